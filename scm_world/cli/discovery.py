"""The commands that recover and check causal graphs: ``discover`` and ``verify``."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any

import typer

from scm_world._arguments import one_of
from scm_world.cli import console, options
from scm_world.cli.arguments import load_system, refuse_settings, split, tag
from scm_world.errors import UnknownOption
from scm_world.runs.files import Location

if TYPE_CHECKING:
    from scm_world.queries.verification import Report

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
"""Two blocks, where there are more by default: what ``verify all`` verifies."""


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
        data: observational, interventional or paired, with commas; by default what suits a learner.
        budget: Rows, episodes or experiments; N also runs N/8, N/4, N/2; or a,b,c.
        seeds: Number of seeds of the benchmark.
        view: Rows of a task: outcome (one per episode) or step (control step).
        cause: What varies, such as '*.mass'.
        outcome: Variable that is measured.
        policy: random, sweep, across, feedback or still; usual is sweep, of --view step random.
        sensor_noise: Of sensors: deviation, in halves of a range.
        timeout: Limit of a run in seconds; 0 for none.
    """
    if learner or re.search(r":\d+$", task) or task.endswith(".json"):
        from scm_world.discovery.problems import TaskView
        from scm_world.policies.scripted import NAMED

        one_of("policy", policy, (*NAMED, "still", "usual"))
        chosen = TaskView(
            view=view,
            causes=tuple(cause) if cause else None,
            outcomes=tuple(outcome) if outcome else None,
            policy=None if policy == "still" else policy,
            steps=steps,
            sensor_noise=sensor_noise,
            options={name: value for name, value in asked.settings.items() if value is not None},
        )
        learners = split(learner or "paired")
        how = {"data": split(data), "view": chosen, "timeout": timeout or None, "seeds": seeds}
        _benchmark(split(task), learners, budget, how, baselines=baselines, jobs=jobs, asked=asked)
        return

    from scm_world.discovery import discover as discovered

    for name, value in vars(jobs).items():
        if value not in (None, "serial", 1):
            allowed = ("left out: discover without --learner runs in this process",)
            raise UnknownOption(f"--{name}", value, allowed)
    with (
        asked.open("discover", task) as (system, folder),
        console.progress("probe states") as tell,
    ):
        names = tuple(system.graph)
        report = discovered(
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
    problems: list[str],
    learners: list[str],
    budget: str,
    how: dict[str, Any],
    *,
    baselines: bool,
    jobs: options.Jobs,
    asked: options.Asked,
) -> None:
    """Run learners over budgets and seeds; print a table per problem."""
    from scm_world.discovery.benchmark_summary import COLUMNS, size, summary, text
    from scm_world.discovery.benchmarks import benchmark
    from scm_world.discovery.learners.registry import baselines as trivial
    from scm_world.discovery.learners.registry import learner as find
    from scm_world.discovery.physics import PHYSICS
    from scm_world.discovery.problems import FAMILIES

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
            given = ",".join(problems)
            raise UnknownOption("problem", given, ("one task, if --option is given",))
        made = load_system(problems[0], asked.option, is_task=True)
        how["view"] = replace(how["view"], arguments=dict(made.given))
    if not all(word.isdecimal() for word in split(budget)):
        raise UnknownOption("budget", budget, ("whole numbers with commas between them",))
    words = "benchmark", *problems, *learners, "" if all(drawn) else how["view"].view
    folder = console.results_folder(asked.out, *words, *(asked.option or ()))
    with jobs.open("runs", folder, "runs/*/*.json", "runs") as job:
        budgets = [*map(int, split(budget))]
        result = benchmark([*learners, *beside], problems, budgets, **how, **job)
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
    ended = Counter((r.learner, r.problem, r.message) for r in result.runs if r.status != "done")
    for (name, problem, reason), runs in ended.items():
        console.say(f"{name} on {problem}, not done in {runs} run(s): {' '.join(reason.split())}")
    console.written(*(folder / name for name in ("results.csv", "budget.png")))


def verify(
    task: Annotated[str, typer.Argument(metavar="SYSTEM")],
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
    from scm_world.queries import SCM, World
    from scm_world.queries import verify as verified
    from scm_world.tasks import TASKS

    names = tuple(TASKS) if task == "all" else (task,)
    variants = {name: asked.option or SMALL.get(name, ()) * (task == "all") for name in names}
    systems = {name: load_system(name, option) for name, option in variants.items()}
    first = systems[names[0]]
    used = "both" if both else asked.backend or str(getattr(first, "backend", "equations"))
    top = asked.folder("verify", task, used)
    found: list[Any] = []
    interrupted = False
    try:
        for name, system in systems.items():
            folder = top / name if task == "all" else top
            settings: dict[str, Any] = {} if isinstance(system, SCM) else asked.settings
            if not settings:
                refuse_settings(**asked.settings)
            engines = BACKENDS if both and settings else (asked.backend,)
            for engine in engines:
                settings |= {"backend": engine} if settings else {}
                with console.progress(f"{tag(name)}: probe states") as tell:
                    how: dict[str, Any] = {
                        "held_out": held_out,
                        "seed": asked.seed,
                        "progress": tell,
                    }
                    report = verified(system, probes=probes, **how, **settings)
                found.append(report.model_copy(update={"arguments": tuple(variants[name])}))
                _tell(found[-1], folder / str(engine) if len(engines) > 1 else folder)
                if report.interrupted:
                    raise KeyboardInterrupt
            if len(engines) > 1:
                with (
                    World(system, **(settings | {"backend": BACKENDS[0]})) as world,
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
    with console.staged(folder) as draft:
        (draft / "report.json").write_text(report.to_json())
        if hasattr(report, "table"):  # a comparison of backends has no edges
            report.table.to_csv(draft / "edges.csv", index=False)


def _exit(outcomes: list[Any], *, strict: bool, interrupted: bool) -> None:
    passed = {"confirmed"} if strict else {"confirmed", "not refuted"}
    raise typer.Exit(console.INTERRUPTED if interrupted else int(not {*outcomes} <= passed))
