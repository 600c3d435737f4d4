"""Jobs in this process and in others: every result once, whatever happens to the processes."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import pytest
from run_samples import Adder, Task, do, pids, tries

from scm_world.errors import ActionError, EngineFailure, MissingExtra, UnknownOption
from scm_world.runs.pool import TRIES, Pool, pool_of
from scm_world.runs.processes import THREADS, Worker, cores


@pytest.fixture(autouse=True)
def _spawned(monkeypatch: pytest.MonkeyPatch) -> None:
    """Start processes as users do, not from one that has imported the package."""
    monkeypatch.setattr("scm_world.runs.processes.multiprocessing", multiprocessing)


def wait_for(what: Callable[[], Any], seconds: float = 60.0) -> None:
    """Wait until something is so."""
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "it did not come about"
        time.sleep(0.01)


def is_alive(pid: int) -> bool:
    """Tell whether a process runs."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


needs_proc = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")

# --- results --------------------------------------------------------------------------------------


def test_results_do_not_depend_on_engine_and_workers() -> None:
    """To the last bit: in this process, and in two others with one thread each."""
    jobs = [Task(number, "product") for number in range(5)]
    with Pool() as here, Pool(workers=2) as others:
        assert dict(here.run(do, jobs)) == dict(others.run(do, jobs))
        threads = next(others.run(do, [Task(0, "threads")]))
    assert threads == (0, dict.fromkeys(THREADS, "1"))


def test_each_result_belongs_to_its_job() -> None:
    """Each comes once, and there may be more jobs than workers, or none."""
    jobs = [Task(number) for number in range(40)]
    with Pool("process", 2) as pool:
        for given in (jobs[::-1], []):
            found = sorted(pool.run(do, given))
            assert found == [(place, job.number**2) for place, job in enumerate(given)]


def test_work_remembers_in_its_process() -> None:
    """It is sent to each process once, and stays there."""
    with Pool("process", 1) as pool:
        found = [result for _, result in pool.run(Adder(), [1, 2, 3])]
    assert [total for _, total in found] == [1, 3, 6]
    assert len({pid for pid, _ in found} - {os.getpid()}) == 1


def test_this_process_needs_no_pickle() -> None:
    """Functions without a name are done in their order."""
    with Pool() as pool:
        pool.check("anything", lambda: 0)
        assert list(pool.run(lambda job: job(), [lambda: "a", lambda: "b"])) == [(0, "a"), (1, "b")]


# --- killed ---------------------------------------------------------------------------------------


def test_a_killed_worker_is_replaced(tmp_path: Path) -> None:
    """What was being done is done again; everything is in the results once."""
    jobs = [Task(number, folder=tmp_path) for number in range(8)]
    jobs[3] = Task(3, "sleep once", tmp_path)

    def kill() -> None:
        wait_for(lambda: tries(tmp_path).get(3))
        os.kill(pids(tmp_path, 3)[0], signal.SIGKILL)

    with Pool("process", 2) as pool:
        killer = threading.Thread(target=kill)
        killer.start()
        found = sorted(pool.run(do, jobs))
        killer.join()
    assert found == [(number, number**2) for number in range(8)]
    assert tries(tmp_path) == {number: 1 + (number == 3) for number in range(8)}


@pytest.mark.parametrize("how", ["die", "leave"])
def test_a_job_that_always_ends_its_process_is_put_aside(tmp_path: Path, how: str) -> None:
    """After three tries, and the others are done; the error says which one it is."""
    jobs = [Task(0, how, tmp_path), *(Task(number) for number in range(1, 9))]
    found: dict[int, int] = {}
    with Pool("process", 2) as pool:
        with pytest.raises(EngineFailure, match=f"tried {TRIES} times") as caught:
            found.update(pool.run(do, jobs))
        assert list(pool.run(do, [Task(3)])) == [(0, 9)]
    assert caught.value.__notes__[0].startswith("in job 0, Task(number=0")
    assert found == {number: number**2 for number in range(1, 9)}
    assert tries(tmp_path) == {0: TRIES}


# --- errors ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ["serial", "process"])
def test_an_error_of_a_job_waits_for_the_others(engine: str) -> None:
    """With class and attributes and the name of the job, when all that can be done is done."""
    jobs = [Task(7, "refuse"), Task(1), Task(8, "refuse"), Task(2)]
    found: dict[int, int] = {}
    with Pool(engine) as pool, pytest.raises(ActionError, match="no 7") as caught:
        found.update(pool.run(do, jobs))
    assert found == {1: 1, 3: 4}
    assert caught.value.action == 7
    first, second, last = caught.value.__notes__[-3:]
    assert first.startswith("in job 0, Task(")
    assert second.startswith("so did job 2, Task(")
    assert second.endswith("ActionError: no 8")
    assert last == "2 of 4 jobs are done"


def test_many_errors_are_listed_in_short() -> None:
    """Five beside the first one, and how many more there are."""
    with Pool() as pool, pytest.raises(ActionError, match="no 0") as caught:
        list(pool.run(do, [Task(number, "refuse") for number in range(9)]))
    notes = caught.value.__notes__
    assert [note.split(",")[0] for note in notes[1:6]] == [f"so did job {n}" for n in range(1, 6)]
    assert notes[6:] == ["and 3 more", "0 of 9 jobs are done"]


def test_what_cannot_travel_back_is_an_error_of_its_job() -> None:
    """An error that cannot be read again, and a result that cannot be pickled."""
    found: dict[int, int] = {}
    with Pool("process", 1) as pool, pytest.raises(EngineFailure, match="this and that") as caught:
        found.update(pool.run(do, [Task(0, "fuss"), Task(1, "secret"), Task(2)]))
    assert found == {2: 4}
    assert "lambda" in caught.value.__notes__[-2]


def test_what_cannot_be_sent_is_refused_before_anything_starts(tmp_path: Path) -> None:
    """The work as well as a job."""
    pool, jobs = Pool(workers=2), [Task(0, folder=tmp_path), lambda: 0]
    with pytest.raises(UnknownOption, match="work cannot be <function"):
        pool.run(lambda job: job, jobs)
    with pytest.raises(UnknownOption, match=r"job 1 cannot be .* a function or class of"):
        pool.run(do, jobs)  # type: ignore[arg-type] # the second one is none
    assert not list(tmp_path.iterdir())


UNGUARDED = """
from scm_world.runs.pool import Pool
with Pool(workers=2) as pool:
    list(pool.run(abs, range(50)))
"""


def test_a_main_file_without_a_guard_is_told(tmp_path: Path) -> None:
    """With what has to be done."""
    script = tmp_path / "run.py"
    script.write_text(UNGUARDED)
    done = subprocess.run(  # noqa: S603 # our own
        [sys.executable, str(script)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert """under 'if __name__ == "__main__":'""" in done.stderr


# --- which ----------------------------------------------------------------------------------------


def test_pools_are_chosen_by_name_or_by_workers() -> None:
    """One worker is this process, several are others."""
    assert Pool().where == Pool(workers=1).where == Pool("serial", 1).where == "in this process"
    both = {Pool(workers=3).where, Pool("process", workers=3).where}
    assert both == {"in 3 processes of this machine"}
    assert Pool("process").workers == cores() >= 1
    assert Pool("process", workers=1).where == "in 1 process of this machine"


@pytest.mark.parametrize(
    ("engine", "workers", "said"),
    [
        (
            "dask",
            None,
            "executor cannot be 'dask'; it can be: serial, process, ray",
        ),
        (3, None, "executor"),
        ("ray://here:1", None, "executor"),
        ("here:there", None, "executor"),
        ("serial", 2, "workers of the executor 'serial' cannot be 2"),
        (None, 0, "workers cannot be 0"),
        ("process", True, "workers cannot be True"),
        ("process", 1.5, "workers cannot be 1.5"),
    ],
)
def test_what_does_not_fit_is_refused(engine: Any, workers: Any, said: str) -> None:
    """With what there is."""
    with pytest.raises(UnknownOption, match=said):
        Pool(engine, workers)


def test_a_pool_that_is_given_has_its_workers() -> None:
    """It is used as it is."""
    with Pool() as pool, pool_of(pool) as same:
        assert same is pool
        with pytest.raises(UnknownOption, match="has its own"), pool_of(pool, 2):
            pass


def test_ray_is_an_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without it, the error says how it is installed."""
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtra, match=r"scm-world\[cloud\]"):
        Pool("ray")


# --- ended ----------------------------------------------------------------------------------------


@needs_proc
def test_who_stops_reading_ends_the_processes(tmp_path: Path) -> None:
    """Those that are at work as well."""
    with Pool("process", 2) as pool:
        for found in pool.run(do, [Task(0), Task(1, "sleep", tmp_path)]):
            assert found == (0, 0)
            wait_for(lambda: pids(tmp_path))
            break
        wait_for(lambda: not any(map(is_alive, pids(tmp_path))))
        assert list(pool.run(do, [Task(2)])) == [(0, 4)]


SCRIPT = """
import sys
from pathlib import Path
from run_samples import Task, do
from scm_world.runs.pool import Pool
if __name__ == "__main__":
    with Pool("process", 2) as pool:
        list(pool.run(do, [Task(number, "sleep", Path(sys.argv[1])) for number in range(4)]))
"""


@needs_proc
@pytest.mark.parametrize("signal_", [signal.SIGINT, signal.SIGKILL])
def test_no_process_outlives_the_one_that_reads(tmp_path: Path, signal_: signal.Signals) -> None:
    """Neither Ctrl-C nor ``kill -9`` leaves workers behind, and they say nothing."""
    script, marks = tmp_path / "run_pool.py", tmp_path / "marks"
    script.write_text(SCRIPT)
    marks.mkdir()
    paths = os.pathsep.join((str(Path(__file__).parent), os.getcwd()))
    process = subprocess.Popen(  # noqa: S603 # our own script
        [sys.executable, str(script), str(marks)],
        env={**os.environ, "PYTHONPATH": paths},
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    wait_for(lambda: len(pids(marks)) == 2)
    if signal_ == signal.SIGINT:
        os.killpg(process.pid, signal_)  # as a terminal does: all of them
    else:
        process.kill()
    _, said = process.communicate(timeout=30)
    wait_for(lambda: not any(map(is_alive, pids(marks))), 10.0)
    assert ("KeyboardInterrupt" in said.decode()) == (signal_ == signal.SIGINT)
    assert "SpawnProcess" not in said.decode()
    assert tries(marks) == {0: 1, 1: 1}


# --- one that can be ended ------------------------------------------------------------------------


def test_a_worker_is_ended_after_a_time(tmp_path: Path) -> None:
    """When it is asked again, another one answers; so it is after one that ended by itself."""
    worker = Worker(do)
    with pytest.raises(TimeoutError):
        worker.ask(Task(0, "sleep", tmp_path), timeout=2.0)
    assert not any(map(is_alive, pids(tmp_path)))
    with pytest.raises(BrokenProcessPool):
        worker.ask(Task(0, "die"))
    assert worker.ask(Task(3)) == 9
    with pytest.raises(ActionError, match="no 5"):
        worker.ask(Task(5, "refuse"))
    worker.close()


def test_a_worker_ends_with_the_question_that_is_interrupted() -> None:
    """Ctrl-C, while it works."""
    worker = Worker(do)
    with pytest.raises(KeyboardInterrupt):
        worker.ask(Task(0, "press Ctrl-C"))
    assert worker.ask(Task(2)) == 4
    worker.close()
