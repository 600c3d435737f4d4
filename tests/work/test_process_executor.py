"""A bag of jobs: every result once, whatever happens to the processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from work_samples import Task, make, no_bench

from scm_world.errors import ActionError, EngineFailure, UnknownOption
from scm_world.work.executors import TRIES, Processes


def wait_for(what: Callable[[], Any], seconds: float = 60.0) -> None:
    """Wait until something is so."""
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "it did not come about"
        time.sleep(0.01)


def tries(folder: Path) -> dict[int, int]:
    """Count how often each job was begun, by its number."""
    numbers = [int(path.name.split("-")[1]) for path in folder.glob("try-*")]
    return {number: numbers.count(number) for number in numbers}


def pids(folder: Path) -> set[int]:
    """List the processes that began a job."""
    return {int(path.name.split("-")[3]) for path in folder.glob("try-*")}


def is_alive(pid: int) -> bool:
    """Tell whether a process runs."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


needs_proc = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")


@pytest.fixture(scope="module")
def pool() -> Iterator[Processes]:
    """Two processes for all that does not end them."""
    with Processes(2) as made:
        yield made


# --- results --------------------------------------------------------------------------------------


def test_the_order_of_jobs_does_not_matter(pool: Processes) -> None:
    """Each result belongs to its job, each comes once, and there may be more jobs than workers."""
    jobs = [Task(number) for number in range(40)]
    for given in (jobs, jobs[::-1]):
        found = sorted(pool.run(make, given))
        assert found == [(place, job.number**2) for place, job in enumerate(given)]


def test_no_job_is_no_result(pool: Processes) -> None:
    """And no process."""
    assert list(pool.run(make, [])) == []


def test_each_worker_is_made_once(tmp_path: Path) -> None:
    """However many jobs and runs there are."""
    maker = partial(make, tmp_path)
    with Processes(2) as pool:
        for _ in range(2):
            assert len(list(pool.run(maker, [Task(number) for number in range(12)]))) == 12
    made = [int(path.name.split("-")[1]) for path in tmp_path.iterdir()]
    assert len(made) == len(set(made)) == 2
    assert os.getpid() not in made


# --- killed ---------------------------------------------------------------------------------------


def test_a_killed_worker_is_replaced(tmp_path: Path) -> None:
    """Its job is done by another one, and is in the results once; no other is done twice."""
    jobs = [Task(number, folder=tmp_path) for number in range(8)]
    jobs[3] = Task(3, "sleep once", tmp_path)
    with Processes(2) as pool:

        def kill() -> None:
            wait_for(lambda: tries(tmp_path).get(3))
            (path,) = tmp_path.glob("try-3-*")
            os.kill(int(path.name.split("-")[3]), signal.SIGKILL)

        killer = threading.Thread(target=kill)
        killer.start()
        found = sorted(pool.run(make, jobs))
        killer.join()
    assert found == [(number, number**2) for number in range(8)]
    assert tries(tmp_path) == {number: 1 + (number == 3) for number in range(8)}


def test_a_worker_that_was_killed_at_rest_is_replaced(tmp_path: Path) -> None:
    """The next jobs are done at the first try."""
    with Processes(1) as pool:
        list(pool.run(make, [Task(0, folder=tmp_path)]))
        (pid,) = pids(tmp_path)
        os.kill(pid, signal.SIGKILL)
        wait_for(lambda: pool._workers[0].has_ended)
        assert list(pool.run(make, [Task(1, folder=tmp_path)])) == [(0, 1)]
    assert tries(tmp_path) == {0: 1, 1: 1}


def test_a_job_that_always_kills_is_put_aside(tmp_path: Path) -> None:
    """After three tries, and the others are done; the error has its number and what it is."""
    jobs = [Task(0, "die", tmp_path), *(Task(number) for number in range(1, 9))]
    found: dict[int, int] = {}
    with Processes(2) as pool:
        with pytest.raises(EngineFailure) as caught:
            found.update(pool.run(make, jobs[:1]))
        with pytest.raises(EngineFailure, match="job 0"):
            found.update(pool.run(make, jobs))
        assert list(pool.run(make, [Task(3)])) == [(0, 9)]
    said = str(caught.value)
    assert said.startswith("job 0, Task(")
    assert said.endswith("was tried 3 times, and then its process ended with exit code -9")
    assert found == {number: number**2 for number in range(1, 9)}
    assert tries(tmp_path) == {0: 2 * TRIES}


# --- errors ---------------------------------------------------------------------------------------


def test_an_error_of_a_job_waits_for_the_others() -> None:
    """With class and attributes and the name of the job, when all that can be done is done."""
    jobs = [Task(7, "refuse"), Task(1), Task(8, "refuse"), Task(2)]
    found: dict[int, int] = {}
    with Processes(2) as pool:
        with pytest.raises(ActionError, match="no 7") as caught:
            found.update(pool.run(make, jobs))
        assert list(pool.run(make, [Task(3)])) == [(0, 9)]
    assert found == {1: 1, 3: 4}
    assert caught.value.action == 7
    first, second, last = caught.value.__notes__
    assert first.startswith("in job 0, Task(")
    assert second.startswith("so did job 2, Task(")
    assert second.endswith("ActionError: no 8")
    assert last == "2 of 4 jobs are done"


def test_an_error_of_make_ends_it_at_once(tmp_path: Path) -> None:
    """As it is: nothing can do any job."""
    made: Any = no_bench
    with Processes(1) as pool, pytest.raises(ActionError, match="there is no room") as caught:
        list(pool.run(made, [Task(number, folder=tmp_path) for number in range(9)]))
    assert not hasattr(caught.value, "__notes__")


def test_what_cannot_be_sent_is_refused_before_anything_starts(tmp_path: Path) -> None:
    """What makes workers at once, a job before any is begun."""
    with pytest.raises(UnknownOption, match="make cannot be <function"):
        Processes(2).run(lambda: len, [])
    with Processes(2) as pool:
        jobs: list[Any] = [Task(0, folder=tmp_path), lambda: 0]
        with pytest.raises(UnknownOption, match=r"job 1 cannot be .* a function or class of"):
            pool.run(make, jobs)
        assert not any(worker._process for worker in pool._workers)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("workers", [0, 1.5, True])
def test_workers_are_counted(workers: Any) -> None:
    """None are too few."""
    with pytest.raises(UnknownOption, match="workers"):
        Processes(workers)


# --- ended ----------------------------------------------------------------------------------------


def test_results_are_read_one_run_after_another(tmp_path: Path) -> None:
    """A second run is refused while the first goes on; one that was closed does not just end."""
    jobs = [Task(number, folder=tmp_path) for number in range(4)]
    with Processes(1) as pool:
        first = pool.run(make, jobs)
        assert next(first) == (0, 0)
        with pytest.raises(EngineFailure, match="at work"):
            next(pool.run(make, jobs))
        pool.close()
        with pytest.raises(EngineFailure, match="was closed"):
            next(first)
        assert len(list(pool.run(make, jobs))) == 4


@needs_proc
def test_who_stops_reading_ends_the_processes(tmp_path: Path) -> None:
    """Those that are at work as well; so does the end of the block."""
    with Processes(2) as pool:
        for found in pool.run(make, [Task(0), Task(1, "sleep", tmp_path)]):
            assert found == (0, 0)
            wait_for(lambda: pids(tmp_path))
            break
        wait_for(lambda: not any(map(is_alive, pids(tmp_path))))
        list(pool.run(make, [Task(2, folder=tmp_path)]))
    assert len(pids(tmp_path)) == 2
    assert not any(map(is_alive, pids(tmp_path)))


SCRIPT = """
import sys
from pathlib import Path
from scm_world.work.executors import Processes
from work_samples import Task, make
if __name__ == "__main__":
    with Processes(2) as pool:
        list(pool.run(make, [Task(number, "sleep", Path(sys.argv[1])) for number in range(4)]))
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
    assert said.decode().count("Traceback") == (signal_ == signal.SIGINT)
    assert tries(marks) == {0: 1, 1: 1}
