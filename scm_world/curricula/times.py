"""When a part of a curriculum acts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal, final

from scm_world.curricula.parts import Acts, AnyPart, Part, as_part
from scm_world.curricula.situations import Situation
from scm_world.errors import UnknownOption
from scm_world.world.start import whole_number


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
        super().__init__(part=as_part(part), **fields)

    def acts(self, situation: Situation) -> Acts:
        """Let it act, in its episodes."""
        since = situation.episode - self.first
        ended = self.stop is not None and situation.episode >= self.stop
        if since < 0 or since % self.period or ended:
            return {}
        return self.part.acts(situation)


def at_reset(part: Any) -> AtStep:
    """Act at the beginning of every episode; so does what has no time of its own."""
    return AtStep(0, part)


def at_step(step: int, part: Any) -> AtStep:
    """Act after so many control steps of every episode."""
    return AtStep(step, part)


def every(steps: int, part: Any, *, first: int = 0) -> Every:
    """Act every so many control steps, beginning at the step ``first``."""
    return Every(steps, part, first=first)


def during(episodes: range, part: Any) -> During:
    """Act in a range of episodes; its step is the period.

    Example:
        >>> during(range(10, 20, 5), {"floor_friction": 0.4}).period
        5
    """
    return During(episodes, part)


__all__ = ["AtStep", "During", "Every", "at_reset", "at_step", "during", "every"]
