"""Recordings in degrees, or with quaternions in another order, are noticed; honest ones pass."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import scm_world as sw
from scm_world.errors import ModelError
from scm_world.fit.recordings import read_recording
from scm_world.fit.units import check_units

ARM = """
<mujoco model="arm">
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.02"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.3"/>
      <body name="lower" pos="0 0 -0.4">
        <joint name="elbow" axis="0 1 0" damping="0.02"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.2"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="shoulder" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
ANGLES, RATES = ("shoulder.position", "elbow.position"), ("shoulder.velocity", "elbow.velocity")
NOISE, STEPS = 2e-3, 60  # [rad]

Arrays = dict[str, Any]


def recorded(world: sw.World, names: tuple[str, ...], **options: Any) -> Arrays:
    """Return time, commands and noisy measurements of a run of a robot like a world."""
    episode = world.rollout("random", seed=1, steps=STEPS, **options)
    rng, dt = np.random.default_rng(0), world.options.control_period
    found: Arrays = {"time": dt * np.arange(STEPS + 1)}
    found |= {name: episode.actions[:, at] for name, at in world.compiled.actions.items()}
    return found | {n: episode[n] + NOISE * rng.normal(size=episode[n].shape) for n in names}


def check(world: sw.World, recording: Arrays) -> None:
    """Read a recording, and check its units."""
    world.reset(seed=0)
    check_units(world, read_recording(world, recording))


def degrees(*names: str) -> Callable[[Arrays], Arrays]:
    """Return what writes some columns in degrees."""
    return lambda found: found | {name: np.degrees(found[name]) for name in names}


@pytest.fixture(scope="module")
def arm() -> sw.World:
    """An arm whose joints have no limits."""
    return sw.World.from_mjcf(ARM)


@pytest.mark.parametrize(
    ("measured", "wrong", "named"),
    [
        (ANGLES, ANGLES, "shoulder.position, elbow.position"),
        (ANGLES, ANGLES[1:], "elbow.position"),
        (ANGLES[:1], ANGLES[:1], "shoulder.position"),
        (ANGLES + RATES, ANGLES + RATES, "shoulder.position, elbow.position, shoulder.velocity"),
        (ANGLES + RATES, ANGLES, "shoulder.position, elbow.position"),
        (ANGLES + RATES, RATES, "shoulder.velocity, elbow.velocity"),
        (RATES, RATES, "shoulder.velocity, elbow.velocity"),
    ],
)
def test_degrees_are_noticed_without_limits(
    arm: sw.World, measured: tuple[str, ...], wrong: tuple[str, ...], named: str
) -> None:
    """By velocities, if they were recorded, and by the motion; also if the robot deviates."""
    found = recorded(arm, measured, do={"shoulder.damping": 0.06, "lower.mass": 0.3})
    check(arm, found)
    with pytest.raises(ModelError, match=rf"^the values of {named}[^:]* are in degrees.*deg2rad"):
        check(arm, degrees(*wrong)(found))


def test_degrees_may_jump_by_a_turn(arm: sw.World) -> None:
    """And a cell may be empty; a fit refuses the recording."""
    found = recorded(arm, ANGLES, do={"shoulder.velocity": 12.0})
    wrapped = np.degrees(found[ANGLES[0]]) + 180.0
    found |= {ANGLES[0]: wrapped % 360.0 - 180.0, ANGLES[1]: np.degrees(found[ANGLES[1]])}
    found[ANGLES[1]][7] = np.nan
    assert np.abs(np.diff(found[ANGLES[0]])).max() > 300.0
    with pytest.raises(ModelError, match=r"shoulder.position, elbow.position are in degrees"):
        arm.fit(found, "shoulder.damping")


def test_motion_without_a_scale_tells_nothing() -> None:
    """A wheel that nothing drives turns alike in degrees and in radians."""
    wheel = "<geom type='cylinder' size='0.1 0.02'/><joint name='axle' damping='0.001'/>"
    world = sw.World.from_mjcf(f"<mujoco><worldbody><body>{wheel}</body></worldbody></mujoco>")
    found = recorded(world, ("axle.position",), do={"axle.velocity": 20.0})
    check(world, found)
    check(world, degrees("axle.position")(found))


GYMNASIUM = "envs/mujoco/assets"


@pytest.mark.parametrize("name", ["ant", "humanoid"])
def test_quaternions_that_begin_with_w_are_noticed(name: str) -> None:
    """The root of a legged robot; angles of joints and orientation as they are pass."""
    package = find_spec("gymnasium")
    assert package is not None
    world = sw.World.from_mjcf(Path(str(package.origin)).parent / f"{GYMNASIUM}/{name}.xml")
    names = [n for n in world.compiled.slices if n.endswith((".position", "orientation"))]
    found = recorded(world, (*names, "torso.cartesian_position"))
    check(world, found)
    swapped = found | {"torso.orientation": np.roll(found["torso.orientation"], 1, axis=1)}
    words = r"^the values of torso.orientation are \(w, x, y, z\): .* as x, y, z, w; if they are"
    with pytest.raises(ModelError, match=words):
        check(world, swapped)


def test_an_angular_velocity_tells_the_order_of_a_quaternion() -> None:
    """Also of a body that falls freely, and that began upside down."""
    world = sw.World.from_mjcf(
        "<mujoco><worldbody><body name='box' pos='0 0 9'><freejoint/>"
        "<geom type='box' size='0.1 0.2 0.3'/></body></worldbody></mujoco>"
    )
    names = ("box.orientation", "box.angular_velocity")
    start = {"box.orientation": [1.0, 0.0, 0.0, 0.0], "box.angular_velocity": [3.0, 2.0, -4.0]}
    found = recorded(world, names, do=start)
    check(world, found)
    with pytest.raises(ModelError, match=r"box.orientation are \(w, x, y, z\)"):
        check(world, found | {names[0]: np.roll(found[names[0]], 1, axis=1)})
