"""A curriculum for many environments, which share their progress."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from itertools import chain
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.envs.registration import VectorizeMode
from gymnasium.vector import AutoresetMode, VectorWrapper

from scm_world._arguments import whole_number
from scm_world.curricula.base import Part, Progress, nested
from scm_world.curricula.curriculum import Curriculum, as_curriculum
from scm_world.curricula.wrapper import ADVICE, CurriculumEnv, State
from scm_world.env import ScmWorldEnv
from scm_world.errors import UnknownOption, UnreadableFile


def make_vec(
    env_id: str,
    num_envs: int,
    curriculum: Any,
    *,
    autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
    **options: Any,
) -> CurriculumVectorEnv:
    """Make several environments under one curriculum.

    Args:
        env_id: Such as ``"scm_world/Pushing-v0"``.
        num_envs: Number of environments.
        curriculum: The curriculum of all of them; see ``CurriculumEnv``.
        autoreset_mode: When a member that is done is reset, as in Gymnasium.
        options: Options of the environments; ``threads`` and ``workers``, see ``vector_env``.

    Raises:
        UnknownOption: There is no such option, or the number is none.

    Example:
        >>> envs = make_vec("scm_world/Pushing-v0", 2, {"floor_friction": 0.4}, backend="fake")
        >>> envs.reset(seed=0)[0].shape
        (2, 56)
        >>> envs.close()
    """
    options.pop("disable_env_checker", None)  # of single environments
    made = as_curriculum(curriculum)
    envs: Any = gymnasium.make_vec(
        env_id,
        whole_number("num_envs", num_envs, least=1),
        vectorization_mode=VectorizeMode.VECTOR_ENTRY_POINT,
        autoreset_mode=autoreset_mode,
        member=partial(_member, made),
        **options,
    )
    return CurriculumVectorEnv(envs, made)


def _member(curriculum: Curriculum, **options: Any) -> CurriculumEnv:
    return CurriculumEnv(ScmWorldEnv(**options), curriculum)


@final
class CurriculumVectorEnv(VectorWrapper):
    """Environments that each play a part of the episodes of a curriculum.

    Member i of n plays the episodes i, i + n, i + 2 n, …; so ``during(range(1_000), …)`` means a
    thousand episodes of training, however many environments there are. They share their successes:
    a stage that is reached holds in each of them from its next episode on. In the autoreset mode
    ``SAME_STEP`` an episode begins in the very step that ends the last one, before its success is
    known to the others: its stage is the one of before.

    Args:
        env: A vector environment whose members are each in a ``CurriculumEnv``.
        curriculum: The curriculum of each of them.

    Raises:
        UnknownOption: A member is in no ``CurriculumEnv``.
    """

    def __init__(self, env: Any, curriculum: Any) -> None:
        super().__init__(env)
        self.curriculum = as_curriculum(curriculum)
        self._is_staged = any(part.kind == "stages" for part in nested(self.curriculum, Part))
        self._members = env  # Gymnasium declares get_attr for its own kinds only
        try:
            self._members.get_attr("saved")
        except AttributeError:
            allowed = ("members in a CurriculumEnv; make_vec makes them",)
            raise UnknownOption("vector environment", type(env).__name__, allowed) from None
        first = {"stages": {}, "noise": None, "every": self.num_envs}
        states = [{"episode": index, **first} for index in range(self.num_envs)]
        self._members.set_attr("saved", states)

    @property
    def stages(self) -> dict[str, Progress]:
        """Progress in each part with stages, by its key."""
        found: dict[str, Progress] = self._members.get_attr("memory")[0].stages
        return found

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in all of them, or in those of ``options["reset_mask"]``."""
        found = self.env.reset(seed=seed, options=options)
        self._share()
        return found

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Advance all of them one control step."""
        found = self.env.step(actions)
        if np.logical_or(found[2], found[3]).any():
            self._share()
        return found

    def _share(self) -> None:
        """Count the episodes that ended, in the order of the members, for all of them."""
        shared = self._members.get_attr("shared") if self._is_staged else ()
        if any(shared):
            stages = self.stages
            for staged, success in chain(*shared):
                stages = self.curriculum.counted(stages, staged, success=success)
            self._members.set_attr("shared", [stages] * self.num_envs)

    def state(self) -> dict[str, Any]:
        """Return the state of the curriculum, as plain data.

        Episodes that are not over begin again.
        """
        return {"members": [*self._members.get_attr("saved")]}

    def resume(self, state: dict[str, Any]) -> None:
        """Continue from a state, with the next reset of all members.

        Args:
            state: The answer of ``state``, of as many environments.

        Raises:
            UnreadableFile: It is something else.
        """
        members = state.get("members") if isinstance(state, Mapping) else None
        if not isinstance(members, list | tuple) or len(members) != self.num_envs:
            said = f"it is not of {self.num_envs} environments"
            raise UnreadableFile("the state of a curriculum", said, ADVICE)
        for one in members:
            State.read(one)
        self._members.set_attr("saved", [*members])

    def rerun(self, state: dict[str, Any], actions: Any, lengths: Any) -> Any:
        """Run unfinished episodes again up to where they were, bit for bit.

        Args:
            state: The answer of ``state``, of as many environments.
            actions: The actions of each control step since their resets, shape
                (steps, n, n_actions).
            lengths: How many of them each member took, shape (n,).

        Returns:
            The observations.

        Raises:
            UnreadableFile: ``state`` is something else.
        """
        self.resume(state)
        self.env.reset()
        given = np.asarray(actions, dtype=np.float64)
        for index, length in enumerate(lengths):
            self._members.call_in([index], "rerun", given[:length, index])
        return self._members.present()[0]
