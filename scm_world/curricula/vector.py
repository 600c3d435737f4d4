"""A curriculum for many environments at once: they count episodes and learn together."""

from __future__ import annotations

from functools import partial
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper

from scm_world.curricula.choices import Stages
from scm_world.curricula.curriculum import Curriculum, as_curriculum
from scm_world.curricula.situations import Memory
from scm_world.curricula.wrapper import CurriculumEnv
from scm_world.errors import UnknownOption
from scm_world.world.start import whole_number

MODES = ("sync", "async")


def make_vec(
    env_id: str,
    num_envs: int,
    curriculum: Any,
    *,
    vectorization_mode: str = "sync",
    autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
    **options: Any,
) -> CurriculumVectorEnv:
    """Make several environments under one curriculum.

    Args:
        env_id: Such as ``"scm_world/Pushing-v0"``.
        num_envs: How many.
        curriculum: What is done in each of them; see ``CurriculumEnv``.
        vectorization_mode: ``"sync"``: in this process; ``"async"``: each in one of its own.
        autoreset_mode: As in Gymnasium.
        options: Of the environments.

    Raises:
        UnknownOption: There is no such mode, or the number is none.

    Example:
        >>> envs = make_vec("scm_world/Pushing-v0", 2, {"floor_friction": 0.4}, backend="fake")
        >>> envs.reset(seed=0)[0].shape
        (2, 56)
        >>> envs.close()
    """
    if vectorization_mode not in MODES:
        raise UnknownOption("vectorization_mode", vectorization_mode, MODES)
    count = whole_number("num_envs", num_envs, least=1)
    made = as_curriculum(curriculum)
    one = partial(_one, env_id, made, options)
    kind: Any = SyncVectorEnv if vectorization_mode == "sync" else AsyncVectorEnv
    return CurriculumVectorEnv(kind([one] * count, autoreset_mode=autoreset_mode), made)


def _one(env_id: str, curriculum: Curriculum, options: dict[str, Any]) -> CurriculumEnv:
    return CurriculumEnv(gymnasium.make(env_id, **options), curriculum)


@final
class CurriculumVectorEnv(VectorWrapper):
    """Counts the episodes of all environments as one series, and shares what they learn.

    Episode numbers are handed out in the order in which episodes begin, within one step in the
    order of the environments; so ``during(range(1_000), …)`` means a thousand episodes of
    training, however many environments there are. A stage that is reached holds in each of them
    from its next episode on. In the autoreset mode ``SAME_STEP`` an episode begins in the step that
    ends the last one: then its number was handed out when that one began.

    Args:
        env: A vector environment whose members are each in a ``CurriculumEnv``.
        curriculum: The same as theirs.

    Raises:
        UnknownOption: A member is in no ``CurriculumEnv``.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], curriculum: Any) -> None:
        super().__init__(env)
        self.curriculum = as_curriculum(curriculum)
        self.memory = Memory()
        self._stages = [p for p in self.curriculum.part.walk() if isinstance(p, Stages)]
        try:
            env.get_attr("memory")  # type: ignore[attr-defined]
        except AttributeError:
            allowed = ("members in a CurriculumEnv; make_vec makes them",)
            raise UnknownOption("vector environment", type(env).__name__, allowed) from None
        mode = env.metadata.get("autoreset_mode")
        self._ahead = mode is AutoresetMode.SAME_STEP

    def state(self) -> dict[str, Any]:
        """Give what decides how the curriculum goes on, as plain data."""
        return self.memory.as_dict()

    def resume(self, state: dict[str, Any]) -> None:
        """Go on where ``state`` was taken, with the next reset.

        Raises:
            UnreadableFile: It is none.
        """
        self.memory = Memory.from_dict(state)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in all of them, or in those of ``options["reset_mask"]``."""
        mask = (options or {}).get("reset_mask")
        begun = np.ones(self.num_envs, bool) if mask is None else np.asarray(mask, bool)
        self._hand_out(begun)
        found = self.env.reset(seed=seed, options=options)
        if self._ahead:
            self._hand_out(begun)
        return found

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Advance all of them one control step."""
        observations, rewards, terminated, truncated, info = self.env.step(actions)
        ended = np.logical_or(terminated, truncated)
        if ended.any():
            final = info.get("final_info", info)
            for index in np.flatnonzero(ended):
                success = bool(final["is_success"][index])
                for part in self._stages:
                    part.ended(self.memory, success=success)
            self._hand_out(ended)
        return observations, rewards, terminated, truncated, info

    def _hand_out(self, which: Any) -> None:
        """Give the next numbers to some environments, for their next episodes."""
        turns: list[Any] = [None] * self.num_envs
        for index in np.flatnonzero(which):
            stages = Memory.from_dict(self.memory.as_dict()).stages
            turns[index] = (self.memory.episode, Memory(self.memory.episode, stages))
            self.memory.episode += 1
        self.env.set_attr("turn", turns)  # type: ignore[attr-defined]
