"""Episodes: running, recording, and counterfactuals."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, Self, final

import numpy as np
from numpy.typing import ArrayLike

from scm_world._arguments import real_numbers, typed, whole_number
from scm_world._patterns import as_names
from scm_world._types import Floats, Value
from scm_world.backends.base import ContactPoint
from scm_world.errors import (
    ActionError,
    InterventionError,
    UnknownOption,
    UnknownVariable,
    blamed,
)
from scm_world.models.camera import Camera
from scm_world.models.scene import Scene
from scm_world.policies.scripted import Policy, as_policy
from scm_world.policies.scripted import Sequence as Given
from scm_world.queries.local import contacts_of
from scm_world.queries.plans import Memory, Plan, check_names
from scm_world.variables import Intervention, Natural
from scm_world.world import Audit, CausalSystem

if TYPE_CHECKING:
    from scm_world.policies.scripted import AnyPolicy
    from scm_world.queries.twins import Twins
    from scm_world.world.snapshot import Snapshot

EVERY = 10
"""Number of control steps between snapshots."""

ALL = "*"
"""Stands for every variable."""

Pairs = frozenset[tuple[str, str]]
"""Pairs of bodies."""


@final
@dataclass(frozen=True)
class Unit:
    """An episode to run, with everything that determines its outcome."""

    seed: int
    number: int  # of the episode, within the noise of the seed
    plan: Plan
    policy: AnyPolicy  # see ``rollout``
    steps: int
    names: tuple[str, ...] = ()  # recorded at every instant; ALL for all variables and contacts
    first: int = 0  # control step from which it continues
    past: Episode | None = None  # the episode before that; None for a new one
    start: Snapshot | None = (
        None  # snapshot at that instant, before interventions; None for a new episode
    )
    ends: bool = False  # whether the names are recorded at the first and last instants only
    listens: bool = False  # whether to record contacts in every physics step, which is slower

    def run(self, world: CausalSystem, twins: Twins | None = None) -> Episode:
        """Run the episode in a world; queries about the episode run on ``twins``."""
        episode = Episode._of(twins, self, world)
        episode._begin()
        run(episode, self.first, self.steps)
        return episode._ended()


class Running(Protocol):
    """One or several episodes that are run together."""

    def _intervene(self, step: int) -> None: ...

    def _record(self, step: int) -> None: ...

    def _act(self, step: int) -> None: ...


def run(running: Running, first: int, steps: int) -> None:
    """Run one or several episodes from one instant to another: the only rollout loop of queries.

    They are at the instant ``first``, after its interventions, and are recorded up to it.
    """
    for step in range(first, steps + 1):
        if first < step < steps:
            running._intervene(step)
        running._record(step)
        if step < steps:
            running._act(step)


class Era(NamedTuple):
    """Structure and parameters, from the instant ``step`` on."""

    step: int
    compiled: Any
    statics: dict[str, Value]


@final
@dataclass(eq=False, repr=False)
class Episode:
    """One unit of a system: its noise, its interventions and its states.

    ``world.rollout`` returns a finished episode. ``world.live`` returns a live one, on a twin of
    the world: ``step`` and ``do`` continue it, and ``split`` branches it. Replays and
    counterfactuals are bit-identical.

    Attributes:
        twins: Twins of the system of the episode.
        unit: The unit.
        world: The twin at the present instant of a live episode; change it through the episode
            only.
        vectors: State at each instant, after interventions.
        eras: Structure and parameters, from each instant on at which they changed.
        taken: The policy's actions, shape (n_actions,) each.
        snapshots: Snapshots at some instants, after interventions.
        memory: What its plan has to know of its past.
        audits: Audits of interventions, by control step.
        values: Values of the recorded variables, at each instant.
        touching: Pairs of bodies that touch at each instant.
        touched: Pairs that touched in any physics step of each control step.

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

    twins: Any
    unit: Unit
    world: Any = None
    vectors: list[Floats] = field(default_factory=list)
    eras: list[Era] = field(default_factory=list)
    taken: list[Floats] = field(default_factory=list)
    snapshots: dict[int, Any] = field(default_factory=dict)
    memory: Memory = field(default_factory=Memory)
    audits: dict[int, Audit] = field(default_factory=dict)
    values: dict[str, list[Value]] = field(default_factory=dict)
    touching: list[Pairs] = field(default_factory=list)
    touched: list[Pairs] = field(default_factory=list)
    remembers: bool = field(default=True, init=False)  # whether the memory is complete
    _policy: Any = field(default=None, init=False)
    _version: int = field(default=-1, init=False)
    _lease: ExitStack = field(default_factory=ExitStack, init=False)
    _arrival: Floats | None = field(default=None, init=False)  # the present, before interventions
    _settled: Plan = field(default=Plan(), init=False)  # without interventions at the present
    _all: Episode | None = field(default=None, init=False)

    @classmethod
    def _of(cls, twins: Twins | None, unit: Unit, world: CausalSystem) -> Self:
        """Return a live episode in a world, with the past of its unit."""
        episode = cls(twins, unit) if unit.past is None else unit.past.until(unit.first)
        episode.twins, episode.unit, episode.world = twins, unit, world
        episode.policy = unit.policy
        episode._settled = unit.plan if unit.past is None else unit.past.plan
        return episode

    @classmethod
    def _live(cls, twins: Twins, unit: Unit) -> Self:
        """Begin a live episode in a twin, which it keeps until ``close``."""
        with ExitStack() as lease:
            twin = lease.enter_context(twins.twin())
            episode = cls._of(twins, replace(unit, steps=sys.maxsize), twin)
            episode._begin()
            episode._lease = lease.pop_all()
        return episode

    def until(self, step: int) -> Self:
        """Return a copy of the instants before a step, for an episode that branches there."""
        step = whole_number("step", step, least=0, most=len(self.vectors))

        def before(found: dict[Any, Any]) -> dict[Any, Any]:
            return {at: kept for at, kept in found.items() if at < step}

        return replace(
            self,
            world=None,
            vectors=self.vectors[:step],
            eras=[era for era in self.eras if era.step < step],
            taken=self.taken[:step],
            snapshots=before(self.snapshots),
            memory=self._remembered().until(step),
            audits=before(self.audits),
            values={name: values[:step] for name, values in self.values.items()},
            touching=[],
            touched=[],
        )

    def _remembered(self) -> Memory:
        """Return what its plan has to know of its past; one that ran with others runs again."""
        if not self.remembers:
            self.memory, self.remembers = self.twins.episode(self._again()).memory, True
        return self.memory

    def __getstate__(self) -> dict[str, Any]:
        if self.world is not None:
            allowed = ("a finished one, such as its episode()",)
            raise UnknownOption("episode to copy or pickle", "a live one", allowed)
        return vars(self)

    # --- running ------------------------------------------------------------------------------

    def _begin(self) -> None:
        """Restore the first instant and apply its interventions."""
        if self.unit.start is None:
            self.world.reset(seed=self.unit.seed, episode=self.unit.number)
        else:
            self.world.restore(self.unit.start)
            self._arrival = self.world.vector.copy()
        self._intervene(self.unit.first)

    def _intervene(self, step: int) -> None:
        """Apply the interventions of an instant."""
        audit = self.unit.plan._act(self.world, step, self.memory, self.world.do)
        if audit is not None:
            self.audits[step] = audit

    def _record(self, step: int) -> None:
        """Record an instant, with a snapshot every ``EVERY`` steps."""
        self._note(step)
        if step % EVERY == 0 and step < self.unit.steps:
            self.snapshots[step] = self.world.snapshot()

    def _note(self, step: int, *, ready: bool = False) -> None:
        """Record the state, changed parameters and the variables, which may be computed already."""
        world, names = self.world, self.unit.names
        if world.version != self._version:
            self._version = world.version
            now = world.row if world.static_names else {}
            statics = {name: np.array(now[name]) for name in world.static_names}
            self.eras.append(Era(step, world.compiled, statics))
        self.vectors.append(world.vector.copy())
        if names and not (self.unit.ends and 0 < step < self.unit.steps):
            there = tuple(name for name in names if name in world.model)
            found = world.row if ready else world.evaluate(None if names == (ALL,) else there)
            for name in world.model if names == (ALL,) else there:
                self.values.setdefault(name, []).append(np.array(found[name]))
        if names == (ALL,):
            self.touching.append(_pairs(c for c in world.contacts() if c.force > 0.0))

    def _act(self, step: int, action: ArrayLike | None = None) -> None:
        """Take a control step with an action; the policy's action if None."""
        chosen = _chosen(self.policy if action is None else lambda _: action, self.world)
        if self.unit.listens:
            steps = contacts_of(self.world, chosen)
            self.touched.append(_pairs(contact for step in steps for contact in step))
        else:
            self.world.step(chosen)
        self._complete()
        self.taken.append(chosen)

    def _complete(self) -> None:
        """Write the command of a control step, and what follows from it, into its instant."""
        places = self.world.compiled.slices
        for name, value in self.world.decided_values().items():
            if name in places:
                self.vectors[-1][..., places[name]] = np.reshape(
                    value, (*self.vectors[-1].shape[:-1], -1)
                )
            if name in self.values:
                self.values[name][-1] = np.array(value)

    def _ended(self) -> Self:
        """Detach the finished episode from its world."""
        self.world = self._policy = None
        return self

    # --- live episodes ------------------------------------------------------------------------

    def _under_way(self) -> Any:
        if self.world is None:
            raise UnknownOption("episode", "a finished one", ("one that world.live() began",))
        return self.world

    @property
    def policy(self) -> Any:
        """The policy of a live episode; see ``rollout``. It can be replaced at any time."""
        return self._policy

    @policy.setter
    def policy(self, given: AnyPolicy) -> None:
        self._policy = as_policy(given, self.world)

    @property
    def held(self) -> dict[str, Any]:
        """The interventions in force now, including those with open windows, by name."""
        found = dict(self._under_way().graph.interventions)
        return found | self.plan._windows(self.steps, self.memory)

    def do(self, request: Mapping[str, Any]) -> Audit | None:
        """Intervene at the present instant of a live episode; see ``World.do``.

        Args:
            request: Values or interventions by variable, also with times from now on, such as
                ``Hard(0.3, during=(5, 10))``, in control steps of the episode.

        Returns:
            The audit; None if all interventions are due later.

        Raises:
            InterventionError: The request was refused; nothing has changed.
        """
        world, step = self._under_way(), self.steps
        model = world.model
        more = Plan().then(request, model, at=step)
        check_names(world, more)
        plan, memory = self.plan.then(more, model, at=step, done=True), self.memory.copy()
        now = [n for n, acts in more.items() if any(_begins(act, step) for act in acts)]
        for name in now:
            memory.forget(name, step)  # each draw at an instant has its own noise
        audit = plan._act(world, step, memory, world.do, now) if now else None
        if audit is not None:
            self.audits[step] = audit
            drawn = {name: one.requested for name, one in audit.targets.items()}
            parts = {
                name: tuple(_drawn(act, step, drawn.get(name)) for act in acts)
                for name, acts in more.items()
            }
            plan = self.plan.then(Plan._of(parts), model, at=step, done=True)
        self.unit, self.memory = replace(self.unit, plan=plan), memory
        return audit

    def step(self, action: ArrayLike | None = None) -> Floats:
        """Take a control step, and apply the interventions of the next instant.

        Args:
            action: The action, shape (n_actions,); the policy's action if None.

        Returns:
            The action before clipping.

        Raises:
            ActionError: The action is invalid; nothing has changed.
            EngineFailure: The backend lost the state; begin another episode.
            InterventionError: An intervention of the next instant was refused. The step is taken,
                and the targets are released.
        """
        world, step = self._under_way(), self.steps
        try:
            self._record(step)
            self._act(step, action)
        except Exception:
            before = self.until(step)
            self.vectors, self.values, self.eras = before.vectors, before.values, before.eras
            self._version = -1
            raise
        self._arrival, self._settled = world.vector.copy(), self.plan
        try:
            self._intervene(step + 1)
        except InterventionError:
            due = self.plan._due(world, step + 1, self.memory.copy())
            self.do({str(name): Natural() for name in due})
            raise
        return self.taken[-1]

    def split(self, do: Mapping[str, Any] | None = None, *, at: int | None = None) -> Self:
        """Return a counterfactual branch of a live episode: the same noise, past and plan.

        With the same actions, it is equal to ``episode().counterfactual(do, at=at)``.

        Args:
            do: The intervention; without a time it is applied at that instant.
            at: The control step; the present one if None.

        Raises:
            InterventionError: The intervention was refused.
            UnknownOption: The control step does not exist.
        """
        self._under_way()
        place = self.steps if at is None else _instant(at, self.steps)
        (unit,) = self._branches(replace(self.unit, policy=self.policy), place, [do])
        return self._live(self.twins, unit)

    def episode(self) -> Self:
        """Return the finished episode up to now, without interventions at the present instant.

        Raises:
            UnknownOption: No control step has been taken.
        """
        if self.world is None:
            return self
        if self._arrival is None:
            raise UnknownOption("number of steps", 0, ("1 or more: call step() first",))
        found = self.until(self.steps)._ended()
        found.vectors.append(self._arrival)
        found.unit = replace(found._again(), plan=self._settled, names=self.unit.names)
        return found

    def close(self) -> None:
        """Return the twin. The episode can still be read; closing twice is harmless."""
        self._lease.close()

    # --- reading ------------------------------------------------------------------------------

    @property
    def seed(self) -> int:
        """The seed of the noise."""
        return self.unit.seed

    @property
    def number(self) -> int:
        """The number of the episode within that noise."""
        return self.unit.number

    @property
    def plan(self) -> Plan:
        """The interventions, with their times."""
        return self.unit.plan

    @property
    def steps(self) -> int:
        """Number of finished control steps."""
        return len(self.taken)

    @property
    def actions(self) -> Floats:
        """The policy's actions before clipping, shape (steps, n_actions)."""
        compiled = self.eras[0].compiled if self.eras else self.world.compiled
        return np.array(self.taken).reshape(self.steps, compiled.n_actions)

    @property
    def events(self) -> Mapping[str, int]:
        """Control steps of the events that triggered interventions, by variable."""
        return {name: step for (name, *_), step in self.memory.fired.items()}

    @property
    def names(self) -> tuple[str, ...]:
        """All variables of the structure at the end."""
        return tuple(self.eras[-1].compiled.model)

    def __len__(self) -> int:
        return self.steps

    def __getitem__(self, name: str) -> Value:
        """Return a variable at every instant, shape ``(steps + 1, *shape)``.

        Row t is instant t, after its interventions, and the command of step t, which is chosen
        there and moves the states of row t + 1 (lag 1). At the end no command is chosen, and the
        last row repeats the last one. Variables of bodies that were added or removed have fewer
        instants. A live episode has the instants before the present.

        Raises:
            UnknownVariable: No variable has this name.
        """
        if not isinstance(name, str):
            raise UnknownVariable(name, self.names)
        if name in self.values:
            return np.asarray(self.values[name])
        first = self.eras[0].compiled
        if name in first.slices and all(era.compiled.plan == first.plan for era in self.eras):
            return np.asarray(first.read(name, np.asarray(self.vectors)))
        if all(name in era.statics for era in self.eras):
            steps = [era.step for era in self.eras] + [len(self.vectors)]
            return np.repeat([era.statics[name] for era in self.eras], np.diff(steps), axis=0)
        if not any(name in era.compiled.model for era in self.eras):
            raise UnknownVariable(name, self.names)
        return np.array(self.replay().values[name][: len(self.vectors)])

    def final(self, name: str) -> Value:
        """Return a variable at the end; see ``__getitem__``."""
        return np.asarray(self[name][-1])

    def replay(self) -> Self:
        """Replay the episode, and record every variable and every contact."""
        if self._all is None or self.steps > self._all.steps:  # a live one has gone on
            self.twins.require_exact("a replay (record what is read, and nothing is replayed)")
            self._all = self.twins.episode(replace(self._again(), names=(ALL,)))
        return self._all

    def __eq__(self, other: object) -> bool:
        """Return whether all states, parameters and actions are bit-identical."""
        if not isinstance(other, Episode) or len(self.vectors) != len(other.vectors):
            return False
        pairs = zip((*self.vectors, *self.taken), (*other.vectors, *other.taken), strict=True)
        if not all(a.tobytes() == b.tobytes() for a, b in pairs):
            return False
        both = ((self.era(t).statics, other.era(t).statics) for t in range(len(self.vectors)))
        return all(
            one.keys() == another.keys() and all(np.array_equal(one[n], another[n]) for n in one)
            for one, another in both
            if one is not another
        )

    __hash__ = None  # type: ignore[assignment] # compared by content

    def __repr__(self) -> str:
        return f"Episode({self.steps} steps, seed {self.seed}, number {self.number}, {self.plan})"

    def era(self, step: int) -> Era:
        """Return the structure and the parameters of an instant."""
        step = whole_number("step", step, least=0, most=self.steps)
        (*_, found) = (era for era in self.eras if era.step <= step)
        return found

    def scene(self, step: int) -> tuple[Scene, tuple[Camera, ...]]:
        """Build the scene of an instant for rendering, without a rerun.

        Args:
            step: Number of the instant, as in ``__getitem__``.

        Returns:
            The scene, and the cameras whose poses are variables.

        Raises:
            UnknownOption: The instant does not exist, or the episode is one of equations.
        """
        _, compiled, values = self.era(step)
        if not hasattr(compiled, "describe"):
            raise UnknownOption("picture", "an episode of equations", ("one of a world",))
        state = compiled.empty_state(np.array(self.vectors[step]))
        return compiled.describe(values, state), compiled.composition.cameras(values)

    # --- counterfactuals ----------------------------------------------------------------------

    @typed
    def counterfactual(
        self,
        do: Mapping[str, Any] | None = None,
        *,
        at: int = 0,
        actions: AnyPolicy = "replay",
        record: Iterable[str] = (),
    ) -> Self:
        """Restore an instant, intervene, and continue with the same noise.

        Args:
            do: The intervention; without a time it is applied at the instant ``at``.
            at: The control step.
            actions: ``"replay"`` for the same actions, or a policy from there on.
            record: Variables to record during the run; others are computed by replaying it.

        Returns:
            The counterfactual episode; bit-identical to this one without an intervention.

        Raises:
            InterventionError: The intervention was refused.
            UnknownOption: The control step does not exist.
        """
        return self.worlds([{} if do is None else do], at=at, actions=actions, record=record)[0]

    @typed
    def worlds(
        self,
        dos: Iterable[Mapping[str, Any]],
        *,
        at: int = 0,
        actions: AnyPolicy = "replay",
        record: Iterable[str] = (),
        workers: int | None = None,
    ) -> tuple[Self, ...]:
        """Run counterfactuals with the same noise, one for each intervention.

        Args:
            dos: The intervention of each counterfactual.
            at: The control step, as in ``counterfactual``.
            actions: ``"replay"`` or a policy.
            record: Variables to record during the run.
            workers: Number of threads, see ``Setting``; the result does not depend on it.
        """
        at, names = _instant(at, max(self.steps - 1, 0)), as_names(record)
        if not isinstance(dos, Iterable) or isinstance(dos, Mapping | str):
            raise UnknownOption("dos", dos, ("a list of interventions",))
        unit = replace(self._again(), names=names)
        if not isinstance(actions, str) or actions != "replay":
            unit = replace(unit, policy=actions)
        units = self._branches(unit, at, dos)
        return tuple(self.twins.run(units, tuple, workers)) if units else ()

    def _again(self) -> Unit:
        """Return the unit that repeats this episode."""
        return Unit(self.seed, self.number, self.plan, Given(self.taken), self.steps)

    def _branches(self, unit: Unit, at: int, dos: Iterable[Mapping[str, Any] | None]) -> list[Unit]:
        """Return units that continue this episode from an instant under interventions."""
        self.twins.require_exact("a counterfactual")
        models = [era.compiled.model for era in self.eras if era.step < max(at, 1)]
        names = tuple(name for name in unit.names if all(name in model for model in models))
        past, start = self.until(at), self._before(at) if at else None
        past.values = {name: list(self[name][:at]) for name in names}
        unit = replace(unit, names=names, first=at, past=past, start=start)
        model = models[-1] if models else self.world.model
        return [replace(unit, plan=self.plan.then(do, model, at=at)) for do in dos]

    def _before(self, at: int) -> Any:
        """Return a snapshot of an instant, before its interventions."""
        near = max((step for step in self.snapshots if step < at), default=None)
        with self.twins.twin() as world:
            running = Episode._of(None, replace(self._again(), steps=at), world)
            running.memory = self._remembered().until(at)
            if near is None:
                running._begin()
            else:
                world.restore(self.snapshots[near])  # after the interventions of its instant
            run(running, near or 0, at)
            self.snapshots = {**self.snapshots, **running.snapshots}
            return world.snapshot()


def _instant(at: object, last: int) -> int:
    if isinstance(at, bool) or not isinstance(at, int | np.integer) or not 0 <= at <= last:
        raise UnknownOption("at", at, (f"a control step from 0 to {last}",))
    return int(at)


def _chosen(policy: Policy, world: CausalSystem) -> Floats:
    """Return the action of a policy; refuse policies that change the world otherwise."""
    before = world.version, world.index
    with blamed(lambda: who(policy, world)):
        given = policy(world)
    if (world.version, world.index) != before:
        raise ActionError("a policy acts through its action only; put the rest into a plan", given)
    try:
        return np.array(real_numbers(given))
    except (TypeError, ValueError):
        raise ActionError("an action is finite numbers", given) from None


def who(policy: object, world: CausalSystem) -> str:
    """Return the name of a policy with the control step, for errors."""
    named = policy if hasattr(policy, "__qualname__") else type(policy)
    return f"in control step {world.index}, the policy {named.__qualname__!r}"


def _pairs(contacts: Iterable[ContactPoint]) -> Pairs:
    found = (tuple(sorted(contact.bodies)) for contact in contacts)
    return frozenset((one, other) for one, other in found)


def _begins(act: Intervention, step: int) -> bool:
    return act.time is None or act.time.start == step


def _drawn(act: Intervention, step: int, requested: Any) -> Intervention:
    """Return a draw with its present noise stream or number; other interventions unchanged."""
    if not _begins(act, step):
        return act
    again = act.time is not None and act.time.every is not None
    return act.drawn_as(requested, again=again)
