"""The commands that intervene: ``do``, ``effect`` and ``counterfactual``."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.text import Text

from scm_world.cli import console, options
from scm_world.cli.arguments import (
    backend_of,
    open_system,
    parse_assignments,
    parse_outcome,
    policy_of,
    refuse_settings,
    tag,
)

PICTURES = ("before.png", "after.png", "scene.png")
DIVIDER = 4  # [pixels] between two pictures
SAME = "="


def do(
    task: options.System,
    assignments: options.Assignments,
    backend: options.Backend = None,
    steps: options.NotNegative = 25,
    seed: options.Seed = 0,
    preset: options.Preset = None,
    space: options.Text = None,
    show_all: Annotated[bool, typer.Option("--all")] = False,
    out: options.Out = None,
    option: options.Option = None,
) -> None:
    """Intervene on a system, and compare it with the same system without the intervention.

    Of a world, pictures before and after are written, too. Exits 1 if a variable moves that is no
    descendant of a target.
    Example: scm-world do pushing tool_block.mass=0.05 --steps 50

    Args:
        steps: Control steps to run afterwards.
        space: Refuse values outside this space: A (training support), B (held out) or 'A|B'.
        show_all: Show descendants that did not move, too.
    """
    from scm_world.queries import SCM, consequences
    from scm_world.queries.experiments.versions import versions

    request = parse_assignments(assignments)
    with open_system(task, option, backend=backend, preset=preset) as system:
        used = backend_of(system)
        if isinstance(system, SCM):
            refuse_settings(space=space)
        folder = console.results_folder(out, "do", tag(task), used, f"seed{seed}", option=option)
        found = consequences(system, request, steps=steps, seed=seed, space=space)  # type: ignore[arg-type] # it checks the space
    audit, astray, steps = found.audit, found.astray, found.done.steps
    rows: list[Any] = [*found.variables.itertuples()]
    result = {
        "format": "scm_world/do/1",
        "task": task,
        "backend": used,
        "preset": preset,
        "seed": seed,
        "space": space,
        "arguments": option or (),
        "steps": steps,
        "audit": {
            name: {part: getattr(one, part) for part in ("requested", "applied", "read_back")}
            for name, one in audit.targets.items()
        },
        **{
            part: {n: {"before": a, "after": b} for n, (a, b) in getattr(audit, part).items()}
            for part in ("followed", "engine")
        },
        "came": audit.came,
        "went": audit.went,
        "variables": found.variables.to_dict("index"),
        "moved_without_a_path": astray,
        "versions": versions("" if isinstance(system, SCM) else found.engine),
    }
    console.say(f"do() in {tag(task)} on {found.engine}, seed {seed}:", audit, "")
    descendants = [row for row in rows if row.descendant]
    console.table(
        (
            *("descendant", "unit", "before", "right after", f"after {steps} steps"),
            *("without the do()", "difference"),
        ),
        [
            (
                Text(row.Index, style="bold"),
                row.unit,
                console.show(row.before),
                _or_same(row.right_after, row.before),
                console.show(row.after),
                _or_same(row.without, row.after),
                Text(f"{row.difference:.3g}", style="bold" if row.difference else "dim"),
            )
            for row in rows
            if row.descendant and (row.moved or show_all)
        ],
        title="What followed",
        whole=(0, 6),
        width=console.PAGE,
    )
    still = sum(not row.moved for row in descendants)
    line = f"{still} of {len(descendants)} descendants did not move"
    line += " (--all shows them)" if still and not show_all else ""
    if not astray:
        line += f"; none of the {len(rows) - len(descendants)} other variables moved"
    console.say(f"{line}.")
    if astray:
        wrong = f"MOVED WITHOUT A DECLARED PATH FROM A TARGET: {', '.join(astray)}."
        console.terminal().print(Text(f"{wrong} The graph is wrong.", style="bold white on red"))
    with console.staged(folder) as draft:
        scenes = () if isinstance(system, SCM) else (found.plain.scene(0), found.done.scene(steps))
        if shown := _pictures([scene for scene, _ in scenes]):
            for name, frames in zip(PICTURES, ([shown[0]], [shown[1]], shown), strict=True):
                _write_picture(draft / name, frames)
        console.write_json(draft / "result.json", result)
    raise typer.Exit(int(bool(astray)))


def _or_same(value: Any, other: Any) -> str:
    return SAME if np.array_equal(value, other) else console.show(value)


def _pictures(scenes: Sequence[Any]) -> list[Any]:
    """Return a picture of each scene; none of systems without bodies."""
    from scm_world.backends.renderer import automatic_camera, picture, shapes_of
    from scm_world.backends.step import StepModel
    from scm_world.models import Model
    from scm_world.models.shapes import Shapes

    if not scenes or isinstance(scenes[0].structure, StepModel):
        return []
    camera = None
    if isinstance(scenes[0].structure, Model):
        shown = (shapes_of(scene, goals=False) for scene in scenes)
        camera = automatic_camera(reduce(Shapes.joined, shown))
    return [picture(scene, camera, samples=2) for scene in scenes]


def _write_picture(path: Path, frames: Sequence[Any]) -> None:
    """Write a file with one picture, or several side by side."""
    from scm_world.backends.renderer import png

    white = np.full((frames[0].shape[0], DIVIDER, 3), 255, dtype=np.uint8)
    strip = [part for frame in frames for part in (frame, white)]
    path.write_bytes(png(np.concatenate(strip[:-1], axis=1)))


def effect(
    task: options.System,
    outcome: Annotated[str, typer.Argument()],
    assignments: options.Assignments,
    versus: options.Pairs = None,
    nature: options.Nature = None,
    how: str = "final",
    n: Annotated[int, typer.Option("-n", min=2)] = 100,
    unpaired: bool = False,
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

    Args:
        outcome: Name of a variable, or of a component: name[2].
        versus: What it is compared with; nothing by default.
        how: final, change, mean, max, min, sum or first.
        n: Number of units.
        unpaired: Compare different units.
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
    console.say(f"{tag(task)} on {found.engine}, seed {seed}, with its 95 % interval:", found)
    with console.staged(folder) as draft:
        (draft / "effect.json").write_text(found.to_json() + "\n")


def counterfactual(
    task: options.System,
    assignments: options.Assignments,
    at: options.NotNegative = 0,
    steps: options.Steps = 25,
    policy: options.Policy = None,
    backend: options.Backend = None,
    seed: options.Seed = 0,
    preset: options.Preset = None,
    out: options.Out = None,
    option: options.Option = None,
) -> None:
    """Run an episode, and again with an intervention and the same noise; compare them.

    Both episodes are saved.
    Example: scm-world counterfactual pushing tool_block.mass=0.1 --at 5

    Args:
        at: Control step of the intervention.
    """
    from scm_world.queries import compare, save_episode

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
    console.say(
        f"{tag(task)} on {used}, seed {seed}: with the intervention at control step {at} (b), and "
        "without it (a)",
        apart,
    )
    variables, contacts = apart.variables, apart.contacts.rename(columns={"episode": "in"})
    contacts["in"] = contacts["in"].map({"a": "episode", "b": "counterfactual"})
    result = {
        "format": "scm_world/counterfactual/1",
        "at": at,
        "steps": episode.steps,
        "variables": variables[np.isfinite(variables["largest"])].to_dict("index"),
        "contacts_in_one_only": contacts.to_dict("records"),
    }
    with console.staged(folder) as draft:
        save_episode(episode, draft / "episode.npz")
        save_episode(other, draft / "counterfactual.npz")
        console.write_json(draft / "difference.json", result)
