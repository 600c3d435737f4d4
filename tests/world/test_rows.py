"""Worlds that are opened together exist in rows; each is, bit for bit, a world by itself."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest

from scm_world import World, do
from scm_world.errors import EngineFailure, InterventionError, ModelError, NotReset, ScmWorldError
from scm_world.tasks import StepTask
from scm_world.variables import (
    Action,
    Box,
    Derived,
    Draw,
    Exogenous,
    Function,
    Hard,
    Measured,
    Normal,
    Shift,
)
from scm_world.world import Batch

N = 5


def drag(mass: float, noise: float = 0.0) -> float:
    """Compute a parameter that follows another one."""
    return 0.5 * mass + noise


class Cart(StepTask):
    """A cart whose parameters are drawn, each by itself."""

    parameters: Any = (
        Exogenous(name="mass", distribution=Box(1.0, 2.0), default=1.0, bounds=Box(0.1, 9.0)),
        Exogenous(name="gain", distribution=Normal(1.0, 0.1), default=1.0),
        Exogenous(name="bias", distribution=Normal(0.0, 0.1), default=(0.0, 0.0), shape=(2,)),
    )
    states = (Measured(name="speed", default=0.0, parents=("mass", "gain", "bias", "push")),)
    actions = (Action(name="push", bounds=Box(-1.0, 1.0)),)
    control_dt = 0.1

    @staticmethod
    def step(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
        """Push the cart."""
        force = parameters["gain"] * action["push"] + parameters["bias"][1] - state["speed"]
        return {"speed": state["speed"] + 0.1 * force / parameters["mass"]}


class Dragged(Cart):
    """A cart with a parameter that follows another one, and has noise of its own."""

    parameters = (
        *Cart.parameters,
        Derived(
            name="drag",
            parents=("mass",),
            mechanism=Function(reference="test_rows:drag"),
            noise=Normal(0.0, 0.1),
        ),
    )


def same(worlds: Batch, alone: list[World], *, each: bool) -> None:
    """Assert that rows hold what worlds by themselves hold; ``each`` lets them go on alone."""
    found = worlds.values()
    for row, world in enumerate(alone):
        one: Any = worlds.world(row) if each else None
        for name, value in world.values().items():
            np.testing.assert_array_equal(found[name][row], value, f"{name}, {row}")
            if each:
                np.testing.assert_array_equal(one[name], value, f"{name}, {row}")
        if each:
            assert (one.noise.seed, one.episode) == (world.noise.seed, world.episode)
            saved, other = one.snapshot(), world.snapshot()
            kept = world.compiled.kept
            assert saved.row.numbers[kept].tobytes() == other.row.numbers[kept].tobytes()
            assert (saved.base is None) == (other.base is None)
            if other.base is not None:
                assert saved.base.at_start == other.base.at_start
                assert saved.base.row.numbers[kept].tobytes() == (
                    other.base.row.numbers[kept].tobytes()
                )


@pytest.mark.parametrize("task", [Cart(), Dragged(), "pushing"])
@pytest.mark.parametrize("each", [False, True])
def test_beginnings_are_those_of_single_worlds(task: Any, each: bool) -> None:
    """What is drawn at the beginning, seeds, episodes and masks; also after a step."""
    backend = "fake" if task == "pushing" else None
    worlds: Any = World(task, backend=backend, num_worlds=N)
    alone = [World(task, backend=backend) for _ in range(N)]
    with pytest.raises(NotReset):
        worlds.values()
    mask = np.arange(N) % 2 == 0
    worlds.reset(seed=3, where=mask)
    assert not worlds.has_begun
    worlds.reset(seed=[7, 1, 2, 9, 4])
    assert worlds.has_begun
    for row, seed in enumerate([7, 1, 2, 9, 4]):
        alone[row].reset(seed=seed)
    same(worlds, alone, each=False)
    size = alone[0].action_low.size
    for turn in range(3):
        worlds.step(np.full((N, size), 0.5))
        worlds.reset(where=mask)  # the next episodes of the same seeds
        for row, world in enumerate(alone):
            world.step(np.full(size, 0.5))
            if mask[row]:
                world.reset()
        if turn == 1:
            same(worlds, alone, each=each)
    assert worlds.index.tolist() == [world.index for world in alone]
    same(worlds, alone, each=True)
    if task != "pushing":
        assert np.unique(worlds["gain"]).size == N


def test_what_makes_worlds_exist_is_forgotten_at_a_reset() -> None:
    """An intervention that each computes alone, and a plan, cost their time in one episode only."""
    worlds: Any = World("pushing", backend="fake", num_worlds=3)
    alone = [World("pushing", backend="fake") for _ in range(3)]
    worlds.reset(seed=0, do=do({"floor_friction": Hard(0.3, at=1)}))
    assert worlds.is_planned
    version = worlds.version
    worlds.step(np.zeros((3, 9)))
    worlds.do({"block.size": [0.06, 0.07, 0.08]})
    assert len(worlds.systems) == 3
    kept = worlds.world(1)
    worlds.reset()
    assert worlds.version > version
    assert worlds.systems == [kept]
    assert not worlds.is_planned
    worlds.do({"tool_block.mass": Draw("A")})
    for row, world in enumerate(alone):
        world.reset(seed=row)
        world.reset()
        world.do({"tool_block.mass": Draw("A")})
    assert worlds.systems == [kept]
    same(worlds, alone, each=True)


def pickled(worlds: Any) -> Any:
    """Return a copy from another process."""
    return pickle.loads(pickle.dumps(worlds))  # noqa: S301 # its own


@pytest.mark.parametrize("copied", [copy.deepcopy, pickled])
def test_copies_go_on_alike_and_share_what_is_compiled(copied: Any) -> None:
    """A copy has the episodes, in one task that is compiled once; without episodes it has rows."""
    worlds: Any = World("pushing", backend="fake", num_worlds=3)
    assert copied(worlds).systems == []
    worlds.reset(seed=0, where=np.array([True, False, True]))
    worlds.do({"tool_block.mass": Draw("A")}, where=np.array([True, False, True]))
    other = copied(worlds)
    assert {id(world.structures) for world in other.systems} == {id(other.one.structures)}
    mask = np.array([True, False, True])
    for each in (worlds, other):
        with pytest.raises(NotReset):
            each.step(np.zeros((3, 9)))
        each.reset(seed=[None, 5, None], where=~mask)
        each.step(np.full((3, 9), 0.1))
        each.do({"tool_block.mass": Shift(Draw(0.0, 0.001))})
    for name, value in worlds.values().items():
        np.testing.assert_array_equal(other[name], value, name)


def test_a_refused_reset_leaves_everything_or_begins_without_it() -> None:
    """As in a world alone: what is asked is refused, and the episodes have begun without it."""
    worlds: Any = World("pushing", backend="fake", num_worlds=3)
    worlds.reset(seed=0)
    worlds.do({"tool_block.mass": 0.05})
    for given in ({"tool_block.mass": Hard(-1.0)}, do({"tool_block.mass": Hard(-1.0, at=0)})):
        worlds.do({"floor_friction": 0.3})
        with pytest.raises(InterventionError):
            worlds.reset(seed=5, do=given)
        assert [worlds._alone(row).noise.seed for row in range(3)] == [5, 6, 7]
        assert worlds["tool_block.mass"].tolist() == [0.02] * 3
        assert worlds.index.tolist() == [0] * 3
    worlds.do({"floor_friction": 0.3})
    before = worlds.values()
    with pytest.raises(ScmWorldError):
        worlds.reset(seed=[1, 2, -3])
    for name, value in worlds.values().items():
        np.testing.assert_array_equal(value, before[name], name)
    assert worlds.world(0).requested == {"floor_friction": 0.3}


def test_an_engine_that_fails_at_a_reset_leaves_all_where_they_were(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No episode has ended, and all go on."""
    worlds: Any = World(Cart(), num_worlds=N)
    worlds.reset(seed=0, where=np.arange(N) < 3)
    worlds.step(np.ones((N, 1)), where=np.arange(N) < 3)
    before = worlds.values(where=np.arange(N) < 3)

    def refuse(*args: Any) -> None:
        raise EngineFailure("it is broken", "step")

    with monkeypatch.context() as patched:
        patched.setattr(worlds._engine._backends[2], "apply", refuse)
        with pytest.raises(EngineFailure, match="it is broken"):
            worlds.reset(seed=9)
    for name, value in worlds.values(where=np.arange(N) < 3).items():
        np.testing.assert_array_equal(value, before[name], name)
    with pytest.raises(NotReset):
        worlds.values()
    worlds.step(np.ones((N, 1)), where=np.arange(N) < 3)
    alone = World(Cart())
    alone.reset(seed=2)
    for _ in range(2):
        alone.step([1.0])
    assert worlds.world(2)["speed"] == alone["speed"]


def test_a_readout_that_fails_in_one_world_is_refused() -> None:
    """Functions are checked in each world that begins for the first time with what is drawn."""

    class Wrong(Cart):
        outcomes = (
            Measured(
                name="ratio",
                parents=("speed", "mass"),
                mechanism=Function(reference="test_rows:wrong"),
            ),
        )

    worlds: Any = World(Wrong(), num_worlds=N)
    masses = {}
    for seed in range(N):
        one: Any = World(Cart())
        one.reset(seed=seed)
        masses[seed] = float(one["mass"])
    seeds = sorted(masses, key=masses.__getitem__)
    assert masses[seeds[0]] < THRESHOLD < masses[seeds[-1]]
    with pytest.raises(ModelError, match="ratio"):
        worlds.reset(seed=seeds)
    assert not worlds.has_begun


THRESHOLD = 1.7


def wrong(speed: float, mass: float) -> float:
    """Fail for a large mass."""
    return np.inf if mass > THRESHOLD else mass


def test_closed_worlds_say_so_and_begin_again() -> None:
    """As a world alone."""
    worlds: Any = World("pushing", backend="fake", num_worlds=3)
    worlds.reset(seed=0)
    first = worlds.values()
    worlds.close()
    for call in (worlds.values, lambda: worlds.do({"tool_block.mass": 0.05})):
        with pytest.raises(NotReset, match="closed"):
            call()
    worlds.reset(seed=0)
    for name, value in worlds.values().items():
        np.testing.assert_array_equal(value, first[name], name)
