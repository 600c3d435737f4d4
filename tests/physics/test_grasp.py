"""Three fingers and a block."""

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.kinematics import forward, inverse

TIP_RADIUS = hardware.COLLISION["tip"].radius
HEIGHT = hardware.NOMINAL_HEIGHT
PERIOD = 0.02  # [s] between two commands


def around(size: float, gaps: tuple[float, float, float], height: float) -> NDArray[np.float64]:
    """Place one fingertip before each of three sides of a cube at the origin."""
    reach = size / 2 + TIP_RADIUS + np.array(gaps)
    return np.array([0.0, reach[0], height, reach[1], 0.0, height, -reach[2], 0.0, height])


def lift(size: float) -> Iterator[tuple[float, NDArray[np.float64], NDArray[np.float64]]]:
    """List the phases: seconds, and the tips at the beginning and the end."""
    open_, closed = (0.03,) * 3, (-0.002, -0.012, -0.012)
    low, high = size / 2, size / 2 + 0.1
    yield 0.6, around(size, open_, 0.12), around(size, open_, low)
    yield 0.4, around(size, open_, low), around(size, closed, low)
    yield 0.3, around(size, closed, low), around(size, closed, low)
    yield 1.5, around(size, closed, low), around(size, closed, high)
    yield 1.0, around(size, closed, high), around(size, closed, high)


@pytest.mark.parametrize(("size", "mass", "friction"), [(0.065, 0.02, 0.8), (0.055, 0.04, 0.9)])
def test_lift(lab, size: float, mass: float, friction: float) -> None:
    """A squeezed block goes up by 0.1 m and slips by less than 0.5 mm/s while it is held."""
    joints = inverse(around(size, (0.03,) * 3, 0.12), HEIGHT, hardware.REST).joint_positions
    parameters = {
        ("tool_block", "size"): [size] * 3,
        ("tool_block", "mass"): mass,
        ("robot", "friction"): friction,
    }
    lab.place([0.0, 0.0, size / 2], parameters, joints=joints, height=HEIGHT)
    offsets = []
    for seconds, first, last in lift(size):
        steps = round(seconds / PERIOD)
        for i in range(steps):
            share = (i + 1) / steps
            solution = inverse((1 - share) * first + share * last, HEIGHT, joints)
            assert solution.reached.all()
            joints = solution.joint_positions
            lab.backend.step(joints, round(PERIOD / lab.preset.timestep))
            state = lab.backend.read()
            tips = forward(state.joint_positions, HEIGHT).reshape(3, 3)
            offsets.append(state.positions[0] - tips.mean(axis=0))
    assert state.positions[0, 2] - size / 2 == pytest.approx(0.1, abs=0.01)
    touching = {body for contact in lab.backend.contacts() for body in contact.bodies}
    assert touching == {"tool_block", *(hardware.link_name(f, 3) for f in hardware.FINGERS)}
    slip = np.linalg.norm(offsets[-1] - offsets[-26]) / (25 * PERIOD)
    assert slip < 5e-4
