"""When a part of a curriculum acts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Literal, final

from scm_world._arguments import whole_number
from scm_world.curricula.base import Acts, AnyPart, Part, as_part
from scm_world.curricula.situations import Memory, Situation
from scm_world.errors import UnknownOption


class _Timed(Part):
    """Something that acts at certain times only.

    Attributes:
        part: What acts.
    """

    part: AnyPart

    def parts(self) -> tuple[Part, ...]:
        """Give what acts."""
        return (self.part,)

    def is_due(self, situation: Situation) -> bool:
        """Tell whether what has no time of its own acts now."""
        return situation.due

    def acts(self, situation: Situation) -> Acts:
        """Let it act, at its time."""
        return self.part.acts(replace(situation, due=self.is_due(situation)))


@final
class AtStep(_Timed):
    """Act at one control step of an episode; 0 is the reset.

    Attributes:
        step: The control step: after so many of them have passed.
    """

    kind: Literal["at_step"] = "at_step"
    step: int

    def __init__(self, step: Any, part: Any, **fields: Any) -> None:
        step = whole_number("step", step, least=0)
        super().__init__(step=step, part=as_part(part), **fields)  # type: ignore[call-arg]

    def is_due(self, situation: Situation) -> bool:
        """Tell whether this is the step."""
        return situation.step == self.step


@final
class Every(_Timed):
    """Act again and again within an episode.

    Attributes:
        steps: Control steps from one time to the next.
        first: The first control step at which it acts.
    """

    kind: Literal["every"] = "every"
    steps: int
    first: int = 0

    def __init__(self, steps: Any, part: Any, *, first: Any = 0, **fields: Any) -> None:
        steps = whole_number("steps", steps, least=1)
        first = whole_number("first", first, least=0)
        super().__init__(steps=steps, part=as_part(part), first=first, **fields)  # type: ignore[call-arg]

    def is_due(self, situation: Situation) -> bool:
        """Tell whether this is one of the steps."""
        since = situation.step - self.first
        return since >= 0 and since % self.steps == 0


@final
class During(_Timed):
    """Act in some episodes only.

    Attributes:
        first: The first episode.
        stop: The one after the last; None if there is no last one.
        period: Episodes from one time to the next.
    """

    kind: Literal["during"] = "during"
    first: int = 0
    stop: int | None = None
    period: int = 1

    def __init__(self, episodes: Any = None, part: Any = None, **fields: Any) -> None:
        if episodes is not None:
            if not isinstance(episodes, range) or episodes.step < 1 or episodes.start < 0:
                allowed = ("a range such as range(1_000, 5_000)", "range(first, stop, period)")
                raise UnknownOption("episodes", episodes, allowed)
            fields |= {"first": episodes.start, "stop": episodes.stop, "period": episodes.step}
        fields["first"] = whole_number("first", fields.get("first", 0), least=0)
        fields["period"] = whole_number("period", fields.get("period", 1), least=1)
        super().__init__(part=as_part(part), **fields)

    def acts(self, situation: Situation) -> Acts:
        """Let it act, in its episodes."""
        return self.part.acts(situation) if self._includes(situation.episode) else {}

    def _includes(self, episode: int) -> bool:
        since = episode - self.first
        ended = self.stop is not None and episode >= self.stop
        return since >= 0 and not since % self.period and not ended

    def live(self, memory: Memory, episode: int) -> Iterator[Part]:
        """List it, and what acts in its episodes if this is one."""
        yield self
        if self._includes(episode):
            yield from self.part.live(memory, episode)


def at_reset(part: Any) -> AtStep:
    """Act at the beginning of every episode; so does what has no time of its own.

    Args:
        part: What acts: a part, or an intervention.

    Raises:
        UnknownOption: It is neither.

    Example:
        >>> at_reset({"floor_friction": 0.4}).step
        0
    """
    return AtStep(0, part)


def at_step(step: int, part: Any) -> AtStep:
    """Act after so many control steps of every episode.

    Args:
        step: How many; 0 is the reset.
        part: What acts: a part, or an intervention. A part of it with a time of its own has
            that one.

    Raises:
        UnknownOption: The number is none, or the part.
    """
    return AtStep(step, part)


def every(steps: int, part: Any, *, first: int = 0) -> Every:
    """Act again and again within every episode.

    Args:
        steps: Control steps from one time to the next.
        part: What acts: a part, or an intervention.
        first: The first control step at which it acts; 0 is the reset.

    Raises:
        UnknownOption: A number is none, or the part.
    """
    return Every(steps, part, first=first)


def during(episodes: range, part: Any) -> During:
    """Act in some episodes only; they count from 0.

    Args:
        episodes: The range of them; its step is the period.
        part: What acts: a part, or an intervention.

    Raises:
        UnknownOption: It is no range of whole numbers that are not negative, or no part.

    Example:
        >>> during(range(10, 20, 5), {"floor_friction": 0.4}).period
        5
    """
    return During(episodes, part)


__all__ = ["AtStep", "During", "Every", "at_reset", "at_step", "during", "every"]
