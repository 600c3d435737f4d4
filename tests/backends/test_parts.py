"""Parts that are added to model files act as their formulas say."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from scm_world.backends.mujoco.parts import Part, drives_of, with_part

LINK = """
<mujoco><option timestep="0.0005" gravity="0 0 0"/>
  <worldbody><body name="link"><joint name="hinge" axis="0 1 0"/>
    <inertial pos="0 0 0" mass="1" diaginertia="0.02 0.02 0.02"/></body></worldbody>
  <actuator><motor name="motor" joint="hinge" gear="3"/></actuator>
</mujoco>
"""


def test_a_spring_between_rotor_and_link_has_the_frequency_of_two_inertias() -> None:
    """The angular frequency is sqrt(k (1 / J + 1 / I)), and the motor turns the rotor."""
    spec = with_part(LINK, Part("spring", "hinge"))
    spec.tendon("hinge_gear").damping = [0.0, 0.0, 0.0]
    model = spec.compile()
    data, found = mujoco.MjData(model), []
    data.qpos[model.joint("hinge_rotor").qposadr[0]] = 0.1
    apart = [int(model.joint(name).qposadr[0]) for name in ("hinge_rotor", "hinge")]
    for _ in range(2000):
        mujoco.mj_step(model, data)
        found.append(data.qpos[apart[0]] - data.qpos[apart[1]])
    rotor = model.dof_armature[model.joint("hinge_rotor").dofadr[0]] + 1e-6
    true = np.sqrt(model.tendon_stiffness[0] * (1.0 / rotor + 1.0 / 0.02))
    below = np.flatnonzero((np.array(found[:-1]) > 0.0) & (np.array(found[1:]) <= 0.0))
    period = 0.0005 * (below[-1] - below[0]) / (len(below) - 1)
    assert 2.0 * np.pi / period == pytest.approx(true, rel=0.01)
    assert [drive.joint for drive in drives_of(model)] == ["hinge_rotor"]


def test_a_backlash_lets_rotor_and_link_turn_apart_up_to_its_ends() -> None:
    """A pushed rotor turns through half of the backlash before it takes the link along."""
    model = with_part(LINK, Part("backlash", "hinge", 0.05)).compile()
    data = mujoco.MjData(model)
    data.ctrl[0] = 0.01
    apart, moved = [], []
    for _ in range(1000):
        mujoco.mj_step(model, data)
        rotor, link = (float(data.joint(name).qpos[0]) for name in ("hinge_rotor", "hinge"))
        apart.append(rotor - link)
        moved.append(abs(link))
    inside = np.array(apart) < 0.04
    assert max(np.array(moved)[: int(np.argmin(inside))]) < 1e-9
    assert max(apart) == pytest.approx(0.05, abs=0.005)
    assert moved[-1] > 0.05
