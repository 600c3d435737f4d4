"""A folder of the finished cells of a long job, so that the same call makes the rest."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing
from hashlib import blake2b
from pathlib import Path
from typing import Any, Self, TypeVar, cast, final

from scm_world._fingerprint import changes
from scm_world.errors import UnreadableFile, reading
from scm_world.runs.files import (
    DRAFT,
    Location,
    is_there,
    located,
    locked,
    read_bytes,
    read_text,
    remove,
    write_whole,
)
from scm_world.runs.pool import Pool

Job = TypeVar("Job")
Result = TypeVar("Result")

HEAD = "study.json"
FORMAT = 2
MARK = b"scm-world sum "
_LENGTH = len(MARK) + 32  # of the mark and the digits of a sum
_BEFORE, _AFTER = b'{"sum": "', b'", "content": '  # around a sum in JSON
_TENSORS = 8 + len(b'{"__metadata__":{')  # where the metadata of a policy begin
_ENTRY, _NEXT = b'"sum": "', b'",'  # around a sum in them: 56 bytes, so that the data stay aligned


@final
class Study:
    """A folder with one file for each cell of a long job, used in a ``with`` block.

    ``study.json`` holds the settings. A cell is done if its file exists: files appear whole, by a
    rename. One process at a time writes to a folder. Each file carries a sum of its content, its
    name and the settings, so that an edited or misplaced file is refused.

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
                    remove(draft)
            if is_there(self.folder / HEAD):
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
            if self.folder is None or not is_there(self.folder / name):
                missing.append(name)
                continue
            result = self.kept(name, read, cells[name])
            done += 1
            tell(done, len(cells))
            yield name, result
        with closing((pool or Pool()).run(make, [cells[name] for name in missing])) as running:
            for place, result in running:
                name = missing[place]
                if self.folder is not None:
                    self.keep(name, write(result), cells[name])
                done += 1
                tell(done, len(cells))
                yield name, result

    def keep(self, name: str, content: bytes, job: object = None) -> None:
        """Write a file of the folder with its sum, which covers a ``range`` of episodes, too."""
        write_whole(self.path(name), sealed(name, content, self._settings, job))

    def kept(self, name: str, read: Callable[[bytes], Result], job: object = None) -> Result:
        """Read a file that ``keep`` wrote; ``UnreadableFile`` names one that was changed."""
        path = self.path(name)
        with reading(path, "delete this file, and it is made again"):
            return read(unsealed(name, read_bytes(path), self._settings, job))

    def path(self, name: str) -> Location:
        """Return the path of a file of the folder, which the study must have."""
        return cast("Location", self.folder) / name


def sealed(name: str, content: bytes, settings: Mapping[str, Any], job: object = None) -> bytes:
    """Return the content of a file with its sum, where readers of its format do not mind it.

    In Parquet it lies before the footer, in an archive it is the comment, in a policy it
    is among the metadata, and JSON stands in an object beside it.
    """
    mark = _sum(name, content, settings, job)
    if name.endswith(".parquet"):
        at = _footer(content)
        return content[:at] + mark + content[at:]
    if name.endswith((".npz", ".zip")):
        return content[:-2] + len(mark).to_bytes(2, "little") + mark
    if name.endswith(".safetensors"):
        entry = _ENTRY + mark + _NEXT
        return _longer(content, len(entry)) + content[8:_TENSORS] + entry + content[_TENSORS:]
    return _BEFORE + mark + _AFTER + content + b"}\n"


def unsealed(name: str, data: bytes, settings: Mapping[str, Any], job: object = None) -> bytes:
    """Return the content that was given to ``sealed``; ``ValueError`` if it is another one."""
    if name.endswith(".parquet"):
        at = _footer(data)
        found, content = data[at - _LENGTH : at], data[: at - _LENGTH] + data[at:]
    elif name.endswith((".npz", ".zip")):
        found, content = data[-_LENGTH:], data[: -_LENGTH - 2] + b"\0\0"
    elif name.endswith(".safetensors"):
        at = _TENSORS + len(_ENTRY)
        found, after = data[at : at + _LENGTH], data[at + _LENGTH + len(_NEXT) :]
        content = _longer(data, _TENSORS - at - _LENGTH - len(_NEXT)) + data[8:_TENSORS] + after
    else:
        at = len(_BEFORE) + _LENGTH
        found, content = data[len(_BEFORE) : at], data[at + len(_AFTER) : -2]
    if not found.startswith(MARK):
        raise ValueError("it is cut, or has no sum of its content")
    if found != _sum(name, content, settings, job):
        raise ValueError("its sum is of other content: it was edited, or belongs elsewhere")
    return content


def _sum(name: str, content: bytes, settings: Mapping[str, Any], job: object) -> bytes:
    holds = [name, str(job) if isinstance(job, range) else "", settings]
    found = blake2b(json.dumps(holds, sort_keys=True).encode(), digest_size=16)
    found.update(content)
    return MARK + found.hexdigest().encode()


def _longer(data: bytes, more: int) -> bytes:
    """Return the first 8 bytes of a policy, the size of its header, for a longer one."""
    return max(int.from_bytes(data[:8], "little") + more, 0).to_bytes(8, "little")


def _footer(data: bytes) -> int:
    """Return where the footer of a Parquet file begins: 8 bytes at its end say how long it is."""
    return len(data) - 8 - int.from_bytes(data[-8:-4], "little")


def settings_in(folder: Location | str, kind: str) -> dict[str, Any]:
    """Read the settings of a study of this kind."""
    path = located(folder) / HEAD
    with reading(path, f"give the folder of a study of {kind!r}, format {FORMAT}"):
        data = json.loads(read_text(path))
        if (data["kind"], data["format"]) != (kind, FORMAT):
            raise ValueError(f"it is a study of {data['kind']!r}, format {data['format']}")
        return dict(data["settings"])
