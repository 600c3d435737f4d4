"""One episode that is to happen, as a value, and how it happens in a world by itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, final

from scm_world.queries.courses import Course, Layer
from scm_world.queries.policies import Policy, as_policy
from scm_world.queries.traces import Trace, intervene, run
from scm_world.world import World, WorldSnapshot


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
    start: WorldSnapshot | None = None

    def goes_on(self) -> Trace:
        """Give the past, to be gone on with."""
        trace = self.past.until(self.first)
        trace.values = {name: list(values) for name, values in self.past.values.items()}
        return trace

    def arrive(self, world: World) -> None:
        """Bring a world to the instant at which it goes on."""
        if self.start is None:
            world.reset(seed=self.seed, episode=self.number)
        else:
            world.restore(self.start)

    def lived(self, world: World, arrive: Callable[[World], None] | None = None) -> Trace:
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

    def ended(self, world: World) -> Trace | Exception:
        """Let it happen in a world by itself; give what stopped it, if something did."""
        try:
            return self.lived(world)
        except Exception as error:
            return error

    def acts(self, world: World | None = None) -> Policy:
        """Make the policy, for one life, in a world if it is known."""
        return as_policy(self.policy, None if world is None else world.task)
