"""The report of an evaluation: one HTML file that needs nothing else, and no network."""

from __future__ import annotations

import posixpath
from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import quote

from scm_world.errors import UnknownOption
from scm_world.evaluation.files import summarized
from scm_world.evaluation.outputs.figures import (
    ALPHA,
    bars_figure,
    causes_figure,
    gap_figure,
    profile_figure,
    radar_figure,
)
from scm_world.evaluation.outputs.labels import (
    Line,
    best,
    causes_of,
    comparisons_of,
    counted,
    differences_of,
    gaps_of,
    is_flat,
    lines_of,
    metric_words,
    protocol_words,
)
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.statistics import Causes, Interval
from scm_world.output.canvas import small_png
from scm_world.output.durable import write_whole
from scm_world.output.locations import Location, located
from scm_world.output.pages import Entry, render

SECTIONS = {
    "summary": "Scores",
    "overall": "Overall",
    "bars": "By protocol",
    "radar": "Radar",
    "profile": "Profiles",
    "differences": "Differences between agents",
    "gap": "Gap between engines",
    "causes": "Which cause broke the agent",
    "videos": "Videos",
    "numbers": "All numbers",
    "about": "About this evaluation",
}


def write_report(
    evaluation: Evaluation,
    path: Location | str,
    *,
    videos: Sequence[Location | str] = (),
    metric: str | None = None,
) -> None:
    """Write the report as one HTML file: scores, figures, differences, causes, how to check them.

    What cannot be computed, such as a gap with one engine, is left out or says why. The same
    evaluation gives the same bytes.

    Args:
        evaluation: Any with one row at least.
        path: Of the HTML file.
        videos: Files that the page links to, relative to where it stands.
        metric: That the figures and the first table are about; one of ``METRICS``.

    Raises:
        UnknownOption: There is no such metric, or no episode.
        UnwritableFolder: There is no such folder, no room, or no permission.
    """
    metric = evaluation.metric(metric)
    if not len(evaluation):
        raise UnknownOption("evaluation", "without episodes", ("one with an episode or more",))
    lines, about, folder = lines_of(evaluation), evaluation.about, located(path).parent
    rows, pairs = summarized(evaluation), differences_of(evaluation, metric)
    compared, gaps = _or_why(comparisons_of, evaluation, metric), None
    if len(evaluation.engines) > 1:
        gaps = _or_why(gaps_of, evaluation, metric)
    figures = {"bars": bars_figure(evaluation, metric), "radar": None}
    if len(evaluation.protocols) >= 3:
        figures["radar"] = radar_figure(evaluation, metric)
    if not isinstance(compared, str):
        figures["profile"] = profile_figure(evaluation, metric, compared)
    if gaps is not None and not isinstance(gaps, str):
        figures["gap"] = gap_figure(evaluation, metric, gaps)
    missing = {"radar": figures["radar"], "differences": pairs, "gap": gaps, "videos": videos}
    published = [
        (line, protocol, numbers)
        for line in lines
        for protocol, numbers in evaluation.published(agent=line.agent, engine=line.engine).items()
    ]
    page = render(
        "evaluation/outputs/report.html",
        title=f"Evaluation: {evaluation.task}",
        lead=f"{', '.join(evaluation.agents)} on {', '.join(evaluation.engines)}: "
        f"{metric_words(metric)}. {len(evaluation)} episodes: {counted(evaluation)}.",
        contents=[one for one in SECTIONS.items() if missing.get(one[0], True)],
        metric=metric_words(metric),
        lines=lines,
        labels=[
            f"{line.agent} on {line.engine}" if len(evaluation.engines) > 1 else line.agent
            for line in lines
        ],
        words=protocol_words(evaluation),
        scores={
            (Line(row["agent"], row["engine"]), row["protocol"]): _interval(row[metric])
            for row in rows
        },
        bold=best(pairs),
        overall=[_overall(evaluation, line, metric) for line in lines],
        figures={name: one and small_png(one) for name, one in figures.items()},
        compared=compared,
        better=[] if isinstance(compared, str) else [
            [engine, " > ".join(pair), str(one)]
            for engine, found in compared.items()
            for pair, one in found.better.items()
        ],
        pairs=[([e, p, f"{a} minus {b}"], one) for (e, p, a, b), one in pairs.items()],
        gaps=gaps if gaps is None or isinstance(gaps, str) else [
            ([agent, protocol, f"{a} minus {b}"], one)
            for (a, b, agent, protocol), one in gaps.items()
        ],
        causes=[_causes(evaluation, line, metric) for line in lines],
        videos=[
            (quote(posixpath.relpath(str(located(one)), str(folder))), located(one).name)
            for one in videos
        ],
        metrics=list(evaluation.metrics),
        every=[
            (
                [row["agent"], row["engine"], row["protocol"]],
                [_interval(row[name]) for name in evaluation.metrics],
            )
            for row in rows
        ],
        published={
            "heads": list(published[0][2]),
            "rows": [
                [line.agent, line.engine, protocol, *(f"{x:.4f}" for x in numbers.values())]
                for line, protocol, numbers in published
            ],
        },
        plain={k: v for k, v in about.items() if k not in ("agents", "protocols", "versions")},
        policies=[
            [one["agent"], str(one["run"]), Entry(_policy(one["policy"]), looks="w")]
            for one in about.get("agents", ())
        ],
        protocols={one["name"]: one for one in about.get("protocols", ())},
        versions=about.get("versions", {}),
        data={
            "rows": len(evaluation),
            "digest": evaluation.digest,
            "scores": rows,
            "about": dict(about),
        },
    )  # fmt: skip
    write_whole(page, path)


def verdict(found: Causes) -> str:
    """Return in a sentence which cause broke the agent in a protocol."""
    if not found.causes:
        return "too few episodes varied anything" if found.left_out else "nothing varies"
    if is_flat(found):
        return "the score was the same in every episode: there is nothing to explain"
    said = []
    for cause in found.found(ALPHA):
        column = cause.column
        text = f"{cause.variable} explains {cause.share.value:.0%} of the score's variance"
        part = f" of {column.name}" if column.name != cause.variable else ""
        way = {"up": "raise", "down": "lower"}.get(column.direction)
        if way is None:
            said.append(f"{text}, neither simply up nor down")
        else:
            said.append(f"{text}: high values{part} {way} it by {abs(column.contrast.value):.2f}")
    return "; ".join(said) or "no variable has an effect that this many episodes could show"


def _or_why(compute: Any, evaluation: Evaluation, metric: str) -> Any:
    """Return what is computed, or in words why it cannot be."""
    try:
        return compute(evaluation, metric)
    except UnknownOption as error:
        return str(error)


def _interval(data: Mapping[str, Any]) -> Interval:
    """Read what ``Interval.as_dict`` wrote."""
    ends = {end: float("nan") for end in ("low", "high") if data[end] is None}
    return Interval(**{**data, **ends})


def _overall(evaluation: Evaluation, line: Line, metric: str) -> tuple[list[str], Any]:
    mine = evaluation.only(agent=line.agent, engine=line.engine)
    runs = len(mine.runs(line.agent))
    over = f"{runs} training runs" if runs > 1 else "episodes of one run"
    names = [line.agent, line.engine, over, f"{len(mine.protocols)} protocols"]
    return names, _or_why(lambda one, metric: one.overall(metric), mine, metric)


def _causes(evaluation: Evaluation, line: Line, metric: str) -> tuple[Line, dict[str, Any], bytes]:
    found = causes_of(evaluation, line, metric)
    figure = causes_figure(evaluation, line.agent, line.engine, metric, found)
    shown = {
        "verdicts": {protocol: verdict(one) for protocol, one in found.items()},
        "effects": [(protocol, one) for protocol, f in found.items() for one in f.ranked()],
        "left_out": [[p, *one] for p, f in found.items() for one in f.left_out.items()],
    }
    return line, shown, small_png(figure)


def _policy(policy: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in policy.items())
