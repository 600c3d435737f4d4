"""The tables in the report of an evaluation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import combinations
from typing import Any, final

from scm_world.errors import UnknownOption
from scm_world.evaluation.arena import METRICS
from scm_world.evaluation.files import summarized
from scm_world.evaluation.outputs.causes import ALPHA, is_flat
from scm_world.evaluation.outputs.gap import Gaps
from scm_world.evaluation.outputs.looks import Line, lines_of, protocol_words
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.statistics import Cause, Causes, Interval
from scm_world.output.pages import Entry, table

Pairs = dict[tuple[str, str, str, str], Interval | str]
"""Paired differences by engine, protocol, one agent and another, or why there is none."""


def differences(evaluation: Evaluation, metric: str | None = None) -> Pairs:
    """Estimate all paired differences between agents."""
    metric = evaluation.metric(metric)
    found: Pairs = {}
    for engine in evaluation.engines:
        here = evaluation.only(engine=engine)
        for protocol in here.protocols:
            both = here.only(protocol=protocol)
            for one, other in combinations(both.agents, 2):
                found[engine, protocol, one, other] = _difference(
                    both, one, other, protocol, metric
                )
    return found


def _difference(
    both: Evaluation, one: str, other: str, protocol: str, metric: str
) -> Interval | str:
    try:
        return both.difference(one, other, protocol, metric)
    except UnknownOption:
        return "they played other episodes"


def best(evaluation: Evaluation, pairs: Pairs) -> set[tuple[Line, str]]:
    """Name who is better than every other agent in a protocol, with intervals that exclude 0."""
    found: set[tuple[Line, str]] = set()
    for engine in evaluation.engines:
        here = evaluation.only(engine=engine)
        for protocol in here.protocols:
            mine = {k[2:]: v for k, v in pairs.items() if k[:2] == (engine, protocol)}
            agents = {agent for pair in mine for agent in pair}
            found |= {(Line(a, engine), protocol) for a in agents if _beats_all(a, mine)}
    return found


def _beats_all(agent: str, pairs: Mapping[tuple[str, str], Interval | str]) -> bool:
    return all(
        not isinstance(one, str) and (one.low > 0.0 if pair[0] == agent else one.high < 0.0)
        for pair, one in pairs.items()
        if agent in pair
    )


@final
class Scores:
    """All mean scores, as the file of results has them.

    Args:
        evaluation: Of which they are.
    """

    def __init__(self, evaluation: Evaluation) -> None:
        self.rows = summarized(evaluation)
        self._rows = {
            (Line(row["agent"], row["engine"]), row["protocol"]): row for row in self.rows
        }
        self.lines, self.words = lines_of(evaluation), protocol_words(evaluation)
        self.several = len(evaluation.engines) > 1

    def of(self, line: Line, protocol: str, metric: str) -> Interval | None:
        """Give a score; None if the agent did not act there."""
        row = self._rows.get((line, protocol))
        return None if row is None else interval(row[metric])

    def summary(self, bold: set[tuple[Line, str]], metric: str) -> str:
        """Write a row for each protocol, a column for each agent and engine."""
        heads = ["protocol", "what varies", *map(self._name, self.lines)]
        rows: list[list[str | Entry]] = [
            [protocol, doc, *(self._entry(ln, protocol, metric, bold) for ln in self.lines)]
            for protocol, doc in self.words.items()
        ]
        return table(heads, rows, left=2, sortable=True)

    def _name(self, line: Line) -> str:
        return f"{line.agent} on {line.engine}" if self.several else line.agent

    def _entry(self, line: Line, protocol: str, metric: str, bold: set[tuple[Line, str]]) -> Entry:
        one = self.of(line, protocol, metric)
        return shown(one, looks="best" if (line, protocol) in bold else "")

    def metrics(self) -> str:
        """Write all metrics, a row for each agent, engine and protocol."""
        there = [metric for metric in METRICS if all(metric in row for row in self.rows)]
        rows: list[list[str | Entry]] = [
            [
                row["agent"],
                row["engine"],
                row["protocol"],
                *(shown(interval(row[m])) for m in there),
            ]
            for row in self.rows
        ]
        return table(["agent", "engine", "protocol", *there], rows, left=3, sortable=True)


def interval(data: Mapping[str, Any]) -> Interval:
    """Read what ``Interval.as_dict`` wrote."""
    ends = {end: float("nan") for end in ("low", "high") if data[end] is None}
    return Interval(**{**data, **ends})


def shown(one: Interval | str | None, looks: str = "") -> Entry:
    """Write an interval into a table; it is sorted by its value."""
    if one is None or isinstance(one, str):
        return Entry(one or "–", by="")
    return Entry(str(one), by=f"{one.value:.6g}", looks=looks)


def _sure(one: Interval | str) -> Entry:
    """Write a difference; it stands out if its interval excludes 0."""
    sure = isinstance(one, Interval) and one.excludes(0.0)
    return shown(one, looks="best" if sure else "")


def difference_table(pairs: Pairs) -> str:
    """Write the paired differences between agents."""
    rows: Iterable[list[str | Entry]] = (
        [engine, protocol, f"{one} minus {other}", _sure(found)]
        for (engine, protocol, one, other), found in pairs.items()
    )
    return table(["engine", "protocol", "agents", "difference"], rows, left=3, sortable=True)


def gap_table(gaps: Gaps) -> str:
    """Write the gaps between engines."""
    rows: Iterable[list[str | Entry]] = (
        [agent, protocol, f"{one} minus {other}", _sure(found)]
        for (one, other, agent, protocol), found in gaps.items()
    )
    return table(["agent", "protocol", "engines", "gap"], rows, left=3, sortable=True)


def overall_table(evaluation: Evaluation, metric: str | None = None) -> str:
    """Write the aggregates over all protocols, and say over what they are."""
    metric = evaluation.metric(metric)
    rows: list[list[str | Entry]] = []
    names = ("interquartile_mean", "mean", "median", "optimality_gap")
    for line in lines_of(evaluation):
        mine = evaluation.only(agent=line.agent, engine=line.engine)
        runs = len(mine.runs(line.agent))
        over = f"{runs} training runs" if runs > 1 else "episodes of one run"
        entries: list[str | Entry] = []
        try:
            found = mine.overall(metric)
            entries = [shown(found[name]) for name in names]
        except UnknownOption as error:
            entries = [Entry(str(error), looks="w"), *([""] * (len(names) - 1))]
        count = f"{len(mine.protocols)} protocols"
        rows.append([line.agent, line.engine, over, count, *entries])
    heads = [
        "agent",
        "engine",
        "intervals over",
        "mean over",
        *(n.replace("_", " ") for n in names),
    ]
    return table(heads, rows, left=4)


def published_table(evaluation: Evaluation) -> str:
    """Write means and standard deviations under the published names."""
    rows: list[list[str | Entry]] = []
    heads: list[str] = []
    for line in lines_of(evaluation):
        mine = evaluation.only(agent=line.agent, engine=line.engine)
        for protocol, numbers in mine.published().items():
            heads = list(numbers)
            rows.append(
                [line.agent, line.engine, protocol, *(f"{x:.4f}" for x in numbers.values())]
            )
    return table(["agent", "engine", "protocol", *heads], rows, left=3, sortable=True)


# --- causes -----------------------------------------------------------------------------------

CAUSE_HEADS = (
    "protocol",
    "variable",
    "share of variance",
    "p (Holm)",
    "high minus low values",
    "of component",
    "with the value the score goes",
    "episodes",
)


def cause_table(found: Mapping[str, Causes]) -> str:
    """Write all effects, protocol by protocol, the strongest one first."""
    rows = [
        _cause_row(protocol, cause) for protocol, one in found.items() for cause in one.ranked()
    ]
    return table(CAUSE_HEADS, rows, left=2, sortable=True) if rows else "<p>Nothing varies.</p>"


def _cause_row(protocol: str, cause: Cause) -> list[str | Entry]:
    looks = "best" if cause.p_holm <= ALPHA else ""
    column = cause.column
    return [
        protocol,
        Entry(cause.variable, looks=looks),
        shown(cause.share),
        f"{cause.p_holm:.4f}",
        shown(column.contrast),
        column.name,
        column.direction,
        str(cause.n),
    ]


def verdict(found: Causes) -> str:
    """Say in a sentence which cause broke the agent in a protocol."""
    if not found.causes:
        return "too few episodes varied anything" if found.left_out else "nothing varies"
    if is_flat(found):
        return "the score was the same in every episode: there is nothing to explain"
    causes = found.found(ALPHA)
    if not causes:
        return "no variable has an effect that this many episodes could show"
    return "; ".join(_named(cause) for cause in causes)


def _named(cause: Cause) -> str:
    column = cause.column
    way = {"up": "raise", "down": "lower"}.get(column.direction)
    share = f"{cause.variable} explains {cause.share.value:.0%} of the score's variance"
    if way is None:
        return f"{share}, neither simply up nor down"
    part = f" of {column.name}" if column.name != cause.variable else ""
    return f"{share}: high values{part} {way} it by {abs(column.contrast.value):.2f}"
