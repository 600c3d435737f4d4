"""``scm-world clone``. What it needs is imported when it is called."""

from __future__ import annotations

from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from scm_world.cli.options import Backend, Observations, Seed, Task
from scm_world.cli.train import INTERRUPTED, about, assigned, say
from scm_world.errors import UnknownOption

if TYPE_CHECKING:
    from scm_world.training.imitation import Lesson

_OF_TASK = "what works for the task"


def clone(
    task: Task,
    source: Annotated[
        str | None,
        typer.Option(
            "--from",
            help="A policy that looks at the world, such as grasp; a recording (.parquet), or a "
            "folder of recordings.",
            show_default=_OF_TASK,
        ),
    ] = None,
    episodes: Annotated[
        int | None,
        typer.Option(help="That the teacher shows alone.", show_default=_OF_TASK),
    ] = None,
    protocols: Annotated[
        str | None,
        typer.Option(help="What varies in them: names with commas.", show_default=_OF_TASK),
    ] = None,
    noise: Annotated[
        float | None,
        typer.Option(help="Largest noise of actions while it shows.", show_default=_OF_TASK),
    ] = None,
    rounds: Annotated[
        int | None,
        typer.Option(help="In which the network plays along.", show_default=_OF_TASK),
    ] = None,
    observations: Observations = None,
    backend: Backend = "mujoco",
    seed: Seed = 0,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for all files.", show_default="under scm-world-results"),
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Any field of the lesson, such as updates=8000, trials.episodes=40 or "
            "network.hidden=[64,64]; the value is JSON or a word. Give it once for each.",
        ),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print the result only.")] = False,
) -> None:
    """Let a network learn by imitation what a scripted policy does, or what was recorded.

    Episodes that end well are learned from. After an interruption the same command goes on. The
    policy is a file that 'scm-world evaluate' takes, and 'scm-world train --start' goes on from.
    """
    from scm_world.cli.console import RESULTS, check_writable, console
    from scm_world.cli.questions import shown_episodes
    from scm_world.policies.scripted import NAMED
    from scm_world.training import imitation

    given = {
        "teacher": source if source in NAMED else None,
        "episodes": episodes,
        "protocols": None if protocols is None else [p.strip() for p in protocols.split(",")],
        "noise": noise,
        "rounds": rounds,
        "observations": observations,
    }
    typed = {name: value for name, value in given.items() if value is not None}
    made = imitation.lesson(task, **assigned(changes or (), typed))
    path = None if source is None or source in NAMED else Path(source)
    if path is not None and not path.exists():
        raise UnknownOption("--from", source, (*NAMED, "a recording or a folder of some"))
    teacher = made.teacher if path is None else path.stem
    folder = out or RESULTS / f"clone-{made.task}-{teacher}-{seed}"
    check_writable(folder, folder=True)
    if not quiet:
        rows = {"from": source or made.teacher}
        if path is None:
            rows["episodes"] = f"{made.episodes} on {backend}, in {', '.join(made.protocols)}"
            rows["noise"] = f"up to {made.noise:g} of the largest action"
            rows["rounds"] = f"{made.rounds} more, of {made.more} episodes"
        rows |= {"observations": made.observations, "seed": str(seed), "folder": str(folder)}
        about(f"Learning {made.task} by imitation", rows)
    tell = None if quiet else partial(say, stderr=True)
    try:
        with nullcontext() if quiet else shown_episodes() as progress:
            how: dict[str, Any] = {
                "seed": seed,
                "backend": backend,
                "progress": progress,
                "tell": tell,
            }
            found = imitation.clone(path, made, out=folder, **how)
    except KeyboardInterrupt:
        said = f"interrupted: what was shown is safe in {folder}; the same command goes on"
        console().print(said, soft_wrap=True)
        raise typer.Exit(INTERRUPTED) from None
    score = "" if found.score is None else f", {found.score:.3f} in the evaluations between rounds"
    say(
        f"policy:   {found.policy}",
        f"best:     {found.best}{score}",
        f"evaluate: scm-world evaluate {found.best} {task}",
    )
    if _is_a_start(found.lesson):
        option = "" if observations is None else f" --observations {observations}"
        say(f"go on:    scm-world train {task}{option} --start {found.best}")


def _is_a_start(learned: Lesson) -> bool:
    """Tell whether the usual recipe of the task trains a policy of this form."""
    from scm_world.policies.cards import COMMON, FORM
    from scm_world.training.recipe import recipe

    usual = recipe(learned.task, observations=learned.observations)
    here, there = usual.options, learned.options
    same = all(here.get(name) == there.get(name) for name in (*FORM, *COMMON))
    return same and usual.network.activation == learned.network.activation
