"""What the evaluations of a study say, one number of the published figures after another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import final

import numpy as np

from scm_world.evaluation import Evaluation, Interval, merge
from scm_world.evaluation.arena import FRACTIONS
from scm_world.evaluation.statistics import aggregate
from scm_world.training.study.cells import PROTOCOLS, Cell, Study
from scm_world.training.study.published import Actor, published
from scm_world.training.study.records import (
    ACTORS,
    Record,
    evaluation_of,
    read_evaluation,
    records,
)

OVERALL = "all"
"""Stands where a protocol stands: the mean over all of them."""


@final
@dataclass(frozen=True)
class Ours:
    """A score of ours.

    Attributes:
        mean: With its 95 % interval.
        over: What the interval is over: ``"seeds"``, or with one of them ``"episodes"``.
        iqm: Interquartile mean over what the interval is over, with its interval.
        seeds: Of the trainings.
        episodes: Of each training, at least.
    """

    mean: Interval
    over: str
    iqm: Interval
    seeds: tuple[int, ...]
    episodes: int


@final
@dataclass(frozen=True)
class Row:
    """A number of a published figure, and all that we know of it.

    Attributes:
        task: Name of the task.
        algo: Name of the algorithm.
        curriculum: Its number.
        protocol: Its name, or ``OVERALL``.
        ours: Trained and evaluated here; None if that was not run.
        published: The published score; None if it is not known.
        source: Of it.
        actor: The published actor, evaluated here.
        original: The same where it comes from.
    """

    task: str
    algo: str
    curriculum: int
    protocol: str
    ours: Ours | None
    published: float | None
    source: str
    actor: Interval | None
    original: float | None


@final
@dataclass(frozen=True)
class Findings:
    """Everything that a folder has.

    Attributes:
        study: The figure that is filled; its folder may have a part of it.
        records: Of the trainings that are evaluated.
        evaluations: Of them.
        actors: Evaluations of published actors, by task.
    """

    study: Study
    records: Mapping[Cell, Record]
    evaluations: Mapping[Cell, Evaluation]
    actors: Mapping[str, Evaluation]

    @classmethod
    def read(cls, study: Study, folder: Path) -> Findings:
        """Read a folder.

        Raises:
            UnreadableFile: A file in it is damaged.
        """
        found = {
            record.cell: (record, evaluation)
            for record in records(folder)
            if (evaluation := read_evaluation(evaluation_of(folder, record.cell))) is not None
        }
        actors = {
            task: evaluation
            for task in study.tasks
            if (evaluation := read_evaluation(folder / ACTORS / task)) is not None
        }
        return cls(
            study,
            {cell: both[0] for cell, both in found.items()},
            {cell: both[1] for cell, both in found.items()},
            actors,
        )

    def group(self, task: str, algo: str, curriculum: int) -> dict[int, Evaluation]:
        """Give the evaluations of one kind of training, by seed."""
        return {
            cell.seed: evaluation
            for cell, evaluation in sorted(self.evaluations.items())
            if cell.group == (task, algo, curriculum)
        }

    @cached_property
    def table(self) -> tuple[Row, ...]:
        """All numbers of the figure."""
        return tuple(
            self._row(task, algo, curriculum, protocol)
            for task in self.study.tasks
            for algo in self.study.algos
            for curriculum in self.study.curricula
            for protocol in (*PROTOCOLS, OVERALL)
        )

    def rows(self, task: str, algo: str, curriculum: int) -> list[Row]:
        """List the numbers of one polygon of a radar, and their mean."""
        key = (task, algo, curriculum)
        return [row for row in self.table if (row.task, row.algo, row.curriculum) == key]

    def _row(self, task: str, algo: str, curriculum: int, protocol: str) -> Row:
        known = published().of(task, algo, curriculum)
        actor = published().actor(task, algo, curriculum)
        return Row(
            task,
            algo,
            curriculum,
            protocol,
            ours=_ours(self.group(task, algo, curriculum), protocol),
            published=None if known is None else _value(known.values, protocol),
            source="" if known is None else known.source,
            actor=self._actor(actor, protocol),
            original=None if actor is None else actor.values.get(protocol),
        )

    def _actor(self, actor: Actor | None, protocol: str) -> Interval | None:
        found = None if actor is None else self.actors.get(actor.task)
        if found is None:
            return None
        if protocol == OVERALL:
            return found.overall()["mean"] if {*PROTOCOLS} <= {*found.protocols} else None
        return found.score(protocol) if protocol in found.protocols else None

    def merged(self, task: str, algo: str) -> Evaluation | None:
        """Put all evaluations of one task and algorithm together: an agent for each curriculum.

        It has the protocols and the episodes that all of them have; None if there are none.

        Raises:
            ModelError: They were made with other versions of an engine.
        """
        parts = {c: e for c, e in self.evaluations.items() if (c.task, c.algo) == (task, algo)}
        common = [p for p in PROTOCOLS if all(p in e.protocols for e in parts.values())]
        if not parts or not common:
            return None
        least = min(int(evaluation.about["n"]) for evaluation in parts.values())
        return merge(_as_run(e, c.seed, common, least) for c, e in sorted(parts.items()))


def _value(values: Mapping[str, float], protocol: str) -> float | None:
    if protocol != OVERALL:
        return values.get(protocol)
    whole = {*PROTOCOLS} <= {*values}
    return float(np.mean([values[name] for name in PROTOCOLS])) if whole else None


def _ours(group: Mapping[int, Evaluation], protocol: str) -> Ours | None:
    """Estimate a score over seeds, or over the episodes of the only one."""
    names = PROTOCOLS if protocol == OVERALL else (protocol,)
    played = {s: e for s, e in group.items() if {*names} <= {*e.protocols}}
    if not played:
        return None
    scores = [
        np.array([e.only(protocol=name).columns[FRACTIONS[0]] for name in names])
        for e in played.values()
    ]  # (seeds, protocols, episodes)
    over = "seeds" if len(scores) > 1 else "episodes"
    means = np.array([one.mean(axis=-1) for one in scores])  # (seeds, protocols)
    episodes = min(one.shape[-1] for one in scores)
    if over == "episodes" and episodes == 1:
        return None
    found = (
        aggregate(means, over="runs")
        if over == "seeds"
        else aggregate(np.array(scores), over="episodes")
    )
    return Ours(found["mean"], over, found["interquartile_mean"], tuple(played), episodes)


def _as_run(evaluation: Evaluation, seed: int, protocols: list[str], n: int) -> Evaluation:
    """Give a part of an evaluation, its training run named after the seed."""
    columns = evaluation.columns
    kept = np.isin(columns["protocol"], protocols) & (columns["episode"] < n)
    part = {name: column[kept] for name, column in columns.items()}
    about = {
        **evaluation.about,
        "agents": [{**agent, "run": seed} for agent in evaluation.about["agents"]],
        "protocols": [p for p in evaluation.about["protocols"] if p["name"] in protocols],
        "n": n,
    }
    return Evaluation(about, {**part, "run": np.full(int(kept.sum()), seed, dtype=np.int64)})
