"""Facts about undoing: interventions at one instant are one, and leave no trace if taken back."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from worlds import (
    NEEDS_BULLET,
    PARAMS,
    PHYSICS,
    PUSHING,
    REST,
    actions,
    begin,
    differing,
    other,
    play,
    same,
    settable,
    shared,
)

from scm_world.errors import InterventionError
from scm_world.tasks import tasks
from scm_world.variables import Draw, Natural, Scale, Shift
from scm_world.world import Simulation


@pytest.mark.parametrize("horizon", [1, 250])
@pytest.mark.parametrize(("backend", "task"), PARAMS)
def test_what_is_undone_leaves_no_trace(backend: str, task: str, horizon: int) -> None:
    """Set and set back, each variable alone and all in a row: the future is bit-identical."""
    world = begin(backend, task)
    start, values = world.snapshot(), world.values()
    commands = actions(horizon, seed=3)
    future = play(world, commands)
    names = settable(world)
    alone = names if horizon == 1 else names[::12]
    for group in [names, *([name] for name in alone)]:
        world.restore(start)
        for name in group:
            target = world.model.target(name)
            world.do({name: other(world, name)})
            assert not np.array_equal(world[target], values[target]), name
            world.do({target: values[target]})
            assert same(world.values(), values), name
        np.testing.assert_array_equal(play(world, commands), future, err_msg=str(group))


@pytest.mark.slow
@pytest.mark.parametrize(("backend", "task"), PARAMS)
def test_what_is_undone_leaves_no_trace_one_by_one(backend: str, task: str) -> None:
    """Over 250 steps, for each variable alone."""
    world = begin(backend, task)
    start, values = world.snapshot(), world.values()
    future = play(world, actions(250, seed=3))
    for name in settable(world):
        world.restore(start)
        target = world.model.target(name)
        world.do({name: other(world, name)})
        world.do({target: values[target]})
        np.testing.assert_array_equal(play(world, actions(250, seed=3)), future, err_msg=name)


DOS: list[dict[str, Any]] = [
    {"block.size": [0.07, 0.06, 0.08]},
    {"tool_block.orientation": [0.1, 0.0, 0.0, np.sqrt(0.99)]},
    {"tool_block.mass": Scale(2.0), "goal_block.polar": Draw("A")},
    {"tool_block.linear_velocity": Shift([0.1, 0.0, 0.2]), "gravity": [0.0, 0.0, -8.0]},
    {"goal_block.euler_orientation": Draw("A"), "joint_velocities": Shift(0.1)},
]


@pytest.mark.parametrize(("backend", "task"), PUSHING)
def test_the_path_does_not_matter(backend: str, task: str) -> None:
    """At one instant dos in any order, in one or in several, with detours, are one do."""
    world = begin(backend, task)
    start = world.snapshot()
    joint = {name: value for do in DOS for name, value in do.items()}
    world.do(joint)
    values, graph = world.values(), world.graph
    future = play(world, actions(20, seed=3))
    detour = {"tool_block.mass": 0.5, "block.size": [0.05] * 3, "joint_velocities": [0.0] * 9}
    paths = [list(order) for order in itertools.islice(itertools.permutations(DOS), 0, 120, 13)]
    paths += [[detour, *DOS], [DOS[0], DOS[1], detour, *DOS[::-1]]]
    for path in paths:
        world.restore(start)
        for do in path:
            world.do(do)
        assert not differing(world.values(), values)
        assert {n: world.graph[n] for n in world.graph} == {n: graph[n] for n in graph}
        np.testing.assert_array_equal(play(world, actions(20, seed=3)), future)


@pytest.mark.parametrize(("backend", "task"), PUSHING)
def test_a_draw_stays_when_something_else_is_done(backend: str, task: str) -> None:
    """What was drawn at this instant, in any coordinates, keeps its last digit."""
    world = begin(backend, task)
    world.do(
        {"goal_block.cylindrical_position": Draw("A"), "goal_block.euler_orientation": Draw("B")}
    )
    world.do({"tool_block.cylindrical_position": Shift([0.001, 0.1, 0.05])})
    values = world.values()
    for other_do in ({"floor_friction": 0.3}, {"joint_velocities": Shift(0.1)}):
        world.do(other_do)
    assert differing(world.values(), values) == {"floor_friction", "joint_velocities"}


@pytest.mark.parametrize(("backend", "task"), PHYSICS)
def test_taking_back_is_never_refused(backend: str, task: str) -> None:
    """Bodies that physics pressed into one another may be put back there."""
    world = shared(backend, task)
    world.reset(seed=0, do={"tool_block.mass": 2.0, "gravity": [0.0, 0.0, -30.0]})
    play(world, [REST] * 5)
    values = world.values()
    world.do({"tool_block.cartesian_position": Shift([0.0, 0.0, 0.1])})
    world.do({"tool_block.cartesian_position": values["tool_block.cartesian_position"]})
    assert same(world.values(), values)


@pytest.mark.parametrize(("backend", "task"), PHYSICS)
def test_what_physics_did_can_always_be_restored(backend: str, task: str) -> None:
    """A joint that was slammed beyond its stop may be put back there, to the last bit."""
    world = shared(backend, task)
    world.reset(seed=0)
    world.do({"joint_velocities": [50.0, 0.0, 0.0] * 3})
    for _ in range(10):
        world.step(world.action_high)
        values = world.values()
        world.do({"joint_positions": REST})
        world.do({"joint_positions": values["joint_positions"]})
        assert same(world.values(), values)


def _undo_at_random(world: Simulation, groups: list[list[str]], seed: int) -> None:
    """Compare futures without interventions and with some that are undone, at random instants.

    Every other group is written back only; every third looks 50 steps ahead instead of one. A
    refused intervention is undone, too: it changed nothing.
    """
    rng, refused = np.random.default_rng(seed), 0
    for case, group in enumerate(groups):
        world.reset(seed=int(rng.integers(1000)))
        play(world, actions(int(rng.integers(1, 5)), seed=case))
        horizon = 50 if case % 3 == 0 else 1
        start, commands = world.snapshot(), actions(horizon, seed=case)
        values, future = world.values(), play(world, commands)
        world.restore(start)
        for name in group:
            if case % 2 == 0:
                try:
                    world.do({name: other(world, name)})
                except InterventionError:
                    refused += 1
            world.do({name: values[name]})
            assert same(world.values(), values), name
        np.testing.assert_array_equal(play(world, commands), future, err_msg=str(group))
    assert refused <= max(1, sum(map(len, groups)) / 4)


@pytest.mark.parametrize(("backend", "task"), PARAMS)
def test_what_is_undone_in_its_own_coordinates_leaves_no_trace(backend: str, task: str) -> None:
    """A quantity whose coordinates are set back, or to what they are, keeps its last digit."""
    world = begin(backend, task)
    names = [name for name in settable(world) if world.model.targets(name) != (name,)]
    _undo_at_random(world, [[name] for name in np.resize(names, 10).tolist()], seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("task", tasks())
@pytest.mark.parametrize("backend", ["mujoco", pytest.param("bullet", marks=NEEDS_BULLET)])
def test_what_is_undone_leaves_no_trace_in_any_task(backend: str, task: str) -> None:
    """Each variable is set and set back, or written back, at random states: no bit differs."""
    world = begin(backend, task)
    names = np.random.default_rng(2).permutation(settable(world))
    groups = [part.tolist() for part in np.array_split(names, 50) for _ in range(2)]
    _undo_at_random(world, groups, seed=1)


@pytest.mark.parametrize(("backend", "task"), PUSHING)
def test_a_quantity_stays_when_a_change_of_its_coordinates_is_none(backend: str, task: str) -> None:
    """Shifts by zero and releases in other coordinates keep the quantity."""
    world = begin(backend, task)
    values = world.values()
    for act in (Shift([0.0, 0.0, 0.0]), Scale([1.0, 1.0, 1.0]), Natural()):
        world.do({"tool_block.cylindrical_position": act, "tool_block.euler_orientation": act})
        assert same(world.values(), values), act
