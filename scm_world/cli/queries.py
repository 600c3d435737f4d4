"""The commands that intervene, ``do``, ``effect`` and ``counterfactual``, and ``fit``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.text import Text

from scm_world.cli import console, options
from scm_world.cli.arguments import (
    engine_of,
    parse_assignments,
    parse_outcome,
    refuse_settings,
    tag,
)
from scm_world.errors import ScmWorldError, UnknownOption


def do(
    task: options.System,
    assignments: options.Assignments,
    *,
    steps: options.NotNegative = 25,
    space: options.Text = None,
    show_all: Annotated[bool, typer.Option("--all")] = False,
    asked: options.Asked,
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

    request = parse_assignments(assignments)
    with asked.open("do", task) as (system, folder):
        is_world = not isinstance(system, SCM)
        if not is_world:
            refuse_settings(space=space)
        found = consequences(system, request, steps=steps, seed=asked.seed, space=space)  # type: ignore[arg-type] # it checks the space
    audit, astray, steps = found.audit, found.astray, found.done.steps
    console.say(f"do() in {tag(task)} on {found.engine}, seed {asked.seed}:", audit, "")
    descendants = found.variables[found.variables["descendant"]]
    shown = descendants if show_all else descendants[descendants["moved"]]
    names = {"right_after": "right after", "after": f"after {steps} steps"}
    table = shown.drop(columns=["descendant", "moved"]).rename(columns=names)
    console.frame(table.rename_axis("descendant").reset_index(), title="What followed")
    still = len(descendants) - int(descendants["moved"].sum())
    console.say(
        f"{still} of {len(descendants)} descendants did not move"
        + " (--all shows them)" * (still > 0 and not show_all)
    )
    others = f"none of the {len(found.variables) - len(descendants)} other variables moved"
    wrong = f"MOVED WITHOUT A DECLARED PATH FROM A TARGET: {', '.join(astray)}."
    alarm = Text(f"{wrong} The graph is wrong.", style="bold white on red")
    console.say(alarm if astray else others)
    result = {
        **asked.about("do/1", task, found.engine),
        "space": space,
        "steps": steps,
        "audit": audit.targets,
        **{part: getattr(audit, part) for part in ("followed", "engine", "came", "went")},
        "variables": found.variables.to_dict("index"),
        "moved_without_a_path": astray,
    }
    with console.staged(folder) as draft:
        if is_world:
            scenes = found.plain.scene(0)[0], found.done.scene(steps)[0]
            for name, picture in zip(("before.png", "after.png"), _pictures(*scenes), strict=False):
                (draft / name).write_bytes(picture)
        console.write_json(draft / "result.json", result)
    raise typer.Exit(int(bool(astray)))


def _pictures(before: Any, after: Any) -> list[bytes]:
    """Return a PNG of each scene, from the camera of the first; none of systems without bodies."""
    from scm_world.backends.renderer import picture, png, scene_camera
    from scm_world.backends.step import StepModel

    if isinstance(before.structure, StepModel):
        return []
    camera = scene_camera(before)
    return [png(picture(scene, camera, samples=2)) for scene in (before, after)]


def effect(
    task: options.System,
    outcome: Annotated[str, typer.Argument()],
    assignments: options.Assignments,
    *,
    versus: options.Pairs = None,
    n: Annotated[int, typer.Option("-n", min=2)] = 100,
    episodes: options.Varied,
    asked: options.Asked,
) -> None:
    """Estimate the average treatment effect of an intervention, with a 95 % interval.

    Units are paired: the same noise, with and without the intervention.
    Example: scm-world effect pushing reward floor_friction=0.3 --versus floor_friction=0.5

    Args:
        outcome: A variable at the end: name, or a component: name[2]; or HOW:name with change,
            mean, max, min, sum or first.
        versus: The other intervention; none by default.
        n: Number of units.
    """
    request, other = (
        parse_assignments(assignments),
        parse_assignments(versus, "'--versus'"),
    )
    measured = parse_outcome(outcome)
    with (
        asked.open("effect", task) as (system, folder),
        console.progress("episodes") as tell,
    ):
        found = system.effect(
            measured,
            do=request,
            versus=other,
            n=n,
            progress=tell,
            seed=asked.seed,
            **episodes.setting(system),
        )
    console.say(
        f"{tag(task)} on {found.engine}, seed {asked.seed}, with its 95 % interval:",
        found,
    )
    with console.staged(folder) as draft:
        (draft / "effect.json").write_text(found.to_json() + "\n")


def counterfactual(
    task: options.System,
    assignments: options.Assignments,
    *,
    at: options.NotNegative = 0,
    episodes: options.EpisodeOptions,
    asked: options.Asked,
) -> None:
    """Run an episode, and again with an intervention and the same noise; compare them.

    Both episodes are saved.
    Example: scm-world counterfactual pushing tool_block.mass=0.1 --at 5

    Args:
        at: Control step of the intervention.
    """
    from scm_world.queries import compare, save_episode

    request = parse_assignments(assignments)
    with asked.open("counterfactual", task) as (system, folder):
        episode = system.rollout(**episodes.setting(system), seed=asked.seed)
        other = episode.counterfactual(request, at=at)
        apart, engine = compare(episode, other), engine_of(system)
    console.say(
        f"{tag(task)}, seed {asked.seed}: with the intervention at control step {at} (b), and "
        "without it (a)",
        apart,
    )
    result = {
        **asked.about("counterfactual/1", task, engine),
        "at": at,
        "steps": episode.steps,
        "variables": apart.variables.to_dict("index"),
        "contacts": apart.contacts.to_dict("records"),
    }
    with console.staged(folder) as draft:
        save_episode(episode, draft / "episode.npz")
        save_episode(other, draft / "counterfactual.npz")
        console.write_json(draft / "difference.json", result)


def fit(
    task: options.System,
    recordings: Annotated[list[str], typer.Argument(metavar="RECORDING...")],
    *,
    parameters: options.Words = None,
    noise: options.Pairs = None,
    window: options.NotNegative = 0,
    suggest: options.NotNegative = 0,
    steps: Annotated[int | None, typer.Option(min=2, show_default="the longest run's")] = None,
    limits: Annotated[list[str] | None, typer.Option(metavar="NAME=LOW,HIGH")] = None,
    do: options.Pairs = None,
    at: options.NotNegative = 0,
    run: options.NotNegative = 0,
    asked: options.Asked,
) -> None:
    """Fit parameters of a world to recordings: tables of time, commands and measurements.

    Without --parameters, each parameter is fitted alone, to find the one that accounts for the
    deviation. Exits 1 if the residuals are larger than the noise: nothing fitted explains them.
    Example: scm-world fit arm.xml run.csv --parameters "*.damping" --noise elbow.position=0.001

    Args:
        recordings: CSV, Parquet or npz files with the time in seconds, every command, and any
            states or readouts; they are fitted together.
        parameters: Fitted parameter, such as '*.damping', upper_arm.mass or delay.
        noise: Standard deviation of a measurement; estimated if there is none.
        window: Rows of a window, which begins in a fitted state; 0 for 50, or 10 where only these
            explain the recording.
        suggest: Number of further experiments that are suggested; their commands are written.
        steps: Control steps of a suggested experiment.
        limits: Range that suggested experiments keep, such as '*.velocity=-2,2', besides those of
            commands and joints.
        do: Intervention on a recorded run: what would have been measured is written.
        at: Control step of this intervention.
        run: Number of this run.
    """
    from scm_world.queries import SCM
    from scm_world.runs.canvas import save

    known, size, failed = (
        parse_assignments(noise, "'--noise'") or None,
        window or None,
        None,
    )
    ranges, request = (
        parse_assignments(limits, "'--limits'"),
        parse_assignments(do, "'--do'"),
    )
    name = "-".join(["fit", *(Path(recording).stem for recording in recordings)])
    with asked.open(name, task) as (system, folder), console.progress("fits") as tell:
        if isinstance(system, SCM):
            raise UnknownOption("system", task, ("a world: equations have no recordings",))
        given: dict[str, Any] = {"noise": known, "window": size, "progress": tell}
        if parameters:
            title, found = "", system.fit(recordings, parameters, **given)
            combinations = found.identifiable.drop(columns="parameters")
            frames = {"fit": found.table, "identifiable": combinations}
        else:
            explained = system.explain(recordings, **given)
            title, found = str(explained).partition("\n")[0], explained.fit
            frames = {"explanation": explained.table}
        other = found.counterfactual(request, at=at, run=run, seed=asked.seed) if request else None
        experiments: tuple[Any, ...] = ()
        try:
            if suggest:
                experiments = found.suggest(suggest, steps=steps, limits=ranges, seed=asked.seed)
        except ScmWorldError as error:  # the fit is printed first
            failed = error
        engine = system.engine
    console.say(f"{tag(task)}, {', '.join(recordings)}: {found.read}")
    for what, frame in frames.items():
        console.frame(_in_words(frame), title=what)
    console.say(*filter(None, (title, *found.remarks)))
    if other is not None:
        last = other.groupby("column", sort=False).tail(1)
        console.frame(last, title=f"end of run {run}, with {', '.join(do or ())} from {at} on")
    console.say(*(f"experiment {i}: {one}" for i, one in enumerate(experiments, 1)))
    result = {
        **asked.about("fit/2", task, engine),
        "recordings": recordings,
        "parameters": parameters or (),
        "noise": dict(zip((c.name for c in found.columns), found.noise, strict=True)),
        "window": size,
        **{what: frame.to_dict("records") for what, frame in frames.items()},
        "misfit": found.misfit,
        "explains": found.explains,
        "remarks": found.remarks,
        "starts": [experiment.start for experiment in experiments],
    }
    with console.staged(folder) as draft:
        found.residuals.to_csv(draft / "residuals.csv", index=False)
        for number, experiment in enumerate(experiments, 1):
            experiment.frame().to_csv(draft / f"experiment-{number}.csv", index=False)
        if other is not None:
            other.to_csv(draft / "counterfactual.csv", index=False)
        save(found.picture(), draft / "fit.png")
        console.write_json(draft / "result.json", result)
    if failed is not None:
        raise failed
    raise typer.Exit(int(not found.explains))


def _in_words(frame: Any) -> Any:
    """Return a table with shares in percent, and truths in words."""
    found = frame.replace({True: "yes", False: "no"})
    for name in found.columns.intersection(["deviation", "explained"]):
        found[name] = [
            f"{100.0 * x:+.3g} %" if np.isfinite(x) else "" for x in frame[name].round(5)
        ]
    return found
