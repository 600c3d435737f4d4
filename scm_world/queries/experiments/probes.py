"""Probe states: where experiments are made.

A task may know where causes show; see ``Task.scenarios``. Of any other system, states are drawn:
where episodes begin, where random actions lead, anywhere that can be, and where bodies touch, with
parameters as they are and with others. In every second one, no number of the action is cut to a
limit. All choices are drawn from keyed noise: probe i of a seed is
the same, regardless of earlier probes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, TypeVar, final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.errors import EngineFailure, InterventionError, SeveralProblems
from scm_world.graph import SCM
from scm_world.policies.planning import action_range
from scm_world.variables import (
    Box,
    Categories,
    Exogenous,
    Integers,
    Measured,
    Noise,
    Rotations,
    Variable,
)
from scm_world.world import Simulation, WorldSnapshot

Pair = tuple[str, str]
T = TypeVar("T")

ATTEMPTS = 20  # how often a scenario is tried with other numbers where it is not feasible
LONGEST = 60  # control steps of random actions before a probe state
TRIED = 60  # states in which bodies may touch
WORLD = "world"  # the body that everything fixed belongs to
MOVING = 0.75  # of the pairs that touch are of two other bodies, where there are such
DRAWS = 96  # of a probe state, without those that have a name
HALVINGS = 30  # of a range of commands, until one of them is found that no limit cuts
TINY = 1e-9  # share of that range, which makes a difference there
KEPT = 10  # for how many control steps an action is kept at most
JITTER = 0.2  # how far, as a fraction, a parameter without a space is moved in a probe state
FAR = 0.75  # the same in an experiment
SHARE = 0.5  # of the parameters that have other values, in the probes where some have
NEAR = 0.5  # of the places are within reach
REACH = {"rad": np.pi, "m": 0.2, "rad/s": 4.0, "m/s": 2.0}
"""How far a state without bounds is moved from where it is, by its unit; others by 1."""


@final
class ProbeGenerator:
    """The random numbers of one probe state.

    They depend on seed, probe and attempt only, not on earlier draws.

    Args:
        noise: The seed's noise.
        probe: Number of the probe state.
        attempt: Counts up where a choice was not feasible.
    """

    def __init__(self, noise: Noise, probe: int, attempt: int = 0) -> None:
        self._noise, self._probe, self._attempt = noise, probe, attempt
        self._numbers = self.random("probe", DRAWS)
        self._used = 0

    def uniform(self, low: float, high: float, n: int | None = None) -> Any:
        """Draw one number, or an array of ``n``; at most 96 in all."""
        count = 1 if n is None else n
        drawn = self._numbers[self._used : self._used + count]
        self._used += count
        scaled = low + (high - low) * drawn
        return float(scaled[0]) if n is None else scaled

    def random(self, stream: str, n: int) -> Floats:
        """Draw numbers in [0, 1) of a named stream, shape (n,)."""
        drawn = self._noise.uniforms(stream, n=n, episode=self._probe, step=self._attempt)
        found: Floats = drawn[0]
        return found


@final
@dataclass(frozen=True)
class Scenario:
    """A kind of probe state.

    Attributes:
        name: Its name.
        prepare: Chooses the values to set in a world that has just been reset. It may step the
            world before. The second value it returns is passed to ``act``.
        act: Returns an action, shape (n_actions,).
        steps: Number of control steps before the experiments; drawn from 0 to 2 if None.
        fresh: Whether the values that were set count as the natural ones: experiments then do not
            add up with them to one intervention, and are faster.
    """

    name: str
    prepare: Callable[[Any, ProbeGenerator], tuple[dict[str, Value], Any]]
    act: Callable[[Any, Any, ProbeGenerator], Floats]
    steps: int | None = None
    fresh: bool = False


@final
@dataclass(frozen=True)
class Probe:
    """A state to experiment in.

    Attributes:
        kind: How it came about.
        snapshot: Of the world; None of equations.
        action: What is done next, shape (n_actions,).
    """

    kind: str
    snapshot: Any
    action: Floats


def probes(
    system: Simulation | SCM,
    n: int,
    seed: int,
    *,
    first: int = 0,
    scenarios: bool = True,
) -> Iterator[Probe]:
    """Prepare probe states one after another.

    Args:
        system: A world, which is reset for each probe, or equations: each is another unit.
        n: How many, those before the first one included.
        seed: Of the choices.
        first: Number of the first one.
        scenarios: Whether the task's own scenarios are used, where it has some.
    """
    if isinstance(system, SCM):
        yield from (Probe("unit", None, np.zeros(0)) for _ in range(first, n))
        return
    world, noise = system, Noise(seed)
    world.reset(seed=seed)
    asked = world.task.scenarios(world) if scenarios else ()
    known = tuple(Scenario(getattr(one[0], "__name__", "own"), *one) for one in asked)
    kinds = known or _kinds(world)
    for number in range(first, n):
        yield _prepared(world, kinds[number % len(kinds)], noise, number)


def _prepared(world: Simulation, scenario: Scenario, noise: Noise, number: int) -> Probe:
    """Prepare a state from which the world can continue; the beginning where nothing else is one.

    Raises:
        EngineFailure: It cannot continue from the beginning either.
    """
    for attempt in range(ATTEMPTS):
        world.reset(seed=number)
        try:
            return _made(world, scenario, ProbeGenerator(noise, number, attempt))
        except (InterventionError, EngineFailure):
            continue
    world.reset(seed=number)
    return _made(world, AT_REST, ProbeGenerator(noise, number))


def _made(world: Simulation, scenario: Scenario, rng: ProbeGenerator) -> Probe:
    states, extra = scenario.prepare(world, rng)
    if states:
        world.do(states)
    action = scenario.act(world, extra, rng)
    drawn = round(rng.uniform(0.0, 2.0))
    steps = drawn if scenario.steps is None else scenario.steps
    for _ in range(steps):
        world.step(action)
    action = scenario.act(world, extra, rng)
    snapshot = world.snapshot()
    if scenario.fresh:
        snapshot = replace(snapshot, base=None)
    world.step(action)
    if not np.isfinite(world.vector).all():
        raise EngineFailure("the state is lost", world.backend.name)
    return Probe(scenario.name, snapshot, action)


# --- of any system ------------------------------------------------------------------------------


def start(world: Simulation, rng: ProbeGenerator) -> tuple[dict[str, Value], None]:
    """Stay where the episode begins."""
    return {}, None


def onward(world: Simulation, rng: ProbeGenerator) -> tuple[dict[str, Value], None]:
    """Go where random actions lead, each kept for a while."""
    steps = 1 + int(rng.uniform(0.0, LONGEST))
    for action in _way(world, rng, steps):
        world.step(action)
    return {}, None


def onward_touching(world: Simulation, rng: ProbeGenerator) -> tuple[dict[str, Value], None]:
    """Go where random actions lead, to where two bodies are about to touch that do on the way."""
    before: dict[Pair, WorldSnapshot] = {}
    for action in _way(world, rng, LONGEST):
        here = world.snapshot()
        world.step(action)
        for pair in touching_pairs(world):
            before.setdefault(pair, here)
    if before:
        world.restore(_one_of(before, rng))
    return {}, None


def anywhere(world: Simulation, rng: ProbeGenerator) -> tuple[dict[str, Value], None]:
    """Move everything to where it can be, with velocities of a few natural units."""
    return _anywhere(world, rng, "moved"), None


def touching(world: Simulation, rng: ProbeGenerator) -> tuple[dict[str, Value], None]:
    """Move everything to where two bodies touch, if some of the states that are tried have such."""
    here, action = world.snapshot(), _at_random(world, None, rng)
    found: dict[Pair, dict[str, Value]] = {}
    for number in range(TRIED):
        states = _anywhere(world, rng, f"moved {number}")
        try:
            world.do(states)
            world.step(action)
        except (InterventionError, EngineFailure):
            continue
        else:
            for pair in touching_pairs(world):
                found.setdefault(pair, states)
        finally:
            world.restore(here)
    return (_one_of(found, rng) if found else _anywhere(world, rng, "moved")), None


def _way(world: Simulation, rng: ProbeGenerator, steps: int) -> Iterator[Floats]:
    """Draw actions, each kept for a while."""
    kept = 1 + int(rng.uniform(0.0, KEPT))
    shares = rng.random("probe way", steps * world.compiled.n_actions).reshape(steps, -1)
    for step in range(steps):
        yield _within(world, shares[step // kept])


def touching_pairs(world: Simulation) -> set[Pair]:
    """Name the pairs of bodies that press on each other now."""
    pressing = (contact for contact in world.backend.contacts() if contact.force > 0.0)
    return {(min(contact.bodies), max(contact.bodies)) for contact in pressing}


def _one_of(found: dict[Pair, T], rng: ProbeGenerator) -> T:
    """Draw one of the pairs that were found, mostly one of two bodies that can move."""
    moving = [pair for pair in sorted(found) if WORLD not in pair]
    which = rng.uniform(0.0, 1.0)
    pairs = moving if moving and which < MOVING else sorted(found)
    return found[pairs[int(rng.uniform(0.0, len(pairs)))]]


def _anywhere(world: Simulation, rng: ProbeGenerator, stream: str) -> dict[str, Value]:
    """Draw a value of every state."""
    model = world.model
    variables = (v for v in model.variables if isinstance(v, Measured) and v.settable)
    return {
        v.name: _moved(
            v, world[v.name], rng.random(f"{v.name}|{stream}", 1 + int(np.prod(v.shape)))
        )
        for v in variables
        if v.dtype == "real" and model.target(v.name) == v.name
    }


def _with_others(prepare: Any) -> Any:
    """Prepare a state under other parameters."""

    def prepared(world: Simulation, rng: ProbeGenerator) -> tuple[dict[str, Value], None]:
        set_others(world, rng)
        found: tuple[dict[str, Value], None] = prepare(world, rng)
        return found

    return prepared


def set_others(world: Simulation, rng: ProbeGenerator) -> None:
    """Set about half of the parameters to values of their spaces, or near those that they have.

    What cannot be set together with the rest stays as it is. So does what decides which bodies
    there are: the graph that is declared is that of the present structure.
    """
    deciding = frozenset(world.task.decided_by)
    drawn = (
        (v.name, _jittered(v, world, rng))
        for v in world.model.variables
        if isinstance(v, Exogenous) and v.settable and v.dtype == "real"
        if not deciding or deciding.isdisjoint(world.compiled.static_order((v.name,)))
    )
    request = {name: value for name, value in drawn if value is not None}
    while request:
        try:
            world.do(request)
        except InterventionError as error:
            problems = error.problems if isinstance(error, SeveralProblems) else (error,)
            refused = {problem.variable for problem in problems} & request.keys()
            if not refused:
                return
            for name in refused:
                del request[name]
        else:
            return


def _jittered(variable: Exogenous, world: Simulation, rng: ProbeGenerator) -> Value | None:
    """Give another value of a parameter, or None where it keeps the one that it has."""
    if rng.random(f"{variable.name}|other or not", 1)[0] >= SHARE:
        return None
    now = world.row
    return drawn(variable, world[variable.name], now, rng, "other", JITTER)


def drawn(
    variable: Variable,
    present: Value,
    now: Values,
    rng: ProbeGenerator,
    stream: str,
    share: float = FAR,
) -> Value | None:
    """Draw another value of a variable: from its space A, its space B, or within its bounds.

    A parameter without ends is moved by a share of itself; a state as far as it can be, or as is
    within reach. None if there is no other value.

    Args:
        variable: It can be set.
        present: The value that it has.
        now: Values of what its spaces and bounds follow from.
        rng: Random numbers.
        stream: Which of them.
        share: How far, as a fraction, what has no ends is moved.
    """
    n = int(np.prod(variable.shape))
    unit = rng.random(f"{variable.name}|{stream}", n + 2)
    numbers = unit[2:].reshape(variable.shape)
    bounds = variable.bounds
    match bounds:
        case Integers():
            width = bounds.high - bounds.low + 1
            return np.asarray(bounds.low + np.floor(numbers * width).astype(np.int64))
        case Categories(members=members):
            others = [member for member in members if not np.any(present == member)]
            return variable.array(others[int(unit[0] * len(others))]) if others else None
    if variable.dtype != "real":
        return present + 1 if variable.dtype == "integer" else None
    if isinstance(variable, Measured):
        return _moved(variable, present, unit[1:])
    named = (variable.space("A"), variable.space("B"), bounds)
    ends = [space.bounds(variable.shape, now) for space in named if isinstance(space, Box)]
    ends = [pair for pair in ends if np.isfinite(pair).all()]
    if ends:
        low, high = ends[int(unit[0] * len(ends))]
        return np.asarray(low + numbers * (high - low))
    if isinstance(bounds, Rotations):
        return bounds.nearest(present + 2.0 * (2.0 * numbers - 1.0))
    moved = present * (1.0 + share * (2.0 * numbers - 1.0)) + JITTER * (present == 0.0) * numbers
    return np.asarray(moved if bounds is None else bounds.nearest(moved, now))


def _moved(variable: Variable, present: Value, drawn: Floats) -> Value:
    """Give a value of a state: within its bounds, or within reach of where it is.

    Of places whose bounds are further away than what is within reach, every other one is within
    reach: else bodies would hardly meet.
    """
    unit = 2.0 * drawn[1:].reshape(variable.shape) - 1.0
    if isinstance(variable.bounds, Rotations):
        return variable.bounds.nearest(present + 2.0 * unit)
    reach = REACH.get(variable.unit, 1.0)
    low, high = np.full(variable.shape, -np.inf), np.full(variable.shape, np.inf)
    if isinstance(variable.bounds, Box):
        low, high = variable.bounds.bounds(variable.shape, {})
    near = np.maximum(low, np.minimum(present, high) - reach)
    far = np.minimum(high, np.maximum(present, low) + reach)
    if variable.unit == "m" and drawn[0] < NEAR:
        low, high = near, far
    low, high = np.where(np.isfinite(low), low, near), np.where(np.isfinite(high), high, far)
    return np.asarray(low + 0.5 * (1.0 + unit) * (high - low))


def _within(world: Simulation, share: Floats) -> Floats:
    """Give the action at some shares of its range."""
    low, high = action_range(world)
    return np.asarray(low + share * (high - low))


def _at_random(world: Simulation, extra: None, rng: ProbeGenerator) -> Floats:
    """Draw an action."""
    return _within(world, rng.random("probe action", world.compiled.n_actions))


def _uncut(world: Simulation, extra: None, rng: ProbeGenerator) -> Floats:
    """Draw an action each number of which acts: it is not cut to a limit of its actuator.

    A servo exerts its largest force for most commands: they have one and the same effect, bit for
    bit. So for each number, the range is halved between two commands with different effects, until
    there is one at which a tiny change of it makes a difference.
    """
    action, (low, high) = _at_random(world, extra, rng), action_range(world)
    here = world.snapshot()

    def reached(place: int, number: float) -> bytes | None:
        world.restore(here)
        changed = action.copy()
        changed[place] = number
        try:
            world.step(changed)
        except EngineFailure:
            return None
        return world.vector.tobytes()

    for place in range(len(action)):
        ends, number = [low[place], high[place]], float(action[place])
        tiny = TINY * (ends[1] - ends[0])
        first, last = (reached(place, end) for end in ends)
        for _ in range(HALVINGS if first != last else 0):
            found = reached(place, number)
            if found == first:
                ends[0] = number
            elif found == last or reached(place, number + tiny) == found:
                ends[1], last = number, found
            else:
                action[place] = number
                break
            number = 0.5 * (ends[0] + ends[1])
    world.restore(here)
    return action


def _at_rest(world: Simulation, extra: None, rng: ProbeGenerator) -> Floats:
    """Return the idle action."""
    return world.task.idle(world)


AT_START = Scenario("start", start, _at_random, steps=0)
AT_REST = Scenario("start", start, _at_rest, steps=0)
"""What is left where nothing else is feasible."""

_ANYWHERE = Scenario("anywhere", anywhere, _at_random, fresh=True)
_OTHERWISE = Scenario("anywhere, others", _with_others(anywhere), _at_random, fresh=True)
_ONWARD = Scenario("onward", onward, _at_random, steps=0)
_ON_OTHERWISE = Scenario("onward, others", _with_others(onward), _at_random, steps=0)
_ON_TOUCHING = Scenario("onward, touching", onward_touching, _at_random, steps=0)
_TOUCHING = Scenario("touching", touching, _at_random, steps=0, fresh=True)
_TOUCH_OTHERWISE = Scenario(
    "touching, others", _with_others(touching), _at_random, steps=0, fresh=True
)
"""Where parameters have other values, too, it says ``others``."""


def _kinds(world: Simulation) -> tuple[Scenario, ...]:
    """List what is tried in a system of which the task says nothing."""
    kinds: tuple[Scenario, ...]
    if any(edge.when == "contact" for edge in world.model.edges):
        kinds = (AT_START, _TOUCHING, _ON_TOUCHING, _ANYWHERE)
        kinds += (_TOUCH_OTHERWISE, _ON_OTHERWISE, _TOUCHING, _ON_TOUCHING)
    else:
        kinds = AT_START, _ONWARD, _ANYWHERE, _ON_OTHERWISE, _ONWARD, _OTHERWISE
    return tuple(
        replace(kind, act=_at_random if number % 2 else _uncut) for number, kind in enumerate(kinds)
    )
