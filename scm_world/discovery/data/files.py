"""Datasets in folders: a study whose files are tables of Parquet."""

from __future__ import annotations

import io
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from scm_world._arguments import typed, whole_number
from scm_world.discovery.data.dataset import Column, Dataset, check_commands, check_names
from scm_world.discovery.data.views import as_frame, from_frame
from scm_world.errors import ModelError, UnreadableFile, in_one_line, reading
from scm_world.queries.observations import TARGETS
from scm_world.runs.files import Location, drafted, located, read_bytes, read_text, write_whole
from scm_world.runs.study import Study, settings_in, unsealed

KIND = "dataset"
COUNT = "dataset.json"
"""Holds how many episodes there are, once it is known, and how many files."""
ABOUT = "table"
"""The entry of the settings with the columns of the dataset, and the file size."""


def shard_name(index: int) -> str:
    """Return the name of a file."""
    return f"shard-{index:05d}.parquet"


def settings_of(about: dict[str, Any], columns: Sequence[Column], shard: int) -> dict[str, Any]:
    """Return the settings of a study; its episodes may become more."""
    check_names(columns)
    found = {**about, ABOUT: {"columns": [asdict(c) for c in columns], "shard": shard}}
    try:
        plain: dict[str, Any] = json.loads(json.dumps(found, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ModelError([f"the dataset's 'about' is not plain data: {error}"]) from None
    return plain


def count_in(folder: Location) -> dict[str, int]:
    """Return how many ``"episodes"`` and ``"files"`` a folder has when it is complete."""
    path = folder / COUNT
    advice = "delete it and collect again with the same settings, or save again elsewhere"
    with reading(path, advice):
        found = json.loads(read_text(path))
        return {name: whole_number(name, found[name], least=0) for name in ("episodes", "files")}


def write_count(folder: Location, episodes: int, files: int) -> None:
    """Write the counts that ``count_in`` reads."""
    write_whole(folder / COUNT, json.dumps({"episodes": episodes, "files": files}) + "\n")


# --- files ----------------------------------------------------------------------------------------


def encoded(table: Dataset) -> bytes:
    """Return rows as a Parquet file of their frame, the same bytes every time."""
    used, number = np.unique(table.regime, return_inverse=True)
    regimes = tuple(table.regimes[kind] for kind in used)
    frame = as_frame(replace(table, regimes=regimes, regime=number.reshape(-1)))
    frame[TARGETS] = [";".join(names or ()) for names in frame[TARGETS]]
    # Only words repeat; numbers keep every bit without a dictionary, and are faster.
    how = {"compression": "zstd", "use_dictionary": [TARGETS], "write_page_checksum": True}
    return bytes(frame.to_parquet(None, index=False, **how))


def decoded(data: bytes, columns: Sequence[Column], trusted: Sequence[str]) -> Dataset:
    """Read a file of ``encoded``."""
    import pandas

    frame = pandas.read_parquet(io.BytesIO(data), page_checksum_verification=True)
    table = from_frame(frame, trusted=tuple(trusted))
    if table.columns != tuple(columns):
        raise ValueError("it has other columns")
    return table


# --- whole datasets -------------------------------------------------------------------------------


def together(settings: Mapping[str, Any], parts: Sequence[Dataset]) -> Dataset:
    """Return the rows of all files as one table, with all that is said of its episodes."""
    about = {name: value for name, value in settings.items() if name != ABOUT}
    for name in ("refused", "touching"):
        found = {
            number: each for part in parts for number, each in part.about.get(name, {}).items()
        }
        about |= {name: found} if found else {}
    return replace(Dataset.joined([replace(part, about={}) for part in parts]), about=about)


@typed
def load(folder: Location | str, *, trusted: Sequence[str] = (), partial: bool = False) -> Dataset:
    """Read a dataset.

    Args:
        folder: A folder, or a URL, that ``collect`` or ``save`` wrote.
        trusted: Packages other than this one whose functions may be mechanisms of its plans.
        partial: Whether files may be missing, since a collection was interrupted.

    Raises:
        UnreadableFile: A file is missing, damaged, or of another kind; the error names it and the
            remedy.
        ModelError: A plan names a function outside of the trusted packages.
    """
    place = located(folder)
    settings = settings_in(place, KIND)
    parts = [*batches(place, trusted=trusted, partial=partial)]
    columns, none = _columns(place, settings), np.zeros(0, dtype=np.int64)
    empty = Dataset(np.empty((0, len(columns))), columns, (), none, none, none)
    return together(settings, parts or [empty])


@typed
def batches(
    folder: Location | str, *, trusted: Sequence[str] = (), partial: bool = False
) -> Iterator[Dataset]:
    """Read a dataset file by file, in bounded memory; see ``load``.

    Returns:
        The rows of each file. Their ``about`` has which of these episodes were ``"refused"``.
    """
    place = located(folder)
    settings, count = settings_in(place, KIND), count_in(place)
    columns, size = _columns(place, settings), settings[ABOUT]["shard"]
    for index in range(count["files"]):
        path = place / shard_name(index)
        holds = range(index * size, min((index + 1) * size, count["episodes"]))
        try:
            content = unsealed(path.name, read_bytes(path), settings, holds)
            table = decoded(content, columns, trusted)
        except FileNotFoundError:
            if partial:
                continue
            advice = "collect again with the same settings to go on, or load it with partial=True"
            raise UnreadableFile(str(path), "it is not there yet", advice) from None
        except Exception as error:
            if isinstance(error, ModelError) and "trusted" in str(error):
                raise
            advice = "delete it, and collect again with the same settings: only it is made anew"
            raise UnreadableFile(str(path), in_one_line(error), advice) from None
        yield together(settings, [table])


def _columns(folder: Location, settings: Mapping[str, Any]) -> tuple[Column, ...]:
    try:
        columns = tuple(Column(**column) for column in settings[ABOUT]["columns"])
    except Exception as error:
        advice = "give the folder of a dataset"
        raise UnreadableFile(str(folder), f"no columns in it: {error!r}", advice) from None
    check_commands(settings, columns)
    return columns


@typed
def save(dataset: Dataset, folder: Location | str, *, shard: int = 10_000) -> Location:
    """Write a dataset to a new folder, without loss.

    Args:
        dataset: A table whose ``about`` is plain data.
        folder: New or empty; it may be a URL.
        shard: How many episodes are in a file, at most.

    Raises:
        UnreadableFile: Something is in the folder.
        UnwritableFolder: The disk is full, or permission is missing.
        ModelError: A part of it cannot be written.
    """
    place, size = located(folder), whole_number("shard", shard, least=1)
    if place.exists() and any(True for _ in place.iterdir()):
        raise UnreadableFile(str(place), "it is not empty", "give a new or an empty folder")
    starts = np.flatnonzero(np.diff(dataset.episode, prepend=dataset.episode[:1] - 1))
    ends = [*starts[::size], len(dataset)]
    settings = settings_of(dataset.about, dataset.columns, size)
    with drafted(place) as draft, Study(draft, KIND, settings) as study:
        for number, (begin, end) in enumerate(itertools.pairwise(ends)):
            rows = replace(dataset.rows(slice(begin, end)), about={})
            holds = range(number * size, min((number + 1) * size, len(starts)))
            study.keep(shard_name(number), encoded(rows), holds)
        write_count(draft, len(starts), len(ends) - 1)
    return place
