"""The commands that collect data: ``collect``, ``sweep`` and ``triplets``."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, Literal

import numpy as np
import typer

from scm_world.cli import console, options
from scm_world.cli.arguments import (
    engine_of,
    parse_assignments,
    parse_outcome,
    parse_value,
    refused,
    tag,
)
from scm_world.runs.files import Location

POINTS = 40  # of a grid, that are printed


def collect(
    task: options.System,
    *,
    design: str = "single",
    n: options.N = 1000,
    target: options.Words = None,
    cause: options.Words = None,
    outcome: options.Outcomes = None,
    values: Annotated[Literal["A", "B", "A|B"], typer.Option(metavar="SPACE")] = "A",
    observational_fraction: Annotated[float, typer.Option(min=0.0, max=1.0)] = 0.3,
    every_step: bool = False,
    contacts: bool = False,
    picture: options.Words = None,
    picture_size: options.Count = 64,
    goal_pictures: bool = False,
    croissant: bool = False,
    shard: options.Count = 100,
    episodes: options.Varied,
    jobs: options.Jobs,
    asked: options.Asked,
) -> None:
    """Collect an interventional dataset in a folder.

    Of a causal model without a backend all variables are written down, and those with lagged edges
    have a row for each control step. After Ctrl-C (exit code 130) the same command resumes.
    Example: scm-world collect pushing --design half -n 1000 --out data

    Args:
        design: Targets of an episode: observational (none), single, all, or half of them.
        n: Number of episodes.
        target: Target of interventions, such as '*.mass'; the causes by default.
        cause: Parameter that is written down; by default physical ones with a space A.
        values: Support of interventions: A (training), B (held out) or 'A|B'.
        observational_fraction: Share of episodes without an intervention.
        every_step: A row for each control step.
        contacts: Look in each physics step which bodies touch, so that the true graph can be one of
            these rows. It takes about twice as long.
        picture: Camera of pictures beside the rows, or 'usual'.
        picture_size: Height and width of a picture in pixels.
        goal_pictures: Pictures of the goals, too.
    """
    import pandas

    from scm_world.discovery.data import Design, Pictures, default_causes
    from scm_world.discovery.data import collect as collected
    from scm_world.discovery.data.files import COUNT
    from scm_world.discovery.data.recorded import settable
    from scm_world.queries import SCM

    wanted: dict[str, Any] = {
        "causes": cause,
        "outcomes": [parse_outcome(text) for text in outcome or ()],
        "every_step": every_step,
        "contacts": contacts,
    }
    if picture:
        wanted["pictures"] = Pictures(cameras_of(picture), (picture_size,) * 2, goal_pictures)
    with asked.open(f"collect-{design}", task) as (system, folder):
        setting = wanted | episodes.setting(system)
        context = {name: value for name, value in setting.items() if value}
        if not isinstance(system, SCM):
            context["policy"] = setting["policy"]  # None: nothing acts
        patterns = target or cause
        targets = settable(system, patterns) if patterns else default_causes(system)
        designed = () if design == "observational" else tuple(targets)
        safe = f"of {-(-n // shard)} files"
        with jobs.open("episodes", folder, "shard-*.*", safe) as job:
            found = collected(
                system,
                Design(design, designed, values, observational_fraction),
                n,
                seed=asked.seed,
                shard=shard,
                **job,
                **context,
            )
    first = found.rows(np.unique(found.episode, return_index=True)[1])
    done = pandas.Series(first.targets).explode().map("do({})".format, na_action="ignore")
    counts = done.fillna("nothing done").value_counts()
    console.frame(
        counts.rename_axis("").reset_index(name="episodes"),
        title=f"Collected from {tag(task)} on {found.about.get('engine', 'equations')}, seed "
        f"{asked.seed}: {len(first)} episodes, {len(found)} rows, {len(found.columns)} columns",
    )
    if refusals := len(found.about.get("refused", ())):
        console.say(f"{refusals} episodes were refused")
    if contacts and found.truth is not None:
        acting, edges = found.acting().truth, len(found.truth.edges)
        could = len(acting.edges) if acting else 0
        console.say(f"{could} of {edges} edges could act in these rows")
        most = sorted(found.contacts.items(), key=lambda item: -item[1])
        shares = [(f"{one}, {other}", f"{share:.1%}") for (one, other), share in most]
        console.frame(pandas.DataFrame(shares, columns=["bodies that touched", "steps"]))
    _written(folder, "shard-*.*", folder / COUNT, describe=croissant)


def cameras_of(names: Iterable[str]) -> tuple[str | None, ...]:
    """Return cameras by their names; ``"usual"`` is the one of pictures for people."""
    return tuple(None if name == "usual" else name for name in names)


def _written(folder: Location, pattern: str, *files: Location, describe: bool) -> None:
    """Print some files and the first one of a pattern; describe the folder for catalogues."""
    from scm_world.discovery.data import as_huggingface

    described = [as_huggingface(folder) / "croissant.json"] if describe else []
    console.written(*files, *sorted(list[Location](folder.glob(pattern)), key=str)[:1], *described)


def triplets(
    task: options.System,
    *,
    factor: options.Words = None,
    n: options.N = 1000,
    targets: options.Count = 1,
    steps: options.NotNegative = 0,
    do: options.Pairs = None,
    camera: options.Words = None,
    size: options.Count = 64,
    shard: options.Count = 1000,
    croissant: bool = False,
    jobs: options.Jobs,
    asked: options.Asked,
) -> None:
    """Write pairs of pictures, before and after an intervention, with factors and targets.

    Example: scm-world triplets pushing --factor '*.color' --factor light_ambient -n 5000

    Args:
        factor: Variable with a space A that is drawn; '*color' by default.
        n: Number of pairs.
        targets: How many factors are drawn again in each pair.
        steps: Control steps before the pictures are taken.
        do: Further intervention in every pair.
        camera: Camera of the pictures, or 'usual'.
        size: Height and width of a picture in pixels.
        shard: Pairs in one file.
    """
    from scm_world.discovery.data import triplets as written
    from scm_world.discovery.data.recorded import settable
    from scm_world.queries import SCM

    with asked.open("triplets", task) as (plain, folder):
        if isinstance(plain, SCM):
            raise refused(task, "is not a world, so there are no pictures of it", "'SYSTEM'")
        matching = settable(plain, factor or ["*color"])
        spaces = {name: plain.model.declared(name).space("A") for name in matching}
        names = [name for name, space in spaces.items() if space is not None] or matching
        with (
            plain.given(parse_assignments(do, "'--do'")) as system,
            jobs.open("pairs", folder, "triplets-*.*", "files") as job,
        ):
            written(
                system,
                names,
                n,
                cameras=cameras_of(camera or ["usual"]),
                size=(size, size),
                targets=targets,
                steps=steps,
                seed=asked.seed,
                shard=shard,
                **job,
            )
    files = len([*folder.glob("triplets-*.*")])
    console.say(f"{n:,} pairs of pictures with {len(names)} factors, in {files} files")
    _written(folder, "triplets-*.*", describe=croissant)


def sweep(
    task: options.System,
    *,
    over: Annotated[list[str], typer.Option(metavar="NAME=VALUES")],
    outcome: options.Outcomes = None,
    n: options.N = 50,
    do: options.Pairs = None,
    shard: options.Count = 100,
    no_picture: bool = False,
    episodes: options.Varied,
    jobs: options.Jobs,
    asked: options.Asked,
) -> None:
    """Estimate outcomes over a grid of interventions (dose-response), with 95 % intervals.

    Every point has the same episodes, with the same noise. After Ctrl-C (exit code 130) the same
    command resumes.
    Example: scm-world sweep pushing --over tool_block.mass=0.02:0.08:5

    Args:
        over: LOW:HIGH:COUNT, A, B:COUNT, or values with commas.
        n: Episodes at each point.
        do: Further intervention at every point.
        no_picture: Leave out sweep.png, the picture beside the table.
    """
    import pandas

    from scm_world.discovery.data import sweep as swept
    from scm_world.discovery.data.sweeps import ENDS, PICTURE, TABLE, points_of
    from scm_world.runs.canvas import save

    grid, held = read_over(over), parse_assignments(do, "'--do'")
    measured = [parse_outcome(text) for text in outcome or ()] or None
    command = "-".join(("sweep", *grid)).replace(".", "_")
    with asked.open(command, task) as (plain, folder), plain.given(held) as system:
        engine = engine_of(system)
        safe = f"of {-(-n * len(points_of(grid, system.graph)) // shard)} files"
        with jobs.open("episodes", folder, "shard-*.*", safe) as job:
            how = {"n": n, "seed": asked.seed, "shard": shard, **episodes.setting(system), **job}
            found = swept(system, grid, measured, **how)
    rows = pandas.DataFrame(found.rows())
    table = rows.loc[:, :"n"].copy()
    for column in found.measured:
        ends = rows[[column.name + end for end in ENDS]].to_numpy(float)
        shown = (tuple(map(console.show, row)) for row in ends.tolist())
        table[column.name] = ["{} ({} … {})".format(*row) for row in shown]
    console.frame(
        table[:POINTS],
        title=f"Sweep of {tag(task)} on {engine}, seed {asked.seed}, with 95 % intervals",
        caption=f"and {len(table) - POINTS} more points" if len(table) > POINTS else "",
    )
    if not no_picture:
        save(found.picture(), folder / PICTURE)
    console.written(folder / TABLE, *([] if no_picture else [folder / PICTURE]))


def read_over(texts: Iterable[str]) -> dict[str, Any]:
    """Return which values variables take.

    Example:
        >>> read_over(["tool_block.mass=0.02:0.08:3", "floor_friction=A:4", "gravity=-9,-10"])
        {'tool_block.mass': [0.02, 0.05, 0.08], ... 'gravity': [-9, -10]}
    """
    from scm_world.discovery.data import Levels
    from scm_world.discovery.data.sweeps import check_points
    from scm_world.variables.kinds import SPACES

    def values(text: str, hint: str) -> Any:
        match [parse_value(part, hint) for part in text.split(":")]:
            case [space] | [space, int()] as given if space in SPACES:
                return Levels(*given)
            case [int() | float() as low, int() | float() as high, int() as count] if count > 0:
                check_points(count)
                return [round(x, 12) for x in np.linspace(low, high, count).tolist()]
            case [found]:
                listed = found if isinstance(found, list) else [found]
                if all(isinstance(one, int | float) for one in listed):
                    return listed
        why = "expected LOW:HIGH:COUNT, A, B:COUNT, or numbers with commas"
        raise refused(text, why, hint)

    return parse_assignments(texts, "'--over'", values)
