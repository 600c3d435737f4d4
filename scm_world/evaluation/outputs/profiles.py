"""Performance profiles, and how probable it is that one agent does better than another."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any, final

import numpy as np

from scm_world._types import Floats
from scm_world.errors import UnknownOption
from scm_world.evaluation.outputs.looks import (
    Line,
    Looks,
    is_fraction,
    lines_of,
    metric_words,
)
from scm_world.evaluation.outputs.sheets import GAP, MARGIN, PLAIN, Sheet, text_size, wrapped
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.statistics import (
    Interval,
    Profile,
    performance_profile,
    probability_of_improvement,
)
from scm_world.output.canvas import INK, PALETTE, save
from scm_world.output.locations import Location

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LEFT, PANEL, AXIS = 0.75, 5.6, 0.65  # [inches]: profiles, and below them
LEAST, MOST = 3.6, 5.4  # [inches]: height of profiles
ROW, WORDS, NUMBERS = 0.3, 2.8, 1.5  # [inches]: pairs
TEXT = 8.0  # [points]
HEAD: dict[str, Any] = {**PLAIN, "size": 10.0, "weight": "bold"}


@final
@dataclass(frozen=True)
class Comparison:
    """What the definitions of rliable say about the agents on an engine.

    Attributes:
        over: ``"runs"`` if each agent has several of them, else ``"episodes"``.
        profiles: By agent.
        better: Probability that the first of a pair scores higher, by pair of agents.
    """

    over: str
    profiles: dict[str, Profile]
    better: dict[tuple[str, str], Interval]


def compare_agents(evaluation: Evaluation, engine: str, metric: str | None = None) -> Comparison:
    """Compare the agents on an engine over all protocols.

    Raises:
        UnknownOption: Agents have not played the same protocols, or one episode only.

    Source:
        Agarwal et al., *Deep reinforcement learning at the edge of the statistical precipice*,
        NeurIPS 2021.
    """
    metric = evaluation.metric(metric)
    here = evaluation.only(engine=engine)
    for agent in here.agents:
        missing = set(here.protocols) - set(here.only(agent=agent).protocols)
        if missing:
            played = (f"agents that have all played {', '.join(sorted(missing))}",)
            raise UnknownOption("agent of a comparison", agent, played)
    scores = {agent: here.scores(metric, agent=agent) for agent in here.agents}
    over = "runs" if all(len(one) > 1 for one in scores.values()) else "episodes"
    at = _thresholds(
        metric, [one.mean(axis=2) if over == "runs" else one for one in scores.values()]
    )
    profiles = {a: performance_profile(one, at, over=over) for a, one in scores.items()}
    better = {
        (one, other): probability_of_improvement(scores[one], scores[other], over=over)
        for one, other in combinations(scores, 2)
    }
    return Comparison(over, profiles, better)


def _thresholds(metric: str, scores: list[Floats]) -> Floats:
    if is_fraction(metric):
        return np.linspace(0.0, 1.0, 101)
    low, high = min(one.min() for one in scores), max(one.max() for one in scores)
    room = 0.02 * ((high - low) or 1.0)
    return np.linspace(low - room, high + room, 101)


def draw_profile(evaluation: Evaluation, path: Location | str, metric: str | None = None) -> None:
    """Draw the share of scores above each threshold, and who is better with what probability.

    For each engine one panel of profiles with their 95 % bands, and with several agents one of
    pairs. Where every agent has several training runs a score is that of a run in a protocol, else
    that of an episode; the picture says which.

    Args:
        evaluation: In which all agents have played the same protocols.
        path: Of the PNG. The same evaluation gives the same bytes.
        metric: One of ``METRICS``.

    Raises:
        UnknownOption: There is no such metric, or agents have not played the same protocols, or one
            episode only.
        UnwritableFolder: There is no such folder, no room, or no permission.
    """
    found = {engine: compare_agents(evaluation, engine, metric) for engine in evaluation.engines}
    save(profile_figure(evaluation, found, metric), path)


def profile_figure(
    evaluation: Evaluation, found: dict[str, Comparison], metric: str | None = None
) -> Figure:
    """Draw comparisons that are known already, by engine."""
    metric = evaluation.metric(metric)
    said, looks = metric_words(metric), Looks(lines_of(evaluation))
    blocks = [sum(_pair_heights(one)) for one in found.values()]
    several = any(one.better for one in found.values())
    named = _names_width(found)
    width = LEFT + PANEL + MARGIN + (named + PANEL * 0.6 + NUMBERS + GAP if several else 0.0)
    heights = [max(LEAST, block) + AXIS + 2.5 * GAP + 0.2 for block in blocks]
    over = " and ".join(sorted({f"of {_unit(one)} in a protocol" for one in found.values()}))
    sheet = Sheet(
        width, sum(heights), title=f"{evaluation.task}: {said}",
        note=f"Left: share of the scores {over} that are higher; bands are 95 % intervals."
        + (" Right: probability that the first agent scores higher, a tie counts half."
           if several else ""),
        handles=looks.line_key(),
    )  # fmt: skip
    down = GAP
    for (engine, one), height, block in zip(found.items(), heights, blocks, strict=True):
        ax = sheet.axes(LEFT, down + 0.2, PANEL, min(max(block, LEAST), MOST))
        ax.set_title(f"on {engine}" if len(found) > 1 else "", loc="left", **HEAD)
        ax.set_xlabel(f"threshold of the {said}", size=9, **PLAIN)
        _profiles(ax, engine, one, looks)
        if one.better:
            left = LEFT + PANEL + MARGIN + named
            _pairs(sheet.axes(left, down + 0.2, PANEL * 0.6, block), one)
        down += height
    return sheet.figure


def _unit(found: Comparison) -> str:
    return "a run" if found.over == "runs" else "an episode"


def _profiles(ax: Axes, engine: str, found: Comparison, looks: Looks) -> None:
    for agent, one in found.profiles.items():
        style = {**looks.line(Line(agent, engine)), "markevery": 0.12, "markersize": 4.0}
        ax.plot(one.thresholds, one.share, drawstyle="steps-post", gid=agent, **style)
        ax.fill_between(
            one.thresholds, one.low, one.high, step="post", color=style["color"], alpha=0.16,
            lw=0, gid=f"band {agent}",
        )  # fmt: skip
    ax.set_ylim(-0.03, 1.03)
    ax.set_ylabel("share of scores above it", size=9, **PLAIN)


def _pair_label(pair: tuple[str, str]) -> str:
    return wrapped(f"{pair[0]} > {pair[1]}", WORDS, TEXT)


def _pair_heights(found: Comparison) -> list[float]:
    return [max(ROW, text_size(_pair_label(pair), TEXT)[1] + 0.1) for pair in found.better]


def _names_width(found: dict[str, Comparison]) -> float:
    """Give the room for the names of pairs [inches]."""
    labels = [_pair_label(pair) for one in found.values() for pair in one.better]
    return max((text_size(label, TEXT)[0] for label in labels), default=0.0) + 3 * GAP


def _pairs(ax: Axes, found: Comparison) -> None:
    """Draw a row for each pair of agents."""
    heights = _pair_heights(found)
    ax.set_xlim(0.0, 1.0)
    ax.set_ylim(sum(heights), 0.0)
    ax.grid(visible=False, axis="y")
    ax.axvline(0.5, color=INK, lw=0.9, zorder=1.5)
    ax.set_xlabel("probability that the first one scores higher", size=9, **PLAIN)
    places = []
    for (pair, one), height, end in zip(
        found.better.items(), heights, np.cumsum(heights), strict=True
    ):
        y = float(end) - height / 2
        places.append(y)
        sure = one.excludes(0.5)
        color = PALETTE[0] if sure else "#6b7686"
        ax.plot([one.value], [y], "o", color=color, clip_on=False, gid=" > ".join(pair), zorder=3)
        ax.hlines(y, one.low, one.high, color=color, lw=1.6, clip_on=False)
        ax.annotate(
            str(one), (1.0, y), xytext=(8, 0), textcoords="offset points", va="center", size=TEXT,
            annotation_clip=False, **PLAIN,
        )  # fmt: skip
    ax.set_yticks(places, [_pair_label(pair) for pair in found.better], size=TEXT)
    for text in ax.get_yticklabels():
        text.set_parse_math(False)
