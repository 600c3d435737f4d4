"""How torques and weight move the fingers, against the equations of motion written out."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from scm_world.backends.mujoco.reading import compiled
from scm_world.geometry.rotations import rotation_matrix
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.system import tip_name, trifinger

Floats = NDArray[np.float64]
SHIFT = 1e-5  # [rad] for derivatives


def turned(axis: tuple[float, ...], angle: float) -> Floats:
    """Give the rotation about a unit axis, shape (3, 3)."""
    half = angle / 2
    return rotation_matrix([*(np.sin(half) * np.array(axis)), np.cos(half)])


def principal(finger: int, joints: Floats) -> list[tuple[Floats, Floats]]:
    """Return the centers of mass and the principal axes of the moving links and the tip.

    Args:
        finger: Its number.
        joints: Positions, shape (3,) [rad].
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
    found.append((place + turn @ np.array(hardware.TIP_ORIGIN), turn))
    return found


def holding(finger: int, joints: Floats, gravity: Floats) -> Floats:
    """Compute the torques that carry the weight, masses times levers, shape (3,) [N m]."""
    turn = turned((0.0, 0.0, 1.0), hardware.WORLD_YAW)
    hinge = turn @ np.array(hardware.FINGER_OFFSET[finger])
    turn = turn @ turned((0.0, 0.0, 1.0), hardware.FINGER_YAW[finger])
    centers = [center for center, _ in principal(finger, joints)]
    weights = np.outer([*hardware.LINK_MASS[1:], hardware.TIP_MASS], gravity)
    found = np.zeros(3)
    for joint in range(3):
        hinge = hinge + turn @ np.array(hardware.JOINT_ORIGINS[joint])
        axis = turn @ np.array(hardware.JOINT_AXES[joint])
        turn = turn @ turned(hardware.JOINT_AXES[joint], joints[joint])
        levers = np.array(centers[joint:]) - hinge
        found[joint] = -axis @ np.cross(levers, weights[joint:]).sum(axis=0)
    return found


def acceleration(
    finger: int, joints: Floats, masses: Floats, torques: Floats, gravity: Floats
) -> Floats:
    """Compute joint accelerations at rest, ``M(q)⁻¹ (τ + J^T m g)``, shape (3,) [rad/s²].

    Source:
        Featherstone, *Rigid Body Dynamics Algorithms*, 2008, section 2.4 and 3.3; Jacobians are
        central differences.
    """
    levers, spins = np.zeros((4, 3, 3)), np.zeros((4, 3, 3))
    for joint in range(3):
        step = SHIFT * np.eye(3)[joint]
        ahead, behind = (principal(finger, joints + s) for s in (step, -step))
        for body in range(4):
            levers[body, :, joint] = (ahead[body][0] - behind[body][0]) / (2 * SHIFT)
            turn = ahead[body][1] @ behind[body][1].T
            spin = (turn - turn.T) / (4 * SHIFT)
            spins[body, :, joint] = spin[2, 1], spin[0, 2], spin[1, 0]
    per_mass = [inertial.per_mass for inertial in hardware.INERTIAL[1:]]
    moments = [*(np.array(per_mass) * masses[:, None]), hardware.TIP_INERTIA]
    inertia, forces = np.zeros((3, 3)), torques.copy()
    axes = [axes for _, axes in principal(finger, joints)]
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
        acceleration(k, joints[3 * k : 3 * k + 3], masses[k], torques[3 * k : 3 * k + 3], gravity)
        for k in range(3)
    ]
    np.testing.assert_allclose(found, np.ravel(expected), rtol=1e-4)


def test_the_torques_of_the_weight_hold_the_fingers_at_rest(lab) -> None:
    """They are masses times levers, with the 10 g of a fingertip 0.16 m below the last joint."""
    joints, gravity = np.tile([0.0, 0.5, 0.7], 3), np.array([0.0, 0.0, -9.81])
    torques = [holding(k, joints[3 * k : 3 * k + 3], gravity) for k in range(3)]
    moment = 0.0307 * 0.089 + 0.01 * 0.16  # [kg m] of the lower link and its tip
    for found in torques:
        assert found[2] == pytest.approx(9.81 * moment * np.sin(0.5 + 0.7))
    lab.place([1.0, 0.0, 0.5], {("world", "gravity"): gravity}, joints=joints, torques=True)
    lab.backend.step(np.ravel(torques), 50)
    np.testing.assert_allclose(lab.backend.read().joint_positions, joints, rtol=0, atol=1e-9)


@pytest.mark.parametrize("torques", [False, True])
def test_a_finger_weighs_as_much_as_its_links_and_its_tip(torques: bool) -> None:
    """The compiled model has their masses, and a tip has its own in the middle of its frame."""
    mj = compiled(trifinger(torques=torques))
    for finger in hardware.FINGERS:
        tip, upper = mj.body(tip_name(finger)).id, mj.body(hardware.link_name(finger, 1)).id
        assert mj.body_subtreemass[upper] == pytest.approx(0.14854 + 0.14854 + 0.0307 + 0.01)
        assert mj.body_mass[tip] == hardware.TIP_MASS
        assert mj.body_ipos[tip].tolist() == [0.0, 0.0, 0.0]
