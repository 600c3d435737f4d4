"""Tables of episodes: a column for everything that is kept of an episode."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from hashlib import blake2b
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scm_world.errors import UnknownOption
from scm_world.evaluation.episodes import METRICS, EpisodeRow
from scm_world.evaluation.statistics import Interval, difference_interval, is_binary

TEXTS = ("agent", "engine", "protocol", "hash")
WHOLE = ("run", "seed", "episode", "steps")
KEYS = ("agent", "run", "engine", "protocol", "seed", "episode")
"""The columns that say which episode a row is of."""

DRAWN = "drawn "
"""First word of the columns with the values that were drawn."""

Columns = dict[str, NDArray[Any]]


def columns_of(rows: Sequence[EpisodeRow]) -> Columns:
    """Return the table of some episodes: a column of shape (n,) for each field of a row."""
    found: Columns = {}
    for name in (*KEYS, "steps"):
        kind: Any = str if name in TEXTS else np.int64
        found[name] = np.array([getattr(row, name) for row in rows], dtype=kind)
    for metric in METRICS:
        if all(metric in row.scores for row in rows):
            found[metric] = np.array([row.scores[metric] for row in rows], dtype=np.float64)
    found["hash"] = np.array([row.hash for row in rows], dtype=str)
    return {**found, **_drawn(rows)}


def _drawn(rows: Sequence[EpisodeRow]) -> Columns:
    """Give a column for each number of each variable that was drawn; NaN where it was not."""
    sizes: dict[str, int] = {}
    for row in rows:
        for name, values in row.drawn.items():
            sizes[name] = max(sizes.get(name, 0), len(values))
    found: Columns = {}
    for name, size in sizes.items():
        table = np.full((len(rows), size), np.nan)
        for place, row in enumerate(rows):
            values = row.drawn.get(name, [])
            table[place, : len(values)] = values
        labels = [name] if size == 1 else [f"{name}[{k}]" for k in range(size)]
        found |= {DRAWN + label: table[:, k].copy() for k, label in enumerate(labels)}
    return found


def joined(tables: Iterable[Columns]) -> Columns:
    """Put tables under one another."""
    listed = list(tables)
    names = dict.fromkeys(name for table in listed for name in table)
    return {
        name: np.concatenate(
            [table.get(name, np.full(len(table["episode"]), np.nan)) for table in listed]
        )
        for name in names
    }


def measured(columns: Columns) -> tuple[str, ...]:
    """List those of ``METRICS`` that a table has."""
    return tuple(metric for metric in METRICS if metric in columns)


def known(columns: Columns, metric: str | None) -> str:
    """Check the name of a metric; None stands for the first one that a table has.

    Raises:
        UnknownOption: It has none of this name.
    """
    there = measured(columns)
    if metric is None:
        return there[0]
    if metric not in there:
        raise UnknownOption("metric", metric, there)
    return metric


def means(columns: Columns, metric: str) -> dict[tuple[int, int], float]:
    """Give the mean score of each episode over the training runs, by seed and number."""
    found: dict[tuple[int, int], list[float]] = {}
    seeds, episodes = columns["seed"].tolist(), columns["episode"].tolist()
    for seed, episode, score in zip(seeds, episodes, columns[metric].tolist(), strict=True):
        found.setdefault((seed, episode), []).append(score)
    return {unit: sum(scores) / len(scores) for unit, scores in found.items()}


def paired(one: Columns, other: Columns, metric: str | None) -> Interval:
    """Estimate by how much the scores of a table are higher, episode by episode.

    Raises:
        UnknownOption: They do not have the same episodes, or there is no such metric.
    """
    metric = known(one, metric)
    mine, its = means(one, metric), means(other, metric)
    if mine.keys() != its.keys():
        differ = sorted(mine.keys() ^ its.keys())[0]
        allowed = ("episodes that both have played",)
        raise UnknownOption("seed and episode of a pair", differ, allowed)
    units = sorted(mine)
    first, second = (np.array([scores[unit] for unit in units]) for scores in (mine, its))
    binary = is_rate(metric, first) and is_rate(metric, second)
    return difference_interval(first, second, proportion=binary)


def is_rate(metric: str, scores: NDArray[np.float64]) -> bool:
    """Tell whether scores are failures and successes: not by chance, as fractions may be."""
    return metric == "success" and is_binary(scores)


def digest_of(columns: Columns) -> str:
    """Sum up a table, bit for bit, in whatever order its columns are."""
    found = blake2b(digest_size=16)
    for name in sorted(columns):
        column = columns[name]
        found.update(f"\0{name}\0".encode())
        text = "\0".join(column) if column.dtype.kind == "U" else ""
        found.update(text.encode() if text else column.tobytes())
    return found.hexdigest()
