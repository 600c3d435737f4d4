"""The commands that intervene: ``do``, ``effect`` and ``counterfactual``."""

from __future__ import annotations

from collections.abc import Sequence
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
from scm_world.errors import UnknownOption

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
    from scm_world.policies.scripted import as_policy
    from scm_world.queries import World
    from scm_world.queries.experiments.effects import gap
    from scm_world.queries.experiments.versions import versions
    from scm_world.queries.twins import asked
    from scm_world.variables import Draw, Scale, Shift
    from scm_world.variables.kinds import SPACES

    if space not in (None, *SPACES):
        raise UnknownOption("space", space, SPACES)
    request = parse_assignments(assignments)
    with open_system(task, option, backend=backend, preset=preset) as system:
        used, is_world = backend_of(system), isinstance(system, World)
        steps = steps if system.graph.is_temporal else 0
        if not is_world:
            refuse_settings(space=space)
        folder = console.results_folder(out, "do", tag(task), used, f"seed{seed}", option=option)
        stepped: Any = asked(system)[1]
        stepped.reset(seed=seed)
        start, before = stepped.snapshot(), stepped.values()
        scenes = [stepped.scene()] if is_world else []
        action = as_policy(None, stepped)(stepped)
        audit = stepped.do(request, space=space) if is_world else stepped.do(request)
        right_after, models = stepped.values(), [stepped.model]
        for _ in range(steps):
            stepped.step(action)
        after = stepped.values()
        scenes += [stepped.scene()] if is_world else []
        stepped.restore(start)
        for _ in range(steps):
            stepped.step(action)
        without = stepped.values()
        models.append(stepped.model)
        engine = stepped.engine if is_world else ""

    targets = {models[0].target(name) for name in audit.targets}
    follow = {
        name
        for model in models  # the intervention may change which bodies there are
        for target in targets & {*model}
        for name in model.descendants(target)
    }
    rows: dict[str, dict[str, Any]] = {}
    for name in models[1]:
        values = [found.get(name) for found in (before, right_after, after, without)]
        if any(value is None for value in values) or (name in targets and name not in follow):
            continue
        difference = gap(after[name], without[name])
        rows[name] = {
            "unit": models[1].declared(name).unit,
            "descendant": name in follow,
            "moved": difference > 0.0 or gap(right_after[name], before[name]) > 0.0,
            **dict(zip(("before", "right_after", "after", "without"), values, strict=True)),
            "difference": difference,
        }
    astray = [name for name, row in rows.items() if row["moved"] and not row["descendant"]]

    def changes(pairs: Any) -> dict[str, Any]:
        return {name: {"before": old, "after": new} for name, (old, new) in pairs.items()}

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
            name: {part: getattr(one, part) for part in ("requested", "applied", "read_back")}
            for name, one in audit.targets.items()
        },
        "followed": changes(audit.followed),
        "engine": changes(audit.engine),
        "came": audit.came,
        "went": audit.went,
        "variables": rows,
        "moved_without_a_path": astray,
        "versions": versions(engine),
    }
    targeted: list[tuple[object, ...]] = []
    for name, entry in audit.targets.items():
        match entry.requested:
            case Shift() | Scale():
                words = f"{entry.requested.kind} by {console.show(entry.requested.by)}"
            case Draw():
                words = f"draw from {entry.requested.source}"
            case asked:
                words = console.show(getattr(asked, "value", asked))
        applied = "at every step" if entry.applied is None else console.show(entry.applied)
        back = "-" if entry.read_back is None else console.show(entry.read_back)
        targeted.append((Text(name, style="bold"), words, applied, back))
    title = f"do() in {tag(task)} on {engine or used}, seed {seed}"
    heads = ("target", "requested", "applied", "backend reports")
    columns = 4 if is_world else 3
    rows_shown = [row[:columns] for row in targeted]
    console.table(heads[:columns], rows_shown, title=title, width=console.PAGE)
    for label, pairs in (
        ("followed at lag 0", audit.followed),
        ("backend, inertia [kg m²]", audit.engine),
    ):
        for name, (old, new) in pairs.items():
            change = f"{console.show(old, per_line=9)} -> {console.show(new, per_line=9)}"
            console.say(f"{label}: {name} {change}")
    for label, names in (("new", audit.came), ("gone", audit.went)):
        if names:
            console.say(f"{label}: {', '.join(names)}")
    descendants = [row for row in rows.values() if row["descendant"]]
    console.table(
        (
            *("descendant", "unit", "before", "right after", f"after {steps} steps"),
            *("without the do()", "difference"),
        ),
        [
            (
                Text(name, style="bold"),
                row["unit"],
                console.show(row["before"]),
                _or_same(row["right_after"], row["before"]),
                console.show(row["after"]),
                _or_same(row["without"], row["after"]),
                Text(f"{row['difference']:.3g}", style="bold" if row["difference"] else "dim"),
            )
            for name, row in rows.items()
            if row["descendant"] and (row["moved"] or show_all)
        ],
        title="What followed",
        whole=(0, 6),
        width=console.PAGE,
    )
    still = sum(not row["moved"] for row in descendants)
    line = f"{still} of {len(descendants)} descendants did not move"
    line += " (--all shows them)" if still and not show_all else ""
    if not astray:
        line += f"; none of the {len(rows) - len(descendants)} other variables moved"
    console.say(f"{line}.")
    if astray:
        wrong = f"MOVED WITHOUT A DECLARED PATH FROM A TARGET: {', '.join(astray)}."
        console.terminal().print(Text(f"{wrong} The graph is wrong.", style="bold white on red"))
    with console.staged(folder) as draft:
        if shown := _pictures(scenes):
            for name, frames in zip(PICTURES, ([shown[0]], [shown[1]], shown), strict=True):
                _write_picture(draft / name, frames)
        console.write_json(draft / "result.json", result)
    raise typer.Exit(int(bool(astray)))


def _or_same(value: Any, other: Any) -> str:
    return SAME if np.array_equal(value, other) else console.show(value)


def _pictures(scenes: Sequence[Any]) -> list[Any]:
    """Return a picture of each scene; none of systems without bodies."""
    from scm_world.backends.renderer import automatic_camera, picture
    from scm_world.backends.step import StepModel
    from scm_world.models import Model

    if not scenes or isinstance(scenes[0].structure, StepModel):
        return []
    camera = automatic_camera(*scenes) if isinstance(scenes[0].structure, Model) else None
    return [picture(scene, camera, samples=2) for scene in scenes]


def _write_picture(path: Path, frames: Sequence[Any]) -> None:
    """Write a file with one picture, or several side by side."""
    from scm_world.backends.renderer import write_png

    white = np.full((frames[0].shape[0], DIVIDER, 3), 255, dtype=np.uint8)
    strip = [part for frame in frames for part in (frame, white)]
    write_png(path, np.concatenate(strip[:-1], axis=1))


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
    show = console.show
    rows = [
        ("effect", show(found.mean), f"{show(found.low)} … {show(found.high)}"),
        ("with it", show(found.treated), ""),
        ("without", show(found.control), ""),
        ("episodes", found.rollouts, "paired" if found.paired else "unpaired"),
    ]
    if found.paired:
        rows.append(("variance unpaired : paired", show(found.variance_ratio), ""))
    title = f"{found.outcome}, {tag(task)} on {found.engine}, seed {seed}"
    console.table(("", "mean", "95 % interval"), rows, title=title)
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
    rows = [
        (
            name,
            one.first,
            f"{console.show(one.largest)} at {one.at}",
            console.show(np.abs(one.final).max(initial=0.0)),
        )
        for name, one in apart.variables.items()
    ]
    console.table(
        ("variable", "differs from", "most, and when", "at the end"),
        rows or [("nothing", "", "", "")],
        title=f"{tag(task)} on {used}, seed {seed}: intervention at control step {at}",
    )
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
        save_episode(episode, draft / "episode.npz")
        save_episode(other, draft / "counterfactual.npz")
        console.write_json(draft / "difference.json", result)
