"""Batches in which something went wrong, or was left out."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world.backends import BackendWrapper, make_backend
from scm_world.backends.mujoco.backend import MujocoBackend
from scm_world.errors import EngineFailure
from scm_world.world import Simulation
from scm_world.world.batch import Batch

COUNT = 3


def _worlds() -> list[Simulation]:
    first = Simulation("pushing")
    found = [first, *(Simulation(first.structures) for _ in range(COUNT - 1))]
    for seed, world in enumerate(found):
        world.reset(seed=seed)
    return found


def _commands(world: Simulation, steps: int) -> Any:
    generator = np.random.default_rng(0)
    return generator.uniform(world.action_low, world.action_high, (steps, COUNT, 9))


def test_worlds_go_on_where_another_one_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A state that is lost is lost in one world; clocks and states of the others agree."""
    monkeypatch.chdir(tmp_path)  # engines may write a log
    alone, many = _worlds(), _worlds()
    many[1].do({"floor_friction": 0.4})
    batch = Batch(many, names=("reward",))
    asked = _commands(alone[0], 3)
    backend: Any = batch.world(1).backend
    assert isinstance(backend, MujocoBackend)
    backend.realization.data.qvel[:] = 1e200
    with pytest.raises(EngineFailure) as caught:
        batch.advance(asked[0])
    assert (caught.value.row, caught.value.lost) == (1, (1,))
    assert [batch.world(index).index for index in (0, 2)] == [1, 1]
    batch.world(1).reset(seed=1)
    alone[1].reset(seed=1)
    for index in (0, 2):
        alone[index].advance(asked[0, index].copy())
    for step in (1, 2):
        batch.advance(asked[step])
        for index, world in enumerate(alone):
            world.advance(asked[step, index].copy())
    for index, world in enumerate(alone):
        assert batch.world(index).index == world.index
        for name, value in world.values().items():
            np.testing.assert_array_equal(batch.world(index)[name], value, err_msg=name)


class Balks(BackendWrapper):
    """An engine that does not step when it is told to balk, and says so."""

    name = "balks"
    balk = False

    def step(self, command: Any, substeps: int) -> None:
        """Step, or do not."""
        if self.balk:
            raise EngineFailure("it balks", self.name)
        super().step(command, substeps)


def test_a_world_whose_engine_did_not_step_is_where_it_was() -> None:
    """Its clock, too; it goes on as a world that was never asked for that step."""
    kind = Simulation("pushing", backend="fake").structures
    alone = [Simulation(kind, backend="fake") for _ in range(COUNT)]
    many = [Simulation(kind, backend=Balks(make_backend("fake"))) for _ in range(COUNT)]
    for seed, pair in enumerate(zip(alone, many, strict=True)):
        for world in pair:
            world.reset(seed=seed)
    batch, asked = Batch(many, names=("reward",)), _commands(alone[0], 3)
    for step, balks in enumerate((False, True, False)):
        many[1].backend.balk = balks  # type: ignore[attr-defined]
        if balks:
            with pytest.raises(EngineFailure, match="it balks") as caught:
                batch.advance(asked[step])
            assert (caught.value.row, caught.value.lost, caught.value.unmoved) == (1, (), (1,))
        else:
            batch.advance(asked[step])
        for index, world in enumerate(alone):
            if not (balks and index == 1):
                world.advance(asked[step, index].copy())
    for world, other in zip(many, alone, strict=True):
        assert world.index == other.index
        for name, value in other.values().items():
            np.testing.assert_array_equal(world[name], value, err_msg=name)


LITTLE = """
<mujoco>
  <size memory="2200"/>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="a" pos="0 0 0.12"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>
    <body name="b" pos="0.5 0 0.12"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>
    <body name="c" pos="1 0 0.12"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>
  </worldbody>
</mujoco>
"""
"""It has no room for what happens when boxes meet the floor, in the middle of a control step."""


def test_a_step_that_mujoco_breaks_off_loses_the_state() -> None:
    """Alone as in a batch: the engine is between two states that the world has."""
    first = Simulation(LITTLE, frame_skip=50)
    worlds = [first, *(Simulation(first.structures, frame_skip=50) for _ in range(2))]
    for world in worlds:
        world.reset(seed=0)
    alone, *many = worlds
    many[1].do({"a.cartesian_position": [0.0, 0.0, 9.0], "b.cartesian_position": [0.5, 0.0, 9.0]})
    many[1].do({"c.cartesian_position": [1.0, 0.0, 9.0]})
    batch = Batch(many)
    with pytest.raises(EngineFailure, match="stack overflow") as caught:
        batch.advance(np.zeros((2, 0)))
    assert caught.value.lost == (0,)
    with pytest.raises(EngineFailure, match="stack overflow"):
        alone.step(np.zeros(0))
    for world in (alone, many[0]):
        with pytest.raises(EngineFailure, match="reset the world"):
            world.step(np.zeros(0))
    assert many[1].index == 1
    batch.step(np.zeros((2, 0)), where=np.array([False, True]))
    many[0].reset(seed=0)
    assert many[0]["a.cartesian_position"].tolist() == [0.0, 0.0, 0.12]


class _Interrupted:
    """An engine during whose step somebody presses Ctrl-C."""

    may_refuse = False

    def __init__(self, engine: Any) -> None:
        self._engine, self.read = engine, engine.read

    def step(self, which: Any, commands: Any, substeps: int, into: Any) -> None:
        """Step, and do not come to reading."""
        self._engine.step(which, commands, substeps, into.copy())
        raise KeyboardInterrupt


def test_an_interrupted_batch_is_where_its_engine_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """After Ctrl-C every world goes on like one that is taken to its snapshot."""
    batch, other = Batch(_worlds(), names=("reward",)), _worlds()[0]
    first, second, third = _commands(other, 3)
    batch.advance(first)
    with monkeypatch.context() as patched:
        patched.setattr(batch, "_engine", _Interrupted(batch._engine))
        with pytest.raises(KeyboardInterrupt):
            batch.advance(second)
    for index in range(COUNT):
        other.restore(batch.world(index).snapshot())
        batch.advance(third, np.arange(COUNT) == index)
        other.advance(third[index].copy())
        assert other.index == batch.world(index).index == 3
        assert other["reward"] == batch.table(index)["reward"][index]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_batch_goes_on_in_a_forked_process() -> None:
    """The threads of the engine stay behind in the old process; the new one starts its own."""
    alone, many = _worlds(), _worlds()
    batch = Batch(many, threads=2, names=("reward",))
    first, second = _commands(alone[0], 2)
    batch.advance(first)
    for index, world in enumerate(alone):
        world.advance(first[index].copy())
        world.advance(second[index].copy())
    child = os.fork()
    if child == 0:
        signal.alarm(20)  # else nobody would notice that it waits for ever
        same = False
        try:
            batch.advance(second)
            same = all(batch.world(i)["reward"] == w["reward"] for i, w in enumerate(alone))
        finally:
            os._exit(0 if same else 1)
    assert os.waitpid(child, 0)[1] == 0


ENDS = """
import os, sys, threading
import gymnasium
import scm_world
envs = gymnasium.make_vec("scm_world/Pushing-v0", 4, threads=2)
envs.reset(seed=0)
actions = envs.action_space.sample()
envs.step(actions)
child = os.fork()
if child == 0:
    sys.exit()
status = os.waitpid(child, 0)[1]
def act():
    while True:
        envs.step(actions)
        begun.set()
begun = threading.Event()
threading.Thread(target=act, daemon=True).start()
begun.wait()
sys.exit(status)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
def test_a_process_ends_quietly_with_its_threads() -> None:
    """Nothing is closed: neither in a forked process nor while another thread steps."""
    command = [sys.executable, "-W", "ignore::DeprecationWarning", "-c", ENDS]
    ended = subprocess.run(  # noqa: S603 # ours
        command, capture_output=True, text=True, timeout=120, check=False
    )
    assert (ended.returncode, ended.stderr) == (0, "")
