"""``scm-world sweep``: how outcomes depend on interventions, over a grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np
import typer

from scm_world.cli.assignments import parse_assignments, parse_value
from scm_world.cli.collection import check_files, kept, read_measure
from scm_world.cli.console import check_writable, console, show, table, written
from scm_world.cli.questions import Circumstances, shown_episodes
from scm_world.cli.tasks import tag
from scm_world.cli.working import Work
from scm_world.discovery.data import Levels, Swept, sweep
from scm_world.discovery.data.levels import check_points, points_of
from scm_world.discovery.data.swept import ENDS, SUMMARY, TABLE
from scm_world.output.locations import Location
from scm_world.variables.kinds import SPACES

if TYPE_CHECKING:
    from scm_world.queries import World

INTERRUPTED = 130
HINT = "'--over'"
SHOWN = 40  # points that are printed


@final
@dataclass(frozen=True)
class Options:
    """What is swept, as it was typed.

    Attributes:
        where: The world, who acts, and the seed.
        over: What takes which values, each as ``name=values``.
        outcomes: What is measured, each as ``name``, ``name[2]`` or ``how:name``.
        n: Episodes at each point.
        do: What is done at every point besides, each as ``name=value``.
        nature: What varies by itself, likewise.
        shard: Episodes in a file.
        files: ``"parquet"`` or ``"csv"``.
        work: Where the episodes happen.
    """

    where: Circumstances
    over: tuple[str, ...]
    outcomes: tuple[str, ...]
    n: int
    do: tuple[str, ...]
    nature: tuple[str, ...]
    shard: int
    files: str
    work: Work


def run(options: Options, *, out: Location | None) -> int:
    """Sweep, print the table; return the exit code."""
    check_files(options.files)
    over, where = read_over(options.over), options.where
    folder = out or where.folder("sweep-" + "-".join(over).replace(".", "_"))
    check_writable(folder, folder=True)
    plain = where.world()
    world = plain.given(parse_assignments(options.do, "'--do'")) if options.do else plain
    terminal = console()
    try:
        found = _swept(world, over, options, folder)
    except KeyboardInterrupt:
        points = len(points_of(over, world.model))
        terminal.print(kept(folder, options.n * points, options.shard), soft_wrap=True)
        return INTERRUPTED
    finally:
        world.close()
        plain.close()
    about = f"{tag(where.task)} on {found.data.about['engine']}, seed {where.seed}"
    terminal.print(_table(found, about))
    written(terminal, folder / TABLE, folder / SUMMARY)
    return 0


def _swept(world: World, over: dict[str, Any], options: Options, folder: Location) -> Swept:
    where = options.where
    with options.work.begun() as executor, shown_episodes() as progress:
        return sweep(
            world,
            over,
            [read_measure(text) for text in options.outcomes] or None,
            n=options.n,
            steps=where.steps,
            policy=where.acts,
            nature=parse_assignments(options.nature, "'--nature'"),
            seed=where.seed,
            out=folder,
            shard=options.shard,
            format=options.files,
            engine=executor,
            progress=progress,
        )


def read_over(texts: Sequence[str]) -> dict[str, Any]:
    """Read which values variables take.

    Raises:
        BadParameter: It cannot be read, or a variable is given twice.

    Example:
        >>> read_over(["tool_block.mass=0.02:0.08:3", "floor_friction=A:4", "gravity=-9,-10"])
        {'tool_block.mass': [0.02, 0.05, 0.08], ... 'gravity': [-9, -10]}
    """
    found: dict[str, Any] = {}
    for text in texts:
        name, equals, values = (part.strip() for part in text.partition("="))
        if not equals or not name or not values or name in found:
            said = f"{text!r}: expected name=values, each name once"
            raise typer.BadParameter(said, param_hint=HINT)
        found[name] = _values(values)
    return found


def _values(text: str) -> Any:
    first, *rest = text.split(":")
    if first in SPACES and len(rest) < 2:
        return Levels(first, _count(*rest)) if rest else Levels(first)
    if len(rest) == 2:
        low, high = (parse_value(word, HINT) for word in (first, rest[0]))
        if isinstance(low, int | float) and isinstance(high, int | float):
            return [round(x, 12) for x in np.linspace(low, high, _count(rest[1])).tolist()]
    value = None if rest else parse_value(text, HINT)
    several = value if isinstance(value, list) else [value]
    if not all(isinstance(one, int | float) for one in several):
        said = f"{text!r}: expected LOW:HIGH:COUNT, A, B:COUNT, or numbers with commas"
        raise typer.BadParameter(said, param_hint=HINT)
    return several


def _count(text: str) -> int:
    if not text.isdecimal() or not int(text):
        raise typer.BadParameter(f"{text!r} is no number of values", param_hint=HINT)
    check_points(int(text))
    return int(text)


def _table(found: Swept, about: str) -> Any:
    """Write down the means, with their intervals."""
    rows = found.rows()
    names = [c.name for c in found.measured]
    results = {name + end for base in names for name in (base, f"{base}.change") for end in ENDS}
    set_ = [key for key in rows[0] if key not in results and key not in ("n", "refused")]
    made = table(*set_, "n", *names, title=f"Sweep of {about}, with 95 % intervals")
    for row in rows[:SHOWN]:
        cells = (_interval([row[name + end] for end in ENDS]) for name in names)
        made.add_row(*(show(row[key]) for key in set_), str(row["n"]), *cells)
    if len(rows) > SHOWN:
        made.caption = f"and {len(rows) - SHOWN} more points, see {TABLE}"
    return made


def _interval(numbers: Sequence[float | None]) -> str:
    mean, low, high = ("-" if number is None else show(number) for number in numbers)
    return f"{mean} ({low} … {high})"
