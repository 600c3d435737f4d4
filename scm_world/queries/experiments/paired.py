"""Paired experiments: same noise, same state, same action, one variable changed.

Any difference afterwards, down to single bits, is an effect. It is a *direct* effect if it remains
while every other variable that moved is held at its old value. There are two kinds of experiment:

- For a variable with a mechanism, the mechanism is evaluated with the value that one parent has at
  another instant. A mechanism gets its parents only.
- For a state of the backend, one variable is set, its other descendants are held, and a control
  step is taken.

For equations, only the first kind is needed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Set
from contextlib import closing, contextmanager
from typing import Any, NamedTuple, final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.errors import (
    EngineFailure,
    InterventionError,
    ModelError,
    SnapshotMismatch,
    UnknownOption,
)
from scm_world.graph import SCM, NoiseKey
from scm_world.policies.planning import action_range
from scm_world.queries.equations import as_given
from scm_world.queries.experiments.effects import (
    FACTOR,
    RESOLUTION,
    EdgeKey,
    Effects,
    ProbeSetting,
    gap,
)
from scm_world.queries.experiments.probes import (
    Probe,
    Random,
    another,
    rounds_at,
    touching_pairs,
)
from scm_world.queries.local import contact_terms, holds
from scm_world.queries.plans import Plan
from scm_world.tasks.composition import parts
from scm_world.variables import Noise
from scm_world.variables.moments import earlier
from scm_world.world import CausalSystem, CompiledModel, Equations, Simulation

SCALES = (0.1, 0.03, 0.01, 0.003, 0.001)
"""Fractions by which a variable is moved towards another value, until one is feasible."""

FAR = (1.0, 0.3)
"""Larger fractions that are tried first in every fourth probe state, to reveal thresholds."""

OTHER = 1_000_000
"""Control steps to the one whose noise is taken instead."""


class Instant(NamedTuple):
    """Inputs of mechanisms: values, those of one step ago, and the noise key."""

    values: Values
    previous: Values | None
    key: NoiseKey | None = None


@final
class Paired:
    """A system that is run twice from one state: unchanged, and with one variable changed.

    A world is restored to the probe state before every experiment. With ``apart``, effects do not
    count where a chain of contacts joins the bodies of cause and effect after the control step. On
    an engine that solves for bodies together that do not touch, edges by contact count there only.
    """

    here: Instant  # inputs of mechanisms in the present probe state
    first: Values  # values there, including actions
    setting: ProbeSetting  # number and kind of that state
    touched: Set[tuple[str, str]] = frozenset()  # bodies in contact after the step, if it matters
    _by_contact: Set[EdgeKey] = frozenset()  # edges that count only where contacts join bodies

    def __init__(self, system: Simulation | SCM, seed: int, *, apart: bool = False) -> None:
        self.world: Any = None if isinstance(system, SCM) else system
        self.model: SCM = system if isinstance(system, SCM) else system.model
        self.seed, self._noise = seed, Noise(seed)
        self.tested = Counter[EdgeKey]()  # numbers of probe states, by edge into a state
        # The variables that the backend computes, and those that are set:
        self.states, self.targets = tuple[str, ...](), tuple(self.model)
        self.generated, self.floors, self._least = False, dict[str, float](), 0.0
        self._rounding = dict[str, float]()
        self.actions: Mapping[str, Any] = {}
        if self.world is None:
            compiled = CompiledModel(self.model)
            self._idle = compiled.split(Equations(compiled).idle())
        else:
            self.world.require_exact("a comparison of a changed with an unchanged control step")
            self.states, computed = engine_decided(self.model), self.world.compiled.computed
            self.targets = tuple(name for name in settable(self.model) if name not in computed)
            self.actions, task = self.world.compiled.actions, self.world.task
            self.generated = task.generated_graph
            self.floors = {name: FACTOR * size for name, size in task.noise_floors.items()}
            self._least, self._rounding = rounds_at(self.world), coupling(self.world, self.states)
            self._terms = contact_terms(self.world) if apart or self._rounding else None
            if self._rounding:
                by_contact = (e.key for e in self.model.edges if e.when == "contact")
                self._by_contact = frozenset(by_contact)
        self._apart = apart
        self._causes: dict[str, list[tuple[str, int]]] = {}
        for edge in self.model.edges:
            if edge.effect not in self.states:
                self._causes.setdefault(edge.effect, []).append((edge.cause, edge.lag))

    def effects(self) -> Effects:
        """Return an empty record of effects."""
        exact = self.generated and not self.floors and not self._rounding
        more: dict[str, Any] = {"floors": self.floors, "rounding": self._rounding}
        return Effects(least=self._least, exact=exact, **more)

    def run(self, number: int, probe: Probe, wanted: Collection[EdgeKey] | None = None) -> Effects:
        """Run all experiments of one probe state in which one variable is changed.

        They test the declared edges in ``wanted``, or all possible edges if None.
        """
        effects, rng = self.effects(), np.random.default_rng((self.seed, number))
        self.probe, self.setting = probe, ProbeSetting(number, probe.kind)
        if self.world is None:
            first = self.model.solve(self._idle, key=NoiseKey(self._noise, number, 0))
            key = NoiseKey(self._noise, number, 1)
            unit = self.model.solve(self._idle, previous=first, key=key)
            self.here = Instant(unit, first, key)
            self._see_mechanisms([self.here], wanted, effects, rng)
            return effects
        try:
            self.world.restore(probe.snapshot)
        except SnapshotMismatch:  # the backend has changed a parameter
            now, names = self.world.row, self.world.compiled.parameter_keys
            found = self.world.backend.parameters(names.values())
            for name, key in names.items():
                effects.see_unstable(name, gap(found[key], now[name]))
            if not effects.unstable:
                raise
            return effects
        self.here = Instant(self.world.values(), self.world.previous())
        actions = {name: probe.action[at] for name, at in self.actions.items()}
        self.first = {**self.here.values, **actions}
        self.touched = self._step(probe.action)
        later = Instant(self.world.values(), self.world.previous())
        effects.rollouts += 1
        effects.touching.append(frozenset(touching_pairs(self.world)))
        if probe.unsaturated is not None:
            places, effects.sought = probe.unsaturated, 1
            acting = (n for n, at in self.actions.items() if places & {*range(at.start, at.stop)})
            effects.unsaturated.update(acting)
        self._see_mechanisms([later, self.here], wanted, effects, rng)
        joined = self.joins(self.touched if self._apart else ())
        causes = (
            None
            if wanted is None
            else {c for c, effect, _ in wanted if effect in self.states and not joined(c, effect)}
        )
        for name in (*self.targets, *self.actions):
            if causes is None or name in causes:
                self._vary(name, later.values, effects, rng)
        self.world.step(self.at({}))
        for name, value in self.world.values().items():
            effects.see_unstable(name, gap(value, later.values[name]))
        for noise, state, value, base in self.driven(probe):
            if noise in self.states and noise != state:  # it is that of another state
                effects.see((f"noise of {noise}", state, 0), value, base, self.setting)
        return effects

    def _step(self, action: Floats) -> set[tuple[str, str]]:
        """Take a control step; return the pairs of bodies that touch at its end, if it matters."""
        self.world.step(action)
        contacts = () if self._terms is None else self.world.backend.contacts()
        return {contact.bodies for contact in contacts}

    def joins(self, touched: Collection[tuple[str, str]]) -> Callable[[str, str], bool]:
        """Return a function of cause and effect: whether contacts join their bodies."""
        terms = self._terms or {}
        return holds(terms, touched) if touched else lambda cause, effect: False

    def at(self, changed: Mapping[str, Value]) -> Floats:
        """Restore the probe state and change some variables; return the action with changes."""
        self.world.restore(self.probe.snapshot)
        request = {name: value for name, value in changed.items() if name not in self.actions}
        if request:
            self.world.do(request)
        action = np.array(self.probe.action)
        for name in self.actions.keys() & changed.keys():
            action[self.actions[name]] = changed[name]
        return action

    def other(self, name: str, values: Values, rng: Random, scale: float = 1.0) -> Any:
        """Return a value between the present one and another one of its spaces, or None."""
        if name not in self.actions:
            return another(self.model.declared(name), values, rng, scale)
        low, high = (end[self.actions[name]] for end in action_range(self.world))
        return np.asarray(values[name] + scale * (rng.uniform(low, high) - values[name]))

    def alike(self, names: Iterable[str], base: Values) -> dict[str, Value]:
        """Return present values, without variables of a new shape."""
        now = self.world.row
        return {n: now[n] for n in names if n in now and np.shape(now[n]) == np.shape(base[n])}

    def moved(self, names: Iterable[str], base: Values) -> list[str]:
        """List the variables of which the present value differs, without those of a new shape."""
        now = self.alike(names, base).items()
        return [name for name, value in now if gap(value, base[name]) > 0.0]

    def driven(self, probe: Probe) -> Iterator[tuple[str, str, Value, Value]]:
        """Draw each noise of the control step again, alone, and yield the states that differ.

        Yields:
            Noise and state, and the state after the step, with the other noise and with this one.
        """
        world, commands = self.world, self.world.composition.commands
        world.restore(probe.snapshot)
        if commands is None or not commands.noisy or not commands.applies(world.row):
            return

        def after(command: Floats) -> Values:
            world.restore(probe.snapshot)
            for steps, part in parts(np.broadcast_to(command, (world.substeps, command.shape[-1]))):
                world.backend.step(part, steps)
            state = world.backend.read()
            return {name: state.vector[at] for name, at in state.layout.slices.items()}

        acted, sent, _ = world._decided(world.compiled.clipped(probe.action))
        command, key = sent.copy(), world.noise_key(world.index + OTHER)
        given = acted, world.row, world.state.vector, key, world.substeps
        others = commands.command(*given).copy()
        base = after(command)
        for noise, place in commands.noisy.items():
            changed = command.copy()
            changed[..., place] = others[..., place]
            for state, value in after(changed).items():
                if gap(value, base[state]) > 0.0:
                    yield noise, state, value, base[state]

    # --- mechanisms -------------------------------------------------------------------------------

    def _see_mechanisms(
        self,
        instants: list[Instant],
        wanted: Collection[EdgeKey] | None,
        effects: Effects,
        rng: Random,
    ) -> None:
        """Evaluate mechanisms with other values of one cause, then of everything but causes."""
        bases = [*instants, self._drawn(rng)]
        others = [base.values for base in (*bases, self._drawn(rng))]
        causes = dict.fromkeys(cause for found in self._causes.values() for cause, _ in found)
        drawn = {n: another(self.model.declared(n), self.here.values, rng) for n in causes}
        others.append({name: value for name, value in drawn.items() if value is not None})
        if self.world is None:  # one base per unit, since experiments are counted
            bases = [bases[self.setting.probe % 2]]
        done = set[tuple[str, int, int]]()
        for base in bases:
            solved: dict[str, Value] = {}
            for child, found in self._causes.items():
                if any(not lag and cause not in base.values for cause, lag in found):
                    continue
                solved[child] = self.evaluated(child, base)
                for cause, lag in found:
                    if wanted is not None and (cause, child, lag) not in wanted:
                        continue
                    for turn, known in enumerate(_alternatives(base, cause, lag, others)):
                        done.add((cause, lag, turn))
                        now, key = self.evaluated(child, known), (cause, child, lag)
                        if effects.see(key, now, solved[child], self.setting):
                            break
            for child in reversed(solved):
                held = {cause: base.values[cause] for cause, lag in self._causes[child] if not lag}
                known = base._replace(values={**base.values, **others[-1], **held})
                effects.see_unstable(child, gap(self.evaluated(child, known), solved[child]))
        effects.changed.update({cause for cause, *_ in done})
        if self.world is None:  # a search without the graph would change every variable
            effects.rollouts += 1 + max(len(done), len(self.targets))

    def _drawn(self, rng: Random) -> Instant:
        """Draw all roots and compute their descendants, since some effects need other values."""
        model, now = self.model, self.here
        names = tuple(model) if self.world is None else self.world.compiled.static_names
        values = {name: now.values[name] for name in names}
        roots = {
            name: another(model.declared(name), values, rng)
            for name in names
            if model.declared(name).is_root or model.declared(name).role == "action"
        }
        roots = {name: value for name, value in roots.items() if value is not None}
        if self.world is not None:
            return Instant(model.solve({**values, **roots}, only=names), None)
        known = {**self._idle, **roots}
        return now._replace(values=model.solve(known, previous=now.previous, key=now.key))

    def evaluated(self, name: str, at: Instant) -> Value:
        """Evaluate the mechanism of a variable."""
        values = at.values
        if at.key is not None:  # a root whose distribution follows others is drawn again
            values = {other: value for other, value in values.items() if other != name}
        return self.model.solve(values, previous=at.previous, key=at.key, only=(name,))[name]

    # --- states that a backend computes -----------------------------------------------------------

    def _vary(self, name: str, later: Values, effects: Effects, rng: Random) -> None:
        """Test other values of a variable until one is feasible."""
        task, near, refused = self.world.task, list[Value](), False
        if name in task.decided_by:  # the structure is changed a little
            near = [one[name] for one in task.nearby(self.first) if name in one]
        for attempt, scale in enumerate((*FAR, *SCALES) if self.setting.probe % 4 == 3 else SCALES):
            value = self.other(name, self.first, rng, scale)
            value = near[attempt % len(near)] if near else value
            if value is None or gap(value, self.first[name]) == 0.0:
                continue
            try:
                self._see_target(name, value, later, effects)
            except (InterventionError, EngineFailure):
                refused = True
                continue
            effects.changed[name] += 1
            return
        effects.refused[name] += refused

    def _see_target(self, name: str, value: Value, later: Values, effects: Effects) -> None:
        """Set a variable, hold its other descendants, and take a control step."""
        first, request = self.first, {name: value}
        setting = self.setting._replace(change=np.ravel(value) - np.ravel(first[name]))
        while True:
            action = self.at(request)
            moved = self.moved((n for n in self.targets if n not in request), first)
            if not moved:
                break
            request |= {other: first[other] for other in moved}
            for state in (other for other in moved if other in self.states):
                self.at({other: held for other, held in request.items() if other != state})
                for now in self.alike((state,), first).values():
                    effects.see((name, state, 0), now, first[state], setting)
        joined = self.joins(self._step(action) | self.touched)
        effects.rollouts += 1
        for state, now in self.alike(self.states, later).items():
            key = name, state, 1
            matters = self._apart or key in self._by_contact
            if not matters or joined(name, state) != self._apart:
                effects.see(key, now, later[state], setting)
                self.tested[key] += 1


@contextmanager
def opened(system: object, options: Mapping[str, Any]) -> Iterator[Simulation | SCM]:
    """Provide a world that is restored afterwards, a new one that is closed, or equations.

    Equations are under the interventions they were given, a world with an engine as it is declared.
    """
    system = as_given(system)
    if options and isinstance(system, CausalSystem | SCM):
        raise UnknownOption("option with a given world", next(iter(options)), ())
    if isinstance(system, SCM):
        yield system
    elif isinstance(system, CausalSystem):
        plan: Any = getattr(system, "plan", Plan())
        if any(act.root.computes for _, act in plan.acts()):
            text = "a mechanism that a world with an engine was given cannot be checked"
            raise ModelError([f"{text}: leave out given({plan})"])
        with system.unchanged():
            yield system  # type: ignore[misc] # equations are a model by now
    else:
        from scm_world.queries.world import World  # above this module

        with closing(World(system, **options)) as world, opened(world, {}) as found:
            yield found


def coupling(world: Simulation, states: Iterable[str]) -> dict[str, float]:
    """Return how far bodies that do not touch move states in a control step; empty if they do not.

    It is by the larger of their values and one unit, the largest of the numbers of each.
    """
    layout, engine = world.structure.empty_state().layout, world.backend
    given = engine.capabilities.rounding(engine, world.structure, world.substeps)
    found = np.broadcast_to(given, (layout.size,))
    if found.max(initial=0.0) <= RESOLUTION:
        return {}
    most = {name: float(found[where].max(initial=0.0)) for name, where in layout.slices.items()}
    return {name: most[name] for name in states if name in most}


def settable(model: SCM) -> tuple[str, ...]:
    """Return the variables of a world that ``do`` sets, without actions and coordinates."""
    return tuple(
        v.name
        for v in model.variables
        if v.settable and v.role != "action" and model.target(v.name) == v.name
    )


def engine_decided(model: SCM) -> tuple[str, ...]:
    """Return the variables of a world that its backend computes."""
    return tuple(v.name for v in model.variables if v.is_simulated)


def _alternatives(
    base: Instant, cause: str, lag: int, others: Iterable[Values]
) -> Iterator[Instant]:
    """Yield instants in which a cause has other values."""
    name = earlier(cause, lag) if lag else cause
    now = base.previous if lag else base.values
    if now is None or (lag == 0 and cause not in now):
        return
    for other in others:
        value = other.get(cause)
        if value is None or (name in now and np.shape(value) != np.shape(now[name])):
            continue
        if name not in now or gap(value, now[name]) > 0.0:
            changed = {**now, name: value}
            yield base._replace(previous=changed) if lag else base._replace(values=changed)
