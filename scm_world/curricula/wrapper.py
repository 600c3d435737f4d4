"""Curricula of environments: a plan for every reset, and what is due within the episode."""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar, final

import gymnasium
from gymnasium.utils import RecordConstructorArgs
from pydantic import NonNegativeInt

from scm_world._arguments import whole_number
from scm_world.curricula.base import Memory, Progress, Situation
from scm_world.curricula.curriculum import Curriculum, as_curriculum
from scm_world.env.arguments import RESETS, reset_options, structure_after
from scm_world.env.copies import EnvSnapshot
from scm_world.env.wrappers import unwrapped_env
from scm_world.errors import ModelError, UnknownOption, UnreadableFile
from scm_world.graph import NoiseKey, flatten
from scm_world.queries.plans import Key, Plan, Schedule
from scm_world.variables import Noise
from scm_world.variables.spaces import Frozen
from scm_world.world.compiled_task import CompiledTask


@final
class State(Memory):
    """The state of a curriculum in an environment.

    Attributes:
        noise: Seed and episode, within the noise, of the next or unfinished episode; None before
            the first reset.
    """

    noise: tuple[NonNegativeInt, NonNegativeInt] | None


ADVICE = "give what state() returned, of as many environments"
Read = TypeVar("Read", bound=Frozen)


def read_state(kind: type[Read], data: Any) -> Read:
    """Return the state that was written as plain data.

    Raises:
        UnreadableFile: It is something else.
    """
    build: Any = kind
    try:
        found: Read = build(**data)
    except (TypeError, ValueError) as error:
        said = "; ".join(getattr(error, "problems", (str(error),)))
        raise UnreadableFile("the state of a curriculum", said, ADVICE) from None
    return found


@dataclass
class _Now:
    """The present episode of a curriculum, or the next one where it is not running.

    Attributes:
        number: Number of the episode within the curriculum.
        stages: Progress in each part with stages, by its key.
        place: Seed and episode of the noise of the next episode, if these were set.
        running: Whether the episode is under way.
        stepped: Whether it has taken a step.
        success: Whether the task was solved at its last step.
        memory: The memory at its beginning.
        noise: Its noise, and its number within that.
        besides: The variables that the curriculum leaves alone.
        staged: The keys of the parts with stages that act in it.
        schedule: The plan of the episode.
        fired: When events of the plan occurred.
        due: The control steps for which something may be due now.
        last: The last control step that was looked at.
        ended: Of the episodes that a vector environment has not counted yet: the parts with
            stages, and the success.
    """

    number: int = 0
    stages: dict[str, Progress] = field(default_factory=dict)
    place: tuple[int, int] | None = None
    running: bool = False
    stepped: bool = False
    success: bool = False
    memory: Memory | None = None
    noise: tuple[Noise, int] = (Noise(0), 0)
    besides: frozenset[str] = frozenset()
    staged: set[str] = field(default_factory=set)
    schedule: Schedule = field(default_factory=Schedule)
    fired: dict[Key, int] = field(default_factory=dict)
    due: tuple[int, ...] = ()
    last: int = 0
    ended: tuple[tuple[tuple[str, ...], bool], ...] = ()

    def copy(self) -> _Now:
        """Return a copy that later steps do not change."""
        return replace(self, staged=set(self.staged), fired=dict(self.fired))


@final
class CurriculumEnv(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Intervenes on an environment, at its resets and within its episodes.

    ``options["do"]`` of ``reset`` counts more than the curriculum; both are one intervention. All
    draws have noise streams of their own, so that another part of a curriculum changes none of
    them. Observation and info are those after the interventions; an intervention gives no reward,
    and the terms of the reward are those of the step. A reset that is refused is no episode: the
    next one has its number.

    Args:
        env: An environment of this package, in any wrappers that do not change the meaning of
            ``do``. Of those that change observations, an ``ObservationWrapper`` may be inside; one
            that remembers earlier observations belongs around this one.
        curriculum: A ``Curriculum``, a part of one, plain data, or an intervention.

    Raises:
        UnknownOption: It is no environment of this package, or no curriculum; or a wrapper inside
            would not know of interventions.
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
        self.curriculum: Curriculum = as_curriculum(curriculum)
        RecordConstructorArgs.__init__(self, curriculum=_plain(self.curriculum))
        super().__init__(env)
        self._inner = unwrapped_env(env, "CurriculumEnv")
        _refuse_forgetful(self._layers())
        self.curriculum.check(self._inner.world)
        self._now = _Now()
        self._lane: tuple[int, int] | None = None

    def _layers(self) -> Iterator[gymnasium.Wrapper[Any, Any, Any, Any]]:
        """List the wrappers inside of this one, from the outermost on."""
        env: Any = self.env
        while isinstance(env, gymnasium.Wrapper):
            yield env
            env = env.env

    # --- the state between episodes ---------------------------------------------------------------

    @property
    def memory(self) -> Memory:
        """The number of the present or next episode, and how far the learner has come."""
        return Memory(episode=self._now.number, stages=self._now.stages)

    def state(self) -> dict[str, Any]:
        """Return the state of the curriculum, as plain data.

        An episode that is not over begins again.
        """
        now, world, place = self._now, self._inner.world, self._now.place
        if place is None and now.memory is not None:
            place = world.noise.seed, world.episode + (not now.running)
        found = State(episode=now.number, stages=now.stages, noise=place)
        return found.model_dump(mode="json")

    def resume(self, state: dict[str, Any]) -> None:
        """Continue from a state, with the next reset, in any process.

        A seed, or an episode, of the reset counts more than that of the state.

        Args:
            state: The answer of ``state``.

        Raises:
            UnreadableFile: It is something else.
        """
        read = read_state(State, state)
        self._now = replace(
            self._now, number=read.episode, stages=read.stages, place=read.noise, running=False
        )

    saved = property(state, resume, doc="The state, for vector environments: they set attributes.")

    @property
    def begun(self) -> dict[str, Any]:
        """The state from which the present episode began, as plain data."""
        memory = self._now.memory or self.memory
        return {**self.state(), "stages": memory.model_dump(mode="json")["stages"]}

    @property
    def stages(self) -> dict[str, Progress]:
        """Progress in each part with stages, by its key."""
        return self._now.stages

    @stages.setter
    def stages(self, stages: dict[str, Progress]) -> None:
        self._now.stages, self._now.ended = stages, ()

    @property
    def ended(self) -> tuple[tuple[tuple[str, ...], bool], ...]:
        """Of episodes since ``stages`` was set: the keys of the parts with stages, the success."""
        return self._now.ended

    @property
    def lane(self) -> tuple[int, int] | None:
        """Index among the members of a vector environment, and their number.

        Member i of n plays the episodes i, i + n, i + 2 n, …
        """
        return self._lane

    @lane.setter
    def lane(self, lane: tuple[int, int]) -> None:
        self._lane, self._now.number = lane, lane[0]

    def snapshot(self) -> EnvSnapshot:
        """Save all that decides the future of the episode, the plan included.

        Raises:
            NotReset: There is no episode yet.
        """
        found: EnvSnapshot = self.env.get_wrapper_attr("snapshot")()
        return replace(found, memory=(self._now.copy(), found.memory))

    def restore(self, snapshot: EnvSnapshot) -> None:
        """Go back to a snapshot, bit for bit.

        Raises:
            SnapshotMismatch: It is none, or one of another task or backend.
        """
        memory = getattr(snapshot, "memory", None)
        if memory is None:
            self.env.get_wrapper_attr("restore")(snapshot)
        else:
            self.env.get_wrapper_attr("restore")(replace(snapshot, memory=memory[1]))
            self._now = memory[0].copy()

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
        self._close()
        now, world, number = self._now, self._inner.world, 0
        if given.get("episode") is not None:
            now.number = whole_number("episode", given["episode"], least=0)
        if seed is None and now.place is not None:
            seed, number = now.place
            given = {"episode": number, **given}
        elif seed is None and world.has_begun:
            number = world.episode + 1
        elif seed is None:
            seed = secrets.randbits(63)
        noise = world.noise.seed if seed is None else whole_number("seed", seed, least=0)
        if given.get("episode") is not None:
            number = given["episode"]
        mine = self._begin(noise, number, flatten(given.get("do") or {}))
        found = self.env.reset(seed=seed, options={**given, **mine})
        now.place, now.running = None, True
        return found

    def _begin(self, seed: int, number: int, mine: Mapping[str, Any]) -> dict[str, Any]:
        """Plan an episode, and return the options of its reset."""
        now, env, world = self._now, self._inner, self._inner.world
        now.memory, now.noise, now.besides = self.memory, (Noise(seed), number), frozenset(mine)
        now.staged, now.fired, now.due, now.last = set(), {}, (), 0
        compiled = world.structures.natural(None)
        if len(world.structures.head):
            key, held = NoiseKey(now.noise[0], number, origin=0), world.structures.head
            first = self._plan(compiled, frozenset(held)).at_start()
            acts = env.beginning({**first, **mine})
            compiled = structure_after(world.structures, acts, held, held.solve(), key) or compiled
        plan = self._plan(compiled)
        now.schedule = Schedule([(0, plan)])
        options: dict[str, Any] = {"do": {**plan.at_start(), **mine}}
        space = self.curriculum.space
        return options if space is None else {**options, "space": space}

    def _plan(self, compiled: CompiledTask, first: frozenset[str] | None = None) -> Plan:
        now = self._now
        memory = now.memory or self.memory
        situation = Situation(memory, compiled, *now.noise, first=first, staged=now.staged)
        return self.curriculum.plan(situation, now.besides)

    def _close(self) -> None:
        """Count the episode that ends; stages count it if it took a step."""
        now = self._now
        if not now.running:
            return
        now.running = False
        if now.stepped and now.staged:
            now.stages = self.curriculum.counted(now.stages, now.staged, success=now.success)
            if self._lane is not None:
                now.ended = (*now.ended, (tuple(now.staged), now.success))
        now.stepped = now.success = False
        index, several = self._lane or (0, 1)
        now.number += 1 + (index - now.number - 1) % several

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
        """Note a control step; return whether the curriculum may act after it.

        Where several control steps have passed, what was due in between is due now.
        """
        now = self._now
        now.stepped, now.success = True, success
        if over:
            self._close()
            return False
        steps = range(now.last + 1, step + 1) if step > now.last else (step,)
        now.fired = {key: at for key, at in now.fired.items() if at < step}
        world = self._inner.world
        now.due = tuple(at for at in steps if now.schedule.concerns(world, at, now.fired))
        now.last = step
        return bool(now.due)

    def act(self) -> bool:
        """Do what is due; return whether that was anything.

        Raises:
            InterventionError: It was refused; nothing has changed.
        """
        now, env, world, acted = self._now, self._inner, self._inner.world, False
        for step in now.due:
            due = now.schedule.due(world, step, now.fired)
            if any(name in world.structures.head for name in due):  # names mean what comes
                where = world.current()[0], world.noise_key(world.index)
                found = structure_after(world.structures, due, world.graph, *where)
                now.schedule = Schedule([(0, self._plan(found or world.compiled))])
                due = now.schedule.due(world, step, now.fired)
            if due:
                env.do(due, space=self.curriculum.space)
                acted = True
        return acted


def _plain(curriculum: Curriculum) -> Any:
    """Return plain data from which it can be made, so that a specification can be written."""
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
