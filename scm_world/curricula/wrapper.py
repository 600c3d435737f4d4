"""Curricula of environments: a plan for every reset of one environment, and of many."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.envs.registration import VectorizeMode
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorWrapper
from gymnasium.vector.utils import concatenate, create_empty_array
from pydantic import Field, NonNegativeInt, PositiveInt

from scm_world._arguments import whole_number
from scm_world.curricula.base import Memory, Part, Progress, Situation, nested
from scm_world.curricula.curriculum import Curriculum
from scm_world.curricula.parts import over
from scm_world.env import ScmWorldEnv
from scm_world.env.arguments import RESETS, reset_options, structure_after
from scm_world.env.environment import EnvSnapshot
from scm_world.env.wrappers import unwrapped_env
from scm_world.errors import ModelError, UnknownOption, UnreadableFile
from scm_world.graph import NoiseKey
from scm_world.queries.plans import Plan
from scm_world.variables import Noise

Outcome = tuple[tuple[str, ...], bool]
"""The keys of the parts with stages that acted in an episode, and its success."""
ADVICE = "give what state() returned, of as many environments"


@final
class State(Memory):
    """The state of a curriculum in an environment.

    Attributes:
        noise: Seed and episode, within the noise, of the unfinished or next episode; None before
            the first reset.
        begun: The stages at the beginning of the unfinished episode; None if there is none.
        every: Difference of the numbers of consecutive episodes: n where n environments share them.
        running: Whether the unfinished episode is under way.
        staged: The keys of the parts with stages that act in it.
        outcomes: Of the episodes that are not counted yet, where environments share the stages.
    """

    noise: tuple[NonNegativeInt, NonNegativeInt] | None
    begun: dict[str, Progress] | None = None
    every: PositiveInt = 1
    running: bool = Field(False, exclude=True)
    staged: tuple[str, ...] = Field((), exclude=True)
    outcomes: tuple[Outcome, ...] = Field((), exclude=True)

    @classmethod
    def read(cls, data: Any) -> State:
        """Return the state that was written as plain data.

        Raises:
            UnreadableFile: It is something else.
        """
        try:
            return cls(**data)
        except (TypeError, ValueError) as error:
            said = "; ".join(getattr(error, "problems", (str(error),)))
            raise UnreadableFile("the state of a curriculum", said, ADVICE) from None


@final
class CurriculumEnv(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Intervenes on an environment: gives it a plan at every reset.

    ``options["do"]`` of ``reset`` counts more than the curriculum; both are one intervention. All
    draws have noise streams of their own, so that another part of a curriculum changes none of
    them. Observation and info are those after the interventions; an intervention gives no reward.
    A reset that is refused is no episode: the next one has its number.

    Args:
        env: An environment of this package, in any wrappers that do not change the meaning of
            ``do``.
        curriculum: A ``Curriculum``, or what it is made of.

    Raises:
        UnknownOption: It is no environment of this package, or no curriculum.
        InterventionError: The curriculum names something that does not exist. Where bodies come
            and go, a reset raises it.

    Example:
        >>> from scm_world.curricula import goals
        >>> env = CurriculumEnv(gymnasium.make("scm_world/Pushing-v0", backend="fake"), goals("A"))
        >>> _, first = env.reset(seed=0)
        >>> _, second = env.reset()
        >>> bool((first["desired_goal"] == second["desired_goal"]).all())
        False
    """

    def __init__(self, env: gymnasium.Env[Any, Any], curriculum: Any) -> None:
        self.curriculum: Curriculum = Curriculum(curriculum)
        RecordConstructorArgs.__init__(self, curriculum=_plain(self.curriculum))
        super().__init__(env)
        self._inner = unwrapped_env(env, "CurriculumEnv")
        self.curriculum.check(self._inner.world)
        self._state = State(episode=0, stages={}, noise=None)

    # --- the state between episodes ---------------------------------------------------------------

    @property
    def memory(self) -> Memory:
        """The number of the unfinished or next episode, and how far the learner has come."""
        return Memory(episode=self._state.episode, stages=self._state.stages)

    def state(self) -> dict[str, Any]:
        """Return the state of the curriculum, as plain data.

        An episode that is not over begins again.
        """
        return self._state.model_dump(mode="json")

    def resume(self, state: dict[str, Any]) -> None:
        """Continue from a state, with the next reset, in any process.

        A seed, or an episode, of the reset counts more than that of the state.

        Args:
            state: The answer of ``state``.

        Raises:
            UnreadableFile: It is something else.
        """
        self._state = State.read(state)

    saved = property(state, resume, doc="The state, for vector environments: they set attributes.")

    @property
    def shared(self) -> tuple[Outcome, ...]:
        """The outcomes of the episodes since the stages of all environments were set here."""
        return self._state.outcomes

    @shared.setter
    def shared(self, stages: dict[str, Progress]) -> None:
        self._state = self._state.model_copy(update={"stages": stages, "outcomes": ()})

    def snapshot(self) -> EnvSnapshot:
        """Save all that decides the future of the episode, the plan included.

        Raises:
            NotReset: There is no episode yet.
        """
        found: EnvSnapshot = self.env.get_wrapper_attr("snapshot")()
        return replace(found, memory=(self._state, found.memory))

    def restore(self, snapshot: EnvSnapshot) -> None:
        """Go back to a snapshot, bit for bit.

        Raises:
            SnapshotMismatch: It is none, or one of another task or backend.
        """
        memory = getattr(snapshot, "memory", None)
        if memory is not None:
            snapshot = replace(snapshot, memory=memory[1])
        self.env.get_wrapper_attr("restore")(snapshot)
        self._state = self._state if memory is None else memory[0]

    # --- episodes ---------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: Seed of the noise.
            options: As without this wrapper. The curriculum leaves the variables of ``"do"`` alone
                for the whole episode; ``"episode"`` is the number of the episode for it, too.

        Raises:
            InterventionError: An intervention was refused.
        """
        given = reset_options(options, RESETS)
        world = self._inner.world
        if self._state.running:
            stepped = world.index > 0 and bool(self._state.staged)
            self.over(success=stepped and bool(self._inner.present()[1]["is_success"]))
        found = self._state
        place = found.noise or (secrets.randbits(63), 0)
        if seed is not None:
            place = whole_number("seed", seed, least=0), 0
        elif found.noise is None and world.has_begun:
            place = world.noise.seed, world.episode + 1
        if given.get("episode") is not None:
            number = whole_number("episode", given["episode"], least=0)
            place, found = (place[0], number), found.model_copy(update={"episode": number})
        goes_on = world.has_begun and place == (world.noise.seed, world.episode + 1)
        if seed is None and not goes_on:
            seed = place[0]
            given |= {"episode": place[1]} if place[1] else {}
        begun = found.stages if found.begun is None else found.begun
        memory = Memory(episode=found.episode, stages=begun)
        given["do"], staged = self._plan(memory, *place, Plan(given.get("do")))
        if self.curriculum.space is not None:
            given["space"] = self.curriculum.space
        shown = self.env.reset(seed=seed, options=given)
        now = {"noise": place, "begun": begun, "staged": staged, "running": True}
        self._state = found.model_copy(update=now)
        return shown

    def _plan(
        self, memory: Memory, seed: int, number: int, mine: Plan
    ) -> tuple[Plan, tuple[str, ...]]:
        """Return the plan of an episode, and the keys of the parts with stages that act in it."""
        structures, besides = self._inner.world.structures, mine.at_start()
        situation = Situation(memory, structures.natural(None), Noise(seed), number)
        if len(structures.head):
            held, key = structures.head, NoiseKey(situation.noise, number, origin=0)
            first = replace(situation, first=frozenset(held))
            plan = over(first.model, self.curriculum.plan(first, besides), mine)
            acts = self._inner.beginning(plan)
            found = structure_after(structures, acts, held, held.solve(), key)
            situation = replace(situation, compiled=found or situation.compiled)
        plan = over(situation.model, self.curriculum.plan(situation, besides), mine)
        return Plan(plan), tuple(sorted(situation.staged))

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Advance one control step.

        Raises:
            InterventionError: An intervention was refused; the control step is over.
        """
        found = self.env.step(action)
        if found[2] or found[3]:
            self.over(success=bool(found[4].get("is_success")))
        return found

    def over(self, *, success: bool) -> None:
        """Count the episode that is over; stages count it if it took a step."""
        now = self._state
        if now.noise is None or not now.running:
            return
        seed, number = now.noise
        then: dict[str, Any] = {"episode": now.episode + now.every, "noise": (seed, number + 1)}
        then |= {"begun": None, "staged": (), "running": False}
        if now.staged and self._inner.world.index > 0:
            if now.every > 1:
                then["outcomes"] = (*now.outcomes, (now.staged, success))
            else:
                then["stages"] = self.curriculum.counted(now.stages, now.staged, success=success)
        self._state = now.model_copy(update=then)

    def rerun(self, actions: Any, lengths: Any) -> Any:
        """Take the steps of an episode again, from its reset on; return the observation.

        Args:
            actions: Those of all environments that share the episodes, shape (steps, n, n_actions).
            lengths: How many steps each of them took, shape (n,).
        """
        index = self._state.episode % self._state.every
        for action in actions[: lengths[index], index]:
            self.step(action)
        return self._inner.observe()


def _plain(curriculum: Curriculum) -> Any:
    """Return plain data from which it can be made, so that a specification can be written."""
    try:
        data = curriculum.as_dict()
        Curriculum.from_dict(data)
    except ModelError:  # it calls a function of the user's
        return curriculum
    return data


# --- many environments ----------------------------------------------------------------------------


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
    made = Curriculum(curriculum)
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
    counted: its stage is the one of before.

    Args:
        env: A vector environment whose members are each in a ``CurriculumEnv``.
        curriculum: The curriculum of each of them.

    Raises:
        UnknownOption: A member is in no ``CurriculumEnv``.
    """

    def __init__(self, env: Any, curriculum: Any) -> None:
        super().__init__(env)
        self.curriculum = Curriculum(curriculum)
        self._is_staged = any(part.kind == "stages" for part in nested(self.curriculum, Part))
        self._members = env  # Gymnasium declares get_attr for its own kinds only
        try:
            self._members.get_attr("saved")
        except AttributeError:
            allowed = ("members in a CurriculumEnv; make_vec makes them",)
            raise UnknownOption("vector environment", type(env).__name__, allowed) from None
        states = [
            State(episode=index, stages={}, noise=None, every=self.num_envs).model_dump()
            for index in range(self.num_envs)
        ]
        self._members.set_attr("saved", states)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the environments inside, such as ``do`` or ``get_attr``."""
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self.env, name)

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
        """Continue from a state, of as many environments; see ``CurriculumEnv.resume``."""
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
        """
        self.resume(state)
        self.env.reset()
        given = np.asarray(actions, dtype=np.float64)
        shown = self._members.call("rerun", given, np.asarray(lengths))
        space = self.single_observation_space
        rows: Any = create_empty_array(space, self.num_envs)
        return concatenate(space, shown, rows)
