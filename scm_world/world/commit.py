"""The second half of a do(): is it feasible, and make it so, wholly or not at all."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from scm_world._types import Floats, Value
from scm_world.errors import EngineFailure, Infeasible, InterventionError
from scm_world.graph import flatten
from scm_world.models import Difference, State
from scm_world.models.scene import TOLERANCE, Overlap
from scm_world.variables import Draw, Hard
from scm_world.variables.checks import coerce
from scm_world.variables.reserved import CONTROL_INDEX
from scm_world.variables.subsets import AnyRegion
from scm_world.world.audit import Applied, Audit
from scm_world.world.compare import same
from scm_world.world.declaration import Declaration
from scm_world.world.proposal import Instant, Proposal, propose

if TYPE_CHECKING:
    from scm_world.world.world import World

READ_BACK = 1e-6  # how far an engine may report a number from what it was given
_MOVES = ("size", "height", "position", "orientation")
"""Parameters that change where the surfaces of bodies are."""
_PLACES = ("m", "rad", "1")
"""Units of states that do so: positions, angles and quaternions, not velocities."""
ATTEMPTS = 1000
"""How often is drawn; one in sixty draws of the joints from A leaves all fingers apart."""


def difference(world: World, proposal: Proposal) -> Difference:
    """Give what the engine has to change, from its present state.

    The same as ``scene.diff`` of the two scenes, without describing them: that would make every
    ``do`` about 25 µs dearer. A test holds the two against each other.
    """
    now, state = world.current()
    structure = proposal.declaration.structure(proposal.static)
    if structure is not world.structure:
        then = proposal.declaration.describe(proposal.static, proposal.state)
        return Difference(structure, then.parameters, proposal.state)
    changed = {
        key: np.asarray(proposal.static[name])
        for name, key in world.parameter_keys.items()
        if proposal.static[name] is not now[name] and not same(proposal.static[name], now[name])
    }
    unmoved = state.coincides(proposal.state)
    return Difference(None, changed, None if unmoved else proposal.state)


def _moves_surfaces(world: World, change: Difference) -> bool:
    if not world.composition.solid:
        return False
    if change.structure is not None or any(what in _MOVES for _, what in change.parameters):
        return True
    if change.state is None:
        return False
    now: Any = world.current()[1]
    then = change.state
    joints = same(now.joint_positions, then.joint_positions)
    return not (joints and same(now.blocks[:, :7], then.blocks[:, :7]))


def _new_overlaps(
    world: World, instant: Instant, proposal: Proposal, change: Difference
) -> list[Overlap]:
    """List overlaps deeper than what physics left; taking something back is always possible."""
    if not _moves_surfaces(world, change):
        return []
    then = proposal.declaration.describe(proposal.static, proposal.state)
    found = proposal.declaration.composition.overlaps(then, TOLERANCE)
    if not found:
        return []
    now = instant.declaration
    present = now.composition.overlaps(now.describe(instant.static, instant.state), 0.0)
    depth = {overlap.bodies: overlap.depth for overlap in present}
    return [o for o in found if o.depth > depth.get(o.bodies, 0.0) + 1e-6]


def feasible(
    world: World, instant: Instant, request: Mapping[str, Any], space: AnyRegion | None
) -> tuple[Proposal, Difference]:
    """Work out an intervention that does not put two bodies in one place.

    Bodies that intersect already (a block that is being squeezed) may go on doing so. What is
    drawn is drawn again until the world can be like that: from the feasible part of its space.
    What takes no part in where bodies are is drawn once.

    Raises:
        InterventionError: See ``propose``.
        Infeasible: With the bodies, the depths, and the nearest value that is feasible; or no
            draw was.
    """
    draws = any(isinstance(act, Draw) for act in flatten(request).values())
    kept: frozenset[str] = frozenset()
    last: Proposal | None = None
    for attempt in range(ATTEMPTS if draws else 1):
        proposal = propose(world, instant, request, space, attempt=attempt, kept=kept, last=last)
        change = difference(world, proposal)
        problems = _new_overlaps(world, instant, proposal, change)
        if draws and not problems:
            problems = _buried(proposal, flatten(request))
        if not problems:
            return proposal, change
        last = proposal
        if draws and not attempt:
            kept = _immaterial(world, proposal.declaration, flatten(request))
    tried = f"none of {ATTEMPTS:,} draws was feasible; in the last one " if draws else ""
    raise _refusal(world, instant, proposal, problems, request, tried)


def _immaterial(
    world: World, declaration: Declaration, request: Mapping[str, Any]
) -> frozenset[str]:
    """Name the draws that move no body and change the size of none.

    Goals count as bodies where there are obstacles, in which they must not be.
    """
    buries = bool(declaration.composition.obstacles)
    found = set()
    for name, act in request.items():
        if isinstance(act, Draw) and name not in world.family.head:
            targets = declaration.model.targets(name)
            followers = (*targets, *declaration.static_order(targets))
            is_state = declaration.model.declared(targets[0]).role == "state"
            keys = (world.parameter_keys.get(follower) for follower in followers)
            moves = any(key and key[1] in _MOVES for key in keys)
            hides = buries and any(follower.endswith(_MOVES) for follower in followers)
            if not (is_state or moves or hides):
                found.add(name)
    return frozenset(found)


def _buried(proposal: Proposal, request: Mapping[str, Any]) -> list[Overlap]:
    """List goals that were drawn into an obstacle. Where they are put by hand, they may be."""
    declaration = proposal.declaration
    if not declaration.composition.obstacles:
        return []
    draws = [name for name, act in request.items() if isinstance(act, Draw)]
    targets = [target for name in draws for target in declaration.model.targets(name)]
    moved = {*targets, *declaration.static_order(targets)}
    scene = declaration.describe(proposal.static, proposal.state)
    return list(declaration.composition.buried(scene, {n.partition(".")[0] for n in moved}))


def refuse_overlaps(
    world: World, instant: Instant, proposal: Proposal, change: Difference, name: str
) -> None:
    """Refuse what nature drew where it puts two bodies in one place.

    Raises:
        Infeasible: With the bodies and the depths.
    """
    problems = _new_overlaps(world, instant, proposal, change)
    if problems:
        raise _refusal(world, instant, proposal, problems, {name: Draw("A")})


def _refusal(
    world: World,
    instant: Instant,
    proposal: Proposal,
    problems: list[Overlap],
    request: Mapping[str, Any],
    tried: str = "",
) -> Infeasible:
    flat = flatten(request)
    name = _culprit(proposal.declaration, flat, {body for p in problems for body in p.bodies})
    found = nearest_feasible(world, instant, request)
    nearest = None if found is None else found[name]
    return Infeasible(name, flat[name], [tried + str(p) for p in problems], nearest)


def _culprit(world: Declaration, names: Iterable[str], bodies: Iterable[str]) -> str:
    """Name the target that is most likely to have moved one of the bodies."""
    surfaces = {name for name in world.slices if world.model.declared(name).unit in _PLACES}
    surfaces |= {name for name, key in world.parameter_keys.items() if key[1] in _MOVES}

    def blame(name: str) -> tuple[bool, bool]:
        targets = world.model.targets(name)
        moved = {*targets, *world.static_order(targets)} & surfaces
        return bool({part.partition(".")[0] for part in moved} & {*bodies}), bool(moved)

    return max(names, key=blame)


def nearest_feasible(
    world: World, instant: Instant, request: Mapping[str, Any], *, halvings: int = 20
) -> dict[str, Any] | None:
    """Search the straight line from the present values to the wanted ones for the last feasible.

    Returns:
        A value for each target, or None where a target is no plain number or nothing is feasible.
    """
    here: dict[str, Value] = {}
    there: dict[str, Value] = {}
    for name, value in flatten(request).items():
        if name in world.family.head or name not in world.model:
            return None  # bodies come and go: there is nothing between
        variable = world.model.declared(name)
        plain = value.value if isinstance(value, Hard) else value
        try:
            there[name] = coerce(variable, plain)
        except InterventionError:
            return None
        here[name] = world[name]

    def between(part: float) -> dict[str, Any]:
        return {name: (here[name] + part * (there[name] - here[name])).tolist() for name in here}

    low, high = 0.0, 1.0
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        try:
            halfway = propose(world, instant, between(middle), None)
            change = difference(world, halfway)
            blocked = bool(_new_overlaps(world, instant, halfway, change))
        except InterventionError:  # outside the bounds on the way
            blocked = True
        low, high = (low, middle) if blocked else (middle, high)
    return between(low)


def commit(
    world: World,
    instant: Instant,
    proposal: Proposal,
    change: Difference,
    request: Mapping[str, Any],
) -> tuple[Audit, Instant]:
    """Apply a proposal, read it back, and report; or put everything back and raise.

    Raises:
        EngineFailure: The engine does not report what it was given. The world is as before.
    """
    before = dict(world.current()[0])
    moved_before = {}
    if change.state is not None:
        states = (name for name in world.slices if name not in world.declaration.bundles)
        moved_before = {name: np.array(before[name]) for name in states}
    declaration, index, state = world.declaration, world.index, world.current()[1].copy()
    model, static = world.graph, {name: before[name] for name in declaration.static_names}
    bodies = {*world.composition.blocks, *world.composition.obstacles}
    backwards = _back(world, change, before, state)
    try:
        inertia = _inertia(world, change)
        _apply(world, change, proposal)
        world.adopt(proposal.declaration, proposal.model, proposal.static, proposal.index)
        audit = _report(world, proposal, request, before, moved_before, inertia, bodies)
    except BaseException:
        if change:
            world.backend.apply(backwards)
        world.adopt(declaration, model, static, index, state)
        raise
    return audit, replace(instant, requests=proposal.requests)


def _apply(world: World, change: Difference, proposal: Proposal) -> None:
    if not change:
        return
    world.backend.apply(change)
    wrong = _not_taken(world, change, proposal)
    if wrong:
        raise EngineFailure(f"the engine did not take over {', '.join(wrong)}", world.backend.name)


def _back(
    world: World, change: Difference, before: Mapping[str, Value], state: State
) -> Difference:
    if change.structure is not None:
        now = world.describe(before, state)
        return Difference(now.structure, now.parameters, state)
    keys = {key: name for name, key in world.parameter_keys.items()}
    old = {key: before[keys[key]] for key in change.parameters}
    return Difference(None, old, None if change.state is None else state)


def _not_taken(world: World, change: Difference, proposal: Proposal) -> list[str]:
    reported = world.backend.parameters(change.parameters)
    wrong = [
        ".".join(key)
        for key, value in change.parameters.items()
        if not _close(value, reported[key])
    ]
    if change.state is not None:
        got = change.state.copy()
        world.backend.read(got)
        if not _close(change.state.settable(), got.settable()):
            wrong.append("the state")
    return wrong


def _close(given: Floats, reported: Floats) -> bool:
    if same(given, reported):
        return True
    return bool(np.all(np.abs(given - reported) <= READ_BACK * np.maximum(1.0, np.abs(given))))


def _inertia(world: World, change: Difference) -> dict[str, Value]:
    if change.structure is not None or not world.composition.solid:
        return {}
    bodies = {body for body, what in change.parameters if what in ("mass", "size")}
    bodies -= {*world.composition.obstacles}
    return {f"{body}.inertia": world.backend.inertia(body) for body in sorted(bodies)}


def _outcome(world: World, proposal: Proposal, target: str) -> tuple[Value | None, Value | None]:
    """Give the value that a target has now, and what the engine says it is; None if unknown."""
    now, state = world.current()
    if target in proposal.declaration.actions:
        act = proposal.requests[target][1]
        return (np.array(act.value) if isinstance(act, Hard) else None), None
    applied = np.array(now[target])
    if target == CONTROL_INDEX:
        return applied, np.asarray(world.index)
    if target in world.slices:
        return applied, np.array(world.declaration.view(target, state))
    key = world.parameter_keys.get(target)
    return applied, None if key is None else world.backend.parameters([key])[key]


def _asked(world: World, proposal: Proposal, name: str) -> tuple[Value | None, Value | None]:
    """Give the same of what was asked for: a target, other coordinates of one, or a bundle."""
    targets = world.model.targets(name)
    outcomes = [_outcome(world, proposal, target) for target in targets]
    if targets == (name,):
        return outcomes[0]
    values = [applied for applied, _ in outcomes if applied is not None]
    reported = [back for _, back in outcomes if back is not None]
    if len(values) < len(targets):
        return None, None
    applied = world.in_coordinates(name, *values)
    if len(reported) < len(targets):
        return applied, None
    exact = all(map(same, reported, values))
    return applied, applied if exact else world.in_coordinates(name, *reported)


def _report(
    world: World,
    proposal: Proposal,
    request: Mapping[str, Any],
    before: Mapping[str, Value],
    moved_before: Mapping[str, Value],
    inertia: Mapping[str, Value],
    bodies: set[str],
) -> Audit:
    flat = flatten(request)
    now = world.current()[0]
    entries = {}
    for name in proposal.asked:
        applied, back = _asked(world, proposal, name)
        entries[name] = Applied(name, flat[name], applied, back)
    bundles = world.declaration.bundles
    known = {*entries, *(part for name in entries if name in bundles for part in bundles[name])}
    followed = {
        name: (before[name], value)
        for name, value in proposal.static.items()
        if value is not before.get(name, value)
        and name not in known
        and not _same(value, before[name])
    }
    for name, old in moved_before.items():
        if name in now and name not in known and not same(old, now[name]):
            followed[name] = (old, np.array(now[name]))
    engine = {
        body: (old, world.backend.inertia(body.removesuffix(".inertia")))
        for body, old in inertia.items()
    }
    there = {*world.composition.blocks, *world.composition.obstacles}
    came, went = sorted(there - bodies), sorted(bodies - there)
    return Audit(entries, followed, engine, tuple(came), tuple(went))


def _same(a: Value, b: Value) -> bool:
    return np.shape(a) == np.shape(b) and same(a, b)
