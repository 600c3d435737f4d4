"""The independent fit of recordings of real machines: its equations, and its derivatives."""

from functools import partial
from typing import Any

import mujoco
import numpy as np
import pytest

from benchmarks.real import MACHINES, Machine, jacobian, one_link, owner, two_links

FRICTION = ("frictionloss", "damping")


def accelerations(machine: Machine, state: Any, torque: Any) -> Any:
    """Return the accelerations of plain MuJoCo without friction."""
    spec = mujoco.MjSpec.from_string(machine.text.format(timestep=0.001))
    for joint in spec.joints:
        joint.frictionloss, joint.damping = 0.0, 0.0 * np.asarray(joint.damping)
    model = spec.compile()
    data = mujoco.MjData(model)
    found = []
    for row, given in zip(state, torque, strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = row[: model.nq], row[model.nq :], given
        mujoco.mj_forward(model, data)
        found.append(data.qacc.copy())
    return np.array(found)


def test_equations_of_two_links_are_those_of_the_engine() -> None:
    """At random states and torques, without friction."""
    rng = np.random.default_rng(0)
    state, torque = rng.normal(size=(20, 4)), rng.uniform(-1.0, 1.0, (20, 2))
    values = {"upper.mass": 0.6, "lower.mass": 0.5}
    names = [f"{joint}.{kind}" for joint in ("shoulder", "elbow") for kind in FRICTION]
    values |= dict.fromkeys([*names, "shoulder.armature", "elbow.armature"], 0.0)
    found = two_links(values, state, torque)
    machine = MACHINES["double pendulum"]
    assert found == pytest.approx(accelerations(machine, state, torque), rel=1e-9, abs=1e-9)


def test_equations_of_a_pendulum_are_nearly_those_of_the_engine() -> None:
    """They take the weight as a point and the rod as a line."""
    rng = np.random.default_rng(1)
    state, torque = rng.normal(size=(20, 2)), rng.uniform(-1.0, 1.0, (20, 1))
    values = {"weight.mass": 0.5, "motor.gear": 1.0, "hinge.damping": 0.0}
    found = one_link({**values, "hinge.frictionloss": 0.0}, state, torque)
    plain = accelerations(MACHINES["pendulum"], state, torque)
    assert found == pytest.approx(plain, rel=0.01, abs=0.01)


def test_derivatives_by_colours_are_those_of_each_number() -> None:
    """Of residuals of segments and gaps that are not linear."""
    count, segments, width = 2, 7, 2
    rng = np.random.default_rng(2)
    target = rng.normal(size=(segments, 5))

    def residual(x: Any) -> Any:
        start = x[count:].reshape(segments, width)
        times = np.arange(1, 6)
        path = np.sin(x[0] * times + start[:, :1]) + x[1] * start[:, 1:] * times
        ends = np.stack([path[:-1, -1], path[:-1, -2] ** 2], 1)
        return np.concatenate([(path - target).ravel(), (ends - start[1:]).ravel()])

    x = rng.normal(size=count + segments * width)
    made = jacobian(partial(residual), count, width, x)
    step = 1e-6 * np.eye(len(x))
    each = np.array([(residual(x + one) - residual(x)) / 1e-6 for one in step]).T
    assert owner(len(each), segments, width).shape == (len(each), 2)
    assert made == pytest.approx(each, abs=1e-7)
