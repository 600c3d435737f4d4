"""The command ``clone``: its options. What it does is loaded when it is called."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from scm_world.cli.options import Backend, Observations, Seed, Task

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
    from scm_world.cli import cloning

    given = {
        "episodes": episodes,
        "protocols": None if protocols is None else [p.strip() for p in protocols.split(",")],
        "noise": noise,
        "rounds": rounds,
        "observations": observations,
    }
    fields = {name: value for name, value in given.items() if value is not None}
    options = cloning.Options(task, source, fields, backend, seed, tuple(changes or ()), quiet)
    raise typer.Exit(cloning.run(options, out=out))
