"""A world that can be gone back to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import final

import numpy as np

from scm_world._types import Floats, Value
from scm_world.backends.base import EngineSnapshot
from scm_world.variables import Intervention


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
        variables: Names of all variables, to tell worlds apart.
        at_start: Whether no step has been made yet.
    """

    engine: EngineSnapshot
    static: Mapping[str, Value]
    interventions: Mapping[str, Intervention] = field(default_factory=dict)
    previous: Mapping[str, Value] = field(default_factory=dict)
    action: Floats = field(default_factory=lambda: np.zeros(9))
    index: int = 0
    seed: int = 0
    episode: int = 0
    variables: tuple[str, ...] = ()
    at_start: bool = False
