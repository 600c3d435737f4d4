"""Environments in several processes."""

from __future__ import annotations

import os
import signal
from functools import partial
from typing import Any

import numpy as np
import pytest
from env_executors import LENGTH, actions, check_alike, check_same, kept, make

from scm_world.env.batched.vector_env import fastest
from scm_world.errors import EngineFailure, OutOfBounds, UnknownOption
from scm_world.work.processes import Worker, cores


def test_how_many_processes_there_are_changes_nothing() -> None:
    """Two, for three environments: bit for bit what one environment after another says."""
    pytest.importorskip("pybullet")
    options: dict[str, Any] = {"backend": "bullet", "max_episode_length": 3}
    said = []
    for executor, how in (("loop", {}), ("processes", {"workers": 2})):
        envs = make(executor, 3, autoreset_mode="SameStep", **how, **options)
        mine = [envs.reset(seed=1), *(envs.step(action) for action in actions(5, 3))]
        envs.do([None, {"floor_friction": 0.3}, {"tool_block.mass": "B"}])
        said.append([*mine, envs.present(), *(envs.step(action) for action in actions(2, 3, 1))])
        envs.close()
    check_same(said[1], said[0])


def test_the_fastest_executor_is_taken() -> None:
    """MuJoCo steps them itself; Bullet takes processes if there are several, and several cores."""
    assert fastest("mujoco", 1, workers=None) == "native"
    assert fastest("mujoco", 2, workers=2) == "processes"
    assert fastest("bullet", 2, workers=None) == ("processes" if cores() > 1 else "loop")
    assert fastest("bullet", 1, workers=None) == "loop"
    assert fastest("fake", 2, workers=None) == "loop"
    assert fastest("fake", 2, workers=2) == "processes"


def test_a_process_that_is_killed_is_an_error() -> None:
    """The error says which environments are lost; asking again says it again."""
    envs = make("processes", 4, workers=2)
    envs.reset(seed=0)
    worker: Worker = envs.executor._workers[1]
    os.kill(worker._process.pid, signal.SIGKILL)
    text = r"environments 2 to 3 are lost: .* exit code -9; make the environments again"
    for _ in range(2):
        with pytest.raises(EngineFailure, match=text):
            envs.step(actions(1)[0])
    with pytest.raises(EngineFailure, match=text):
        envs.do({0: {"floor_friction": 0.3}})
    envs.close()


def test_a_process_that_is_killed_between_calls_is_an_error() -> None:
    """Whatever it is asked."""
    envs = make("processes", 1, workers=1)
    envs.reset(seed=0)
    worker: Worker = envs.executor._workers[0]
    os.kill(worker._process.pid, signal.SIGKILL)
    with pytest.raises(EngineFailure, match="environments 0 to 0 are lost"):
        envs.snapshot()
    envs.close()


def test_an_interrupted_step_ends_the_executor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Some environments may have stepped: it cannot go on, and no process stays."""

    def interrupted(*_: Any) -> Any:
        raise KeyboardInterrupt

    envs = make("processes", 1, workers=1)
    envs.reset(seed=0)
    pid = envs.executor._workers[0]._process.pid
    with monkeypatch.context() as patched:
        patched.setattr(Worker, "answer", interrupted)
        with pytest.raises(KeyboardInterrupt):
            envs.step(actions(1, 1)[0])
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    with pytest.raises(EngineFailure, match="interrupted by KeyboardInterrupt"):
        envs.reset()


def test_in_a_process_of_a_pool_no_process_is_started() -> None:
    """One that ends with its parent may have no children."""
    with Worker(partial(partial, fastest, "bullet", 4, workers=None)) as worker:
        assert worker.ask("__call__") == "loop"


def test_nothing_is_left_behind() -> None:
    """No process stays, and what was seen can be seen after the end."""
    envs = make("processes", 3, workers=2, copy=False)
    observations, _ = envs.reset(seed=0)
    kept = observations.copy()
    pids = [worker._process.pid for worker in envs.executor._workers]
    envs.close()
    np.testing.assert_array_equal(observations, kept)
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
    with pytest.raises(EngineFailure, match="closed; make the environments again"):
        envs.step(actions(1, 3)[0])


def test_processes_end_with_the_executor_that_nobody_uses() -> None:
    """Without ``close`` too."""
    envs = make("processes", 2, workers=1)
    pid = envs.executor._workers[0]._process.pid
    del envs
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_what_cannot_be_sent_is_refused() -> None:
    """An argument that cannot be pickled changes nothing, and neither does a wrong one."""
    with pytest.raises(UnknownOption, match=r"make cannot be"):
        make("processes", 2, task_options={"weights": lambda: None})
    envs, twin = kept("processes"), make("loop", max_episode_length=LENGTH)
    for one in (envs, twin):
        one.reset(seed=0)
    with pytest.raises(UnknownOption, match="argument"):
        envs.do({0: {"floor_friction": 0.3}, 3: {"tool_block.mass": lambda: None}})
    with pytest.raises(OutOfBounds, match="environment 3"):
        envs.do({0: {"floor_friction": 0.3}, 3: {"tool_block.mass": -1.0}})
    check_same(envs.present(), twin.present(), "present")
    check_alike(envs, twin, 3)


def test_a_reset_that_one_process_refuses_happens_nowhere() -> None:
    """When episodes begin by themselves, too: the error comes out, and the others go back."""
    envs, twin = kept("processes"), make("loop", max_episode_length=LENGTH)
    for one in (envs, twin):
        one.reset(seed=0)
    check_alike(envs, twin, LENGTH)
    envs.set_attr("_start", [{}, {}, {}, {"tool_block.mass": -1.0}])
    with pytest.raises(OutOfBounds, match="environment 3"):
        envs.step(actions(1)[0])
    assert [snapshot.world.index for snapshot in envs.call("snapshot")] == [LENGTH] * 4
    envs.set_attr("_start", {})
    check_alike(envs, twin, 3)
