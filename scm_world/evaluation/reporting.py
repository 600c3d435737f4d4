"""Everything that is drawn and written of an evaluation, in one folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from scm_world.evaluation.again import bench_of
from scm_world.evaluation.outputs import (
    draw_bars,
    draw_causes,
    draw_gap,
    draw_profile,
    draw_radar,
    record_videos,
    write_report,
)
from scm_world.evaluation.results import Evaluation
from scm_world.output.durable import removed
from scm_world.output.locations import Location, located
from scm_world.queries.progress import Progress

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
    """Write plots, the report, and videos if they are wanted.

    Args:
        evaluation: What is shown.
        folder: Where to; it is there. It may be a URL.
        metric: Score that is drawn.
        videos: Whether the best, the median and the worst episode of each agent are filmed.
        policy: Who acted, for videos of policies that are no files and have no names.
        trusted: Packages whose functions may be policies, for videos.
        progress: Told how many control steps of a video are done.

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
        films = _films(evaluation, place, metric, policy, trusted, progress)
    files = []
    for name, draw in _pictures(evaluation, metric).items():
        files.append(place / f"{name}.png")
        draw(evaluation, files[-1])
    report = place / "report.html"
    write_report(evaluation, report, videos=films, metric=metric)
    return (*files, report, *films)


def _pictures(evaluation: Evaluation, metric: str) -> dict[str, Callable[..., Any]]:
    """List the pictures that an evaluation has enough for."""
    found: dict[str, Callable[..., Any]] = {"bars": partial(draw_bars, metric=metric)}
    if len(evaluation.protocols) >= CORNERS:
        found["radar"] = partial(draw_radar, metric=metric)
    if _comparable(evaluation):
        found["profile"] = partial(draw_profile, metric=metric)
    if len(evaluation.engines) > 1:
        found["gap"] = partial(draw_gap, metric=metric)
    if evaluation.drawn():
        doers = [(agent, engine) for agent in evaluation.agents for engine in evaluation.engines]
        for agent, engine in doers:
            name = "causes" if len(doers) == 1 else f"causes-{agent}-{engine}"
            draw = partial(draw_causes, agent=agent, engine=engine, metric=metric)
            found[name.replace("/", "_")] = draw
    return found


def _comparable(evaluation: Evaluation) -> bool:
    """Tell whether all agents have played the same protocols, and more than one episode of each."""
    agents = [evaluation.only(agent=agent) for agent in evaluation.agents]
    same = {frozenset(mine.protocols) for mine in agents} == {frozenset(evaluation.protocols)}
    least = min(len(mine) / len(mine.protocols) / len(mine.engines) for mine in agents)
    return same and least > 1


def _films(
    evaluation: Evaluation,
    folder: Location,
    metric: str,
    policy: Any,
    trusted: Sequence[str],
    progress: Progress | None,
) -> list[Location]:
    bench = bench_of(evaluation, policy=policy, trusted=trusted)
    try:
        return [
            film
            for agent in evaluation.agents
            for engine in evaluation.engines
            for film in record_videos(
                bench,
                evaluation,
                folder,
                agent=agent,
                engine=engine,
                metric=metric,
                progress=progress,
            )
        ]
    finally:
        bench.close()
