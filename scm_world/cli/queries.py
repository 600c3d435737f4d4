"""The commands that intervene: ``do``, ``effect``, ``counterfactual`` and ``plan``."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.text import Text

from scm_world.cli import console, options
from scm_world.cli.arguments import (
    backend_of,
    load_task,
    open_system,
    parse_assignments,
    parse_outcome,
    policy_of,
    tag,
)
from scm_world.errors import UnknownOption

PICTURES = ("before.png", "after.png", "scene.png")
DIVIDER = 4  # [pixels] between two pictures
SAME = "="


def do(
    task: options.System,
    assignments: options.Assignments,
    backend: options.Backend = None,
    steps: Annotated[int, typer.Option(min=0, help="Control steps to run afterwards.")] = 25,
    seed: options.Seed = 0,
    preset: options.Preset = None,
    space: Annotated[
        str | None,
        typer.Option(
            help="Refuse values outside this space: A (training support), B (held out) or 'A|B'."
        ),
    ] = None,
    show_all: Annotated[
        bool, typer.Option("--all", help="Show descendants that did not move, too.")
    ] = False,
    out: options.Out = None,
    option: options.Option = None,
) -> None:
    """Intervene on a world, and compare it with the same world without the intervention.

    Exits 1 if a variable moves that is no descendant of a target.
    Example: scm-world do pushing tool_block.mass=0.05 --steps 50
    """
    from scm_world.queries import World
    from scm_world.queries.experiments.effects import gap
    from scm_world.queries.experiments.versions import versions
    from scm_world.variables import Draw, Hard, Scale, Shift
    from scm_world.variables.kinds import SPACES

    if space not in (None, *SPACES):
        raise UnknownOption("space", space, SPACES)
    request = parse_assignments(assignments)
    with World(load_task(task, option), backend=backend, preset=preset) as world:
        used = backend_of(world)
        folder = console.results_folder(out, "do", tag(task), used, f"seed{seed}", option=option)
        world.reset(seed=seed)
        start, before, scenes = world.snapshot(), world.values(), [world.scene()]
        action = world.task.idle(world)
        audit = world.do(request, space=space)
        at_once, models = world.values(), [world.model]
        for _ in range(steps):
            world.step(action)
        after = world.values()
        scenes.append(world.scene())
        world.restore(start)
        for _ in range(steps):
            world.step(action)
        without = world.values()
        models.append(world.model)
        engine = f"{world.backend.name} {world.backend.version}"

    targets = {models[0].target(name) for name in audit.targets}
    follow = {
        name
        for model in models  # the intervention may change which bodies there are
        for target in targets & {*model}
        for name in model.descendants(target)
    }
    rows: dict[str, dict[str, Any]] = {}
    for name in models[1]:
        values = [found.get(name) for found in (before, at_once, after, without)]
        if any(value is None for value in values) or (name in targets and name not in follow):
            continue
        difference = gap(after[name], without[name])
        rows[name] = {
            "unit": models[1].declared(name).unit,
            "descendant": name in follow,
            "moved": difference > 0.0 or gap(at_once[name], before[name]) > 0.0,
            **dict(zip(("before", "at_once", "after", "without"), values, strict=True)),
            "difference": difference,
        }
    astray = [name for name, row in rows.items() if row["moved"] and not row["descendant"]]

    def changes(pairs: Any) -> dict[str, Any]:
        return {name: {"before": old, "after": new} for name, (old, new) in pairs.items()}

    acts = Hard | Shift | Scale | Draw
    result = {
        "format": "scm_world/do/1",
        "task": task,
        "backend": used,
        "preset": preset,
        "seed": seed,
        "steps": steps,
        "space": space,
        "arguments": option or (),
        "audit": {
            name: {
                "requested": entry.requested.model_dump(mode="json")
                if isinstance(entry.requested, acts)
                else entry.requested,
                "applied": entry.applied,
                "read_back": entry.read_back,
            }
            for name, entry in audit.targets.items()
        },
        "followed": changes(audit.followed),
        "engine": changes(audit.engine),
        "came": audit.came,
        "went": audit.went,
        "variables": rows,
        "moved_without_a_path": astray,
        "versions": versions(engine),
    }
    with console.staged(folder) as draft:
        shown = _pictures(scenes)
        if shown:
            _write_pictures(
                draft, dict(zip(PICTURES, ([shown[0]], [shown[1]], shown), strict=True))
            )
        console.write_json(draft / "result.json", result)

    terminal = console.terminal(width=console.PAGE)
    title = f"do() in {tag(task)} on {engine}, seed {seed}"
    made = console.table("target", "requested", "applied", "backend reports", title=title)
    for name, entry in audit.targets.items():
        match entry.requested:
            case Shift() | Scale():
                words = f"{entry.requested.kind} by {console.show(entry.requested.by)}"
            case Draw():
                words = f"draw from {entry.requested.source}"
            case Hard():
                words = console.show(entry.requested.value)
            case _:
                words = console.show(entry.requested)
        applied = "at every step" if entry.applied is None else console.show(entry.applied)
        back = "-" if entry.read_back is None else console.show(entry.read_back)
        made.add_row(Text(name, style="bold"), words, applied, back)
    terminal.print(made)
    for label, pairs in (
        ("followed at once", audit.followed),
        ("backend, inertia [kg m²]", audit.engine),
    ):
        for name, (old, new) in pairs.items():
            change = f"{console.show(old, per_line=9)} -> {console.show(new, per_line=9)}"
            terminal.print(Text.assemble((f"{label}: ", "bold"), f"{name} {change}"))
    for label, names in (("new", audit.came), ("gone", audit.went)):
        if names:
            terminal.print(Text.assemble((f"{label}: ", "bold"), ", ".join(names)))
    terminal.print()
    made = console.table(
        *("descendant", "unit", "before", "right after", f"after {steps} steps"),
        *("without the do()", "difference"),
        title="What followed",
        whole=(0, 6),
    )
    descendants = [row for row in rows.values() if row["descendant"]]
    for name, row in rows.items():
        if row["descendant"] and (row["moved"] or show_all):
            same = np.array_equal(row["at_once"], row["before"])
            alike = np.array_equal(row["without"], row["after"])
            made.add_row(
                Text(name, style="bold"),
                Text(row["unit"]),
                console.show(row["before"]),
                SAME if same else console.show(row["at_once"]),
                console.show(row["after"]),
                SAME if alike else console.show(row["without"]),
                Text(f"{row['difference']:.3g}", style="bold" if row["difference"] else "dim"),
            )
    terminal.print(made)
    still = sum(not row["moved"] for row in descendants)
    line = f"{still} of {len(descendants)} descendants did not move"
    line += " (--all shows them)" if still and not show_all else ""
    if not astray:
        line += f"; none of the {len(rows) - len(descendants)} other variables moved"
    terminal.print(Text(f"{line}."))
    if astray:
        wrong = f"MOVED WITHOUT A DECLARED PATH FROM A TARGET: {', '.join(astray)}."
        terminal.print(Text(f"{wrong} The graph is wrong.", style="bold white on red"))
    there = [name for name in PICTURES if (folder / name).exists()]
    console.written(*(folder / name for name in (*there, "result.json")))
    raise typer.Exit(int(bool(astray)))


def _pictures(scenes: Sequence[Any]) -> list[Any]:
    """Return a picture of each scene; none of a step function, which has no bodies."""
    from scm_world.backends.renderer import automatic_camera, picture
    from scm_world.backends.step import StepModel
    from scm_world.models import Model

    if isinstance(scenes[0].structure, StepModel):
        return []
    camera = automatic_camera(*scenes) if isinstance(scenes[0].structure, Model) else None
    return [picture(scene, camera, samples=2) for scene in scenes]


def _write_pictures(folder: Path, files: dict[str, list[Any]]) -> None:
    """Write files, each with one picture or several side by side."""
    from scm_world.backends.renderer import write_png

    for name, frames in files.items():
        white = np.full((frames[0].shape[0], DIVIDER, 3), 255, dtype=np.uint8)
        strip = [part for frame in frames for part in (frame, white)]
        write_png(folder / name, np.concatenate(strip[:-1], axis=1))


def effect(
    task: options.System,
    outcome: Annotated[str, typer.Argument(help="Name of a variable, or of a component: name[2].")],
    assignments: options.Assignments,
    versus: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="What it is compared with; nothing by default."),
    ] = None,
    nature: options.Nature = None,
    how: Annotated[
        str, typer.Option(help="final, change, mean, max, min, sum or first.")
    ] = "final",
    n: Annotated[int, typer.Option("-n", min=2, help="Number of units.")] = 100,
    unpaired: Annotated[bool, typer.Option("--unpaired", help="Compare different units.")] = False,
    steps: options.Steps = 25,
    policy: options.Policy = None,
    backend: options.Backend = None,
    seed: options.Seed = 0,
    preset: options.Preset = None,
    out: options.Out = None,
    option: options.Option = None,
) -> None:
    """Estimate the average treatment effect of an intervention, with a 95 % interval.

    Units are paired by default: the same noise, with and without the intervention.
    Example: scm-world effect pushing reward floor_friction=0.3 --versus floor_friction=0.5
    """
    request, other, varies = map(parse_assignments, (assignments, versus, nature))
    measured = parse_outcome(outcome, how)
    with open_system(task, option, backend=backend, preset=preset) as system:
        used = backend_of(system)
        folder = console.results_folder(
            out, "effect", tag(task), used, f"seed{seed}", option=option
        )
        with console.progress("episodes") as tell:
            found = system.effect(
                measured,
                do=request,
                versus=other,
                n=n,
                paired=not unpaired,
                progress=tell,
                nature=varies,
                steps=steps if system.graph.is_temporal else 0,
                seed=seed,
                policy=policy_of(policy, system),
            )
    made = console.table(
        *("", "mean", "95 % interval"),
        title=f"{found.outcome}, {tag(task)} on {found.engine}, seed {seed}",
    )
    made.add_row(
        "effect",
        console.show(found.mean),
        f"{console.show(found.low)} … {console.show(found.high)}",
    )
    made.add_row("with it", console.show(found.treated), "")
    made.add_row("without", console.show(found.control), "")
    made.add_row("episodes", str(found.rollouts), "paired" if found.paired else "unpaired")
    if found.paired:
        made.add_row("variance unpaired : paired", console.show(found.variance_ratio), "")
    console.terminal().print(made)
    with console.staged(folder) as draft:
        (draft / "effect.json").write_text(found.to_json() + "\n")
    console.written(folder / "effect.json")


def counterfactual(
    task: options.System,
    assignments: options.Assignments,
    at: Annotated[int, typer.Option(min=0, help="Control step of the intervention.")] = 0,
    steps: options.Steps = 25,
    policy: options.Policy = None,
    backend: options.Backend = None,
    seed: options.Seed = 0,
    preset: options.Preset = None,
    out: options.Out = None,
    option: options.Option = None,
) -> None:
    """Run an episode, and again with an intervention and the same noise; compare them.

    Both episodes are saved, except those of equations, which have no file format.
    Example: scm-world counterfactual pushing tool_block.mass=0.1 --at 5
    """
    from scm_world.queries import SCM, compare, save_episode

    request = parse_assignments(assignments)
    with open_system(task, option, backend=backend, preset=preset) as system:
        used = backend_of(system)
        folder = console.results_folder(
            out, "counterfactual", tag(task), used, f"seed{seed}", option=option
        )
        acts, length = policy_of(policy, system), steps if system.graph.is_temporal else 0
        episode = system.rollout(acts, seed=seed, steps=length)
        other = episode.counterfactual(request, at=at)
        apart = compare(episode, other)
    made = console.table(
        *("variable", "differs from", "most, and when", "at the end"),
        title=f"{tag(task)} on {used}, seed {seed}: intervention at control step {at}",
    )
    for name, found in apart.variables.items():
        most = f"{console.show(found.largest)} at {found.at}"
        made.add_row(
            name, str(found.first), most, console.show(np.abs(found.final).max(initial=0.0))
        )
    if not apart.variables:
        made.add_row("nothing", "", "", "")
    console.terminal().print(made)
    if apart.contacts:
        step, pair, which = apart.contacts[0]
        episode_name = ("the factual", "the counterfactual")[which]
        console.say(
            f"{len(apart.contacts)} contacts in one of the two only, first {pair[0]} and {pair[1]} "
            f"at {step}, in {episode_name} episode"
        )
    result = {
        "format": "scm_world/counterfactual/1",
        "at": at,
        "steps": episode.steps,
        "variables": {
            name: {"first": d.first, "largest": d.largest, "at": d.at, "final": d.final}
            for name, d in apart.variables.items()
            if np.isfinite(d.largest)
        },
        "contacts_in_one_only": [
            {"step": step, "bodies": pair, "in": ("episode", "counterfactual")[which]}
            for step, pair, which in apart.contacts
        ],
        "noise_in_one_only": [
            {"variable": name, "in": ("episode", "counterfactual")[which]}
            for name, which in apart.noise
        ],
    }
    with console.staged(folder) as draft:
        if not isinstance(system, SCM):
            save_episode(episode, draft / "episode.npz")
            save_episode(other, draft / "counterfactual.npz")
        console.write_json(draft / "difference.json", result)
        names = [name for name in ("episode.npz", "counterfactual.npz") if (draft / name).exists()]
    console.written(*(folder / name for name in (*names, "difference.json")))


def plan(
    task: options.System,
    samples: Annotated[
        int | None, typer.Option(min=2, help="Sequences of actions in each round.")
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
        typer.Option(
            "--do", metavar="NAME=VALUE", help="Intervention in the planner's model only."
        ),
    ] = None,
    given: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="Intervention in the world at the beginning."),
    ] = None,
    backend: options.Backend = None,
    model: Annotated[
        str | None, typer.Option(help="Backend of the planner; that of the world by default.")
    ] = None,
    seed: options.Seed = 0,
    preset: options.Preset = None,
    threads: Annotated[
        int | None, typer.Option(min=1, help="Of the backend; as many as there are cores.")
    ] = None,
    out: options.Out = None,
    option: options.Option = None,
) -> None:
    """Run an episode with model-predictive control: actions are tried in copies of the world.

    Writes the episode, pictures of it and result.json. With --do the planner's model differs from
    the world.
    Example: scm-world plan pushing --steps 125 --do tool_block.friction=0.2
    """
    from scm_world.policies.planning import CrossEntropy
    from scm_world.queries import World, save_episode
    from scm_world.queries.experiments.versions import versions

    believed, happens = parse_assignments(do), parse_assignments(given)
    numbers = {"samples": samples, "horizon": horizon, "iterations": iterations, "every": every}
    planner: dict[str, Any] = {
        **{name: number for name, number in numbers.items() if number is not None},
        "objective": objective,
        "backend": model,
        "seed": seed,
        "threads": threads,
    }
    policy = CrossEntropy(do=believed, **planner)
    scenes: list[Any] = []
    milliseconds: list[float] = []
    with World(load_task(task, option), backend=backend, preset=preset) as world:
        used, engine = backend_of(world), world.engine
        folder = console.results_folder(out, "plan", tag(task), used, f"seed{seed}", option=option)
        length = steps or world.max_episode_length
        names = [n for n in ("fractional_success", "success", "reward") if n in world.model]
        with console.progress("control steps") as tell:

            def act(seen: Any) -> Any:
                if seen.index in {0, length // 2, length - 1}:
                    scenes.append(seen.scene())
                began = time.perf_counter()
                action = policy(seen)
                milliseconds.append(1e3 * (time.perf_counter() - began))
                tell(seen.index + 1, length)
                return action

            episode = world.rollout(act, seed=seed, steps=length, do=happens, record=names)
        values = {name: np.asarray(episode[name]) for name in names}

    found = {"control steps": float(len(milliseconds))}
    if "fractional_success" in values:
        found["fractional success at the end"] = float(values["fractional_success"][-1])
        found["highest fractional success"] = float(values["fractional_success"].max())
    if "success" in values:
        found["success at the end"] = float(values["success"][-1])
    if "reward" in values:
        found["return"] = float(values["reward"][1:].sum())
    found["time per action, median [ms]"] = float(np.median(milliseconds))
    found["time per action, mean [ms]"] = float(np.mean(milliseconds))
    made = console.table("what", "value", title=f"{tag(task)} on {engine}, seed {seed}, planned")
    for name, number in found.items():
        made.add_row(Text(name), console.show(number))  # not markup: there are brackets in it
    for name, value in believed.items():
        made.add_row(f"in the planner's model: {name}", Text(str(value)))
    console.terminal().print(made)
    result = {
        "format": "scm_world/planned/1",
        "task": task,
        "backend": used,
        "preset": preset,
        "seed": seed,
        "steps": steps,
        "planner": planner,
        "believed": {name: str(value) for name, value in believed.items()},
        "given": {name: str(value) for name, value in happens.items()},
        "arguments": option or (),
        "search": {**asdict(policy.search), "every": policy.every},
        "found": found,
        "versions": versions(engine),
    }
    with console.staged(folder) as draft:
        save_episode(episode, draft / "episode.npz")
        if shown := _pictures(scenes):
            _write_pictures(draft, {"scenes.png": shown})
        console.write_json(draft / "result.json", result)
        files = sorted(path.name for path in draft.iterdir())
    console.written(*(folder / name for name in files))
