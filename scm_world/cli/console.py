"""The output of commands, and the files that they write."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Union

import numpy as np
import typer
from pydantic_core import to_json
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from scm_world.runs.files import Location, located, write_whole

if TYPE_CHECKING:
    import pandas as pd

Columns = Union["pd.DataFrame", Iterable[Mapping[str, object]], Mapping[str, Sequence[object]]]
Edges = Mapping[tuple[str, str, int], str]

WIDTH = 200  # [characters] without a terminal to ask
NARROW = 120  # [characters] names are broken on terminals that are not as wide
LONG = 80  # [characters] longer lists are written once
INTERRUPTED = 130  # exit code after Ctrl-C


# --- printing -------------------------------------------------------------------------------------


def terminal(*, stderr: bool = False, file: IO[str] | None = None) -> Console:
    """Return the terminal, or, without one, plain text of a fixed width."""
    found = Console(stderr=stderr, file=file, highlight=False)
    if not found.is_terminal:
        found.width = WIDTH
    return found


def say(*lines: object, stderr: bool = False) -> None:
    """Print lines without markup or wrapping, in the styles that the terminal has."""
    for line in lines:
        typer.echo(line, err=stderr)


def written(*paths: Location) -> None:
    """Print which files were written."""
    for number, path in enumerate(paths):
        say(f"{'         ' if number else 'written: '}{path}")


def frame(
    found: Columns, *, title: str = "", caption: str = "", file: IO[str] | None = None
) -> None:
    """Print the columns of a data frame, or of rows by column; cells wrap and are never cut off."""
    import pandas

    console, data = terminal(file=file), pandas.DataFrame(found)  # type: ignore[arg-type] # rows
    table = Table(
        title=Text(title) if title else None,
        caption=Text(caption) if caption else None,
        box=box.SIMPLE_HEAD,
        title_justify="left",
        caption_justify="left",
        title_style="bold",
        pad_edge=False,
    )
    for number, name in enumerate(data.columns):
        whole = number == 0 and console.width >= NARROW
        table.add_column(Text(name), overflow="fold", no_wrap=whole)
    for row in data.itertuples(index=False, name=None):
        table.add_row(*(Text(show(cell)) for cell in row))
    console.print(table)


def show(value: object) -> str:
    """Return a cell of a table: numbers with four digits, long vectors over several lines.

    Example:
        >>> show(0.0200001), show([1.0, -0.0, 2.5]), show(12345), show(None)
        ('0.02', '1 0 2.5', '12345', '')
    """
    if value is None:
        return ""
    if not isinstance(value, float | list | tuple | np.ndarray):
        return str(value)
    numbers = [
        f"{x:.1e}" if 0.0 < abs(x) < 1e-4 else f"{x + 0.0:.4g}" for x in map(float, np.ravel(value))
    ]
    step = 2 if len(numbers) == 4 else 3
    return "\n".join(" ".join(numbers[i : i + step]) for i in range(0, len(numbers), step))


def edge_table(
    names: Sequence[str],
    edges: Edges,
    title: str,
    *,
    caption: str = "",
    file: IO[str] | None = None,
) -> None:
    """Print one row per variable with its causes, and the names of variables without causes.

    ``edges`` has the sign before the cause of each edge (cause, effect, lag); see ``frame``.
    """
    from scm_world.discovery.names import by_entity

    table: dict[str, list[str]] = {
        name: [] for name in ("variable", "contemporaneous causes", "causes one step earlier")
    }
    roots, first = [], dict[str, str]()
    for name in names:
        row = [name]
        for lag in (0, 1):
            signed = [edges[c, name, lag] + c for c in names if (c, name, lag) in edges]
            cell = ", ".join(by_entity(signed))
            like = first.setdefault(cell, name)
            row.append(f"same as {like}" if like != name and len(cell) > LONG else cell)
        if not any(row[1:]):
            roots.append(name)
            continue
        for cells, cell in zip(table.values(), row, strict=True):
            cells.append(cell)
    frame(table, title=title, caption=caption, file=file)
    if roots:
        said = Text(f"without causes: {', '.join(by_entity(roots))}")
        terminal(file=file).print(said)


@contextmanager
def progress(what: str) -> Iterator[Callable[[int, int], None]]:
    """Show a bar on a terminal: the finished share of episodes, or of other counts."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    err = terminal(stderr=True)
    columns = (what, BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as bar:
        row = bar.add_task("", total=None)
        yield lambda done, planned: bar.update(row, completed=done, total=planned)


# --- files ----------------------------------------------------------------------------------------


def results_folder(out: str | None, *words: object) -> Location:
    """Return the folder that was asked for, or is named by words; it can be written to."""
    clean = (re.sub(r"[^\w.=-]+", "_", str(word)).strip("_") for word in words if word)
    name = "-".join(word.replace("=_", "=") for word in clean)
    return writable(out or f"scm-world-results/{name}")


def writable(place: Location | str, *, is_folder: bool = True) -> Location:
    """Return a file or folder; refuse one that cannot be written, before time is spent on it."""
    path, hint = located(place), "'--out'"
    if path.exists() and path.is_dir() != is_folder:
        kind = "a file" if is_folder else "a folder"
        raise typer.BadParameter(f"{str(path)!r} is {kind}", param_hint=hint)
    if isinstance(path, Path):
        there = next(place for place in (path, *path.parents) if place.exists())
        if (there != path and not there.is_dir()) or not os.access(there, os.W_OK):
            raise typer.BadParameter(f"{str(there)!r} cannot be written to", param_hint=hint)
    return path


@contextmanager
def resumable(folder: Location, pattern: str, what: str) -> Iterator[None]:
    """After Ctrl-C, say how many files of a pattern are safe in a folder; exit with code 130."""
    try:
        yield
    except KeyboardInterrupt:
        safe = len(list(folder.glob(pattern)))
        say(f"interrupted: {safe} {what} are safe in {folder}; the same command resumes")
        raise typer.Exit(INTERRUPTED) from None


def as_json(value: object) -> bytes:
    """Return plain data and arrays as JSON; numbers that are not finite become null."""

    def plain(part: object) -> object:
        return dict(part) if isinstance(part, Mapping) else np.asarray(part).tolist()

    return to_json(value, indent=1, inf_nan_mode="null", fallback=plain) + b"\n"


def write(folder: Location, files: Mapping[str, Any], *others: Location) -> None:
    """Write texts and bytes, and other data as JSON; print their names, after those of others."""
    contents = {n: f if isinstance(f, str | bytes) else as_json(f) for n, f in files.items()}
    for name, content in contents.items():
        write_whole(folder / name, content)
    written(*others, *(folder / name for name in contents))
