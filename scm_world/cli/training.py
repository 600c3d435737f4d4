"""The commands that make policies: ``train`` and ``clone``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from scm_world.cli import console, options
from scm_world.cli.arguments import load_system, parse_assignments, split, tag
from scm_world.errors import ConflictingTargets, UnknownOption

OBSERVATIONS = "Observations of the policy: plain, or privileged: with every causal parameter."
CHANGES = (
    "Any other field, such as worlds=16, network.hidden=[64,64], env.frame_skip=5, or "
    "trials.protocols=[] for no evaluations; the value is JSON or a word."
)


@dataclass
class Training:
    """Options of the making of a policy."""

    observations: Annotated[str | None, typer.Option(show_default="plain", help=OBSERVATIONS)] = (
        None
    )
    backend: options.Backend = None
    seed: options.NotNegative = 0
    out: options.Out = None
    changes: Annotated[
        list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help=CHANGES)
    ] = None
    quiet: Annotated[bool, typer.Option("--quiet", help="Print the result only.")] = False

    def fields(self, **given: Any) -> dict[str, Any]:
        """Return the fields of ``--set``, and those that have an option of their own."""
        found = parse_assignments(self.changes, "'--set'")
        for name, value in (given | {"observations": self.observations}).items():
            if value is not None and name in found:
                raise ConflictingTargets((f"--{name}", f"--set {name}"), name)
            found |= {} if value is None else {name: value}
        return found

    @contextmanager
    def job(self, task: str, *words: str, files: str, what: str) -> Iterator[dict[str, Any]]:
        """Print progress, and after Ctrl-C which files are safe; yield arguments of the work."""
        used = self.backend or load_system(task, is_task=True).backend
        folder = console.results_folder(self.out, *words, str(self.seed))
        bar = nullcontext() if self.quiet else console.progress(what)
        with console.resumable(folder, files, f"files of {what}"), bar as progress:
            yield {
                "out": folder,
                "seed": self.seed,
                "backend": used,
                "progress": progress,
                "tell": None if self.quiet else partial(console.say, stderr=True),
            }


def train(
    task: options.System,
    *,
    algo: options.Text = None,
    curriculum: options.Text = None,
    recipe: Path | None = None,
    steps: int | None = None,
    threads: int | None = None,
    start: Path | None = None,
    device: str = "auto",
    onnx: bool = False,
    show_recipe: bool = False,
    common: Training,
) -> None:
    """Train an agent; write its policy, its learning curve and checkpoints.

    After Ctrl-C it writes a checkpoint and ends (exit code 130); the same command resumes.
    Example: scm-world train reaching --set n_steps=128 --out my-reacher

    Args:
        algo: ppo (by default), sac or td3.
        curriculum: What varies: 0 for nothing, 1 for goals, 2 for everything (gravity and gains,
            too), a protocol such as P10, or the JSON file of a curriculum; by default what works
            for the task.
        recipe: JSON file of a recipe; by default what works for the task.
        steps: Control steps, of all worlds together; those of the recipe by default.
        threads: Threads of the backend and of torch; by default as many as there are cores for the
            backend, and one for torch.
        start: Policy to start from.
        device: auto, cpu or cuda.
        onnx: Write the policy as ONNX, too.
        show_recipe: Print the recipe as JSON, and do nothing.
    """
    from scm_world.training.recipe import Recipe
    from scm_world.training.recipe import recipe as usual

    fields = common.fields(curriculum=curriculum, steps=steps)
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
    if show_recipe:
        typer.echo(made.to_json())
        return

    from scm_world.training import loop

    words = "train", tag(made.task), made.algo, made.name
    with common.job(task, *words, files="checkpoints/*.zip", what="steps") as job:
        found = loop.train(made, start=start, device=device, threads=threads, **job)
    _tell(found, made.task)
    if onnx:
        from scm_world.training.export import to_onnx

        console.say(f"ONNX:     {to_onnx(found.best, found.best.with_suffix('.onnx'))}")


def clone(
    task: options.System,
    *,
    from_: options.Text = None,
    episodes: int | None = None,
    protocols: options.Text = None,
    noise: float | None = None,
    rounds: int | None = None,
    workers: options.ManyWorkers = 0,
    common: Training,
) -> None:
    """Train a network by imitation of a scripted policy, or of recordings.

    Episodes that end well are learned from. After an interruption the same command resumes.
    'scm-world evaluate' takes the policy. 'scm-world train --start' starts from it where the recipe
    observes and acts alike and it has no memory. Omitted options
    have values that work for the task.
    Example: scm-world clone picking --episodes 200 --out my-picker

    Args:
        from_: A policy that sees the whole world, such as feedback; a recording (.parquet), or a
            folder of recordings.
        episodes: Demonstrations of the teacher.
        protocols: What varies in them: names with commas.
        noise: Largest noise of actions in them.
        rounds: Further rounds, in which the network acts, too.
        backend: Physics backend, or several with commas, which take turns; by default that of the
            task.
        workers: How many files of 25 demonstrations are recorded at the same time; 0 for as many
            as there are cores.
    """
    from scm_world.policies.scripted import NAMED
    from scm_world.runs.processes import cores
    from scm_world.training import imitation

    fields = common.fields(
        teacher=from_ if from_ in NAMED else None,
        episodes=episodes,
        protocols=None if protocols is None else split(protocols),
        noise=noise,
        rounds=rounds,
    )
    made = imitation.lesson(task, **fields)
    path = None if from_ is None or from_ in NAMED else Path(from_)
    if path is not None and not path.exists():
        raise UnknownOption("--from", from_, (*NAMED, "a recording or a folder of some"))
    words = "clone", tag(made.task), made.teacher if path is None else path.stem
    with common.job(task, *words, files="demonstrations/*.npz", what="episodes") as job:
        found = imitation.clone(path, made, workers=workers or cores(), **job)
    _tell(found, task)


def _tell(found: Any, task: str) -> None:
    """Print where the policies of a training are, and what evaluates them."""
    score = "" if found.score is None else f", {found.score:.3f} in the evaluations on the way"
    console.say(
        f"policy:   {found.policy}",
        f"best:     {found.best}{score}",
        f"evaluate: scm-world evaluate {found.best} {task}",
    )
