"""A recording as one Parquet file: a row for each instant.

The last instant of an episode has an observation and a state, but no action and no reward. All
numbers keep their bits.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scm_world.errors import ModelError, UnreadableFile
from scm_world.evaluation.recording.episodes import ONLY, Recorded, parts, whole
from scm_world.evaluation.recording.headers import ADVICE, Header, Numbers
from scm_world.graph.exchange.libraries import load

KEY = b"scm_world"
SHAPES = b"scm_world_shapes"
OBSERVATION, INFO = "observation", "info."
STEPS = {"reward": "rewards", "terminated": "terminations", "truncated": "truncations"}
"""Columns that have a value for each control step, and the fields that they hold."""

Array = NDArray[Any]


def encoded(header: str, episodes: Sequence[Recorded]) -> bytes:
    """Write episodes as the bytes of a file; the same ones every time.

    Raises:
        MissingExtra: pyarrow is not installed.
        ModelError: There is none, or one has other parts of the observation than another.
    """
    arrow, parquet = _libraries()
    names, shapes = _same_parts(episodes), dict[str, list[int]]()
    columns: dict[str, Any] = {
        "episode": np.repeat(np.arange(len(episodes)), [len(e) + 1 for e in episodes]),
        "step": np.concatenate([np.arange(len(e) + 1) for e in episodes]),
    }
    for name in names:
        rows = [parts(seen)[name] for episode in episodes for seen in episode.observations]
        shapes[name] = list(rows[0].shape[1:])
        columns[_column(name)] = _lists(arrow, [row.reshape(-1) for row in rows])
    actions = [row for e in episodes for row in (*e.actions, None)]
    kind = np.result_type(*(episode.actions for episode in episodes))
    columns["action"] = _lists(arrow, actions, kind)
    for column, field in STEPS.items():
        values = [v for e in episodes for v in (*getattr(e, field).tolist(), None)]
        columns[column] = arrow.array(values)
    for name in sorted({name for episode in episodes for name in episode.infos}):
        columns[INFO + name] = arrow.array(_spread(episodes, name))
    columns["state"] = np.concatenate([episode.states for episode in episodes])
    about = {KEY: header, SHAPES: json.dumps(shapes)}
    table = arrow.table(columns).replace_schema_metadata(about)
    sink = arrow.BufferOutputStream()
    parquet.write_table(table, sink, compression="zstd", use_dictionary=False)
    return bytes(sink.getvalue())


def decoded(data: bytes, path: str, trusted: Sequence[str]) -> tuple[Header, list[Recorded]]:
    """Read what ``encoded`` wrote.

    Raises:
        MissingExtra: pyarrow is not installed.
        UnreadableFile: It is something else, or damaged.
        ModelError: A mechanism is a function of no trusted package.
    """
    arrow, parquet = _libraries()
    try:
        table = parquet.read_table(arrow.BufferReader(data), use_threads=False).combine_chunks()
    except (arrow.ArrowException, OSError, ValueError) as error:
        raise UnreadableFile(path, f"it is no whole Parquet file ({error})", ADVICE) from None
    about = table.schema.metadata or {}
    header = Header.read(about.get(KEY), path, trusted)
    try:
        shapes = json.loads(about[SHAPES])
        numbers, steps = (table[name].to_numpy() for name in ("episode", "step"))
    except (KeyError, ValueError):
        raise UnreadableFile(path, "it has other columns", ADVICE) from None
    if not np.array_equal(np.unique(numbers), np.arange(len(header.episodes))):
        raise UnreadableFile(path, "it has other episodes than it says", ADVICE)
    lengths = np.bincount(numbers, minlength=len(header.episodes))
    if np.any(np.diff(numbers) < 0) or not np.array_equal(steps, _counted(lengths)):
        raise UnreadableFile(path, "its rows are in another order", ADVICE)
    bounds = np.searchsorted(numbers, np.arange(len(header.episodes) + 1))
    episodes = []
    for number, (start, stop) in enumerate(pairwise(bounds)):
        rows = table.slice(start, stop - start)
        episodes.append(header.episode(number, partial(_numbers, rows, shapes)))
    return header, episodes


def _counted(lengths: NDArray[np.int64]) -> NDArray[np.int64]:
    """Count from 0 in each of several lengths."""
    return np.concatenate([np.arange(length) for length in lengths])


def _numbers(rows: Any, shapes: Mapping[str, Sequence[int]]) -> Numbers:
    """Give the arrays of an episode.

    Raises:
        ValueError: A column is damaged.
    """
    seen = {name: list(_rows(rows[_column(name)], shapes[name])) for name in shapes}
    count = rows.num_rows
    infos = {}
    for column in rows.column_names:
        if column.startswith(INFO) and rows[column].null_count == 0:
            infos[column.removeprefix(INFO)] = rows[column].to_numpy()
    steps = rows.slice(0, count - 1)
    return {
        "observations": tuple(
            whole({name: arrays[at] for name, arrays in seen.items()}) for at in range(count)
        ),
        "actions": np.array(list(_rows(steps["action"], ()))),
        **{field: steps[column].to_numpy() for column, field in STEPS.items()},
        "infos": infos,
        "states": rows["state"].to_numpy(),
    }


def _libraries() -> tuple[Any, Any]:
    return load("pyarrow", "pyarrow", "data"), load("pyarrow.parquet", "pyarrow", "data")


def _same_parts(episodes: Sequence[Recorded]) -> tuple[str, ...]:
    """Give the parts of all observations.

    Raises:
        ModelError: They are not the same ones, or there is no episode.
    """
    kinds = {tuple(parts(e.observations[0])) for e in episodes}
    if len(kinds) != 1:
        raise ModelError(["a recording to save has episodes of one environment, and one at least"])
    return kinds.pop()


def _column(name: str) -> str:
    return OBSERVATION if name == ONLY else f"{OBSERVATION}.{name}"


def _lists(arrow: Any, rows: Sequence[Array | None], kind: Any = None) -> Any:
    """Make a column of lists; None is a row without one."""
    there = [row for row in rows if row is not None]
    lengths = [0 if row is None else len(row) for row in rows]
    flat = np.concatenate(there).astype(kind or there[0].dtype, casting="safe")
    places: NDArray[np.int64] = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    missing = np.array([row is None for row in rows])
    return arrow.LargeListArray.from_arrays(places, flat, mask=arrow.array(missing))


def _rows(column: Any, shape: Sequence[int]) -> Iterator[Array]:
    """Give the arrays of a column of lists."""
    for chunk in column.chunks:
        flat = chunk.values.to_numpy(zero_copy_only=False)
        places = chunk.offsets.to_numpy()
        for start, stop in pairwise(places):
            yield flat[start:stop].reshape(-1, *shape) if shape else flat[start:stop]


def _spread(episodes: Sequence[Recorded], name: str) -> list[Any]:
    """Give an info of all episodes; None where it is not known."""
    found: list[Any] = []
    for episode in episodes:
        known = episode.infos.get(name)
        found += [None] * (len(episode) + 1) if known is None else known.tolist()
    return found
