"""Real Ray on this machine: workers are killed, nothing is lost and nothing comes twice."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from run_samples import Task, do, pids

from scm_world.errors import EngineFailure, UnknownOption
from scm_world.runs.pool import Pool
from scm_world.runs.processes import TRIES

pytest.importorskip("ray")


@pytest.fixture(scope="module")
def ray() -> Iterator[Pool]:
    """Two workers for all of them."""
    with Pool("ray", workers=2) as made:
        yield made


def test_ray_gives_the_same_bits(ray: Pool) -> None:
    """As this process has; functions without a name are sent, too, and it says where it works."""
    jobs = [Task(number, "product") for number in range(5)]
    assert dict(ray.run(do, jobs)) == dict(Pool().run(do, jobs))
    assert list(ray.run(do, [])) == []
    assert [*ray.run(lambda job: job + 1, [41])] == [(0, 42)]
    assert ray.where.startswith("on Ray at ")
    assert ray.where.endswith(", 2 workers on 1 node")


def test_a_killed_worker_of_ray_costs_its_job(ray: Pool, tmp_path: Path) -> None:
    """SIGKILL in the middle: it is done by another one, and no other is done twice."""
    jobs = [Task(number, folder=tmp_path) for number in range(8)]
    jobs[3] = Task(3, "sleep once", tmp_path)

    def kill() -> None:
        while not pids(tmp_path, 3):
            time.sleep(0.01)
        os.kill(pids(tmp_path, 3)[0], signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    found = sorted(ray.run(do, jobs))
    killer.join()
    assert found == [(number, number**2) for number in range(8)]
    assert [len(pids(tmp_path, number)) for number in range(8)] == [1, 1, 1, 2, 1, 1, 1, 1]


def test_poison_jobs_are_put_aside(ray: Pool, tmp_path: Path) -> None:
    """One that kills its workers and one that fails: the others are done before they are told."""
    jobs = [Task(0, "die", tmp_path), Task(1, "refuse"), *(Task(n) for n in range(2, 8))]
    found: dict[int, int] = {}
    with pytest.raises(EngineFailure, match=f"tried {TRIES} times") as caught:
        found.update(ray.run(do, jobs))
    assert found == {number: number**2 for number in range(2, 8)}
    assert len(pids(tmp_path, 0)) == TRIES
    assert "so did job 1" in caught.value.__notes__[1]


def test_what_cannot_be_sent_to_ray_is_refused(ray: Pool) -> None:
    """Before anything is begun."""
    with pytest.raises(UnknownOption, match="job 1 cannot be"):
        ray.run(do, [Task(0), threading.Lock()])  # type: ignore[arg-type] # it is none
    with pytest.raises(UnknownOption, match="policy cannot be"):
        ray.check("policy", threading.Lock())


def test_who_stops_reading_ends_the_work_on_ray(ray: Pool, tmp_path: Path) -> None:
    """And the pool does other work then."""
    first = ray.run(do, [Task(0), Task(1, "sleep", tmp_path)])
    assert next(first) == (0, 0)
    first.close()
    assert sorted(ray.run(do, [Task(2), Task(3)])) == [(0, 4), (1, 9)]


def test_a_connection_is_shared(ray: Pool) -> None:
    """Another pool uses it, and leaves it open when it ends; it cannot go elsewhere."""
    with Pool("auto", workers=1) as other:
        assert list(other.run(do, [Task(3)])) == [(0, 9)]
    assert list(ray.run(do, [Task(4)])) == [(0, 16)]
    with pytest.raises(UnknownOption, match="it is connected there"):
        Pool("127.0.0.1:9")


@pytest.mark.usefixtures("ray")
def test_a_cluster_that_is_not_there_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """At once, also that of ``RAY_ADDRESS``."""
    monkeypatch.setattr("ray.is_initialized", lambda: False)
    with pytest.raises(EngineFailure, match=r"there is no Ray at 127\.0\.0\.1:9"):
        Pool("127.0.0.1:9")
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:7")
    with pytest.raises(EngineFailure, match=r"there is no Ray at 127\.0\.0\.1:7"):
        Pool("ray")
