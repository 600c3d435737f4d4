"""A curriculum for one environment."""

from __future__ import annotations

from typing import Any, final

import gymnasium
from gymnasium.utils import RecordConstructorArgs

from scm_world.curricula.curriculum import Curriculum, Turn, as_curriculum
from scm_world.curricula.situations import Memory
from scm_world.env import ScmWorldEnv
from scm_world.errors import UnknownOption


def environment(env: Any, wrapper: str) -> ScmWorldEnv:
    """Give the environment of this package inside of wrappers.

    Raises:
        UnknownOption: There is another one.
    """
    inner = env.unwrapped
    if not isinstance(inner, ScmWorldEnv):
        raise UnknownOption(f"environment for {wrapper}", type(inner).__name__, ("ScmWorldEnv",))
    return inner


@final
class CurriculumEnv(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Intervenes on an environment, at its resets and within its episodes.

    What the caller of ``reset`` asks for in ``options["do"]`` counts more than the curriculum. All
    draws come from noises of their own, so that another part of a curriculum changes none of them.
    Observation and info are those after the interventions; an intervention is no progress, so it
    gives no reward.

    Args:
        env: Of this package, in any wrappers that do not change what ``do`` means.
        curriculum: A ``Curriculum``, a part of one, plain data, or an intervention.

    Raises:
        UnknownOption: It is no environment of this package, or no curriculum.
        InterventionError: The curriculum names something that does not exist.

    Example:
        >>> from scm_world.curricula import goals
        >>> env = CurriculumEnv(gymnasium.make("scm_world/Pushing-v0", backend="fake"), goals("A"))
        >>> _, first = env.reset(seed=0)
        >>> _, second = env.reset()
        >>> bool((first["desired_goal"] == second["desired_goal"]).all())
        False
    """

    def __init__(self, env: gymnasium.Env[Any, Any], curriculum: Any) -> None:
        made = as_curriculum(curriculum)
        RecordConstructorArgs.__init__(self, curriculum=made)
        super().__init__(env)
        self._inner = environment(env, "CurriculumEnv")
        made.check(self._inner.world)
        self._turn = Turn(made)
        self._running = False
        self._success = False
        self._next: tuple[int, Memory] | None = None

    @property
    def curriculum(self) -> Curriculum:
        """What is done."""
        return self._turn.curriculum

    @property
    def memory(self) -> Memory:
        """How many episodes there were, and how far the learner has come."""
        return self._turn.memory

    def state(self) -> dict[str, Any]:
        """Give what decides how the curriculum goes on, as plain data."""
        return self.memory.as_dict()

    def resume(self, state: dict[str, Any]) -> None:
        """Go on where ``state`` was taken, with the next reset.

        Raises:
            UnreadableFile: It is none.
        """
        self._turn.memory = Memory.from_dict(state)
        self._running = False

    @property
    def turn(self) -> tuple[int, Memory] | None:
        """What number the next episode has, and what is remembered then, if somebody said so."""
        return self._next

    @turn.setter
    def turn(self, turn: tuple[int, Memory] | None) -> None:
        self._next = turn or self._next

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode, with what is due.

        Raises:
            InterventionError: An intervention was refused.
        """
        self._count()
        observation, info = self.env.reset(seed=seed, options=options)
        if self._turn.begin(self._inner):
            asked = (options or {}).get("do")
            if asked:
                self._inner.do(asked)
            observation, info = self._seen(observation, info)
        return observation, info

    def _count(self) -> None:
        """Count the episode that ends, unless somebody else does."""
        if self._next is not None:
            episode, memory = self._next
            self._turn.memory, self._next = memory, None
            self._turn.memory.episode = episode
        elif self._running:
            self._turn.ended(success=self._success)
        self._running, self._success = True, False

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Advance one control step, then do what is due.

        Raises:
            InterventionError: An intervention was refused.
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._success = bool(info["is_success"])
        if not (terminated or truncated) and self._turn.step(self._inner):
            observation, info = self._seen(observation, info)
        return observation, reward, terminated, truncated, info

    def _seen(self, observation: Any, info: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Look again, through the wrappers inside of this one."""
        seen, known = self._inner.present()
        env = self.env
        layers = []
        while env is not self._inner:
            layers.append(env)
            env = env.env  # type: ignore[attr-defined]
        for layer in reversed(layers):
            change = getattr(layer, "observation", None)
            if isinstance(layer, gymnasium.ObservationWrapper) and change is not None:
                seen = change(seen)
        return seen, {**info, **known}
