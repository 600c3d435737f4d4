"""One episode that is to happen, as a value, and how it happens in a world by itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, final

from scm_world.queries.courses import Course, Layer
from scm_world.queries.equations import Equations, System
from scm_world.queries.policies import Policy, as_policy
from scm_world.queries.traces import Trace, intervene, run
from scm_world.world.start import whole_number


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
        course, trace = Course(self.layers), self.goes_on()
        (arrive or self.arrive)(world)
        intervene(world, course, self.first, trace)
        run(
            world,
            trace,
            course,
            self.acts(world),
            first=self.first,
            steps=self.steps,
            names=self.names,
            begun=True,
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
