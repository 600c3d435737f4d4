"""Interventions as plans: what is asked for, and what the world would be; nothing changes here."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, final

import numpy as np

from scm_world._types import Value
from scm_world.errors import (
    ConflictingTargets,
    InterventionError,
    NotIntervenable,
    OutOfBounds,
    UnknownVariable,
    raise_all,
)
from scm_world.graph import SCM, NoiseKey
from scm_world.graph.acceptance import refuse_time
from scm_world.models import State
from scm_world.variables import Draw, Hard, Intervention, Natural, Null, divided
from scm_world.variables.subsets import AnyRegion, as_region
from scm_world.world.compiled_task import CompiledTask, PendingInterventions, StepBase
from scm_world.world.solver import Solver
from scm_world.world.structures import (
    StructureCache,
    asked_structure,
    restructured,
    wrong_structure,
)


@final
@dataclass(frozen=True)
class InterventionPlan:
    """What a world would be after an intervention.

    Attributes:
        compiled: The task in the structure that there would be.
        static: Values of everything that physics does not move.
        state: Where everything would be.
        index: The control step.
        asked: The names that were asked for now.
        solver: How it was computed, for another attempt.
        removals: What was asked to be taken away.
    """

    compiled: CompiledTask
    static: Mapping[str, Value]
    state: State
    index: int
    asked: tuple[str, ...] = ()
    solver: Solver | None = None
    removals: Mapping[str, Null] = field(default_factory=dict)

    # Of hundreds of attempts one is carried out: these are computed for it alone.

    @cached_property
    def model(self) -> SCM:
        """With the interventions that would hold."""
        if self.solver is None:
            return self.compiled.model
        fixed = self.solver.fixed
        return self.solver.model.with_interventions(fixed) if fixed else self.solver.model

    @cached_property
    def pending(self) -> PendingInterventions:
        """The interventions at this control step, draws as values."""
        solver, model = self.solver, self.compiled.model
        if solver is None:
            return {}
        removals = {name: (name, act) for name, act in self.removals.items()}
        return {
            target: solver.frozen(target, *named) if target in model else named
            for target, named in {**solver.pending, **removals}.items()
        }


def plan_intervention(
    structures: StructureCache,
    base: StepBase,
    request: Mapping[str, Any],
    space: AnyRegion | None,
    key: NoiseKey,
    last: InterventionPlan | None = None,
    found: Iterable[InterventionError] = (),
) -> InterventionPlan:
    """Compute what the world would be after an intervention.

    Args:
        structures: Of the task.
        base: The world as physics left it.
        request: The intervention, with dotted names.
        space: Every target has to lie in, if any.
        key: Where to draw.
        last: An earlier attempt at the same. What is the same again is taken from there, where
            the structure is; nothing comes out differently for that.
        found: Problems of the request that are known already.

    Raises:
        InterventionError: With every problem of the request. Whether bodies overlap is asked only
            where there is no other problem.
        UnknownOption: There is no such space.
    """
    space = as_region("space", space)
    earlier = None if last is None else last.solver
    if (
        last is not None
        and draws_bodies(structures, request)
        and asked_structure(structures, base, request, key) != last.compiled.plan
    ):
        earlier = None
    if earlier is None:
        wrong = wrong_structure(structures, base, request)
        request = {n: act for n, act in request.items() if n not in wrong}
        base = restructured(structures, base, request, key)
        accepted, asked, problems = _accepted(base, request)
        problems = [*found, *wrong.values(), *problems]
        solver = Solver(base, asked, {**base.pending, **accepted}, key)
    else:  # another draw from the same spaces
        solver, problems = earlier.again(key), []
    with np.errstate(all="ignore"):  # what is not finite is refused by name
        problems += solver.solve(space, frozenset(structures.head))
    raise_all(solver.as_asked(problems) if problems else problems)
    return InterventionPlan(
        solver.base.compiled,
        solver.static,
        solver.state,
        solver.index,
        solver.asked,
        solver,
        {name: act for name, act in request.items() if isinstance(act, Null)},
    )


def draws_bodies(structures: StructureCache, request: Mapping[str, Any]) -> bool:
    """Tell whether it is drawn which bodies there are."""
    return any(isinstance(act, Draw) and name in structures.head for name, act in request.items())


def _accepted(
    base: StepBase, request: Mapping[str, Any]
) -> tuple[PendingInterventions, tuple[str, ...], list[InterventionError]]:
    """Check names, types and shapes: what is right, under which names it was asked, problems.

    What is asked of a bundle is asked of its parts.
    """
    compiled = base.compiled
    model = compiled.model
    accepted: PendingInterventions = {}
    asked: dict[str, str] = {}
    problems: list[InterventionError] = []
    for name, value in request.items():
        try:
            if isinstance(value, Null | Natural) and name not in model:
                refuse_time(name, value)
            if isinstance(value, Null):  # of an entity, not of a variable; see ``restructured``
                continue
            if isinstance(value, Natural) and name in compiled.entity_names:
                continue  # it is there
            kept, act = _checked(base, name, value)
            targets = model.targets(name)
            twice = next((target for target in targets if target in asked), None)
            if twice is not None:
                raise ConflictingTargets((asked[twice], name), twice)
            asked |= dict.fromkeys(targets, name)
            for part, own in divided(model.declared(kept), act).items():
                accepted[model.target(part)] = (part, own)
        except InterventionError as problem:
            reason = dict(compiled.composition.system.refused).get(name)
            if reason is not None and isinstance(problem, UnknownVariable):
                problem = NotIntervenable(name, reason)
            problems.append(problem)
    return accepted, tuple(dict.fromkeys(asked.values())), problems


def _checked(base: StepBase, name: str, value: Any) -> tuple[str, Intervention]:
    """Check an intervention; return it with the name of what it sets.

    Coordinates that are those of the instant set the quantity to what it was at the instant: their
    inverse is rounded, and taking something back leaves no trace.
    """
    model = base.compiled.model
    try:
        act = model.accept(name, value)
    except OutOfBounds as problem:
        # What physics did is possible: a state can always be put back to where it is.
        present = base.value(name)
        if present is None or not np.array_equal(problem.value, present):
            raise
        act = Hard(problem.value)
    target = model.target(name)
    if isinstance(act, Hard) and name != target and name not in base.compiled.bundles:
        quantity, present = base.value(target), base.value(name)
        if present is not None and np.array_equal(act.value, np.ravel(present)):
            return target, Hard(quantity)
    return name, act


def merged(model: SCM, *requests: Mapping[str, Any]) -> dict[str, Any]:
    """Combine interventions; the last one that sets a quantity counts.

    Args:
        model: Knows which names are coordinates of one quantity, and which are bundles.
        requests: With dotted names.
    """
    found: dict[str, Any] = {}
    for acts in requests:
        mine = {target for name in acts for target in _targets(model, name)}
        kept = {n: a for n, a in found.items() if not mine.issuperset(_targets(model, n))}
        found = {**kept, **acts}
    return found


def _targets(model: SCM, name: str) -> tuple[str, ...]:
    return model.targets(name) if name in model else (name,)
