"""``scm-world plan``: an episode that is planned with the model itself."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, final

import numpy as np
import typer

from scm_world.cli.options import Arguments, Out, Preset, Seed, Task, TaskBackend

FORMAT = "scm_world/planned/1"
DIVIDER = 4  # [pixels] between two pictures
FRACTION, SUCCESS, REWARD = "fractional_success", "success", "reward"


def plan(
    task: Task,
    samples: Annotated[
        int | None, typer.Option(min=2, help="Sequences of actions in each round; of the policy.")
    ] = None,
    horizon: Annotated[
        int | None, typer.Option(min=1, help="Control steps that a plan looks ahead.")
    ] = None,
    iterations: Annotated[int | None, typer.Option(min=1, help="Rounds of the search.")] = None,
    every: Annotated[
        int | None, typer.Option(min=1, help="Control steps for which a plan is followed.")
    ] = None,
    objective: Annotated[
        str | None,
        typer.Option(help="Variable to maximize, such as reward; nearness to the goal by default."),
    ] = None,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Of the episode; as many as the task has.")
    ] = None,
    do: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="What the planner believes; once for each."),
    ] = None,
    given: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="What is done to the world at the beginning."),
    ] = None,
    backend: TaskBackend = None,
    model: Annotated[
        str | None, typer.Option(help="Engine to plan with; that of the world by default.")
    ] = None,
    seed: Seed = 0,
    preset: Preset = None,
    threads: Annotated[
        int | None, typer.Option(min=1, help="Of the engine; as many as there are cores.")
    ] = None,
    out: Out = None,
    option: Arguments = None,
) -> None:
    """Play an episode with model-predictive control: actions are tried out in copies of the world.

    Writes the episode, pictures of it and result.json. With --do the planner believes something
    else than what is the case.
    """
    from scm_world.cli.assignments import parse_assignments
    from scm_world.cli.console import RESULTS, check_writable
    from scm_world.cli.tasks import backend_of, suffix, tag

    arguments = tuple(option or ())
    used = backend_of(backend, task, option)
    folder = out or RESULTS / f"plan-{tag(task)}-{used}-seed{seed}{suffix(arguments)}"
    check_writable(folder, folder=True)
    believed, happens = (parse_assignments(texts or ()) for texts in (do, given))
    numbers = {"samples": samples, "horizon": horizon, "iterations": iterations, "every": every}
    asked = {name: number for name, number in numbers.items() if number is not None}
    planner = {**asked, "objective": objective, "backend": model, "seed": seed, "threads": threads}
    run = Run(task, used, preset, seed, steps, planner, believed, happens, arguments)
    raise typer.Exit(_played(run, folder))


@final
@dataclass(frozen=True)
class Run:
    """What is played.

    Attributes:
        task: Name of the task.
        backend: Engine of the world.
        preset: Numerical settings.
        seed: Of the noise, and of the search.
        steps: Of the episode; as many as the task has if None.
        planner: Options of ``CrossEntropy``.
        believed: What the planner believes.
        given: What is done to the world.
        arguments: Of the task, each as ``name=value``.
    """

    task: str
    backend: str
    preset: str | None
    seed: int
    steps: int | None
    planner: dict[str, Any]
    believed: dict[str, Any]
    given: dict[str, Any]
    arguments: tuple[str, ...] = ()


@final
@dataclass
class Watched:
    """A policy whose time is taken, and whose scenes are kept.

    Attributes:
        policy: Who acts.
        steps: How many control steps there will be.
        progress: Told after each action.
        seconds: Wall time of each action.
        scenes: At the beginning, in the middle and at the last action.
    """

    policy: Callable[[Any], Any]
    steps: int
    progress: Callable[[int, int], None]
    seconds: list[float] = field(default_factory=list)
    scenes: list[Any] = field(default_factory=list)

    def __call__(self, world: Any) -> Any:
        """Act."""
        if world.index in {0, self.steps // 2, self.steps - 1}:
            self.scenes.append(world.scene())
        began = time.perf_counter()
        action = self.policy(world)
        self.seconds.append(time.perf_counter() - began)
        self.progress(world.index + 1, self.steps)
        return action


def _played(run: Run, folder: Any) -> int:
    """Play, print, write; return the exit code."""
    from scm_world.cli.console import console, staged, written
    from scm_world.cli.questions import shown_episodes
    from scm_world.cli.tasks import build
    from scm_world.policies.planning import CrossEntropy
    from scm_world.queries import World, save_episode

    policy = CrossEntropy(do=run.believed, **run.planner)
    world = World(build(run.task, run.arguments), backend=run.backend, preset=run.preset)
    try:
        steps = run.steps or world.max_episode_length
        with shown_episodes() as progress:
            acts = Watched(policy, steps, progress)
            names = [name for name in (FRACTION, SUCCESS, REWARD) if name in world.model]
            episode = world.rollout(acts, seed=run.seed, steps=steps, do=run.given, record=names)
        engine = world.engine
    finally:
        world.close()
    found = _summary({name: np.asarray(episode[name]) for name in names}, acts)
    _report(console(), run, engine, found)
    files = ("episode.npz", "scenes.png", "result.json")
    with staged(folder) as draft:
        save_episode(episode, draft / files[0])
        _picture(draft / files[1], acts.scenes)
        (draft / files[2]).write_text(_text(run, engine, policy, found))
    written(console(), *(folder / name for name in files))
    return 0


def _summary(values: dict[str, Any], acts: Watched) -> dict[str, float]:
    """Give the numbers that are told, by what they are called."""
    first = {"control steps": float(len(acts.seconds))}
    if FRACTION in values:
        first["fractional success at the end"] = float(values[FRACTION][-1])
        first["highest fractional success"] = float(values[FRACTION].max())
    if SUCCESS in values:
        first["success at the end"] = float(values[SUCCESS][-1])
    if REWARD in values:
        first["return"] = float(values[REWARD][1:].sum())
    milliseconds = 1e3 * np.array(acts.seconds)
    first["time per action, median [ms]"] = float(np.median(milliseconds))
    first["time per action, mean [ms]"] = float(milliseconds.mean())
    return first


def _report(terminal: Any, run: Run, engine: str, found: dict[str, float]) -> None:
    from rich.text import Text

    from scm_world.cli.console import show, table

    title = f"{run.task} on {engine}, seed {run.seed}, planned"
    made = table("what", "value", title=title)
    for name, number in found.items():
        made.add_row(Text(name), show(number))  # not markup: there are brackets in it
    for name, value in run.believed.items():
        made.add_row(f"believed: {name}", Text(str(value)))
    terminal.print(made)


def _picture(path: Path, scenes: Sequence[Any]) -> None:
    """Write pictures of scenes, one beside the other."""
    from scm_world.backends.renderer import automatic_camera, picture, write_png
    from scm_world.models import Model

    foreign = isinstance(scenes[0].structure, Model)
    camera = automatic_camera(*scenes) if foreign else None
    strip: list[Any] = []
    for scene in scenes:
        frame = picture(scene, camera, samples=2)
        strip += [frame, np.full((frame.shape[0], DIVIDER, 3), 255, dtype=np.uint8)]
    write_png(path, np.concatenate(strip[:-1], axis=1))


def _text(run: Run, engine: str, policy: Any, found: dict[str, float]) -> str:
    from scm_world.cli.console import plain
    from scm_world.queries.experiments.versions import versions

    about = {
        "format": FORMAT,
        **asdict(run),
        "believed": {name: str(value) for name, value in run.believed.items()},
        "given": {name: str(value) for name, value in run.given.items()},
        "search": {**asdict(policy.search), "every": policy.every},
        "found": found,
        "versions": versions(engine),
    }
    return json.dumps(plain(about), indent=1, allow_nan=False) + "\n"
