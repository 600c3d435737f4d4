"""In a world of any model, no intervention puts two bodies into one place."""

from __future__ import annotations

import numpy as np
import pytest
from worlds import BACKENDS, NEEDS_BULLET

from scm_world import Draw, ModelTask, World
from scm_world.errors import Infeasible
from scm_world.tasks.composition import Composition
from scm_world.variables import Box

SCENE = """
<mujoco model="arm and ball">
  <worldbody>
    <geom name="floor" type="plane" size="2 2 0.1"/>
    <body name="arm" pos="0 0 0.5">
      <joint name="hinge" type="hinge" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>
      <body name="hand" pos="0.3 0 0">
        <joint name="wrist" type="hinge" axis="0 1 0" damping="0.1"/>
        <geom type="box" size="0.04 0.04 0.04"/>
        <body name="nail" pos="0.03 0 0">
          <joint name="nail" type="slide" axis="1 0 0" range="-0.02 0.02" damping="1"/>
          <geom type="sphere" size="0.02"/>
        </body>
      </body>
    </body>
    <body name="sleeve" pos="0.15 0 0.5">
      <joint name="sleeve" type="slide" axis="1 0 0" damping="1"/>
      <geom name="sleeve" type="box" size="0.03 0.03 0.03"/>
    </body>
    <body name="ball" pos="-0.5 0 0.1">
      <freejoint/>
      <geom name="ball" type="sphere" size="0.1" mass="1"/>
    </body>
  </worldbody>
  <option gravity="0 0 0"/>
</mujoco>
"""
PLACE = "ball.cartesian_position"
ENGINES = [
    pytest.param(b, marks=NEEDS_BULLET if b == "bullet" else ()) for b in BACKENDS if b != "fake"
]


def begin(backend: str = "mujoco") -> World:
    """Make the world, and begin."""
    world = World(ModelTask(SCENE), backend=backend)
    world.reset(seed=0)
    return world


@pytest.mark.parametrize("backend", ENGINES)
def test_a_body_in_another_is_refused_with_the_depth_and_the_nearest_place(backend: str) -> None:
    """Nothing has changed then, and the nearest place is as deep as is tolerated."""
    world = begin(backend)
    before = world.values()
    with pytest.raises(Infeasible, match="'ball' lies 20 mm deep in 'world'") as refused:
        world.do({PLACE: [-0.5, 0.0, 0.08]})
    assert refused.value.variable == PLACE
    np.testing.assert_allclose(refused.value.nearest, [-0.5, 0.0, 0.099], atol=1e-6)
    with pytest.raises(Infeasible, match=r"'ball' lies .* deep in 'hand'"):
        world.do({PLACE: [0.3, 0.0, 0.6]})
    assert all(np.array_equal(world[name], value) for name, value in before.items())
    world.do({PLACE: refused.value.nearest})
    world.close()


def test_a_shape_that_grows_into_another_is_refused() -> None:
    """Sizes count as places do, and so does what is turned by a joint."""
    world = begin()
    with pytest.raises(Infeasible, match="'ball' lies 50 mm deep in 'world'"):
        world.do({"ball.size": 0.15})
    world.do({PLACE: [0.25, 0.0, 0.25]})
    with pytest.raises(Infeasible, match=r"'ball' lies .* deep in 'hand'"):
        world.do({"hinge.position": 0.6})


def test_what_lies_in_one_another_in_the_file_may_do_so() -> None:
    """The sleeve around the arm, and the nail in the hand, are meant to be there."""
    world = begin()
    world.do({"sleeve.position": 0.05, "hinge.position": 0.1})
    world.do({"nail.position": -0.01})


def test_what_physics_left_may_stay_but_go_no_deeper() -> None:
    """A ball that was pressed into the floor can be moved along it."""
    world = begin()
    world.do({"gravity": [0.0, 0.0, -300.0]})
    while world[PLACE][2] > 0.097:
        world.step(world.task.idle(world))
    x, y, z = world[PLACE]
    world.do({PLACE: [x + 0.1, y, z]})
    with pytest.raises(Infeasible, match="'ball'"):
        world.do({PLACE: [x, y, z - 0.002]})


def test_draws_are_repeated_until_bodies_are_apart() -> None:
    """Half of the space is below the floor, and some is in the arm."""
    world = begin()
    for episode in range(30):
        space = Box((-0.3, -0.2, -0.6), (0.5, 0.2, 0.8))
        world.reset(seed=1, episode=episode, do={PLACE: Draw(space)})
        assert world[PLACE][2] > 0.0989
        assert world.composition.overlaps(world.scene()) == ()


def test_nothing_is_looked_at_where_nothing_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    """A velocity, a mass and gravity put no body anywhere."""
    world = begin()

    def fail(*_: object, **__: object) -> None:
        raise AssertionError

    monkeypatch.setattr(Composition, "overlaps", fail)
    world.do({"hinge.velocity": 1.0, "ball.mass": 2.0, "gravity": [0.0, 0.0, -1.0]})
    with pytest.raises(AssertionError):
        world.do({"hinge.position": 0.01})
