"""Which parts of a curriculum act: all, one after another, one by lot, or the one that is due."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, Literal, final

import numpy as np

from scm_world._arguments import whole_number
from scm_world.curricula.base import Acts, AnyPart, Part, as_part
from scm_world.curricula.situations import Memory, Progress, Situation
from scm_world.errors import UnknownOption
from scm_world.world.plan import merged


class _Several(Part):
    """Something that is made of several parts.

    Attributes:
        of: The parts.
    """

    of: tuple[AnyPart, ...]

    def parts(self) -> tuple[Part, ...]:
        """List them."""
        return self.of


@final
class Together(_Several):
    """All at once; of two that set one quantity the later one counts."""

    kind: Literal["together"] = "together"

    def acts(self, situation: Situation) -> Acts:
        """Put them over one another."""
        return merged(situation.compiled.model, *(part.acts(situation) for part in self.of))


@final
class InTurn(_Several):
    """One after another, from episode to episode, and again from the first one.

    Attributes:
        each: How many episodes each of them lasts.
    """

    kind: Literal["in_turn"] = "in_turn"
    each: int = 1

    def acts(self, situation: Situation) -> Acts:
        """Let the one act whose turn it is."""
        return self._present(situation.episode).acts(situation)

    def _present(self, episode: int) -> Part:
        return self.of[episode // self.each % len(self.of)]

    def live(self, memory: Memory, episode: int) -> Iterator[Part]:
        """List it and the one whose turn it is."""
        yield self
        yield from self._present(episode).live(memory, episode)


@final
class Weighted(_Several):
    """One of them by lot, in each episode.

    Attributes:
        weights: Their probabilities are in proportion to these.
    """

    kind: Literal["weighted"] = "weighted"
    weights: tuple[float, ...]

    def acts(self, situation: Situation) -> Acts:
        """Let the one act that was drawn at the beginning of the episode."""
        ends = np.cumsum(self.weights)
        drawn = replace(situation, step=0).uniform(self.key) * ends[-1]
        chosen = int(np.searchsorted(ends, drawn, side="right"))
        return self.of[min(chosen, len(self.of) - 1)].acts(situation)  # a product may round up


@final
class Stages(_Several):
    """One stage after another, as the learner succeeds.

    Attributes:
        up: The next stage begins when this share of the last episodes were successes.
        down: The stage before comes back when the share is this or less; never if None.
        window: How many episodes of a stage count.
    """

    kind: Literal["stages"] = "stages"
    up: float = 0.8
    down: float | None = None
    window: int = 100

    def acts(self, situation: Situation) -> Acts:
        """Let the present stage act."""
        return self.of[self.progress(situation.memory).level].acts(situation)

    def live(self, memory: Memory, episode: int) -> Iterator[Part]:
        """List it and the present stage."""
        yield self
        yield from self.of[self.progress(memory).level].live(memory, episode)

    def progress(self, memory: Memory) -> Progress:
        """Give what is remembered of this part."""
        return memory.stages.setdefault(self.key, Progress())

    def ended(self, memory: Memory, *, success: bool) -> None:
        """Take an episode into account."""
        kept = self.progress(memory)
        kept.recent.append(success)
        while len(kept.recent) > self.window:
            kept.recent.popleft()
        if len(kept.recent) < self.window:
            return
        share = sum(kept.recent) / self.window
        step = 1 if share >= self.up else -1 if self.down is not None and share <= self.down else 0
        level = min(max(kept.level + step, 0), len(self.of) - 1)
        if level != kept.level:
            kept.level = level
            kept.recent.clear()


def count(parts: Iterable[Part], memory: Memory, *, success: bool) -> None:
    """Take an episode into account, for all stages that acted in it.

    Args:
        parts: What could act.
        memory: Of the curriculum.
        success: Whether the task was solved at the end.
    """
    stages_by_key = {part.key: part for part in parts if isinstance(part, Stages)}
    for part in stages_by_key.values():
        part.ended(memory, success=success)


def _several(option: str, given: Iterable[Any]) -> tuple[Part, ...]:
    made = tuple(as_part(part) for part in given)
    if not made:
        raise UnknownOption(option, (), ("one part or more",))
    return made


def together(*parts: Any) -> Together:
    """Do all of it; of two that set one quantity the later one counts.

    Raises:
        UnknownOption: There is no part.

    Example:
        >>> both = together({"floor_friction": 0.4}, {"tool_block.mass": 0.03})
        >>> [list(part.request) for part in both.of]
        [['floor_friction'], ['tool_block.mass']]
    """
    return Together(of=_several("together", parts))


def in_turn(*parts: Any, each: int = 1) -> InTurn:
    """Do one of it in ``each`` episodes, then the next.

    Raises:
        UnknownOption: There is no part, or ``each`` is no positive whole number.

    Example:
        >>> in_turn({"gravity": [0.0, 0.0, -9.8]}, {}, each=10).each
        10
    """
    each = whole_number("each", each, least=1)
    return InTurn(of=_several("in_turn", parts), each=each)


def weighted(*pairs: tuple[float, Any]) -> Weighted:
    """Do one of it by lot, anew in each episode.

    Args:
        pairs: A weight and a part each.

    Raises:
        UnknownOption: There is no pair, or a weight is no positive number.

    Example:
        >>> weighted((3.0, {"floor_friction": 0.4}), (1.0, {})).weights
        (3.0, 1.0)
    """
    for pair in pairs:
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise UnknownOption("weighted", pair, ("pairs of a weight and a part",))
        if isinstance(pair[0], bool) or not isinstance(pair[0], int | float):
            raise UnknownOption("weight", pair[0], ("any positive number",))
        if not 0.0 < pair[0] < float("inf"):
            raise UnknownOption("weight", pair[0], ("any positive number",))
    weights = tuple(float(weight) for weight, _ in pairs)
    return Weighted(of=_several("weighted", (part for _, part in pairs)), weights=weights)


def stages(*parts: Any, up: float = 0.8, down: float | None = None, window: int = 100) -> Stages:
    """Do the first of it, and the next one once the learner succeeds.

    Args:
        parts: The stages, the easiest one first.
        up: Share of successes from which the next stage begins, in (0, 1].
        down: Share from which down the stage before comes back; never if None.
        window: How many episodes count.

    Raises:
        UnknownOption: There is no part, a share is none, or ``down`` is not below ``up``.

    Example:
        >>> stages({}, {"tool_block.mass": 0.08}, up=0.9, window=50).window
        50
    """
    window = whole_number("window", window, least=1)
    if not 0.0 < up <= 1.0:
        raise UnknownOption("up", up, ("a share above 0 and up to 1",))
    if down is not None and not 0.0 <= down < up:
        raise UnknownOption("down", down, (f"a share from 0 up to less than {up:g}", "None"))
    return Stages(of=_several("stages", parts), up=up, down=down, window=window)
