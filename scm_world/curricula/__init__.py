"""Intervention curricula, for environments and protocols: each episode gets a plan.

A curriculum is a sentence::

    curriculum = Curriculum(
        together(
            goals("A"),
            during(range(1_000, 5_000), physics("B")),
            at_step(100, resample("floor_friction")),
        )
    )
    env = CurriculumEnv(gymnasium.make("scm_world/Pushing-v0"), curriculum)
"""

from scm_world.curricula.base import Memory, Part, Progress, Situation
from scm_world.curricula.combinations import (
    at_reset,
    at_step,
    during,
    every,
    in_turn,
    stages,
    together,
    weighted,
    when,
)
from scm_world.curricula.curriculum import Curriculum, as_curriculum
from scm_world.curricula.parts import (
    everything,
    follow,
    goals,
    interpolate,
    joints,
    looks,
    physics,
    poses,
    resample,
)
from scm_world.curricula.published import ACTORS, published_actor
from scm_world.curricula.vector import CurriculumVectorEnv, make_vec
from scm_world.curricula.wrapper import CurriculumEnv
from scm_world.variables import AB, A, B, Subset

__all__ = [
    "AB",
    "ACTORS",
    "A",
    "B",
    "Curriculum",
    "CurriculumEnv",
    "CurriculumVectorEnv",
    "Memory",
    "Part",
    "Progress",
    "Situation",
    "Subset",
    "as_curriculum",
    "at_reset",
    "at_step",
    "during",
    "every",
    "everything",
    "follow",
    "goals",
    "in_turn",
    "interpolate",
    "joints",
    "looks",
    "make_vec",
    "physics",
    "poses",
    "published_actor",
    "resample",
    "stages",
    "together",
    "weighted",
    "when",
]
