"""What a part of a curriculum is told before it decides."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from scm_world._types import Value
from scm_world.errors import UnreadableFile
from scm_world.variables import Noise
from scm_world.world import World
from scm_world.world.compiled_task import CompiledTask

STREAM = "curriculum"
"""First word of the noise of curricula."""


@final
@dataclass
class Progress:
    """How far the learner has come in the stages of an adaptive part.

    Attributes:
        level: The present stage.
        recent: Whether the last episodes of this stage were successes.
    """

    level: int = 0
    recent: deque[bool] = field(default_factory=deque)


@final
@dataclass
class Memory:
    """What a curriculum remembers from one episode to the next.

    Attributes:
        episode: How many episodes have begun before the present one.
        stages: Progress of each adaptive part, by its key.
    """

    episode: int = 0
    stages: dict[str, Progress] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Write it as plain data."""
        return {
            "episode": self.episode,
            "stages": {
                key: {"level": kept.level, "recent": list(kept.recent)}
                for key, kept in self.stages.items()
            },
        }

    @classmethod
    def from_dict(cls, data: Any) -> Memory:
        """Read what ``as_dict`` wrote.

        Raises:
            UnreadableFile: It is something else.
        """
        try:
            stages = {
                str(key): Progress(int(kept["level"]), deque(map(bool, kept["recent"])))
                for key, kept in data["stages"].items()
            }
            return cls(int(data["episode"]), stages)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            advice = "give what state() gave"
            raise UnreadableFile("the state of a curriculum", repr(error), advice) from None


@final
@dataclass(frozen=True)
class Situation:
    """An instant at which a curriculum may intervene.

    Attributes:
        world: At this instant; a part looks at it and leaves it alone.
        episode: How many episodes the curriculum has seen begin before this one.
        step: The control step within the episode; 0 is the reset.
        memory: Of the curriculum.
        due: Whether what has no time of its own acts now.
        first: Where bodies come and go: what decides that, which is asked for before all else,
            so that the rest finds the bodies that there are then; else None.
        initial: Values at the beginning of the episode, before anything was done, of what parts
            ask for.
    """

    world: World
    episode: int
    step: int
    memory: Memory
    due: bool
    first: frozenset[str] | None = None
    initial: Mapping[str, Value] = field(default_factory=dict)

    @property
    def compiled(self) -> CompiledTask:
        """The structure that there is."""
        return self.world.compiled

    def values(self) -> Mapping[str, Value]:
        """Give the present value of every variable."""
        return self.world.values()

    def uniform(self, key: str) -> float:
        """Draw a number in [0, 1) from a noise of the curriculum's own.

        Args:
            key: Of the noise; one key gives one number at one instant.
        """
        noise: Noise = self.world.noise
        where: Any = {"episode": self.world.episode, "step": self.step}
        return float(noise.uniforms(f"{STREAM}/{key}", n=1, **where)[0, 0])

    def generator(self, key: str) -> np.random.Generator:
        """Give a generator of random numbers of the curriculum's own; see ``uniform``."""
        noise: Noise = self.world.noise
        where: Any = {"episode": self.world.episode, "step": self.step}
        words = noise.uniforms(f"{STREAM}/{key}/generator", n=2, **where)[0] * 2.0**53
        return np.random.default_rng([int(word) for word in words])
