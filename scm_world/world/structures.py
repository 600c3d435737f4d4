"""The structures of a task: sets of bodies, each with its compiled task."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any, final
from weakref import WeakValueDictionary

import networkx as nx

from scm_world._fingerprint import digest, fingerprint
from scm_world._types import Values
from scm_world.errors import InterventionError, ModelError, UnknownOption, UnknownVariable
from scm_world.graph import SCM, NoiseKey
from scm_world.tasks import Options, Task
from scm_world.tasks.sources import TASKS
from scm_world.variables import Intervention, Null
from scm_world.variables.checks import check_bounds, coerce
from scm_world.variables.reserved import CONTROL_INDEX
from scm_world.world.compiled_task import (
    CompiledTask,
    Plan,
    beginning,
)
from scm_world.world.mechanisms import Rows
from scm_world.world.snapshot import Base

KEPT = 8
"""Number of compiled tasks in the cache."""

HELD = 64
"""Number of models whose tasks may be compiled again without reading them."""


@final
class StructureCache:
    """The compiled tasks of all structures of a task.

    Args:
        task: A task in any structure.
        options: Options of the world.
        kind: What a structure is compiled to, of a task and options.

    Attributes:
        options: The same, with the length of an episode in the structure without interventions.
        task: The task without a plan.
        head: The submodel of the variables that determine which entities exist.
        deciding: The names of its variables.
        compiled: Returns the task compiled for a structure.
    """

    def __init__(
        self, task: Task, options: Options, kind: Callable[[Any, Options], Any] = CompiledTask
    ) -> None:
        self._kind = kind
        self.task = task.at(None, options.conventions)
        with _refused(self.task):
            self.head = _head(self.task)
        self.deciding = frozenset(self.head)
        self.compiled = lru_cache(KEPT)(self._compile)
        self._held = lru_cache(HELD)(lambda system: system)
        first = self.task.at(self.plan(self.head.solve())[0], options.conventions)
        whole = math.floor(first.seconds / options.control_period + 1e-9)
        self.options = replace(options, steps=options.given_length or max(whole, 1))
        self.natural(None).refuse_impossible()

    @cached_property
    def digest(self) -> str:
        """Hash of the variables and the model, without the arguments of the task."""
        return digest(fingerprint(self._system(), libraries=False))

    @cached_property
    def first(self) -> Rows:
        """The row of an episode that begins without draws; copy it to change it."""
        return beginning(self.natural(None), None)

    def __fingerprint__(self) -> dict[str, Any]:
        """Return everything that determines the system: task, arguments, model and variables."""
        return {**self.task.__fingerprint__(), **self._system()}

    def _system(self) -> dict[str, Any]:
        physics = {"physics": getattr(self.task, "system", None)}
        model = self.natural(None).model
        return {**physics, **self.head.__fingerprint__(), **model.__fingerprint__()}

    def plan(self, values: Values) -> Plan:
        """Return the structure that follows from values of the head."""
        return self.task.arrange(values) if self.deciding else None, frozenset()

    def _compile(self, plan: Plan) -> CompiledTask:
        task = self.task.at(plan[0], self.options.conventions, plan[1])
        with _refused(task):
            made: CompiledTask = self._kind(task, self.options)
        self._held(made.source)
        return made

    def natural(self, key: NoiseKey | None) -> CompiledTask:
        """Return the structure of an episode without interventions."""
        values = self.head.solve(key=key) if self.deciding else {}
        return self.compiled(self.plan(values))

    def after(
        self, acts: Mapping[str, Any], held: SCM, static: Values, key: NoiseKey
    ) -> Plan | None:
        """Return the structure after an intervention; None if the intervention leaves it alone.

        ``held`` is the model with the interventions in force, and ``static`` has present values.
        What is wrong is refused later, with the reason.
        """
        new: dict[str, Intervention] = {}
        for name in (name for name in acts if name in self.head):
            with suppress(InterventionError):
                new[name] = self.head.accept(name, acts[name])
        if not new:
            return None
        kept = {name: act for name, act in held.interventions.items() if name in self.head}
        model, cycles = self.head._with_interventions(kept)._without_cycles(new)
        if cycles:
            return None
        targets = {target for name in (*kept, *new) for target in self.head.targets(name)}
        known = {
            v.name: static[v.name]
            for v in self.head.variables
            if v.is_root and v.name not in targets
        }
        values = model.solve(known, key=key)
        try:
            for variable in self.head.variables:
                check_bounds(variable, coerce(variable, values[variable.name]), values)
        except InterventionError:
            return None
        return self.plan(values)


_ALIVE: WeakValueDictionary[tuple[type[Task], Options], StructureCache] = WeakValueDictionary()


def structures_of(task: Task, options: Options) -> StructureCache:
    """Return the structures of a task.

    They are those of another world that is there, if both have equal options and an equal task of
    this package: nothing in those can change but their attributes, which are compared.
    """
    key = type(task), options
    found = _ALIVE.get(key)
    if found is None or not _alike(found.task, task.at(None, options.conventions)):
        found = StructureCache(task, options)
        if type(task) in TASKS.values():
            _ALIVE[key] = found
    return found


def _alike(one: Task, other: Task) -> bool:
    try:
        return vars(one) == vars(other)
    except ValueError:  # of arrays
        return False


@contextmanager
def _refused(task: Task) -> Iterator[None]:
    """Add the name of the task to errors in declarations."""
    try:
        yield
    except (ModelError, UnknownOption) as error:
        error.add_note(f"in the task {task.name!r}")
        raise


def _head(task: Task) -> SCM:
    """Return the submodel of the shared variables that determine the structure."""
    shared = {variable.name: variable for variable in task.shared()}
    causes = nx.DiGraph((p.name, v.name) for v in shared.values() for p in v.all_parents)
    causes.add_nodes_from(task.decided_by)
    wanted = {*task.decided_by}.union(*(nx.ancestors(causes, name) for name in task.decided_by))
    missing = sorted(wanted - shared.keys())
    if missing:
        advice = "determines which bodies exist: declare it in shared()"
        raise ModelError([f"{name!r} {advice}" for name in missing])
    return SCM(task.conventions.adapt(shared[name] for name in shared if name in wanted))


def restructured(
    structures: StructureCache, base: Base, request: Mapping[str, Any], key: NoiseKey
) -> tuple[Base, dict[str, InterventionError]]:
    """Return the base in the structure after a request, and errors by requested name.

    Bodies that remain keep their values, states and interventions; added bodies begin as at the
    start of an episode.
    """
    present, acts = base.row.compiled, dict[str, Any](base.pending.values())
    gone = {name for name, act in acts.items() if getattr(act, "removes", False)}
    wrong: dict[str, InterventionError] = {}
    for name, act in request.items():
        try:
            if getattr(act, "removes", False) and name not in gone:
                _check_removal(present, name)
                gone.add(name)
            elif isinstance(act, Intervention) and act.computes and name in structures.head:
                _check_parents(structures.head, name, act)
        except InterventionError as problem:
            wrong[name] = problem
        else:
            acts[name] = act
    after = structures.after(acts, base.model, base.row, key) or present.plan
    plan = after[0], present.task.absent | gone
    if plan == present.plan:
        return base, wrong
    compiled = structures.compiled(plan)
    kept = {n: act for n, act in base.model.interventions.items() if n in compiled.model}
    model = compiled.model._with_interventions(kept)
    held = {target for name in kept for target in model.targets(name)}
    known = {
        v.name: base.row[v.name]
        for v in model.variables
        if v.is_root and v.name in present.static and v.name not in held
    }
    row = beginning(compiled, key, model, known)
    row[CONTROL_INDEX] = base.row[CONTROL_INDEX]
    if row.actions.shape == base.row.actions.shape:
        row.actions[:] = base.row.actions
    row.recall(base.row)
    for name in compiled.slices.keys() & present.slices.keys():
        row[name] = base.row[name]
    fresh = frozenset(compiled.slices.keys() - present.slices.keys())
    structure = compiled.composition.structure(row)
    return replace(base, model=model, row=row, structure=structure, fresh=fresh), wrong


def _check_parents(head: SCM, name: str, act: Intervention) -> None:
    others = [p.name for p in act.follows(head.declared(name)) if p.name not in head or p.lag]
    if others:
        raise InterventionError(
            f"do({name}): it determines which bodies exist, so its parents can only be "
            f"{', '.join(n for n in head if n != name) or 'nothing'}, not {', '.join(others)}",
            variable=name,
            value=act,
        )


def _check_removal(present: CompiledTask, name: str) -> None:
    there = {entity.name: entity.kind for entity in present.composition.entities}
    if name not in there and name in present.model:
        present.model.accept(name, Null())  # which says that it is a variable
    if name not in there:
        raise UnknownVariable(name, there)
    if not there[name]:
        removable = ", ".join(n for n, kind in there.items() if kind)
        text = f"do({name}): it cannot be removed; these can: {removable}"
        raise InterventionError(text, variable=name, value=Null())
