"""Curricula of environments: a plan for every reset."""

from __future__ import annotations

import secrets
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar, final

import gymnasium
from gymnasium.utils import RecordConstructorArgs
from pydantic import NonNegativeInt

from scm_world._arguments import whole_number
from scm_world.curricula.base import Memory, Progress, Situation
from scm_world.curricula.combinations import over
from scm_world.curricula.curriculum import Curriculum, as_curriculum
from scm_world.env.arguments import RESETS, reset_options, structure_after
from scm_world.env.copies import EnvSnapshot
from scm_world.env.wrappers import unwrapped_env
from scm_world.errors import ModelError, UnreadableFile
from scm_world.graph import NoiseKey
from scm_world.queries.plans import Plan
from scm_world.variables import Noise
from scm_world.variables.spaces import Frozen


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
        begun: The memory at the beginning of the last episode that began.
        staged: The keys of the parts with stages that act in it.
        running: Whether it is under way.
        ended: Of the episodes that a vector environment has not counted yet: the parts with
            stages, and the success.
    """

    number: int = 0
    stages: dict[str, Progress] = field(default_factory=dict)
    place: tuple[int, int] | None = None
    begun: Memory | None = None
    staged: tuple[str, ...] = ()
    running: bool = False
    ended: tuple[tuple[tuple[str, ...], bool], ...] = ()


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
        curriculum: A ``Curriculum``, a part of one, plain data, or an intervention.

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
        self.curriculum: Curriculum = as_curriculum(curriculum)
        RecordConstructorArgs.__init__(self, curriculum=_plain(self.curriculum))
        super().__init__(env)
        self._inner = unwrapped_env(env, "CurriculumEnv")
        self.curriculum.check(self._inner.world)
        self._now = _Now()
        self._lane: tuple[int, int] | None = None

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
        if place is None and now.begun is not None:
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
        self._now = _Now(read.episode, read.stages, read.noise, self._now.begun)

    saved = property(state, resume, doc="The state, for vector environments: they set attributes.")

    @property
    def begun(self) -> dict[str, Any]:
        """The state from which the present episode began, as plain data."""
        memory = self._now.begun or self.memory
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
        return replace(found, memory=(replace(self._now), found.memory))

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
            self._now = replace(memory[0])

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
        now, world, number = self._now, self._inner.world, 0
        if now.running:
            self.over(success=world.index > 0 and self._inner.present()[1].get("is_success"))
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
        given["do"], staged = self._plan(Noise(noise), number, Plan(given.get("do")))
        if self.curriculum.space is not None:
            given["space"] = self.curriculum.space
        found = self.env.reset(seed=seed, options=given)
        now.place, now.begun, now.staged, now.running = None, self.memory, staged, True
        return found

    def _plan(self, noise: Noise, number: int, mine: Plan) -> tuple[Plan, tuple[str, ...]]:
        """Return the plan of an episode, and the parts with stages that act in it."""
        structures, besides = self._inner.world.structures, mine.at_start()
        situation = Situation(self.memory, structures.natural(None), noise, number)
        if len(structures.head):
            held, key = structures.head, NoiseKey(noise, number, origin=0)
            first = replace(situation, first=frozenset(held))
            acts = self._inner.beginning(
                over(first.model, self.curriculum.plan(first, besides), mine)
            )
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
        now = self._now
        if not now.running:
            return
        now.running = False
        if now.staged and self._inner.world.index > 0:
            now.stages = self.curriculum.counted(now.stages, now.staged, success=success)
            if self._lane is not None:
                now.ended = (*now.ended, (now.staged, success))
        index, several = self._lane or (0, 1)
        now.number += 1 + (index - now.number - 1) % several

    def rerun(self, actions: Any) -> None:
        """Take the steps of an episode again, from its reset on."""
        for action in actions:
            self.step(action)


def _plain(curriculum: Curriculum) -> Any:
    """Return plain data from which it can be made, so that a specification can be written."""
    try:
        data = curriculum.as_dict()
        Curriculum.from_dict(data)
    except ModelError:  # it calls a function of the user's
        return curriculum
    return data
