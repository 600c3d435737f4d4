"""How episodes run: the rollout loop, and its trace."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from scm_world._arguments import real_numbers, whole_number
from scm_world._types import Floats, Value
from scm_world.backends.base import ContactPoint
from scm_world.errors import ActionError, UnknownOption, blamed
from scm_world.policies.scripted import Policy, as_policy
from scm_world.queries.equations import Equations, System
from scm_world.queries.local import contacts_of
from scm_world.queries.plans import GroupedSchedules, Key, Schedule
from scm_world.world import Audit, Simulation
from scm_world.world.batch import Batch
from scm_world.world.mechanisms import Mechanisms, Rows

EVERY = 10
"""Control steps from one snapshot to the next."""

ALL = "*"
"""Stands for every variable."""


@final
@dataclass
class Trace:
    """Everything that a rollout records.

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
        touched: Pairs that touched in any physics step of each control step, where asked for.
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
    touched: list[frozenset[tuple[str, str]]] = field(default_factory=list)

    def until(self, step: int) -> Trace:
        """Copy what was before an instant, for a run that differs from there on."""
        return Trace(
            vectors=self.vectors[:step],
            statics=[pair for pair in self.statics if pair[0] < step],
            declarations=[pair for pair in self.declarations if pair[0] < step],
            actions=self.actions[:step],
            snapshots={at: kept for at, kept in self.snapshots.items() if at < step},
            fired={key: at for key, at in self.fired.items() if at < step},
            audits={at: audit for at, audit in self.audits.items() if at < step},
        )


def as_names(record: Iterable[str]) -> tuple[str, ...]:
    """Read the names of variables; a text is one name.

    Raises:
        UnknownOption: It is neither.
    """
    if not isinstance(record, Iterable):
        raise UnknownOption("names", record, ("a name", "names of variables"))
    return (record,) if isinstance(record, str) else tuple(record)


def _chosen(policy: Policy, world: System) -> Floats:
    """Ask a policy for an action.

    Raises:
        ActionError: It did something else to the world, or gave no numbers.
        FunctionFailure: It raised an error.
    """
    before = world.version, world.index
    with blamed(lambda: _who(policy, world)):
        given = policy(world)
    if (world.version, world.index) != before:
        raise ActionError("a policy acts through its action only; put the rest into a plan", given)
    try:
        return np.array(real_numbers(given))
    except (TypeError, ValueError):
        raise ActionError("an action is finite numbers", given) from None


def _pairs(contacts: Iterable[ContactPoint]) -> frozenset[tuple[str, str]]:
    found = (tuple(sorted(contact.bodies)) for contact in contacts)
    return frozenset((one, other) for one, other in found)


def _who(policy: Any, world: System) -> str:
    """Name a policy and the control step in which it is asked."""
    named = policy if hasattr(policy, "__qualname__") else type(policy)
    return f"in control step {world.index}, the policy {named.__qualname__!r}"


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
    """An episode to run: everything that decides its outcome.

    Attributes:
        seed: Of the noise.
        number: Of the episode within that noise.
        schedule: What is done, and when.
        policy: Who acts; see ``rollout``.
        steps: How many control steps the episode has.
        names: Variables to record at every instant; ``ALL`` for all.
        first: The control step from which it continues; 0 for a new episode.
        past: What was before that.
        start: The world at that instant, before anything is done then; None for a new episode.
        contacts: Whether to record which bodies touch, where there are bodies.
        listens: Whether to do so in each physics step, which is slower.
    """

    seed: int
    number: int
    schedule: Schedule | GroupedSchedules
    policy: Any
    steps: int
    names: tuple[str, ...] = ()
    first: int = 0
    past: Trace = field(default_factory=Trace)
    start: Any = None
    contacts: bool = False
    listens: bool = False

    def run(self, world: System, arrive: Callable[[System], None] | None = None) -> Trace:
        """Run it in one world.

        Args:
            world: Any twin.
            arrive: Brings the world to the first instant; a reset or ``start`` if None.

        Raises:
            InterventionError: An intervention was refused.
            ActionError: The policy gave no action.
        """
        running = Running(self, world)
        running.begin(arrive)
        run(running, self.first, self.steps)
        return running.trace

    def result(self, world: System) -> Trace | Exception:
        """Run it in one world; return its trace, or the exception that stopped it."""
        try:
            return self.run(world)
        except Exception as error:
            return error


def run(running: Running | RunningTogether, first: int, steps: int) -> None:
    """Run episodes from one instant to another: the only rollout loop of queries.

    Args:
        running: Episodes under way, at the instant ``first``, after its interventions; recorded
            up to that instant.
        first: Number of the first instant.
        steps: Number of the last one.
    """
    for step in range(first, steps + 1):
        if first < step < steps:
            running.intervene(step)
        running.record(step)
        if step < steps:
            running.act(step)


@final
class Running:
    """A unit under way in one world, or in equations that solve several episodes together.

    Args:
        unit: To run.
        world: To run it in.

    Attributes:
        trace: What it has left behind so far.
    """

    def __init__(self, unit: Unit, world: System) -> None:
        self.unit, self.world = unit, world
        self.policy: Any = as_policy(unit.policy, world)
        self.trace = unit.past.until(unit.first)
        self.trace.values = {name: list(values) for name, values in unit.past.values.items()}
        self._version = -1

    def begin(self, arrive: Callable[[System], None] | None = None) -> None:
        """Go to the first instant and do what is due then; see ``Unit.run``."""
        if arrive is not None:
            arrive(self.world)
        elif self.unit.start is None:
            self.world.reset(seed=self.unit.seed, episode=self.unit.number)
        else:
            self.world.restore(self.unit.start)
        self.intervene(self.unit.first)

    def intervene(self, step: int) -> None:
        """Do what is due at an instant."""
        due: Any = self.unit.schedule.due(self.world, step, self.trace.fired)
        if due:
            self.trace.audits[step] = self.world.do(due)

    def record(self, step: int) -> None:
        """Record an instant, and of some a snapshot."""
        self.note(step)
        if step % EVERY == 0 and step < self.unit.steps:
            self.trace.snapshots[step] = self.world.snapshot()

    def note(self, step: int) -> None:
        """Record the state, what else was asked for, and parameters that have changed."""
        world, trace = self.world, self.trace
        if world.version != self._version:
            self._version = world.version
            now = world.row if isinstance(world, Simulation) else {}
            values = {name: np.array(now[name]) for name in world.static_names}
            trace.statics.append((step, values))
            if not trace.declarations or trace.declarations[-1][1].plan != world.compiled.plan:
                trace.declarations.append((step, world.compiled))
        trace.vectors.append(world.vector.copy())
        names = self.unit.names
        if names:
            there = tuple(name for name in names if name in world.model)
            found = world.values() if names == (ALL,) else world.evaluate(there)
            for name in found if names == (ALL,) else there:
                trace.values.setdefault(name, []).append(np.array(found[name]))
        if self.unit.contacts and isinstance(world, Simulation):
            trace.touching.append(_pairs(c for c in world.backend.contacts() if c.force > 0.0))

    def act(self, step: int, action: Any = None) -> None:
        """Take a control step, with the action of the policy if none is given."""
        policy = self.policy if action is None else lambda _: action
        chosen = _chosen(policy, self.world)
        if self.unit.listens and isinstance(self.world, Simulation):
            steps = contacts_of(self.world, chosen)
            self.trace.touched.append(_pairs(contact for step in steps for contact in step))
        else:
            self.world.step(chosen)
        self.trace.actions.append(chosen)

    def forget(self) -> None:
        """Record parameters again at the next instant, since the trace was cut."""
        self._version = -1


@final
class RunningTogether:
    """Units under way in the rows of a batch; an error stops one of them, and no other one.

    Args:
        batch: Of as many worlds or more, whose tables have the names of the units.
        units: All with the same first control step, as many steps, the same names, and policies
            whose actions are known beforehand.
    """

    def __init__(self, batch: Batch, units: Sequence[Unit]) -> None:
        self._batch = batch
        self._rows = [Running(unit, batch.world(row)) for row, unit in enumerate(units)]
        self._errors: dict[int, Exception] = {}
        self._first, self._steps, self._names = units[0].first, units[0].steps, units[0].names
        self._goes_on = np.arange(len(batch)) < len(units)
        self._pending = np.zeros(len(batch), dtype=np.bool_)  # stepped, and not recorded
        n_actions = self._rows[0].world.compiled.n_actions
        self._commands = np.zeros((self._steps, len(batch), n_actions))
        self._numbers: list[list[Floats]] = [[] for _ in units]  # of rows, not in the trace yet
        self._mechanisms: dict[int, Mechanisms] = {}  # of the rows that have such numbers

    def begin(self) -> None:
        """Bring every world to the first instant."""
        for row in range(len(self._rows)):
            self._alone(row, self._first)

    def intervene(self, step: int) -> None:
        """Do what is due at an instant."""
        for row in np.flatnonzero(self._goes_on).tolist():
            one = self._rows[row]
            schedule: Any = one.unit.schedule
            if schedule.concerns(one.world, step, one.trace.fired):
                self._alone(row, step)

    def record(self, step: int) -> None:
        """Record an instant of those rows that have not been recorded by themselves."""
        rows = np.flatnonzero(self._pending)
        for table, members in self._batch.tables(rows) if len(rows) else ():
            for row, mine in zip(members.tolist(), table.numbers[members], strict=True):
                self._mechanisms[row] = table.mechanisms
                self._numbers[row].append(mine)

    def act(self, step: int) -> None:
        """Take a control step in all rows."""
        if self._goes_on.any():
            self._batch.advance(self._commands[step], self._goes_on)
        self._pending[:] = self._goes_on

    def results(self) -> list[Trace | Exception]:
        """Return what each unit leaves behind, or the exception that stopped it."""
        for row in range(len(self._rows)):
            self._flush(row)
        return [self._errors.get(row, one.trace) for row, one in enumerate(self._rows)]

    def _alone(self, row: int, step: int) -> None:
        """Reset or intervene in one world alone, record the instant, and ask for what follows."""
        one = self._rows[row]
        self._flush(row)
        self._pending[row] = False
        self._batch.world(row)
        try:
            if step == self._first:
                one.begin()
            else:
                one.intervene(step)
            one.note(step)
            with blamed(lambda: _who(one.policy, one.world)):
                given = one.policy.ahead(one.world, one.world.index, self._steps - step)
            for command, action in zip(self._commands[step:, row], given, strict=True):
                command[:] = one.world.compiled.clipped(action)
            one.trace.actions[step:] = np.array(given)
        except Exception as error:  # it ends this unit, and no other one
            self._errors[row] = error
            self._goes_on[row] = False

    def _flush(self, row: int) -> None:
        """Move the numbers of a row into its trace."""
        if not self._numbers[row]:
            return
        mechanisms, trace = self._mechanisms[row], self._rows[row].trace
        rows, self._numbers[row] = Rows(mechanisms, np.array(self._numbers[row])), []
        trace.vectors.extend(rows.numbers[:, : mechanisms.state_size].copy())
        for name in self._names:
            if name in rows:
                trace.values[name].extend(np.array(rows[name]))
