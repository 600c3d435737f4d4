"""What runs a curriculum: it counts episodes, remembers successes, and intervenes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, Protocol, final

from scm_world._types import Value
from scm_world.curricula.base import Acts
from scm_world.curricula.choices import count
from scm_world.curricula.curriculum import Curriculum, as_curriculum
from scm_world.curricula.moves import Interpolate
from scm_world.curricula.situations import Memory, Situation
from scm_world.world import World


class Doable(Protocol):
    """An environment that can be intervened on."""

    world: World

    def do(self, request: Mapping[str, Any], *, space: Any = None) -> Any:
        """Intervene now."""

    def snapshot(self) -> Any:
        """Save this instant."""

    def restore(self, snapshot: Any) -> None:
        """Go back to it."""


@final
class CurriculumRunner:
    """A curriculum at work.

    Args:
        curriculum: What is done.
        memory: Where it goes on; at the beginning if None.

    Attributes:
        curriculum: What is done.
        memory: The state that decides how it goes on.
    """

    def __init__(self, curriculum: Any, memory: Memory | None = None) -> None:
        self.curriculum: Curriculum = as_curriculum(curriculum)
        self.memory = Memory() if memory is None else memory
        self._waits = self.curriculum.steps_matter
        self._besides: frozenset[str] = frozenset()
        self._initial: dict[str, Value] = {}
        self._last = 0
        parts = self.curriculum.part.walk()
        self._moved = [
            name for part in parts if isinstance(part, Interpolate) for name in part.stop
        ]

    def begin(
        self, env: Doable, episode: int | None = None, *, besides: Iterable[str] = ()
    ) -> bool:
        """Do what is due at a reset, just after it.

        Args:
            env: At the beginning of an episode.
            episode: Its number; as many as have ended if None.
            besides: Variables that are left as they are in this episode, in whatever coordinates.

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
        return self._waits and self.curriculum.may_act(step)

    def step(self, env: Doable) -> bool:
        """Do what is due after a control step; tell whether that was anything.

        Where several control steps have passed, what was due in between is done now.

        Raises:
            InterventionError: It was refused; nothing has changed.
        """
        if not self._waits:
            return False
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

    def _act(self, env: Doable, step: int) -> bool:
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
        world: World,
        step: int,
        besides: frozenset[str],
        first: frozenset[str] | None = None,
    ) -> Acts:
        memory, model = self.memory, world.model
        situation = Situation(world, memory.episode, step, memory, due=step == 0, first=first)
        situation = replace(situation, initial=self._initial)
        acts = self.curriculum.part.acts(situation)
        if first is not None:
            acts = {name: act for name, act in acts.items() if name in first}

        def targets(name: str) -> tuple[str, ...]:
            return model.targets(name) if name in model else (name,)

        taken = {target for name in besides for target in targets(name)}
        return {
            name: act for name, act in acts.items() if not taken or taken.isdisjoint(targets(name))
        }
