"""Facts about thousands of random interventions, most of them wrong in some way."""

from __future__ import annotations

import numpy as np
import pytest
from worlds import NEEDS_BULLET, actions, play, same, settable

from benchmarks.fuzz import random_request
from scm_world.errors import InterventionError
from scm_world.world import Simulation


def check(backend: str, count: int) -> None:
    """Do many things, and compare the world with a new one."""
    world = Simulation("pushing", backend=backend)
    world.reset(seed=1)
    fresh, future = world.values(), play(world, actions(20))
    generator = np.random.default_rng(8)
    done = refused = 0
    for index in range(count):
        if index % 50 == 0:
            world.reset(seed=index)
        try:
            world.do(random_request(world, generator))
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


ENGINES = ["fake", "mujoco", pytest.param("bullet", marks=NEEDS_BULLET)]


@pytest.mark.parametrize("backend", ENGINES)
def test_many_dos_leave_no_nan_and_no_drift(backend: str) -> None:
    """After all of them a reset world equals a new one, bit for bit."""
    check(backend, {"fake": 600, "mujoco": 400, "bullet": 200}[backend])


@pytest.mark.slow
@pytest.mark.parametrize("backend", ENGINES)
def test_ten_thousand_dos_leave_no_nan_and_no_drift(backend: str) -> None:
    """The same ten thousand times."""
    check(backend, 10_000)


def test_taking_everything_back_at_one_instant_leaves_no_trace() -> None:
    """After hundreds of dos at one instant, setting all values back is as if nothing had been."""
    world = Simulation("pushing", backend="mujoco")
    world.reset(seed=1)
    play(world, actions(4))
    start, values = world.snapshot(), world.values()
    future = play(world, actions(30, seed=2))
    world.restore(start)
    generator = np.random.default_rng(3)
    names = [name for name in settable(world) if world.model.target(name) == name]
    for _ in range(300):
        request = random_request(world, generator)
        request.pop("action", None)  # what is held until the reset cannot be set back
        try:
            world.do(request)
        except InterventionError:
            continue
    world.do({name: values[name] for name in names})
    assert same(world.values(), values)
    np.testing.assert_array_equal(play(world, actions(30, seed=2)), future)
    world.close()
