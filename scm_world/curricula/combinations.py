"""When parts of a curriculum act, and which of several."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Literal, final

import numpy as np

from scm_world._arguments import whole_number
from scm_world.curricula.base import (
    AnyPart,
    Memory,
    Part,
    Progress,
    Situation,
    as_part,
    in_time,
    over,
)
from scm_world.errors import UnknownOption
from scm_world.variables import Time

# --- when -----------------------------------------------------------------------------------------


@final
class Timed(Part):
    """Act at certain times of every episode; what has a time of its own keeps it.

    Attributes:
        time: Of what has none.
        part: What acts: a part, or an intervention.
    """

    kind: Literal["timed"] = "timed"
    time: Time
    part: AnyPart

    def __init__(self, time: Any, part: Any, **fields: Any) -> None:
        super().__init__(time=time, part=as_part(part), **fields)

    def parts(self) -> tuple[Part, ...]:
        """Return what acts."""
        return (self.part,)

    def acts(self, situation: Situation) -> Mapping[str, Any]:
        """Return the interventions of the part, at its time."""
        if situation.time is None and self.time == _RESET:
            return self.part.plan(situation)
        return self.part.plan(in_time(situation, self.time))


_RESET = Time(at=0)


def at_reset(part: Any) -> Timed:
    """Act at the beginning of every episode; so does what has no time of its own.

    Example:
        >>> at_reset({"floor_friction": 0.4}).time
        Time(at=0)
    """
    return Timed(_RESET, part)


def at_step(step: int, part: Any) -> Timed:
    """Act after so many control steps of every episode; 0 is the reset."""
    return Timed(Time(at=step), part)


def every(steps: int, part: Any, *, first: int = 0) -> Timed:
    """Act again and again within every episode.

    Args:
        steps: Control steps from one time to the next.
        part: What acts: a part, or an intervention.
        first: The first control step at which it acts; 0 is the reset.
    """
    return Timed(Time(every=steps, at=first), part)


def when(event: Any, part: Any) -> Timed:
    """Act at the first control step of every episode at which an event is there.

    Args:
        event: ``Contact(first, second)`` or ``Reaches(name, above=…)``.
        part: What acts: a part, or an intervention.
    """
    return Timed(Time(when=event), part)


@final
class During(Part):
    """Act in some episodes only, which count from 0; ``during`` in a sentence.

    Its arguments are a range of episodes, whose step is the period, and what acts: a part, or an
    intervention.

    Attributes:
        first: The first episode.
        stop: The one after the last; None if there is no last one.
        period: Episodes from one time to the next.

    Raises:
        UnknownOption: It is no range of whole numbers that are not negative, or no part.

    Example:
        >>> During(range(10, 20, 5), {"floor_friction": 0.4}).period
        5
    """

    kind: Literal["during"] = "during"
    part: AnyPart
    first: int = 0
    stop: int | None = None
    period: int = 1

    def __init__(self, episodes: Any = None, part: Any = None, **fields: Any) -> None:
        if episodes is not None:
            usable = isinstance(episodes, range) and episodes.step > 0 <= episodes.start
            if not (usable and len(episodes)):
                allowed = ("a range such as range(1_000, 5_000)", "range(first, stop, period)")
                raise UnknownOption("episodes", episodes, allowed)
            fields |= {"first": episodes.start, "stop": episodes.stop, "period": episodes.step}
        fields["first"] = whole_number("first", fields.get("first", 0), least=0)
        fields["period"] = whole_number("period", fields.get("period", 1), least=1)
        if fields.get("stop") is not None:
            fields["stop"] = whole_number("stop", fields["stop"], least=fields["first"] + 1)
        super().__init__(part=as_part(part), **fields)

    def parts(self) -> tuple[Part, ...]:
        """Return what acts."""
        return (self.part,)

    def acts(self, situation: Situation) -> Mapping[str, Any]:
        """Return the interventions of the part, in its episodes."""
        return self.part.plan(situation) if self._includes(situation.episode) else {}

    def _includes(self, episode: int) -> bool:
        since = episode - self.first
        ended = self.stop is not None and episode >= self.stop
        return since >= 0 and not since % self.period and not ended

    def live(self, memory: Memory, episode: int) -> Iterator[Part]:
        """List it, and what acts in its episodes if this is one."""
        yield self
        if self._includes(episode):
            yield from self.part.live(memory, episode)


# --- which ----------------------------------------------------------------------------------------


class _Several(Part):
    """Something that is made of several parts, which are its arguments.

    Attributes:
        of: The parts.
    """

    of: tuple[AnyPart, ...]

    def __init__(self, *parts: Any, **fields: Any) -> None:
        made = tuple(as_part(part) for part in (*parts, *fields.pop("of", ())))
        if not made:
            kind = str(type(self).model_fields["kind"].default)
            raise UnknownOption(kind, (), ("one part or more",))
        super().__init__(of=made, **fields)

    def parts(self) -> tuple[Part, ...]:
        """List them."""
        return self.of


@final
class Together(_Several):
    """Do all together; of two on one quantity at one time the later one counts; ``together``.

    Raises:
        UnknownOption: There is no part.

    Example:
        >>> both = Together({"floor_friction": 0.4}, {"tool_block.mass": 0.03})
        >>> [list(part.request) for part in both.of]
        [['floor_friction'], ['tool_block.mass']]
    """

    kind: Literal["together"] = "together"

    def __init__(self, *parts: Any, **fields: Any) -> None:
        super().__init__(*parts, **fields)

    def acts(self, situation: Situation) -> Mapping[str, Any]:
        """Put them over one another."""
        return over(situation.model, *(part.plan(situation) for part in self.of))


class _Chosen(_Several):
    """Several parts of which the episode and the progress of the learner choose one."""

    def __init__(self, *parts: Any, **fields: Any) -> None:
        super().__init__(*parts, **fields)

    @abstractmethod
    def chosen(self, memory: Memory, episode: int) -> Part:
        """Return the part that acts in an episode."""

    def acts(self, situation: Situation) -> Mapping[str, Any]:
        """Return the interventions of that part."""
        return self.chosen(situation.memory, situation.episode).plan(situation)

    def live(self, memory: Memory, episode: int) -> Iterator[Part]:
        """List it and that part."""
        yield self
        yield from self.chosen(memory, episode).live(memory, episode)


@final
class InTurn(_Chosen):
    """Do one after another, and again from the first one; ``in_turn`` in a sentence.

    Attributes:
        each: How many episodes each of them lasts.

    Raises:
        UnknownOption: There is no part, or ``each`` is no positive whole number.

    Example:
        >>> InTurn({"gravity": [0.0, 0.0, -9.8]}, {}, each=10).each
        10
    """

    kind: Literal["in_turn"] = "in_turn"
    each: int = 1

    def __init__(self, *parts: Any, each: Any = 1, **fields: Any) -> None:
        super().__init__(*parts, each=whole_number("each", each, least=1), **fields)

    def chosen(self, memory: Memory, episode: int) -> Part:
        """Return the part whose turn it is."""
        return self.of[episode // self.each % len(self.of)]


@final
class Weighted(_Several):
    """Do one that is drawn in each episode; ``weighted`` in a sentence.

    Its arguments are pairs of a weight and a part.

    Attributes:
        weights: Probabilities are in proportion to these.

    Raises:
        UnknownOption: There is no pair, or a weight is no positive number.

    Example:
        >>> Weighted((3.0, {"floor_friction": 0.4}), (1.0, {})).weights
        (3.0, 1.0)
    """

    kind: Literal["weighted"] = "weighted"
    weights: tuple[float, ...]

    def __init__(self, *pairs: Any, **fields: Any) -> None:
        for pair in pairs:
            if not isinstance(pair, tuple | list) or len(pair) != 2:
                raise UnknownOption("weighted", pair, ("pairs of a weight and a part",))
        weights = (*(weight for weight, _ in pairs), *fields.pop("weights", ()))
        for weight in weights:
            is_number = isinstance(weight, int | float) and not isinstance(weight, bool)
            if not is_number or not 0.0 < weight < float("inf"):
                raise UnknownOption("weight", weight, ("any positive number",))
        super().__init__(*(part for _, part in pairs), weights=tuple(map(float, weights)), **fields)

    def acts(self, situation: Situation) -> Mapping[str, Any]:
        """Return the interventions of the part that was drawn for the episode."""
        ends = np.cumsum(self.weights)
        drawn = in_time(situation, None).uniform(self.key) * ends[-1]
        place = int(np.searchsorted(ends, drawn, side="right"))
        return self.of[min(place, len(self.of) - 1)].plan(situation)  # a product may round up


@final
class Stages(_Chosen):
    """Do the first, and the next one once the learner succeeds; ``stages`` in a sentence.

    Attributes:
        up: Share of successes from which the next stage begins, in (0, 1].
        down: Share from which down the stage before comes back; never if None.
        window: How many episodes of a stage count.

    Raises:
        UnknownOption: There is no part, a share is none, or ``down`` is not below ``up``.

    Example:
        >>> Stages({}, {"tool_block.mass": 0.08}, up=0.9, window=50).window
        50
    """

    kind: Literal["stages"] = "stages"
    up: float = 0.8
    down: float | None = None
    window: int = 100

    def __init__(
        self, *parts: Any, up: Any = 0.8, down: Any = None, window: Any = 100, **fields: Any
    ) -> None:
        window = whole_number("window", window, least=1)
        if not 0.0 < up <= 1.0:
            raise UnknownOption("up", up, ("a share above 0 and up to 1",))
        if down is not None and not 0.0 <= down < up:
            raise UnknownOption("down", down, (f"a share from 0 up to less than {up:g}", "None"))
        super().__init__(*parts, up=up, down=down, window=window, **fields)

    def chosen(self, memory: Memory, episode: int) -> Part:
        """Return the part of the present stage."""
        return self.of[memory.stages.setdefault(self.key, Progress()).level]

    def ended(self, memory: Memory, *, success: bool) -> None:
        """Take an episode into account."""
        kept = memory.stages.setdefault(self.key, Progress())
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


during, together, in_turn, weighted, stages = During, Together, InTurn, Weighted, Stages
