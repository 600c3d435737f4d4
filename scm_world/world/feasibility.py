"""Feasible interventions: those that put no two bodies in one place."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, final

import numpy as np

from scm_world._types import Value
from scm_world.errors import Infeasible, InterventionError
from scm_world.graph import NoiseKey
from scm_world.models import Difference, State, Structure
from scm_world.models.scene import SURFACES, Overlap
from scm_world.variables import SOFT, Draw, Hard, Mechanism
from scm_world.variables.checks import coerce
from scm_world.variables.subsets import AnyRegion
from scm_world.world.candidates import deeper, overlaps_before, promising
from scm_world.world.compiled_task import CompiledTask, Plan, StepBase
from scm_world.world.plan import InterventionPlan, draws_bodies, plan_intervention
from scm_world.world.solver import same
from scm_world.world.structures import StructureCache, asked_structure

ATTEMPTS = 1000
"""How often is drawn; one in sixty draws of the joints from A leaves all fingers apart."""
NONE = f"none of {ATTEMPTS:,} draws was feasible; in the last one "
REMEMBERED = 32
"""In how many structures draws are looked at together, where it is drawn which bodies there are."""


@final
@dataclass(frozen=True)
class Present:
    """What a backend has now.

    Attributes:
        compiled: The task in the structure that there is.
        structure: What the backend has compiled.
        values: By variable; of what physics does not move, the very arrays of the last plan.
        state: Where everything is.
    """

    compiled: CompiledTask
    structure: Structure
    values: Mapping[str, Value]
    state: State

    def difference(self, plan: InterventionPlan) -> Difference:
        """Return what the backend has to change.

        The same as ``scene.diff`` of the two scenes, without describing them: that would make every
        ``do`` about 25 µs dearer. A test compares the two.
        """
        structure = plan.compiled.structure(plan.static)
        if structure is not self.structure:
            then = plan.compiled.describe(plan.static, plan.state)
            return Difference(structure, then.parameters, plan.state)
        changed = {
            key: np.asarray(plan.static[name])
            for name, key in self.compiled.parameter_keys.items()
            if plan.static[name] is not self.values[name]
            and not same(plan.static[name], self.values[name])
        }
        unmoved = self.state.coincides(plan.state)
        return Difference(None, changed, None if unmoved else plan.state)

    def inverse(self, change: Difference) -> Difference:
        """Return what takes a change back."""
        if change.structure is not None:
            now = self.compiled.describe(self.values, self.state)
            return Difference(now.structure, now.parameters, self.state)
        keys, changed = self.compiled.parameter_keys.items(), change.parameters
        old = {key: np.asarray(self.values[name]) for name, key in keys if key in changed}
        return Difference(None, old, None if change.state is None else self.state)

    def overlaps(self, base: StepBase, plan: InterventionPlan, change: Difference) -> list[Overlap]:
        """List overlaps deeper than what physics left; taking something back is always possible."""
        if not self._moves_surfaces(change):
            return []
        then = plan.compiled.describe(plan.static, plan.state)
        found = plan.compiled.composition.overlaps(then, asked=plan.asked)
        return deeper(found, overlaps_before(base)) if found else []

    def _moves_surfaces(self, change: Difference) -> bool:
        if change.structure is not None or any(what in SURFACES for _, what in change.parameters):
            return True
        if change.state is None:
            return False
        moved = self.state.vector != change.state.vector
        return bool(moved[self.compiled.placed].any())


@final
@dataclass(frozen=True)
class CarriedOut:
    """A request with draws that was carried out, for when it comes again from the same base.

    Episodes without noise of their own begin alike, and most have the same request. What it asks
    has been checked then, and what does not follow from a draw has been computed.

    Attributes:
        base: What it started from.
        request: The intervention, with dotted names.
        space: Every target has to lie in, if any.
        plan: Of the draw that was taken.
        kept: The draws that move no body.
        crowded: Whether the first draw need not be planned before it is looked at: it was not
            feasible, so that it seldom is, and it can only be refused for overlaps. All draws are
            from the spaces of a task of this package, and nobody changed a mechanism.
    """

    base: StepBase
    request: Mapping[str, Any]
    space: AnyRegion | None
    plan: InterventionPlan
    kept: frozenset[str]
    crowded: bool

    def is_again(self, base: StepBase, request: Mapping[str, Any], space: AnyRegion | None) -> bool:
        """Tell whether a request is the same, but for where it is drawn."""
        mine = self.base
        return (
            (mine.compiled, mine.index, mine.at_start) == (base.compiled, base.index, base.at_start)
            and mine.model is base.model
            and mine.static is base.static
            and same(mine.state.vector, base.state.vector)
            and not base.pending
            and self.space == space
            and [*self.request] == [*request]
            and all(map(_is_same_act, self.request.values(), request.values()))
        )


def _is_same_act(one: Any, other: Any) -> bool:
    return one is other or (isinstance(one, Draw) and one == other)


def carried_out(
    structures: StructureCache,
    base: StepBase,
    request: Mapping[str, Any],
    space: AnyRegion | None,
    plan: InterventionPlan,
) -> CarriedOut | None:
    """Keep a request that may come again; None where it has no draws, or bodies are drawn."""
    again = base.at_start and not base.pending and not draws_bodies(structures, request)
    if not again or not any(isinstance(act, Draw) for act in request.values()):
        return None
    kept = _immaterial(structures, plan.compiled, request)
    acts = (*request.values(), *base.model.interventions.values())
    ours = type(base.compiled.task).__module__.startswith("scm_world.tasks.")
    usual = (space is None and ours) and not any(
        isinstance(act, (*SOFT, Mechanism))
        or (isinstance(act, Draw) and not isinstance(act.source, str))
        for act in acts
    )
    crowded = usual and plan.solver is not None and plan.solver.attempt > 0
    return CarriedOut(base, request, space, plan, kept, crowded)


def feasible_plan(
    structures: StructureCache,
    base: StepBase,
    present: Present,
    request: Mapping[str, Any],
    space: AnyRegion | None,
    key: NoiseKey,
    found: Iterable[InterventionError] = (),
    earlier: CarriedOut | None = None,
) -> tuple[InterventionPlan, Difference]:
    """Plan an intervention that puts no two bodies in one place.

    Bodies that intersect already (a block that is being squeezed) may continue to. What is
    drawn is drawn again until the world can be like that: from the feasible part of its space.
    What takes no part in where bodies are is drawn once.

    Args:
        structures: Of the task.
        base: The world as physics left it.
        present: What the backend has.
        request: The intervention, with dotted names.
        space: Every target has to lie in, if any.
        key: Where to draw.
        found: Problems of the request that are known already.
        earlier: The same request, if it was carried out before.

    Raises:
        InterventionError: See ``plan_intervention``.
        Infeasible: With the bodies, the depths, and the nearest value that is feasible; or no
            draw was.
    """
    draws = any(isinstance(act, Draw) for act in request.values())
    made: dict[Plan | None, InterventionPlan] = {}
    attempts: Iterator[tuple[int, Plan | None]] = iter(((0, None),))
    tried = ""
    start = None if earlier is None else earlier.plan
    if earlier is not None and earlier.crowded:  # look at the first draw before planning it, too
        key, tried = replace(key, kept=earlier.kept), NONE
        known: dict[Plan | None, InterventionPlan] = {earlier.plan.compiled.plan: earlier.plan}
        attempts = promising(base, known, None, key, range(ATTEMPTS))
    while (drawn := next(attempts, None)) is not None:
        attempt, where = drawn
        key = replace(key, attempt=attempt) if attempt != key.attempt else key
        last = made.get(where, start)
        plan = plan_intervention(structures, base, request, space, key, last, found)
        if len(made) < REMEMBERED:
            made.setdefault(plan.compiled.plan, plan)
        change = present.difference(plan)
        problems = present.overlaps(base, plan, change)
        if draws and not problems:
            problems = _buried(plan, request)
        if not problems:
            return plan, change
        if draws and not attempt:
            if earlier is not None:
                kept = earlier.kept
            else:
                kept = _immaterial(structures, plan.compiled, request)
                if _stay(structures, plan.compiled, request, kept, problems):
                    tried = "whatever is drawn, "
                    break
            key, tried = replace(key, kept=kept), NONE
            structure = None
            if draws_bodies(structures, request):
                structure = partial(_structure, structures, base, request)
            attempts = promising(base, made, structure, key, range(1, ATTEMPTS))
    raise refusal(structures, base, present, plan, request, problems, key, tried)


def _structure(
    structures: StructureCache, base: StepBase, request: Mapping[str, Any], key: NoiseKey
) -> Plan | None:
    """Give the structure of a draw; None where that is refused."""
    try:
        return asked_structure(structures, base, request, key)
    except InterventionError:
        return None


def _immaterial(
    structures: StructureCache, compiled: CompiledTask, request: Mapping[str, Any]
) -> frozenset[str]:
    """Name the draws that move no body and change the size of none.

    Goals count as bodies where there are obstacles, in which they must not be.
    """
    buries = compiled.composition.hides_goals
    found = set()
    for name, act in request.items():
        if isinstance(act, Draw) and name not in structures.head:
            targets = compiled.model.targets(name)
            followers = (*targets, *compiled.static_order(targets))
            is_state = compiled.model.declared(targets[0]).role == "state"
            keys = (compiled.parameter_keys.get(follower) for follower in followers)
            moves = any(key and key[1] in SURFACES for key in keys)
            hides = buries and any(name.endswith(tuple(SURFACES)) for name in followers)
            if not (is_state or moves or hides):
                found.add(name)
    return frozenset(found)


def _stay(
    structures: StructureCache,
    compiled: CompiledTask,
    request: Mapping[str, Any],
    kept: frozenset[str],
    problems: Iterable[Overlap],
) -> bool:
    """Tell whether every draw has an overlap.

    So it is where no draw moves anything, or where both bodies are blocks or obstacles that do not
    follow a draw. Where a draw decides which bodies there are, nothing is known.
    """
    draws = {name for name, act in request.items() if isinstance(act, Draw)} - kept
    if any(name in structures.head for name in draws):
        return False
    targets = {target for name in draws for target in compiled.model.targets(name)}
    moved = targets.union(compiled.static_order(sorted(targets)))
    for state in compiled.carried:
        if not moved.isdisjoint(compiled.set_parents[state.name]):
            moved.add(state.name)
    anyhow = {*compiled.composition.bodies} - {name.partition(".")[0] for name in moved}
    return not draws or any(anyhow.issuperset(overlap.bodies) for overlap in problems)


def _buried(plan: InterventionPlan, request: Mapping[str, Any]) -> list[Overlap]:
    """List goals that were drawn into an obstacle. Where they are put by hand, they may be."""
    compiled = plan.compiled
    if not compiled.composition.hides_goals:
        return []
    draws = [name for name, act in request.items() if isinstance(act, Draw)]
    targets = [target for name in draws for target in compiled.model.targets(name)]
    moved = {*targets, *compiled.static_order(targets)}
    scene = compiled.describe(plan.static, plan.state)
    return list(compiled.composition.buried(scene, {n.partition(".")[0] for n in moved}))


def refusal(
    structures: StructureCache,
    base: StepBase,
    present: Present,
    plan: InterventionPlan,
    request: Mapping[str, Any],
    problems: list[Overlap],
    key: NoiseKey,
    tried: str = "",
) -> Infeasible:
    """Return the error that names the target to blame, and its nearest feasible value."""
    bodies = {body for overlap in problems for body in overlap.bodies}
    name = _culprit(plan.compiled, request, bodies)
    key = replace(key, attempt=0, kept=frozenset())
    found = _nearest(structures, base, present, request, key)
    nearest = None if found is None else found[name]
    return Infeasible(name, request[name], [tried + str(p) for p in problems], nearest)


def _culprit(compiled: CompiledTask, names: Iterable[str], bodies: Iterable[str]) -> str:
    """Name the target that is most likely to have moved one of the bodies."""
    model = compiled.model
    surfaces = {*compiled.places}
    surfaces |= {name for name, key in compiled.parameter_keys.items() if key[1] in SURFACES}

    def blame(name: str) -> tuple[bool, bool]:
        targets = model.targets(name)
        moved = {*targets, *compiled.static_order(targets)} & surfaces
        return bool({part.partition(".")[0] for part in moved} & {*bodies}), bool(moved)

    return max(names, key=blame)


def _nearest(
    structures: StructureCache,
    base: StepBase,
    present: Present,
    request: Mapping[str, Any],
    key: NoiseKey,
    *,
    halvings: int = 20,
) -> dict[str, Any] | None:
    """Search the straight line from the present values to the wanted ones for the last feasible.

    Returns:
        A value for each target, or None where a target is no plain number or nothing is feasible.
    """
    here: dict[str, Value] = {}
    there: dict[str, Value] = {}
    for name, value in request.items():
        if name in structures.head or name not in present.compiled.model:
            return None  # bodies come and go: there is nothing between
        variable = present.compiled.model.declared(name)
        plain = value.value if isinstance(value, Hard) else value
        try:
            there[name] = coerce(variable, plain)
        except InterventionError:
            return None
        here[name] = np.array(present.values[name])

    def between(part: float) -> dict[str, Any]:
        return {name: (here[name] + part * (there[name] - here[name])).tolist() for name in here}

    low, high = 0.0, 1.0
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        try:
            halfway = plan_intervention(structures, base, between(middle), None, key)
            blocked = bool(present.overlaps(base, halfway, present.difference(halfway)))
        except InterventionError:  # outside the bounds on the way
            blocked = True
        low, high = (low, middle) if blocked else (middle, high)
    return between(low)
