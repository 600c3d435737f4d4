"""The report of an evaluation: one HTML file that needs nothing else, and no network."""

from __future__ import annotations

import posixpath
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from scm_world.errors import UnknownOption
from scm_world.evaluation.outputs.bars import bars_figure
from scm_world.evaluation.outputs.causes import causes_figure, causes_of
from scm_world.evaluation.outputs.gap import gap_figure, gaps_of
from scm_world.evaluation.outputs.looks import Line, counted, lines_of, metric_words
from scm_world.evaluation.outputs.profiles import compare_agents, profile_figure
from scm_world.evaluation.outputs.radar import radar_figure
from scm_world.evaluation.outputs.tables import (
    Pairs,
    Scores,
    best,
    cause_table,
    difference_table,
    differences,
    gap_table,
    overall_table,
    published_table,
    verdict,
)
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.statistics import Causes
from scm_world.output.canvas import small_png
from scm_world.output.durable import write_whole
from scm_world.output.locations import Location, located
from scm_world.output.pages import Entry, embedded, facts, folded, page, picture, section, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Section = tuple[str, str, str]
"""Anchor, title and what stands in it."""


def write_report(
    evaluation: Evaluation,
    path: Location | str,
    *,
    videos: Sequence[Location | str] = (),
    metric: str | None = None,
) -> None:
    """Write the report: scores, pictures, differences, causes, and how to check all of it.

    What cannot be computed, such as a gap with one engine, is left out or says why. The same
    evaluation gives the same bytes.

    Args:
        evaluation: Any with one row at least.
        path: Of the HTML file.
        videos: Files that the page links to, relative to where it stands.
        metric: That the pictures and the first table are about; one of ``METRICS``.

    Raises:
        UnknownOption: There is no such metric, or no episode.
        UnwritableFolder: There is no such folder, no room, or no permission.
    """
    metric = evaluation.metric(metric)
    said = metric_words(metric)
    if not len(evaluation):
        raise UnknownOption("evaluation", "without episodes", ("one with an episode or more",))
    scores, pairs = Scores(evaluation), differences(evaluation, metric)
    sections = [
        _summary(evaluation, scores, pairs, metric),
        _overall(evaluation, metric),
        *_pictures(evaluation, metric),
        *_differences(pairs),
        *_gap(evaluation, metric),
        _causes(evaluation, metric),
        *_videos(videos, located(path).parent),
        _numbers(evaluation, scores),
        _about(evaluation),
    ]
    whole = page(
        f"Evaluation: {evaluation.task}",
        [*(section(*one) for one in sections), embedded("data", _data(evaluation, scores))],
        lead=f"{', '.join(evaluation.agents)} on {', '.join(evaluation.engines)}: {said}. "
        f"{len(evaluation)} episodes: {counted(evaluation)}.",
        contents=[(anchor, title) for anchor, title, _ in sections],
    )
    write_whole(whole, path)


def _said(text: str) -> str:
    return f"<p>{escape(text, quote=False)}</p>"


def _drawn(figure: Figure, text: str) -> str:
    return picture(small_png(figure), text)


# --- scores -----------------------------------------------------------------------------------


def _summary(evaluation: Evaluation, scores: Scores, pairs: Pairs, metric: str) -> Section:
    bold = best(evaluation, pairs)
    note = f"Mean {metric_words(metric)} with 95 % intervals over episodes."
    if len(evaluation.agents) > 1:
        note += (
            " Bold: better than every other agent on the same engine, as the interval of each "
            "paired difference excludes 0; not corrected for the number of comparisons."
        )
    return "summary", "Scores", _said(note) + scores.summary(bold, metric)


def _overall(evaluation: Evaluation, metric: str) -> Section:
    note = (
        "Over all protocols, with 95 % intervals. Over training runs they say how other runs of "
        "the same training would do; over episodes, how this one run would do in other episodes. "
        "The interquartile mean leaves out the lowest and the highest quarter of the scores; the "
        "optimality gap is what is missing to a score of 1 on average."
    )
    return "overall", "Overall", _said(note) + overall_table(evaluation, metric)


def _pictures(evaluation: Evaluation, metric: str) -> list[Section]:
    said = metric_words(metric)
    bars = _drawn(
        bars_figure(evaluation, metric),
        f"Bar chart: mean {said} of each agent in each protocol. The numbers are those of Scores.",
    )
    found: list[Section] = [("bars", "By protocol", bars)]
    if len(evaluation.protocols) >= 3:
        text = "Radar chart: the same means, an axis for each protocol."
        found.append(("radar", "Radar", _drawn(radar_figure(evaluation, metric), text)))
    return [*found, ("profile", "Profiles", _profile(evaluation, metric))]


def _profile(evaluation: Evaluation, metric: str) -> str:
    try:
        compared = {e: compare_agents(evaluation, e, metric) for e in evaluation.engines}
    except UnknownOption as error:
        return _said(f"There are none: {error}.")
    text = "Line chart: share of scores above each threshold. "
    rows = [
        [engine, f"{one} > {other}", str(better)]
        for engine, found in compared.items()
        for (one, other), better in found.better.items()
    ]
    if not rows:
        return _drawn(profile_figure(evaluation, compared, metric), text)
    text += "Beside it how probable it is that one agent scores higher than another."
    heads = ["engine", "agents", "probability that the first one scores higher"]
    return _drawn(profile_figure(evaluation, compared, metric), text) + folded(
        "Probabilities of improvement", table(heads, rows, left=2)
    )


def _differences(pairs: Pairs) -> list[Section]:
    if not pairs:
        return []
    note = (
        "Agents met the same draws, so differences are taken episode by episode. Marked: the 95 % "
        "interval excludes 0; not corrected for the number of comparisons."
    )
    inside = _said(note) + difference_table(pairs)
    return [("differences", "Differences between agents", inside)]


def _gap(evaluation: Evaluation, metric: str) -> list[Section]:
    title = "Gap between engines"
    if len(evaluation.engines) < 2:
        return []
    try:
        gaps = gaps_of(evaluation, metric)
    except UnknownOption as error:
        return [("gap", title, _said(f"It cannot be computed: {error}."))]
    text = "Chart: paired difference between engines in each protocol. The numbers are below."
    drawn = _drawn(gap_figure(evaluation, gaps, metric), text)
    return [("gap", title, drawn + folded("Gaps in numbers", gap_table(gaps)))]


# --- causes -----------------------------------------------------------------------------------


def _causes(evaluation: Evaluation, metric: str) -> Section:
    note = (
        "Protocols draw their variables at random, each on its own, so that what goes with the "
        "score is an effect. Named are effects with a Holm p of at most 0.05 in their protocol."
    )
    parts = [_causes_of(evaluation, line, metric) for line in lines_of(evaluation)]
    return "causes", "Which cause broke the agent", _said(note) + "".join(parts)


def _causes_of(evaluation: Evaluation, line: Line, metric: str) -> str:
    found = causes_of(evaluation, line.agent, line.engine, metric)
    title = f"<h3>{escape(f'{line.agent} on {line.engine}')}</h3>"
    verdicts = facts({protocol: verdict(one) for protocol, one in found.items()})
    drawn = _drawn(
        causes_figure(evaluation, found, line.agent, line.engine, metric),
        "Bar charts: share of variance that each variable explains. The numbers are below.",
    )
    numbers = folded("Effects in numbers", cause_table(found) + _left_out(found))
    return title + verdicts + folded("Picture", drawn) + numbers


def _left_out(found: dict[str, Causes]) -> str:
    rows = [
        [protocol, name, reason]
        for protocol, one in found.items()
        for name, reason in one.left_out.items()
    ]
    heads = ["protocol", "left out", "because"]
    return table(heads, rows, left=3) if rows else ""


# --- the rest ---------------------------------------------------------------------------------


def _videos(videos: Sequence[Location | str], folder: Location) -> list[Section]:
    links = "".join(
        f'<li><a href="{escape(quote(_relative(video, folder)))}">{escape(located(video).name)}</a>'
        "</li>"
        for video in videos
    )
    return [("videos", "Videos", f"<ul>{links}</ul>")] if links else []


def _relative(video: Location | str, folder: Location) -> str:
    return posixpath.relpath(str(located(video)), str(folder))


def _numbers(evaluation: Evaluation, scores: Scores) -> Section:
    names = (
        "Means and standard deviations over episodes, under the names of CausalWorld 1.2. There "
        "last_integrated_fractional_success is the mean of the first step and the last nineteen; "
        "here it is that of the last twenty."
    )
    inside = folded("All metrics with intervals", scores.metrics())
    published = _said(names) + published_table(evaluation)
    return "numbers", "All numbers", inside + folded("Published names", published)


def _about(evaluation: Evaluation) -> Section:
    about = evaluation.about
    apart = ("agents", "protocols", "versions")
    plain = facts({name: value for name, value in about.items() if name not in apart})
    policies = table(
        ["agent", "run", "policy"],
        [
            [one["agent"], str(one["run"]), Entry(_policy(one["policy"]), looks="w")]
            for one in about.get("agents", ())
        ],
        left=3,
    )
    versions = "".join(
        f"<h3>{escape(engine)}</h3>{facts(found)}"
        for engine, found in about.get("versions", {}).items()
    )
    check = (
        "<p>Every episode can be played again, with the same bits: "
        "<code>scm-world evaluate --check results.json</code> does so with some of them. The "
        f"table of episodes has the digest <code>{evaluation.digest}</code>.</p>"
    )
    protocols = folded("Protocols", facts({p["name"]: p for p in about.get("protocols", ())}))
    return "about", "About this evaluation", f"{check}{plain}{policies}{protocols}{versions}"


def _policy(policy: dict[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in policy.items())


def _data(evaluation: Evaluation, scores: Scores) -> dict[str, Any]:
    return {
        "rows": len(evaluation),
        "digest": evaluation.digest,
        "scores": scores.rows,
        "about": dict(evaluation.about),
    }
