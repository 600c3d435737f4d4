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
from pydantic import Field, NonNegativeInt, PositiveInt

from scm_world._arguments import whole_number
from scm_world.curricula.curriculum import Curriculum
from scm_world.curricula.parts import Part, Progress, Situation, nested, over
from scm_world.env import ScmWorldEnv
from scm_world.env.arguments import RESETS, reset_options, structure_after
from scm_world.env.environment import EnvSnapshot
from scm_world.env.wrappers import unwrapped_env
from scm_world.errors import ModelError, UnknownOption
from scm_world.graph import NoiseKey
from scm_world.queries.plans import Plan
from scm_world.variables import Noise
from scm_world.variables.spaces import Frozen


@final
class CurriculumState(Frozen):
    """The state of a curriculum in an environment: it goes to JSON without the episode under way.

    Attributes:
        episode: Number of the unfinished or next episode, from 0.
        stages: Progress in each part with stages, by its key.
        noise: Seed and episode, within the noise, of the unfinished or next episode; None before
            the first reset.
        begun: The stages at the beginning of the unfinished episode; None if there is none.
        every: Difference of the numbers of consecutive episodes: n where n environments share them.
        staged: The keys of the parts with stages that act in it; None if none is under way.
        outcomes: Episodes that are not counted yet, where environments share the stages: the
            value of ``staged``, and the success.
    """

    episode: NonNegativeInt = 0
    stages: dict[str, Progress] = Field({})
    noise: tuple[NonNegativeInt, NonNegativeInt] | None = None
    begun: dict[str, Progress] | None = None
    every: PositiveInt = 1
    staged: tuple[str, ...] | None = Field(None, exclude=True)
    outcomes: tuple[tuple[tuple[str, ...], bool], ...] = Field((), exclude=True)


@final
class CurriculumEnv(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Intervenes on an environment: gives it a plan at every reset.

    ``options["do"]`` of ``reset`` counts more than the curriculum; both are one intervention. All
    draws have noise streams of their own, so that another part of a curriculum changes none of
    them. Observation and info are those after the interventions; an intervention gives no reward.
    A reset that is refused is not an episode: the next one has its number.

    Args:
        env: An environment of this package, in any wrappers that do not change the meaning of
            ``do``.
        curriculum: A ``Curriculum``, or its parts.

    Attributes:
        state: Where the curriculum is. Set in any environment under the same curriculum, it goes on
            from there with the next reset; an episode that is not over begins again. A seed, or
            an episode, of the reset counts more.

    Raises:
        UnknownOption: It is not an environment of this package, or not a curriculum.
        InterventionError: The curriculum names something that does not exist. Where bodies come
            and go, a reset raises it.

    Example:
        >>> from scm_world.curricula import goals
        >>> env = CurriculumEnv(gymnasium.make("scm_world/Pushing-v0", backend="fake"), goals("A"))
        >>> _, first = env.reset(seed=0)
        >>> _, second = env.reset()
        >>> bool((first["desired_goal"] == second["desired_goal"]).all())
        False
        >>> env.state.episode
        1
    """

    def __init__(self, env: gymnasium.Env[Any, Any], curriculum: Any) -> None:
        self.curriculum: Curriculum = Curriculum(curriculum)
        try:  # plain data, so that a specification can be written
            written: Any = self.curriculum.as_dict()
            Curriculum(written)
        except ModelError:  # it calls a function of the user's
            written = self.curriculum
        RecordConstructorArgs.__init__(self, curriculum=written)
        super().__init__(env)
        self._inner = unwrapped_env(env, "CurriculumEnv")
        self.curriculum.check(self._inner.world)
        self._state = CurriculumState()

    @property
    def state(self) -> CurriculumState:
        """The state of the curriculum; see above."""
        return self._state

    @state.setter
    def state(self, state: CurriculumState | Mapping[str, Any]) -> None:
        given = state.model_dump() if isinstance(state, CurriculumState) else state
        if not isinstance(given, Mapping):
            raise UnknownOption(
                "state of a curriculum", state, ("a CurriculumState", "one as plain data")
            )
        self._state = CurriculumState(**given)

    def share(self, stages: dict[str, Progress]) -> None:
        """Set the stages that environments share: all outcomes are counted."""
        self._state = self._state.model_copy(update={"stages": stages, "outcomes": ()})

    def snapshot(self) -> EnvSnapshot:
        """Save all that decides the future of the episode, the plan and the state included."""
        found: EnvSnapshot = self.env.get_wrapper_attr("snapshot")()
        return replace(found, memory=(self._state, found.memory))

    def restore(self, snapshot: EnvSnapshot) -> None:
        """Restore a snapshot, bit for bit; see ``ScmWorldEnv.restore``."""
        memory = getattr(snapshot, "memory", None)
        inner = snapshot if memory is None else replace(snapshot, memory=memory[1])
        self.env.get_wrapper_attr("restore")(inner)
        self._state = self._state if memory is None else memory[0]

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
        stepped = bool(self._state.staged) and world.index > 0
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
        situation = Situation(
            found.episode, begun, world.structures.natural(None), Noise(place[0]), place[1]
        )
        given["do"] = self._plan(situation, Plan(given.get("do")))
        if self.curriculum.space is not None:
            given["space"] = self.curriculum.space
        shown = self.env.reset(seed=seed, options=given)
        now = {"noise": place, "begun": begun, "staged": tuple(sorted(situation.staged))}
        self._state = found.model_copy(update=now)
        return shown

    def _plan(self, situation: Situation, mine: Plan) -> Plan:
        """Return the plan of an episode: of what the curriculum and the caller do."""
        structures, besides = self._inner.world.structures, mine.at_start()
        if len(structures.head):  # first the variables that decide which bodies exist
            held, key = structures.head, NoiseKey(situation.noise, situation.number, origin=0)
            first = replace(situation, first=frozenset(held))
            plan = over(first.model, self.curriculum.plan(first, besides), mine)
            acts = self._inner.beginning(plan)
            found = structure_after(structures, acts, held, held.solve(), key)
            situation = replace(situation, compiled=found or situation.compiled)
        return Plan(over(situation.model, self.curriculum.plan(situation, besides), mine))

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
        """Count the episode under way, if any, as over; stages count it if it took a step."""
        now = self._state
        if now.noise is None or now.staged is None:
            return
        seed, number = now.noise
        then: dict[str, Any] = {"episode": now.episode + now.every, "noise": (seed, number + 1)}
        then |= {"begun": None, "staged": None}
        if now.staged and self._inner.world.index > 0:
            ended = (*now.outcomes, (now.staged, success))
            if now.every > 1:
                then["outcomes"] = ended
            else:
                then["stages"] = self.curriculum.counted(now.stages, ended)
        self._state = now.model_copy(update=then)


# --- many environments ----------------------------------------------------------------------------


def make_vec(
    env_id: str,
    num_envs: int,
    curriculum: Any,
    *,
    autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
    **options: Any,
) -> CurriculumVectorEnv:
    """Make several environments under one curriculum; see ``CurriculumVectorEnv``.

    Args:
        env_id: Such as ``"scm_world/Pushing-v0"``.
        num_envs: Number of environments.
        curriculum: The curriculum of all of them; see ``CurriculumEnv``.
        autoreset_mode: When a member that is done is reset, as in Gymnasium.
        options: Options of the environments; ``threads`` and ``workers``, see ``vector_env``.

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
    counted: its stage is the one of before. ``get_attr("state")`` and ``set_attr("state", …)``
    keep and resume the curriculum.

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
            self._members.get_attr("curriculum")
        except AttributeError:
            allowed = ("members in a CurriculumEnv; make_vec makes them",)
            raise UnknownOption("vector environment", type(env).__name__, allowed) from None
        n = self.num_envs
        self._members.set_attr(
            "state", [CurriculumState(episode=index, every=n) for index in range(n)]
        )

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the environments inside, such as ``do`` or ``get_attr``."""
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self.env, name)

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
        states: Any = self._members.get_attr("state") if self._is_staged else ()
        outcomes = [*chain(*(state.outcomes for state in states))]
        if outcomes:
            self._members.call("share", self.curriculum.counted(states[0].stages, outcomes))
