"""Recorded episodes and their counterfactuals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, final

import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import Floats, Value
from scm_world.errors import UnknownOption, UnknownVariable
from scm_world.models.camera import Camera
from scm_world.models.scene import Scene
from scm_world.policies.scripted import Sequence as Given
from scm_world.queries.equations import System
from scm_world.queries.parallel import Result, run_units
from scm_world.queries.plans import Layer, Plan, Schedule
from scm_world.queries.rollouts import (
    ALL,
    EVERY,
    Running,
    Trace,
    Unit,
    as_names,
    run,
)
from scm_world.queries.twins import AnyTwins, EquationTwins
from scm_world.world import Audit


@final
class Episode:
    """One unit of the world: its noise, its interventions and its states.

    Replays and counterfactuals are bit-identical.

    Args:
        twins: Twins of the world that it happened in.
        unit: What was run.
        trace: What was recorded.

    Attributes:
        seed: Of the noise.
        number: Of the episode within that noise.
        schedule: Plans, each with the control step from which it counts.
        steps: How many control steps it has.
    """

    def __init__(self, twins: AnyTwins, unit: Unit, trace: Trace) -> None:
        self.twins: Any = twins
        self.seed, self.number = unit.seed, unit.number
        self.schedule: Any = unit.schedule
        self.steps = unit.steps
        self.trace = trace
        self._all: Trace | None = None

    # --- reading ------------------------------------------------------------------------------

    @property
    def layers(self) -> tuple[Layer, ...]:
        """Plans, each with the control step from which it counts."""
        return tuple(self.schedule.layers)

    @property
    def plan(self) -> Plan:
        """What was done from the beginning."""
        return self.layers[0][1] if self.layers else Plan()

    @property
    def actions(self) -> Floats:
        """What the policy asked for, shape (steps, n_actions)."""
        n = self.trace.declarations[0][1].n_actions
        return np.array(self.trace.actions).reshape(self.steps, n)

    @property
    def audits(self) -> Mapping[int, Audit]:
        """What each intervention did, by control step."""
        return dict(self.trace.audits)

    @property
    def events(self) -> Mapping[str, int]:
        """At which control step events happened that variables waited for, by variable."""
        return {name: step for (_, name, _), step in self.trace.fired.items()}

    @property
    def names(self) -> tuple[str, ...]:
        """All variables of the structure at the end."""
        return tuple(self.trace.declarations[-1][1].model)

    def __len__(self) -> int:
        return self.steps

    def __getitem__(self, name: str) -> Value:
        """Give a variable at every instant, shape ``(steps + 1, *shape)``.

        Instant t is the one at which the action of step t is chosen, after what was done then; the
        last one is the end. What is not there at every instant, since bodies came or went, is
        given as far as it is there.

        Raises:
            UnknownVariable: No variable has this name.
        """
        if name in self.trace.values:
            return np.array(self.trace.values[name])
        declarations = self.trace.declarations
        if len(declarations) == 1 and name in declarations[0][1].slices:
            return np.asarray(declarations[0][1].read(name, np.array(self.trace.vectors)))
        if all(name in values for _, values in self.trace.statics):
            return self._parameter(name)
        if not any(name in declaration.model for _, declaration in declarations):
            raise UnknownVariable(name, self.names)
        return np.array(self.replay().values[name])

    def _parameter(self, name: str) -> Value:
        steps = [step for step, _ in self.trace.statics] + [self.steps + 1]
        lengths = np.diff(steps)
        return np.repeat([values[name] for _, values in self.trace.statics], lengths, axis=0)

    def final(self, name: str) -> Value:
        """Give a variable at the end; see ``__getitem__``."""
        return np.asarray(self[name][-1])

    def replay(self) -> Trace:
        """Replay the episode, and record every variable and every contact."""
        if self._all is None:
            with self.twins.twin() as world:
                self._all = replace(self._again(), names=(ALL,), contacts=True).run(world)
        return self._all

    def __eq__(self, other: object) -> bool:
        """Tell whether all states, parameters and actions are the same, bit for bit."""
        return isinstance(other, Episode) and _same(self.trace, other.trace)

    __hash__ = None  # type: ignore[assignment] # compared by content

    def __repr__(self) -> str:
        held = ", ".join(f"{name} from {at}" for at, plan in self.layers for name in plan)
        return f"Episode({self.steps} steps, seed {self.seed}, number {self.number}, do({held}))"

    def scene(self, step: int) -> tuple[Scene, tuple[Camera, ...]]:
        """Describe an instant of a world for pictures, without running it again.

        Args:
            step: Number of the instant, as in ``__getitem__``.

        Returns:
            The scene, and the cameras whose places are variables.

        Raises:
            UnknownOption: There is no such instant, or it is no episode of a world.
        """
        if whole_number("step", step, least=0) > self.steps:
            raise UnknownOption("step", step, (f"0 to {self.steps}",))
        if isinstance(self.twins, EquationTwins):
            raise UnknownOption("picture", "an episode of equations", ("one of a world",))
        values = _at(self.trace, step)
        compiled = next(c for at, c in reversed(self.trace.declarations) if at <= step)
        state = compiled.empty_state(np.array(self.trace.vectors[step]))
        return compiled.describe(values, state), compiled.composition.cameras(values)

    # --- counterfactuals -----------------------------------------------------------------

    def counterfactual(
        self,
        do: Mapping[str, Any] | None = None,
        *,
        at: int = 0,
        actions: Any = "replay",
        record: Iterable[str] = (),
    ) -> Episode:
        """Restore an instant, intervene, and continue with the same noise.

        Args:
            do: The intervention; without a time it takes place at the instant ``at``.
            at: Number of the control step.
            actions: ``"replay"`` for the same actions, or a policy that acts from there on.
            record: Variables to record during the run; others are computed by replaying it.

        Returns:
            The counterfactual episode; bit-identical to this one without an intervention.

        Raises:
            InterventionError: The intervention was refused.
            UnknownOption: There is no such control step.
        """
        unit = self._unit(do, self._instant(at), actions, as_names(record))
        with self.twins.twin() as world:
            trace = unit.run(world, lambda twin: self._arrive(twin, unit.first))
        return Episode(self.twins, unit, trace)

    def _instant(self, at: Any) -> int:
        last = max(self.steps - 1, 0)
        if isinstance(at, bool) or not isinstance(at, int | np.integer) or not 0 <= at <= last:
            raise UnknownOption("at", at, (f"a control step from 0 to {last}",))
        return int(at)

    def _unit(
        self, do: Mapping[str, Any] | None, at: int, actions: Any, names: tuple[str, ...]
    ) -> Unit:
        """Return the unit that continues from an instant."""
        before = [d.model for step, d in self.trace.declarations if step < max(at, 1)]
        whole = tuple(name for name in names if all(name in model for model in before))
        past = self.trace.until(at)
        past.values = {name: list(self[name][:at]) for name in whole}
        again, is_replay = self._again(), isinstance(actions, str) and actions == "replay"
        return replace(
            again,
            schedule=Schedule([*self.layers, (at, Plan(do))]),
            policy=again.policy if is_replay else actions,
            names=whole,
            first=at,
            past=past,
        )

    def _again(self) -> Unit:
        """Return the unit that repeats this episode."""
        past = Given(self.trace.actions)
        return Unit(self.seed, self.number, self.schedule, past, self.steps)

    def _arrive(self, world: System, at: int) -> None:
        """Bring a twin to an instant, before anything is done then that the past does not know."""
        if at == 0:
            world.reset(seed=self.seed, episode=self.number)
            return
        near = self._near(world, at)  # snapshots are taken after what was done: an earlier one
        world.restore(self.trace.snapshots[near])
        self._go_through(world, near, at)

    def _near(self, world: System, at: int) -> int:
        """Find the last snapshot before an instant; take those that were not taken on the way."""
        near = max((step for step in self.trace.snapshots if step < at), default=-1)
        if near < (at - 1) // EVERY * EVERY:
            if near < 0:
                near = 0
                Running(self._again(), world).begin()
            else:
                world.restore(self.trace.snapshots[near])
            found = self._go_through(world, near, at).snapshots
            self.trace.snapshots = {**self.trace.snapshots, **found}
            near = max(step for step in self.trace.snapshots if step < at)
        return near

    def _go_through(self, world: System, first: int, last: int) -> Trace:
        """Replay from an instant, after its interventions."""
        running = Running(replace(self._again(), steps=last), world)
        running.trace.fired = dict(self.trace.fired)
        run(running, first, last)
        return running.trace

    def worlds(
        self,
        dos: Iterable[Mapping[str, Any]],
        *,
        at: int = 0,
        actions: Any = "replay",
        record: Iterable[str] = (),
        workers: int | None = None,
    ) -> tuple[Episode, ...]:
        """Run counterfactuals with the same noise, one for each intervention.

        Args:
            dos: What is done in each.
            at: Number of the control step, as in ``counterfactual``; also what follows.
            actions: ``"replay"`` or a policy.
            record: Variables to write down on the way.
            workers: Threads, see ``Setting``; the result does not depend on how many.
        """
        at, names = self._instant(at), as_names(record)
        if not isinstance(dos, Iterable) or isinstance(dos, Mapping):
            raise UnknownOption("dos", dos, ("a list of interventions",))
        given = list(dos)
        start = None
        if at > 0 and given:
            with self.twins.twin() as world:
                self._arrive(world, at)
                start = world.snapshot()
        units = [replace(self._unit(do, at, actions, names), start=start) for do in given]

        def finish(place: int, result: Result) -> Episode:
            if isinstance(result, Exception):
                raise result
            return Episode(self.twins, units[place], result)

        return tuple(run_units(self.twins, units, finish, workers))


def _same(one: Trace, other: Trace) -> bool:
    if len(one.vectors) != len(other.vectors):
        return False
    vectors = zip((*one.vectors, *one.actions), (*other.vectors, *other.actions), strict=True)
    if not all(a.tobytes() == b.tobytes() for a, b in vectors):
        return False
    return all(
        mine.keys() == its.keys() and all(np.array_equal(mine[n], its[n]) for n in mine)
        for step in range(len(one.vectors))
        for mine, its in [(_at(one, step), _at(other, step))]
        if mine is not its
    )


def _at(trace: Trace, step: int) -> dict[str, Value]:
    return next(values for at, values in reversed(trace.statics) if at <= step)
