"""The commands that make policies: ``train`` and ``clone``."""

from __future__ import annotations

import json
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.text import Text

from scm_world.cli import console, options
from scm_world.cli.arguments import load_task, parse_assignments, parse_json, split, tag
from scm_world.errors import ConflictingTargets, UnknownOption

OF_TASK = "what works for the task"
Folder = Annotated[
    Path | None,
    typer.Option(help="Folder for all files.", show_default="under scm-world-results"),
]


def train(
    task: options.System,
    algo: Annotated[str | None, typer.Option(help="ppo, sac or td3.", show_default="ppo")] = None,
    curriculum: Annotated[
        str | None,
        typer.Option(
            help="0: nothing varies, 1: goals, 2: everything, or the JSON file of a curriculum.",
            show_default=OF_TASK,
        ),
    ] = None,
    recipe: Annotated[
        Path | None, typer.Option(help="JSON file of a recipe.", show_default=OF_TASK)
    ] = None,
    backend: options.Backend = None,
    seed: options.Seed = 0,
    steps: Annotated[
        int | None,
        typer.Option(help="Control steps, of all worlds together.", show_default="of the recipe"),
    ] = None,
    out: Folder = None,
    observations: options.Observations = None,
    hindsight: Annotated[
        bool, typer.Option("--hindsight", help="Hindsight replay and sparse rewards (sac, td3).")
    ] = False,
    worlds: Annotated[
        int | None,
        typer.Option(help="Number of parallel worlds.", show_default="of the recipe"),
    ] = None,
    threads: Annotated[
        int | None,
        typer.Option(
            help="Of the backend and of torch.", show_default="cores for the backend, 1 for torch"
        ),
    ] = None,
    changes: options.Changes = None,
    start: Annotated[Path | None, typer.Option(help="Policy to start from.")] = None,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    evaluate: Annotated[
        bool,
        typer.Option("--evaluate/--no-evaluate", help="Evaluate while training; keep the best."),
    ] = True,
    onnx: Annotated[bool, typer.Option("--onnx", help="Write the policy as ONNX, too.")] = False,
    show: Annotated[
        bool, typer.Option("--show-recipe", help="Print the recipe as JSON, and do nothing.")
    ] = False,
    quiet: options.Quiet = False,
) -> None:
    """Train an agent; write its policy, its learning curve and checkpoints.

    Ctrl-C ends after the present round with a checkpoint (exit code 130); the same command resumes.
    Example: scm-world train reaching --set n_steps=128 --out my-reacher
    """
    from scm_world.training.recipe import Recipe
    from scm_world.training.recipe import recipe as usual

    fields = _fields(
        changes,
        curriculum=curriculum,
        observations=observations,
        worlds=worlds,
        steps=steps,
        hindsight=hindsight or None,
    )
    fields |= {} if evaluate else {"trials.protocols": []}
    for name, where in (("task", "the task stands before the options"), ("algo", "give --algo")):
        if name in fields:
            raise UnknownOption(f"{name} after --set", fields[name], (f"none: {where}",))
    if recipe is None:
        made = usual(task, algo or "ppo", **fields)
    else:
        made = Recipe.load(recipe, trusted=(task,))
        for name, typed, its in (("task", task, made.task), ("algo", algo, made.algo)):
            if typed not in (its, None):
                raise UnknownOption(name, typed, (f"{its}, as in {recipe}",))
        made = made.but(**fields)
    if show:
        typer.echo(made.to_json())
        return

    from scm_world.training import loop

    used = backend or load_task(task).backend
    folder: Any = console.results_folder(out, "train", tag(made.task), made.algo, made.name, seed)
    if not quiet:
        _about(
            f"Training {made.algo.upper()} on {made.task}",
            {
                "recipe": made.name,
                "curriculum": json.dumps(made.curriculum["part"]),
                "steps": f"{made.steps:,} in {made.worlds} worlds of {used}",
                "actions": made.env.get("action_mode", "joint_positions"),
                "observations": made.observations + (", with goals" if made.hindsight else ""),
                "evaluation": ", ".join(made.trials.protocols) or "none while training",
                "seed": seed,
                "folder": folder,
            },
        )
    bar = nullcontext() if quiet else console.progress("steps", lines=10)
    with console.resumable(folder, "checkpoints/*.pt", "checkpoints"), bar as tell:
        found = loop.train(
            made,
            out=folder,
            seed=seed,
            backend=used,
            start=start,
            device=device,
            threads=threads,
            progress=tell,
            tell=None if quiet else partial(console.say, stderr=True),
        )
    score = "" if found.score is None else f", {found.score:.3f} in the evaluations while training"
    console.say(
        f"policy:   {found.policy} after {found.steps:,} steps",
        f"best:     {found.best}{score}",
        f"evaluate: scm-world evaluate {found.best} {made.task}",
    )
    if onnx:
        from scm_world.training.onnx import to_onnx

        console.say(f"ONNX:     {to_onnx(found.best, found.best.with_suffix('.onnx'))}")


def clone(
    task: options.System,
    source: Annotated[
        str | None,
        typer.Option(
            "--from",
            help="A policy that sees the whole world, such as grasp; a recording (.parquet), or a "
            "folder of recordings.",
            show_default=OF_TASK,
        ),
    ] = None,
    episodes: Annotated[
        int | None, typer.Option(help="Demonstrations of the teacher.", show_default=OF_TASK)
    ] = None,
    protocols: Annotated[
        str | None,
        typer.Option(help="What varies in them: names with commas.", show_default=OF_TASK),
    ] = None,
    noise: Annotated[
        float | None,
        typer.Option(help="Largest noise of actions in them.", show_default=OF_TASK),
    ] = None,
    rounds: Annotated[
        int | None,
        typer.Option(help="Further rounds, in which the network acts, too.", show_default=OF_TASK),
    ] = None,
    observations: options.Observations = None,
    backend: options.Backend = None,
    seed: options.Seed = 0,
    out: Folder = None,
    changes: options.Changes = None,
    quiet: options.Quiet = False,
) -> None:
    """Train a network by imitation of a scripted policy, or of recordings.

    Episodes that end well are learned from. After an interruption the same command resumes.
    'scm-world evaluate' takes the policy, and 'scm-world train --start' starts from it.
    Example: scm-world clone picking --episodes 200 --out my-picker
    """
    from scm_world.policies.cards import COMMON, FORM
    from scm_world.policies.scripted import NAMED
    from scm_world.training import imitation
    from scm_world.training.recipe import recipe

    fields = _fields(
        changes,
        teacher=source if source in NAMED else None,
        episodes=episodes,
        protocols=None if protocols is None else split(protocols),
        noise=noise,
        rounds=rounds,
        observations=observations,
    )
    made = imitation.lesson(task, **fields)
    path = None if source is None or source in NAMED else Path(source)
    if path is not None and not path.exists():
        raise UnknownOption("--from", source, (*NAMED, "a recording or a folder of some"))
    used = backend or load_task(task).backend
    teacher = made.teacher if path is None else path.stem
    folder: Any = console.results_folder(out, "clone", tag(made.task), teacher, seed)
    if not quiet:
        rows = {"from": source or made.teacher}
        if path is None:
            rows["episodes"] = f"{made.episodes} on {used}, in {', '.join(made.protocols)}"
            rows["noise"] = f"up to {made.noise:g} of the largest action"
            rows["rounds"] = f"{made.rounds} more, of {made.more} episodes"
        rows |= {"observations": made.observations, "seed": str(seed), "folder": str(folder)}
        _about(f"Learning {made.task} by imitation", rows)
    bar = nullcontext() if quiet else console.progress("episodes")
    with console.resumable(folder, "demonstrations/*.npz", "files of episodes"), bar as tell:
        found = imitation.clone(
            path,
            made,
            out=folder,
            seed=seed,
            backend=used,
            progress=tell,
            tell=None if quiet else partial(console.say, stderr=True),
        )
    score = "" if found.score is None else f", {found.score:.3f} in the evaluations between rounds"
    console.say(
        f"policy:   {found.policy}",
        f"best:     {found.best}{score}",
        f"evaluate: scm-world evaluate {found.best} {task}",
    )
    learned = found.lesson
    usual = recipe(task, observations=learned.observations)
    same = all(usual.options.get(k) == learned.options.get(k) for k in (*FORM, *COMMON))
    if same and usual.network.activation == learned.network.activation:
        more = "" if observations is None else f" --observations {observations}"
        console.say(f"go on:    scm-world train {task}{more} --start {found.best}")


def _fields(changes: list[str] | None, **given: Any) -> dict[str, Any]:
    """Return the fields of ``--set``, and those that have an option of their own.

    Raises:
        ConflictingTargets: A field is given twice.
    """
    found = parse_assignments(changes, "'--set'", parse_json)
    given = {name: value for name, value in given.items() if value is not None}
    for name in given:
        if name in found:
            raise ConflictingTargets((f"--{name}", f"--set {name}"), name)
    return {**found, **given}


def _about(title: str, rows: dict[str, Any]) -> None:
    """Print what will be done."""
    shown = console.table("", "", title=title)
    shown.show_header = False
    for name, value in rows.items():
        shown.add_row(name, Text(str(value)))
    console.terminal().print(shown)
