"""What figures and tables of evaluations compare, and what it is called."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any, final

import numpy as np

from scm_world._arguments import one_of
from scm_world.errors import UnknownOption
from scm_world.evaluation.episodes import LAST, METRICS
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.statistics import (
    Causes,
    Interval,
    Profile,
    performance_profile,
    probability_of_improvement,
)

WORDS: Mapping[str, str] = {
    "last_fractional_success": "fractional success at the end",
    "last_integrated_fractional_success": f"fractional success over the last {LAST} steps",
    "full_integrated_fractional_success": "fractional success over the whole episode",
    "success": "success rate",
    "return": "return",
    "published_overlap": "overlap at the end as CausalWorld has it",
}


@final
@dataclass(frozen=True)
class Line:
    """An agent on a backend: one line of a figure, or one bar of each protocol."""

    agent: str
    engine: str


def lines_of(evaluation: Evaluation) -> list[Line]:
    """List which agent acted on which backend, agents in their order and then backends."""
    columns = evaluation.columns
    there = set(zip(columns["agent"].tolist(), columns["engine"].tolist(), strict=True))
    every = (Line(a, e) for a in evaluation.agents for e in evaluation.engines)
    return [line for line in every if (line.agent, line.engine) in there]


def metric_words(metric: str) -> str:
    """Return in words what a metric is, or raise ``UnknownOption``."""
    one_of("metric", metric, METRICS)
    return WORDS[metric]


def is_fraction(metric: str) -> bool:
    """Whether a metric goes from 0 to 1."""
    return metric != "return"


def counted(evaluation: Evaluation) -> str:
    """Return how many runs and episodes a number is of."""
    keys = ("agent", "engine", "protocol", "run")
    rows = zip(*(evaluation.columns[key].tolist() for key in keys), strict=True)
    each = Counter(rows).values()
    runs = [len(evaluation.runs(agent)) for agent in evaluation.agents]
    some = "" if max(runs) == 1 else f" and {_range(runs)} training runs of each agent"
    return f"{_range(each)} episodes of each protocol{some}"


def _range(numbers: Collection[int]) -> str:
    low, high = min(numbers), max(numbers)
    return f"{low}" if low == high else f"{low} to {high}"


def protocol_words(evaluation: Evaluation) -> dict[str, str]:
    """Return what varies in each protocol, as far as the evaluation says so."""
    declared = {one["name"]: one for one in evaluation.about.get("protocols", ())}
    return {name: _varies(declared.get(name, {})) for name in evaluation.protocols}


def _varies(protocol: Mapping[str, Any]) -> str:
    text = str(protocol.get("doc") or "")
    varies, space = protocol.get("varies") or (), protocol.get("space")
    if not text and varies:
        text = ", ".join(varies) + (f" from {space}" if isinstance(space, str) else "")
    step = protocol.get("step") or 0
    return f"{text} after {step} steps".strip() if step else text


Scores = Mapping[tuple[Line, str], Interval]
"""By line and protocol; a line has no entry for a protocol in which it did not act."""
Gaps = Mapping[tuple[str, str, str, str], Interval]
"""By one backend, the other, agent and protocol."""
Pairs = Mapping[tuple[str, str, str, str], Interval | str]
"""Paired differences by backend, protocol, one agent and another, or why there is none."""


def scores_of(evaluation: Evaluation, metric: str) -> Scores:
    """Estimate all mean scores."""
    return {
        (line, protocol): mine.score(protocol, metric)
        for line in lines_of(evaluation)
        for mine in [evaluation.only(agent=line.agent, engine=line.engine)]
        for protocol in mine.protocols
    }


def differences_of(evaluation: Evaluation, metric: str) -> Pairs:
    """Estimate all paired differences between agents."""
    found: dict[tuple[str, str, str, str], Interval | str] = {}
    for engine in evaluation.engines:
        for protocol in evaluation.only(engine=engine).protocols:
            both = evaluation.only(engine=engine, protocol=protocol)
            for one, other in combinations(both.agents, 2):
                key = (engine, protocol, one, other)
                try:
                    found[key] = both.difference(one, other, protocol, metric)
                except UnknownOption:
                    found[key] = "they played other episodes"
    return found


def best(pairs: Pairs) -> set[tuple[Line, str]]:
    """Return who is better than every other agent in a protocol: all intervals exclude 0."""
    every: set[tuple[Line, str]] = set()
    beaten: set[tuple[Line, str]] = set()
    for (engine, protocol, one, other), found in pairs.items():
        first, second = (Line(one, engine), protocol), (Line(other, engine), protocol)
        every |= {first, second}
        if isinstance(found, str) or not found.low > 0.0:  # nan where an interval is unknown
            beaten.add(first)
        if isinstance(found, str) or not found.high < 0.0:
            beaten.add(second)
    return every - beaten


def gaps_of(evaluation: Evaluation, metric: str) -> Gaps:
    """Estimate all gaps between backends, of the agents that acted on both in a protocol.

    Raises:
        UnknownOption: There is one backend only, or an agent did not play the same episodes on
            both.
    """
    if len(evaluation.engines) < 2:
        allowed = ("an evaluation on two engines or more, such as backend='mujoco,bullet'",)
        raise UnknownOption("engines of a gap", ", ".join(evaluation.engines), allowed)
    return {
        (one, other, agent, protocol): here.gap(one, other, protocol, metric)
        for agent in evaluation.agents
        for protocol in evaluation.only(agent=agent).protocols
        for here in [evaluation.only(agent=agent, protocol=protocol)]
        for one, other in combinations(evaluation.engines, 2)
        if {one, other} <= set(here.engines)
    }


def causes_of(evaluation: Evaluation, line: Line, metric: str) -> dict[str, Causes]:
    """Estimate the effects in every protocol in which an agent acted on an engine.

    Raises:
        UnknownOption: There is no such agent or engine.
    """
    mine = evaluation.only(agent=line.agent, engine=line.engine)
    return {protocol: mine.causes(protocol, metric) for protocol in mine.protocols}


def is_flat(found: Causes) -> bool:
    """Whether the score was the same in every episode."""
    return bool(found.causes) and all(math.isnan(cause.share.width) for cause in found.causes)


@final
@dataclass(frozen=True)
class Comparison:
    """Agents on a backend compared as rliable defines it.

    Attributes:
        over: ``"runs"`` if each agent has several of them, else ``"episodes"``.
        profiles: By agent.
        better: Probability that the first of a pair scores higher, by pair of agents.
    """

    over: str
    profiles: Mapping[str, Profile]
    better: Mapping[tuple[str, str], Interval]


def comparisons_of(evaluation: Evaluation, metric: str) -> dict[str, Comparison]:
    """Compare the agents on each backend over all protocols.

    Raises:
        UnknownOption: Agents have not played the same protocols, or one episode only.
    """
    return {
        engine: _compared(evaluation.only(engine=engine), metric) for engine in evaluation.engines
    }


def _compared(here: Evaluation, metric: str) -> Comparison:
    for agent in here.agents:
        if missing := set(here.protocols) - set(here.only(agent=agent).protocols):
            played = (f"agents that have all played {', '.join(sorted(missing))}",)
            raise UnknownOption("agent of a comparison", agent, played)
    scores = {agent: here.scores(metric, agent=agent) for agent in here.agents}
    over = "runs" if all(len(one) > 1 for one in scores.values()) else "episodes"
    units = [one.mean(axis=2) if over == "runs" else one for one in scores.values()]
    low, high = min(one.min() for one in units), max(one.max() for one in units)
    room = 0.02 * ((high - low) or 1.0)
    if is_fraction(metric):
        low, high, room = 0.0, 1.0, 0.0
    at = np.linspace(low - room, high + room, 101)
    return Comparison(
        over,
        {agent: performance_profile(one, at, over=over) for agent, one in scores.items()},
        {
            (one, other): probability_of_improvement(scores[one], scores[other], over=over)
            for one, other in combinations(scores, 2)
        },
    )
