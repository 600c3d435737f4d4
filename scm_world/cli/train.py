"""The command ``train``: its options. What it does is loaded when it is called."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from scm_world.cli.options import Backend, Observations, Seed, Task


def train(
    task: Task,
    algo: Annotated[str | None, typer.Option(help="ppo, sac or td3.", show_default="ppo")] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            help="tuned: what works best here.",
            show_default="tuned",
        ),
    ] = None,
    curriculum: Annotated[
        str | None,
        typer.Option(
            help="0: nothing varies, 1: goals, 2: everything, or the JSON file of a curriculum.",
            show_default="that of the preset",
        ),
    ] = None,
    recipe: Annotated[
        Path | None,
        typer.Option(help="JSON file of a recipe, in place of a preset."),
    ] = None,
    backend: Backend = "mujoco",
    seed: Seed = 0,
    steps: Annotated[
        int | None,
        typer.Option(help="Control steps, of all worlds together.", show_default="of the preset"),
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
        int | None, typer.Option(help="Simulated at once.", show_default="of the preset")
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
    from scm_world.cli import training

    given = training.Options(
        task,
        algo,
        preset,
        curriculum,
        recipe,
        backend,
        seed,
        steps,
        observations,
        hindsight,
        worlds,
        threads,
        tuple(changes or ()),
        start,
        device,
        evaluate,
        onnx,
        quiet,
    )
    raise typer.Exit(training.show(given) if show else training.run(given, out=out))
