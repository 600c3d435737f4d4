"""What figures and tables of evaluations are labelled with."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, final

from scm_world.errors import UnknownOption
from scm_world.evaluation.episodes import LAST, METRICS
from scm_world.evaluation.results import Evaluation

WORDS: Mapping[str, str] = {
    "last_fractional_success": "fractional success at the end",
    "last_integrated_fractional_success": f"fractional success over the last {LAST} steps",
    "full_integrated_fractional_success": "fractional success over the whole episode",
    "success": "success rate",
    "return": "return",
}


@final
@dataclass(frozen=True)
class Line:
    """An agent on an engine: one line of a figure, or one bar of each protocol."""

    agent: str
    engine: str


def lines_of(evaluation: Evaluation) -> list[Line]:
    """List which agent acted on which engine, agents in their order and then engines."""
    columns = evaluation.columns
    there = set(zip(columns["agent"].tolist(), columns["engine"].tolist(), strict=True))
    every = (Line(a, e) for a in evaluation.agents for e in evaluation.engines)
    return [line for line in every if (line.agent, line.engine) in there]


def metric_words(metric: str) -> str:
    """Return in words what a metric is.

    Raises:
        UnknownOption: There is no such metric.

    Example:
        >>> metric_words("success")
        'success rate'
    """
    if metric not in METRICS:
        raise UnknownOption("metric", metric, METRICS)
    return WORDS[metric]


def is_fraction(metric: str) -> bool:
    """Whether a metric goes from 0 to 1."""
    return metric != "return"


def counted(evaluation: Evaluation) -> str:
    """Return how many runs and episodes stand behind a number.

    Example:
        >>> from scm_world.evaluation.pipeline import evaluate
        >>> counted(evaluate("still", "P0", n=2, backend="fake", env={"max_episode_length": 3}))
        '2 episodes of each protocol'
    """
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
    told = {one["name"]: one for one in evaluation.about.get("protocols", ())}
    return {name: _varies(told.get(name, {})) for name in evaluation.protocols}


def _varies(protocol: Mapping[str, Any]) -> str:
    text = str(protocol.get("doc") or "")
    varies, space = protocol.get("varies") or (), protocol.get("space")
    if not text and varies:
        text = ", ".join(varies) + (f" from {space}" if isinstance(space, str) else "")
    step = protocol.get("step") or 0
    return f"{text} after {step} steps".strip() if step else text
