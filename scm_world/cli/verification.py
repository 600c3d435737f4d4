"""``scm-world verify``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

from rich.text import Text

from scm_world.cli.console import RESULTS, check_writable, console, staged, table, written
from scm_world.cli.discovery import INTERRUPTED, shown_progress
from scm_world.cli.tasks import suffix, system, tag
from scm_world.discovery.plots import draw_verification
from scm_world.output.locations import Location
from scm_world.queries import SCM
from scm_world.queries.agreement import Agreement
from scm_world.queries.verification import Row, Verification
from scm_world.queries.verify import LEAST, verify, verify_engines
from scm_world.tasks import TASKS

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

ALL = "all"
BOTH = ("mujoco", "bullet")
SMALL: dict[str, tuple[str, ...]] = {
    "towers": ("number_of_blocks_in_tower=1,1,2", "tower_dims=0.035,0.035,0.07"),
    "stacked_blocks": ("num_of_levels=2", "max_level_width=0.04"),
    "creative_stacked_blocks": ("num_of_levels=2", "max_level_width=0.04"),
    "general": ("nums_objects=2",),
}
"""Two blocks, where there are more by default: what ``all`` verifies."""

Found = Verification | Agreement


@final
@dataclass(frozen=True)
class Options:
    """What to verify.

    Attributes:
        task: Name of the task, or ``"all"``.
        backend: Name of the engine.
        both: Whether to verify on MuJoCo and Bullet, and compare them.
        preset: Numerical settings.
        probes: How many probe states at most.
        seed: Of the experiments.
        arguments: Of the task, each as ``name=value``.
        resolution: Of the graph of the robot; that of the task if None.
    """

    task: str
    backend: str
    both: bool
    preset: str | None
    probes: int
    seed: int
    arguments: tuple[str, ...] = ()
    resolution: str | None = None

    @property
    def where(self) -> str:
        """The engine, in a word."""
        return "both" if self.both else self.backend


def run(options: Options, *, out: Location | None) -> int:
    """Verify, print, write; return the exit code."""
    about = f"{options.where}-seed{options.seed}{suffix(options.arguments)}"
    about += f"-{options.resolution}" if options.resolution else ""
    folder = out or RESULTS / f"verify-{tag(options.task)}-{about}"
    check_writable(folder, folder=True)
    every = options.task == ALL
    terminal, found = console(), list[Found]()
    for task in TASKS if every else (options.task,):
        arguments = options.arguments or (SMALL.get(task, ()) if every else ())
        try:
            report = _verified(task, arguments, options)
        except KeyboardInterrupt:
            if not found:
                raise
            return _ended(terminal, found, interrupted=True)
        found.append(report)
        _print(terminal, report)
        _write(terminal, report, folder / task if every else folder)
        if report.interrupted:
            return _ended(terminal, found, interrupted=True)
    return _ended(terminal, found, interrupted=False)


def _verified(task: str, arguments: tuple[str, ...], options: Options) -> Found:
    made, about = system(task, arguments), {"arguments": arguments}
    common: dict[str, Any] = {
        "probes": options.probes,
        "least": min(LEAST, options.probes),
        "seed": options.seed,
    }
    with _bars(options.probes) as bar:
        if isinstance(made, SCM):
            found = verify(made, progress=bar(f"{tag(task)}"), **common)
            return found.model_copy(update=about)
        if not options.both:
            found = verify(
                made,
                backend=options.backend,
                preset=options.preset,
                resolution=options.resolution,
                progress=bar(f"{tag(task)} on {options.backend}"),
                **common,
            )
            return found.model_copy(update=about)
        both = verify_engines(
            made,
            backends=BOTH,
            preset=options.preset,
            resolution=options.resolution,
            progress=lambda name: bar(f"{tag(task)}: {name}"),
            **common,
        )
    reports = tuple(one.model_copy(update=about) for one in both.verifications)
    return both.model_copy(update={"verifications": reports})


@contextmanager
def _bars(probes: int) -> Iterator[Callable[[str], Callable[[int, int], None]]]:
    """Show one bar after another."""
    from contextlib import ExitStack

    with ExitStack() as stack:

        def bar(name: str) -> Callable[[int, int], None]:
            stack.close()
            return stack.enter_context(shown_progress(probes, name))

        yield bar


def _reports(found: Found) -> tuple[Verification, ...]:
    return found.verifications if isinstance(found, Agreement) else (found,)


def _print(terminal: Console, found: Found) -> None:
    for report in _reports(found):
        terminal.print(Text(f"Verification of {report.task} on {report.backend}", style="bold"))
        terminal.print(_grid(report.rows()))
        terminal.print()
    if isinstance(found, Agreement):
        title = f"Agreement of {' and '.join(found.backends)} on {found.task}"
        terminal.print(Text(title, style="bold"))
        terminal.print(_grid(found.rows()))
        terminal.print()


def _grid(rows: Iterable[Row]) -> Table:
    """Write the numbers, one per line."""
    from rich.table import Table

    made = Table.grid(padding=(0, 2))
    made.add_column(style="bold")
    made.add_column(overflow="fold")
    for name, value, good in rows:
        made.add_row(name, Text(value, style="" if good is None else _style(good)))
    return made


def _style(good: bool) -> str:
    return "green" if good else "bold red"


def _write(terminal: Console, found: Found, folder: Location) -> None:
    with staged(folder) as draft:
        (draft / "report.json").write_text(found.to_json())
        draw_verification(found, draft / "verify.png")
    written(terminal, folder / "report.json", folder / "verify.png")


def _ended(terminal: Console, found: list[Found], *, interrupted: bool) -> int:
    """Summarise several tasks; give the exit code."""
    if len(found) > 1:
        terminal.print()
        terminal.print(_summary(found))
    if interrupted:
        return INTERRUPTED
    return int(not all(report.passed for report in found))


def _summary(found: Iterable[Found]) -> Table:
    headers = ("task", "engine", "probe states", "seen", "undeclared", "floor", "seconds", "passed")
    made = table(*headers, title="All verifications")
    for one in found:
        for report in _reports(one):
            cells = (
                report.task,
                report.backend,
                str(report.probes),
                f"{len(report.fired)} of {len(report.declared)}",
                str(len(report.undeclared)),
                f"{report.floor:g}",
                f"{report.seconds:.1f}",
            )
            passed = Text("yes" if report.passed else "no", style=_style(report.passed))
            made.add_row(*cells, passed)
        if isinstance(one, Agreement):
            share = f"same sign: {100 * one.share:.1f} %"
            passed = Text("yes" if one.passed else "no", style=_style(one.passed))
            made.add_row(one.task, "both", "", share, "", "", f"{one.seconds:.1f}", passed)
    return made
