"""What commands print, and the folders that they write into."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any
from uuid import uuid4

import numpy as np
import typer
from pydantic import BaseModel
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from scm_world.cli.arguments import suffix
from scm_world.runs.files import Location, made, removed, write_whole

WIDTH, PAGE = 160, 200  # [characters] where there is no terminal to ask; for the widest tables
LONG = 80  # [characters] longer lists are written once
RESULTS = Path("scm-world-results")
INTERRUPTED = 130  # exit code after Ctrl-C


def terminal(*, stderr: bool = False, file: IO[str] | None = None, width: int = WIDTH) -> Console:
    """Return the terminal, or plain text of a fixed width where there is none."""
    found = Console(stderr=stderr, file=file, highlight=False)
    if found.is_terminal:
        return found
    return Console(stderr=stderr, file=file, highlight=False, width=width)


def say(*lines: object, stderr: bool = False) -> None:
    """Print lines as they are: no markup, no wrapping."""
    for line in lines:
        terminal(stderr=stderr).print(Text(str(line)), soft_wrap=True)


def written(*paths: Location) -> None:
    """Print which files were written."""
    for number, path in enumerate(paths):
        say(f"{'         ' if number else 'written: '}{path}")


def table(
    headers: Sequence[str],
    rows: Iterable[Sequence[object]],
    *,
    title: str = "",
    caption: str = "",
    whole: tuple[int, ...] = (),
    width: int = WIDTH,
    file: IO[str] | None = None,
) -> None:
    """Print a table whose cells wrap and are never cut off.

    Args:
        headers: Of the columns; none is shown if all are empty.
        rows: Texts as they are, with styles if they are a ``Text``.
        title: Above the table.
        caption: Below it.
        whole: Columns whose words are not broken where the terminal is wide enough.
        width: In characters, where there is no terminal.
        file: Where to; standard output if None.
    """
    made = Table(
        title=Text(title) if title else None,
        caption=Text(caption) if caption else None,
        box=box.SIMPLE_HEAD,
        title_justify="left",
        caption_justify="left",
        title_style="bold",
        pad_edge=False,
        show_header=any(headers),
    )
    wide = terminal().width >= WIDTH
    for number, header in enumerate(headers):
        made.add_column(Text(header), overflow="fold", no_wrap=wide and number in whole)
    for row in rows:
        made.add_row(*(cell if isinstance(cell, Text) else Text(str(cell)) for cell in row))
    terminal(width=width, file=file).print(made)


def edge_table(
    names: Sequence[str],
    edges: Mapping[tuple[str, str, int], str],
    *,
    signs: Mapping[str, str] = MappingProxyType({}),
    file: IO[str] | None = None,
    **how: Any,
) -> None:
    """Print one row per variable with its causes, and the names of variables without causes.

    Args:
        names: The variables.
        edges: The style of each edge (cause, effect, lag).
        signs: What stands before causes of a style.
        file: Where to; standard output if None.
        how: See ``table``.
    """
    from scm_world.discovery.names import by_entity

    first: dict[str, str] = {}  # the variable at which a long list of causes is written
    rows, roots = list[tuple[object, ...]](), []
    for effect in names:
        cells = []
        for lag in (0, 1):
            styles = {cause: edges.get((cause, effect, lag)) for cause in names}
            parts = [
                Text(signs.get(style, "") + short, style)
                for style in dict.fromkeys(style for style in styles.values() if style is not None)
                for short in by_entity(cause for cause in names if styles[cause] == style)
            ]
            cell = Text(", ").join(parts)
            like = first.setdefault(cell.plain, effect)
            again = like != effect and len(cell) > LONG
            cells.append(Text(f"same as {like}", "italic") if again else cell)
        if any(cells):
            rows.append((Text(effect, "bold"), *cells))
        else:
            roots.append(effect)
    headers = ("variable", "causes at once", "causes one step earlier")
    table(headers, rows, whole=(0,), file=file, **how)
    if roots:
        terminal(file=file).print(Text(f"without causes: {', '.join(by_entity(roots))}"))


def facts(rows: Any) -> None:
    """Print a name and a value per line: green if it is good, red if it is bad."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="bold")
    grid.add_column(overflow="fold")
    for name, value, good in rows:
        grid.add_row(name, Text(value, style={True: "green", False: "bold red"}.get(good, "")))
    terminal().print(grid)


def show(value: Any, *, per_line: int = 3) -> str:
    """Return a value with four digits, long ones over several lines.

    Example:
        >>> show(0.0200001), show([1.0, -0.0, 2.5])
        ('0.02', '1 0 2.5')
    """
    numbers = [
        f"{x:.1e}" if 0.0 < abs(x) < 1e-4 else f"{x + 0.0:.4g}" for x in map(float, np.ravel(value))
    ]
    step = 2 if len(numbers) == 4 else per_line
    rows = [" ".join(numbers[i : i + step]) for i in range(0, len(numbers), step)]
    return "\n".join(rows)


def plain(value: Any) -> Any:
    """Return a value as data that JSON can hold; what is not finite becomes None."""
    match value:
        case BaseModel():
            return value.model_dump(mode="json")
        case np.ndarray() | np.generic():
            return plain(value.tolist())
        case dict():
            return {key: plain(part) for key, part in value.items()}
        case list() | tuple():
            return [plain(part) for part in value]
        case float() if not np.isfinite(value):
            return None
    return value


@contextmanager
def progress(what: str, *, lines: int = 0, about: str = "") -> Iterator[Callable[[int, int], None]]:
    """Show how much is done: a bar on a terminal, elsewhere some lines.

    Args:
        what: What is counted, such as ``"episodes"``.
        lines: How many lines there are where there is no terminal.
        about: Said before.
    """
    stderr = terminal(stderr=True)
    if not stderr.is_terminal:
        last = 0

        def tell(done: int, planned: int) -> None:
            nonlocal last
            if lines * done // planned != last:
                last = lines * done // planned
                say(f"{about}{done:,} of {planned:,} {what}", stderr=True)

        yield tell
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    columns = (f"{about}{what}", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=stderr, transient=True) as bar:
        row = bar.add_task("", total=None)
        yield lambda done, planned: bar.update(row, completed=done, total=planned)


@contextmanager
def resumable(folder: Location, pattern: str, what: str) -> Iterator[None]:
    """After Ctrl-C, say how many files of a pattern are safe in a folder; exit with code 130."""
    try:
        yield
    except KeyboardInterrupt:
        safe = len(list(folder.glob(pattern)))
        say(f"interrupted: {safe} {what} are safe in {folder}; the same command resumes")
        raise typer.Exit(INTERRUPTED) from None


def check_writable(path: Location, *, folder: bool) -> None:
    """Refuse a place that cannot be written before time is spent on filling it.

    Raises:
        BadParameter: Something else lies there, or it is read-only.
        UnwritableFolder: A store does not answer, or does not allow it.
    """
    if not isinstance(path, Path):  # writing something is the only way to know
        trial = (path if folder else path.parent) / f".trial-{uuid4().hex}"
        write_whole(trial, b"")
        removed(trial)
    if path.exists() and path.is_dir() != folder:
        kind = "a file" if folder else "a folder"
        raise typer.BadParameter(f"{str(path)!r} is {kind}", param_hint="'--out'")
    if not isinstance(path, Path):
        return
    there = path
    while not there.exists() and there != there.parent:
        there = there.parent
    if (there != path and not there.is_dir()) or not os.access(there, os.W_OK):
        raise typer.BadParameter(f"{str(there)!r} cannot be written to", param_hint="'--out'")


def results_folder(out: Location | None, *words: object, option: Any = ()) -> Location:
    """Return the folder for the results of a command, which can be written to.

    Args:
        out: What was asked for.
        words: Name the folder if nothing was asked for.
        option: Arguments of the task; they end that name.
    """
    folder = out or RESULTS / ("-".join(str(word) for word in words if word) + suffix(option or ()))
    check_writable(folder, folder=True)
    return folder


def write_json(path: Path, value: Any) -> None:
    """Write plain data to a file; numbers that are not finite become null."""
    path.write_text(json.dumps(plain(value), indent=1, allow_nan=False) + "\n")


@contextmanager
def staged(folder: Location) -> Iterator[Path]:
    """Collect files elsewhere; put them into a folder, and name them, once all are complete."""
    with tempfile.TemporaryDirectory(prefix="scm-world-") as draft:
        yield Path(draft)
        made(folder)
        files = sorted(Path(draft).iterdir())
        for file in files:
            write_whole(folder / file.name, file.read_bytes())
        written(*(folder / file.name for file in files))
