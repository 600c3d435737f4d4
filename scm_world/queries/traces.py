"""What a rollout leaves behind, and the loop that makes it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from scm_world._types import Floats, Value
from scm_world.errors import ActionError
from scm_world.queries.courses import Course, Courses, Key
from scm_world.queries.equations import System
from scm_world.queries.policies import Policy
from scm_world.world import Audit, World

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
    course: Course | Courses,
    policy: Policy,
    *,
    first: int,
    steps: int,
    names: Iterable[str] = (),
    contacts: bool = False,
    begun: bool = False,
) -> None:
    """Go on with a world, and write down what happens.

    Args:
        world: At the instant ``first``, before anything of the course is done there.
        trace: To go on with; it ends before that instant.
        course: What is done.
        policy: Who acts.
        first: Number of the first instant.
        steps: Number of the last one.
        names: Variables to write down at every instant; ``ALL`` for all.
        contacts: Whether to write down which bodies touch, where there are bodies.
        begun: Whether what is due at ``first`` has been done already.
    """
    wanted = tuple(names)
    version = -1
    for step in range(first, steps + 1):
        if (step < steps or step == first) and not (begun and step == first):
            intervene(world, course, step, trace)
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


def begin(world: System, seed: int, number: int, course: Course | Courses, trace: Trace) -> None:
    """Begin an episode, with what is due at its first instant.

    Args:
        world: Any; it is reset.
        seed: Of the noise.
        number: Of the episode within that noise.
        course: What is done.
        trace: Still empty.
    """
    world.reset(seed=seed, episode=number)
    intervene(world, course, 0, trace)


def intervene(world: System, course: Course | Courses, step: int, trace: Trace) -> None:
    """Do what is due at an instant."""
    due: Any = course.due(world, step, trace.fired)
    if due:
        trace.audits[step] = world.do(due)


def note_parameters(world: System, trace: Trace, step: int) -> None:
    """Write down the values of parameters, and the structure if it is another one."""
    now = world.current()[0] if isinstance(world, World) else {}
    values = {name: np.array(now[name]) for name in world.static_names}
    trace.statics.append((step, values))
    if not trace.declarations or trace.declarations[-1][1].plan != world.declaration.plan:
        trace.declarations.append((step, world.declaration))


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
