"""The worlds in which an agent is trained."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

from gymnasium.vector import AutoresetMode

from scm_world.backends import BACKENDS
from scm_world.curricula import make_vec
from scm_world.env import IDS
from scm_world.env.batched.choice import fastest
from scm_world.errors import UnknownOption
from scm_world.training.episodes import Episodes, ScaledRewards
from scm_world.training.recipe import Recipe, curriculum_of
from scm_world.training.sb3 import sb3_vec_env

ENV_IDS = {task: name for name, task in IDS.items()}
"""The registered environment of each task."""

SEEDS = 1_000_003
"""Between the noises of two seeds; a seed has one for each world."""


@final
@dataclass(frozen=True)
class Worlds:
    """Many worlds for Stable-Baselines3, and what can be asked of them besides.

    Attributes:
        vec_env: What the algorithm takes.
        episodes: That are played in them.
        scaled: What divides rewards, if something does.
        length: Control steps of an episode.
        engine: Name and version of the engine.
    """

    vec_env: Any
    episodes: Episodes
    scaled: ScaledRewards | None
    length: int
    engine: str

    def begin_with(self, seed: int) -> None:
        """Let the next reset begin with the noise of a seed, another one in each world."""
        self.vec_env.seed(seed * SEEDS)

    def close(self) -> None:
        """Free the engines."""
        self.vec_env.close()


def make_worlds(recipe: Recipe, *, backend: str, seed: int, threads: int | None = None) -> Worlds:
    """Make the worlds of a recipe; the first reset begins with the noise of the seed.

    Args:
        recipe: How an agent is trained.
        backend: Name of the engine.
        seed: Of everything that is drawn.
        threads: Of an engine that steps many worlds in one call, or processes of another one; as
            many as there are cores if None. What comes out does not depend on it.

    Raises:
        MissingExtra: Stable-Baselines3 is not installed.
        UnknownOption: There is no such engine, or an option of the environment does not exist.
        InterventionError: The curriculum names something that does not exist.
    """
    if backend not in BACKENDS:
        raise UnknownOption("backend", backend, BACKENDS)
    crew = fastest(backend, recipe.worlds, workers=None)
    several = {"native": {"threads": threads}, "processes": {"workers": threads}}.get(crew, {})
    envs = make_vec(
        ENV_IDS.get(recipe.task, ENV_IDS["general"]),  # the task decides, not the id
        recipe.worlds,
        curriculum_of(recipe.curriculum),
        vectorization_mode=crew,
        autoreset_mode=AutoresetMode.SAME_STEP,
        backend=backend,
        task=recipe.task,
        **several,
        **recipe.trained_in,
    )
    try:
        made = _wrapped(recipe, envs)
    except BaseException:
        envs.close()
        raise
    made.begin_with(seed)
    return made


def _wrapped(recipe: Recipe, envs: Any) -> Worlds:
    crew = envs.unwrapped.crew
    (length,) = crew.attribute([0], "limit")
    (world,) = crew.attribute([0], "world")
    episodes = Episodes(envs, length, staggered=recipe.staggered)
    scaled: ScaledRewards | None = None
    if recipe.scale_rewards:
        kept: Any = recipe.settings
        scaled = ScaledRewards(episodes, kept.gamma)
    vec_env = sb3_vec_env(scaled or episodes)
    return Worlds(vec_env, episodes, scaled, length, world.engine)
