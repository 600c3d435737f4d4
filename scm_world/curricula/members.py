"""An environment under a curriculum, as a member of an executor."""

from __future__ import annotations

from typing import Any, Self, final

from scm_world.curricula.curriculum import Curriculum
from scm_world.curricula.wrapper import CurriculumEnv
from scm_world.env import ScmWorldEnv


@final
class Member:
    """Does what a ``ScmWorldEnv`` does, with the curriculum at its resets and steps.

    Args:
        env: Around the environment itself.
    """

    def __init__(self, env: CurriculumEnv) -> None:
        self._env = env
        self._inner: Any = env.unwrapped
        self.reset, self.step = env.reset, env.step
        self.get_wrapper_attr, self.set_wrapper_attr = env.get_wrapper_attr, env.set_wrapper_attr

    @classmethod
    def of(cls, curriculum: Curriculum, **options: Any) -> Self:
        """Make one.

        Args:
            curriculum: What is done.
            options: Of the environment.
        """
        return cls(CurriculumEnv(ScmWorldEnv(**options), curriculum))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def sibling(self) -> Self:
        """Make another one like it; they share what is declared."""
        return type(self)(CurriculumEnv(self._inner.sibling(), self._env.curriculum))
