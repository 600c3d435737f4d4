"""``scm-world discover``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

from rich.text import Text

from scm_world.cli.console import (
    RESULTS,
    check_writable,
    console,
    keep_whole,
    staged,
    table,
    written,
)
from scm_world.cli.tasks import suffix, system, tag
from scm_world.discovery import DiscoveryReport, discover
from scm_world.discovery.names import by_entity
from scm_world.discovery.plots import draw_graphs
from scm_world.output.locations import Location
from scm_world.queries import SCM, World

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

INTERRUPTED = 130
PROGRESS = "progress.json"
LONG = 80  # [characters] what is longer is not repeated
EXTRA, MISSING = "bold dark_orange", "bold red"


@final
@dataclass(frozen=True)
class Options:
    """What to discover.

    Attributes:
        task: Name of the task.
        backend: Name of the engine.
        preset: Numerical settings.
        probes: How many probe states.
        seed: Of the experiments.
        arguments: Of the task, each as ``name=value``.
        resolution: Of the graph of the robot; that of the task if None.
    """

    task: str
    backend: str
    preset: str | None
    probes: int
    seed: int
    arguments: tuple[str, ...] = ()
    resolution: str | None = None


def run(options: Options, *, out: Location | None, strict: bool) -> int:
    """Discover, print, write; return the exit code."""
    about = f"{options.backend}-seed{options.seed}{suffix(options.arguments)}"
    about += f"-{options.resolution}" if options.resolution else ""
    folder = out or RESULTS / f"discover-{tag(options.task)}-{about}"
    check_writable(folder, folder=True)
    task = system(options.task, options.arguments)
    made = {"backend": options.backend, "preset": options.preset, "resolution": options.resolution}
    asked = task if isinstance(task, SCM) else World(task, **made)  # type: ignore[arg-type]
    with asked, shown_progress(options.probes) as progress:
        report = discover(
            asked,
            probes=options.probes,
            seed=options.seed,
            progress=progress,
            checkpoint=folder / PROGRESS,
        )
    report = replace(report, arguments=options.arguments)
    terminal = console()
    _print(terminal, report, tuple(asked.graph))
    with staged(folder) as draft:
        report.save(draft / "report.json")
        draw_graphs(report, draft / "graphs.png")
    written(terminal, folder / "report.json", folder / "graphs.png")
    if report.probes < report.planned:
        return INTERRUPTED
    return int(strict and report.score.shd > 0)


@contextmanager
def shown_progress(probes: int, about: str = "") -> Iterator[Callable[[int, int], None]]:
    """Show how far it is: a bar on a terminal, a few plain lines elsewhere."""
    terminal = console(stderr=True)
    lead = f"{about}, " if about else ""
    if not terminal.is_terminal:
        steps = {max(1, round(probes * quarter / 4)) for quarter in range(1, 5)}
        yield (
            lambda done, planned: (
                terminal.print(f"{lead}probe state {done} of {planned}") if done in steps else None
            )
        )
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    columns = (f"{lead}probe states", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=terminal, transient=True) as bar:
        task = bar.add_task("", total=probes)
        yield lambda done, planned: bar.update(task, completed=done, total=planned)


def _print(terminal: Console, report: DiscoveryReport, names: tuple[str, ...]) -> None:
    terminal.print(keep_whole(_edges(report, names), terminal, 0))
    used = {name for edge in (*report.found, *report.declared) for name in edge[:2]}
    alone = [name for name in names if name not in used]
    if alone:
        terminal.print(Text.assemble(("no edge at all: ", "bold"), ", ".join(by_entity(alone))))
        terminal.print()
    terminal.print(_summary(report))


def _edges(report: DiscoveryReport, names: Iterable[str]) -> Table:
    """Write one row per effect."""
    title = f"Recovered graph of {report.task} ({len(report.found)} edges)"
    caption = "[+] found but not declared   [-] declared but not found"
    headers = ("effect", "causes at once", "causes one step earlier", "edges")
    made = table(*headers, title=title, caption=caption)
    made.columns[3].justify = "right"
    first: dict[str, str] = {}
    for effect in names:
        cells = [_causes(report, names, effect, lag) for lag in (0, 1)]
        if not any(cells):
            continue
        for lag, cell in enumerate(cells):
            like = first.setdefault(cell.plain, effect)
            if like != effect and len(cell) > LONG:
                cells[lag] = Text(f"same as {like}", style="italic")
        count = sum(edge[1] == effect for edge in report.found)
        made.add_row(Text(effect, style="bold"), *cells, str(count))
    return made


def _causes(report: DiscoveryReport, names: Iterable[str], effect: str, lag: int) -> Text:
    found, declared = set(report.found), set(report.declared)
    edges = [(cause, effect, lag) for cause in names]
    kinds = (
        ("", "", [e for e in edges if e in found and e in declared]),
        ("[+]", EXTRA, [e for e in edges if e in found and e not in declared]),
        ("[-]", MISSING, [e for e in edges if e in declared and e not in found]),
    )
    parts = [
        Text(symbol + short, style=style)
        for symbol, style, kind in kinds
        for short in by_entity(edge[0] for edge in kind)
    ]
    return Text(", ").join(parts)


def _summary(report: DiscoveryReport) -> Table:
    """Write the numbers, one per line."""
    from rich.table import Table

    made = Table.grid(padding=(0, 2))
    made.add_column(style="bold")
    made.add_column(overflow="fold")
    for name, value, good in _numbers(report):
        style = "" if good is None else ("green" if good else "bold red")
        made.add_row(name, Text(value, style=style))
    return made


def _numbers(report: DiscoveryReport) -> Iterator[tuple[str, str, bool | None]]:
    score = report.score
    version = report.versions.get(report.backend, "")
    complete = report.probes == report.planned
    states = f"{report.probes}" if complete else f"{report.probes} of {report.planned}: interrupted"
    yield "engine", f"{report.backend} {version}, preset {report.preset}", None
    if report.arguments:
        yield "options", ", ".join(report.arguments), None
    yield "probe states", states, None if complete else False
    yield "rollouts, at least needed", f"{report.rollouts}, {report.bound}", None
    yield "floor (do and undo)", f"{report.floor:.3g}", None
    yield "threshold", f"{report.threshold:.3g}", None
    yield "largest effect without an edge", f"{report.inert:.3g}", None
    yield "edges declared, found", f"{len(report.declared)}, {len(report.found)}", None
    yield "SHD", str(score.shd), score.shd == 0
    yield "precision", f"{score.precision:.4f}", None
    yield "recall", f"{score.recall:.4f}", None
    yield "F1", f"{score.f1:.4f}", None
    yield "[+] undeclared", _list(score.undeclared), not score.undeclared
    yield "[-] missed", _list(score.missed), not score.missed
    if report.refused:
        refused = ", ".join(f"{name} ({n})" for name, n in report.refused.items())
        yield "no feasible value in some states", refused, None
    yield "seconds", f"{report.seconds:.1f}", None


def _list(edges: tuple[tuple[str, str, int], ...]) -> str:
    shown = [f"{cause} -> {effect} (lag {lag})" for cause, effect, lag in edges[:10]]
    more = [f"and {len(edges) - 10} more, see report.json"] if len(edges) > 10 else []
    return "\n".join([str(len(edges)), *shown, *more])
