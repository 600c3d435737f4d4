"""Datasets in folders: reading and writing them whole."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from scm_world._arguments import whole_number
from scm_world.discovery.data.dataset import Dataset, Regime
from scm_world.discovery.data.folders import SHARD, Folder, Head, head_of, read_sidecar
from scm_world.discovery.data.shards import check_kind, content_of
from scm_world.discovery.data.sources import SourceRows
from scm_world.errors import ModelError, UnreadableFile
from scm_world.output.locations import Location, located


def load(folder: Location | str, *, trusted: Sequence[str] = (), partial: bool = False) -> Dataset:
    """Read a dataset.

    Args:
        folder: That ``collect`` or ``save`` wrote; it may be a URL.
        trusted: Packages, besides this one, whose functions may be mechanisms of its plans.
        partial: Whether files may be missing, since a collection was interrupted.

    Raises:
        UnreadableFile: A file is missing, damaged, or belongs to another dataset; it says which,
            and what to do.
        ModelError: A plan names a function outside of the trusted packages.
        MissingExtra: A library that reads it is not installed.
    """
    place = located(folder)
    head = head_of(read_sidecar(place))
    check_kind(head.kind)
    files = Folder(place, head, trusted)
    parts, ranges = [], head.ranges()
    known = {files.shard(index) for index in range(len(ranges))}
    for stranger in sorted(set(place.glob(f"shard-*.{head.kind}")) - known, key=str):
        reason = f"the dataset has {len(ranges)} files, and it is none of them"
        raise UnreadableFile(str(stranger), reason, "remove it from the folder")
    for index, numbers in enumerate(ranges):
        part = files.read(index, numbers)
        if part is None and not partial:
            advice = f"{files.again} to go on, or load it with partial=True"
            raise UnreadableFile(str(files.shard(index)), "it is not there yet", advice)
        if part is not None:
            parts.append(part)
    return together(head, parts)


def together(head: Head, parts: Sequence[SourceRows]) -> Dataset:
    """Put the parts of a dataset together, with what was refused."""
    empty = np.zeros(0, dtype=np.int64)
    nothing = np.empty((0, len(head.columns)))
    tables = [part.table for part in parts] or [
        Dataset(nothing, head.columns, (), empty, empty, empty, head.about)
    ]
    refused = refusals(parts)
    about = {**head.about, "refused": refused} if refused else dict(head.about)
    return replace(Dataset.joined(tables), about=about)


def refusals(parts: Sequence[SourceRows]) -> dict[str, str]:
    """Say why episodes could not be, by their number."""
    return {str(number): why for part in parts for number, why in part.refused}


def save(
    dataset: Dataset,
    folder: Location | str,
    *,
    shard: int = SHARD,
    format: str = "parquet",  # noqa: A002 # as other libraries call it
) -> Location:
    """Write a dataset to a new folder, without loss.

    Args:
        dataset: Its ``about`` has to be plain data: what JSON can hold.
        folder: New or empty, or one in which saving the same dataset was interrupted; it may be a
            URL.
        shard: How many episodes are in a file.
        format: ``"parquet"`` or ``"csv"``.

    Raises:
        UnreadableFile: Something else is in the folder, be it a dataset with other numbers only.
        UnwritableFolder: There is no room, or no permission.
        ModelError: A part of it cannot be written.
    """
    try:
        about = json.loads(json.dumps(dataset.about, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ModelError(
            [f"what the dataset says about itself is no plain data: {error}"]
        ) from None
    table = _trimmed(dataset)
    starts = np.flatnonzero(np.diff(table.episode, prepend=table.episode[:1] - 1))
    ends = [*starts, len(table)]
    size = whole_number("shard", shard, least=1)
    head = Head(about, table.columns, len(starts), size, format, content=content_of(table))
    files = Folder(folder, head)
    with files.opened():
        files.note({})
        for index, numbers in enumerate(head.ranges()):
            rows = table.rows(slice(ends[numbers.start], ends[numbers.stop]))
            files.write(index, numbers, SourceRows(_trimmed(rows)))
        files.note({}, complete=True)
    return files.path


def _trimmed(table: Dataset) -> Dataset:
    """Number the regimes as they occur, each once, and leave out those that no row has."""
    used, first = np.unique(table.regime, return_index=True)
    kept: dict[Regime, int] = {}
    number = np.zeros(len(table.regimes), dtype=np.int64)
    for old in used[np.argsort(first)]:
        number[old] = kept.setdefault(table.regimes[old], len(kept))
    return replace(table, regimes=tuple(kept), regime=number[table.regime])
