"""The wrapper that runs a curriculum: it counts episodes and successes, and intervenes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, final

import gymnasium
from gymnasium.utils import RecordConstructorArgs

from scm_world._arguments import whole_number
from scm_world._types import Value
from scm_world.curricula.base import Acts, Memory, Situation, state_read
from scm_world.curricula.combinations import count
from scm_world.curricula.curriculum import Curriculum, as_curriculum
from scm_world.curricula.parts import Interpolate
from scm_world.env import ScmWorldEnv
from scm_world.env.arguments import RESETS, reset_options
from scm_world.env.wrappers import unwrapped_env
from scm_world.errors import ModelError, UnknownOption, UnknownVariable, blamed
from scm_world.graph import flatten
from scm_world.world import Simulation


@final
class CurriculumRunner:
    """A curriculum at work.

    Args:
        curriculum: What is done.
        memory: The state to continue from; the beginning if None.

    Attributes:
        curriculum: What is done.
        memory: The state of the curriculum.
    """

    def __init__(self, curriculum: Any, memory: Memory | None = None) -> None:
        self.curriculum: Curriculum = as_curriculum(curriculum)
        self.memory = Memory() if memory is None else memory
        self._besides: frozenset[str] = frozenset()
        self._initial: dict[str, Value] = {}
        self._last = 0
        parts = self.curriculum.part.walk()
        self._moved = [
            name for part in parts if isinstance(part, Interpolate) for name in part.stop
        ]

    def begin(
        self, env: ScmWorldEnv, episode: int | None = None, *, besides: Iterable[str] = ()
    ) -> bool:
        """Do what is due at a reset, just after it.

        Args:
            env: At the beginning of an episode.
            episode: Its number; as many as have ended if None.
            besides: Variables that are left as they are in this episode, in any coordinates.

        Returns:
            Whether anything was done.

        Raises:
            InterventionError: It was refused; nothing has changed.
        """
        if episode is not None:
            self.memory.episode = episode
        self._besides, self._last = frozenset(besides), 0
        world = env.world
        self._initial = {name: world[name] for name in self._moved if name in world.model}
        return self._act(env, 0)

    def may_act(self, step: int) -> bool:
        """Tell whether anything may be due after so many control steps of the episode."""
        return self.curriculum.may_act(step)

    def step(self, env: ScmWorldEnv) -> bool:
        """Do what is due after a control step; tell whether that was anything.

        Where several control steps have passed, what was due in between is done now.

        Raises:
            InterventionError: It was refused; nothing has changed.
        """
        now = env.world.index
        steps = range(self._last + 1, now + 1) if now > self._last else (now,)
        self._last = now
        acted = [self.curriculum.may_act(step) and self._act(env, step) for step in steps]
        return any(acted)

    def ended(self, *, success: bool) -> None:
        """Take an episode into account that has ended, and count it."""
        count(
            self.curriculum.part.live(self.memory, self.memory.episode),
            self.memory,
            success=success,
        )
        self.memory.episode += 1

    def _act(self, env: ScmWorldEnv, step: int) -> bool:
        """Intervene; first on what decides which bodies there are, for others have their names."""
        besides = self._besides
        head = frozenset(env.world.structures.head)
        space = self.curriculum.space
        first = self._asked(env.world, step, besides, head) if head else {}
        if not first:
            acts = self._asked(env.world, step, besides)
            if acts:
                env.do(acts, space=space)
            return bool(acts)
        before = env.snapshot()
        env.do(first, space=space)
        try:
            rest = self._asked(env.world, step, besides | head)
            if rest:
                env.do(rest, space=space)
        except BaseException:
            env.restore(before)
            raise
        return True

    def _asked(
        self,
        world: Simulation,
        step: int,
        besides: frozenset[str],
        first: frozenset[str] | None = None,
    ) -> Acts:
        memory, model = self.memory, world.model
        situation = Situation(world, memory.episode, step, memory, due=step == 0, first=first)
        situation = replace(situation, initial=self._initial)
        with blamed(f"the curriculum, in control step {step} of episode {memory.episode},"):
            acts = self.curriculum.part.acts(situation)
        if first is not None:
            acts = {name: act for name, act in acts.items() if name in first}

        def targets(name: str) -> tuple[str, ...]:
            return model.targets(name) if name in model else (name,)

        taken = {target for name in besides for target in targets(name)}
        return {
            name: act for name, act in acts.items() if not taken or taken.isdisjoint(targets(name))
        }


@final
class CurriculumEnv(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Intervenes on an environment, at its resets and within its episodes.

    What the caller of ``reset`` asks for in ``options["do"]`` counts more than the curriculum. All
    draws come from noises of their own, so that another part of a curriculum changes none of them.
    Observation and info are those after the interventions; an intervention is no progress, so it
    gives no reward, and the terms of the reward are those of the step. A reset that is refused is
    no episode: the next one has its number.

    Args:
        env: Of this package, in any wrappers that do not change what ``do`` means. Of those that
            change observations, an ``ObservationWrapper`` may be inside; one that remembers
            earlier observations belongs around this one.
        curriculum: A ``Curriculum``, a part of one, plain data, or an intervention.

    Raises:
        UnknownOption: It is no environment of this package, or no curriculum; or a wrapper inside
            would not know of interventions.
        InterventionError: The curriculum names something that does not exist. Where bodies come
            and go, that is said at a reset.

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
        RecordConstructorArgs.__init__(self, curriculum=_plain(made))
        super().__init__(env)
        self._inner = unwrapped_env(env, "CurriculumEnv")
        _refuse_forgetful(self._layers())
        self._checked = is_checked(made, self._inner.world)
        self._turn = CurriculumRunner(made)
        self._begun = self._running = self._stepped = self._success = False
        self._next: tuple[int, Memory] | None = None
        self._place: tuple[int, int] | None = None

    def _layers(self) -> Iterator[gymnasium.Wrapper[Any, Any, Any, Any]]:
        """List the wrappers inside of this one, from the outermost on."""
        env: Any = self.env
        while isinstance(env, gymnasium.Wrapper):
            yield env
            env = env.env

    @property
    def curriculum(self) -> Curriculum:
        """What is done."""
        return self._turn.curriculum

    @property
    def memory(self) -> Memory:
        """How many episodes there were, and how far the learner has come."""
        return self._turn.memory

    @property
    def where(self) -> tuple[int, int] | None:
        """Seed and episode, within the noise, of the next episode; of the present one in mid-way.

        None before the first reset.
        """
        world = self._inner.world
        if self._place is not None or not self._begun:
            return self._place
        return world.noise.seed, world.episode + (not self._running)

    @where.setter
    def where(self, where: tuple[int, int] | None) -> None:
        self._place, self._running = where, False

    def state(self) -> dict[str, Any]:
        """Return the state of the curriculum, as plain data.

        An episode that is not over begins again.
        """
        return {**self.memory.as_dict(), "noise": None if self.where is None else [*self.where]}

    def resume(self, state: dict[str, Any]) -> None:
        """Continue where ``state`` was taken, with the next reset, in any process.

        A seed, or an episode, that the reset is given counts more than that of the state.

        Args:
            state: What ``state`` gave.

        Raises:
            UnreadableFile: It is something else.
        """
        memory = Memory.from_dict(state)
        with state_read("state()"):
            where = place(state["noise"])
        self._turn.memory, self.where = memory, where

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

        Args:
            seed: Of the noise.
            options: As without this wrapper; what ``"do"`` sets, the curriculum leaves alone for
                the whole episode, and ``"episode"`` is the number of the episode for it, too.

        Raises:
            InterventionError: An intervention was refused.
        """
        given = reset_options(options, RESETS)
        self._close()
        if self._next is not None:
            episode, memory = self._next
            self._turn.memory = Memory(episode, memory.stages)
        elif given.get("episode") is not None:
            self._turn.memory.episode = whole_number("episode", given["episode"], least=0)
        if self._place is not None and seed is None:
            seed, number = self._place
            given = {"episode": number, **given}
        observation, info = self.env.reset(seed=seed, options=given)
        if not self._checked:
            self.curriculum.check(self._inner.world)
            self._checked = True
        if self._turn.begin(self._inner, besides=flatten(given.get("do") or {})):
            observation, info = self._seen(info)
        self._next = self._place = None
        self._begun = self._running = True
        return observation, info

    def _close(self) -> None:
        """Count the episode that ends."""
        if self._running and self._stepped:
            self._turn.ended(success=self._success)
        elif self._running:
            self.memory.episode += 1
        self._running = self._stepped = self._success = False

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Advance one control step, then do what is due.

        Raises:
            InterventionError: An intervention was refused; the control step is over.
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        over, success = terminated or truncated, bool(info.get("is_success"))
        self.stepped(self._inner.world.index, over=over, success=success)
        if not over and self.act():
            terms = info["reward_terms"]  # of the step: an intervention earns nothing
            observation, info = self._seen(info)
            info["reward_terms"] = terms
        return observation, reward, terminated, truncated, info

    def rerun(self, actions: Iterable[Any]) -> None:
        """Take the steps of an episode again, from its reset on."""
        for action in actions:
            self.step(action)

    def stepped(self, step: int, *, over: bool, success: bool) -> bool:
        """Note a control step; tell whether the curriculum may act after it."""
        self._stepped, self._success = True, success
        if over:
            self._close()
        return not over and self._turn.may_act(step)

    def act(self) -> bool:
        """Do what is due; tell whether that was anything."""
        return self._turn.step(self._inner)

    def _seen(self, info: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Look again, through the wrappers inside of this one."""
        seen, known = self._inner.present()
        for layer in reversed([*self._layers()]):
            if isinstance(layer, gymnasium.ObservationWrapper):
                seen = layer.observation(seen)
        return seen, {**info, **known}


def is_checked(curriculum: Curriculum, world: Simulation) -> bool:
    """Look for what is wrong; tell whether all names are known already.

    Raises:
        InterventionError: The curriculum names something that does not exist.
    """
    try:
        curriculum.check(world)
    except UnknownVariable:
        if not len(world.structures.head):
            raise
        return False
    return True


def place(given: Any) -> tuple[int, int] | None:
    """Read a seed and an episode.

    Raises:
        ValueError: It is something else.
    """
    if given is None:
        return None
    seed, episode = given
    return whole_number("seed", seed, least=0), whole_number("episode", episode, least=0)


def _plain(curriculum: Curriculum) -> Any:
    """Give plain data from which it can be made, so that a specification can be written down."""
    try:
        data = curriculum.as_dict()
        Curriculum.from_dict(data)
    except ModelError:  # it calls a function of the user's
        return curriculum
    return data


REMEMBER = ("DelayObservation", "NormalizeObservation")
"""Wrappers of Gymnasium that count how often they are asked."""


def _refuse_forgetful(layers: Iterator[gymnasium.Wrapper[Any, Any, Any, Any]]) -> None:
    """Refuse wrappers inside whose observations cannot be made again after an intervention."""
    for layer in layers:
        name = type(layer).__name__
        if isinstance(layer, gymnasium.ObservationWrapper) and name not in REMEMBER:
            continue
        if name in REMEMBER or layer.observation_space != layer.env.observation_space:
            allowed = (f"ObservationWrapper; put {name} around the curriculum",)
            raise UnknownOption("wrapper inside of CurriculumEnv", name, allowed)
