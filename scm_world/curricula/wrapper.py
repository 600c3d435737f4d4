"""Curricula of environments: a plan for every reset of one environment, and of many."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.envs.registration import VectorizeMode
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from pydantic import Field, NonNegativeInt, PositiveInt

from scm_world._arguments import typed, whole_number
from scm_world.curricula.curriculum import Curriculum, Part, Progress, Situation, as_curriculum
from scm_world.env import IDS, ScmWorldEnv, ScmWorldVectorEnv
from scm_world.env.arguments import RESETS, beginning_structure, reset_options
from scm_world.env.environment import EnvSnapshot, unwrapped_env
from scm_world.errors import UnknownOption, in_one_line
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
        every: Difference of the numbers of consecutive episodes: n where n environments play the
            episodes of one series.
    """

    episode: NonNegativeInt = 0
    stages: dict[str, Progress] = Field({})
    noise: tuple[NonNegativeInt, NonNegativeInt] | None = None
    every: PositiveInt = 1


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
        curriculum: A ``Curriculum``, interventions, or a function of the ``Situation``.

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

    @typed
    def __init__(self, env: gymnasium.Env[Any, Any], curriculum: Part) -> None:
        RecordConstructorArgs.__init__(self, curriculum=curriculum)
        super().__init__(env)
        self.curriculum: Curriculum = as_curriculum(curriculum)
        self._inner = unwrapped_env(env, "CurriculumEnv")
        self.curriculum.check(self._inner.world)
        self._state = CurriculumState()
        self._staged: dict[str, Any] | None = None  # what acts in the episode under way, by key

    @property
    def state(self) -> CurriculumState:
        """The state of the curriculum; see above."""
        return self._state

    @state.setter
    def state(self, state: CurriculumState | Mapping[str, Any]) -> None:
        self._state, self._staged = CurriculumState(**dict(state)), None

    def snapshot(self) -> EnvSnapshot:
        """Save all that decides the future of the episode, the plan and the state included."""
        found: EnvSnapshot = self.env.get_wrapper_attr("snapshot")()
        return replace(found, memory=(self._state, self._staged, found.memory))

    def restore(self, snapshot: EnvSnapshot) -> None:
        """Restore a snapshot, bit for bit; see ``ScmWorldEnv.restore``."""
        memory = getattr(snapshot, "memory", None)
        inner = snapshot if memory is None else replace(snapshot, memory=memory[2])
        self.env.get_wrapper_attr("restore")(inner)
        if memory is not None:
            self._state, self._staged = memory[:2]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: Seed of the noise.
            options: As without this wrapper. ``"do"`` lies above the curriculum: a shift acts on
                what that makes of a variable. ``"draws"``, or else ``"episode"``, is its number for
                the curriculum, too.

        Raises:
            InterventionError: An intervention was refused.
        """
        given = reset_options(options, RESETS)
        world = self._inner.world
        stepped = bool(self._staged) and world.index > 0
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
        compiled, seeded = world.structures.natural(None), Noise(place[0])
        drawn = given.get("draws")
        numbers = (found.episode, place[1]) if drawn is None else (drawn, drawn)
        situation = Situation(numbers[0], found.stages, compiled, seeded, numbers[1])
        given["do"] = self._plan(situation, Plan(given.get("do")))
        shown = self.env.reset(seed=seed, options=given)
        self._state, self._staged = found.model_copy(update={"noise": place}), situation.staged
        return shown

    def _plan(self, situation: Situation, mine: Plan) -> Plan:
        """Return the plan of an episode: that of the caller over the curriculum."""
        world, key = self._inner.world, NoiseKey(situation.noise, situation.number, origin=0)
        if len(head := world.structures.head):  # first the variables that decide which bodies exist
            acts = self._inner.beginning(
                self._over(replace(situation, first=frozenset(head)), mine)
            )
            situation = replace(situation, compiled=beginning_structure(world, acts, key))
        return self._over(situation, mine)

    def _over(self, situation: Situation, mine: Plan) -> Plan:
        """Return the caller's plan over that of the curriculum."""
        plan, first = self.curriculum.plan(situation), situation.first
        for kind, layer in (("curriculum", Plan(dict(plan))), *reversed(plan.context)):
            mine = mine.over(
                {n: acts for n, acts in layer.items() if first is None or n in first}, kind
            )
        return mine

    def step(self, action: object) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Advance one control step.

        Raises:
            InterventionError: An intervention was refused; the control step is over.
        """
        found = self.env.step(action)
        if found[2] or found[3]:
            self.over(success=bool(found[4].get("is_success")))
        return found

    @typed
    def over(self, *, success: bool) -> None:
        """Count the episode under way, if any, as over; stages count it if it took a step."""
        now = self._state
        if now.noise is None or self._staged is None:
            return
        stages, (seed, number) = dict(now.stages), now.noise
        for key, part in self._staged.items() if self._inner.world.index > 0 else ():
            stages[key] = part.after(stages.get(key, Progress()), success=success)
        then = {"episode": now.episode + now.every, "stages": stages, "noise": (seed, number + 1)}
        self._state, self._staged = now.model_copy(update=then), None


@final
class LevelsEnv(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Plays episodes of a fixed set: level i is episode i of the noise of a seed.

    A reset draws a level uniformly, unless ``options["episode"]`` names one; its ``seed`` is that
    of these draws. So ``reset(seed=level_seed, options={"episode": i})`` of the environment inside
    is level i.

    Args:
        env: A ``CurriculumEnv``, or an environment of this package in other wrappers.
        levels: How many there are.
        level_seed: Seed of their noise.

    Source:
        Cobbe et al., *Leveraging Procedural Generation to Benchmark Reinforcement Learning*, ICML
        2020.
    """

    @typed
    def __init__(self, env: gymnasium.Env[Any, Any], levels: int, level_seed: int = 0) -> None:
        RecordConstructorArgs.__init__(self, levels=levels, level_seed=level_seed)
        super().__init__(env)
        unwrapped_env(env, "LevelsEnv")
        self.levels = whole_number("levels", levels, least=1)
        self.level_seed = whole_number("level_seed", level_seed, least=0)
        self._draws = np.random.default_rng()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode of a level; errors are those of the environment inside."""
        if seed is not None:
            self._draws = np.random.default_rng(whole_number("seed", seed, least=0))
        given = {"episode": None, **reset_options(options, RESETS)}
        if given["episode"] is None:
            given["episode"] = int(self._draws.integers(self.levels))
        return self.env.reset(seed=self.level_seed, options=given)


def _member(
    curriculum: Part, levels: int | None, level_seed: int, **options: Any
) -> CurriculumEnv | LevelsEnv:
    found = CurriculumEnv(ScmWorldEnv(**options), curriculum)
    return found if levels is None else LevelsEnv(found, levels, level_seed)


@typed
def make_vec(
    env_id: str,
    num_envs: int,
    curriculum: Part,
    *,
    autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
    levels: int | None = None,
    level_seed: int = 0,
    **options: object,
) -> ScmWorldVectorEnv | AsyncVectorEnv:
    """Make several environments that each play a part of the episodes of a curriculum.

    Environment i of n plays the episodes i, i + n, i + 2 n, …; so ``during(range(1_000), …)`` means
    a thousand episodes of training, however many environments there are. Each goes through the
    stages by its own successes. ``get_attr("state")`` and ``set_attr("state", …)`` keep and resume
    the curriculum.

    Args:
        env_id: Such as ``"scm_world/Pushing-v0"``.
        num_envs: Number of environments.
        curriculum: The curriculum of all of them; see ``CurriculumEnv``.
        autoreset_mode: When a member that is done is reset, as in Gymnasium.
        levels: Number of levels, which all environments play, each drawn uniformly; None for new
            draws in every episode. See ``LevelsEnv``.
        level_seed: Seed of the noise of the levels.
        options: Options of the environments; ``threads`` and ``workers``, see ``vector_env``.

    Returns:
        A vector environment whose members are each in a ``CurriculumEnv``; see ``vector_env``.

    Example:
        >>> envs = make_vec("scm_world/Pushing-v0", 2, {"floor_friction": 0.4}, backend="fake")
        >>> envs.reset(seed=0)[0].shape
        (2, 56)
        >>> envs.close()
    """
    options.pop("disable_env_checker", None)  # of single environments
    count = whole_number("num_envs", num_envs, least=1)
    try:
        gymnasium.spec(env_id)
    except gymnasium.error.Error as error:
        allowed = (*IDS.values(), in_one_line(error))
        raise UnknownOption("env_id", env_id, allowed) from None
    given: dict[str, Any] = {**options, "member": partial(_member, curriculum, levels, level_seed)}
    mode = VectorizeMode.VECTOR_ENTRY_POINT
    envs: ScmWorldVectorEnv | AsyncVectorEnv = gymnasium.make_vec(  # type: ignore[assignment] # ours
        env_id, count, vectorization_mode=mode, autoreset_mode=autoreset_mode, **given
    )
    envs.set_attr("state", [CurriculumState(episode=index, every=count) for index in range(count)])
    return envs
