"""A folder that holds a dataset: a sidecar, and files that are complete or absent."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import Any, final

import numpy as np

from scm_world._arguments import typed, whole_number
from scm_world._fingerprint import changes
from scm_world.discovery.data.dataset import Column, Dataset, Regime, check_names
from scm_world.discovery.data.pictures import ENDINGS
from scm_world.discovery.data.shards import (
    checksum,
    decoded,
    encoded,
    raw_of,
)
from scm_world.discovery.data.sources import FORMAT, SourceRows
from scm_world.errors import DAMAGED, ModelError, UnknownOption, UnreadableFile
from scm_world.graph.structure import Edge
from scm_world.output.durable import PARTIAL, is_draft, locked, removed, said, write_durably
from scm_world.output.reading import LARGEST_TABLE, read_bytes, read_text
from scm_world.output.remote import Location, located

SIDECAR = "dataset.json"
SHARD = 100
"""Episodes in a file by default."""


class FewerEpisodes(UnknownOption):
    """A folder has more episodes already than are asked for.

    Attributes:
        there: How many it has.
        folder: Which one.
    """

    def __init__(
        self, asked: int, there: int, folder: str, option: str = "number of episodes"
    ) -> None:
        self.there, self.folder = there, folder
        super().__init__(option, asked, (f"{there} or more: {folder} has so many already",))


@final
@dataclass(frozen=True)
class Head:
    """What is known of a dataset before its first row.

    Attributes:
        about: Everything that decides the rows, as plain data.
        columns: What stands in a row.
        n: How many episodes there will be.
        shard: How many of them are in a file.
        edges: The declared graph, if it may be known.
        content: Sums up the rows of a dataset that was saved; None of one that is collected, of
            which ``about`` decides the rows.
    """

    about: dict[str, Any]
    columns: tuple[Column, ...]
    n: int
    shard: int = SHARD
    edges: tuple[Edge, ...] | None = None
    content: str | None = None

    @property
    def terms(self) -> dict[str, Any]:
        """List what has to be the same for rows to belong together; how many is not among it."""
        found = {
            "about": self.about,
            "columns": [asdict(column) for column in self.columns],
            "shard": self.shard,
            "files": "parquet",
            "content": self.content,
        }
        plain: dict[str, Any] = json.loads(json.dumps(found))
        return plain

    @property
    def plan(self) -> str:
        """Sum up the terms."""
        return hashlib.sha256(json.dumps(self.terms, sort_keys=True).encode()).hexdigest()

    @property
    def empty(self) -> Dataset:
        """The dataset without its rows."""
        none = np.zeros(0, dtype=np.int64)
        return Dataset(
            np.empty((0, len(self.columns))), self.columns, (), none, none, none, self.about
        )

    def ranges(self) -> list[range]:
        """Give the numbers of the episodes of each file."""
        return [
            range(first, min(first + self.shard, self.n)) for first in range(0, self.n, self.shard)
        ]


@final
class Folder:
    """A folder that holds a dataset, or is about to.

    Args:
        path: Of the folder, or a URL.
        head: Of the dataset.
        trusted: Packages whose functions may be mechanisms of its plans.
    """

    def __init__(self, path: Location | str, head: Head, trusted: Sequence[str] = ()) -> None:
        self.path, self.head, self._trusted = located(path), head, tuple(trusted)
        self._plan = head.plan

    def shard(self, index: int) -> Location:
        """Name a file."""
        return self.path / f"shard-{index:05d}.parquet"

    def pictures(self, index: int) -> Location | None:
        """Name the file with the pictures that belong to a file; None where there are none."""
        taken = self.head.about.get("pictures")
        if taken is None or self.head.content is not None:  # a saved table has none
            return None
        return self.path / f"pictures-{index:05d}.{ENDINGS[taken['format']]}"

    def read(self, index: int, numbers: range) -> SourceRows | None:
        """Read a file; None where it is not there, or ends before it should.

        Raises:
            UnreadableFile: It is damaged, or belongs to something else.
        """
        path = self.shard(index)
        head = self.head
        pictures = self.pictures(index)
        if pictures is not None and not pictures.exists():
            return None
        try:
            data = read_bytes(path, LARGEST_TABLE)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise UnreadableFile(str(path), said(error), "make it readable") from None
        try:
            there, part = decoded(data, self._plan, head.empty, self._trusted)
        except DAMAGED as error:
            if isinstance(error, ModelError) and "trusted" in str(error):
                raise
            advice = f"delete it, and {self.again}: only it is made anew"
            raise UnreadableFile(str(path), str(error), advice) from None
        reason = f"it holds the episodes from {there.start} to {there.stop - 1}"
        if there.start != numbers.start or there.stop > numbers.start + head.shard:
            raise UnreadableFile(str(path), reason, "put it back under its own name")
        if there.stop > numbers.stop:
            reason += f", and {SIDECAR} says that there are {head.n} in all"
            raise UnreadableFile(str(path), reason, f"put the {SIDECAR} back that belongs to it")
        return part if there.stop >= numbers.stop else None

    @property
    def again(self) -> str:
        """Say how a file that is missing can be made."""
        if self.head.content is None:
            return "collect again with the same settings"
        return "save the same dataset again"

    def write(self, index: int, numbers: range, part: SourceRows) -> None:
        """Write a file; it is there as a whole, or not at all.

        Raises:
            UnwritableFolder: There is no room, or no permission.
        """
        pictures = self.pictures(index)
        if pictures is not None:  # first, so that a file of the table never lacks them
            write_durably(pictures, part.pictures)
        write_durably(self.shard(index), encoded(part, self._plan, numbers))

    # --- the sidecar --------------------------------------------------------------------------

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Hold the folder for writing: new, or one in which this dataset was begun.

        Raises:
            UnreadableFile: Something else is in it, or another process is writing to it.
            UnknownOption: It has more episodes already.
            UnwritableFolder: There is no permission.
        """
        check_names(self.head.columns)
        with locked(self.path):
            for stale in self.path.glob(f".*{PARTIAL}"):  # of a process that was killed
                if any(is_draft(stale.name, of) for of in ("shard-", "pictures-", SIDECAR)):
                    removed(stale)
            if (self.path / SIDECAR).exists():
                self._check_same(read_sidecar(self.path))
            elif any(not path.name.startswith(".") for path in self.path.glob("*")):
                reason = f"it holds other files, and no {SIDECAR}"
                raise UnreadableFile(str(self.path), reason, "give a new or an empty folder")
            else:
                self.note({})
            yield

    def _check_same(self, there: Mapping[str, Any]) -> None:
        mine = self.head.terms
        other = [f"{key}" for key in mine if key != "about" and there.get(key) != mine[key]]
        other += changes(there.get("about", {}), mine["about"])
        if other:
            reason = f"it holds another dataset: {', '.join(other)} differ"
            advice = "give another folder, or bring back the system and the settings of this one"
            raise UnreadableFile(str(self.path), reason, advice)
        if there["n"] > self.head.n:
            raise FewerEpisodes(self.head.n, there["n"], str(self.path))
        if there["n"] < self.head.n:
            self.note({})

    def note(self, refused: Mapping[str, str], *, complete: bool = False) -> None:
        """Write the sidecar.

        Args:
            refused: Why episodes could not be, by their number.
            complete: Whether all files are there.
        """
        edges = self.head.edges
        graph = edges and [[*e.key, e.when] if e.when else list(e.key) for e in edges]
        lines: dict[str, Any] = {
            "format": FORMAT,
            "n": self.head.n,
            "complete": complete,
            "refused": dict(refused),
            "plan": self._plan,
            **self.head.terms,
            "graph": graph,
        }
        lines["checksum"] = _checksum(lines)
        rows = ",\n".join(f' "{key}": {json.dumps(value)}' for key, value in lines.items())
        data = f"{{\n{rows}\n}}\n".encode()
        path = self.path / SIDECAR
        if not path.exists() or path.read_bytes() != data:
            write_durably(path, data)


def _checksum(lines: Mapping[str, Any]) -> str:
    """Return the digest of the rest of a sidecar."""
    rest = {key: value for key, value in lines.items() if key != "checksum"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def read_sidecar(folder: Location) -> dict[str, Any]:
    """Read what a folder says of itself.

    Raises:
        UnreadableFile: There is no sidecar, or it is damaged.
    """
    path, advice = folder / SIDECAR, "give a folder that collect or save wrote"
    try:
        found = json.loads(read_text(path))
        head = head_of(found)
        is_right = (
            found["format"] == FORMAT
            and found["plan"] == head.plan
            and found["checksum"] == _checksum(found)
        )
    except DAMAGED as error:
        raise UnreadableFile(str(path), f"it describes no dataset ({error})", advice) from None
    if not is_right:
        raise UnreadableFile(str(path), "it was changed, or has another format", advice)
    checked: dict[str, Any] = found
    return checked


def head_of(found: Mapping[str, Any]) -> Head:
    """Turn what a sidecar says into what it said it from."""
    columns = tuple(Column(**column) for column in found["columns"])
    n = whole_number("n", found["n"], least=0)
    shard = whole_number("shard", found["shard"], least=1)
    graph = found["graph"]
    edges = None if graph is None else tuple(Edge(*key) for key in graph)
    return Head(found["about"], columns, n, shard, edges, found["content"])


# --- whole datasets -------------------------------------------------------------------------------


@typed
def load(folder: Location | str, *, trusted: Sequence[str] = (), partial: bool = False) -> Dataset:
    """Read a dataset.

    Args:
        folder: That ``collect`` or ``save`` wrote; it may be a URL.
        trusted: Packages other than this one whose functions may be mechanisms of its plans.
        partial: Whether files may be missing, since a collection was interrupted.

    Raises:
        UnreadableFile: A file is missing, damaged, or belongs to another dataset; it says which,
            and what to do.
        ModelError: A plan names a function outside of the trusted packages.
        MissingExtra: A library that reads it is not installed.
    """
    place = located(folder)
    head = head_of(read_sidecar(place))
    files = Folder(place, head, trusted)
    parts, ranges = [], head.ranges()
    known = {files.shard(index) for index in range(len(ranges))}
    for unknown in sorted(set(place.glob("shard-*.parquet")) - known, key=str):
        reason = f"the dataset has {len(ranges)} files, and it is none of them"
        raise UnreadableFile(str(unknown), reason, "remove it from the folder")
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
    tables = [part.table for part in parts] or [head.empty]
    refused = refusals(parts)
    about = {**head.about, "refused": refused} if refused else dict(head.about)
    if "contacts" in about and "touching" not in about:  # a saved table has it
        episodes = {number: each for part in parts for number, each in part.touching.items()}
        about["touching"] = {"whole": about["contacts"] == "episodes", "episodes": episodes}
    return replace(Dataset.joined(tables), about=about)


def refusals(parts: Sequence[SourceRows]) -> dict[str, str]:
    """Say why episodes could not be, by their number."""
    return {str(number): why for part in parts for number, why in part.refused}


@typed
def save(
    dataset: Dataset,
    folder: Location | str,
    *,
    shard: int = SHARD,
) -> Location:
    """Write a dataset to a new folder, without loss.

    Args:
        dataset: Its ``about`` has to be plain data: what JSON can hold.
        folder: New or empty, or one in which saving the same dataset was interrupted; it may be a
            URL.
        shard: How many episodes are in a file.

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
    head = Head(about, table.columns, len(starts), size, content=checksum(raw_of(table)))
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
