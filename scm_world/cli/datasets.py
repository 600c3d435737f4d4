"""The commands that collect data: ``collect``, ``sweep`` and ``triplets``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated, Any

import numpy as np
import typer

from scm_world._arguments import one_of
from scm_world.cli import console, options
from scm_world.cli.arguments import (
    backend_of,
    open_system,
    parse_assignments,
    parse_outcome,
    parse_value,
    policy_of,
    refused,
    tag,
)
from scm_world.runs.files import Location

Describe = Annotated[
    bool,
    typer.Option(
        "--croissant",
        help="Write README.md and croissant.json, too, by which Hugging Face and mlcroissant find "
        "the Parquet files.",
    ),
]
Size = Annotated[int, typer.Option(min=1, help="Height and width of a picture in pixels.")]
SHOWN, POINTS = 12, 40  # targets, and points of a grid, that are printed


def collect(
    task: options.System,
    design: str = "single",
    n: options.N = 1000,
    target: options.Patterns = None,
    cause: options.Patterns = None,
    outcome: options.Outcomes = None,
    values: str = "A",
    observational_fraction: Annotated[float, typer.Option(min=0.0, max=1.0)] = 0.3,
    nature: options.Nature = None,
    every_step: bool = False,
    contacts: bool = False,
    steps: options.Steps = 25,
    policy: options.Policy = None,
    backend: options.Backend = None,
    seed: options.Seed = 0,
    preset: options.Preset = None,
    picture: options.Patterns = None,
    picture_size: Size = 64,
    picture_format: str = "parquet",
    goal_pictures: bool = False,
    croissant: Describe = False,
    shard: options.Shard = 100,
    workers: options.Workers = None,
    executor: options.Executor = None,
    address: options.Address = None,
    out: options.Out = None,
    option: options.Option = None,
) -> None:
    """Collect an interventional dataset in a folder.

    Of a causal model without a backend all variables are written down, and those with lagged edges
    have a row for each control step. After Ctrl-C (exit code 130) the same command resumes.
    Example: scm-world collect pushing --design half -n 1000 --out data

    Args:
        design: Targets of an episode: observational (none), single, all, or half of them.
        n: Number of episodes.
        target: Targets of interventions, such as '*.mass'; the causes by default. Repeat it for
            more.
        cause: Parameters that are written down; by default physical ones with a space A. Repeat it
            for more.
        values: Support of interventions: A (training), B (held out) or 'A|B'.
        observational_fraction: Share of episodes without an intervention.
        every_step: A row for each control step.
        contacts: Look in each physics step which bodies touch, so that the true graph can be one of
            these rows. It takes about twice as long.
        picture: Camera of pictures beside the rows, or 'usual'; repeat it for more.
        picture_format: Format of the files with pictures: parquet or webdataset.
        goal_pictures: Pictures of the goals, too.
    """
    import pandas

    from scm_world.discovery.data import Design, Pictures, default_causes
    from scm_world.discovery.data import collect as collected
    from scm_world.discovery.data.files import COUNT
    from scm_world.discovery.data.recorded import settable
    from scm_world.queries import SCM
    from scm_world.variables.kinds import SPACES

    one_of("values", values, SPACES)
    asked: dict[str, Any] = {
        "policy": policy,
        "nature": parse_assignments(nature, "'--nature'"),
        "causes": cause,
        "outcomes": [parse_outcome(text) for text in outcome or ()],
        "every_step": every_step,
        "contacts": contacts,
    }
    if picture:
        size = picture_size, picture_size
        asked["pictures"] = Pictures(cameras_of(picture), size, goal_pictures, picture_format)
    asked = {name: value for name, value in asked.items() if value}
    with open_system(task, option, backend=backend, preset=preset) as system:
        used = backend_of(system)
        folder = console.results_folder(
            out, f"collect-{design}", tag(task), used, f"seed{seed}", option=option
        )
        if not isinstance(system, SCM):
            asked["policy"] = policy_of(policy, system)
        if not isinstance(system, SCM) or system.is_temporal:
            asked["steps"] = steps
        targets: Sequence[str] = ()
        if design != "observational":
            patterns = target or cause
            targets = settable(system, patterns) if patterns else default_causes(system)
        with (
            console.resumable(folder, "shard-*.*", f"of {-(-n // shard)} files"),
            options.open_pool(executor, workers, address, "episodes") as (pool, tell),
        ):
            found = collected(
                system,
                Design(design, tuple(targets), values, observational_fraction),
                n,
                seed=seed,
                out=folder,
                shard=shard,
                progress=tell,
                engine=pool,
                **asked,
            )
    first = found.rows(np.unique(found.episode, return_index=True)[1])
    named = {
        name: pandas.Series(some.targets).explode().map("do({})".format, na_action="ignore")
        for name, some in (("episodes", first), ("rows", found))
    }
    counts = pandas.DataFrame(
        {name: one.fillna("nothing done").value_counts() for name, one in named.items()}
    )
    rows: list[Any] = [
        ("all", len(first), len(found)),
        *counts.fillna(0).astype(int)[:SHOWN].itertuples(),
    ]
    if len(counts) > SHOWN:
        rows.append((f"and {len(counts) - SHOWN} more", "", ""))
    rows.append(("columns", "", len(found.columns)))
    if impossible := found.about.get("refused"):
        rows.append(("refused", len(impossible), ""))
    title = f"Collected from {tag(task)} on {found.about.get('engine', used)}, seed {seed}"
    console.table(("", "episodes", "rows"), rows, title=title)
    if contacts and found.truth is not None:
        acting, edges = found.acting().truth, len(found.truth.edges)
        console.say(
            f"{len(acting.edges) if acting else 0} of {edges} edges could act in these rows"
        )
        most = sorted(found.contacts.items(), key=lambda item: -item[1])[:SHOWN]
        shares = [(f"{one}, {other}", f"{share:.1%}") for (one, other), share in most]
        console.table(("bodies that touched", "steps"), shares)
    shards = list[Location](folder.glob("shard-*.*"))
    console.written(folder / COUNT, *sorted(shards, key=str)[:1], *described(folder, croissant))


def described(folder: Location, wanted: bool) -> list[Location]:
    """Describe a folder for Hugging Face if that is wanted; give the Croissant file."""
    from scm_world.discovery.data import as_huggingface

    return [as_huggingface(folder) / "croissant.json"] if wanted else []


def cameras_of(names: Iterable[str]) -> tuple[str | None, ...]:
    """Return cameras by their names; ``"usual"`` is the one of pictures for people."""
    return tuple(None if name == "usual" else name for name in names)


def triplets(
    task: options.System,
    factor: options.Patterns = None,
    n: options.N = 1000,
    targets: options.Count = 1,
    steps: options.NotNegative = 0,
    given: options.Do = None,
    camera: options.Patterns = None,
    size: Size = 64,
    backend: options.Backend = None,
    seed: options.Seed = 0,
    shard: Annotated[int, typer.Option(min=1)] = 1000,
    format_: Annotated[str, typer.Option("--format")] = "parquet",
    croissant: Describe = False,
    workers: options.Workers = None,
    executor: options.Executor = None,
    address: options.Address = None,
    out: options.Out = None,
    option: options.Option = None,
) -> None:
    """Write pairs of pictures, before and after an intervention, with factors and targets.

    Example: scm-world triplets pushing --factor '*.color' --factor light_ambient -n 5000

    Args:
        factor: Variables with a space A that are drawn; '*color' by default. Repeat it for more.
        n: Number of pairs.
        targets: How many factors are drawn again in each pair.
        steps: Control steps before the pictures are taken.
        given: Further intervention in every pair; repeat it for more.
        camera: Camera of the pictures, or 'usual'; repeat it for more.
        shard: Pairs in one file.
        format_: Format of the files: parquet or webdataset.
    """
    from scm_world.discovery.data import triplets as written
    from scm_world.discovery.data.recorded import settable
    from scm_world.queries import SCM

    folder = console.results_folder(out, "triplets", tag(task), f"seed{seed}", option=option)
    with open_system(task, option, backend=backend, preset=None) as plain:
        if isinstance(plain, SCM):
            raise refused(task, "is no world, so there are no pictures of it", "'SYSTEM'")
        free = [name for name in plain.model if plain.model.declared(name).space("A") is not None]
        asked = settable(plain, factor or ["*color"])
        names = [name for name in asked if name in free] or asked
        with (
            plain.given(parse_assignments(given, "'--do'")) as system,
            console.resumable(folder, "triplets-*.*", "files"),
            options.open_pool(executor, workers, address, "pairs") as (pool, tell),
        ):
            written(
                system,
                names,
                n,
                folder,
                cameras=cameras_of(camera or ["usual"]),
                size=(size, size),
                targets=targets,
                steps=steps,
                seed=seed,
                shard=shard,
                format=format_,
                engine=pool,
                progress=tell,
            )
    files = sorted(list[Location](folder.glob("triplets-*.*")), key=str)
    console.say(f"{n:,} pairs of pictures with {len(names)} factors, in {len(files)} files")
    console.written(*files[:1], *described(folder, croissant))


def sweep(
    task: options.System,
    over: Annotated[list[str], typer.Option(metavar="NAME=VALUES")],
    outcome: options.Outcomes = None,
    n: options.N = 50,
    do: options.Do = None,
    nature: options.Nature = None,
    steps: options.Steps = 25,
    policy: options.Policy = None,
    backend: options.Backend = None,
    seed: options.Seed = 0,
    preset: options.Preset = None,
    shard: options.Shard = 100,
    workers: options.Workers = None,
    executor: options.Executor = None,
    address: options.Address = None,
    out: options.Out = None,
    option: options.Option = None,
) -> None:
    """Estimate outcomes over a grid of interventions (dose-response), with 95 % intervals.

    Every point has the same episodes, with the same noise. After Ctrl-C (exit code 130) the same
    command resumes.
    Example: scm-world sweep pushing --over tool_block.mass=0.02:0.08:5

    Args:
        over: LOW:HIGH:COUNT, A, B:COUNT, or values with commas; repeat it for more variables.
        n: Episodes at each point.
        do: Further intervention at every point; repeat it for more.
    """
    from scm_world.discovery.data import sweep as swept
    from scm_world.discovery.data.sweeps import ENDS, TABLE, points_of

    grid, held = read_over(over), parse_assignments(do, "'--do'")
    measured = [parse_outcome(text) for text in outcome or ()] or None
    with (
        open_system(task, option, backend=backend, preset=preset) as plain,
        plain.given(held) as system,
    ):
        used = backend_of(system)
        words = "-".join(("sweep", *grid)).replace(".", "_")
        folder = console.results_folder(out, words, tag(task), used, f"seed{seed}", option=option)
        whole = -(-n * len(points_of(grid, system.graph)) // shard)
        with (
            console.resumable(folder, "shard-*.*", f"of {whole} files"),
            options.open_pool(executor, workers, address, "episodes") as (pool, tell),
        ):
            found = swept(
                system,
                grid,
                measured,
                n=n,
                steps=steps if system.graph.is_temporal else 0,
                policy=policy_of(policy, system),
                nature=parse_assignments(nature, "'--nature'"),
                seed=seed,
                out=folder,
                shard=shard,
                engine=pool,
                progress=tell,
            )
    rows, names = found.rows(), [column.name for column in found.measured]
    results = {name + end for base in names for name in (base, f"{base}.change") for end in ENDS}
    columns = [key for key in rows[0] if key not in results and key not in ("n", "refused")]

    def interval(row: Any, name: str) -> str:
        numbers = (row[name + end] for end in ENDS)
        mean, low, high = ("-" if one is None else console.show(one) for one in numbers)
        return f"{mean} ({low} … {high})"

    console.table(
        (*columns, "n", *names),
        [
            (
                *(console.show(row[key]) for key in columns),
                row["n"],
                *(interval(row, n) for n in names),
            )
            for row in rows[:POINTS]
        ],
        title=f"Sweep of {tag(task)} on {used}, seed {seed}, with 95 % intervals",
        caption=f"and {len(rows) - POINTS} more points, see {TABLE}" if len(rows) > POINTS else "",
    )
    console.written(folder / TABLE)


def read_over(texts: Iterable[str]) -> dict[str, Any]:
    """Return which values variables take.

    Raises:
        BadParameter: It cannot be read, or a variable is given twice.

    Example:
        >>> read_over(["tool_block.mass=0.02:0.08:3", "floor_friction=A:4", "gravity=-9,-10"])
        {'tool_block.mass': [0.02, 0.05, 0.08], ... 'gravity': [-9, -10]}
    """
    from scm_world.discovery.data import Levels
    from scm_world.discovery.data.sweeps import check_points
    from scm_world.variables.kinds import SPACES

    hint, found = "'--over'", dict[str, Any]()
    for text in texts:
        name, equals, values = (part.strip() for part in text.partition("="))
        if not equals or not name or not values or name in found:
            raise refused(text, "expected name=values, each name once", hint)
        first, *rest = values.split(":")
        if (first in SPACES and len(rest) == 1) or len(rest) == 2:
            if not rest[-1].isdecimal() or not int(rest[-1]):
                raise refused(rest[-1], "is no number of values", hint)
            check_points(int(rest[-1]))
        if first in SPACES and len(rest) < 2:
            found[name] = Levels(first, *map(int, rest))
            continue
        given = None if rest else parse_value(values, hint)
        if len(rest) == 2:
            low, high = (parse_value(word, hint) for word in (first, rest[0]))
            if isinstance(low, int | float) and isinstance(high, int | float):
                given = [round(x, 12) for x in np.linspace(low, high, int(rest[1])).tolist()]
        found[name] = given if isinstance(given, list) else [given]
        if not all(isinstance(one, int | float) for one in found[name]):
            why = "expected LOW:HIGH:COUNT, A, B:COUNT, or numbers with commas"
            raise refused(values, why, hint)
    return found
