"""How torques and weight move the fingers, against the equations of motion written out."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from scm_world.geometry.rotations import rotation_matrix
from scm_world.tasks.trifinger import hardware

Floats = NDArray[np.float64]
SHIFT = 1e-5  # [rad] for derivatives


def turned(axis: tuple[float, ...], angle: float) -> Floats:
    """Give the rotation about a unit axis, shape (3, 3)."""
    half = angle / 2
    return rotation_matrix([*(np.sin(half) * np.array(axis)), np.cos(half)])


def principal(finger: int, joints: Floats, tip: tuple[float, ...]) -> list[tuple[Floats, Floats]]:
    """Give the center of mass and the principal axes of the moving links and the tip of a finger.

    Args:
        finger: Its number.
        joints: Positions, shape (3,) [rad].
        tip: Center of mass of the tip in its own frame [m].
    """
    base = turned((0.0, 0.0, 1.0), hardware.WORLD_YAW)
    place = base @ np.array(hardware.FINGER_OFFSET[finger])
    turn = base @ turned((0.0, 0.0, 1.0), hardware.FINGER_YAW[finger])
    found = []
    for joint, inertial in enumerate(hardware.INERTIAL[1:]):
        place = place + turn @ np.array(hardware.JOINT_ORIGINS[joint])
        turn = turn @ turned(hardware.JOINT_AXES[joint], joints[joint])
        axes = turn @ rotation_matrix(inertial.orientation)
        found.append((place + turn @ np.array(inertial.center), axes))
    found.append((place + turn @ (np.array(hardware.TIP_ORIGIN) + np.array(tip)), turn))
    return found


def acceleration(
    finger: int, joints: Floats, masses: Floats, torques: Floats, gravity: Floats, engine: str
) -> Floats:
    """Compute joint accelerations at rest, ``M(q)⁻¹ (τ + J^T m g)``, shape (3,) [rad/s²].

    Source:
        Featherstone, *Rigid Body Dynamics Algorithms*, 2008, section 2.4 and 3.3; Jacobians are
        central differences.
    """
    tip = hardware.TIP_CENTER[engine]
    levers, spins = np.zeros((4, 3, 3)), np.zeros((4, 3, 3))
    for joint in range(3):
        step = SHIFT * np.eye(3)[joint]
        ahead, behind = (principal(finger, joints + s, tip) for s in (step, -step))
        for body in range(4):
            levers[body, :, joint] = (ahead[body][0] - behind[body][0]) / (2 * SHIFT)
            turn = ahead[body][1] @ behind[body][1].T
            spin = (turn - turn.T) / (4 * SHIFT)
            spins[body, :, joint] = spin[2, 1], spin[0, 2], spin[1, 0]
    per_mass = [inertial.per_mass for inertial in hardware.INERTIAL[1:]]
    moments = [*(np.array(per_mass) * masses[:, None]), hardware.TIP_INERTIA]
    inertia, forces = np.zeros((3, 3)), torques.copy()
    axes = [axes for _, axes in principal(finger, joints, tip)]
    for body, mass in enumerate([*masses, hardware.TIP_MASS]):
        round_ = axes[body] @ np.diag(moments[body]) @ axes[body].T
        inertia += mass * levers[body].T @ levers[body] + spins[body].T @ round_ @ spins[body]
        forces += mass * levers[body].T @ gravity
    return np.linalg.solve(inertia, forces)


@pytest.mark.parametrize("seed", [0, 1])
def test_torques_and_weight_accelerate_the_fingers(lab, seed: int) -> None:
    """A step from rest is that of the equations of motion, with the masses of links as set."""
    random = np.random.default_rng(seed)
    joints = np.array(hardware.REST) + random.uniform(-0.3, 0.3, 9)
    gravity = np.array([*random.uniform(-2.0, 2.0, 2), -7.0])
    masses = np.array(hardware.LINK_MASS[1:]) * random.uniform(0.75, 1.35, (3, 3))
    parameters = {
        (hardware.link_name(finger, link + 1), "mass"): masses[number, link]
        for number, finger in enumerate(hardware.FINGERS)
        for link in range(3)
    }
    parameters["world", "gravity"] = gravity
    parameters["controller", "safety_damping"] = np.zeros(3)  # it brakes within the step
    lab.place([1.0, 0.0, 0.5], parameters, joints=joints, torques=True)
    torques = random.uniform(-0.2, 0.2, 9)
    lab.backend.step(torques, 1)
    found = lab.backend.read().joint_velocities / lab.preset.timestep
    expected = [
        acceleration(
            k, joints[3 * k : 3 * k + 3], masses[k], torques[3 * k : 3 * k + 3], gravity,
            lab.engine,
        )
        for k in range(3)
    ]  # fmt: skip
    np.testing.assert_allclose(found, np.ravel(expected), rtol=1e-4)
