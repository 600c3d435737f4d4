"""Where the words go, and how numbers and files are written."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any
from uuid import uuid4

import numpy as np
import typer

from scm_world.output.durable import made, removed, write_durably
from scm_world.output.locations import Location
from scm_world.output.remote import Remote

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

WIDTH, PAGE = 160, 200  # [characters] where there is no terminal to ask; for the widest tables
RESULTS = Path("scm-world-results")


def console(*, stderr: bool = False, file: IO[str] | None = None, width: int = WIDTH) -> Console:
    """Open the terminal; plain text of a fixed width where there is none."""
    from rich.console import Console

    terminal = Console(stderr=stderr, file=file, highlight=False)
    if terminal.is_terminal:
        return terminal
    return Console(stderr=stderr, file=file, highlight=False, width=width)


def table(*headers: str, title: str = "", caption: str = "") -> Table:
    """Begin a table whose cells wrap and are never cut off."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    begun = Table(
        title=Text(title) if title else None,
        caption=Text(caption) if caption else None,
        box=box.SIMPLE_HEAD,
        title_justify="left",
        caption_justify="left",
        title_style="bold",
        pad_edge=False,
    )
    for header in headers:
        begun.add_column(header, overflow="fold")
    return begun


def keep_whole(made: Table, terminal: Console, *columns: int) -> Table:
    """Do not break the words in some columns where there is room enough."""
    if terminal.width >= WIDTH:
        for column in columns:
            made.columns[column].no_wrap = True
    return made


def fail(message: str) -> None:
    """Write one error line."""
    from rich.text import Text

    line = Text.assemble(("error:", "bold red"), " ", message)
    console(stderr=True).print(line, soft_wrap=True)


def written(terminal: Console, *paths: Location) -> None:
    """Say which files were written."""
    from rich.text import Text

    for number, path in enumerate(paths):
        lead = "         " if number else "written: "
        terminal.print(Text(f"{lead}{path}"), soft_wrap=True)


def show(value: Any, *, per_line: int = 3) -> str:
    """Write a value down with four digits, long ones over several lines.

    Example:
        >>> show(0.0200001), show([1.0, -0.0, 2.5])
        ('0.02', '1 0 2.5')
    """
    numbers = [_show(float(x)) for x in np.ravel(value)]
    step = 2 if len(numbers) == 4 else per_line
    rows = [" ".join(numbers[i : i + step]) for i in range(0, len(numbers), step)]
    return "\n".join(rows)


def _show(number: float) -> str:
    return f"{number:.1e}" if 0.0 < abs(number) < 1e-4 else f"{number + 0.0:.4g}"


def plain(value: Any) -> Any:
    """Turn a value into data that JSON can hold; what is not finite becomes None."""
    match value:
        case np.ndarray() | np.generic():
            return plain(value.tolist())
        case dict():
            return {key: plain(part) for key, part in value.items()}
        case list() | tuple():
            return [plain(part) for part in value]
        case float() if not np.isfinite(value):
            return None
    return value


def check_writable(path: Location, *, folder: bool) -> None:
    """Refuse a place that cannot be written before time is spent on filling it.

    Raises:
        BadParameter: Something else lies there, or it is read-only.
        UnwritableFolder: A store does not answer, or does not allow it.
    """
    if isinstance(path, Remote):
        _try(path if folder else path.parent)
    if path.exists() and path.is_dir() != folder:
        kind = "a file" if folder else "a folder"
        raise typer.BadParameter(f"{str(path)!r} is {kind}", param_hint="'--out'")
    if isinstance(path, Remote):
        return
    there = path
    while not there.exists() and there != there.parent:
        there = there.parent
    if (there != path and not there.is_dir()) or not os.access(there, os.W_OK):
        raise typer.BadParameter(f"{str(there)!r} cannot be written to", param_hint="'--out'")


def _try(folder: Remote) -> None:
    """Write something to a store, and remove it: there is no other way to know."""
    trial = folder / f".trial-{uuid4().hex}"
    write_durably(trial, b"")
    removed(trial)


@contextmanager
def staged(folder: Location) -> Iterator[Path]:
    """Collect files elsewhere, and put them into a folder once all of them are complete."""
    with tempfile.TemporaryDirectory(prefix="scm-world-") as draft:
        yield Path(draft)
        made(folder)
        for file in sorted(Path(draft).iterdir()):
            write_durably(folder / file.name, file.read_bytes())
