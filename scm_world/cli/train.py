"""``scm-world train``. What it needs is imported when it is called."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from scm_world.cli.options import Backend, Observations, Seed, Task
from scm_world.errors import ConflictingTargets, UnknownOption

if TYPE_CHECKING:
    from scm_world.training.recipe import Recipe

INTERRUPTED = 130
OWN = {"task": "none: the task stands before the options", "algo": "none: give --algo"}
"""What is no change of a recipe, and where it is said."""


def train(
    task: Task,
    algo: Annotated[str | None, typer.Option(help="ppo, sac or td3.", show_default="ppo")] = None,
    curriculum: Annotated[
        str | None,
        typer.Option(
            help="0: nothing varies, 1: goals, 2: everything, or the JSON file of a curriculum.",
            show_default="what works for the task",
        ),
    ] = None,
    recipe: Annotated[
        Path | None,
        typer.Option(help="JSON file of a recipe, in place of the one that works for the task."),
    ] = None,
    backend: Backend = "mujoco",
    seed: Seed = 0,
    steps: Annotated[
        int | None,
        typer.Option(help="Control steps, of all worlds together.", show_default="of the recipe"),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder of the run.", show_default="under scm-world-results"),
    ] = None,
    observations: Observations = None,
    hindsight: Annotated[
        bool, typer.Option("--hindsight", help="Hindsight replay and sparse rewards (sac, td3).")
    ] = False,
    worlds: Annotated[
        int | None, typer.Option(help="Simulated at once.", show_default="of the recipe")
    ] = None,
    threads: Annotated[
        int | None,
        typer.Option(
            help="Of the engine and of torch.", show_default="cores for the engine, 1 for torch"
        ),
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Any field of the recipe or setting, such as n_steps=128, rate.initial=1e-4 or "
            "env.frame_skip=5; the value is JSON or a word. Give it once for each.",
        ),
    ] = None,
    start: Annotated[Path | None, typer.Option(help="Policy to begin with.")] = None,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    evaluate: Annotated[
        bool,
        typer.Option("--evaluate/--no-evaluate", help="Evaluate while training; keep the best."),
    ] = True,
    onnx: Annotated[bool, typer.Option("--onnx", help="Write the policy as ONNX, too.")] = False,
    show: Annotated[
        bool, typer.Option("--show-recipe", help="Print the recipe as JSON, and do nothing.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print the result only.")] = False,
) -> None:
    """Train an agent, and keep its policy, its learning curve and checkpoints.

    The same command goes on after an interruption. Ctrl-C ends after the present round with a
    checkpoint (exit code 130).
    """
    given = {"curriculum": curriculum, "observations": observations, "worlds": worlds}
    given |= {"steps": steps, "hindsight": hindsight or None}
    fields = assigned(changes or (), {n: one for n, one in given.items() if one is not None})
    if not evaluate:
        fields["trials.protocols"] = []
    made = _recipe(task, algo, recipe, fields)
    if show:
        typer.echo(made.to_json())
        return

    from scm_world.cli.console import RESULTS, check_writable, console
    from scm_world.training import loop

    folder = out or RESULTS / f"train-{made.task}-{made.algo}-{made.name}-{seed}"
    check_writable(folder, folder=True)
    terminal = console()
    if not quiet:
        rows = {
            "recipe": made.name,
            "curriculum": json.dumps(made.curriculum["part"]),
            "steps": f"{made.steps:,} in {made.worlds} worlds of {backend}",
            "actions": made.env.get("action_mode", "joint_positions"),
            "observations": made.observations + (", with goals" if made.hindsight else ""),
            "evaluation": ", ".join(made.trials.protocols) or "none while training",
            "seed": seed,
            "folder": folder,
        }
        about(f"Training {made.algo.upper()} on {made.task}", rows)
    how: dict[str, Any] = {"start": start, "device": device, "threads": threads}
    try:
        with shown(quiet) as (progress, tell):
            how |= {"progress": progress, "tell": tell}
            found = loop.train(made, out=folder, seed=seed, backend=backend, **how)
    except KeyboardInterrupt:
        safe = sorted(int(path.stem) for path in folder.glob("checkpoints/*.pt"))
        kept = f"{safe[-1]:,} steps are safe in {folder}" if safe else "nothing was kept yet"
        terminal.print(f"interrupted: {kept}; the same command goes on", soft_wrap=True)
        raise typer.Exit(INTERRUPTED) from None
    score = "" if found.score is None else f", {found.score:.3f} in the evaluations while training"
    say(
        f"policy:   {found.policy} after {found.steps:,} steps",
        f"best:     {found.best}{score}",
        f"evaluate: scm-world evaluate {found.best} {made.task}",
    )
    if onnx:
        from scm_world.training.onnx import to_onnx

        say(f"ONNX:     {to_onnx(found.best, found.best.with_suffix('.onnx'))}")


def _recipe(task: str, algo: str | None, path: Path | None, fields: dict[str, Any]) -> Recipe:
    """Make the recipe of a task, or read one, and change fields of it."""
    from scm_world.training.recipe import Recipe, recipe

    for name, allowed in OWN.items():
        if name in fields:
            raise UnknownOption(f"{name} after --set", fields[name], (allowed,))
    if path is None:
        return recipe(task, algo or "ppo", **fields)
    found = Recipe.load(path, trusted=(task,))
    for name, typed, its in (("task", task, found.task), ("algo", algo, found.algo)):
        if typed not in (its, None):
            raise UnknownOption(name, typed, (f"{its}, as in {path}",))
    return found.but(**fields)


def assigned(texts: Iterator[str] | list[str] | tuple[str, ...], given: Mapping[str, Any]) -> Any:
    """Read ``name=value``, whose value may be a word, and add what has an option of its own.

    Raises:
        BadParameter: There is no name or no value.
        ConflictingTargets: A name is given twice.

    Example:
        >>> assigned(["n_steps=128", "rate.schedule=linear", "network.hidden=[64]"], {"steps": 8})
        {'n_steps': 128, 'rate.schedule': 'linear', 'network.hidden': [64], 'steps': 8}
    """
    found: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        name = name.strip()
        if not (name and equals and value.strip()):
            raise typer.BadParameter(f"{text!r}: expected name=value", param_hint="'--set'")
        if name in found:
            raise ConflictingTargets((name, name), name)
        try:
            found[name] = json.loads(value)
        except json.JSONDecodeError:
            found[name] = value.strip()
    for name in given:
        if name in found:
            raise ConflictingTargets((f"--{name}", f"--set {name}"), name)
    return {**found, **given}


def about(title: str, rows: Mapping[str, Any]) -> None:
    """Print what will be done."""
    from rich.text import Text

    from scm_world.cli.console import console, table

    shown = table("", "", title=title)
    shown.show_header = False
    for name, value in rows.items():
        shown.add_row(name, Text(str(value)))
    console().print(shown)


def say(*lines: str, stderr: bool = False) -> None:
    """Print lines as they are."""
    from rich.text import Text

    from scm_world.cli.console import console

    for line in lines:
        console(stderr=stderr).print(Text(line), soft_wrap=True)


@contextmanager
def shown(
    quiet: bool,
) -> Iterator[tuple[Callable[[int, int], None] | None, Callable[[str], None] | None]]:
    """Show how far it is, and what happens: a bar, or lines where there is no terminal."""
    if quiet:
        yield None, None
        return
    from scm_world.cli.console import console

    def tell(line: str) -> None:
        say(line, stderr=True)

    terminal, last = console(stderr=True), [0]

    def tenths(done: int, planned: int) -> None:
        if 10 * done // planned > last[0]:
            last[0] = 10 * done // planned
            tell(f"{done:,} of {planned:,} steps")

    if not terminal.is_terminal:
        yield tenths, tell
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    columns = ("steps", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=terminal, transient=True) as bar:
        row = bar.add_task("", total=None)
        yield lambda done, planned: bar.update(row, completed=done, total=planned), tell
