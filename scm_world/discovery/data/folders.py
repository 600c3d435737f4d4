"""A folder that holds a dataset: a sidecar, and files that are complete or absent."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any, final

from scm_world._arguments import whole_number
from scm_world.discovery.data.dataset import Column
from scm_world.discovery.data.shards import ShardPlace, check_kind, check_names, decoded, encoded
from scm_world.discovery.data.sources import FORMAT, SourceRows
from scm_world.errors import DAMAGED, ModelError, UnknownOption, UnreadableFile
from scm_world.graph.structure import Edge
from scm_world.output.durable import is_draft, locked, removed, write_durably
from scm_world.output.locations import Location, located
from scm_world.output.reading import LARGEST_TABLE, read_bytes, read_text
from scm_world.output.remote import PARTIAL, said

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
        kind: Of the files: ``"parquet"`` or ``"csv"``.
        edges: The declared graph, if it may be known.
        content: Sums up the rows of a dataset that was saved; None of one that is collected, of
            which ``about`` decides the rows.
    """

    about: dict[str, Any]
    columns: tuple[Column, ...]
    n: int
    shard: int = SHARD
    kind: str = "parquet"
    edges: tuple[Edge, ...] | None = None
    content: str | None = None

    @property
    def terms(self) -> dict[str, Any]:
        """List what has to be the same for rows to belong together; how many is not among it."""
        found = {
            "about": self.about,
            "columns": [asdict(column) for column in self.columns],
            "shard": self.shard,
            "files": self.kind,
            "content": self.content,
        }
        plain: dict[str, Any] = json.loads(json.dumps(found))
        return plain

    @property
    def plan(self) -> str:
        """Sum up the terms."""
        return hashlib.sha256(json.dumps(self.terms, sort_keys=True).encode()).hexdigest()

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
        return self.path / f"shard-{index:05d}.{self.head.kind}"

    def read(self, index: int, numbers: range) -> SourceRows | None:
        """Read a file; None where it is not there, or ends before it should.

        Raises:
            UnreadableFile: It is damaged, or belongs to something else.
        """
        path = self.shard(index)
        head = self.head
        try:
            data = read_bytes(path, LARGEST_TABLE)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise UnreadableFile(str(path), said(error), "make it readable") from None
        try:
            place, part = decoded(
                data, head.kind, self._plan, head.columns, head.about, self._trusted
            )
        except DAMAGED as error:
            if isinstance(error, ModelError) and "trusted" in str(error):
                raise
            advice = f"delete it, and {self.again}: only it is made anew"
            raise UnreadableFile(str(path), str(error), advice) from None
        self._check_place(path, place, numbers)
        return part if place.stop >= numbers.stop else None

    def _check_place(self, path: Location, place: ShardPlace, numbers: range) -> None:
        reason = f"it holds the episodes from {place.first} to {place.stop - 1}"
        if place.first != numbers.start or place.stop > numbers.start + self.head.shard:
            raise UnreadableFile(str(path), reason, "put it back under its own name")
        if place.stop > numbers.stop:
            reason += f", and {SIDECAR} says that there are {self.head.n} in all"
            raise UnreadableFile(str(path), reason, f"put the {SIDECAR} back that belongs to it")

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
        place = ShardPlace(self._plan, numbers.start, numbers.stop)
        write_durably(self.shard(index), encoded(part, place, self.head.kind))

    # --- the sidecar --------------------------------------------------------------------------

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Hold the folder for writing: new, or one in which this dataset was begun.

        Raises:
            UnreadableFile: Something else is in it, or another process is writing to it.
            UnknownOption: It has more episodes already.
            UnwritableFolder: There is no permission.
        """
        check_kind(self.head.kind)
        check_names(self.head.columns)
        with locked(self.path):
            self._begin()
            yield

    def _begin(self) -> None:
        sidecar = self.path / SIDECAR
        for stale in self.path.glob(f".*{PARTIAL}"):  # of a process that was killed
            if is_draft(stale.name, "shard-") or is_draft(stale.name, SIDECAR):
                removed(stale)
        if sidecar.exists():
            self._check_same(read_sidecar(self.path))
        elif any(not path.name.startswith(".") for path in self.path.iterdir()):
            reason = f"it holds other files, and no {SIDECAR}"
            raise UnreadableFile(str(self.path), reason, "give a new or an empty folder")
        else:
            self.note({})

    def _check_same(self, there: Mapping[str, Any]) -> None:
        mine = self.head.terms
        other = [f"{key}" for key in mine if key != "about" and there.get(key) != mine[key]]
        abouts = there.get("about", {}), mine["about"]
        keys = dict.fromkeys((*abouts[0], *abouts[1]))
        other += [key for key in keys if abouts[0].get(key) != abouts[1].get(key)]
        if other:
            reason = f"it holds another dataset: {', '.join(other)} differ"
            raise UnreadableFile(str(self.path), reason, "give another folder")
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
        graph = None if self.head.edges is None else [list(e.key) for e in self.head.edges]
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
    """Sum up all that a sidecar says besides."""
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
    n, shard = (
        whole_number("n", found["n"], least=0),
        whole_number("shard", found["shard"], least=1),
    )
    graph = found["graph"]
    edges = None if graph is None else tuple(Edge(*key) for key in graph)
    return Head(found["about"], columns, n, shard, found["files"], edges, found["content"])
