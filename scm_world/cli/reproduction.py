"""``scm-world reproduce``: the published figures, trained and evaluated here."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from scm_world.cli.options import Backend, read_location
from scm_world.cli.working import Engine, Work, Workers
from scm_world.errors import UnknownOption

if TYPE_CHECKING:
    from scm_world.training.study import Outcome, Plan, Reproduction, Study
    from scm_world.training.study.runs import Tell

INTERRUPTED = 130
_COMMAS = "with commas; all if left out."


def reproduce(
    table: Annotated[
        str, typer.Option(help="Figure: pushing, picking, pick_and_place, stacking2 or all.")
    ] = "pushing",
    preset: Annotated[
        str, typer.Option(help="Of the recipes: paper, the published settings; or tuned.")
    ] = "paper",
    scale: Annotated[
        float, typer.Option(help="Share of the preset's training steps, such as 0.01.")
    ] = 1.0,
    tasks: Annotated[str | None, typer.Option(help=f"Of the figure, {_COMMAS}")] = None,
    algos: Annotated[str | None, typer.Option(help=f"ppo, sac, td3, {_COMMAS}")] = None,
    curricula: Annotated[str | None, typer.Option(help=f"0, 1, 2, {_COMMAS}")] = None,
    seeds: Annotated[
        str, typer.Option(help="Of the trainings, with commas; none: train nothing.")
    ] = "0,1,2,3,4",
    protocols: Annotated[str | None, typer.Option(help=f"P0 to P11, {_COMMAS}")] = None,
    episodes: Annotated[int, typer.Option(min=1, help="Of each protocol.")] = 200,
    backend: Backend = "mujoco",
    policy: Annotated[
        str, typer.Option(help="Of each training: last, as published, or best.")
    ] = "last",
    conventions: Annotated[
        str | None,
        typer.Option(
            help="scm_world or causal_world.",
            show_default="causal_world with the preset paper, else scm_world",
        ),
    ] = None,
    actors: Annotated[
        Path | None,
        typer.Option(help="Folder with the published actors; they are evaluated, too."),
    ] = None,
    hours: Annotated[
        float | None, typer.Option(help="Stop after so many hours; the same command goes on.")
    ] = None,
    plan: Annotated[
        bool, typer.Option("--plan", help="Show what there is to do, and what it costs.")
    ] = False,
    pictures: Annotated[bool, typer.Option(help="Draw radars and reports, too.")] = True,
    workers: Workers = None,
    engine: Engine = None,
    out: Annotated[
        Any,  # a Location or None
        typer.Option(
            parser=read_location,
            metavar="PATH",
            help="Folder of this machine, for everything.",
            show_default="under scm-world-results",
        ),
    ] = None,
) -> None:
    """Train and evaluate what the figures of the paper show, and set both side by side.

    Every training is task x algorithm x curriculum x seed. What is finished is kept in the folder;
    after an interruption, or with more seeds, the same command goes on. Writes tables, pictures
    and reports, in which a part of the published budget is called one. Exits 1 if a training
    failed; the others are done nevertheless.
    """
    from scm_world.training.study import Study
    from scm_world.training.study.cells import ALGOS, CURRICULA, PROTOCOLS
    from scm_world.training.study.published import figure

    known = figure(table)
    study = Study(
        tasks=_chosen("task of the figure", tasks, known),
        algos=_chosen("algorithm", algos, ALGOS),
        curricula=_numbers("curriculum", curricula, CURRICULA),
        seeds=() if seeds == "none" else _numbers("seed", seeds, ()),
        protocols=_chosen("protocol", protocols, PROTOCOLS),
        episodes=episodes,
        preset=preset,
        scale=scale,
        backend=backend,
        policy=policy,
        conventions=conventions,
    )
    folder = _folder(out, table, study)
    if plan:
        raise typer.Exit(_show_plan(study, folder))
    how = {"table": table, "hours": hours, "actors": actors, "pictures": pictures}
    raise typer.Exit(_run(study, folder, how, Work(engine, workers)))


def _chosen(what: str, given: str | None, known: Sequence[str]) -> tuple[str, ...]:
    """Read names with commas between them; all if none are given."""
    if given is None:
        return tuple(known)
    words = tuple(word.strip() for word in given.split(",") if word.strip())
    for word in words:
        if word not in known:
            raise UnknownOption(what, word, known)
    return words


def _numbers(what: str, given: str | None, known: Sequence[int]) -> tuple[int, ...]:
    """Read whole numbers with commas between them."""
    if given is None:
        return tuple(known)
    words = [word.strip() for word in given.split(",") if word.strip()]
    if not all(word.isdecimal() for word in words):
        raise UnknownOption(what, given, ("whole numbers with commas between them",))
    return tuple(map(int, words))


def _folder(out: Any, table: str, study: Study) -> Path:
    """Name the folder; policies are read from it again, so it is one of this machine."""
    from scm_world.cli.console import RESULTS, check_writable

    usual = RESULTS / f"reproduce-{table}-{study.preset}-{study.scale:g}-{study.backend}"
    folder = usual if out is None else out
    if not isinstance(folder, Path):
        raise UnknownOption("folder of a study", str(folder), ("a folder of this machine",))
    check_writable(folder, folder=True)
    return folder


# --- plans --------------------------------------------------------------------------------------


def _show_plan(study: Study, folder: Path) -> int:
    from scm_world.cli.console import console, keep_whole, table
    from scm_world.training.study import planned

    plans = planned(study, folder)
    terminal = console()
    title = f"{len(plans)} trainings, preset {study.preset}, {study.scale:g} of its steps"
    note = "Times are estimates from measured rates, of one core [h]."
    heads = ("training", "steps", "training [h]", "evaluation [h]", "state")
    made = table(*heads, title=title, caption=note)
    for one in plans:
        times = (f"{one.training:.2f}", f"{one.evaluation:.2f}")
        made.add_row(one.cell.name, f"{one.steps:,}", *times, one.state)
    terminal.print(keep_whole(made, terminal, 0))
    terminal.print(_sum(plans), soft_wrap=True)
    return 0


def _sum(plans: Sequence[Plan]) -> str:
    if not plans:
        return "nothing is trained"
    done = sum(one.trained and one.evaluated for one in plans)
    whole = sum(one.training + one.evaluation for one in plans)
    left = sum(one.left for one in plans)
    return f"{done} of {len(plans)} are done; {left:,.1f} of {whole:,.1f} CPU-hours are left"


# --- runs ---------------------------------------------------------------------------------------


def _run(study: Study, folder: Path, how: dict[str, Any], work: Work) -> int:
    from scm_world.cli.console import console
    from scm_world.training.study import planned
    from scm_world.training.study import reproduce as do

    terminal = console()
    terminal.print(_sum(planned(study, folder)), soft_wrap=True)
    try:
        with work.begun() as executor, _shown() as tell:
            found = do(study, folder, engine=executor, tell=tell, **how)
    except KeyboardInterrupt:
        said = f"interrupted: what is finished is safe in {folder}; the same command goes on"
        terminal.print(said, soft_wrap=True)
        return INTERRUPTED
    return _told(found, terminal)


def _told(found: Reproduction, terminal: Any) -> int:
    """Print what there is, what was written, and what went wrong; give the exit code."""
    from scm_world.cli.console import fail, table, written
    from scm_world.training.study.runs import DONE, STOPPED

    made = table("task", "training", "mean of P0 to P11, ours", "published")
    for row in found.overall:
        ours = "not run" if row.ours is None else f"{row.ours.mean} over {row.ours.over}"
        there = "–" if row.published is None else f"{row.published:.2f}"
        made.add_row(row.task, f"{row.algo}, curriculum {row.curriculum}", ours, there)
    terminal.print(made)
    written(terminal, *found.files)
    count = {status: _count(found.outcomes, status) for status in (DONE, STOPPED)}
    if found.outcomes:
        terminal.print(f"{count[DONE]} of {len(found.outcomes)} trainings are done and evaluated")
    if count[STOPPED]:
        terminal.print(f"the time is over: {count[STOPPED]} are left; the same command goes on")
    for note in found.notes:
        terminal.print(note, soft_wrap=True, markup=False)
    for outcome in found.failed:
        fail(f"{outcome.cell.name}: {outcome.message}")
    return 1 if found.failed else 0


def _count(outcomes: Sequence[Outcome], status: str) -> int:
    return sum(outcome.status == status for outcome in outcomes)


@contextmanager
def _shown() -> Iterator[Tell]:
    """Show which training is at work and how far: a bar on a terminal, else a line for each."""
    from scm_world.cli.console import console

    terminal = console(stderr=True)
    if not terminal.is_terminal:
        yield _lines(terminal)
        return
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TimeRemainingColumn

    columns = ("{task.description}", BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=terminal, transient=True) as bar:
        bars: dict[str, Any] = {}

        def tell(cell: Any, what: str, done: int, total: int) -> None:
            name = f"{cell.name} {what}"
            if name not in bars:
                for old in bars.values():
                    bar.remove_task(old)
                bars.clear()
                bars[name] = bar.add_task(name, total=total)
            bar.update(bars[name], completed=done, total=total)

        yield tell


def _lines(terminal: Any) -> Callable[[Any, str, int, int], None]:
    """Tell of each tenth of a piece of work."""
    last: list[tuple[str, int]] = [("", 0)]

    def tell(cell: Any, what: str, done: int, total: int) -> None:
        now = (f"{cell.name} {what}", 10 * done // max(1, total))
        if now != last[0]:
            last[0] = now
            terminal.print(f"{now[0]}: {done:,} of {total:,}", markup=False)

    return tell
