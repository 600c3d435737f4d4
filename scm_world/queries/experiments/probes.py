"""Probe states, in which experiments are run.

A task may define states in which effects are visible; see ``Task.scenarios``. For other systems,
states are drawn: at the beginning of episodes, after random actions, random feasible states, and
states with contacts, with present and with other parameters. In every second one, no component of
the action is saturated. Probe i of a seed is the same, regardless of earlier probes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.backends.step import StepModel
from scm_world.errors import EngineFailure, InterventionError, SeveralProblems
from scm_world.graph import SCM
from scm_world.policies.planning import action_range
from scm_world.queries.episodes import ALL, Episode, Unit, run
from scm_world.queries.experiments.effects import RESOLUTION
from scm_world.queries.plans import Plan
from scm_world.tasks.base import Scenario
from scm_world.variables import Box, Rotations, Variable
from scm_world.world import CompiledModel, Equations, Simulation, Snapshot

Random = np.random.Generator
T = TypeVar("T")

BY_CONTACT = (
    *("start", "touching", "onward, touching", "anywhere"),
    *("touching, others", "onward, others", "touching", "onward, touching"),
)
"""Kinds of states of a system with contacts; ``others``: parameters have other values."""

FREE = ("start", "onward", "anywhere", "onward, others", "onward", "anywhere, others")
"""Kinds of states of a system without contacts."""

GIVEN = (
    *("start", "somewhere", "onward", "at an end"),
    *("somewhere", "onward", "at an end", "somewhere"),
)
"""Kinds of states at given parameters: bodies are moved one by one, maybe to ends of a range."""

ATTEMPTS = 20  # number of draws of an infeasible kind of state
TRIES = 4  # attempts of a request, each without the refused targets
LONGEST = 60  # control steps of random actions, or number of states in the search for contacts
FOLLOWED = 5  # control steps from each of these states
KEPT = 10  # largest number of control steps with one action
WORLD = "world"  # the body of all static shapes
MOVING = 0.75  # share of contacts between two other bodies, if there are any
HALVINGS = 30  # bisections of a range of commands, in the search for an unsaturated one
TINY = 1e-9  # share of that range: the change of a command that must have an effect
SHARE = 0.5  # share of parameters with other values, in probes with other parameters
FREE_RUNS, FREE_STEPS = 4, 30  # episodes and their control steps, in free motion
JITTER = 0.2  # largest relative change of a parameter without a space in a probe state
FAR = 0.75  # the same in an experiment
NEAR = 0.5  # share of positions within reach
REACH = {"rad": np.pi, "m": 0.2, "rad/s": 4.0, "m/s": 2.0}
"""Largest change of a state without bounds, by its unit.

For other units it is the present value, but at least the default; 1 if that is zero.
"""


class Probe(NamedTuple):
    """A probe state."""

    kind: str
    snapshot: Any  # None for equations
    action: Floats  # the next one, shape (n_actions,)
    unsaturated: frozenset[int] | None = None  # components of which a tiny change has an effect


def probes(
    system: Simulation | SCM,
    n: int,
    seed: int,
    *,
    first: int = 0,
    scenarios: bool = True,
    begin: Callable[[int], object] | None = None,
    kinds: Sequence[str] = (),
) -> Iterator[Probe]:
    """Yield the probe states from ``first`` to ``n - 1``; a world is reset for each of them.

    Those of equations are units. ``scenarios`` is whether to use the task's, if there are any; with
    ``kinds``, states are of these instead. With ``begin``, it begins the episode of each probe.
    """
    if isinstance(system, SCM):
        yield from (Probe("unit", None, np.zeros(0)) for _ in range(first, n))
        return
    system.reset(seed=seed)
    own = system.task.scenarios(system) if scenarios and not kinds else ()
    for number in range(first, n):
        for attempt in range(ATTEMPTS + 1):
            rng = np.random.default_rng((seed, number, attempt))
            try:
                if begin is None:
                    system.reset(seed=number)
                else:
                    begin(number)
                if attempt == ATTEMPTS:
                    probe = Probe("start", system.snapshot(), system.task.idle(system))
                elif own:
                    probe = _staged(system, own[number % len(own)], rng)
                else:
                    probe = _drawn(system, number, rng, kinds)
                system.step(probe.action)
                if not np.isfinite(system.vector).all():
                    raise EngineFailure("the state is lost", system.backend.name)
                break
            except (InterventionError, EngineFailure):
                if attempt == ATTEMPTS:
                    raise
        yield probe


def _staged(world: Simulation, scenario: Scenario, rng: Random) -> Probe:
    """Prepare a scenario of the task."""
    prepare, act, steps = scenario
    states, extra = prepare(world, rng)
    if states:
        world.do(states)
    action = act(world, extra, rng)
    for _ in range(round(rng.uniform(0.0, 2.0)) if steps is None else steps):
        world.step(action)
    return Probe(prepare.__name__, world.snapshot(), act(world, extra, rng))


def free_spread(system: Simulation | SCM, seed: int) -> dict[str, float]:
    """Return how much each effect varies by itself: the largest standard deviation of a component.

    It is taken over the instants of episodes without interventions and with random actions, or
    over draws of equations without time. Rounding counts as 0.
    """
    is_timeless = isinstance(system, SCM) and not system.is_temporal
    free: Any = Equations(CompiledModel(system)) if isinstance(system, SCM) else system
    seen: dict[str, list[Value]] = {edge.effect: [] for edge in free.model.edges}
    runs, steps = (FREE_RUNS * FREE_STEPS, 0) if is_timeless else (FREE_RUNS, FREE_STEPS)
    for number in range(runs):
        rng = np.random.default_rng((seed, number, 2))
        kept, shape = 1 + rng.integers(KEPT), (steps + 1, free.compiled.n_actions)
        actions = rng.uniform(*action_range(free), shape)[np.arange(steps + 1) // kept]
        episode = Episode._of(None, Unit(number, 0, Plan(), actions, steps, (ALL,)), free)
        with suppress(InterventionError, EngineFailure):  # then the run ends early
            episode._begin()
            run(episode, 0, steps)
        for name in seen.keys() & episode.values.keys():
            seen[name] += (np.array(value, float) for value in episode.values[name])
    found, least = dict.fromkeys(seen, 0.0), rounds_at(free)
    for name, rows in seen.items():
        alike = [row for row in rows if row.shape == rows[0].shape and np.isfinite(row).all()]
        size = float(np.std(alike, axis=0).max(initial=0.0)) if alike else 0.0
        largest = max(least, float(np.abs(alike).max(initial=0.0)))
        found[name] = size if size > RESOLUTION * largest else 0.0
    return found


def rounds_at(system: Any) -> float:
    """Return the least size of numbers of which a system has the rounding errors.

    That is 1 in physics engines: in SI units, they compute with numbers of order one. Step
    functions and equations have units of any size.
    """
    physics = system.backend is not None and not isinstance(system.structure, StepModel)
    return float(physics)


# --- of any system ------------------------------------------------------------------------------


def _drawn(world: Simulation, number: int, rng: Random, kinds: Sequence[str]) -> Probe:
    """Draw a state of the kind of a probe number; without ``kinds``, of those of the system."""
    if not kinds:
        kinds = BY_CONTACT if any(edge.when == "contact" for edge in world.model.edges) else FREE
    which = number % len(kinds)
    words = kinds[which].split(", ")
    if "others" in words:
        set_others(world, rng)
    if {"somewhere", "at an end"} & {*words}:
        things: dict[str, dict[str, Value]] = {}
        for name, value in anywhere(world, rng, at_end="at an end" in words).items():
            things.setdefault(name.partition(".")[0], {})[name] = value
        for values in things.values():
            with suppress(InterventionError):
                world.do(values)
    elif "start" not in words:
        _go(world, rng, onward="onward" in words, touching="touching" in words)
    action = rng.uniform(*action_range(world))
    unsaturated = _uncut(world, action) if which % 2 == 0 and len(kinds) > 1 else None
    snapshot = world.snapshot()
    if "start" not in words:  # experiments start from a new base, which is faster
        snapshot = replace(snapshot, base=None)
    return Probe(kinds[which], snapshot, action, unsaturated)


def _go(world: Simulation, rng: Random, *, onward: bool, touching: bool) -> None:
    """Take random actions or draw a feasible state; if ``touching``, stop before a contact."""
    start, found = world.snapshot(), dict[tuple[str, str], Snapshot]()
    actions = rng.uniform(*action_range(world), (LONGEST, world.compiled.n_actions))
    kept = 1 + rng.integers(KEPT)
    steps = LONGEST if onward else LONGEST * FOLLOWED
    for step in range(steps if touching else 1 + rng.integers(LONGEST)):
        try:
            if not onward and step % FOLLOWED == 0:
                world.restore(start)
                world.do(anywhere(world, rng))
                if not touching:
                    return
            here = world.snapshot()
            world.step(actions[step // kept % LONGEST])
        except (InterventionError, EngineFailure):
            if onward:
                raise
            continue
        for pair in touching_pairs(world) if touching else ():
            found.setdefault(pair, here)
    if found:
        moving = [pair for pair in sorted(found) if WORLD not in pair]
        pairs = moving if moving and rng.random() < MOVING else sorted(found)
        world.restore(found[pairs[rng.integers(len(pairs))]])
    elif not onward:
        world.restore(start)
        world.do(anywhere(world, rng))


def touching_pairs(world: Simulation) -> set[tuple[str, str]]:
    """Return the pairs of bodies that press on each other now."""
    pressing = (contact for contact in world.backend.contacts() if contact.force > 0.0)
    return {(min(contact.bodies), max(contact.bodies)) for contact in pressing}


def anywhere(world: Simulation, rng: Random, *, at_end: bool = False) -> dict[str, Value]:
    """Draw a value of every state, with velocities of a few natural units.

    With ``at_end``, half of the numbers that have finite bounds are at one of them.
    """
    model, now, found = world.model, world.values(), dict[str, Value]()
    for v in model.variables:
        if v.is_measured and v.settable and v.dtype == "real" and model.target(v.name) == v.name:
            value = found[v.name] = another(v, now, rng)
            if at_end and isinstance(v.bounds, Box):
                ends = v.bounds.bounds(v.shape, now)
                end, there = np.where(rng.random(v.shape) < 0.5, *ends), rng.random(v.shape) < 0.5
                found[v.name] = np.where(there & np.isfinite(end), end, value)
    return found


def set_others(world: Simulation, rng: Random) -> None:
    """Set about half of the parameters to values of their spaces, or near the present ones."""
    # Those that determine which bodies exist stay: the declared graph has the present structure.
    deciding, now = frozenset(world.task.decided_by), world.values()
    drawn = {
        v.name: another(v, now, rng, share=JITTER)
        for v in world.model.variables
        if v.is_root and v.settable and v.dtype == "real"
        if not deciding or deciding.isdisjoint(world.compiled.static_order((v.name,)))
        if rng.random() < SHARE
    }
    without_refused(drawn, world.do)


def without_refused(
    request: dict[str, Value],
    attempt: Callable[[dict[str, Value]], T],
    places: Collection[str] = (),
) -> T | None:
    """Attempt a request without its refused targets; return None if it is infeasible."""
    # For overlapping bodies, the error names one target only, and finding others is slow. So all
    # ``places`` are left out if one is not sufficient.
    for turn in range(TRIES):
        try:
            return attempt(request)
        except EngineFailure:
            break
        except InterventionError as error:
            problems = error.problems if isinstance(error, SeveralProblems) else (error,)
            refused = {problem.variable for problem in problems} & request.keys()
            if turn or not refused:
                refused |= request.keys() & places
            for name in refused:
                del request[name]
    return None


def another(
    variable: Variable, values: Values, rng: Random, scale: float = 1.0, share: float = FAR
) -> Any:
    """Draw another value of a variable: from its space A, its space B, or within its bounds.

    A parameter without bounds changes by a ``share`` of its value; a state within its bounds or its
    reach. A real variable is moved by a fraction, ``scale``, towards the other value. The result is
    None if no other value exists.
    """
    present, bounds, shape = values[variable.name], variable.bounds, variable.shape
    spaces = [s for s in (variable.space("A"), variable.space("B"), bounds) if s is not None]
    finite = [s for s in spaces if np.isfinite(s.volume(shape, values))]
    if variable.is_measured and variable.dtype == "real" and not isinstance(bounds, Rotations):
        value = rng.uniform(*_reach(variable, present, rng))
    elif finite:
        space = finite[rng.integers(len(finite))]
        value = space.transform(rng.random((1, space.n_uniforms(shape))), shape, values)[0]
    elif variable.dtype == "real":
        value = present * (1.0 + share * rng.uniform(-1.0, 1.0, shape))
        value += JITTER * (present == 0.0) * rng.random(shape)
        value = value if bounds is None else bounds.nearest(value, values)
    else:
        return present + 1 if variable.dtype == "integer" else None
    if variable.dtype != "real" or scale == 1.0:
        return np.asarray(value)
    moved = np.asarray(present + scale * (value - present))
    return bounds.nearest(moved) if isinstance(bounds, Rotations) else moved


def _reach(variable: Variable, present: Value, rng: Random) -> tuple[Floats, Floats]:
    """Return the range of a state: its bounds, or its reach from the present value."""
    default = getattr(variable, "default", None)
    usual = 0.0 if default is None else float(np.abs(default).max())
    own = max(usual or 1.0, float(np.abs(present).max()))
    reach = REACH.get(variable.unit, own)
    low, high = np.full(variable.shape, -np.inf), np.full(variable.shape, np.inf)
    if isinstance(variable.bounds, Box):
        low, high = variable.bounds.bounds(variable.shape, {})
    near = np.maximum(low, np.minimum(present, high) - reach)
    far = np.minimum(high, np.maximum(present, low) + reach)
    if variable.unit == "m" and rng.random() < NEAR:  # for more contacts
        return near, far
    return np.where(np.isfinite(low), low, near), np.where(np.isfinite(high), high, far)


def _uncut(world: Simulation, action: Floats) -> frozenset[int]:
    """Change an action in place so that its components are not saturated; return those."""
    # A servo exerts its largest force for most commands, which have bit-identical effects. So for
    # each component, the range between two commands with different effects is bisected until a
    # tiny change of the command has an effect.
    here, found_at = world.snapshot(), set[int]()

    def reached(place: int, number: float) -> bytes | None:
        world.restore(here)
        changed = action.copy()
        changed[place] = number
        try:
            world.step(changed)
        except EngineFailure:
            return None
        return world.vector.tobytes()

    for place, ends in enumerate(np.transpose(action_range(world))):
        number, tiny = float(action[place]), TINY * (ends[1] - ends[0])
        first, last = (reached(place, end) for end in ends)
        for _ in range(HALVINGS if first != last else 0):
            found = reached(place, number)
            if found == first:
                ends[0] = number
            elif found == last or reached(place, number + tiny) == found:
                ends[1], last = number, found
            else:
                action[place] = number
                found_at.add(place)
                break
            number = ends.mean()
    world.restore(here)
    return frozenset(found_at)
