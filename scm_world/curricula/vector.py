"""A curriculum for many environments, which share their progress."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.envs.registration import VectorizeMode
from gymnasium.vector import AutoresetMode, VectorWrapper

from scm_world._arguments import whole_number
from scm_world.curricula.base import Part, Progress, nested
from scm_world.curricula.curriculum import Curriculum, as_curriculum
from scm_world.curricula.wrapper import ADVICE, CurriculumEnv, State, read_state
from scm_world.env import ScmWorldEnv
from scm_world.errors import UnknownOption, UnreadableFile
from scm_world.variables.spaces import Frozen


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


class _States(Frozen):
    """The states of all members; those under way have the stages of their beginning in others."""

    members: tuple[State, ...]
    stages: dict[str, Progress]


@final
class CurriculumVectorEnv(VectorWrapper):
    """Environments that each play a part of the episodes of a curriculum.

    Member i of n plays the episodes i, i + n, i + 2 n, …; so ``during(range(1_000), …)`` means a
    thousand episodes of training, however many environments there are. They share their successes:
    a stage that is reached holds in each of them from its next episode on. In the autoreset mode
    ``SAME_STEP`` an episode begins in the very step that ends the last one; of the successes of
    that step it knows only its own.

    Args:
        env: A vector environment whose members are each in a ``CurriculumEnv``.
        curriculum: The curriculum of each of them.

    Attributes:
        stages: Progress in each part with stages, by its key.

    Raises:
        UnknownOption: A member is in no ``CurriculumEnv``.
    """

    def __init__(self, env: Any, curriculum: Any) -> None:
        super().__init__(env)
        self.curriculum = as_curriculum(curriculum)
        self.stages: dict[str, Progress] = {}
        self._is_staged = any(part.kind == "stages" for part in nested(self.curriculum, Part))
        self._members = env  # Gymnasium declares get_attr for its own kinds only
        try:
            self._members.get_attr("lane")
        except AttributeError:
            allowed = ("members in a CurriculumEnv; make_vec makes them",)
            raise UnknownOption("vector environment", type(env).__name__, allowed) from None
        self._members.set_attr("lane", [(index, self.num_envs) for index in range(self.num_envs)])

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
        if not self._is_staged:
            return
        for ended in self._members.get_attr("ended"):
            for staged, success in ended:
                self.stages = self.curriculum.counted(self.stages, staged, success=success)
        self._members.set_attr("stages", [self.stages] * self.num_envs)

    def state(self) -> dict[str, Any]:
        """Return the state of the curriculum, as plain data.

        Episodes that are not over begin again.
        """
        return self._written("saved")

    def _written(self, what: str) -> dict[str, Any]:
        members = self._members.get_attr(what)
        return _States(members=members, stages=self.stages).model_dump(mode="json")

    def resume(self, state: dict[str, Any]) -> None:
        """Continue from a state, with the next reset of all members.

        Args:
            state: The answer of ``state``, of as many environments.

        Raises:
            UnreadableFile: It is something else.
        """
        read = read_state(_States, state)
        if len(read.members) != self.num_envs:
            said = f"it has {len(read.members)} environments, and here are {self.num_envs}"
            raise UnreadableFile("the state of a curriculum", said, ADVICE)
        self._members.set_attr("saved", [one.model_dump() for one in read.members])
        self.stages = read.stages

    def running(self) -> dict[str, Any]:
        """Return how the episodes that are under way began, as plain data.

        With the actions since then, ``rerun`` takes all members to where they are.
        """
        return self._written("begun")

    def rerun(self, running: Mapping[str, Any], actions: Any, lengths: Any) -> Any:
        """Run episodes again up to where they were, bit for bit.

        Args:
            running: The answer of ``running``, of as many environments.
            actions: The actions of each control step since their resets, shape
                (steps, n, n_actions).
            lengths: How many of them each member took, shape (n,).

        Returns:
            The observations.

        Raises:
            UnreadableFile: ``running`` is something else.
        """
        self.resume(dict(running))
        self.env.reset()
        given = np.asarray(actions, dtype=np.float64)
        for index, length in enumerate(lengths):
            self._members.call_in([index], "rerun", given[:length, index])
        self._share()
        return self._members.present()[0]
