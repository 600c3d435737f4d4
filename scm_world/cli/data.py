"""The commands that recover and check causal graphs, and those that collect data."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import typer

import scm_world as sw
from scm_world._arguments import one_of
from scm_world.cli import console, options
from scm_world.cli.options import (
    load_system,
    parse_assignments,
    parse_outcome,
    parse_value,
    refused,
    split,
    tag,
)
from scm_world.errors import UnknownOption
from scm_world.runs.canvas import save
from scm_world.runs.files import Location

if TYPE_CHECKING:
    from scm_world.discovery.problems import TaskView
    from scm_world.queries.comparison import Comparison
    from scm_world.queries.verification import Report, Verification

POINTS = 40  # of a grid, that are printed
BRIEF = (
    *("shd", "shd_standardised", "f1", "precision", "recall", "auprc", "sid", "pag_distance"),
    *("adjacency_f1", "head_f1", "tail_f1", "targets", "experiments", "seconds"),
)
"""Scores that are printed, where there are any."""
BACKENDS = "mujoco", "bullet"
SMALL: dict[str, tuple[str, ...]] = {
    "towers": ("number_of_blocks_in_tower=1,1,2", "tower_dims=0.035,0.035,0.07"),
    "stacked_blocks": ("num_of_levels=2", "max_level_width=0.04"),
    "creative_stacked_blocks": ("num_of_levels=2", "max_level_width=0.04"),
    "general": ("nums_objects=2",),
}
"""Variants with two blocks of tasks that have more: ``verify all`` takes these."""


# --- graphs ---------------------------------------------------------------------------------------


def discover(
    task: options.System,
    *,
    probes: options.Count = 32,
    at_least: options.Amount = 0.0,
    strict: bool = False,
    learner: options.Text = None,
    baselines: Annotated[bool, typer.Option("--baselines/--no-baselines")] = True,
    data: str = "",
    budget: str = "1000",
    seeds: options.Count = 3,
    view: str = "outcome",
    cause: options.Words = None,
    outcome: options.Words = None,
    policy: str = "usual",
    steps: options.Count = 25,
    sensor_noise: options.Amount = 0.005,
    contacts: bool = False,
    timeout: options.Amount = 300.0,
    jobs: options.Jobs,
    asked: options.Asked,
) -> None:
    """Recover a causal graph by experiments, and score it; or benchmark learners.

    Without --learner the one-step graph of a system is recovered by paired experiments. With it,
    and for families, learners run over budgets and seeds, and a table and a picture are
    written. Exits 1 if an effect is found that no edge declares. After Ctrl-C (exit code 130) the
    same command resumes.
    Example: scm-world discover er2:20 --learner do_order,gies

    Args:
        task: A task, a model.xml or model.urdf, or module:name; with --learner also a family with a
            size (er2:20, servo:10; er2:20:3 hides three more), the JSON file of an SCM, or several
            with commas between them.
        probes: Number of states to experiment in.
        learner: Learners to benchmark, with commas; see 'scm-world list'. A custom one is
            module:function or file.py:function.
        baselines: Trivial ones beside learners from data.
        data: observational, interventional or paired, with commas; by default all of a learner.
        budget: Rows, episodes or experiments; N also runs N/8, N/4, N/2; or a,b,c.
        seeds: Number of seeds of the benchmark.
        view: Rows of a task: outcome (one per episode) or step (control step).
        cause: Variable that varies, such as '*.mass'.
        outcome: Variable that is measured.
        policy: random, sweep, across, feedback or still; usual is sweep, of --view step random.
        sensor_noise: Of sensors: deviation, in halves of a range.
        contacts: With --learner, score rows of a world with and without contacts for themselves,
            each with the graph that acts in them.
        timeout: Limit of a run in seconds; 0 for none.
    """
    if learner or re.search(r":\d+$", task) or task.endswith(".json"):
        from scm_world.discovery.problems import TaskView
        from scm_world.policies.scripted import NAMED

        one_of("policy", policy, (*NAMED, "still", "usual"))
        rows = TaskView(
            view=view,
            causes=tuple(cause) if cause else None,
            outcomes=tuple(outcome) if outcome else None,
            policy=None if policy == "still" else policy,
            steps=steps,
            sensor_noise=sensor_noise,
            contacts=contacts,
            options=asked.settings(),
        )
        learners = split(learner or "paired")
        how = {"data": split(data), "timeout": timeout or None, "seeds": seeds}
        _benchmark(task, learners, rows, budget, how, baselines=baselines, jobs=jobs, asked=asked)
        return
    if contacts:
        allowed = ("left out: the experiments of discover without --learner record them anyway",)
        raise UnknownOption("--contacts", contacts, allowed)
    for name, value in vars(jobs).items():
        if value not in (None, "serial", 1):
            allowed = ("left out: discover without --learner runs in this process",)
            raise UnknownOption(f"--{name}", value, allowed)
    with (
        asked.open("discover", task) as (system, folder, _),
        console.progress("probe states") as tell,
    ):
        names = tuple(system.graph)
        report = sw.discover(
            system,
            probes=probes,
            seed=asked.seed,
            at_least=at_least,
            progress=tell,
            checkpoint=folder / "probes",
        )
    report = report.model_copy(update={"arguments": tuple(asked.option or ())})
    found, declared = set(report.found), set(report.declared)
    weak = report.weak(at_least)
    signs = {edge: "" if edge in declared else "[+]" for edge in found}
    signs |= dict.fromkeys(declared - found, "[-]") | dict.fromkeys(weak & declared, "[~]")
    caption = "[+] found but not declared   [-] declared but not found"
    console.edge_table(
        names,
        signs,
        title=f"Recovered graph of {report.task} ({len(found)} edges)",
        caption=caption + f"   [~] weaker than {at_least:g}" * bool(weak),
    )
    _tell(report, folder)
    _exit([report.outcome], strict=strict, interrupted=report.probes < report.planned)


def _benchmark(
    task: str,
    learners: list[str],
    view: TaskView,
    budget: str,
    how: dict[str, Any],
    *,
    baselines: bool,
    jobs: options.Jobs,
    asked: options.Asked,
) -> None:
    """Run learners over budgets and seeds; print a table per problem."""
    from scm_world.discovery.benchmark_summary import COLUMNS, size, summary, text, trivial_answers
    from scm_world.discovery.benchmarks import benchmark
    from scm_world.discovery.learners.registry import baselines as trivial
    from scm_world.discovery.learners.registry import learner as find
    from scm_world.tasks.families import FAMILIES, PHYSICS

    problems, budgets = split(task), split(budget)
    kinds = [find(name) for name in learners]
    beside = [
        name
        for name in trivial()
        if baselines
        and name not in learners
        and any(kind.takes != ("paired",) for kind in kinds)  # others need no data
        and (any(kind.marked for kind in kinds) or not find(name).marked)
    ]
    families = (*FAMILIES, *PHYSICS)
    drawn = [n.partition(":")[0] in families or n.endswith(".json") for n in problems]
    if asked.option:
        if drawn != [False]:
            raise UnknownOption("problem", ",".join(problems), ("one task, if --option is given",))
        made = load_system(problems[0], asked.option).task()
        view = replace(view, arguments=dict(made.given))
    if not all(word.isdecimal() for word in budgets):
        raise UnknownOption("budget", budget, ("whole numbers with commas between them",))
    words = "benchmark", *problems, *learners, "" if all(drawn) else view.view
    folder = console.results_folder(asked.out, *words, *(asked.option or ()))
    with jobs.open("runs", folder, "runs/*/*.json", "runs") as job:
        rows = [*map(int, budgets)]
        result = benchmark([*learners, *beside], problems, rows, view=view, **how, **job)
    for (name, oracles), whole in summary(result).groupby(["problem", "oracle"], sort=False):
        rows = whole[~whole.learner.isin(beside) | (whole.budget == whole.budget.max())]
        there = [c for c in COLUMNS if c.key in rows and rows[c.key].notna().any()]
        table = rows[["data", "learner", "budget"]].copy()  # of means over the seeds
        table["done"] = rows.done.astype(str) + " of " + rows.seeds.astype(str)
        about = size(result, name) + "; oracles with access to the simulator" * bool(oracles)
        for column in there:
            if column.key in BRIEF:
                table[column.title] = [text(row, column) for _, row in rows.iterrows()]
            elif column.key.endswith("_sortability"):
                about += f", {column.title} {rows[column.key].dropna().iloc[0]:.2f}"
        console.frame(table, title=f"{name}: {about}")
    console.say(*trivial_answers(result))
    ended = Counter((r.learner, r.problem, r.message) for r in result.runs if r.status != "done")
    for (name, problem, reason), runs in ended.items():
        console.say(f"{name} on {problem}, not done in {runs} run(s): {' '.join(reason.split())}")
    names = "results.csv", "comparison.csv", "budget.png"
    console.written(*(folder / name for name in names))


def verify(
    task: options.System,
    *,
    both: bool = False,
    probes: options.Count = 200,
    held_out: options.NotNegative = 8,
    strict: bool = False,
    asked: options.Asked,
) -> None:
    """Check the declared causal graph of a system against its physics.

    It is confirmed (every declared edge was seen, and nothing else), not refuted (some edges were
    never seen, which does not prove them) or refuted. Exits 1 if it is refuted. 'all' takes small
    variants of tasks with many blocks. Ctrl-C gives the result so far (exit code 130).
    Example: scm-world verify pushing --both

    Args:
        task: A task, a model.xml, model.urdf or model.json, module:name, or 'all'.
        both: On MuJoCo and Bullet; compare.
        probes: Largest number of probe states.
        held_out: Further ones, in which effects without an edge are looked for.
    """
    from scm_world.tasks import TASKS

    names = tuple(TASKS) if task == "all" else (task,)
    variants = {name: asked.option or SMALL.get(name, ()) * (task == "all") for name in names}
    systems = {name: load_system(name, option) for name, option in variants.items()}
    usual = systems[names[0]].backend or "equations"
    top = asked.folder("verify", task, "both" if both else asked.backend or usual)
    found: list[Verification | Comparison] = []
    interrupted = False
    try:
        for name, system in systems.items():
            folder = top / name if task == "all" else top
            settings = asked.settings(system)
            has_engine = system.backend is not None
            engines = BACKENDS if both and has_engine else (asked.backend,)
            for engine in engines:
                settings |= {"backend": engine} if has_engine else {}
                with console.progress(f"{tag(name)}: probe states") as tell:
                    how: dict[str, Any] = {"probes": probes, "held_out": held_out, **settings}
                    report = sw.verify(system, seed=asked.seed, progress=tell, **how)
                found.append(report.model_copy(update={"arguments": tuple(variants[name])}))
                _tell(found[-1], folder / str(engine) if len(engines) > 1 else folder)
                if report.interrupted:
                    raise KeyboardInterrupt
            if len(engines) > 1:
                with (
                    sw.World(system, **(settings | {"backend": BACKENDS[0]})) as world,
                    console.progress(f"{tag(name)}: states compared") as tell,
                ):
                    found.append(world.compare(BACKENDS[1], seed=asked.seed, progress=tell))
                _tell(found[-1], folder / "comparison")
    except KeyboardInterrupt:
        if not found:
            raise
        interrupted = True
    if len(found) > 1:
        console.say("All verifications:", *(one.title for one in found))
    _exit([one.outcome for one in found], strict=strict, interrupted=interrupted)


def _tell(report: Report, folder: Location) -> None:
    """Print a report, and write it, with a table of its edges."""
    console.say(report, "")
    files = {"report.json": report.to_json()}
    name = "gaps.csv" if isinstance(report, sw.queries.Comparison) else "edges.csv"
    files[name] = report.table.to_csv(index=False)
    console.write(folder, files)


def _exit(outcomes: Iterable[str], *, strict: bool, interrupted: bool) -> None:
    passed = {"confirmed"} if strict else {"confirmed", "not refuted"}
    failed = not passed.issuperset(outcomes)
    raise typer.Exit(console.INTERRUPTED if interrupted else int(failed))


# --- data -----------------------------------------------------------------------------------------


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
    shard: options.Shard = None,
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
    from scm_world.discovery.data import Design, Pictures, collect_parts, default_causes, load
    from scm_world.discovery.data.files import COUNT
    from scm_world.discovery.data.worlds import usual_shard

    wanted: dict[str, Any] = {
        "causes": cause,
        "outcomes": [parse_outcome(text) for text in outcome or ()],
        "every_step": every_step,
        "contacts": contacts,
    }
    if picture:
        wanted["pictures"] = Pictures(_cameras(picture), (picture_size,) * 2, goal_pictures)
    with asked.open(f"collect-{design}", task) as (system, folder, engine):
        setting = wanted | episodes.setting(system)
        context = {name: value for name, value in setting.items() if value}
        if system.backend is not None:
            context["policy"] = setting["policy"]  # None: nothing acts
        targets = () if design == "observational" else target or cause or default_causes(system)
        plan = Design(design, tuple(targets), values, observational_fraction)
        files = -(-n // (usual_shard(system) if shard is None else shard))
        with jobs.open("episodes", folder, "shard-*.*", f"of {files} files") as job:
            how = {"seed": asked.seed, "shard": shard, **job, **context}
            done, size, refused = Counter[str](), Counter[str](), 0
            for part in collect_parts(system, plan, n, **how):
                kinds = part.regime[np.unique(part.episode, return_index=True)[1]]
                size += Counter(episodes=len(kinds), rows=len(part))
                refused += len(part.about.get("refused", ()))
                for kind, count in Counter(kinds.tolist()).items():
                    for name in part.regimes[kind].targets or ("",):
                        done[f"do({name})" if name else "no intervention"] += count
    console.frame(
        [{"": name, "episodes": count} for name, count in done.most_common()],
        title=f"Collected from {tag(task)} on {engine}, seed {asked.seed}: {size['episodes']} "
        f"episodes, {size['rows']} rows, {len(part.columns)} columns",
    )
    if refused:
        console.say(f"{refused} episodes were refused")
    if contacts and (found := load(folder)).truth is not None:
        acting, edges = found.acting().truth, len(found.truth.edges)
        could = len(acting.edges) if acting else 0
        console.say(f"{could} of {edges} edges could act in these rows")
        most = sorted(found.contacts.items(), key=lambda item: -item[1])
        touched = [", ".join(pair) for pair, _ in most]
        shares = [f"{share:.1%}" for _, share in most]
        console.frame({"bodies that touched": touched, "steps": shares})
    _written(folder, "shard-*.*", folder / COUNT, describe=croissant)


def _cameras(names: Iterable[str]) -> tuple[str | None, ...]:
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
        shard: Pairs in one file.
    """
    from scm_world.discovery.data import triplets as written
    from scm_world.discovery.data.recorded import settable

    how: dict[str, Any] = {"n": n, "size": (size, size), "targets": targets, "steps": steps}
    with asked.open("triplets", task) as (plain, folder, _):
        if plain.backend is None:
            raise refused(task, "is not a world, so there are no pictures of it", "'SYSTEM'")
        matching = settable(plain, factor or ["*color"])
        spaces = {name: plain.model.declared(name).space("A") for name in matching}
        names = [name for name, space in spaces.items() if space is not None] or matching
        cameras = _cameras(camera or ["usual"])
        with (
            plain.given(parse_assignments(do, "'--do'")) as system,
            jobs.open("pairs", folder, "triplets-*.*", "files") as job,
        ):
            written(system, names, cameras=cameras, seed=asked.seed, shard=shard, **how, **job)
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

    grid, held = read_over(over), parse_assignments(do, "'--do'")
    measured = [parse_outcome(text) for text in outcome or ()] or None
    command = "-".join(("sweep", *grid)).replace(".", "_")
    with asked.open(command, task) as (plain, folder, engine), plain.given(held) as system:
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
    floors = ", ".join(f"{c.name} {found.floors.get(c.name, 0.0):.3g}" for c in found.measured)
    if found.floors:
        console.say(
            f"equal runs on {engine} are up to so far apart, and less is not seen: {floors}"
        )
    console.frame(
        table[:POINTS],
        title=f"Sweep of {tag(task)} on {engine}, seed {asked.seed}, with 95 % intervals",
        caption=f"and {len(table) - POINTS} more points" if len(table) > POINTS else "",
    )
    if not no_picture:
        save(found.picture(), folder / PICTURE)
    console.written(folder / TABLE, *([] if no_picture else [folder / PICTURE]))


def read_over(texts: Iterable[str]) -> dict[str, Any]:
    """Return which values variables take."""
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
