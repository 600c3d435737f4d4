"""All the worlds that a task can be: one declaration for each structure."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Hashable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, final

import numpy as np
from pydantic import ValidationError

from scm_world._types import Values
from scm_world.errors import ModelError, UnknownOption
from scm_world.graph import SCM, Moment
from scm_world.tasks import Task
from scm_world.variables import Intervention, Variable
from scm_world.world.absence import taken_apart
from scm_world.world.declaration import Declaration, Options
from scm_world.world.start import refuse_impossible, the_task

KEPT = 8  # declarations that are kept for structures that come again


@final
class Family:
    """A task with all its structures.

    Args:
        task: Of any structure.
        options: Of the world.

    Attributes:
        task: Without a plan.
        head: The model of what decides which entities there are, on its own.
        steps: Length of an episode in control steps, by the structure without interventions.
    """

    def __init__(self, task: Task, options: Options) -> None:
        self.options = options
        self.task = task.at(None, options.conventions)
        with _refused(self.task):
            self.head = _head(self.task)
        self._declarations: OrderedDict[Hashable, Declaration] = OrderedDict()
        first = self.task.at(self.plan(self.head.solve()), options.conventions)
        seconds = first.seconds
        whole = math.floor(seconds / options.control_period + 1e-9)
        self.steps = options.given_length or max(whole, 1)
        refuse_impossible(self.natural(None))

    def plan(self, values: Values) -> Hashable:
        """Say what stands in the world, given the values of the head."""
        return self.task.arrange(values) if len(self.head) else None

    def declaration(self, plan: Hashable) -> Declaration:
        """Give the declaration of a structure."""
        found = self._declarations.get(plan)
        if found is None:
            inner, absent = taken_apart(plan)
            task = self.task.at(inner, self.options.conventions, absent)
            with _refused(task):
                found = self._declarations[plan] = Declaration(task, self.options, self.steps)
            while len(self._declarations) > KEPT:
                self._declarations.popitem(last=False)
        self._declarations.move_to_end(plan)
        return found

    def natural(self, moment: Moment | None) -> Declaration:
        """Give the structure that an episode has when nobody intervenes."""
        return self.declaration(self.plan(self.head.solve(moment=moment)))

    def after(
        self, acts: dict[str, Intervention], held: SCM, static: Values, moment: Moment
    ) -> Declaration | None:
        """Give the structure after an intervention; None where it has nothing to do with it.

        Args:
            acts: What is asked for now, by requested name.
            held: The present model, with the interventions that hold.
            static: Present values.
            moment: Where to draw.
        """
        mine = {name: act for name, act in acts.items() if name in self.head}
        if not mine:
            return None
        kept = {name: act for name, act in held.interventions.items() if name in self.head}
        model = self.head.with_interventions(kept).with_interventions(mine)
        targets = {target for name in (*kept, *mine) for target in self.head.targets(name)}
        known = {
            v.name: static[v.name]
            for v in self.head.variables
            if v.kind == "exogenous" and v.name not in targets  # type: ignore[attr-defined]
        }
        values = model.solve(known, moment=moment)
        if not all(_possible(variable, values) for variable in self.head.variables):
            return None  # the intervention will be refused, with the reason
        return self.declaration(self.plan(values))


def as_family(task: Task | Family | str, options: Options) -> Family:
    """Give all structures of a task, as they are if they are given.

    Raises:
        UnknownOption: There is no such task, or the family is one of other options.
    """
    if not isinstance(task, Family):
        return Family(the_task(task), options)
    if task.options != options:
        raise UnknownOption("options of a world with this family", options, (str(task.options),))
    return task


@contextmanager
def _refused(task: Task) -> Iterator[None]:
    """Say of which task a variable cannot be declared."""
    try:
        yield
    except ValidationError as error:
        problems = [problem["msg"].removeprefix("Value error, ") for problem in error.errors()]
        named = [f"a variable of the task {task.name!r}: {problem}" for problem in problems]
        raise ModelError(named) from error


def _possible(variable: Variable, values: Values) -> bool:
    value = values[variable.name]
    bounds = variable.bounds
    return bool(np.isfinite(value).all()) and (bounds is None or bounds.contains(value, values))


def _head(task: Task) -> SCM:
    """Cut the model of what decides the structure out of what the task's entities share.

    Raises:
        ModelError: A deciding variable, or a cause of one, is not declared in ``shared``.
    """
    shared = {variable.name: variable for variable in task.shared()}
    wanted = _with_causes(task.decided_by, shared)
    missing = sorted(wanted - shared.keys())
    if missing:
        where = "decides what stands in the world: declare it in shared()"
        raise ModelError([f"{name!r} {where}" for name in missing])
    mine = (variable for name, variable in shared.items() if name in wanted)
    return SCM(task.conventions.adapt(mine))


def _with_causes(names: Iterable[str], declared: dict[str, Variable]) -> set[str]:
    found: set[str] = set()
    stack: list[Any] = list(names)
    while stack:
        name = stack.pop()
        if name not in found:
            found.add(name)
            variable = declared.get(name)
            stack.extend(p.name for p in (variable.all_parents if variable else ()))
    return found
