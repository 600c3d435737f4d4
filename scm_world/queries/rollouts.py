"""How an episode is run: what is done when, the loop, and what it leaves behind."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import Floats, Value
from scm_world.errors import ActionError, InterventionError
from scm_world.policies.scripted import Policy, as_policy
from scm_world.queries.equations import Equations, System
from scm_world.queries.plans import Plan
from scm_world.queries.timed import ACTS, At, Clamp, On
from scm_world.variables import Hard, Intervention, Mechanism, Natural
from scm_world.world import Audit, World

Layer = tuple[int, Plan]
"""The control step from which a plan counts, and the plan."""
Key = tuple[int, str, int]
"""Layer, variable and number of an intervention that waits for an event."""


@final
class Schedule:
    """Plans over one another: from its first step on, a later one counts for what it names.

    Args:
        layers: In the order of their making.

    Raises:
        InterventionError: Something should happen before its plan begins, or a state is to be
            held at what is no value.
    """

    def __init__(self, layers: Iterable[Layer]) -> None:
        self.layers = tuple((start, plan) for start, plan in layers if len(plan))
        for start, plan in self.layers:
            for name, part in plan.timed():
                step = part.step if isinstance(part, At) else start
                step = part.start if isinstance(part, Clamp) else step
                if step < start:
                    raise InterventionError(
                        f"do({name}): control step {step} is over; the plan begins at {start}",
                        variable=name,
                        value=part,
                    )
        self._is_simple = not any(True for _, plan in self.layers for _ in plan.timed())
        self._starts = frozenset(start for start, _ in self.layers)

    def due(self, world: System, step: int, fired: dict[Key, int]) -> dict[str, Intervention]:
        """Give what is to be done at the beginning of a control step.

        Args:
            world: As it is then; events are looked for in it.
            step: Number of the control step.
            fired: When events happened; those that happen now are added.
        """
        if self._is_simple and step not in self._starts:
            return {}
        found: dict[str, Intervention] = {}
        for number, name, start, parts in self._owners(step, world):
            released = False
            for index, part in enumerate(parts):
                act = _due(part, step, start, name, world, fired, (number, name, index))
                if isinstance(part, Clamp) and isinstance(act, Natural) and step == part.stop:
                    released = True
                elif act is not None:
                    found[name] = act
            if released and name not in found:
                found[name] = _still_held(parts, step)
        return found

    def concerns(self, world: System, step: int, fired: Mapping[Key, int]) -> bool:
        """Tell whether anything may be due at a control step, without a look at the present.

        Args:
            world: In the structure that there is then.
            step: Number of the control step.
            fired: When events happened.
        """
        if self._is_simple or step in self._starts:
            return step in self._starts
        return any(
            _concerns(part, step, start, world, name, fired, (number, name, index))
            for number, (start, plan) in enumerate(self.layers)
            if start <= step
            for name, parts in plan.items()
            for index, part in enumerate(parts)
        )

    def _owners(self, step: int, world: System) -> Iterator[tuple[int, str, int, tuple[Any, ...]]]:
        """List what counts at a step: of each quantity the last plan that names it."""
        last: dict[str, tuple[int, dict[str, None]]] = {}
        for number, (start, plan) in enumerate(self.layers):
            for name in plan if start <= step else ():
                for target in world.model.targets(name) if name in world.model else (name,):
                    if last.get(target, (-1, {}))[0] != number:
                        last[target] = (number, {})
                    last[target][1][name] = None
        owners = dict.fromkeys((number, name) for number, names in last.values() for name in names)
        for number, name in owners:
            start, plan = self.layers[number]
            yield number, name, start, plan[name]


@final
class Schedules:
    """Schedules of groups of episodes that are run together.

    Args:
        schedules: Of each group.
    """

    def __init__(self, schedules: Iterable[Schedule]) -> None:
        self._courses = tuple(schedules)

    def due(self, world: System, step: int, fired: dict[Key, int]) -> dict[int, Any]:
        """Give what is to be done in each group where something is."""
        found = ((g, schedule.due(world, step, fired)) for g, schedule in enumerate(self._courses))
        return {group: due for group, due in found if due}


def _still_held(parts: tuple[Any, ...], step: int) -> Intervention:
    """Say what holds where a window ends: a window around it, or the variable's own mechanism."""
    for part in parts:
        is_open = isinstance(part, Clamp) and part.start <= step
        if is_open and (part.stop is None or step < part.stop):
            held: Intervention = part.act
            return held
    return Natural()


def _concerns(
    part: Any,
    step: int,
    start: int,
    world: System,
    name: str,
    fired: Mapping[Key, int],
    key: Key,
) -> bool:
    """Tell whether a part may be due at a control step."""
    match part:
        case At():
            return part.step == step
        case Clamp():
            if step < part.start or (part.stop is not None and step > part.stop):
                return False
            is_held = name not in world.model or _is_state(name, world)
            return is_held or step in (part.start, part.stop)
        case On():
            return step > start and fired.get(key, step) == step
    return False


def _due(
    part: Any, step: int, start: int, name: str, world: System, fired: dict[Key, int], key: Key
) -> Intervention | None:
    act: Intervention | None = None
    match part:
        case At():
            act = part.act if part.step == step else None
        case Clamp():
            act = _held(part, step, name, world)
        case On():
            if step > start and key not in fired and part.event.happens(world):
                fired[key] = step
            act = part.act if fired.get(key) == step else None
        case _ if isinstance(part, ACTS):
            act = part if step == start else None
    return act


def _held(part: Clamp, step: int, name: str, world: System) -> Intervention | None:
    """Say what a clamp does: a state is put back at every step, a parameter is set and released."""
    if step < part.start or (part.stop is not None and step > part.stop):
        return None
    if not _is_state(name, world):
        return {part.start: part.act, part.stop: Natural()}.get(step)
    if not isinstance(part.act, Hard | Mechanism):
        raise InterventionError(
            f"do({name}): a state is held at a value or by a Mechanism, not by {part.act!r}",
            variable=name,
            value=part.act,
        )
    return part.act if step != part.stop else None


def _is_state(name: str, world: System) -> bool:
    role: str = world.model.declared(world.model.target(name)).role
    return role == "state"


EVERY = 10
"""Control steps from one snapshot to the next."""

ALL = "*"
"""Stands for every variable."""


@final
@dataclass
class Trace:
    """Everything that a rollout leaves behind.

    Attributes:
        vectors: State of each instant, after what was done then.
        statics: From when which values of parameters held.
        declarations: From when which structure there was.
        actions: What the policy asked for, shape (n_actions,) each.
        snapshots: Of some instants, after what was done then.
        fired: When events happened.
        audits: What interventions did, by control step.
        values: Of the variables that were asked for, at each instant.
        touching: Pairs of bodies that touch at each instant, where asked for.
    """

    vectors: list[Floats] = field(default_factory=list)
    statics: list[tuple[int, dict[str, Value]]] = field(default_factory=list)
    declarations: list[tuple[int, Any]] = field(default_factory=list)
    actions: list[Floats] = field(default_factory=list)
    snapshots: dict[int, Any] = field(default_factory=dict)
    fired: dict[Key, int] = field(default_factory=dict)
    audits: dict[int, Audit] = field(default_factory=dict)
    values: dict[str, list[Value]] = field(default_factory=dict)
    touching: list[frozenset[tuple[str, str]]] = field(default_factory=list)

    def until(self, step: int) -> Trace:
        """Copy what was before an instant, for a world that goes on otherwise from there."""
        return Trace(
            vectors=self.vectors[:step],
            statics=[pair for pair in self.statics if pair[0] < step],
            declarations=[pair for pair in self.declarations if pair[0] < step],
            actions=self.actions[:step],
            snapshots={at: kept for at, kept in self.snapshots.items() if at < step},
            fired={key: at for key, at in self.fired.items() if at < step},
            audits={at: audit for at, audit in self.audits.items() if at < step},
        )


def run(
    world: System,
    trace: Trace,
    schedule: Schedule | Schedules,
    policy: Policy,
    *,
    first: int,
    steps: int,
    names: Iterable[str] = (),
    contacts: bool = False,
) -> None:
    """Go on with a world, and write down what happens.

    Args:
        world: At the instant ``first``, after what was done then.
        trace: To go on with; it ends before that instant.
        schedule: What is done.
        policy: Who acts.
        first: Number of the first instant.
        steps: Number of the last one.
        names: Variables to write down at every instant; ``ALL`` for all.
        contacts: Whether to write down which bodies touch, where there are bodies.
    """
    wanted = tuple(names)
    version = -1
    for step in range(first, steps + 1):
        if first < step < steps:
            intervene(world, schedule, step, trace)
        if world.version != version:
            version = world.version
            note_parameters(world, trace, step)
        write(world, trace, wanted, contacts)
        if step % EVERY == 0 and step < steps:
            trace.snapshots[step] = world.snapshot()
        if step < steps:
            action = _chosen(policy, world)
            world.step(action)
            trace.actions.append(action)


def as_names(record: Iterable[str]) -> tuple[str, ...]:
    """Read the names of variables; a text is one name."""
    return (record,) if isinstance(record, str) else tuple(record)


def _chosen(policy: Policy, world: System) -> Floats:
    """Ask a policy for an action.

    Raises:
        ActionError: It did something else to the world, or gave no numbers.
    """
    before = world.version, world.index
    given = policy(world)
    if (world.version, world.index) != before:
        raise ActionError("a policy acts through its action only; put the rest into a plan", given)
    try:
        return np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise ActionError("an action is finite numbers", given) from None


def begin(
    world: System, seed: int, number: int, schedule: Schedule | Schedules, trace: Trace
) -> None:
    """Begin an episode, with what is due at its first instant.

    Args:
        world: Any; it is reset.
        seed: Of the noise.
        number: Of the episode within that noise.
        schedule: What is done.
        trace: Still empty.
    """
    world.reset(seed=seed, episode=number)
    intervene(world, schedule, 0, trace)


def intervene(world: System, schedule: Schedule | Schedules, step: int, trace: Trace) -> None:
    """Do what is due at an instant."""
    due: Any = schedule.due(world, step, trace.fired)
    if due:
        trace.audits[step] = world.do(due)


def note_parameters(world: System, trace: Trace, step: int) -> None:
    """Write down the values of parameters, and the structure if it is another one."""
    now = world.current()[0] if isinstance(world, World) else {}
    values = {name: np.array(now[name]) for name in world.static_names}
    trace.statics.append((step, values))
    if not trace.declarations or trace.declarations[-1][1].plan != world.compiled.plan:
        trace.declarations.append((step, world.compiled))


def write(world: System, trace: Trace, names: tuple[str, ...], contacts: bool = False) -> None:
    """Write down an instant, with what else was asked for."""
    trace.vectors.append(world.vector.copy())
    if names:
        there = names if names == (ALL,) else tuple(name for name in names if name in world.model)
        found = world.values() if names == (ALL,) else world.evaluate(there)
        for name in found if names == (ALL,) else there:
            trace.values.setdefault(name, []).append(np.array(found[name]))
    if contacts and isinstance(world, World):
        pairs = (tuple(sorted(c.bodies)) for c in world.backend.contacts() if c.force > 0.0)
        trace.touching.append(frozenset((one, other) for one, other in pairs))


def length(system: System, steps: int | None) -> int:
    """Give the number of control steps of an episode; that of the task if None.

    Raises:
        UnknownOption: It is no possible number.
        ModelError: The system has no number of its own.
    """
    if isinstance(system, Equations):
        return system.length(steps)
    return whole_number("steps", system.max_episode_length if steps is None else steps, least=1)


@final
@dataclass(frozen=True)
class Unit:
    """All that decides what will have happened.

    Attributes:
        seed: Of the noise.
        number: Of the episode within that noise.
        layers: Plans, each with the control step from which it counts.
        policy: Who acts; see ``rollout``.
        steps: How many control steps the episode has.
        names: Variables to write down at every instant.
        first: The control step at which it goes on; 0 for a new episode.
        past: What was before that.
        start: The world at that instant, before anything is done then; None for a new episode.
    """

    seed: int
    number: int
    layers: tuple[Layer, ...]
    policy: Any
    steps: int
    names: tuple[str, ...] = ()
    first: int = 0
    past: Trace = field(default_factory=Trace)
    start: Any = None

    def goes_on(self) -> Trace:
        """Give the past, to be gone on with."""
        trace = self.past.until(self.first)
        trace.values = {name: list(values) for name, values in self.past.values.items()}
        return trace

    def arrive(self, world: System) -> None:
        """Bring a world to the instant at which it goes on."""
        if self.start is None:
            world.reset(seed=self.seed, episode=self.number)
        else:
            world.restore(self.start)

    def lived(self, world: System, arrive: Callable[[System], None] | None = None) -> Trace:
        """Let it happen in a world by itself.

        Args:
            world: Any twin.
            arrive: Brings it to the first instant; ``Unit.arrive`` if None.

        Raises:
            InterventionError: An intervention was refused.
            ActionError: The policy gave no action.
        """
        schedule, trace = Schedule(self.layers), self.goes_on()
        (arrive or self.arrive)(world)
        intervene(world, schedule, self.first, trace)
        run(
            world,
            trace,
            schedule,
            self.acts(world),
            first=self.first,
            steps=self.steps,
            names=self.names,
        )
        return trace

    def ended(self, world: System) -> Trace | Exception:
        """Let it happen in a world by itself; give what stopped it, if something did."""
        try:
            return self.lived(world)
        except Exception as error:
            return error

    def acts(self, world: System | None = None) -> Policy:
        """Make the policy, for one life, in a world if it is known."""
        return as_policy(self.policy, world)
