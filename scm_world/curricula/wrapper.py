"""Curricula of environments: a plan for every reset, and what is due within the episode."""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, final

import gymnasium
from gymnasium.utils import RecordConstructorArgs

from scm_world._arguments import whole_number
from scm_world.curricula.base import Memory, Situation, state_read
from scm_world.curricula.combinations import count
from scm_world.curricula.curriculum import Curriculum, as_curriculum
from scm_world.env import ScmWorldEnv
from scm_world.env.arguments import RESETS, reset_options, structure_after
from scm_world.env.wrappers import unwrapped_env
from scm_world.errors import ModelError, UnknownOption
from scm_world.graph import NoiseKey, flatten
from scm_world.queries.plans import Key, Plan, Schedule
from scm_world.variables import Noise
from scm_world.world.compiled_task import CompiledTask


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
        self._where = Noise(0), 0
        self._besides: frozenset[str] = frozenset()
        self._schedule = Schedule()
        self._fired: dict[Key, int] = {}
        self._due: list[int] = []
        self._last = 0

    def begin(
        self, env: ScmWorldEnv, seed: int, number: int, do: Mapping[str, Any] | None = None
    ) -> dict[str, Any]:
        """Plan an episode, and return the options of its reset.

        Args:
            env: Before the reset.
            seed: Of the noise.
            number: Of the episode within the noise.
            do: What the caller does at the reset: the curriculum leaves these variables alone, in
                any coordinates.

        Raises:
            InterventionError: The curriculum names something that does not exist.
        """
        mine, world = flatten(do or {}), env.world
        self._where, self._besides = (Noise(seed), number), frozenset(mine)
        self._fired, self._due, self._last = {}, [], 0
        compiled = world.structures.natural(None)
        if len(world.structures.head):
            key, held = NoiseKey(self._where[0], number, origin=0), world.structures.head
            first = self._plan(compiled, frozenset(held)).at_start()
            acts = env.beginning({**first, **mine})
            compiled = structure_after(world.structures, acts, held, held.solve(), key) or compiled
        plan = self._plan(compiled)
        self._schedule = Schedule([(0, plan)])
        options: dict[str, Any] = {"do": {**plan.at_start(), **mine}}
        space = self.curriculum.space
        return options if space is None else {**options, "space": space}

    def _plan(self, compiled: CompiledTask, first: frozenset[str] | None = None) -> Plan:
        memory, (noise, number) = self.memory, self._where
        situation = Situation(memory.episode, memory, compiled, noise, number, first=first)
        return self.curriculum.plan(situation, self._besides)

    def stepped(self, env: ScmWorldEnv, step: int) -> bool:
        """Note that so many control steps are over; tell whether anything may be due now.

        Where several control steps have passed, what was due in between is due now.
        """
        steps = range(self._last + 1, step + 1) if step > self._last else (step,)
        self._fired = {key: at for key, at in self._fired.items() if at < step}
        self._due = [at for at in steps if self._schedule.concerns(env.world, at, self._fired)]
        self._last = step
        return bool(self._due)

    def act(self, env: ScmWorldEnv) -> bool:
        """Do what is due; tell whether that was anything.

        Raises:
            InterventionError: It was refused; nothing has changed.
        """
        world, acted = env.world, False
        for step in self._due:
            due = self._schedule.due(world, step, self._fired)
            if any(name in world.structures.head for name in due):  # names mean what there is then
                now = world.row, world.noise_key(world.index)
                found = structure_after(world.structures, due, world.graph, *now)
                self._schedule = Schedule([(0, self._plan(found or world.compiled))])
                due = self._schedule.due(world, step, self._fired)
            if due:
                env.do(due, space=self.curriculum.space)
                acted = True
        return acted

    def ended(self, *, success: bool) -> None:
        """Take an episode into account that has ended, and count it."""
        parts = self.curriculum.part.live(self.memory, self.memory.episode)
        count(parts, self.memory, success=success)
        self.memory.episode += 1


@final
class CurriculumEnv(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Intervenes on an environment, at its resets and within its episodes.

    What the caller of ``reset`` asks for in ``options["do"]`` counts more than the curriculum; both
    are one intervention. All draws come from noises of their own, so that another part of a
    curriculum changes none of them. Observation and info are those after the interventions; an
    intervention gives no reward, and the terms of the reward are those of the step. A reset that is
    refused is no episode: the next one has its number.

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
        made.check(self._inner.world)
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
        """The number of the next episode, and the memory then, if a vector environment set them."""
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
            self._turn.memory = Memory(self._next[0], self._next[1].stages)
        elif given.get("episode") is not None:
            self.memory.episode = whole_number("episode", given["episode"], least=0)
        world, number = self._inner.world, 0
        if seed is None and self._place is not None:
            seed, number = self._place
            given = {"episode": number, **given}
        elif seed is None and world.has_begun:
            number = world.episode + 1
        elif seed is None:
            seed = secrets.randbits(63)
        noise = world.noise.seed if seed is None else whole_number("seed", seed, least=0)
        if given.get("episode") is not None:
            number = given["episode"]
        mine = self._turn.begin(self._inner, noise, number, given.get("do"))
        found = self.env.reset(seed=seed, options={**given, **mine})
        self._next = self._place = None
        self._begun = self._running = True
        return found

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
        if self.stepped(self._inner.world.index, over=over, success=success) and self.act():
            terms = info["reward_terms"]  # of the step: an intervention earns nothing
            observation, known = self._inner.present()
            for layer in reversed([*self._layers()]):
                if isinstance(layer, gymnasium.ObservationWrapper):
                    observation = layer.observation(observation)
            info = {**info, **known, "reward_terms": terms}
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
        return not over and self._turn.stepped(self._inner, step)

    def act(self) -> bool:
        """Do what is due, after the plan of the reset; return whether that was anything."""
        return self._inner.act() | self._turn.act(self._inner)


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
    """Return plain data from which it can be made, so that a specification can be written down."""
    try:
        data = curriculum.as_dict()
        Curriculum.from_dict(data)
    except ModelError:  # it calls a function of the user's
        return curriculum
    return data


REMEMBER = ("DelayObservation", "NormalizeObservation")
"""Wrappers of Gymnasium that count how often they are asked."""


def _refuse_forgetful(layers: Iterable[gymnasium.Wrapper[Any, Any, Any, Any]]) -> None:
    """Refuse wrappers inside whose observations cannot be made again after an intervention."""
    for layer in layers:
        name = type(layer).__name__
        if isinstance(layer, gymnasium.ObservationWrapper) and name not in REMEMBER:
            continue
        if name in REMEMBER or layer.observation_space != layer.env.observation_space:
            allowed = (f"ObservationWrapper; put {name} around the curriculum",)
            raise UnknownOption("wrapper inside of CurriculumEnv", name, allowed)
