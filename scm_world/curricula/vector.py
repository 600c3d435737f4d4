"""A curriculum for many environments, which share its counts and its progress."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.envs.registration import VectorizeMode
from gymnasium.vector import AutoresetMode, VectorWrapper
from numpy.typing import NDArray

from scm_world._arguments import whole_number
from scm_world.curricula.base import Memory, state_read
from scm_world.curricula.combinations import count
from scm_world.curricula.curriculum import Curriculum, as_curriculum
from scm_world.curricula.wrapper import CurriculumEnv, place
from scm_world.env import ScmWorldEnv
from scm_world.env.arguments import RESETS, reset_options
from scm_world.env.many import MASK
from scm_world.errors import UnknownOption
from scm_world.world.batch import read_mask

SUCCESS = "is_success"


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
        num_envs: How many.
        curriculum: What is done in each of them; see ``CurriculumEnv``.
        autoreset_mode: When a member that is done is reset, as in Gymnasium.
        options: Of the environments; ``threads`` and ``workers``, see ``vector_env``.

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
    """Counts the episodes of all environments as one series, and shares what they learn.

    Episode numbers are handed out in the order in which episodes begin, within one step in the
    order of the environments; so ``during(range(1_000), …)`` means a thousand episodes of
    training, however many environments there are. A stage that is reached holds in each of them
    from its next episode on. In the autoreset mode ``SAME_STEP`` an episode begins in the very
    step that ends the last one, before that is known here: its number was handed out when that
    one began, and its stage is the one of before.

    Args:
        env: A vector environment whose members are each in a ``CurriculumEnv``.
        curriculum: The same as theirs.

    Raises:
        UnknownOption: A member is in no ``CurriculumEnv``.
    """

    def __init__(self, env: Any, curriculum: Any) -> None:
        super().__init__(env)
        self.curriculum = as_curriculum(curriculum)
        self.memory = Memory()
        self._members = env  # Gymnasium declares get_attr for its own kinds only
        try:
            self._members.get_attr("turn")
        except AttributeError:
            allowed = ("members in a CurriculumEnv; make_vec makes them",)
            raise UnknownOption("vector environment", type(env).__name__, allowed) from None
        self._ahead = env.metadata.get("autoreset_mode") is AutoresetMode.SAME_STEP
        self._again: list[int] = []
        self._forget()

    def _forget(self) -> None:
        """Know of no episode."""
        self._present: list[int | None] = [None] * self.num_envs
        self._waiting: list[int | None] = [None] * self.num_envs
        self._stepped = np.zeros(self.num_envs, bool)
        self._success = np.zeros(self.num_envs, bool)

    def state(self) -> dict[str, Any]:
        """Return the state of the curriculum, as plain data.

        Episodes that are not over begin again.
        """
        numbers = (*self._present, *self._waiting, *self._again)
        again = sorted({number for number in numbers if number is not None})
        places = [None if where is None else [*where] for where in self._members.get_attr("where")]
        return {**self.memory.as_dict(), "again": again, "noises": places}

    def resume(self, state: dict[str, Any]) -> None:
        """Continue where ``state`` was taken, with the next reset of all members.

        Args:
            state: What ``state`` gave, of as many environments.

        Raises:
            UnreadableFile: It is something else.
        """
        memory = Memory.from_dict(state)
        with state_read("state()"):
            again = [whole_number("episode", number, least=0) for number in state["again"]]
            places = [place(noise) for noise in state["noises"]]
            if len(places) != self.num_envs:
                raise ValueError(f"{len(places)} environments, and here are {self.num_envs}")
        self._members.set_attr("where", places)
        self.memory, self._again = memory, again
        self._forget()

    def running(self) -> dict[str, Any]:
        """Give what decides how the episodes that are under way began, as plain data.

        With the actions since then, ``rerun`` takes all members to where they are.
        """
        memories, turns = self._members.get_attr("memory"), self._members.get_attr("turn")
        saved = [None if turn is None else [turn[0], turn[1].as_dict()] for turn in turns]
        return {
            **self.state(),
            "present": [*self._present],
            "waiting": [*self._waiting],
            "left": [*self._again],
            "memories": [memory.as_dict() for memory in memories],
            "turns": saved,
            "stepped": self._stepped.tolist(),
            "success": self._success.tolist(),
        }

    def rerun(self, running: Mapping[str, Any], actions: Any, lengths: Any) -> Any:
        """Play episodes again up to where they were, bit for bit.

        Args:
            running: What ``running`` gave, of as many environments.
            actions: Of each control step since their resets, shape (steps, n, n_actions).
            lengths: How many of them each member took, shape (n,).

        Returns:
            The observations.

        Raises:
            UnreadableFile: ``running`` is something else.
        """
        with state_read("running()"):
            memories = [Memory.from_dict(memory) for memory in running["memories"]]
            turns = [t and (int(t[0]), Memory.from_dict(t[1])) for t in running["turns"]]
            left = [int(number) for number in running["left"]]
            kept = {name: running[name] for name in ("present", "waiting", "stepped", "success")}
            if any(len(one) != self.num_envs for one in (memories, turns, *kept.values())):
                raise ValueError(f"another number of environments than {self.num_envs}")
        self.resume({name: running[name] for name in ("episode", "stages", "again", "noises")})
        self._members.set_attr("turn", [(memory.episode, memory) for memory in memories])
        self.env.reset()
        given = np.asarray(actions, dtype=np.float64)
        for index, length in enumerate(lengths):
            self._members.call_in([index], "rerun", given[:length, index])
        self._members.set_attr("turn", turns)
        self._present, self._waiting, self._again = kept["present"], kept["waiting"], left
        self._stepped = np.array(kept["stepped"], bool)
        self._success = np.array(kept["success"], bool)
        return self._members.present()[0]

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in all of them, or in those of ``options["reset_mask"]``."""
        begun = read_mask(MASK, reset_options(options, (*RESETS, MASK)).get(MASK), self.num_envs)
        for index in np.flatnonzero(begun):
            self._ended(index, counts=bool(self._stepped[index]))
        self._hand_out(begun)
        found = self.env.reset(seed=seed, options=options)
        self._begin(begun)
        return found

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Advance all of them one control step."""
        waited = np.array([number is not None for number in self._waiting])
        observations, rewards, terminated, truncated, info = self.env.step(actions)
        ended = np.logical_or(terminated, truncated)
        if not self._ahead and waited.any():
            self._begin(waited)
        self._stepped |= self._ahead | ~waited
        present = info.get(SUCCESS, False)
        final = info["final_info"].get(SUCCESS, False) if "final_info" in info else present
        self._success = np.where(ended, final, present).astype(bool)
        if ended.any():
            levels = self._levels()
            for index in np.flatnonzero(ended):
                self._ended(index)
            if self._ahead:
                self._begin(ended)
                if levels != self._levels():
                    self._hand_out(np.ones(self.num_envs, bool))
            else:
                self._hand_out(ended)
        return observations, rewards, terminated, truncated, info

    def _levels(self) -> dict[str, int]:
        return {key: kept.level for key, kept in self.memory.stages.items()}

    def _ended(self, index: Any, *, counts: bool = True) -> None:
        """Take into account how the present episode of a member ended."""
        number, self._present[index] = self._present[index], None
        if number is not None and counts:
            live = self.curriculum.part.live(self.memory, number)
            count(live, self.memory, success=bool(self._success[index]))

    def _begin(self, which: NDArray[np.bool_]) -> None:
        """Note which members have begun their next episode."""
        for index in np.flatnonzero(which):
            self._present[index], self._waiting[index] = self._waiting[index], None
            self._stepped[index] = self._success[index] = False
        if self._ahead:
            self._hand_out(which)

    def _hand_out(self, which: NDArray[np.bool_]) -> None:
        """Tell some members the number of their next episode, and the stages."""
        turns: list[Any] = [None] * self.num_envs
        for index in np.flatnonzero(which):
            number = self._waiting[index]
            if number is None:
                number = self._again.pop(0) if self._again else self.memory.episode
                self.memory.episode += number == self.memory.episode
            self._waiting[index] = number
            turns[index] = (number, Memory.from_dict(self.memory.as_dict()))
        self._members.set_attr("turn", turns)
