"""The figures of the paper again: a radar with a polygon for each curriculum, and what is known.

They say in their titles how much of the published budget stands behind them.
"""

from __future__ import annotations

import math
from pathlib import Path

from scm_world.evaluation import Interval, protocols_of
from scm_world.evaluation.outputs.looks import Line, Looks, Scores
from scm_world.evaluation.outputs.radar import radars
from scm_world.output.canvas import save
from scm_world.training.study.cells import PROTOCOLS
from scm_world.training.study.scores import Findings
from scm_world.training.study.tables import lacks, said

OURS, THERE, ACTOR = "ours", "published", "published actor, evaluated here"
SIDES = (OURS, THERE, ACTOR)


def draw(found: Findings, task: str, algo: str, path: Path) -> bool:
    """Draw the radar of a task and an algorithm: a color for each curriculum.

    Args:
        found: What is in the folder.
        task: Name of the task.
        algo: Name of the algorithm.
        path: Of the PNG.

    Returns:
        Whether there is anything to draw besides what was published.

    Raises:
        UnwritableFolder: There is no such folder, no room, or no permission.
    """
    scores = _scores(found, task, algo)
    if not any(line.engine in (OURS, ACTOR) for line, _ in scores):
        return False
    lines = sorted({line for line, _ in scores}, key=_order)
    looks = Looks(lines, between=", ")
    words = {p.name: p.doc for p in protocols_of(task) if p.name in PROTOCOLS}
    figure = radars(
        {"": lines},
        scores,
        words,
        looks=looks,
        title=f"{task}, {algo.upper()}: fractional success at the end",
        note=_note(found, task, algo),
    )
    save(figure, path)
    return True


def _scores(found: Findings, task: str, algo: str) -> Scores:
    """Give what is known of all polygons, those of one curriculum after another."""
    scores: Scores = {}
    for curriculum in found.study.curricula:
        agent = f"curriculum {curriculum}"
        rows = [row for row in found.rows(task, algo, curriculum) if row.protocol in PROTOCOLS]
        for row in rows:
            known = {
                OURS: None if row.ours is None else row.ours.mean,
                THERE: None if row.published is None else _exactly(row.published),
                ACTOR: row.actor,
            }
            for side, one in known.items():
                if one is not None:
                    scores[Line(agent, side), row.protocol] = one
    return scores


def _order(line: Line) -> tuple[int, str]:
    return SIDES.index(line.engine), line.agent


def _exactly(value: float) -> Interval:
    """Give a score of which nothing else is known."""
    return Interval(value, math.nan, math.nan, 0.95, 1)


def _note(found: Findings, task: str, algo: str) -> str:
    study = found.study
    done = "; ".join(
        f"curriculum {curriculum}: {said(lacks(found, task, algo, curriculum))}"
        for curriculum in study.curricula
    )
    return (
        f"Ours: preset {study.preset}, conventions {study.rules}, {study.backend}; {done}. Bands "
        "are 95 % intervals, over seeds, or over the episodes of the only one."
    )
