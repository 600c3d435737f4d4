"""Chains of joints, against MuJoCo's own forward kinematics."""

from __future__ import annotations

import pickle

import mujoco
import numpy as np

from scm_world import ModelTask, World
from scm_world.geometry.chains import Chain

ARM = """<mujoco><worldbody><body name="base" pos="0 0 1" quat="0.9 0.1 0.2 0.3"><freejoint/>
  <geom size="0.1"/><body name="upper" pos="0.1 0.2 0.3" euler="10 20 30">
  <joint name="ball" type="ball" pos="0.01 0.02 0.03"/><geom size="0.1" pos="0.1 0 0"/>
  <body name="lower" pos="0 0 0.5"><joint name="slide" type="slide" axis="1 2 3" ref="0.1"/>
  <joint name="hinge" axis="0 1 1" pos="0.1 0 0.05" ref="20"/><geom size="0.1"/>
  <site name="tip" pos="0 0.1 0.4" euler="40 0 5"/></body></body></body></worldbody></mujoco>"""


def test_it_is_where_the_engine_says() -> None:
    """With every type of joint, off-center and with references, in random states, copied too."""
    world = World(ModelTask(ARM, outcomes=("tip.position", "tip.orientation", "lower.orientation")))
    mj = mujoco.MjModel.from_xml_string(ARM)
    data, rng = mujoco.MjData(mj), np.random.default_rng(0)
    for readout in world.task.system.readouts:
        assert isinstance(readout.function, Chain)
        function = pickle.loads(pickle.dumps(readout.function))  # noqa: S301 # our own
        assert function == readout.function
        for _ in range(5):
            mujoco.mj_integratePos(mj, data.qpos, rng.normal(size=mj.nv), 1.0)
            mujoco.mj_kinematics(mj, data)
            free, ball = data.qpos[:7], data.qpos[7:11]
            turned = free[[4, 5, 6, 3]], ball[[1, 2, 3, 0]]
            found = function(free[:3], turned[0], turned[1], data.qpos[11], data.qpos[12])
            if readout.name == "tip.position":
                expected = data.site("tip").xpos
            else:
                expected = np.empty(4)
                tip = data.site("tip") if "tip" in readout.name else data.body("lower")
                mujoco.mju_mat2Quat(expected, tip.xmat)
                expected = expected[[1, 2, 3, 0]] * np.sign(expected[0])
            np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-14)


def test_worlds_compute_it_as_the_function_says() -> None:
    """Bit for bit; the mechanism can be found again under its name."""
    world = World(ModelTask(ARM, outcomes=("tip.position",)))
    world.reset(seed=0)
    world.do({"hinge.position": 0.7, "slide.position": 0.2})
    (readout,) = world.task.system.readouts
    expected = readout.function(*(world[parent] for parent in readout.parents))
    np.testing.assert_array_equal(world["tip.position"], expected)
    assert world.model.declared("tip.position").mechanism.is_portable()
