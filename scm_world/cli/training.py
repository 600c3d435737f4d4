"""``scm-world train``."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import typer
from rich.text import Text

from scm_world.cli.console import RESULTS, check_writable, console, table
from scm_world.errors import ConflictingTargets, UnknownOption
from scm_world.training.checkpoints import checkpoints
from scm_world.training.loop import Trained, train
from scm_world.training.recipe import Recipe, recipe
from scm_world.training.runs import CHECKPOINTS

INTERRUPTED = 130
SET = "'--set'"
OWN = {
    "task": "none: the task stands before the options",
    "algo": "none: give --algo",
    "preset": "none: give --preset",
}
"""What is no change of a recipe, and where it is said."""


@final
@dataclass(frozen=True)
class Options:
    """What is trained, as it was typed.

    Attributes:
        task: Name of the task.
        algo: Of the algorithm; PPO if None.
        preset: Of the recipe; the tuned one if None.
        curriculum: A number or a path; that of the preset if None.
        recipe: JSON file of a recipe, in place of a preset.
        backend: Name of the engine.
        seed: Of everything that is drawn.
        steps: Control steps; those of the preset if None.
        observations: Of the recipe; those of the preset if None.
        hindsight: Whether goals are made up.
        worlds: How many; those of the preset if None.
        threads: Of the engine and of torch.
        changes: Fields of the recipe, each as ``name=value``.
        start: Policy file to begin with.
        device: Where networks are computed.
        evaluate: Whether it is evaluated while it is trained.
        onnx: Whether the policy is written as ONNX, too.
        quiet: Whether only the result is printed.
    """

    task: str
    algo: str | None
    preset: str | None
    curriculum: str | None
    recipe: Path | None
    backend: str
    seed: int
    steps: int | None
    observations: str | None
    hindsight: bool
    worlds: int | None
    threads: int | None
    changes: tuple[str, ...]
    start: Path | None
    device: str
    evaluate: bool
    onnx: bool
    quiet: bool

    def made(self) -> Recipe:
        """Make the recipe."""
        changes = assigned(self.changes)
        for name, value in self._given().items():
            if name in changes:
                raise ConflictingTargets((f"--{name}", f"--set {name}"), name)
            changes[name] = value
        for name in OWN:
            if name in changes:
                raise UnknownOption(f"{name} after --set", changes[name], (OWN[name],))
        if not self.evaluate:
            changes["trials.protocols"] = []
        if self.recipe is not None:
            return self._loaded(self.recipe).but(**changes)
        return recipe(self.task, self.algo or "ppo", preset=self.preset or "tuned", **changes)

    def _given(self) -> dict[str, Any]:
        """List the fields of the recipe that were given as options of their own."""
        names = ("curriculum", "observations", "worlds", "steps")
        given = {name: getattr(self, name) for name in names} | {
            "hindsight": self.hindsight or None
        }
        return {name: value for name, value in given.items() if value is not None}

    def _loaded(self, path: Path) -> Recipe:
        """Read a recipe, which has a task and an algorithm of its own."""
        found = Recipe.load(path)
        wanted = {"task": self.task, "algo": self.algo, "preset": self.preset}
        for name, mine in {"task": found.task, "algo": found.algo, "preset": None}.items():
            if wanted[name] not in (mine, None):
                allowed = (f"{mine}, as in {path}" if mine else f"none, beside {path}",)
                raise UnknownOption(name, wanted[name], allowed)
        return found

    def folder(self, made: Recipe) -> Path:
        """Name the folder of the run."""
        return RESULTS / f"train-{made.task}-{made.algo}-{made.name}-{self.seed}"


def assigned(texts: tuple[str, ...]) -> dict[str, Any]:
    """Read ``name=value``; a value that is no JSON is a word.

    Raises:
        BadParameter: There is no name or no value.
        ConflictingTargets: A name is given twice.

    Example:
        >>> assigned(("n_steps=128", "rate.schedule=linear", "network.hidden=[64, 64]"))
        {'n_steps': 128, 'rate.schedule': 'linear', 'network.hidden': [64, 64]}
    """
    found: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        name = name.strip()
        if not (name and equals and value.strip()):
            raise typer.BadParameter(f"{text!r}: expected name=value", param_hint=SET)
        if name in found:
            raise ConflictingTargets((name, name), name)
        try:
            found[name] = json.loads(value)
        except json.JSONDecodeError:
            found[name] = value.strip()
    return found


def show(options: Options) -> int:
    """Print the recipe as JSON; return the exit code."""
    typer.echo(options.made().to_json())
    return 0


def run(options: Options, *, out: Path | None) -> int:
    """Train, say where the policy is; return the exit code."""
    made = options.made()
    folder = out or options.folder(made)
    check_writable(folder, folder=True)
    terminal = console()
    if not options.quiet:
        terminal.print(_about(options, made, folder))
    try:
        with shown(options) as (progress, tell):
            found = train(
                made,
                out=folder,
                seed=options.seed,
                backend=options.backend,
                start=options.start,
                progress=progress,
                tell=tell,
                device=options.device,
                threads=options.threads,
            )
    except KeyboardInterrupt:
        safe = [path.name for path in checkpoints(folder / CHECKPOINTS)]
        kept = f"{int(safe[-1]):,} steps are safe in {folder}" if safe else "nothing was kept yet"
        terminal.print(f"interrupted: {kept}; the same command goes on", soft_wrap=True)
        return INTERRUPTED
    _tell(found, terminal)
    if options.onnx:
        from scm_world.training.onnx import to_onnx

        target = to_onnx(found.best, found.best.with_suffix(".onnx"))
        terminal.print(Text(f"ONNX:     {target}"), soft_wrap=True)
    return 0


def _about(options: Options, made: Recipe, folder: Path) -> Any:
    """Say what will be done."""
    about = table("", "", title=f"Training {made.algo.upper()} on {made.task}")
    about.show_header = False
    rows = {
        "recipe": made.name,
        "curriculum": json.dumps(made.curriculum["part"]),
        "steps": f"{made.steps:,} in {made.worlds} worlds of {options.backend}",
        "actions": str(made.env.get("action_mode", "joint_positions")),
        "observations": made.observations + (", with goals" if made.hindsight else ""),
        "evaluation": ", ".join(made.trials.protocols) or "none while training",
        "seed": str(options.seed),
        "folder": str(folder),
    }
    for name, value in rows.items():
        about.add_row(name, Text(value))
    return about


def _tell(found: Trained, terminal: Any) -> None:
    score = "" if found.score is None else f", {found.score:.3f} in the evaluations while training"
    command = f"scm-world evaluate {found.best} {found.recipe.task}"
    lines = (
        f"policy:   {found.policy} after {found.steps:,} steps",
        f"best:     {found.best}{score}",
        f"evaluate: {command}",
    )
    for line in lines:
        terminal.print(Text(line), soft_wrap=True)


@contextmanager
def shown(
    options: Options,
) -> Iterator[tuple[Callable[[int, int], None] | None, Callable[[str], None] | None]]:
    """Show how far it is, and what happens: a bar on a terminal, plain lines elsewhere."""
    if options.quiet:
        yield None, None
        return
    terminal = console(stderr=True)

    def tell(line: str) -> None:
        terminal.print(Text(line), soft_wrap=True)

    if not terminal.is_terminal:
        yield Lines(tell), tell
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    columns = ("steps", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=terminal, transient=True) as bar:
        row = bar.add_task("", total=None)
        yield lambda done, planned: bar.update(row, completed=done, total=planned), tell


@final
class Lines:
    """Says at every tenth of the way how far it is.

    Args:
        tell: Prints a line.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell, self._said = tell, 0

    def __call__(self, done: int, planned: int) -> None:
        """Tell how far it is."""
        tenth = 10 * done // planned
        if tenth > self._said:
            self._said = tenth
            self._tell(f"{done:,} of {planned:,} steps")
