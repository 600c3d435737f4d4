"""Benchmarks of learners: every learner on every problem, over budgets and seeds."""

from __future__ import annotations

import hashlib
import json
import math
import re
import time
from collections.abc import Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, cast, final

import numpy as np
from pydantic import FiniteFloat, PlainValidator, TypeAdapter

from scm_world._arguments import typed, whole_number
from scm_world._fingerprint import fingerprint
from scm_world.discovery.data import Dataset, save
from scm_world.discovery.learners.found import EstimatedGraph
from scm_world.discovery.learners.registry import SOURCES, Learner, Source, learn, learner
from scm_world.discovery.metrics import MARKS, evaluate, sortability
from scm_world.discovery.problems import (
    GroundTruth,
    Problem,
    TaskView,
    problem,
    problem_label,
    refuse_untargeted,
)
from scm_world.errors import (
    EngineFailure,
    MissingExtra,
    ModelError,
    UnknownOption,
    in_one_line,
)
from scm_world.graph import SCM, to_json
from scm_world.queries.equations import as_given
from scm_world.queries.experiments.versions import versions
from scm_world.queries.progress import Progress
from scm_world.runs.canvas import save as save_picture
from scm_world.runs.cluster import RAY
from scm_world.runs.files import Location, located, read_bytes, write_whole
from scm_world.runs.pool import Pool, pool_of
from scm_world.runs.processes import PROCESS, Worker
from scm_world.runs.study import Study
from scm_world.tasks.sources import FILES
from scm_world.world import CausalSystem

README = """The files of models that the problems name, and the files that these name. Not here:
"""
LARGE = 2**26
"""Largest file that is copied with a model file that names it [bytes]."""
_NAMES = re.compile(r"""["']([^"'\n\0]{1,200})["']|^\s*(?:from|import)\b(.*)$""", re.MULTILINE)
"""Text in quotes, and the rest of a line that imports."""
SHARES = (8, 4, 2, 1)
"""A single budget N is spent as N/8, N/4, N/2 and N, so that there is a curve."""
LONGEST = 1e6  # [s] of one wait
CONTEXTS = ("", "free", "touching")
"""All rows of a world; those in which no edge by contact can act; those in which one can."""
GRAPHS = ("found", "scores")
"""Fields of a run that a table leaves out."""

# --- results --------------------------------------------------------------------------------------


@final
@dataclass(frozen=True, kw_only=True)
class BenchmarkRun:
    """One learner on one problem with one budget and one seed.

    Attributes:
        problem: Name of the problem in tables.
        learner: Name of the learner.
        data: ``"observational"``, ``"interventional"`` or ``"paired"``.
        budget: How many rows, episodes or experiments it might use.
        seed: Seed of the model (in a family), the data and the learner.
        standardised: Whether every column had mean 0 and deviation 1.
        status: ``"done"``, ``"timeout"`` or ``"failed"``.
        message: Why it was not done.
        found: The estimated graph; None unless it was done.
        scores: By name; None for one that does not exist here.
        seconds: Wall time of the learner [s].
        experiments: How many it used.
        bound: Fewest that can do in theory, if known.
    """

    problem: str
    learner: str
    data: Source
    budget: int
    seed: int
    standardised: bool = False
    status: Literal["done", "timeout", "failed"] = "done"
    message: str = ""
    found: Annotated[
        EstimatedGraph | None, PlainValidator(lambda v: v and EstimatedGraph.from_dict(v))
    ] = None
    scores: dict[str, int | FiniteFloat | None] = field(default_factory=dict)
    seconds: float = 0.0
    experiments: int = 0
    bound: int | None = None

    @property
    def key(self) -> tuple[str, str, str, bool, int, int]:
        """The problem, learner, data, standardisation, budget and seed."""
        return self.problem, self.learner, self.data, self.standardised, self.budget, self.seed

    def as_dict(self) -> dict[str, Any]:
        """Return plain data."""
        plain = {f.name: getattr(self, f.name) for f in fields(self)}
        return {**plain, "found": None if self.found is None else self.found.as_dict()}


_RUN = TypeAdapter(BenchmarkRun)


@final
@typed
@dataclass(frozen=True)
class BenchmarkResult:
    """All runs of a benchmark.

    Attributes:
        problems: The true graphs by name; of a family, that of seed 0. Each seed draws its own:
            ``problem(name, seed=run.seed).truth``.
        runs: By problem, learner, data, budget and seed.
        settings: The arguments, and the versions of all libraries.

    Raises:
        ModelError: A run has no problem, or there are two of one kind.
    """

    problems: dict[str, GroundTruth]
    runs: tuple[BenchmarkRun, ...]
    settings: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check and sort the runs."""
        place = {name: number for number, name in enumerate(self.problems)}
        lost = sorted({run.problem for run in self.runs} - set(place))
        wrong = [f"a run of {name!r}, which is not a problem" for name in lost]
        if len({run.key for run in self.runs}) < len(self.runs):
            wrong.append("two runs of one problem, learner, data, budget and seed")
        if wrong:
            raise ModelError(wrong)
        ordered = sorted(self.runs, key=lambda run: (place[run.problem], run.key))
        object.__setattr__(self, "runs", tuple(ordered))

    def to_dataframe(self) -> Any:
        """Return a ``pandas.DataFrame`` with a row per run: its settings, status, costs, scores."""
        import pandas

        names = [f.name for f in fields(BenchmarkRun) if f.name not in GRAPHS]
        rows = [{**{n: getattr(run, n) for n in names}, **run.scores} for run in self.runs]
        scores = dict.fromkeys(name for run in self.runs for name in run.scores)
        return pandas.DataFrame(rows, columns=[*names, *scores])

    def write(self, folder: Location | str) -> None:
        """Write ``results.csv``, ``comparison.csv`` and a picture, ``budget.png``."""
        from scm_world.discovery.benchmark_summary import comparison, draw_budgets

        home = located(folder)
        write_whole(home / "results.csv", self.to_dataframe().convert_dtypes().to_csv(index=False))
        write_whole(home / "comparison.csv", comparison(self).to_csv(index=False))
        save_picture(draw_budgets(self), home / "budget.png")


def _as_json(plain: object) -> str:
    """Write JSON; numbers of numpy are numbers, and numbers that are not finite are refused."""

    def number(value: object) -> Any:
        if isinstance(value, np.generic | np.ndarray):
            return value.tolist()
        raise TypeError(f"{type(value).__name__} cannot be written as JSON: {value!r}")

    return json.dumps(plain, indent=1, allow_nan=False, default=number) + "\n"


# --- the benchmark --------------------------------------------------------------------------------


@typed
def benchmark(
    learners: Sequence[str],
    problems: Sequence[str | SCM | CausalSystem],
    budgets: Sequence[int] = (1000,),
    seeds: int = 3,
    *,
    data: Sequence[str] = (),
    view: TaskView | None = None,
    timeout: float | None = 300.0,
    standardised: bool = True,
    out: Location | str | None = None,
    workers: int | None = None,
    engine: Pool | str | None = None,
    progress: Progress | None = None,
) -> BenchmarkResult:
    """Run learners on problems and score the estimated graphs.

    With ``out`` every run is a separate file, written whole or not at all. A benchmark that was
    interrupted or killed resumes with the same call: at most the unfinished runs are lost.

    Args:
        learners: Names, or ``"module:attribute"`` of custom ones; ``baselines()`` belong beside
            every learner from data, and use the kinds of data that the others use.
        problems: Names, models, or worlds of equations, as ``problem`` takes them.
        budgets: How many rows, episodes or experiments a learner may use; a single one is also
            divided by 2, 4 and 8.
        seeds: How many: models, data and learners are drawn again with each.
        data: Kinds of data; the richest kind of each learner if empty.
        view: Of tasks and worlds.
        timeout: Limit of a run [s]; None for no limit.
        standardised: Whether the largest budget is also run on standardised data.
        out: Folder or URL: new, empty, or one of the same benchmark. Nothing is written if None.
        workers: How many runs are done at the same time; the graphs do not depend on it. None is
            one; with an engine it is as many as there are cores.
        engine: ``"serial"``, ``"process"``, ``"ray"``, the address of a cluster, or a ``Pool``. A
            run has a separate process on all of them, which ends at the timeout. Each worker
            collects the data of a problem for itself.
        progress: Called with (done, planned) after each run.

    Returns:
        All runs and scores. In ``out`` also ``results.csv``, ``comparison.csv``, ``budget.png``,
        the files of ``models``, and the ``data`` that worlds gave learners, unless Ray does the
        work.

    Raises:
        UnknownOption: Something does not exist, or a learner cannot use a kind of data.
        MissingExtra: A learner is not installed.
        UnreadableFile: The folder is one of another benchmark, a file in it is damaged, or another
            process is writing to it.
        ScmWorldError: A problem cannot be made, or data cannot be collected or written.

    Example:
        >>> result = benchmark(["paired"], ["er2:4"], budgets=[40, 80], seeds=1)
        >>> [run.scores["shd"] for run in result.runs]
        [0, 0]
    """
    view = view or TaskView()
    givens: list[str | SCM] = [*map(as_given, problems)]
    shown = [problem_label(one, view) for one in givens]
    _check_names(problems=shown, learners=learners, data=data)
    if timeout is not None and not 0.0 < timeout < math.inf:
        raise UnknownOption("timeout", timeout, ("seconds, more than 0", "None"))
    whole_number("seeds", seeds, least=1)
    spent = sorted({whole_number("budget", budget, least=1) for budget in budgets})
    if not spent:
        raise UnknownOption("budgets", budgets, ("one or more",))
    if len(spent) == 1:
        spent = sorted({max(1, spent[0] // share) for share in SHARES})
    chosen = {name: learner(name) for name in learners}
    kinds = {name: _kinds(one, data) for name, one in chosen.items()}
    of_others = {k for name, found in kinds.items() if not chosen[name].baseline for k in found}
    beside: list[Source] = [kind for kind in SOURCES if kind in of_others and kind != "paired"]
    if beside and not data:  # baselines use the data of the learners
        kinds |= {name: beside for name, one in chosen.items() if one.baseline}
    parts: dict[str, Any] = {f"learner {n!r}": (one, one.version) for n, one in chosen.items()}
    truths: dict[str, GroundTruth] = {}
    contexts, engines = dict[str, tuple[str, ...]](), dict[str, str]()
    named = [label if isinstance(p, SCM) else p for p, label in zip(givens, shown, strict=True)]
    for given, name, label in zip(givens, named, shown, strict=True):
        with closing(problem(given, view=view)) as known:
            by_contact = view.contacts and known.truth.when.get("contact")
            contexts[label] = CONTEXTS if by_contact else CONTEXTS[:1]
            for context in contexts[label]:
                true = known.truth.during("set") if context == "free" else known.truth
                truths[in_context(label, context)] = replace(true, name=in_context(label, context))
            engines |= versions(getattr(known.system, "engine", ""))
            parts |= {f"{part} in {name}": made for part, made in known.__fingerprint__().items()}
    asked = {
        "problems": named,
        "learners": learners,
        "data": data,
        "budgets": spent,
        "seeds": seeds,
        "view": asdict(view),
        "timeout": timeout,
        "standardised": standardised,
    }
    settings = json.loads(
        json.dumps({**asked, "versions": engines, "fingerprint": fingerprint(parts)})
    )
    marked = any(one.marked and not one.baseline for one in chosen.values())
    marked = marked or any(truth.confounded for truth in truths.values())
    cells = {}
    for (given, label), seed in product(zip(givens, shown, strict=True), range(seeds)):
        kept = set[Source]()
        for context, who in product(contexts[label], learners):
            name = in_context(label, context)
            for kind, n, even in product(kinds[who], spent, (False, True)):
                rows = kind != "paired"
                if (context and not rows) or (
                    even and not (rows and standardised and n == spent[-1])
                ):
                    continue
                run = BenchmarkRun(
                    problem=name, learner=who, data=kind, budget=n, seed=seed, standardised=even
                )
                first = kind not in kept
                kept.add(kind)
                cells[run_name(run)] = _Job(
                    given, run, spent[-1], view, marked, label, context, first
                )
    runs = []
    with (
        pool_of(engine, workers) as pool,
        Study(out, "benchmark", settings) as study,
        closing(_Isolated(timeout, None if pool.engine == RAY else study.folder)) as make,
    ):
        if study.folder is not None:
            _write_models(study.folder / "models", givens, shown)
        for _, run in study.map(
            cells,
            make,
            read=_RUN.validate_json,
            write=lambda run: _as_json(run.as_dict()).encode(),
            pool=pool,
            progress=progress,
        ):
            runs.append(run)
        result = BenchmarkResult(truths, tuple(runs), settings)
        if study.folder is not None:
            result.write(study.folder)
        return result


def in_context(label: str, context: str) -> str:
    """Return the name of a problem in one of the ``CONTEXTS``."""
    return f"{label}, {context}" if context else label


def _write_models(folder: Location, givens: Sequence[str | SCM], shown: Sequence[str]) -> None:
    """Copy the files that problems name, and write models that were given as objects.

    Files that these name are copied, too; a README lists those that are not.
    """
    missing: list[str] = []
    for given, label in zip(givens, shown, strict=True):
        if isinstance(given, SCM):
            with suppress(ModelError):  # functions without a name
                write_whole(folder / f"{slug(label)}.json", to_json(given))
            continue
        home, _, _ = given.rpartition(".py:")
        path = Path(f"{home}.py" if home else given)  # file.py:function
        if path.suffix in (*FILES, ".json", ".py"):
            write_whole(folder / f"{slug(label)}{path.suffix}", read_bytes(path))
            for file, name in _named_in(path).items():
                if name and file.stat().st_size <= LARGE:
                    write_whole(folder / name, read_bytes(file))
                else:
                    missing.append(f"- `{file}`, which `{path.name}` names")
            if path.suffix == ".py":
                missing.append(f"- what `{path.name}` loads by names that it computes, if anything")
    if missing:
        write_whole(folder / "README.md", "\n".join([README, *missing, ""]))


def _named_in(path: Path) -> dict[Path, str]:
    """Return the files that a model file names in quotes or imports, and those that these name.

    Each has its name below the folder of the model file; an empty one if it lies elsewhere.
    """
    home, found = path.parent.resolve(), [path.resolve()]
    for file in found:  # it grows
        is_text = file.suffix in (*FILES, ".py")
        named = _NAMES.findall(read_bytes(file).decode("utf-8", "replace") if is_text else "")
        words = [quoted for quoted, _ in named if quoted] + ["__init__.py"] * bool(named)
        for module in (one for _, rest in named for one in re.findall(r"[\w.]+", rest)):
            stem = module.strip(".").replace(".", "/")
            words += [stem, f"{stem}.py"]
        roots = [home, file.parent]
        roots += [root / word for word in words for root in roots if (root / word).is_dir()]
        there = ((root / word).resolve() for word in words for root in roots)
        found += [one for one in dict.fromkeys(there) if one.is_file() and one not in found]
    inside = (str(one.relative_to(home)) if one.is_relative_to(home) else "" for one in found)
    return dict([*zip(found, inside, strict=True)][1:])


def _check_names(**given: Sequence[str]) -> None:
    for what, names in given.items():
        if isinstance(names, str) or not (names or what == "data"):
            raise UnknownOption(what, names or "none", ("a list of one or more",))
        if len(set(names)) < len(names):
            raise UnknownOption(what, ", ".join(names), ("names, each of them once",))


def _kinds(chosen: Learner, wanted: Sequence[str]) -> list[Source]:
    """Return the kinds of data for a learner, by default the richest that it takes."""
    if not chosen.is_installed:
        raise MissingExtra(chosen.package, chosen.extra)
    given: list[Source] = [kind for kind in SOURCES if kind in wanted]
    for kind in wanted:
        if kind not in SOURCES:
            raise UnknownOption("kind of data", kind, SOURCES)
        watches = kind == "interventional" and "observational" in chosen.takes
        if kind not in chosen.takes and not watches:
            raise UnknownOption(f"data for {chosen.name}", kind, chosen.takes)
    return given or [chosen.takes[-1]]


# --- runs -----------------------------------------------------------------------------------------


@final
@dataclass(frozen=True)
class _Job:
    """A learner on a problem: the run without its results, and the data that it needs.

    Attributes:
        name: Name of the problem, or its model.
        run: The run.
        collected: The largest budget.
        view: Of tasks and worlds.
        marked: Whether edge marks are scored.
        label: Name of the problem in tables, in all contexts.
        context: One of ``CONTEXTS``.
        saves: Whether the data are written, as this is the first run with them.
    """

    name: str | SCM
    run: BenchmarkRun
    collected: int
    view: TaskView
    marked: bool
    label: str
    context: str
    saves: bool


def slug(name: str) -> str:
    """Return a file name for a name, another one for each."""
    plain = re.sub(r"[^A-Za-z0-9.-]", "_", name)
    mark = hashlib.sha256(name.encode()).hexdigest()[:4]
    return plain if plain == name else f"{plain}-{mark}"


def run_name(run: BenchmarkRun) -> str:
    """Return the name of the file of a run, below the folder of the benchmark."""
    even = "-standardised" if run.standardised else ""
    name = f"{slug(run.learner)}-{run.data}-{run.budget}-seed{run.seed}{even}.json"
    return f"runs/{slug(run.problem)}/{name}"


@final
class _Isolated:
    """Runs jobs in a separate process, which is replaced if one takes longer than the timeout."""

    def __init__(self, timeout: float | None, folder: Location | None = None) -> None:
        self._timeout = None if timeout is None else min(timeout, LONGEST)
        self._worker = Worker(_Runner(folder))
        self.close = self._worker.close

    def __call__(self, job: _Job) -> BenchmarkRun:
        """Do a job; a learner that ends its process has failed."""
        try:
            self._worker.ask(job, "prepare")  # the time of a learner is that of learning
        except BrokenProcessPool as ended:
            raise EngineFailure(f"{job.name}: {ended}", PROCESS) from None
        try:
            done: BenchmarkRun = self._worker.ask(job, "run", timeout=self._timeout)
        except TimeoutError:
            said = f"stopped after {self._timeout:g} s"
            return replace(
                job.run, status="timeout", message=said, seconds=float(self._timeout or 0.0)
            )
        except BrokenProcessPool as ended:
            return replace(job.run, status="failed", message=str(ended))
        return done


@final
class _Runner:
    """Does jobs one after another, and keeps the last problem and its data for the next one."""

    def __init__(self, folder: Location | None = None) -> None:
        self._folder = folder
        self._key: tuple[Any, ...] = ()
        self._problem: Problem | None = None
        self._data: dict[str, Dataset] = {}

    def __call__(self, job: _Job, what: str) -> BenchmarkRun | None:
        """Prepare a job: make the problem and collect its data, unless that is done; or run it.

        A failure of the learner is recorded in the run.
        """
        if what == "run":
            started = time.perf_counter()
            try:
                done = self._learned(job.run, job.context, marked=job.marked)
                _as_json(done.as_dict())  # a run that cannot be written has failed
            except MissingExtra:
                raise
            except (Exception, SystemExit) as error:  # custom learners may raise anything
                seconds, said = time.perf_counter() - started, in_one_line(error)
                return replace(job.run, status="failed", message=said, seconds=seconds)
            return done
        run, key = job.run, (job.label, str(job.name), job.run.seed, repr(job.view))
        if self._problem is None or key != self._key:
            if self._problem is not None:
                self._problem.close()
            self._problem = problem(job.name, seed=run.seed, view=job.view)
            self._key, self._data = key, {}
        if run.data != "paired" and run.data not in self._data:
            self._data[run.data] = table = self._problem.data(run.data, job.collected, run.seed)
            if job.saves and self._folder and not isinstance(self._problem.system, SCM):
                place = self._folder / "data" / f"{slug(job.label)}-{run.data}-seed{run.seed}"
                if not place.exists():
                    save(table, place)
        return None

    def _learned(self, run: BenchmarkRun, context: str, *, marked: bool) -> BenchmarkRun:
        table, made = None, cast(Problem, self._problem)
        truth, chosen = made.truth, learner(run.learner)
        if run.data != "paired":
            part = self._data[run.data].rows(slice(run.budget))
            if context:
                part, truth = rows_in(part, truth, context)
            if run.data == "interventional":
                refuse_untargeted(part)
            table = part.standardised() if run.standardised else part
        if table is None:
            found = learn(chosen, made.simulator(run.seed), seed=run.seed, budget=run.budget)
        else:
            found = learn(chosen, table, seed=run.seed)
        compared = evaluate(found, truth, marks=marked).as_dict()
        numbers = {k: v for k, v in compared.items() if isinstance(v, int | float | None)}
        scores: dict[str, Any] = {
            "true_edges": len(truth.edges),
            "confounded": len(truth.confounded),
        }
        missed, by_contact = {*compared["missed"]}, {*truth.when.get("contact", ())}
        for name, edges in (("contact", by_contact), ("always", {*truth.edges} - by_contact)):
            if edges and by_contact:
                scores[f"recall_{name}"] = 1.0 - len(missed & edges) / len(edges)
        if found.marks is None:  # a partial ancestral graph does not estimate a directed one
            scores |= {k: v for k, v in numbers.items() if k not in MARKS}
        if marked or found.marks is not None:
            scores |= {k: numbers[k] for k in MARKS}
        if table is not None and found.targets:
            there = [k for k in np.unique(table.regime) if table.regimes[k].targets]
            right = [set(found.targets[k]) == set(table.regimes[k].targets) for k in there]
            scores["targets"] = float(np.mean(right))
        rows = None if table is None else table.observational
        if rows is not None and len(rows) > len(truth.names) and {*truth.names} <= {*rows.names}:
            known = sortability(rows.select(truth.names), truth.edges)
            scores |= {f"{k}_sortability": v for k, v in known.items() if math.isfinite(v)}
        return replace(
            run,
            found=found.restricted(truth.names),
            scores=scores,
            seconds=found.seconds,
            experiments=found.experiments
            // (2 if context and made.rows > 1 else 1),  # pairs of rows
            bound=found.bound,
        )


def rows_in(table: Dataset, truth: GroundTruth, context: str) -> tuple[Dataset, GroundTruth]:
    """Return the rows of a context, and the graph that acts in them.

    Where rows are control steps, each one comes with the one before, as an episode of two rows:
    the step before it lies in this context.

    Raises:
        ModelError: There are no such rows.
    """
    there = table.touching() == (context == "touching")
    if table.is_temporal:
        there[1:] &= (np.diff(table.episode) == 0) & (np.diff(table.step) == 1)
        there[0] = False
    after = np.flatnonzero(there)
    if not after.size:
        raise ModelError([f"no row of {len(table)} is {context}: raise the budget"])
    acting = truth.for_rows(table.rows(after))
    if not table.is_temporal:
        return table.rows(after), acting
    places, pair = np.stack([after - 1, after], axis=1).ravel(), np.arange(2 * len(after))
    parts: dict[str, Any] = {n: getattr(table, n)[places] for n in ("values", "regime")}
    return replace(table, **parts, episode=pair // 2, step=pair % 2), acting
