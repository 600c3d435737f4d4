"""Exams: run, interrupted, gone on with, and given bad learners."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import user_learners

from scm_world.discovery.exam import study as study_module
from scm_world.discovery.exam.families import model
from scm_world.discovery.exam.results import Cell, Exam, read_cell
from scm_world.discovery.exam.sittings import cell_path
from scm_world.discovery.exam.study import Study, examine
from scm_world.discovery.exam.subjects import TaskView
from scm_world.errors import ActionError, MissingExtra, ScmWorldError, UnknownOption, UnreadableFile
from scm_world.graph import to_json

SMALL = Study(("er2:5",), ("do_order", "paired"), budgets=(70, 140), seeds=2)
"""Two learners, two budgets, two seeds, and once more standardised: 10 runs."""


def among(*names: str, **others: Any) -> Study:
    """Examine users' learners on one graph with next to no data, beside one of ours."""
    learners = (*(f"user_learners:{name}" for name in names), "paired")
    return Study(("er2:5",), learners, budgets=(1,), seeds=1, standardised=False, **others)


def plain(exam: Exam) -> dict[str, Any]:
    """Write an exam down without what depends on the machine."""
    whole: dict[str, Any] = json.loads(json.dumps(exam.as_dict(), default=float))
    for cell in whole["cells"]:
        cell["seconds"] = 0.0
        if cell["found"] is not None:
            cell["found"]["seconds"] = 0.0
    return whole


def files(folder: Path) -> dict[str, int]:
    """List the cells with the instants at which they were written."""
    return {str(path): path.stat().st_mtime_ns for path in (folder / "cells").rglob("*.json")}


def by_learner(exam: Exam) -> dict[str, list[Cell]]:
    """Sort the cells by learner."""
    found: dict[str, list[Cell]] = {}
    for cell in exam.ordered:
        found.setdefault(cell.learner.removeprefix("user_learners:"), []).append(cell)
    return found


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Exam, Path]:
    """Run the small exam once."""
    folder = tmp_path_factory.mktemp("exam") / "small"
    return examine(SMALL, folder), folder


# --- what comes out -------------------------------------------------------------------------------


def test_everything_is_run_and_written(done: tuple[Exam, Path]) -> None:
    """Every run is done, exact where it has enough; the files are there and come back."""
    exam, folder = done
    assert len(exam.cells) == 2 * (2 + 1 + 2)
    assert all(cell.is_done for cell in exam.cells)
    assert all(cell.scores["shd"] == 0 for cell in by_learner(exam)["paired"])
    assert len(files(folder)) == len(exam.cells)
    for name in ("exam.json", "results.csv", "results.md", "budget.png", "report.html"):
        assert (folder / name).stat().st_size > 0
    assert not list(folder.rglob("*.part"))
    again = Exam.from_dict(json.loads((folder / "exam.json").read_text()))
    assert plain(again) == plain(exam)
    cells = [cell.as_dict() for cell in again.cells]
    for job in (job for jobs in SMALL.jobs(folder) for job in jobs):
        assert read_cell(cell_path(folder, job)).as_dict() in cells


def test_each_seed_has_its_own_graph(done: tuple[Exam, Path]) -> None:
    """The subject shows that of the first seed; the cells of the other one say which they had."""
    exam, _ = done
    assert {cell.declared is None for cell in exam.cells if cell.seed == 0} == {True}
    others = {cell.declared for cell in exam.cells if cell.seed == 1}
    assert others == {tuple(edge.key for edge in model("er2:5", 1).edges)}


def test_workers_change_nothing_but_seconds(done: tuple[Exam, Path], tmp_path: Path) -> None:
    """Two processes find what one finds, and progress counts every run once."""
    told: list[tuple[int, int]] = []
    exam = examine(SMALL, tmp_path, workers=2, progress=lambda *at: told.append(at))
    assert plain(exam) == plain(done[0])
    assert [count for count, _ in told] == list(range(1, 11))
    assert {total for _, total in told} == {10}


def test_an_exam_goes_on_where_it_was(done: tuple[Exam, Path]) -> None:
    """Deleted runs are run again and give the same; the others are not touched."""
    exam, folder = done
    before = files(folder)
    lost = sorted(before)[::3]
    for path in lost:
        Path(path).unlink()
    (folder / "exam.json").unlink()
    assert plain(examine(SMALL, folder)) == plain(exam)
    after = files(folder)
    assert after.keys() == before.keys()
    assert {path for path in after if after[path] != before[path]} == set(lost)


@pytest.mark.parametrize("text", ["", "{", '{"format": "other"}', "[]"])
def test_a_damaged_run_is_named(tmp_path: Path, text: str) -> None:
    """The message has the file, and says what to do with it."""
    study = replace(SMALL, learners=("paired",), seeds=1)
    path = cell_path(tmp_path, next(study.jobs(tmp_path))[0])
    monkey = tmp_path / "study.json"
    study_module._begun(study, tmp_path)
    assert monkey.exists()
    path.parent.mkdir(parents=True)
    path.write_text(text)
    with pytest.raises(UnreadableFile, match="run again") as told:
        examine(study, tmp_path)
    assert path.name in str(told.value)
    assert path.read_text() == text


def test_a_folder_of_another_study_is_refused(done: tuple[Exam, Path]) -> None:
    """The message names what differs."""
    before = files(done[1])
    with pytest.raises(UnreadableFile, match="another exam: seeds differ"):
        examine(replace(SMALL, seeds=3), done[1])
    assert files(done[1]) == before


def test_a_folder_of_something_else_is_untouched(tmp_path: Path) -> None:
    """A folder with a file of the user's, and a file in place of a folder, are refused."""
    (tmp_path / "thesis.txt").write_text("mine")
    for place in (tmp_path, tmp_path / "thesis.txt"):
        with pytest.raises(UnreadableFile, match="something else"):
            examine(SMALL, place)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
    (tmp_path / "study.json").write_text("no json")
    with pytest.raises(UnreadableFile, match="describes no exam"):
        examine(SMALL, tmp_path)


def test_a_model_of_ones_own_is_a_subject(tmp_path: Path) -> None:
    """A JSON file of a model is examined on, by the name of the file."""
    path = tmp_path / "mine.json"
    path.write_text(to_json(model("er2:5", 3)))
    study = Study((str(path),), ("paired",), budgets=(70, 71), seeds=1)
    exam = examine(study, tmp_path / "out")
    assert list(exam.subjects) == ["mine"]
    assert [cell.scores["shd"] for cell in exam.cells] == [0, 0]


# --- bad learners ---------------------------------------------------------------------------------


def test_a_learner_that_takes_too_long_is_stopped(tmp_path: Path) -> None:
    """Its runs are noted as such; others have their time, whatever was lost before."""
    cells = by_learner(examine(among("sleeper", timeout=0.5), tmp_path))
    assert [cell.status for cell in cells["sleeper"]] == ["timeout"]
    assert cells["sleeper"][0].message == "stopped after 0.5 s"
    assert [cell.status for cell in cells["paired"]] == ["done"]


def test_learners_that_fail_do_not_end_the_exam(tmp_path: Path) -> None:
    """Their runs have failed, with a reason, and are not run again; all others are done."""
    said = {
        "refuses": "1 rows of seed 0 are not to its liking",
        "confused": "KeyError: 'b'",
        "hungry": "MemoryError",
        "dies": "its process ended with exit code 3",
        "leaves": "its process ended with exit code 4",
    }
    study = among(*said)
    exam = examine(study, tmp_path)
    cells = by_learner(exam)
    for learner, why in said.items():
        assert [cell.status for cell in cells[learner]] == ["failed"]
        assert why in cells[learner][0].message
    assert [cell.status for cell in cells["paired"]] == ["done"]
    before = files(tmp_path)
    assert plain(examine(study, tmp_path)) == plain(exam)
    assert files(tmp_path) == before


# --- what is refused beforehand -------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong",
    [
        {"learners": ("nobody",)},
        {"learners": ("user_learners:nobody",)},
        {"learners": ()},
        {"learners": ("paired", "paired")},
        {"data": ("dreams",)},
        {"data": ("do",)},
        {"subjects": ("mars",)},
        {"subjects": ("er2:1",)},
        {"subjects": ("er2:five",)},
        {"subjects": ()},
        {"subjects": ("er2:5", "er2:5")},
        {"budgets": (0,)},
        {"budgets": (1.5,)},
        {"budgets": ()},
        {"seeds": 0},
        {"timeout": 0.0},
        {"timeout": float("nan")},
    ],
)
def test_what_does_not_exist_is_told_at_once(wrong: dict[str, Any]) -> None:
    """An unknown learner, kind of data, subject, or a number that is none."""
    with pytest.raises(UnknownOption):
        replace(SMALL, **wrong)


def test_a_file_that_is_no_model_is_told_at_once(tmp_path: Path) -> None:
    """Missing or damaged."""
    (tmp_path / "bad.json").write_text("{}")
    for name in ("bad.json", "none.json"):
        with pytest.raises(ScmWorldError, match=name):
            replace(SMALL, subjects=(str(tmp_path / name),))


def test_workers_are_counted(tmp_path: Path) -> None:
    """None are too few, before anything is written."""
    with pytest.raises(UnknownOption, match="workers"):
        examine(SMALL, tmp_path / "out", workers=0)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("view", "error"),
    [
        (TaskView("sideways"), UnknownOption),
        (TaskView(options={"backend": "clay"}), UnknownOption),
        (TaskView(policy="dance"), ActionError),
        (TaskView(causes=("no_such_*",)), ScmWorldError),
    ],
)
def test_a_wrong_view_is_told_before_anything_is_written(
    tmp_path: Path, view: Any, error: type[Exception]
) -> None:
    """There is no folder afterwards."""
    with pytest.raises(error):
        examine(replace(SMALL, subjects=("pushing",), view=view), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_is_not_installed_is_told_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The message says how to install it."""

    def nothing(package: str) -> None:
        """Pretend that no package is there."""

    monkeypatch.setattr("scm_world.discovery.learners.registry._version", nothing)
    with pytest.raises(MissingExtra, match=r"scm-world\[.+\]"):
        replace(SMALL, learners=("gies",))


# --- killed ---------------------------------------------------------------------------------------

SCRIPT = """
import sys
from scm_world.discovery.exam.study import Study, examine
if __name__ == "__main__":
    study = Study(("er2:5",), tuple(sys.argv[2].split(",")), budgets=(40, 60), seeds=2,
                  standardised=False, timeout=None)
    examine(study, sys.argv[1], workers=2)
"""


def started(out: Path, marks: Path, learners: str) -> subprocess.Popen[bytes]:
    """Start an exam in a process of its own."""
    marks.mkdir(exist_ok=True)
    script = marks.parent / "run_exam.py"
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
@pytest.mark.parametrize("learner", ["sleeper", "busy"])
def test_no_process_outlives_one_that_was_killed(tmp_path: Path, learner: str) -> None:
    """A learner that would work for ten minutes ends with the exam, without a word."""
    marks = tmp_path / "marks"
    exam = started(tmp_path / "out", marks, f"user_learners:{learner}")
    wait_for(lambda: len(pids(marks)) == 2)
    exam.kill()
    exam.communicate()
    wait_for(lambda: not any(map(is_alive, pids(marks))), 10.0)
    assert not list((tmp_path / "out").rglob("cells/**/*.json"))


@needs_proc
def test_an_exam_that_was_killed_goes_on(tmp_path: Path) -> None:
    """What was written is kept, the rest is run, and nothing is half written."""
    out, marks = tmp_path / "out", tmp_path / "marks"
    learners = "user_learners:marked,paired"
    exam = started(out, marks, learners)
    wait_for(lambda: len(files(out)) >= 2 if out.exists() else False)
    exam.kill()
    exam.communicate()
    wait_for(lambda: not any(map(is_alive, pids(marks))), 10.0)
    kept = files(out)
    for path in kept:
        read_cell(path)
    again = started(out, marks, learners)
    _, said = again.communicate(timeout=120)
    assert again.returncode == 0, said.decode()
    assert len(files(out)) == 8
    assert {path: files(out)[path] for path in kept} == kept
    whole = Exam.from_dict(json.loads((out / "exam.json").read_text()))
    assert whole.counted.endswith("8 done, 0 timed out, 0 failed")


@needs_proc
@pytest.mark.parametrize("everyone", [False, True])
def test_ctrl_c_ends_an_exam_at_once(tmp_path: Path, everyone: bool) -> None:
    """Whether the signal comes to one process or to all, nothing is written of what was run."""
    out, marks = tmp_path / "out", tmp_path / "marks"
    exam = started(out, marks, "user_learners:sleeper")
    wait_for(lambda: len(pids(marks)) == 2)
    workers = pids(marks) if everyone else ()
    exam.send_signal(signal.SIGINT)
    for pid in workers:
        with suppress(ProcessLookupError):  # the exam may have ended it by now
            os.kill(pid, signal.SIGINT)
    _, said = exam.communicate(timeout=20)
    assert exam.returncode != 0
    assert said.decode().rstrip().endswith("KeyboardInterrupt")
    assert not any(map(is_alive, pids(marks)))
    assert files(out) == {}
    assert [path.name for path in out.iterdir()] == ["study.json"]
