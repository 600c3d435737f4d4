"""Facts about thousands of random interventions, most of them wrong in some way."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from worlds import NEEDS_BULLET, actions, play, same, settable

from scm_world.errors import InterventionError
from scm_world.variables import Box, Draw, Integers, Normal, Scale, Shift
from scm_world.world import World

BAD = (None, "x", float("nan"), float("inf"), [], [1.0, 2.0], {"x": 1.0}, 1e300, -1e300, True)


def spread(world: World, name: str, generator: np.random.Generator) -> Any:
    """Draw a value somewhere in, at, or just outside the bounds of a variable."""
    variable: Any = world.model.declared(name)
    bounds = variable.bounds
    if isinstance(bounds, Box):
        low, high = bounds.bounds(variable.shape, {})
        return low + (high - low) * generator.uniform(-0.02, 1.02, variable.shape)
    if isinstance(bounds, Integers):
        return int(generator.integers(-1, 200))
    value = generator.normal(size=variable.shape)
    return value / np.linalg.norm(value) if variable.shape == (4,) else 0.1 * value


def one(world: World, names: list[str], generator: np.random.Generator) -> dict[str, Any]:
    """Draw a request."""
    request: dict[str, Any] = {}
    for _ in range(generator.integers(1, 4)):
        name = str(generator.choice(names))
        variable = world.model.declared(name)
        near = world[name] + 0.01 * generator.normal(size=variable.shape)
        match generator.integers(8):
            case 0:
                request[name] = BAD[generator.integers(len(BAD))]
            case 1:
                request[name] = Shift(float(generator.normal(scale=0.01)))
            case 2:
                request[name] = Scale(float(generator.uniform(-0.1, 2.0)))
            case 3:
                request[name] = Draw(("A", "B", "A|B")[generator.integers(3)])
            case 4:
                request[name] = Draw(Normal(0.0, 0.05))
            case 5 | 6:
                request[name] = near
            case _:
                request[name] = spread(world, name, generator)
    return request


def check(backend: str, count: int) -> None:
    """Do many things, and compare the world with a new one."""
    world = World("pushing", backend=backend)
    world.reset(seed=1)
    fresh, future = world.values(), play(world, actions(20))
    generator = np.random.default_rng(8)
    names = list(world.model)
    done = refused = 0
    for index in range(count):
        if index % 50 == 0:
            world.reset(seed=index)
        try:
            world.do(one(world, names, generator))
            done += 1
        except InterventionError:
            refused += 1
        if index % 10 == 0:
            play(world, actions(1, seed=index))
        if index % 100 == 0:
            values = world.values()
            assert all(np.isfinite(value).all() for value in values.values())
            for name in settable(world):
                bounds = world.model.declared(name).bounds
                moved = name.endswith(("position", "positions", "velocity", "velocities"))
                assert moved or bounds is None or bounds.contains(values[name], values), name
    assert done > count / 20
    assert refused > count / 20
    world.reset(seed=1)
    assert same(world.values(), fresh)
    assert not world.graph.interventions
    np.testing.assert_array_equal(play(world, actions(20)), future)
    world.close()


def test_ten_thousand_dos_leave_no_nan_and_no_drift() -> None:
    """Without physics: after all of them a reset world equals a new one, bit for bit."""
    check("fake", 10_000)


@pytest.mark.parametrize("backend", ["mujoco", pytest.param("bullet", marks=NEEDS_BULLET)])
def test_many_dos_leave_no_nan_and_no_drift(backend: str) -> None:
    """The same on the engines."""
    check(backend, 2_000 if backend == "mujoco" else 500)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["mujoco", pytest.param("bullet", marks=NEEDS_BULLET)])
def test_ten_thousand_dos_on_an_engine(backend: str) -> None:
    """The same ten thousand times."""
    check(backend, 10_000)


def test_taking_everything_back_at_one_instant_leaves_no_trace() -> None:
    """After hundreds of dos at one instant, setting all values back is as if nothing had been."""
    world = World("pushing", backend="mujoco")
    world.reset(seed=1)
    play(world, actions(4))
    start, values = world.snapshot(), world.values()
    future = play(world, actions(30, seed=2))
    world.restore(start)
    generator = np.random.default_rng(3)
    names = [name for name in settable(world) if world.model.target(name) == name]
    for _ in range(300):
        try:
            world.do(one(world, names, generator))
        except InterventionError:
            continue
    world.do({name: values[name] for name in names})
    assert same(world.values(), values)
    np.testing.assert_array_equal(play(world, actions(30, seed=2)), future)
    world.close()
