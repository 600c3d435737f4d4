"""An episode that is run by hand: step by step, with interventions at the present instant."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from typing import Any, final

from scm_world._types import Floats
from scm_world.errors import InterventionError, UnknownOption
from scm_world.policies.scripted import Sequence as Given
from scm_world.policies.scripted import as_policy
from scm_world.queries.episodes import Episode
from scm_world.queries.plans import Layer, Plan, Schedule, retimed
from scm_world.queries.rollouts import Running, Unit
from scm_world.queries.twins import AnyTwins
from scm_world.variables import Draw, Natural
from scm_world.world import Audit, Simulation


@final
class LiveEpisode:
    """An episode under way; ``world.live`` makes it. The world that was asked is not changed.

    All that is done becomes a part of an ``Episode``: it can be saved, replayed, and continued
    otherwise, bit for bit.

    Args:
        twins: Twins of the world; one of them is used until ``close``.
        unit: What has happened until its first control step, and what is done from there on.

    Attributes:
        world: The twin, at the present instant. Change it through this object only.

    Example:
        >>> from scm_world.queries import World
        >>> live = World("pushing", backend="fake").live("random", seed=1)
        >>> print(live.do({"joint_damping": 0.05}))
        joint_damping = 0.05, engine reports 0.05
        >>> for _ in range(3):
        ...     action = live.step()
        >>> twin = live.split({"floor_friction": 0.4}, at=1)
        >>> twin.steps, [*twin.held]
        (1, ['joint_damping', 'floor_friction'])
        >>> live.episode().counterfactual({}) == live.episode()
        True
    """

    def __init__(self, twins: AnyTwins, unit: Unit) -> None:
        self.twins: Any = twins
        self._lease = ExitStack()
        lent: Any = twins.twin()
        self.world: Any = self._lease.enter_context(lent)
        self._running = Running(replace(unit, steps=sys.maxsize), self.world)
        self._arrival: Floats | None = None

    def begin(self) -> None:
        """Begin the episode, with what is done from its beginning.

        Raises:
            InterventionError: It was refused.
        """
        self._running.begin()
        self._arrival = None

    @property
    def steps(self) -> int:
        """How many control steps are over."""
        return len(self._running.trace.actions)

    @property
    def layers(self) -> tuple[Layer, ...]:
        """What was done: plans, each with the control step from which it counts."""
        schedule: Any = self._running.unit.schedule
        return tuple(schedule.layers)

    @property
    def actions(self) -> list[Floats]:
        """The actions of the steps that are over, shape (n_actions,) each."""
        return list(self._running.trace.actions)

    @property
    def policy(self) -> Any:
        """What acts in ``step``; see ``rollout``. It can be replaced at any time."""
        return self._running.policy

    @policy.setter
    def policy(self, given: Any) -> None:
        self._running.policy = as_policy(given, self.world)

    @property
    def held(self) -> dict[str, Any]:
        """What is in force: interventions that hold a variable, and open windows, by variable."""
        world, step = self.world, self.steps
        windows: dict[str, Any] = {}
        for start, plan in self.layers:
            for name, acts in plan.items() if start <= step else ():
                held = [act for act in acts if act.time is not None and act.time.holds(step)]
                windows.pop(name, None)
                windows.update({name: held[-1]} if held else {})
        model = world.graph if isinstance(world, Simulation) else world.model
        return {**model.interventions, **windows}

    def do(self, request: Mapping[str, Any]) -> Audit | None:
        """Intervene at the present instant; see ``World.do``.

        Args:
            request: By variable, a value, an intervention, or one with a time from now on, such as
                ``Hard(0.3, during=(5, 10))``. The numbers are control steps of the episode.

        Returns:
            What it did; None if nothing is done before a later control step.

        Raises:
            InterventionError: The request was refused; nothing has changed.
        """
        step, plan = self.steps, self._with_streams(Plan(request))
        due = Schedule([(step, plan)]).due(self.world, step, {})
        audit = self.world.do(due) if due else None
        if audit is not None:
            self._running.trace.audits[step] = audit
        earlier, (start, last) = self.layers[:-1], self.layers[-1]
        draws = any(isinstance(act, Draw) for _, act in last.acts())
        if start != step or draws or not {*last} <= {*plan}:  # else this one takes its place
            earlier = self.layers
        self._take((*earlier, (step, plan)))
        return audit

    def _with_streams(self, plan: Plan) -> Plan:
        """Name the noise of draws of what was drawn at this instant already, as the world does."""
        world, step, request = self.world, self.steps, dict[str, Any](plan)
        random = world.compiled.random if isinstance(world, Simulation) and step == 0 else ()
        drawn = [
            name
            for start, done in self.layers
            for name, act in (done.acts() if start == step else ())
            if isinstance(act, Draw)
        ]
        for name, (act, *others) in plan.items():
            if name in drawn and isinstance(act, Draw) and act.stream is None:
                times = drawn.count(name) + (name in random)
                request[name] = (act.model_copy(update={"stream": f"draw {times}"}), *others)
        return Plan(request)

    def _take(self, layers: tuple[Layer, ...]) -> None:
        self._running.unit = replace(self._running.unit, schedule=Schedule(layers))

    def step(self, action: Any = None) -> Floats:
        """Take a control step, and do what is due at the instant that it leads to.

        Args:
            action: Shape (n_actions,); that of the policy if None.

        Returns:
            The action that was asked for.

        Raises:
            ActionError: It is no action; nothing has changed.
            EngineFailure: The backend lost the state; begin another episode.
            InterventionError: What was due at that instant was refused. The step is taken, and the
                variables that it concerned are released.
        """
        running, step = self._running, self.steps
        before, audits = running.trace, dict(running.trace.audits)
        try:
            running.record(step)
            running.act(step, action)
        except Exception:
            running.trace = before.until(step)
            running.trace.audits = audits
            running.forget()
            raise
        self._arrival = self.world.vector.copy()
        try:
            running.intervene(step + 1)
        except InterventionError:
            due = running.unit.schedule.due(self.world, step + 1, dict(running.trace.fired))
            self.do({str(name): Natural() for name in due})
            raise
        return running.trace.actions[-1]

    def split(self, do: Mapping[str, Any] | None = None, *, at: int | None = None) -> LiveEpisode:
        """Return a counterfactual twin at an instant: the same noise, past and plans.

        Stepped with the same actions, it goes as ``episode().counterfactual(do, at=at)``.

        Args:
            do: The intervention; without a time it takes place at that instant.
            at: Number of the control step; the present one if None.

        Raises:
            InterventionError: The intervention was refused.
            UnknownOption: There is no such control step.
        """
        last = self.steps
        place = last if at is None else at
        if isinstance(place, bool) or not isinstance(place, int) or not 0 <= place <= last:
            raise UnknownOption("at", at, (f"a control step from 0 to {last}",))
        unit = replace(self._running.unit, first=place, past=self._running.trace)
        other = LiveEpisode(self.twins, unit)
        running, world = other._running, other.world
        running.policy = self.policy
        if place == last:
            world.restore(self.world.snapshot())
            other._arrival = self._arrival
            running.trace.audits.update(self._running.trace.audits)
        else:
            self.episode()._arrive(world, place)
            other._arrival = world.vector.copy() if place else None
        try:
            if place < last:
                other._take((*self.layers, (place, Plan(do))))
                running.intervene(place)
            elif do:
                other.do(do)
        except InterventionError:
            other.close()
            raise
        return other

    def episode(self) -> Episode:
        """Return what has happened so far, without what was done at the present instant.

        Raises:
            UnknownOption: No control step has been taken.
        """
        steps = self.steps
        if self._arrival is None:
            raise UnknownOption("number of steps", 0, ("1 or more: call step() first",))
        trace = self._running.trace.until(steps)
        trace.vectors.append(self._arrival)
        unit = replace(
            self._running.unit,
            schedule=Schedule(layer for layer in self.layers if layer[0] < steps),
            policy=Given(trace.actions),
            steps=steps,
            first=0,
        )
        return Episode(self.twins, unit, trace)

    def plan(self) -> Plan:
        """Return what was done so far as one plan: ``rollout`` with it repeats the interventions.

        Raises:
            InterventionError: An event was waited for from a later control step than the first.
        """
        found: dict[str, list[Any]] = {}
        for start, plan in self.layers:
            for name, acts in plan.items():
                kept = [part for act in found.pop(name, ()) for part in _until(act, start)]
                found[name] = kept + [_since(name, act, start) for act in acts]
        return Plan({name: tuple(acts) for name, acts in found.items()})

    def close(self) -> None:
        """Give the twin back. The episode can still be read; closing twice is harmless."""
        self._lease.close()


def _until(act: Any, end: int) -> list[Any]:
    """Return what an intervention has done before another one replaces it at a control step."""
    time = act.time
    if time is None:
        return [act] if end else []
    if time.when is not None or time.start >= end:
        return []
    if time.during is not None:
        stop = end if time.during[1] is None else min(end, time.during[1])
        return [retimed(act, during=(time.start, stop))]
    return [retimed(act, at=step) for step in range(time.start, end, time.every or end)]


def _since(name: str, act: Any, start: int) -> Any:
    """Return an intervention of a plan that begins at a control step, for one from the beginning.

    Raises:
        InterventionError: It waits for an event from a later control step on.
    """
    time = act.time
    if not start or (time is not None and time.when is None and time.every is None):
        return act
    if time is None:
        return retimed(act, at=start)
    if time.when is not None:
        said = "an event that is waited for from a later step needs its own plan"
        raise InterventionError(said, variable=name, value=act)
    first = time.start if time.start >= start else start + (time.start - start) % time.every
    return retimed(act, at=first, every=time.every)
