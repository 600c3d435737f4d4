"""The commands that recover and check causal graphs: ``discover`` and ``verify``."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from scm_world._arguments import one_of
from scm_world.cli import console, options
from scm_world.cli.arguments import (
    backend_of,
    load_system,
    load_task,
    open_system,
    refuse_settings,
    split,
    tag,
)
from scm_world.errors import UnknownOption
from scm_world.runs.files import Location

if TYPE_CHECKING:
    from scm_world.discovery.problems import TaskView
    from scm_world.queries.comparison import Comparison
    from scm_world.queries.verification import Verification

LISTED = 10  # edges
BRIEF = (
    *("shd", "shd_standardised", "f1", "precision", "recall", "auprc", "sid"),
    *("experiments", "seconds"),
)
BRIEF_MARKS = ("shd", "f1", "seconds")
"""Beside scores of edge marks, so that the table fits a terminal."""
MARKED = ("pag_distance", "adjacency_f1", "head_f1", "tail_f1", "targets")
"""Shown where some run has them."""
BACKENDS = "mujoco", "bullet"
SMALL: dict[str, tuple[str, ...]] = {
    "towers": ("number_of_blocks_in_tower=1,1,2", "tower_dims=0.035,0.035,0.07"),
    "stacked_blocks": ("num_of_levels=2", "max_level_width=0.04"),
    "creative_stacked_blocks": ("num_of_levels=2", "max_level_width=0.04"),
    "general": ("nums_objects=2",),
}
"""Two blocks, where there are more by default: what ``verify all`` verifies."""


def discover(
    task: Annotated[str, typer.Argument(metavar="SYSTEM")],
    backend: options.Backend = None,
    probes: options.Count = 32,
    seed: options.Seed = 0,
    preset: options.Preset = None,
    out: options.Out = None,
    strict: bool = False,
    option: options.Option = None,
    resolution: options.Resolution = None,
    learner: options.Text = None,
    baselines: Annotated[bool, typer.Option("--baselines/--no-baselines")] = True,
    data: options.Text = None,
    budget: str = "1000",
    seeds: options.Count = 3,
    view: str = "outcome",
    cause: options.Patterns = None,
    outcome: Annotated[list[str] | None, typer.Option(metavar="NAME")] = None,
    policy: str = "usual",
    steps: options.Steps = 25,
    sensor_noise: options.Amount = 0.005,
    timeout: options.Amount = 300.0,
    workers: options.Workers = None,
    executor: options.Executor = None,
    address: options.Address = None,
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
        strict: Exit 1 unless the declared graph is recovered, edge by edge.
        learner: Learners to benchmark, with commas; see 'scm-world list'. A custom one is
            module:function or file.py:function.
        baselines: Trivial ones beside learners from data.
        data: Of the benchmark: observational, interventional or paired, with commas; by default
            what each learner can use best.
        budget: Rows, episodes or experiments; N also runs N/8, N/4, N/2; or a,b,c.
        seeds: Number of seeds of the benchmark.
        view: Rows of a task: outcome (one per episode) or step (control step).
        cause: What varies, such as '*.mass'; repeat it for more.
        outcome: Variable that is measured; repeat it for more.
        policy: random, sweep, across, feedback or still; usual is sweep, of --view step random.
        sensor_noise: Of sensors: deviation, in halves of a range.
        timeout: Limit of a run in seconds; 0 for none.
    """
    settings = {"backend": backend, "preset": preset, "resolution": resolution}
    if learner or re.search(r":\d+$", task) or task.endswith(".json"):
        from scm_world.discovery.problems import TaskView

        chosen = TaskView(
            view=view,
            causes=tuple(cause) if cause else None,
            outcomes=tuple(outcome) if outcome else None,
            policy=policy,
            steps=steps,
            sensor_noise=sensor_noise,
            options={name: value for name, value in settings.items() if value is not None},
        )
        where = {"executor": executor, "workers": workers, "address": address}
        spent = (budget, seeds, timeout)
        named = (learner or "paired", baselines)
        _benchmark(task, named, data or "", chosen, spent, where, option or (), out)
        return

    from scm_world.discovery import discover as discovered
    from scm_world.discovery.plots import draw_graphs
    from scm_world.queries.verification import failed

    elsewhere = {"--executor": executor, "--workers": workers, "--address": address}
    for name, value in elsewhere.items():
        if value not in (None, "serial", 1):
            allowed = ("left out: discover without --learner runs in this process",)
            raise UnknownOption(name, value, allowed)
    with open_system(task, option, **settings) as system:
        about = (tag(task), backend_of(system), f"seed{seed}")
        folder = console.results_folder(
            out, "discover", *about, option=(*(option or ()), resolution or "")
        )
        with console.progress("probe states", lines=4) as tell:
            report = discovered(
                system,
                probes=probes,
                seed=seed,
                progress=tell,
                checkpoint=folder / "probes",
            )
        names = tuple(system.graph)
    report = report.model_copy(update={"arguments": tuple(option or ())})
    found, declared = set(report.found), set(report.declared)
    styles = {edge: "" if edge in declared else "bold dark_orange" for edge in found}
    console.edge_table(
        names,
        styles | dict.fromkeys(declared - found, "bold red"),
        signs={"bold dark_orange": "[+]", "bold red": "[-]"},
        title=f"Recovered graph of {report.task} ({len(found)} edges)",
        caption="[+] found but not declared   [-] declared but not found",
    )
    console.facts(report.rows())
    with console.staged(folder) as draft:
        report.save(draft / "report.json")
        draw_graphs(report, draft / "graphs.png")
    if report.probes < report.planned:
        raise typer.Exit(console.INTERRUPTED)
    raise typer.Exit(int(failed([report.outcome], strict=strict)))


def _benchmark(
    task: str,
    named: tuple[str, bool],
    data: str,
    view: TaskView,
    spent: tuple[str, int, float],
    where: dict[str, Any],
    option: Sequence[str],
    out: Location | None,
) -> None:
    """Run learners over budgets and seeds; print a table per problem."""
    from scm_world.discovery.benchmark_summary import COLUMNS, ENDS, best, size, summary, text
    from scm_world.discovery.benchmarks import benchmark, slug
    from scm_world.discovery.learners.registry import baselines as trivial
    from scm_world.discovery.learners.registry import learner as find
    from scm_world.discovery.physics import PHYSICS
    from scm_world.discovery.problems import FAMILIES
    from scm_world.policies.scripted import NAMED

    problems, learners, (budget, seeds, timeout) = split(task), split(named[0]), spent
    beside = [name for name in trivial() if named[1] and name not in learners]
    if not any(find(name).marked for name in learners):
        beside = [name for name in beside if not find(name).marked]
    if all(find(name).takes == ("paired",) for name in learners):
        beside = []  # it needs no data
    policies = (*NAMED, "still", "usual")
    one_of("policy", view.policy, policies)
    view = replace(view, policy=None) if view.policy == "still" else view
    families = (*FAMILIES, *PHYSICS)
    drawn = [n.partition(":")[0] in families or n.endswith(".json") for n in problems]
    if option:
        if drawn != [False]:
            raise UnknownOption("problem", task, ("one task, if --option is given",))
        view = replace(view, arguments=dict(load_task(problems[0], option).given))
    if not all(word.isdecimal() for word in split(budget)):
        raise UnknownOption("budget", budget, ("whole numbers with commas between them",))
    words = [*map(slug, (*problems, *learners)), "" if all(drawn) else view.view]
    folder = console.results_folder(out, "benchmark", *words, option=option)
    with (
        console.resumable(folder, "runs/*/*.json", "runs"),
        options.open_pool(**where, what="runs", lines=10) as (pool, tell),
    ):
        result = benchmark(
            [*learners, *beside],
            problems,
            [int(word) for word in split(budget)],
            seeds,
            data=split(data),
            view=view,
            timeout=timeout or None,
            out=folder,
            engine=pool,
            progress=tell,
        )
    every = summary(result)
    marks = best(every)
    for (name, oracles), whole in every.groupby(["problem", "oracle"], sort=False):
        rows = whole[~whole.learner.isin(beside) | (whole.budget == whole.budget.max())]
        there = {c.key for c in COLUMNS if c.key in rows and rows[c.key].notna().any()}
        brief = BRIEF_MARKS if "pag_distance" in there else BRIEF
        shown = [c for c in COLUMNS if c.key in brief or (c.key in MARKED and c.key in there)]
        about = size(result, name)
        for key, title in (("variance", "varsortability"), ("r2", "R²-sortability")):
            known = rows.get(f"{key}_sortability", rows.budget[:0]).dropna()
            about += f", {title} {known.iloc[0]:.2f}" if len(known) else ""
        cells = []
        for at, row in rows.iterrows():
            done = f"{row.done} of {row.seeds}"
            for end in ("timeout", "failed"):
                done += f", {row[end]} {ENDS[end]}" if row[end] else ""
            good = {key for key in marks if marks.loc[at, key]}
            numbers = (Text(text(row, c), "bold" if c.key in good else "") for c in shown)
            cells.append((row.data, row.learner, str(row.budget), done, *numbers))
        console.table(
            ("data", "learner", "budget", "done", *(column.title for column in shown)),
            cells,  # the means over seeds; the single runs are in results.csv
            title=f"{name}: {about}" + "; oracles with access to the simulator" * bool(oracles),
        )
    ended = Counter((r.learner, r.problem, r.message) for r in result.runs if r.status != "done")
    for (name, problem, reason), runs in ended.items():
        console.say(f"{name} on {problem}, not done in {runs} run(s): {' '.join(reason.split())}")
    console.written(*(folder / name for name in ("results.csv", "budget.png")))


def verify(
    task: options.Systems,
    backend: options.Backend = None,
    both: bool = False,
    probes: options.Count = 200,
    held_out: options.NotNegative = 8,
    seed: options.Seed = 0,
    preset: options.Preset = None,
    out: options.Out = None,
    strict: bool = False,
    option: options.Option = None,
    resolution: options.Resolution = None,
) -> None:
    """Check the declared causal graph of a system against its physics.

    It is confirmed (every declared edge was seen, and nothing else), not refuted (some edges were
    never seen, which is no proof of them) or refuted. Exits 1 if it is refuted. 'all' takes small
    variants of tasks with many blocks. Ctrl-C gives the result so far (exit code 130).
    Example: scm-world verify pushing --both

    Args:
        both: On MuJoCo and Bullet; compare.
        probes: Largest number of probe states.
        held_out: Further ones, in which effects without an edge are looked for.
        strict: Exit 1 unless the graph is confirmed.
    """
    from scm_world.queries import SCM, Comparison, World
    from scm_world.queries import verify as verified
    from scm_world.queries.verification import failed
    from scm_world.tasks import TASKS

    every = task == "all"
    systems = {
        name: option or (SMALL.get(name, ()) if every else ())
        for name in (TASKS if every else (task,))
    }
    loaded = {name: load_system(name, given) for name, given in systems.items()}
    first = next(iter(loaded.values()))
    used = "both" if both else backend or getattr(first, "backend", "equations")
    words = (*(option or ()), resolution or "")
    folder = console.results_folder(out, "verify", tag(task), used, f"seed{seed}", option=words)
    interrupted = False
    found: list[Verification | Comparison] = []
    for (name, given), engine in product(systems.items(), BACKENDS if both else (backend,)):
        system = loaded[name]
        settings: dict[str, Any] = {}
        if isinstance(system, SCM):
            if both and engine != BACKENDS[0]:
                continue  # it has no backend
            refuse_settings(backend=backend, preset=preset, resolution=resolution)
        else:
            settings = {"preset": preset, "resolution": resolution, "backend": engine}
        parts = [name] * every + [str(engine)] * (both and bool(settings))
        about = f"{tag(name)}: "
        try:
            with console.progress("probe states", lines=4, about=about) as tell:
                report = verified(
                    system, probes=probes, held_out=held_out, seed=seed, progress=tell, **settings
                )
            report = report.model_copy(update={"arguments": tuple(given)})
            _told(report, found, folder.joinpath(*parts))
            interrupted = report.interrupted
            last = both and engine == BACKENDS[1] and not interrupted
            if last and not isinstance(system, SCM):
                with (
                    World(system, **{**settings, "backend": BACKENDS[0]}) as world,
                    console.progress("states compared", lines=4, about=about) as tell,
                ):
                    compared = world.compare(BACKENDS[1], seed=seed, progress=tell)
                _told(compared, found, folder.joinpath(*parts[:-1], "comparison"))
        except KeyboardInterrupt:
            if not found:
                raise
            interrupted = True
        if interrupted:
            break
    if len(found) > 1:
        colors = {"confirmed": "green", "not refuted": "yellow", "refuted": "bold red"}
        rows: list[tuple[object, ...]] = []
        for one in found:
            if isinstance(one, Comparison):
                cells = ("both", one.probes, f"same sign: {100 * one.share:.1f} %", "", "")
            else:
                seen = f"{len(one.fired)} of {len(one.declared)}"
                undeclared = str(len(one.undeclared))
                cells = (one.backend, one.probes, seen, undeclared, f"{one.floor:g}")
            said = Text(one.outcome, colors[one.outcome])
            rows.append((one.task, *cells, f"{one.seconds:.1f}", said))
        heads = ("task", "backend", "probe states", "seen", "undeclared", "noise floor", "seconds")
        console.table((*heads, "outcome"), rows, title="All verifications")
    if interrupted:
        raise typer.Exit(console.INTERRUPTED)
    raise typer.Exit(int(failed([one.outcome for one in found], strict=strict)))


def _told(
    report: Verification | Comparison, found: list[Verification | Comparison], folder: Location
) -> None:
    """Print a report, write it, and add it to those that were found."""
    from scm_world.discovery.plots import draw_verification
    from scm_world.queries import Comparison

    console.say(report.title)
    console.facts(report.rows())
    console.say("")
    with console.staged(folder) as draft:
        (draft / "report.json").write_text(report.to_json())
        if not isinstance(report, Comparison):
            draw_verification(report, draft / "verify.png")
    found.append(report)
