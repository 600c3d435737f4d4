"""Paired experiments: same noise, same state, same action, one variable changed.

What differs afterwards, bit by bit, is an effect. It is a *direct* effect if it remains while every
other variable that moved is held at its old value. There are two kinds of experiment:

- Of a variable with a mechanism, the mechanism is evaluated with one of its parents as it is at
  another instant. A mechanism is given nothing but its parents.
- Of a state that a backend decides, one variable is set, all that follows is held, and a control
  step is taken.

Equations have the first kind only, so that everything here serves them, too.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any, NamedTuple, final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.errors import EngineFailure, InterventionError, SnapshotMismatch
from scm_world.graph import SCM, NoiseKey
from scm_world.graph.evaluate import earlier
from scm_world.policies.planning import action_range
from scm_world.queries.equations import CompiledModel, Equations
from scm_world.queries.experiments.effects import RESOLUTION, EdgeKey, Effects, ProbeSetting, gap
from scm_world.queries.experiments.probes import Probe, ProbeGenerator, drawn, touching_pairs
from scm_world.variables import Action, Exogenous, Measured, Noise, Rotations
from scm_world.world import Simulation

SCALES = (0.1, 0.03, 0.01, 0.003, 0.001)
"""How far towards another value a variable is moved, as a fraction; less until it is feasible."""

FAR = (1.0, 0.3)
"""How far it is moved first, in every fourth probe state: what has a threshold shows there."""

REMEMBERED = 6
"""How many probe states lend their values to the causes of mechanisms, the present one included."""


class Instant(NamedTuple):
    """What mechanisms are evaluated with.

    Attributes:
        values: Of the variables.
        previous: Of one control step ago; None where there is no time.
        key: Of the noise; None where there is none.
    """

    values: Values
    previous: Values | None
    key: NoiseKey | None = None


@final
class Paired:
    """Experiments in which one variable is changed.

    Args:
        system: A world, which is restored to the probe state before every experiment, or equations.
        seed: Of the values that are given to variables.

    Attributes:
        targets: The variables that are set; of equations all.
        states: The variables that the backend decides.
        exact: Whether any difference counts; see ``Effects``.
    """

    def __init__(self, system: Simulation | SCM, seed: int) -> None:
        self._system: Any = system
        self._world = system if isinstance(system, Simulation) else None
        self._model = model = system if isinstance(system, SCM) else system.model
        self._noise = Noise(seed)
        self._kept: list[Instant] = []
        self.states: tuple[str, ...] = ()
        self.targets = tuple(model)
        self.exact = False
        if self._world is None:
            compiled = CompiledModel(model)
            self._idle = compiled.split(Equations(compiled).idle())
        else:
            self.states = engine_decided(model)
            self.targets = settable(model)
            self.exact = self._world.task.generated_graph
        self._causes: dict[str, list[tuple[str, int]]] = {}
        for edge in model.edges:
            if edge.effect not in self.states:
                self._causes.setdefault(edge.effect, []).append((edge.cause, edge.lag))

    def run(self, number: int, probe: Any, wanted: Collection[EdgeKey] | None = None) -> Effects:
        """Do all experiments of one probe state.

        Args:
            number: Of the probe state.
            probe: The probe state; of equations anything.
            wanted: The declared edges that are looked for; all edges if None.
        """
        effects = Effects(exact=self.exact)
        try:
            instants = self.look(number, probe)
        except SnapshotMismatch:
            if not self._is_worn(effects):
                raise
            return effects
        effects.rollouts += 1
        self._see_mechanisms(ProbeSetting(number, probe.kind), instants, wanted, effects)
        if self._world is not None:
            effects.touched |= {body for pair in touching_pairs(self._world) for body in pair}
            self._see_states(number, probe, instants, wanted, effects)
        return effects

    def _is_worn(self, effects: Effects) -> bool:
        """Note the parameters that the backend has changed by itself; no state comes back then."""
        world: Any = self._world
        now, names = world.row, {k: n for n, k in world.compiled.parameter_keys.items()}
        for key, value in world.backend.parameters(names).items():
            effects.see_unstable(names[key], gap(value, now[names[key]]))
        return bool(effects.unstable)

    def look(self, number: int, probe: Any) -> list[Instant]:
        """Return two instants of a probe state, the later one first, and three that are drawn.

        In the last one, each cause of a mechanism is moved by itself.
        """
        if self._world is None:
            first = self._model.solve(self._idle, key=NoiseKey(self._noise, number, 0))
            key = NoiseKey(self._noise, number, 1)
            unit = self._model.solve(self._idle, previous=first, key=key)
            instants = [Instant(unit, first, key)]
        else:
            self._world.restore(probe.snapshot)
            here = Instant(self._world.values(), self._world.previous())
            self._world.step(probe.action)
            instants = [Instant(self._world.values(), self._world.previous()), here]
        self._kept = [*self._kept, *instants][-2 * REMEMBERED :]
        now, rng = instants[-1], ProbeGenerator(self._noise, number)
        moved = {
            name: value
            for name in {cause: None for causes in self._causes.values() for cause, _ in causes}
            for value in (another(self._model, name, now.values, rng, "moved", 1.0),)
            if value is not None
        }
        others = [self._drawn(number, turn, now) for turn in (0, 1)]
        return [*instants, *others, now._replace(values=moved)]

    def _drawn(self, number: int, turn: int, now: Instant) -> Instant:
        """Draw everything that has no parents, and compute what follows from it.

        Some causes show in other circumstances only: the noise of a wall where walls are random.
        """
        rng, model = ProbeGenerator(self._noise, number, turn), self._model
        names = tuple(model) if self._world is None else self._world.static_names
        values = {name: now.values[name] for name in names}
        roots = {
            v.name: other
            for v in model.variables
            if isinstance(v, Exogenous | Action) and v.name in values
            for other in (drawn(v, values[v.name], values, rng, "roots"),)
            if other is not None
        }
        if self._world is not None:
            return Instant(model.solve({**values, **roots}, only=names), None)
        known = {**self._idle, **roots}
        return now._replace(values=model.solve(known, previous=now.previous, key=now.key))

    # --- mechanisms -------------------------------------------------------------------------------

    def _see_mechanisms(
        self,
        setting: ProbeSetting,
        instants: list[Instant],
        wanted: Collection[EdgeKey] | None,
        effects: Effects,
    ) -> None:
        """Evaluate each mechanism with one cause as it is at another instant.

        In the end each is evaluated once more, with everything else as it is at another instant:
        the same has to come out.
        """
        others = [*instants, *self._kept]
        bases = instants[:3]
        if self._world is None:  # experiments are counted, and every unit is another circumstance
            bases = [bases[setting.probe % 2]]
        done = set[tuple[str, int, int]]()
        for base in bases:
            solved: dict[str, Value] = {}
            for child, causes in self._causes.items():
                if any(not lag and cause not in base.values for cause, lag in causes):
                    continue
                solved[child] = self._evaluated(child, base)
                for cause, lag in causes:
                    if wanted is not None and (cause, child, lag) not in wanted:
                        continue
                    for turn, known in enumerate(_otherwise(base, cause, lag, others)):
                        size = gap(self._evaluated(child, known), solved[child])
                        effects.see((cause, child, lag), size, setting)
                        done.add((cause, lag, turn))
                        if size > RESOLUTION:
                            break
            for child in reversed(solved):
                held = {cause: base.values[cause] for cause, lag in self._causes[child] if not lag}
                known = base._replace(values={**base.values, **others[-1].values, **held})
                effects.see_unstable(child, gap(self._evaluated(child, known), solved[child]))
        effects.changed.update({cause for cause, *_ in done})
        if self._world is None:  # without the graph, every variable would have to be moved
            effects.rollouts += 1 + max(len(done), len(self.targets))

    def _evaluated(self, name: str, at: Instant) -> Value:
        solve = self._model.solve
        return solve(at.values, previous=at.previous, key=at.key, only=(name,))[name]

    # --- states that a backend decides ------------------------------------------------------------

    def _see_states(
        self,
        number: int,
        probe: Probe,
        instants: list[Instant],
        wanted: Collection[EdgeKey] | None,
        effects: Effects,
    ) -> None:
        """Set one variable at a time; compare the states, at once and one control step later."""
        world: Any = self._world
        self._probe, self._later, self._first = probe, instants[0].values, instants[1].values
        causes = None if wanted is None else {c for c, effect, _ in wanted if effect in self.states}
        for target in self.targets:
            if causes is None or target in causes:
                self._vary(number, target, effects)
        rng, (low, high) = ProbeGenerator(self._noise, number), action_range(world)
        for name, where in world.compiled.actions.items():
            if causes is None or name in causes:
                action = np.array(probe.action)
                elsewhere = low[where] + rng.random(name, len(low[where])) * (high - low)[where]
                action[where] += SCALES[0] * (elsewhere - action[where])
                world.restore(probe.snapshot)
                change = action - probe.action
                self._see_later(name, ProbeSetting(number, probe.kind, change), action, effects)
                effects.changed[name] += bool(change.any())
        world.restore(probe.snapshot)
        world.step(probe.action)
        for name, value in world.values().items():
            effects.see_unstable(name, gap(value, self._later[name]))

    def _vary(self, number: int, target: str, effects: Effects) -> None:
        """Try other values of a variable until one is feasible."""
        rng, refused = ProbeGenerator(self._noise, number), False
        for attempt, scale in enumerate((*FAR, *SCALES) if number % 4 == 3 else SCALES):
            value = self._other(target, rng, attempt, scale)
            if value is None or gap(value, self._first[target]) == 0.0:
                continue
            try:
                self._see_target(number, target, value, effects)
            except (InterventionError, EngineFailure):
                refused = True
                continue
            effects.changed[target] += 1
            return
        effects.refused[target] += refused

    def _other(self, target: str, rng: ProbeGenerator, attempt: int, scale: float) -> Value | None:
        """Choose another value; of what decides the structure, one that changes it a little."""
        world: Any = self._world
        if target in world.task.decided_by:
            nearby: list[Value] = [r[target] for r in world.task.nearby(self._first) if target in r]
            if nearby:
                return nearby[attempt % len(nearby)]
        return another(self._model, target, self._first, rng, f"other {attempt}", scale)

    def _see_target(self, number: int, target: str, value: Value, effects: Effects) -> None:
        """Set a variable, hold what follows, and take a control step.

        A change of structure is an effect like any other: what is there before and after it is
        held, and compared.
        """
        world: Any = self._world
        change = np.ravel(value) - np.ravel(self._first[target])
        setting = ProbeSetting(number, self._probe.kind, change)
        held: dict[str, Value] = {}
        while moved := self._moved({target: value, **held}):
            held |= {name: self._first[name] for name in moved}
            for name in (name for name in moved if name in self.states):
                others = {other: at for other, at in held.items() if other != name}
                self._moved({target: value, **others})
                if self._alike(name):
                    effects.see((target, name, 0), gap(world[name], self._first[name]), setting)
        self._see_later(target, setting, self._probe.action, effects)

    def _moved(self, request: Mapping[str, Value]) -> list[str]:
        """Intervene in the probe state; name what could be held, and is not as it was."""
        world: Any = self._world
        world.restore(self._probe.snapshot)
        world.do(request)
        now = world.row
        return [
            name
            for name in self.targets
            if name not in request and self._alike(name) and gap(now[name], self._first[name]) > 0.0
        ]

    def _alike(self, name: str) -> bool:
        """Check whether a variable is there in the present structure, and has the same shape."""
        world: Any = self._world
        now = world.row
        return name in now and np.shape(now[name]) == np.shape(self._first[name])

    def _see_later(
        self, cause: str, setting: ProbeSetting, action: Floats, effects: Effects
    ) -> None:
        """Take a control step, and compare the states with those of the unchanged run."""
        world: Any = self._world
        world.step(action)
        effects.rollouts += 1
        now = world.row
        for name in filter(self._alike, self.states):
            effects.see((cause, name, 1), gap(now[name], self._later[name]), setting)


def settable(model: SCM) -> tuple[str, ...]:
    """Name the variables of a world that ``do`` sets, each once; actions are none of them."""
    return tuple(
        v.name
        for v in model.variables
        if v.settable and v.role != "action" and model.target(v.name) == v.name
    )


def engine_decided(model: SCM) -> tuple[str, ...]:
    """Name the variables of a world that its backend decides."""
    return tuple(v.name for v in model.variables if isinstance(v, Measured) and v.mechanism is None)


def another(
    model: SCM, name: str, values: Values, rng: ProbeGenerator, stream: str, scale: float
) -> Value | None:
    """Move a variable towards another value of its spaces; None if there is none."""
    variable, present = model.declared(name), values[name]
    value = drawn(variable, present, values, rng, stream)
    if value is None or variable.dtype != "real":
        return value
    moved = np.asarray(present + scale * (value - present))
    return variable.bounds.nearest(moved) if isinstance(variable.bounds, Rotations) else moved


def _otherwise(base: Instant, cause: str, lag: int, others: Iterable[Instant]) -> Iterator[Instant]:
    """Give a cause the values that it has at other instants."""
    name = earlier(cause, lag) if lag else cause
    now = base.previous if lag else base.values
    if now is None or (lag == 0 and cause not in now):
        return
    for other in others:
        value = other.values.get(cause)
        if value is None or (name in now and np.shape(value) != np.shape(now[name])):
            continue
        if name not in now or gap(value, now[name]) > 0.0:
            changed = {**now, name: value}
            yield base._replace(previous=changed) if lag else base._replace(values=changed)
