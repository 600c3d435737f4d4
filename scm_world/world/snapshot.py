"""A world that can be gone back to."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from scm_world._types import Floats, Value
from scm_world.backends.base import EngineSnapshot
from scm_world.variables import Intervention
from scm_world.world.family import Family
from scm_world.world.proposal import Instant, Requests


@final
@dataclass(frozen=True)
class SavedInstant:
    """An instant without its model, of which only the interventions are kept."""

    interventions: Mapping[str, Intervention]
    static: Mapping[str, Value]
    vector: Floats
    index: int
    requests: Requests
    at_start: bool
    plan: Hashable = None

    @classmethod
    def of(cls, instant: Instant) -> SavedInstant:
        """Save an instant."""
        return cls(
            instant.model.interventions,
            dict(instant.static),
            instant.state.vector.copy(),
            instant.index,
            dict(instant.requests),
            instant.at_start,
            instant.declaration.plan,
        )

    def instant(self, family: Family) -> Instant:
        """Give the instant back."""
        declaration = family.declaration(self.plan)
        state = declaration.empty_state(self.vector.copy())
        held = declaration.model.with_interventions(self.interventions)
        return Instant(
            declaration,
            held,
            self.static,
            state,
            self.index,
            dict(self.requests),
            self.at_start,
        )


@final
@dataclass(frozen=True)
class WorldSnapshot:
    """All that decides how a world goes on: physics, causes, noise, clock and memory.

    Attributes:
        engine: The engine's part.
        static: Values of everything that physics does not move.
        interventions: What ``do`` holds.
        previous: Values of one control step ago.
        action: The last action.
        index: The control step.
        seed: Of the noise.
        episode: Number of the episode.
        world: Task, options and names of all variables, to tell worlds apart.
        instant: What was done at this instant so far, and where it began.
        plan: What stands in the world.
        memory: What a world of another kind remembers besides.
    """

    engine: EngineSnapshot
    static: Mapping[str, Value]
    interventions: Mapping[str, Intervention] = field(default_factory=dict)
    previous: Mapping[str, Value] = field(default_factory=dict)
    action: Floats = field(default_factory=lambda: np.zeros(0))
    index: int = 0
    seed: int = 0
    episode: int = 0
    world: tuple[Any, ...] = ()
    instant: SavedInstant | None = None
    plan: Hashable = None
    memory: Any = None
