"""Intervention curricula, for environments and protocols: each episode gets a plan.

A curriculum is a sentence::

    curriculum = together(
        goals("A"),
        during(range(1_000, 5_000), physics("B")),
        at_step(100, resample("floor_friction")),
    )
    env = CurriculumEnv(gymnasium.make("scm_world/Pushing-v0"), curriculum)
"""

from scm_world.curricula.curriculum import Curriculum, Progress, Situation
from scm_world.curricula.parts import (
    at_step,
    during,
    everything,
    follow,
    goals,
    joints,
    looks,
    physics,
    poses,
    resample,
    stages,
    timed,
    together,
)
from scm_world.curricula.wrapper import CurriculumEnv, CurriculumState, LevelsEnv, make_vec
from scm_world.variables import AB, A, B, Subset

__all__ = [
    "AB",
    "A",
    "B",
    "Curriculum",
    "CurriculumEnv",
    "CurriculumState",
    "LevelsEnv",
    "Progress",
    "Situation",
    "Subset",
    "at_step",
    "during",
    "everything",
    "follow",
    "goals",
    "joints",
    "looks",
    "make_vec",
    "physics",
    "poses",
    "resample",
    "stages",
    "timed",
    "together",
]
