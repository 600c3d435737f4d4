"""What parameters of a model mean to an engine: plain MuJoCo with the same numbers, and weight."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
from lab import ENGINES

from benchmarks.sabotage import BALLS, CART
from scm_world.queries import World

ARM = """
<mujoco model="arm">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="0.1" stiffness="0.3" springref="0.2"/>
      <inertial pos="0.01 0 -0.2" mass="0.4" diaginertia="0.001 0.002 0.0025"/>
      <body name="lower" pos="0 0 -0.3">
        <joint name="elbow" axis="1 0 0" damping="0.05"/>
        <inertial pos="0 0.02 -0.1" mass="0.2" diaginertia="0.0012 0.001 0.0005"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="motor" joint="shoulder" gear="2" ctrlrange="-2 2"/>
    <position name="servo" joint="elbow" kp="5" kv="0.2"/>
  </actuator>
</mujoco>
"""


def written(model: mujoco.MjModel, element: str, attribute: str, value: Any) -> None:
    """Write a parameter into the arrays of a compiled model, as MuJoCo's reference says."""
    match attribute:
        case "gravity":
            model.opt.gravity[:] = value
        case "mass" | "inertia":
            getattr(model.body(element), attribute)[:] = value
        case "damping" | "stiffness":
            getattr(model.joint(element), attribute)[:] = value
        case "gear":
            model.actuator(element).gear[0] = value
        case "kp":
            model.actuator(element).gainprm[0] = value
            model.actuator(element).biasprm[1] = -value
        case "kv":
            model.actuator(element).biasprm[2] = -value


PARAMETERS = ("gravity", "mass", "inertia", "damping", "stiffness", "gear", "kp", "kv")


def check_motion(world: World, text: str) -> None:
    """Check that joints move as in plain MuJoCo with the values that ``do`` sets.

    Args:
        world: Of hinges and slides.
        text: Its MJCF.
    """
    random, model = np.random.default_rng(2), mujoco.MjModel.from_xml_string(text)
    world.reset(seed=0)
    names = [n for n in world.compiled.parameter_keys if n.rpartition(".")[2] in PARAMETERS]
    values = {name: world[name] * random.uniform(0.75, 1.35) for name in names}
    joints = [model.joint(number).name for number in range(model.njnt)]
    values |= {f"{joint}.position": random.uniform(-0.3, 0.3) for joint in joints}
    values |= {f"{joint}.velocity": random.uniform(-2.0, 2.0) for joint in joints}
    world.do(values)
    for name in names:
        element, _, attribute = name.rpartition(".")
        written(model, element, attribute, values[name])
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    for joint in joints:
        data.joint(joint).qpos[:] = values[f"{joint}.position"]
        data.joint(joint).qvel[:] = values[f"{joint}.velocity"]
    data.ctrl[:] = random.uniform(-1.0, 1.0, model.nu)
    world.step(data.ctrl)
    for _ in range(world.substeps):
        mujoco.mj_step(model, data)
    found = [float(world[f"{joint}.velocity"]) for joint in joints]
    most = np.abs(data.qvel).max()
    np.testing.assert_allclose(found, data.qvel, rtol=0, atol=1e-7 * most)


def check_rest(world: World) -> None:
    """Check that every free ball comes to rest on its radius and presses with its weight."""
    world.reset(seed=0)
    world.do({"one.mass": 0.3, "other.mass": 2.0, "one.size": 0.12, "gravity": [0.0, 0.0, -5.0]})
    while world.index * world.options.control_period < 2.0:
        world.step([])
    contacts = world.backend.contacts()
    for ball in ("one", "other"):
        height = float(world[f"{ball}.cartesian_position"][2])
        assert height == pytest.approx(float(world[f"{ball}.size"]), rel=0.02)
        force = sum(contact.force for contact in contacts if ball in contact.bodies)
        assert force == pytest.approx(5.0 * float(world[f"{ball}.mass"]), rel=0.02)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("text", [ARM, CART], ids=["arm", "cart"])
def test_joints_move_as_in_plain_mujoco(text: str, engine: str) -> None:
    """Masses, inertias, springs, dampers, gears and gains act as their values say."""
    check_motion(World(text, backend=engine), text)


@pytest.mark.parametrize("engine", ENGINES)
def test_balls_rest_on_their_radius_with_their_weight(engine: str) -> None:
    """Sizes, masses and gravity act as their values say."""
    check_rest(World(BALLS, backend=engine))
