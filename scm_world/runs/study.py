"""A folder of the finished cells of a long job, so that the same call makes the rest."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, Self, TypeVar, final

from scm_world._fingerprint import changes
from scm_world.errors import DAMAGED, UnreadableFile, in_one_line
from scm_world.runs.files import (
    DRAFT,
    Location,
    located,
    locked,
    read_bytes,
    read_text,
    removed,
    write_whole,
)
from scm_world.runs.pool import Pool

Job = TypeVar("Job")
Result = TypeVar("Result")

HEAD = "study.json"
FORMAT = 1


@final
class Study:
    """A folder with one file for each cell of a long job, used in a ``with`` block.

    ``study.json`` holds the settings. A cell is done if its file exists: files appear whole, by a
    rename. One process at a time writes to a folder.

    Args:
        folder: A path, or a URL: new, empty, or one of the same study. None keeps nothing.
        kind: Kind of the study, such as ``"evaluation"``.
        settings: Plain data: everything that decides the results and is the same for all cells.

    Example:
        >>> with Study("memory://squares", "squares", {"power": 2}) as study:
        ...     dict(study.map({"two.txt": -2}, abs, read=int, write=lambda x: str(x).encode()))
        {'two.txt': 2}
    """

    def __init__(
        self, folder: Location | str | None, kind: str, settings: Mapping[str, Any]
    ) -> None:
        self.folder = None if folder is None else located(folder)
        self.kind, self._settings = kind, json.loads(json.dumps(settings))
        self._held = ExitStack()

    def __enter__(self) -> Self:
        """Lock the folder; write the settings, or compare them with those that are there."""
        if self.folder is None:
            return self
        with ExitStack() as stack:
            stack.enter_context(locked(self.folder))
            if isinstance(self.folder, Path):
                for draft in self.folder.rglob(f".*{DRAFT}"):  # of a process that was killed
                    removed(draft)
            if (self.folder / HEAD).exists():
                if differ := changes(settings_in(self.folder, self.kind), self._settings):
                    reason = f"it is of another {self.kind}; these differ: {', '.join(differ)}"
                    advice = "give the same system, arguments and versions, or another folder"
                    raise UnreadableFile(str(self.folder), reason, advice)
            elif others := sorted(path.name for path in self.folder.iterdir())[:5]:
                reason = f"it holds something else: {', '.join(others)}"
                raise UnreadableFile(str(self.folder), reason, "give an empty folder, or a new one")
            else:
                data = {"kind": self.kind, "format": FORMAT, "settings": self._settings}
                write_whole(self.folder / HEAD, json.dumps(data, indent=1, allow_nan=False) + "\n")
            self._held = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()

    def map(
        self,
        cells: Mapping[str, Job],
        make: Callable[[Job], Result],
        *,
        read: Callable[[bytes], Result],
        write: Callable[[Result], bytes],
        pool: Pool | None = None,
        progress: Callable[[int, int], object] | None = None,
    ) -> Iterator[tuple[str, Result]]:
        """Return the names and results of all cells: first of those that are done.

        The others are in the order in which they are ready; see ``Pool.run``. When a result is
        handed out, its file is there.

        Args:
            cells: The job of each cell, by the name of its file.
            make: Makes the result of a cell from its job.
            read: Reads a result from the content of its file.
            write: Returns the content of the file of a result.
            pool: What does the work; this process if None.
            progress: Called with how many cells are done, and how many there are.
        """
        missing, done = [], 0
        tell = progress or (lambda *_: None)
        for name in cells:
            path = None if self.folder is None else self.folder / name
            if path is None or not path.exists():
                missing.append(name)
                continue
            try:
                result = read(read_bytes(path))
            except DAMAGED as error:
                advice = "delete this file, and it is made again"
                raise UnreadableFile(str(path), in_one_line(error), advice) from error
            done += 1
            tell(done, len(cells))
            yield name, result
        with closing((pool or Pool()).run(make, [cells[name] for name in missing])) as running:
            for place, result in running:
                name = missing[place]
                if self.folder is not None:
                    write_whole(self.folder / name, write(result))
                done += 1
                tell(done, len(cells))
                yield name, result


def settings_in(folder: Location | str, kind: str) -> dict[str, Any]:
    """Read the settings of a study of this kind."""
    path = located(folder) / HEAD
    try:
        data = json.loads(read_text(path))
        if (data["kind"], data["format"]) != (kind, FORMAT):
            raise ValueError(f"it is a study of {data['kind']!r}, format {data['format']}")
        settings: dict[str, Any] = dict(data["settings"])
    except DAMAGED as error:
        advice = f"give the folder of a study of {kind!r}, format {FORMAT}"
        raise UnreadableFile(str(path), in_one_line(error), advice) from None
    return settings
