"""Benchmarks of learners: run, interrupted, resumed, and given bad learners."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing, suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import user_learners

from scm_world import SCM, Derived, Linear
from scm_world._fingerprint import differing, fingerprint
from scm_world.discovery import BenchmarkResult, TaskView, benchmark
from scm_world.discovery.benchmarks import BenchmarkRun, run_name
from scm_world.discovery.data import load
from scm_world.discovery.problems import problem
from scm_world.errors import (
    ActionError,
    MissingExtra,
    ModelError,
    ScmWorldError,
    UnknownOption,
    UnreadableFile,
    UnwritableFolder,
)
from scm_world.graph import to_json
from scm_world.runs.processes import Worker
from scm_world.tasks.families import random_model
from scm_world.variables import Normal

pytestmark = pytest.mark.usefixtures("sketched")

SMALL: dict[str, Any] = {
    "problems": ["er2:5"],
    "learners": ["do_order", "paired"],
    "budgets": [70, 140],
    "seeds": 2,
}
"""Two learners, two budgets, two seeds, and once more standardised: 10 runs."""


def among(*names: str, **others: Any) -> dict[str, Any]:
    """Benchmark users' learners on one graph with next to no data, beside one of ours."""
    learners = [*(f"user_learners:{name}" for name in names), "paired"]
    few = {"budgets": [2], "seeds": 1, "standardised": False}
    return {"problems": ["er2:5"], "learners": learners, **few, **others}


def plain(result: BenchmarkResult) -> list[dict[str, Any]]:
    """Write the runs down without what depends on the machine."""
    runs: list[dict[str, Any]] = json.loads(json.dumps([run.as_dict() for run in result.runs]))
    for run in runs:
        run["seconds"] = 0.0
        if run["found"] is not None:
            run["found"]["seconds"] = 0.0
    return runs


def files(folder: Path) -> dict[str, int]:
    """List the runs with the instants at which they were written."""
    return {str(path): path.stat().st_mtime_ns for path in (folder / "runs").rglob("*.json")}


def by_learner(result: BenchmarkResult) -> dict[str, list[BenchmarkRun]]:
    """Sort the runs by learner."""
    found: dict[str, list[BenchmarkRun]] = {}
    for run in result.runs:
        found.setdefault(run.learner.removeprefix("user_learners:"), []).append(run)
    return found


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[BenchmarkResult, Path]:
    """Run the small benchmark once."""
    folder = tmp_path_factory.mktemp("benchmark") / "small"
    return benchmark(**SMALL, out=folder), folder


# --- numbers --------------------------------------------------------------------------------------

FAKE = {"backend": "fake"}
REFERENCES: dict[str, dict[str, Any]] = {
    "models": {
        "learners": ["do_order", "gies", "paired"],
        "problems": ["er2:6", "tanh4:5"],
        "budgets": [60, 240],
        "seeds": 2,
    },
    "outcome": {
        "learners": ["do_order", "paired"],
        "problems": ["pushing"],
        "budgets": [40, 80],
        "seeds": 1,
        "view": TaskView(
            steps=3,
            causes=("block.size", "gravity", "*friction", "tool_block.mass"),
            options=FAKE,
        ),
    },
    "step": {
        "learners": ["do_order"],
        "problems": ["pushing"],
        "budgets": [60, 120],
        "seeds": 1,
        "view": TaskView(
            "step", steps=6, causes=("gravity", "*friction", "tool_block.mass"), options=FAKE
        ),
    },
}


@pytest.mark.parametrize("name", REFERENCES)
def test_scores_are_those_of_the_reference(name: str, request: pytest.FixtureRequest) -> None:
    """The same seeds give the scores of ``benchmark_reference.csv``, to twelve digits."""
    if name != "models":  # which is done in another process
        request.getfixturevalue("in_this_process")
    with (Path(__file__).parent / "benchmark_reference.csv").open() as stream:
        lines = [line for line in csv.DictReader(stream) if line.pop("benchmark") == name]
    result = benchmark(**REFERENCES[name])
    assert len(result.runs) == len(lines)
    for record, line in zip(result.to_dataframe().to_dict("records"), lines, strict=True):
        for key, said in line.items():
            value = record.get(key)
            if key in ("problem", "learner", "data", "standardised"):
                assert str(value) == said
            else:
                value = float("nan") if value is None else value
                expected = pytest.approx(float(said or "nan"), rel=1e-12, nan_ok=True)
                assert value == expected, (key, line)


@pytest.mark.usefixtures("in_this_process")
def test_models_are_problems(tmp_path: Path) -> None:
    """An object stands beside names; two of them are told apart, and results are read again."""
    models = [random_model("er2:4", seed) for seed in (1, 2)]
    asked: dict[str, Any] = {"budgets": [40], "seeds": 1, "standardised": False}
    result = benchmark(["paired"], [*models, "er2:4"], **asked, out=tmp_path / "r")
    assert len(result.problems) == 3
    assert {run.status for run in result.runs} == {"done"}
    again = benchmark(["paired"], [*models, "er2:4"], **asked, out=tmp_path / "r")
    assert [run.key for run in again.runs] == [run.key for run in result.runs]


def test_files_that_models_name_are_copied(tmp_path: Path) -> None:
    """A folder of models works elsewhere; what lies elsewhere, or has a computed name, is said."""
    here, outside = tmp_path / "here", tmp_path / "outside.txt"
    files = {
        "mine.py": (
            "from pathlib import Path\nimport numpy as np\n"
            "from laws.linear import made\n"
            f'OUTSIDE = np.loadtxt("{outside}")\n'
            'W = float(np.loadtxt(Path(__file__).parent / "weights" / "w.txt"))\n'
            "def given():\n    return made(W)\n"
        ),
        "laws/__init__.py": "",
        "laws/linear.py": (
            "from scm_world import SCM, Derived, Exogenous, Linear\n"
            "from scm_world.variables import Normal\n"
            "from . import noise\n"
            'cause = Exogenous(name="a", distribution=Normal(), default=0.0)\n'
            "def made(w):\n    law = Linear(weights=(w,))\n    return SCM([cause, Derived("
            'name="b", parents=("a",), mechanism=law, noise=noise.NOISE)])\n'
        ),
        "laws/noise.py": "from scm_world.variables import Normal\nNOISE = Normal(0.0, 0.5)\n",
        "weights/w.txt": "3.0",
        "unused.txt": "1.0",
    }
    for name, text in files.items():
        (here / name).parent.mkdir(parents=True, exist_ok=True)
        (here / name).write_text(text)
    outside.write_text("1.0")
    asked: dict[str, Any] = {"budgets": [40], "seeds": 1, "standardised": False}
    given = f"{here / 'mine.py'}:given"
    sys.path.insert(0, str(here))
    try:
        result = benchmark(["paired"], [given], **asked, out=tmp_path / "out")
    finally:
        sys.path.remove(str(here))
    assert {run.status for run in result.runs} == {"done"}
    models = tmp_path / "out" / "models"
    (own,) = models.glob("*.py")
    copied = {path.relative_to(models).as_posix() for path in models.rglob("*.*")}
    assert copied == {own.name, *files, "README.md"} - {"mine.py", "unused.txt"}
    readme = (models / "README.md").read_text()
    assert f"`{outside}`" in readme
    assert "names that it computes" in readme
    shutil.rmtree(here)
    code = f"import {own.stem.replace('-', '_')} as m; print(m.given()['b'].mechanism.weights)"
    own.rename(own.with_stem(own.stem.replace("-", "_")))
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-B", "-c", code],
        cwd=models,
        env={"PYTHONPATH": ":".join(["", *sys.path])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "(3.0,)\n", done.stderr


@pytest.mark.usefixtures("in_this_process")
def test_a_budget_is_not_exceeded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where an episode has several rows, the last one is cut; without a folder nothing is kept."""
    monkeypatch.chdir(tmp_path)
    result = benchmark(["empty"], ["tanh4:4"], [15, 36], seeds=1, standardised=False)
    assert not list(tmp_path.iterdir())
    table = result.to_dataframe()
    assert list(table.experiments) == list(table.budget) == [15, 36]


@pytest.mark.usefixtures("in_this_process")
def test_the_order_of_declaration_is_no_hint() -> None:
    """Of a model declared in causal order, each seed permutes the columns, for every learner."""
    line = [Derived(name="a", parents=(), mechanism=Linear(weights=()), noise=Normal())]
    line += [
        Derived(name=effect, parents=(cause,), mechanism=Linear(weights=(1.0,)), noise=Normal())
        for cause, effect in pairwise("abcde")
    ]
    learners = ["user_learners:rightward", "bipartite"]
    seen = {"data": ["observational"], "standardised": False}
    result = benchmark(learners, [SCM(line)], [40], seeds=4, **seen)
    mine, theirs = ([r for r in result.runs if r.learner == name] for name in learners)
    assert all(run.found.names == tuple("abcde") for run in result.runs if run.found)
    assert np.mean([run.scores["recall"] for run in mine]) < 0.8
    assert [run.scores["shd"] for run in mine] == [run.scores["shd"] for run in theirs]


# --- what comes out -------------------------------------------------------------------------------


def test_everything_is_run_and_written(done: tuple[BenchmarkResult, Path]) -> None:
    """Every run is done, exact where it has enough; the files are there and come back."""
    result, folder = done
    assert len(result.runs) == 2 * (2 + 1 + 2)
    assert all(run.status == "done" for run in result.runs)
    assert all(run.scores["shd"] == 0 for run in by_learner(result)["paired"])
    assert set(files(folder)) == {str(folder / run_name(run)) for run in result.runs}
    for name in ("results.csv", "budget.png"):
        assert (folder / name).stat().st_size > 0
    assert not list(folder.rglob("*.part"))


def test_each_seed_has_its_own_graph(done: tuple[BenchmarkResult, Path]) -> None:
    """The result has that of the first seed; runs of each have the size of their own."""
    result, _ = done
    assert result.problems["er2:5"] == problem("er2:5", seed=0).truth
    for run in result.runs:
        assert run.scores["true_edges"] == len(random_model("er2:5", run.seed).edges)


def test_workers_change_nothing_but_seconds(
    done: tuple[BenchmarkResult, Path], tmp_path: Path
) -> None:
    """Two processes find what one finds, and progress counts every run once."""
    told: list[tuple[int, int]] = []
    result = benchmark(**SMALL, out=tmp_path, workers=2, progress=lambda *at: told.append(at))
    assert plain(result) == plain(done[0])
    assert [count for count, _ in told] == list(range(1, 11))
    assert {total for _, total in told} == {10}


@pytest.mark.usefixtures("in_this_process")
def test_a_benchmark_resumes(done: tuple[BenchmarkResult, Path]) -> None:
    """Deleted runs are run again and give the same; the others are not touched."""
    result, folder = done
    before = files(folder)
    lost = sorted(before)[::3]
    for path in lost:
        Path(path).unlink()
    assert plain(benchmark(**SMALL, out=folder)) == plain(result)
    after = files(folder)
    assert after.keys() == before.keys()
    assert {path for path in after if after[path] != before[path]} == set(lost)


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: "",
        lambda text: text[: len(text) // 2],
        lambda text: "[]",
        lambda text: text.replace('"budget": 140', '"budget": "ten"'),
        lambda text: text.replace('"status": "done"', '"status": "perhaps"'),
        lambda text: text.replace('"shd": 0', '"shd": "none"'),
        lambda text: text.replace('"shd": 0', '"shd": NaN'),
        lambda text: text.replace('"lags": 0', '"lags": -1'),
        lambda text: text.replace("scm_world/found", "scm_world/lost"),
        lambda text: text.replace('"seed": 0', '"seed": 1'),
    ],
)
def test_a_damaged_run_is_named(
    done: tuple[BenchmarkResult, Path], tmp_path: Path, damage: Callable[[str], str]
) -> None:
    """The error names the file and says what to do with it; the file is not touched."""
    folder = tmp_path / "copy"
    shutil.copytree(done[1], folder)
    path = folder / run_name(by_learner(done[0])["paired"][-2])
    damaged = damage(path.read_text())
    assert damaged != path.read_text()
    path.write_text(damaged)
    with pytest.raises(UnreadableFile, match="it is made again") as told:
        benchmark(**SMALL, out=folder)
    assert path.name in str(told.value)
    assert path.read_text() == damaged


def test_a_folder_of_another_benchmark_is_refused(done: tuple[BenchmarkResult, Path]) -> None:
    """The error names what differs."""
    before = files(done[1])
    with pytest.raises(UnreadableFile, match="another benchmark; these differ: seeds"):
        benchmark(**{**SMALL, "seeds": 3}, out=done[1])
    assert files(done[1]) == before


def test_a_folder_of_something_else_is_untouched(tmp_path: Path) -> None:
    """A folder with a file of the user's, and a file in place of a folder, are refused."""
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(UnreadableFile, match=r"something else: thesis\.txt"):
        benchmark(**SMALL, out=tmp_path)
    with pytest.raises(UnwritableFolder, match=r"thesis\.txt"):
        benchmark(**SMALL, out=tmp_path / "thesis.txt")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
    (tmp_path / "study.json").write_text("no json")
    with pytest.raises(UnreadableFile, match="a study of 'benchmark'"):
        benchmark(**SMALL, out=tmp_path)


@pytest.mark.usefixtures("in_this_process")
def test_a_changed_model_or_library_is_another_benchmark(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Results of different versions are never mixed."""
    file, out = tmp_path / "mine.json", tmp_path / "out"
    file.write_text(to_json(random_model("er2:5", 0)))
    asked: dict[str, Any] = {"budgets": [40, 41], "seeds": 1, "standardised": False}
    result = benchmark(["gies"], [str(file)], **asked, out=out)
    assert list(result.problems) == ["mine"]
    file.write_text(to_json(random_model("er2:5", 1)))
    with pytest.raises(UnreadableFile, match=r"declaration of 'x0' in .*mine\.json"):
        benchmark(["gies"], [str(file)], **asked, out=out)
    file.write_text(to_json(random_model("er2:5", 0)))
    monkeypatch.setattr("scm_world.discovery.learners.registry.Learner.version", "99")
    with pytest.raises(UnreadableFile, match=r"differ: .*learner 'gies'"):
        benchmark(["gies"], [str(file)], **asked, out=out)
    fake, real = problem("pushing", view=TaskView(options=FAKE)), problem("pushing")
    assert "engine" in differing(fingerprint(fake), fingerprint(real))


# --- bad learners ---------------------------------------------------------------------------------


def test_a_learner_that_takes_too_long_is_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its runs are noted as such; others have their time, whatever was lost before."""
    ask, limits = Worker.ask, set[tuple[str, float | None]]()

    def without_a_clock(worker: Worker, job: Any, what: str, timeout: float | None = None) -> Any:
        """Let only the learner that never returns run out of time, on a busy machine, too."""
        limits.add((what, timeout))
        never = job.run.learner.endswith("sleeper") and job.run.budget == 2
        return ask(worker, job, what, timeout=timeout if never else None)

    monkeypatch.setattr(Worker, "ask", without_a_clock)
    runs = by_learner(benchmark(**among("sleeper", timeout=0.5), out=tmp_path))
    assert limits == {("prepare", None), ("run", 0.5)}
    untargeted, late = runs["sleeper"]
    assert (late.status, late.message) == ("timeout", "stopped after 0.5 s")
    assert untargeted.message.startswith("none of 1 interventional rows is targeted")
    assert [run.status for run in runs["paired"]] == ["done", "done"]


def test_learners_that_fail_do_not_end_the_benchmark(tmp_path: Path) -> None:
    """Their runs have failed, with a reason, and are not run again; all others are done."""
    said = {
        "refuses": "2 rows of seed 0 are not to its liking",
        "confused": "KeyError: 'b'",
        "hungry": "MemoryError",
        "dies": "its process ended with exit code 3",
        "leaves": "SystemExit: 4",
        "unwritable": "cannot be written as JSON",
        "infinite": "not finite",
    }
    asked = among(*said)
    result = benchmark(**asked, out=tmp_path)
    runs = by_learner(result)
    for learner, why in said.items():
        assert [run.status for run in runs[learner]] == ["failed"] * 2
        assert why in runs[learner][1].message
    assert [run.status for run in runs["paired"]] == ["done"] * 2
    before = files(tmp_path)
    assert plain(benchmark(**asked, out=tmp_path)) == plain(result)
    assert files(tmp_path) == before


# --- what is refused beforehand -------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong",
    [
        {"learners": ("nobody",)},
        {"learners": ("user_learners:nobody",)},
        {"learners": "paired"},
        {"learners": ()},
        {"learners": ("paired", "paired")},
        {"data": ("dreams",)},
        {"data": ("interventional",)},
        {"problems": ("mars",)},
        {"problems": ("er2:1",)},
        {"problems": ("er2:five",)},
        {"problems": ()},
        {"problems": ("er2:5", "er2:5")},
        {"budgets": (0,)},
        {"budgets": (1.5,)},
        {"budgets": ()},
        {"seeds": 0},
        {"timeout": 0.0},
        {"timeout": float("nan")},
    ],
)
def test_what_does_not_exist_is_told_at_once(wrong: dict[str, Any]) -> None:
    """An unknown learner, kind of data, problem, or a number that is none."""
    with pytest.raises(UnknownOption):
        benchmark(**{**SMALL, **wrong})


def test_a_file_that_is_no_model_is_told_at_once(tmp_path: Path) -> None:
    """Missing or damaged."""
    (tmp_path / "bad.json").write_text("{}")
    for name in ("bad.json", "none.json"):
        with pytest.raises(ScmWorldError, match=name):
            benchmark(**{**SMALL, "problems": [str(tmp_path / name)]})


def test_workers_are_counted(tmp_path: Path) -> None:
    """None are too few, before anything is written."""
    with pytest.raises(UnknownOption, match="workers"):
        benchmark(**SMALL, out=tmp_path / "out", workers=0)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("view", "error"),
    [
        ({"view": "sideways"}, UnknownOption),
        ({"options": {"backend": "clay"}}, UnknownOption),
        ({"policy": "dance"}, ActionError),
        ({"causes": ("no_such_*",)}, ScmWorldError),
    ],
)
def test_a_wrong_view_is_told_before_anything_is_written(
    tmp_path: Path, view: Any, error: type[Exception]
) -> None:
    """There is no folder afterwards."""
    with pytest.raises(error):
        benchmark(["paired"], ["pushing"], view=TaskView(**view), out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_is_not_installed_is_told_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The message says how to install it."""
    monkeypatch.setattr("scm_world.discovery.learners.registry.Learner.version", None)
    with pytest.raises(MissingExtra, match=r"scm-world\[.+\]"):
        benchmark(["gies"], ["er2:5"])


# --- killed ---------------------------------------------------------------------------------------

SCRIPT = """
import sys
from scm_world.discovery import benchmark
if __name__ == "__main__":
    benchmark(sys.argv[2].split(","), ["er2:5"], budgets=[40, 60], seeds=2, standardised=False,
              timeout=None, out=sys.argv[1], workers=2)
"""


def started(out: Path, marks: Path, learners: str) -> subprocess.Popen[bytes]:
    """Start a benchmark in a process of its own."""
    marks.mkdir(exist_ok=True)
    script = marks.parent / "run_benchmark.py"
    script.write_text(SCRIPT)
    path = os.pathsep.join((str(Path(user_learners.__file__).parent), os.getcwd()))
    environment = {**os.environ, user_learners.MARK: str(marks), "PYTHONPATH": path}
    command = [sys.executable, str(script), str(out), learners]
    return subprocess.Popen(  # noqa: S603 # our own script
        command, env=environment, stderr=subprocess.PIPE
    )


def wait_for(what: Callable[[], bool], seconds: float = 60.0) -> None:
    """Wait until something is so."""
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "it did not come about"
        time.sleep(0.02)


def is_alive(pid: int) -> bool:
    """Tell whether a process runs."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def pids(marks: Path) -> set[int]:
    """List the processes in which learners worked."""
    return {int(path.name.partition("-")[0]) for path in marks.iterdir()}


needs_proc = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")


@needs_proc
def test_no_process_outlives_one_that_was_killed(tmp_path: Path) -> None:
    """A learner that would compute for ten minutes ends with the benchmark, without a word."""
    marks = tmp_path / "marks"
    process = started(tmp_path / "out", marks, "user_learners:busy")
    wait_for(lambda: len(pids(marks)) == 2)
    process.kill()
    process.communicate(timeout=60)
    wait_for(lambda: not any(map(is_alive, pids(marks))), 10.0)
    assert not list((tmp_path / "out").rglob("runs/**/*.json"))


@needs_proc
def test_a_benchmark_that_was_killed_resumes(tmp_path: Path) -> None:
    """What was written is kept, the rest is run, and nothing is half written."""
    out, marks = tmp_path / "out", tmp_path / "marks"
    learners = "user_learners:marked,paired"
    process = started(out, marks, learners)
    wait_for(lambda: len(files(out)) >= 2 if out.exists() else False)
    process.kill()
    process.communicate(timeout=60)
    wait_for(lambda: not any(map(is_alive, pids(marks))), 10.0)
    kept = files(out)
    for path in kept:
        assert json.loads(Path(path).read_text())["content"]["status"] == "done"
    again = started(out, marks, learners)
    _, said = again.communicate(timeout=120)
    assert again.returncode == 0, said.decode()
    assert len(files(out)) == 8
    assert {path: files(out)[path] for path in kept} == kept
    assert (out / "results.csv").read_text().count("done") == 8


@needs_proc
def test_ctrl_c_ends_a_benchmark_at_once(tmp_path: Path) -> None:
    """The signal comes to all processes, as from a terminal; nothing is written of what was run."""
    out, marks = tmp_path / "out", tmp_path / "marks"
    process = started(out, marks, "user_learners:sleeper")
    wait_for(lambda: len(pids(marks)) == 2)
    workers = pids(marks)
    process.send_signal(signal.SIGINT)
    for pid in workers:
        with suppress(ProcessLookupError):  # the benchmark may have ended it by now
            os.kill(pid, signal.SIGINT)
    _, said = process.communicate(timeout=20)
    assert process.returncode != 0
    assert said.decode().rstrip().endswith("KeyboardInterrupt")
    assert "SpawnProcess" not in said.decode()  # workers say nothing
    assert not any(map(is_alive, pids(marks)))
    assert files(out) == {}
    assert [path.name for path in out.iterdir()] == ["study.json"]


# --- worlds with contacts -----------------------------------------------------------------------

BALLS = """
<mujoco><option gravity="0 0 0"/><worldbody>
  <body name="a"><joint name="ax" type="slide" axis="1 0 0" damping=".3"/>
    <geom type="sphere" size=".05" mass="1"/></body>
  <body name="b" pos=".13 0 0"><joint name="bx" type="slide" axis="1 0 0" damping=".3"/>
    <geom type="sphere" size=".05" mass="1"/></body>
</worldbody><actuator>
  <motor name="au" joint="ax" ctrlrange="-3 3"/><motor name="bu" joint="bx" ctrlrange="-3 3"/>
</actuator></mujoco>
"""


@pytest.mark.usefixtures("in_this_process")
def test_a_world_with_contacts_is_scored_in_each_context(tmp_path: Path) -> None:
    """Free of contacts, a learner is no worse than a trivial answer; the folder has all of it."""
    (tmp_path / "balls.xml").write_text(BALLS)
    spaces = {"*.mass": {"a": (0.5, 1.5), "b": (1.5, 3.0)}}
    view = TaskView("step", steps=40, contacts=True, arguments={"spaces": spaces})
    result = benchmark(
        ["do_order", "all_or_nothing"],
        [str(tmp_path / "balls.xml")],
        [400, 800],
        1,
        view=view,
        standardised=False,
        out=tmp_path / "out",
    )
    assert [*result.problems] == ["balls/step", "balls/step, free", "balls/step, touching"]
    assert {run.status for run in result.runs} == {"done"}
    free, both = result.problems["balls/step, free"], result.problems["balls/step"]
    assert {*both.edges} - {*free.edges} == {*both.when["contact"]}
    scores = {(r.problem, r.learner): r.scores for r in result.runs if r.budget == 800}
    edges = {name: scores[name, "do_order"]["true_edges"] for name in result.problems}
    assert edges == {name: len(truth.edges) for name, truth in result.problems.items()}
    whole, alone = (scores[name, "all_or_nothing"] for name in (both.name, free.name))
    assert whole["f1"] > alone["f1"] + 0.1  # it says that everything acts on everything
    assert scores[free.name, "do_order"]["f1"] > alone["f1"]
    assert "recall_contact" not in scores[free.name, "do_order"]
    assert 0.0 <= scores[both.name, "do_order"]["recall_contact"] <= 1.0
    home = tmp_path / "out"
    assert result.settings["versions"]["mujoco"]
    assert [path.read_text() for path in (home / "models").iterdir()] == [BALLS]
    (data,) = (home / "data").iterdir()
    with closing(problem(str(tmp_path / "balls.xml"), view=view)) as known:
        assert load(data) == known.data("interventional", 800, 0)
    assert (home / "comparison.csv").exists()


def test_a_table_that_is_called_interventional_has_targets() -> None:
    """One in which nothing was set is refused, with what to do."""
    given = problem("springs:5", seed=0)
    with closing(given), pytest.raises(ModelError, match=r"none of 25 .* targeted: raise"):
        given.data("interventional", 25, 0)
    assert not given.data("observational", 25, 0).intervened.any()
