"""The outputs of an evaluation: figures, videos, and a report that needs no network."""

from __future__ import annotations

import posixpath
from collections.abc import Mapping, Sequence
from contextlib import closing
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from scm_world.errors import UnknownOption
from scm_world.evaluation.checking import shard_runner_of
from scm_world.evaluation.files import summarized
from scm_world.evaluation.outputs.comparisons import (
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
from scm_world.evaluation.outputs.figures import (
    ALPHA,
    bars_figure,
    causes_figure,
    gap_figure,
    profile_figure,
    radar_figure,
)
from scm_world.evaluation.outputs.videos import record_videos
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.statistics import Causes, Interval
from scm_world.output.canvas import save, small_png
from scm_world.output.durable import removed, write_whole
from scm_world.output.pages import Entry, render
from scm_world.output.remote import Location, located
from scm_world.queries.progress import Progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
) -> dict[str, Figure]:
    """Write the report as one HTML file: scores, figures, differences, causes, how to check them.

    What cannot be computed, such as a gap with one backend, is left out or says why. The same
    evaluation gives the same bytes.

    Args:
        evaluation: Any with one row at least.
        path: Of the HTML file.
        videos: Files that the page links to, relative to where it stands.
        metric: That the figures and the first table are about; one of ``METRICS``.

    Returns:
        The figures of the page, by name.

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
    figures = {"bars": bars_figure(evaluation, metric)}
    if len(evaluation.protocols) >= CORNERS:
        figures["radar"] = radar_figure(evaluation, metric)
    if not isinstance(compared, str):
        figures["profile"] = profile_figure(evaluation, metric, compared)
    if gaps is not None and not isinstance(gaps, str):
        figures["gap"] = gap_figure(evaluation, metric, gaps)
    missing = {"radar": "radar" in figures, "differences": pairs, "gap": gaps, "videos": videos}
    published = [
        (line, protocol, numbers)
        for line in lines
        for protocol, numbers in evaluation.published(agent=line.agent, engine=line.engine).items()
    ]
    causes = [_causes(evaluation, line, metric) for line in lines]
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
        figures={"radar": None} | {name: small_png(one) for name, one in figures.items()},
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
        causes=[(line, shown, small_png(figure)) for line, shown, figure in causes],
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
    for line, _, figure in causes if evaluation.drawn() else ():
        name = "causes" if len(lines) == 1 else f"causes-{line.agent}-{line.engine}"
        figures[name.replace("/", "_")] = figure
    return figures


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


def _causes(evaluation: Evaluation, line: Line, metric: str) -> tuple[Line, dict[str, Any], Figure]:
    found = causes_of(evaluation, line, metric)
    figure = causes_figure(evaluation, line.agent, line.engine, metric, found)
    shown = {
        "verdicts": {protocol: verdict(one) for protocol, one in found.items()},
        "effects": [(protocol, one) for protocol, f in found.items() for one in f.ranked()],
        "left_out": [[p, *one] for p, f in found.items() for one in f.left_out.items()],
        "dependent": [
            [protocol, " and ".join(pair.variables), f"{pair.shared:.2f}"]
            for protocol, one in found.items()
            for pair in one.dependent
        ],
    }
    return line, shown, figure


def _policy(policy: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in policy.items())


STALE = ("bars.png", "radar.png", "profile.png", "gap.png", "causes*.png", "report.html")
"""What an earlier evaluation may have left in the folder."""

CORNERS = 3
"""With fewer protocols a radar has no area."""


def write_outputs(
    evaluation: Evaluation,
    folder: Location | str,
    *,
    metric: str | None = None,
    videos: bool = False,
    policy: Any = None,
    trusted: Sequence[str] = (),
    progress: Progress | None = None,
) -> tuple[Location, ...]:
    """Write figures, the report, and videos if they are wanted.

    Args:
        evaluation: What is shown.
        folder: Where to; it is there. It may be a URL.
        metric: Score that is drawn.
        videos: Whether the best, the median and the worst episode of each agent are filmed.
        policy: Who acted, for videos of policies that are no files and have no names.
        trusted: Packages whose functions may be policies, for videos.
        progress: Called with how many control steps of a video are done.

    Returns:
        The files.

    Raises:
        UnknownOption: There is no such metric.
        UnwritableFolder: There is no room, or no permission.
        MissingExtra: Videos are wanted, and moviepy is not installed.
    """
    metric = evaluation.metric(metric)
    place = located(folder)
    for name in STALE:
        for old in place.glob(name):
            removed(old)
    films: list[Location] = []
    if videos:
        with closing(shard_runner_of(evaluation, policy=policy, trusted=trusted)) as shard_runner:
            for line in lines_of(evaluation):
                who: Any = {"agent": line.agent, "engine": line.engine, "metric": metric}
                films += record_videos(shard_runner, evaluation, place, **who, progress=progress)
    report, files = place / "report.html", []
    for name, figure in write_report(evaluation, report, videos=films, metric=metric).items():
        files.append(place / f"{name}.png")
        save(figure, files[-1])
    return (*files, report, *films)
