"""When parts of a curriculum act, and which of several."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from scm_world._arguments import real_number
from scm_world.curricula.base import (
    Acts,
    AnyPart,
    Count,
    Index,
    Part,
    Progress,
    Rule,
    Situation,
    kind,
)
from scm_world.errors import UnknownOption
from scm_world.graph import SCM
from scm_world.queries.plans import targets
from scm_world.variables import Time

# --- when -----------------------------------------------------------------------------------------

RESET = Time(at=0)


@kind("timed")
def _timed(time: Time, part: AnyPart) -> Rule:
    def acts(situation: Situation) -> Acts:
        plan = part.plan(replace(situation, step=time.start or 0))
        return {
            name: tuple(act if act.time else act.model_copy(update={"time": time}) for act in acts)
            for name, acts in plan.items()
        }

    return acts


def at_reset(part: Any) -> Part:
    """Act at the beginning of every episode; so does what has no time of its own.

    Example:
        >>> at_reset({"floor_friction": 0.4}).time
        Time(at=0)
    """
    return _timed(RESET, part)


def at_step(step: int, part: Any) -> Part:
    """Act after a number of control steps of every episode; 0 is the reset."""
    return _timed(Time(at=step), part)


def every(steps: int, part: Any, *, first: int = 0) -> Part:
    """Act again and again within every episode.

    Args:
        steps: Control steps from one time to the next.
        part: A part, or an intervention.
        first: The first control step at which it acts; 0 is the reset.
    """
    return _timed(Time(every=steps, at=first), part)


def when(event: Any, part: Any) -> Part:
    """Act at the first control step of every episode at which an event occurs.

    Args:
        event: ``Contact(first, second)`` or ``Reaches(name, above=…)``.
        part: A part, or an intervention.
    """
    return _timed(Time(when=event), part)


@kind("during")
def _during(part: AnyPart, first: Index = 0, stop: Count | None = None, period: Count = 1) -> Rule:
    if stop is not None and stop <= first:
        raise UnknownOption("stop", stop, (f"any whole number from {first + 1} on",))

    def acts(situation: Situation) -> Acts:
        episode = situation.episode
        is_within = first <= episode and (stop is None or episode < stop)
        return part.plan(situation) if is_within and (episode - first) % period == 0 else {}

    return acts


def during(episodes: range, part: Any) -> Part:
    """Act in some episodes only, which count from 0.

    Args:
        episodes: ``range(first, stop)`` or ``range(first, stop, period)``.
        part: A part, or an intervention.

    Raises:
        UnknownOption: It is not a range of whole numbers from 0 on, or an empty one.

    Example:
        >>> during(range(10, 20, 5), {"floor_friction": 0.4}).period
        5
    """
    usable = isinstance(episodes, range) and episodes.step > 0 <= episodes.start
    if not (usable and len(episodes)):
        allowed = ("a range such as range(1_000, 5_000)", "range(first, stop, period)")
        raise UnknownOption("episodes", episodes, allowed)
    return _during(part, episodes.start, episodes.stop, episodes.step)


# --- which ----------------------------------------------------------------------------------------


@kind("together")
def together(*of: Part) -> Rule:
    """Do several parts; of two on one quantity at one time the later one counts.

    Raises:
        UnknownOption: There is no part.

    Example:
        >>> both = together({"floor_friction": 0.4}, {"tool_block.mass": 0.03})
        >>> [list(part.request) for part in both.of]
        [['floor_friction'], ['tool_block.mass']]
    """

    def acts(situation: Situation) -> Acts:
        found: Acts = {}
        for part in of:
            found = over(situation.model, found, part.plan(situation))
        return found

    return acts


def over(model: SCM, below: Acts, plan: Acts) -> Acts:
    """Return interventions with a plan over them: at its times it alone sets its quantities."""
    if not below:
        return plan
    mine: dict[Time, set[str]] = {}
    for name, acts in plan.items():
        for act in acts:
            mine.setdefault(act.time or RESET, set()).update(targets(model, name))
    found: dict[str, Any] = {}
    for name, acts in below.items():
        its = set(targets(model, name))
        found[name] = tuple(act for act in acts if not its <= mine.get(act.time or RESET, set()))
    found |= {name: (*found.get(name, ()), *acts) for name, acts in plan.items()}
    return {name: acts for name, acts in found.items() if acts}


@kind("in_turn")
def in_turn(*of: Part, each: Count = 1) -> Rule:
    """Do one part after another, and again from the first one.

    Args:
        of: Parts, or interventions.
        each: How many episodes each of them lasts.

    Raises:
        UnknownOption: There is no part, or ``each`` is not a positive whole number.

    Example:
        >>> in_turn({"gravity": [0.0, 0.0, -9.8]}, {}, each=10).each
        10
    """
    return lambda situation: of[situation.episode // each % len(of)].plan(situation)


@kind("weighted")
def _weighted(*of: Part, weights: tuple[float, ...]) -> Rule:
    if len(weights) != len(of) or min(weights) <= 0.0:
        raise UnknownOption("weights", weights, ("a positive number for each part",))

    def acts(situation: Situation) -> Acts:
        ends = np.cumsum(weights)
        drawn = replace(situation, step=0).uniform(situation.key) * ends[-1]
        place = int(np.searchsorted(ends, drawn, side="right"))
        return of[min(place, len(of) - 1)].plan(situation)  # a product may round up

    return acts


def weighted(*pairs: Any) -> Part:
    """Do one of several parts, drawn in each episode.

    Args:
        pairs: A weight and a part each; probabilities are in proportion to the weights.

    Raises:
        UnknownOption: There is no pair, or a weight is not a positive number.

    Example:
        >>> weighted((3.0, {"floor_friction": 0.4}), (1.0, {})).weights
        (3.0, 1.0)
    """
    for pair in pairs:
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise UnknownOption("weighted", pair, ("pairs of a weight and a part",))
    weights = [real_number("weight", weight) for weight, _ in pairs]
    return _weighted(*(part for _, part in pairs), weights=weights)


@kind("stages")
def stages(*of: Part, up: float = 0.8, down: float | None = None, window: Count = 100) -> Rule:
    """Do the first part, and the next one once the learner succeeds.

    Args:
        of: Parts, or interventions, from the first stage on.
        up: Share of successes from which the next stage begins, in (0, 1].
        down: Share of successes down from which the stage before comes back; never if None.
        window: How many episodes of a stage count.

    Raises:
        UnknownOption: There is no part, a share is out of range, or ``down`` is not below ``up``.

    Example:
        >>> stages({}, {"tool_block.mass": 0.08}, up=0.9, window=50).window
        50
    """
    if not 0.0 < up <= 1.0:
        raise UnknownOption("up", up, ("a share above 0 and up to 1",))
    if down is not None and not 0.0 <= down < up:
        raise UnknownOption("down", down, (f"a share from 0 up to less than {up:g}", "None"))

    def acts(situation: Situation) -> Acts:
        situation.staged.add(situation.key)
        level = situation.memory.stages.get(situation.key, Progress()).level
        return of[level].plan(situation)

    return acts


def progressed(part: Any, before: Progress, *, success: bool) -> Progress:
    """Return the progress in stages after one more episode."""
    recent = (*before.recent, success)[-part.window :]
    share, step = sum(recent) / part.window, 0
    if len(recent) == part.window:
        is_down = part.down is not None and share <= part.down
        step = 1 if share >= part.up else -1 if is_down else 0
    level = min(max(before.level + step, 0), len(part.of) - 1)
    return Progress(level, recent if level == before.level else ())
