"""Everything that is drawn and written of an evaluation, in one folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from typing import TYPE_CHECKING, Any

from scm_world.evaluation.checking import shard_runner_of
from scm_world.evaluation.outputs import (
    bars_figure,
    causes_figure,
    gap_figure,
    profile_figure,
    radar_figure,
    record_videos,
    save,
    write_report,
)
from scm_world.evaluation.results import Evaluation
from scm_world.output.durable import removed
from scm_world.output.locations import Location, located
from scm_world.queries.progress import Progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
    doers = [(agent, engine) for agent in evaluation.agents for engine in evaluation.engines]
    if videos:
        with closing(shard_runner_of(evaluation, policy=policy, trusted=trusted)) as shard_runner:
            for agent, engine in doers:
                who: Any = {"agent": agent, "engine": engine, "metric": metric}
                films += record_videos(shard_runner, evaluation, place, **who, progress=progress)
    drawn: dict[str, Callable[[], Figure]] = {"bars": lambda: bars_figure(evaluation, metric)}
    if len(evaluation.protocols) >= CORNERS:
        drawn["radar"] = lambda: radar_figure(evaluation, metric)
    if _comparable(evaluation):
        drawn["profile"] = lambda: profile_figure(evaluation, metric)
    if len(evaluation.engines) > 1:
        drawn["gap"] = lambda: gap_figure(evaluation, metric)
    for agent, engine in doers if evaluation.drawn() else ():
        name = "causes" if len(doers) == 1 else f"causes-{agent}-{engine}".replace("/", "_")
        drawn[name] = partial(causes_figure, evaluation, agent, engine, metric)
    files = []
    for name, draw in drawn.items():
        files.append(place / f"{name}.png")
        save(draw(), files[-1])
    report = place / "report.html"
    write_report(evaluation, report, videos=films, metric=metric)
    return (*files, report, *films)


def _comparable(evaluation: Evaluation) -> bool:
    """Whether all agents have played the same protocols, and more than one episode of each."""
    agents = [evaluation.only(agent=agent) for agent in evaluation.agents]
    same = {frozenset(mine.protocols) for mine in agents} == {frozenset(evaluation.protocols)}
    least = min(len(mine) / len(mine.protocols) / len(mine.engines) for mine in agents)
    return same and least > 1
