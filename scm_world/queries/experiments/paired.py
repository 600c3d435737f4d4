"""Paired experiments in a world: same noise, same state, same action, one variable changed.

From a probe state, one variable X is set to another value and everything else stays. What
differs afterwards, bit by bit, is an effect of X. A difference is a *direct* effect if it
remains while every other variable that X moved is held at its old value.

Within the instant, variables that can be set are held by the intervention itself, and computed
ones by handing their old value to their children. Over one control step the backend is one joint
mechanism, so a difference in a state is a direct effect of the differences before; a
computed variable has a lagged cause if it still differs while all present values are held.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping
from typing import Any, final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.backends.base import InMemory
from scm_world.errors import EngineFailure, InterventionError, SnapshotMismatch
from scm_world.queries.experiments.effects import (
    RESOLUTION,
    EdgeKey,
    Effects,
    ProbeSetting,
    Response,
    gap,
)
from scm_world.queries.experiments.probes import Probe, touching_pairs
from scm_world.variables import (
    Box,
    Categories,
    Derived,
    Exogenous,
    Integers,
    Measured,
    Noise,
    Rotations,
    Variable,
)
from scm_world.variables.kinds import SpaceName
from scm_world.variables.reserved import CONTROL_INDEX
from scm_world.world import Simulation

STEPS = (0.05, -0.05, 0.02, -0.02, 0.005, -0.005, 0.001, -0.001)
"""How far to move a variable, as a fraction of its bounds; smaller until it is feasible."""

FAR = (0.4, -0.4, 0.2, -0.2)
"""How far to move it first, in some of the probes: what has a threshold shows there."""

TRIED_ALONE = 8
"""In how many probes the mechanisms of what does not move are tried on their own."""

FEW = 24  # mechanisms with more causes than this are left to experiments in the world
NUDGE = 0.2  # how far, as a fraction, to move a cause that has no spaces to be drawn from

SEEN_ELSEWHERE = 8
"""How many earlier values of a readout are kept, to hand them to its children."""


@final
class _Kept:
    """The values of an instant, and what differs from them.

    Args:
        world: As it is at that instant.

    Attributes:
        values: Copies.
    """

    def __init__(self, world: Simulation) -> None:
        self.values = world.values()
        now, state = world.current()
        self._vector = state.vector.copy()
        self._slices = tuple(world.compiled.slices.items())
        self._compared = (CONTROL_INDEX, *world.computed)  # the clock counts in place
        moving = {*world.compiled.slices, *self._compared}
        self._rest = {name: now[name] for name in world.model if name not in moving}

    def differing(self, world: Simulation) -> list[str]:
        """Name what differs in a world of the same structure, in the order of the model."""
        now = world.evaluate(world.computed)
        apart = world.current()[1].vector != self._vector
        found = set()
        if apart.any():
            found = {name for name, where in self._slices if apart[where].any()}
        found |= {n for n, value in self._rest.items() if now[n] is not value and self._is(n, now)}
        found |= {name for name in self._compared if self._is(name, now)}
        return [name for name in world.model if name in found] if found else []

    def _is(self, name: str, now: Values) -> bool:
        """Tell whether a value differs."""
        return gap(now[name], self.values[name]) > 0.0


@final
class Paired:
    """Experiments with one world.

    Args:
        world: It is restored to the probe before every experiment.
        seed: Of the values that targets are set to.
        causes: Names of the variables to experiment with; all if None.
        responses: Whether to keep every effect of every probe state.

    Attributes:
        effects: What was seen.
        targets: The variables that ``do`` sets.
        actions: The action variables.
    """

    def __init__(
        self,
        world: Simulation,
        seed: int,
        *,
        causes: Container[str] | None = None,
        responses: bool = False,
    ) -> None:
        self._world = world
        self._noise = Noise(seed)
        kept: dict[tuple[EdgeKey, int], Response] = {}
        self.effects = Effects(
            responses=kept if responses else None,
            exact=world.task.generated_graph,
        )
        model = world.model
        self.targets = tuple(
            v.name
            for v in model.variables
            if v.settable and v.role != "action" and model.target(v.name) == v.name
            if causes is None or v.name in causes
        )
        self.actions = tuple(
            name for name in world.compiled.actions if causes is None or name in causes
        )
        self._declaration = world.compiled
        self._computed = world.computed
        self._states = frozenset(
            v.name for v in model.variables if isinstance(v, Measured) and v.mechanism is None
        )
        reported = tuple(
            v.name
            for v in model.variables
            if isinstance(v, Measured) and v.mechanism is None and not v.settable
        )
        self._readouts = (*reported, *self._computed)
        self._readers = tuple(
            {
                name: frozenset(p.name for p in model.declared(name).all_parents if p.lag == lag)
                for name in self._computed
            }
            for lag in (0, 1)
        )
        self._pool: dict[str, list[Value]] = {name: [] for name in self._readouts}
        in_memory = isinstance(world.backend, InMemory)  # nothing ever touches there
        self._by_contact = frozenset(
            edge.key for edge in model.edges if edge.when == "contact" and not in_memory
        )

    def run(self, number: int, probe: Probe) -> None:
        """Do all experiments of one probe state."""
        self._number, self._probe = number, probe
        self._world.restore(probe.snapshot)
        self._before = _Kept(self._world)
        at_first = self._engine_values()
        self._at_once, self._earlier = self._before.values, self._world.previous()
        self._memory = self._advanced(probe.action)
        self.effects.touched |= touching_pairs(self._world)
        self._after = _Kept(self._world)
        self._later = self._after.values
        self._reported = self._engine_values()
        for name, value in self._reported.items():  # nothing but time has passed
            self._see_floor(name, gap(value, at_first[name]))
        self._apart = False
        if self._by_contact:
            self._world.restore(probe.snapshot)
            self._apart = self._touches_nothing(probe.action)
        for target in self.targets:
            self._experiment(target)
        for action in self.actions:
            self._vary_action(action)
        self._doing(None)
        if number < TRIED_ALONE:
            see_mechanisms(self._world, self._at_once, self.effects, self._noise, number)
        for name in self._readouts:
            self._vary_readout(name)
            self._pool[name] = [*self._pool[name], self._at_once[name], self._later[name]]
            self._pool[name] = self._pool[name][-SEEN_ELSEWHERE:]
        self.effects.end_of_probe()

    def arrives(self, probe: Probe) -> bool:
        """Tell whether the world can go to a probe state; if not, note which parameters differ.

        What was prepared with an engine that changes parameters by itself is no state of the world.
        """
        try:
            self._world.restore(probe.snapshot)
        except SnapshotMismatch:
            now, found = self._world.current()[0], self._engine_values()
            sizes = {name: gap(value, now[name]) for name, value in found.items()}
            if not any(sizes.values()):
                raise
            for name in sorted(name for name, size in sizes.items() if size > 0.0):
                self._see_floor(name, sizes[name])
            return False
        return True

    def memory(self) -> dict[str, list[Any]]:
        """Give what later probes need of earlier ones: values of readouts, as plain data."""
        return {name: [np.asarray(v).tolist() for v in seen] for name, seen in self._pool.items()}

    def remember(self, effects: Effects, memory: Mapping[str, Iterable[Any]]) -> None:
        """Continue from the results of earlier probes."""
        self.effects = effects
        model = self._world.model
        self._pool = {
            name: [model.declared(name).array(value) for value in seen]
            for name, seen in memory.items()
        }

    # --- the pieces of an experiment ----------------------------------------------------------

    def _doing(self, change: Floats | None) -> None:
        """Record the present probe, for the report of the differences that are found."""
        self.effects.setting = ProbeSetting(self._number, self._probe.kind, change)

    def _advanced(self, action: Floats) -> dict[str, Value]:
        """Step once; give the values that are kept of the instant before."""
        self._world.step(action)
        self.effects.rollouts += 1
        return self._world.previous()

    def _experiment(self, target: str) -> None:
        steps = (*FAR, *STEPS) if self._number % 4 == 3 else STEPS
        for attempt, step in enumerate(steps):
            value = self._other(target, step, attempt)
            if value is None:
                return
            self._doing(np.ravel(value) - np.ravel(self._at_once[target]))
            try:
                self._see_target(target, value)
                self._undo(target, value)
            except (InterventionError, EngineFailure):
                continue
            return
        self.effects.refused[target] = self.effects.refused.get(target, 0) + 1

    def _see_target(self, target: str, value: Value) -> None:
        """Find the effects of one value.

        What decides the structure is an effect like any other, and is held like any other. What
        causes it is seen where its mechanism is tried on its own.
        """
        deciding: tuple[str, ...] = ()
        self._hold(target, value, ())
        if self._world.compiled is not self._declaration:
            deciding = self._world.task.decided_by
            if target in deciding:
                self._in_another_structure(target, value)
                return
            self._hold(target, value, deciding)
        self._within_the_instant(target, value, deciding)

    def _other(self, target: str, step: float, attempt: int) -> Value | None:
        """Choose another value; of what decides the structure, one that changes it a little."""
        if target in self._world.task.decided_by:
            nearby = [r[target] for r in self._world.task.nearby(self._at_once) if target in r]
            if nearby:
                return nearby[attempt % len(nearby)]
        variable = self._world.model.declared(target)
        present = self._at_once[variable.name]
        n = int(np.prod(variable.shape))
        uniforms = self._noise.uniforms(variable.name, n=n, episode=self._number, step=attempt)[0]
        direction = (0.5 + 0.5 * uniforms).reshape(variable.shape)
        match variable.bounds:
            case Box() | None if variable.dtype == "real":
                high = np.full(variable.shape, np.inf)
                ends = (-high, high)
                if variable.bounds is not None:
                    ends = variable.bounds.bounds(variable.shape, self._at_once)
                return _elsewhere(present, step * direction, *ends)
            case Rotations():
                return variable.bounds.nearest(present + 4 * step * direction)
            case Integers():
                full = present >= variable.bounds.high
                return np.asarray(present + np.where(full, -1, 1))
            case Categories(members=members):
                others = [member for member in members if member != present]
                return np.asarray(others[attempt % len(others)]) if others else None
            case _:
                return None

    def _within_the_instant(self, target: str, value: Value, deciding: tuple[str, ...]) -> None:
        """Find the effects at lags 0 and 1, in the structure that there is."""
        moved = [name for name in self._before.differing(self._world) if name != target]
        held = [name for name in moved if name not in self._computed]
        if held:
            self._see_settable(target, value, held, deciding)
            self._hold(target, value, (*deciding, *held))
        computed = [name for name in moved if name in self._computed]
        if computed:
            self._see_computed(target, computed, self._world.values())
        self._see_later(target)

    def _in_another_structure(self, target: str, value: Value) -> None:
        """Find the effects of a change of structure, on what there is before and after it."""
        moved: list[str] = []
        while further := self._differing(target, moved):
            moved += further
            self._see_settable(target, value, moved)
            self._hold(target, value, moved)
        self._advanced(self._probe.action)
        after = self._world.values()
        for name in self._states.intersection(after):
            self.effects.see(target, name, 1, after[name], self._later[name])

    def _differing(self, target: str, held: list[str]) -> list[str]:
        """Name what is not as it was, although it could be."""
        now = self._world.values()
        return [
            name
            for name in now
            if name != target
            and name not in held
            and self._alike(name)
            and gap(now[name], self._at_once[name]) > 0.0
        ]

    def _alike(self, name: str) -> bool:
        """Tell whether something can be held that is there before and after a new structure."""
        if name not in self._at_once or name in self._computed:
            return False
        before = self._declaration.model.declared(name)
        after = self._world.model.declared(name)
        return after.settable and before.shape == after.shape and type(before) is type(after)

    def _hold(self, target: str, value: Value, names: Iterable[str]) -> None:
        """Set the target, with some other variables kept at their old values."""
        self._world.restore(self._probe.snapshot)
        self._world.do({target: value, **{name: self._at_once[name] for name in names}})

    def _see_settable(
        self, target: str, value: Value, moved: list[str], deciding: tuple[str, ...] = ()
    ) -> None:
        """Let one variable follow at a time, with all others at their old values."""
        for name in moved:
            others = [other for other in moved if other != name]
            self._hold(target, value, (*deciding, *others))
            self.effects.see(target, name, 0, self._world[name], self._at_once[name])

    def _see_computed(self, cause: str, moved: list[str], alone: Values) -> None:
        """Evaluate each computed variable with all other computed ones at their old values."""
        known = {**alone, **{name: self._at_once[name] for name in self._computed}}
        if cause in self._computed:
            known[cause] = alone[cause]
        for name in moved:
            value = self._evaluate(name, known, self._earlier)
            self.effects.see(cause, name, 0, value, self._at_once[name])

    def _evaluate(self, name: str, known: Values, previous: Values) -> Value:
        return self._world.model.solve(known, previous=previous, only=(name,))[name]

    def _see_later(self, cause: str, action: Floats | None = None) -> None:
        """Step with everything as it was but the cause, and compare with the base run."""
        action = self._probe.action if action is None else action
        here = self._world.snapshot() if self._apart else None
        memory = self._advanced(action)
        moved = frozenset(self._after.differing(self._world))
        now = self._world.current()[0]
        for name in self._states:
            if name in moved:
                self.effects.see(cause, name, 1, now[name], self._later[name])
            else:
                self.effects.see_nothing(cause, name, 1)
        self._see_memory(cause, memory)
        self._see_engine(cause)
        far = {(cause, name, 1) for name in moved} & self._by_contact if here else set()
        sizes = {key: gap(now[key[1]], self._later[key[1]]) for key in far}
        if here and any(size > RESOLUTION for size in sizes.values()):
            there = self._world.snapshot()
            self._world.restore(here)
            if self._touches_nothing(action):
                self.effects.see_apart(sizes)
            self._world.restore(there)

    def _touches_nothing(self, action: Floats) -> bool:
        """Take the physics steps of a control step one by one; return whether bodies stay apart."""
        world = self._world
        if getattr(world.structure, "staged", False):
            return False  # they may have touched in a stage whose contacts are not known
        sent = world.command(world.decided(world.compiled.clipped(action)), world.index)
        for _ in range(world.substeps):
            world.backend.step(sent, 1)
            if world.backend.contacts():
                return False
        return True

    def _engine_values(self) -> dict[str, Value]:
        """Read the parameters that the engine has now, by variable."""
        names = {key: name for name, key in self._world.compiled.parameter_keys.items()}
        found = self._world.backend.parameters(names)
        return {names[key]: np.array(value) for key, value in found.items()}

    def _see_engine(self, cause: str) -> None:
        """Find parameters of the engine that differ where the world says that they do not."""
        if self._world.compiled is not self._declaration:
            return
        now = self._world.current()[0]
        for name, value in self._engine_values().items():
            is_other = name != cause and gap(now[name], self._later[name]) == 0.0
            if is_other and value.tobytes() != self._reported[name].tobytes():
                self.effects.see(cause, name, 0, value, self._reported[name])

    def _see_memory(self, cause: str, memory: Values) -> None:
        """Find computed variables that depend on the cause one step ago.

        A mechanism is handed its declared causes only, so the others need not be evaluated.
        """
        own = {**self._memory, **({cause: memory[cause]} if cause in memory else {})}
        for name in self._computed:
            if cause in self._readers[1][name]:
                value = self._evaluate(name, self._later, own)
                self.effects.see(cause, name, 1, value, self._later[name])

    def _undo(self, target: str, value: Value) -> None:
        """Intervene and undo: a difference that remains is numerical noise, not an effect."""
        self._world.restore(self._probe.snapshot)
        self._world.do({target: value})
        self._world.do({target: self._at_once[target]})
        self.effects.changed[target] += 1
        self._advanced(self._probe.action)
        moved, now = self._after.differing(self._world), self._world.current()[0]
        self.effects.floors.setdefault(target, 0.0)
        for name in moved:
            self._see_floor(name, gap(now[name], self._later[name]), target)

    def _see_floor(self, name: str, size: float, after: str = "") -> None:
        """Note what differs though nothing was changed, or what was has been put back."""
        effects = self.effects
        effects.floor = max(effects.floor, size)
        for target in (after,) if after else self.targets:
            effects.floors[target] = max(effects.floors.get(target, 0.0), size)
        effects.see_unstable(name, size, after)

    def _vary_action(self, name: str) -> None:
        """Find the effects of another value of one action, within its range."""
        self._world.restore(self._probe.snapshot)
        where = self._world.compiled.actions[name]
        low, high = self._world.action_low[where], self._world.action_high[where]
        unit = self._noise.uniforms(name, n=len(low), episode=self._number)[0]
        action = np.array(self._probe.action)
        present = np.clip(action[where], low, high)
        action[where] = _elsewhere(present, 0.1 * (unit - 0.5), low, high)
        self._doing(action[where] - present)
        try:
            self._see_later(name, action)
        except EngineFailure:
            return
        self.effects.changed[name] += bool((action[where] != present).any())
        taken = np.array(self._world.current()[0][name])
        self._see_memory(name, {name: taken})
        for reader, causes in self._readers[0].items():
            if name in causes:
                value = self._evaluate(reader, {**self._later, name: taken}, self._memory)
                self.effects.see(name, reader, 0, value, self._later[reader])

    def _vary_readout(self, cause: str) -> None:
        """Give a readout another value, seen elsewhere, and watch what is computed from it.

        No experiment in the world can do this; it is done in the model of the readouts.
        """
        present = self._at_once[cause]
        self.effects.changed[cause] += any(gap(v, present) > 0.0 for v in self._pool[cause])
        others = [name for name, causes in self._readers[0].items() if cause in causes]
        for value in self._pool[cause]:
            known = {**self._at_once, cause: value}
            self._see_computed(cause, others, known)
            self._see_memory(cause, {**self._memory, cause: value})


def _elsewhere(present: Value, share: Floats, low: Floats, high: Floats) -> Value:
    """Move numbers by a share of their range; of one without ends, of their size.

    Where that is outside, they are moved the other way.
    """
    size = np.where(present == 0.0, 1.0, np.abs(present))
    with np.errstate(invalid="ignore"):  # a range from nowhere to nowhere
        spread = np.where(np.isfinite(high - low), high - low, size)
    moved = present + share * spread
    inside = np.where((moved < low) | (moved > high), 2 * present - moved, moved)
    return np.asarray(np.clip(inside, low, high))


def see_mechanisms(
    world: Simulation, present: Values, effects: Effects, noise: Noise, number: int
) -> None:
    """Try every mechanism of what does not move: sizes, layouts, goals, piles.

    An experiment in the world changes one thing about the present structure. Some causes show only
    in other circumstances (the noise of a wall only where walls are random). So each mechanism is
    also tried on its own: all its causes have values of one circumstance, and one of them gets the
    value that it has in another. A mechanism can be handed nothing but its declared causes, so
    what is not declared is looked for in the world alone.

    Args:
        world: Its model has the mechanisms.
        present: Values of the probe: the first circumstance.
        effects: What is seen is noted there.
        noise: Draws two more, one from the spaces A and one from B.
        number: Of the probe.
    """
    model, static = world.model, world.static_names
    now = {name: present[name] for name in static}
    circumstances = []
    for episode in (2 * number, 2 * number + 1):
        space: SpaceName = "B" if episode % 2 else "A"
        roots = {
            variable.name: _drawn(variable, space, now, noise, episode)
            for variable in model.variables
            if isinstance(variable, Exogenous) and variable.name in now
        }
        circumstances.append(model.solve(roots, only=static))
    one, other = circumstances if number % 2 == 0 else reversed(circumstances)
    for child in model.variables:
        if not isinstance(child, Derived) or child.name not in now:
            continue
        names = {parent.name for parent in child.parents}
        if not names <= now.keys() or len(names) > FEW:
            continue
        for base, changed in ((one, other), (now, one)):
            before = model.solve(base, only=(child.name,))[child.name]
            for cause in child.parents:
                known = {**base, cause.name: changed[cause.name]}
                after = model.solve(known, only=(child.name,))[child.name]
                effects.see(cause.name, child.name, 0, after, before)


def _drawn(variable: Variable, name: SpaceName, now: Values, noise: Noise, episode: int) -> Value:
    space = variable.space(name)
    if space is not None:
        drawn = noise.draw(space, variable.name, variable.shape, now, episode=episode)
        return np.asarray(drawn[0])
    if variable.dtype != "real" or variable.bounds is None:
        return now[variable.name]
    unit = noise.uniforms(f"{variable.name}|nudge", n=1, episode=episode)[0, 0]
    return variable.bounds.nearest(now[variable.name] * (1.0 + NUDGE * unit), now)
