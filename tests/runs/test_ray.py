"""Real Ray on this machine: workers are killed, nothing is lost and nothing comes twice."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from run_samples import Task, do, pids

from scm_world.discovery.benchmarks import benchmark
from scm_world.discovery.data import Design, collect, sweep
from scm_world.errors import EngineFailure, UnknownOption
from scm_world.evaluation import evaluate
from scm_world.queries import World
from scm_world.runs.pool import TRIES, Pool

pytest.importorskip("ray")


@pytest.fixture(scope="module")
def ray() -> Iterator[Pool]:
    """Two workers for all of them."""
    with Pool("ray", workers=2) as made:
        yield made


def contents(folder: Path) -> dict[str, bytes]:
    """Read all files of a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


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
    with pytest.raises(EngineFailure, match=r"Ray does not answer at 127\.0\.0\.1:9"):
        Pool("127.0.0.1:9")
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:7")
    with pytest.raises(EngineFailure, match=r"Ray does not answer at 127\.0\.0\.1:7"):
        Pool("ray")


# --- what runs on it ------------------------------------------------------------------------------


def test_a_collection_on_ray_has_the_same_files(ray: Pool, tmp_path: Path) -> None:
    """Byte for byte those of this process; in memory it is the same table."""
    design = Design("half", ("tool_block.mass", "floor_friction", "gravity"))
    world = World("pushing", backend="fake")
    how: Any = {"steps": 2, "shard": 4, "nature": {"sensor_noise": 0.01}}
    here = collect(world, design, 14, out=tmp_path / "here", **how)
    there = collect(world, design, 14, out=tmp_path / "there", engine=ray, **how)
    assert here == there == collect(world, design, 14, engine=ray, **how)
    assert contents(tmp_path / "here") == contents(tmp_path / "there")


def test_an_evaluation_on_ray_has_the_same_rows(ray: Pool, tmp_path: Path) -> None:
    """And the same files."""
    how: Any = {"n": 27, "backend": "fake", "env": {"max_episode_length": 3}}
    here = evaluate("random", "P0,P9", out=tmp_path / "here", **how)
    assert evaluate("random", "P0,P9", out=tmp_path / "there", engine=ray, **how) == here
    assert contents(tmp_path / "here") == contents(tmp_path / "there")


def test_a_sweep_on_ray_has_the_same_files(ray: Pool, tmp_path: Path) -> None:
    """The table, too."""
    world, over = World("pushing", backend="fake"), {"tool_block.mass": [0.02, 0.08]}
    how: Any = {"n": 5, "steps": 2, "shard": 3}
    for name, engine in (("here", None), ("there", ray)):
        sweep(world, over, ["reward"], out=tmp_path / name, engine=engine, **how)
    assert contents(tmp_path / "here") == contents(tmp_path / "there")


@pytest.mark.slow
def test_a_benchmark_on_ray_finds_the_same_graphs(ray: Pool, tmp_path: Path) -> None:
    """Only the seconds differ; each run is kept, and none is done again."""
    asked: Any = {"budgets": [40, 80], "seeds": 1, "standardised": False}
    told: list[tuple[int, int]] = []
    here = benchmark(["correlation"], ["er2:4"], **asked)
    how: Any = {"out": tmp_path / "there", "engine": ray}
    there = benchmark(
        ["correlation"], ["er2:4"], **asked, **how, progress=lambda *at: told.append(at)
    )
    graphs = [{r.key: r.found.edges.tolist() for r in result.runs} for result in (here, there)]
    assert graphs[0] == graphs[1]
    assert here.problems == there.problems
    assert told == [(1, 2), (2, 2)]
    again = benchmark(["correlation"], ["er2:4"], **asked, **how)
    assert [run.seconds for run in again.runs] == [run.seconds for run in there.runs]


# --- the driver -----------------------------------------------------------------------------------

PROGRAM = """
import sys
from scm_world.discovery.data import Design, collect
from scm_world.queries import World
from scm_world.runs.pool import Pool
if __name__ == "__main__":
    design = Design("half", ("tool_block.mass", "floor_friction", "gravity"))
    collect(World("pushing", backend="fake"), design, 200, out=sys.argv[1], shard=4, steps=2,
            engine="ray", workers=2)
"""


def test_a_killed_driver_goes_on_where_it_was(tmp_path: Path, ray: Pool) -> None:
    """SIGKILL leaves no worker behind, and the same call makes the files that are missing."""
    out, script = tmp_path / "out", tmp_path / "run.py"
    script.write_text(PROGRAM)
    process = subprocess.Popen([sys.executable, str(script), str(out)])  # noqa: S603 # our own
    while len(list(out.glob("shard-*"))) < 5:
        assert process.poll() is None
        time.sleep(0.01)
    process.kill()
    process.wait()
    before = contents(out)
    assert 5 <= len(before) - 2 < 50
    design = Design("half", ("tool_block.mass", "floor_friction", "gravity"))
    how: Any = {"steps": 2, "shard": 4}
    times = {path: path.stat().st_mtime_ns for path in out.glob("shard-*")}
    world = World("pushing", backend="fake")
    whole = collect(world, design, 200, out=out, engine=ray, **how)
    assert all(path.stat().st_mtime_ns == time_ for path, time_ in times.items())
    assert whole == collect(world, design, 200, steps=2)
