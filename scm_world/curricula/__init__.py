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

from scm_world.curricula.curriculum import Curriculum
from scm_world.curricula.parts import (
    Part,
    Progress,
    Situation,
    at_reset,
    at_step,
    during,
    every,
    everything,
    follow,
    goals,
    in_turn,
    interpolate,
    joints,
    looks,
    physics,
    poses,
    published_actor,
    resample,
    stages,
    together,
    weighted,
    when,
)
from scm_world.curricula.wrapper import (
    CurriculumEnv,
    CurriculumState,
    CurriculumVectorEnv,
    make_vec,
)
from scm_world.variables import AB, A, B, Subset

__all__ = [
    "AB",
    "A",
    "B",
    "Curriculum",
    "CurriculumEnv",
    "CurriculumState",
    "CurriculumVectorEnv",
    "Part",
    "Progress",
    "Situation",
    "Subset",
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
