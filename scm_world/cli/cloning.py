"""``scm-world clone``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from rich.text import Text

from scm_world.cli.console import RESULTS, check_writable, console, table
from scm_world.cli.questions import shown_episodes
from scm_world.cli.training import INTERRUPTED, assigned
from scm_world.errors import ConflictingTargets, UnknownOption
from scm_world.evaluation.policies.cards import OPTIONS
from scm_world.queries.policies import NAMED
from scm_world.training.imitation import Cloned, Lesson, clone, lesson
from scm_world.training.recipe import recipe


@final
@dataclass(frozen=True)
class Options:
    """What is cloned, as it was typed.

    Attributes:
        task: Name of the task.
        source: Name of a teacher, or path of recordings; None for the teacher of the lesson.
        fields: Of the lesson, that have an option of their own.
        backend: Name of the engine.
        seed: Of everything that is drawn.
        changes: Fields of the lesson, each as ``name=value``.
        quiet: Whether only the result is printed.
    """

    task: str
    source: str | None
    fields: Mapping[str, Any]
    backend: str
    seed: int
    changes: tuple[str, ...]
    quiet: bool

    def made(self) -> Lesson:
        """Make the lesson."""
        changes = assigned(self.changes)
        for name in self.fields:
            if name in changes:
                raise ConflictingTargets((f"--{name}", f"--set {name}"), name)
        is_named = self.source is not None and self.path is None
        teacher = {"teacher": self.source} if is_named else {}
        return lesson(self.task, **teacher, **self.fields, **changes)

    @property
    def path(self) -> Path | None:
        """Where recordings are; None if there is a teacher.

        Raises:
            UnknownOption: There are none, and there is no such teacher.
        """
        if self.source is None or self.source in NAMED:
            return None
        if not Path(self.source).exists():
            raise UnknownOption("--from", self.source, (*NAMED, "a recording or a folder of some"))
        return Path(self.source)


def run(options: Options, *, out: Path | None) -> int:
    """Clone, say where the policy is; return the exit code."""
    made, path = options.made(), options.path
    teacher = made.teacher if path is None else path.stem
    folder = out or RESULTS / f"clone-{made.task}-{teacher}-{options.seed}"
    check_writable(folder, folder=True)
    terminal = console()
    tell: Callable[[str], None] | None = None
    if not options.quiet:
        terminal.print(_about(options, made, folder))
        errors = console(stderr=True)

        def tell(line: str) -> None:
            errors.print(Text(line), soft_wrap=True)

    try:
        with nullcontext() if options.quiet else shown_episodes() as progress:
            found = clone(
                path,
                made,
                out=folder,
                seed=options.seed,
                backend=options.backend,
                progress=progress,
                tell=tell,
            )
    except KeyboardInterrupt:
        said = f"interrupted: what was shown is safe in {folder}; the same command goes on"
        terminal.print(said, soft_wrap=True)
        return INTERRUPTED
    _tell(found, terminal)
    return 0


def _about(options: Options, made: Lesson, folder: Path) -> Any:
    """Say what will be done."""
    about = table("", "", title=f"Learning {made.task} by imitation")
    about.show_header = False
    rows = {"from": options.source or made.teacher}
    if options.path is None:
        rows["episodes"] = f"{made.episodes} on {options.backend}, in {', '.join(made.protocols)}"
        rows["noise"] = f"up to {made.noise:g} of the largest action"
        rows["rounds"] = f"{made.rounds} more, of {made.more} episodes"
    rows["observations"] = made.observations
    rows["seed"] = str(options.seed)
    rows["folder"] = str(folder)
    for name, value in rows.items():
        about.add_row(name, Text(value))
    return about


def _is_a_start(learned: Lesson) -> bool:
    """Tell whether the preset of the task trains a policy of this form."""
    preset = recipe(learned.task, observations=learned.observations)
    here, there = preset.options, learned.options
    names = {name for name in (*here, *there) if name in OPTIONS}
    same = all(here.get(name) == there.get(name) for name in names)
    return same and preset.network.activation == learned.network.activation


def _tell(found: Cloned, terminal: Any) -> None:
    score = "" if found.score is None else f", {found.score:.3f} in the evaluations between rounds"
    task = found.lesson.task
    lines = [
        f"policy:   {found.policy}",
        f"best:     {found.best}{score}",
        f"evaluate: scm-world evaluate {found.best} {task}",
    ]
    if _is_a_start(found.lesson):
        seen = found.lesson.observations
        option = "" if seen == "plain" else f" --observations {seen}"
        lines.append(f"go on:    scm-world train {task}{option} --start {found.best}")
    for line in lines:
        terminal.print(Text(line), soft_wrap=True)
