"""Environments in processes, which Gymnasium's ``AsyncVectorEnv`` runs."""

from __future__ import annotations

import os
import signal
from typing import Any

import numpy as np
import pytest
from many_envs import LENGTH, PUSHING, actions, check_alike, check_same, kept, make

from scm_world.env import vector_env
from scm_world.env.native import NativeVectorEnv
from scm_world.env.processes import ProcessVectorEnv
from scm_world.errors import EngineFailure, OutOfBounds, UnknownOption
from scm_world.runs.processes import Worker, cores


def test_how_many_work_at_the_same_time_changes_nothing() -> None:
    """One after another, or two for three environments: bit for bit the same."""
    pytest.importorskip("pybullet")
    said = []
    for workers in (1, 2):
        options: dict[str, Any] = {"backend": "bullet", "max_episode_length": 3}
        envs = make("turns", 3, autoreset_mode="SameStep", workers=workers, **options)
        mine = [envs.reset(seed=1), *(envs.step(action) for action in actions(5, 3))]
        envs.do([None, {"floor_friction": 0.3}, {"tool_block.mass": "B"}])
        said.append([*mine, envs.present(), *(envs.step(action) for action in actions(2, 3, 1))])
        envs.close()
    check_same(said[1], said[0])


def test_the_fastest_kind_is_taken() -> None:
    """MuJoCo steps them itself; Bullet takes processes if there are several, and several cores."""
    pytest.importorskip("pybullet")
    several = ProcessVectorEnv if cores() > 1 else NativeVectorEnv
    for backend, number, workers, kind in (
        ("mujoco", 2, None, NativeVectorEnv),
        ("fake", 2, None, NativeVectorEnv),
        ("fake", 2, 2, ProcessVectorEnv),
        ("bullet", 2, None, several),
        ("bullet", 2, 1, NativeVectorEnv),
        ("bullet", 1, None, NativeVectorEnv),
    ):
        envs = make("turns", number, backend=backend, workers=workers)
        assert type(envs) is kind
        envs.close()


def test_a_process_that_is_killed_is_an_error() -> None:
    """The error says which environment is lost; asking again says it again."""
    envs = make("processes", 2)
    envs.reset(seed=0)
    os.kill(envs._envs.processes[1].pid, signal.SIGKILL)
    text = r"a process ended: environment 1 .* -9; make the environments again"
    for ask in (lambda: envs.step(actions(1, 2)[0]), envs.snapshot, envs.present):
        with pytest.raises(EngineFailure, match=text):
            ask()
    envs.close()


def test_an_interrupted_step_ends_the_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Some environments may have stepped: they cannot go on, and no process stays."""

    def interrupted(*_: Any) -> Any:
        raise KeyboardInterrupt

    envs = make("processes", 2)
    envs.reset(seed=0)
    pids = [process.pid for process in envs._envs.processes]
    with monkeypatch.context() as patched:
        patched.setattr(envs._envs, "step_wait", interrupted)
        with pytest.raises(KeyboardInterrupt):
            envs.step(actions(1, 2)[0])
    for pid in pids:
        assert not is_running(pid)
    with pytest.raises(EngineFailure, match="interrupted by KeyboardInterrupt"):
        envs.reset()


def test_in_a_process_of_a_pool_no_process_is_started() -> None:
    """One that ends with its parent may have no children."""
    pytest.importorskip("pybullet")
    worker = Worker(_kind)
    assert worker.ask() == "NativeVectorEnv"
    worker.close()


def _kind() -> str:
    return type(vector_env(2, task="pushing", backend="bullet")).__name__


def test_nothing_is_left_behind() -> None:
    """No process stays, and what was seen can be seen after the end."""
    envs = make("processes", 2, copy=False)
    observations, _ = envs.reset(seed=0)
    seen = observations.copy()
    pids = [process.pid for process in envs._envs.processes]
    envs.close()
    np.testing.assert_array_equal(observations, seen)
    for pid in pids:
        assert not is_running(pid)
    with pytest.raises(EngineFailure, match="closed; make the environments again"):
        envs.step(actions(1, 2)[0])


def is_running(pid: int) -> bool:
    """Return whether there is such a process, and it did not end."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_processes_end_with_environments_that_nobody_uses() -> None:
    """Without ``close`` too."""
    envs = make("processes", 2)
    pids = [process.pid for process in envs._envs.processes]
    del envs
    for pid in pids:
        assert not is_running(pid)


def test_what_cannot_be_sent_is_refused() -> None:
    """An argument that cannot be pickled changes nothing, and neither does a wrong one."""
    envs, twin = kept("processes"), make("turns", max_episode_length=LENGTH)
    for one in (envs, twin):
        one.reset(seed=0)
    with pytest.raises(UnknownOption, match="argument"):
        envs.do({0: {"floor_friction": 0.3}, 3: {"tool_block.mass": lambda: None}})
    with pytest.raises(UnknownOption, match="value"):
        envs.set_attr("remark", lambda: None)
    with pytest.raises(OutOfBounds, match="environment 3") as refused:
        envs.do({0: {"floor_friction": 0.3}, 3: {"tool_block.mass": -1.0}})
    assert refused.value.variable == "tool_block.mass"
    check_same(envs.present(), twin.present(), "present")
    check_alike(envs, twin, 3)


def test_a_reset_that_one_process_refuses_happens_nowhere() -> None:
    """When episodes begin by themselves, too: the error comes out, and the others go back."""
    envs, twin = kept("processes"), make("turns", max_episode_length=LENGTH)
    for one in (envs, twin):
        one.reset(seed=0)
    check_alike(envs, twin, LENGTH)
    envs.set_attr("_start", [{}, {}, {}, {"tool_block.mass": -1.0}])
    with pytest.raises(OutOfBounds, match="environment 3"):
        envs.step(actions(1)[0])
    assert [snapshot.world.index for snapshot in envs.snapshot()] == [LENGTH] * 4
    envs.set_attr("_start", {})
    check_alike(envs, twin, 3)


def test_gymnasiums_own_kind_says_the_same() -> None:
    """``vectorization_mode="async"`` gives Gymnasium's class as it is."""
    how = {"context": "forkserver", "shared_memory": True}
    options: dict[str, Any] = {"backend": "fake", "max_episode_length": 3}
    import gymnasium

    theirs = gymnasium.make_vec(
        PUSHING, 2, vectorization_mode="async", vector_kwargs=how, **options
    )
    ours = make("turns", 2, **options)
    check_same(ours.reset(seed=1), theirs.reset(seed=1), "reset")
    for step, action in enumerate(actions(5, 2)):
        check_same(ours.step(action), theirs.step(action), f"step {step}")
    theirs.call("do", {"floor_friction": 0.4})
    ours.do({"floor_friction": 0.4})
    action = actions(1, 2, 3)[0]
    check_same(ours.step(action), theirs.step(action), "after an intervention")
    theirs.close()
