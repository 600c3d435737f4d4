"""Viscous joints. The engine has them too, but with a torque from before the step, which explodes.

That torque, ``-damping * velocity``, is one of the speed that it brakes: above 0.1 N m s/rad the
light lower links would turn back faster than they came. Here it is the one at the end of the step,
as in MuJoCo's integrators.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numba import njit

from scm_world._types import Floats
from scm_world.backends.bullet.vectors import (
    Vector,
    applied,
    cross,
    dot,
    plus,
    scaled,
    turned,
    vector,
)
from scm_world.geometry.rotations import rotation_matrix
from scm_world.tasks.trifinger import hardware

Resistance = Callable[[Sequence[Any], Sequence[float]], list[float]]
"""From joint states (position, velocity, …) and nine torques to the torques with resistance."""

MASSES = tuple(
    (hardware.link_name(finger, link), "mass") for finger in hardware.FINGERS for link in (1, 2, 3)
)
"""Keys of the masses that move, in the order of the joints."""


def _per_mass(part: hardware.Inertial) -> Floats:
    """Give the inertia of a link divided by its mass, in its frame, shape (3, 3) [m²]."""
    turn = rotation_matrix(part.orientation)
    return np.asarray(turn @ np.diag(part.per_mass) @ turn.T)


_AXES = np.array(hardware.JOINT_AXES)
_OFFSETS = np.array(hardware.JOINT_ORIGINS)
_CENTERS = np.array([*(part.center for part in hardware.INERTIAL[1:]), hardware.TIP_ORIGIN])
_INERTIAS = np.array(
    [
        *(_per_mass(part) for part in hardware.INERTIAL[1:]),
        np.diag(hardware.TIP_INERTIA) / hardware.TIP_MASS,
    ]
)
"""Centers [m] and inertias per mass [m²] of links 1, 2, 3 and of the tip, which moves with 3."""

_TIP, _TIP_MASS = 3, hardware.TIP_MASS
_YAWS = np.array([hardware.WORLD_YAW + yaw for yaw in hardware.FINGER_YAW])


def resistance(
    damping: float, timestep: float, gravity: Sequence[float], masses: Sequence[float]
) -> Resistance:
    """Make a function that adds the resistance of viscous joints to torques.

    Args:
        damping: Of every joint [N m s/rad].
        timestep: Physics step [s].
        gravity: Shape (3,) [m/s²].
        masses: Of the nine moving links, see ``MASSES`` [kg].
    """
    pull, weights = np.array(gravity), np.array(masses).reshape(3, 3)

    def resisted(states: Sequence[Any], torques: Sequence[float]) -> list[float]:
        known = np.array([[s[0] for s in states], [s[1] for s in states], torques])
        result: list[float] = _resist(known, pull, weights, damping, timestep).tolist()
        return result

    return resisted


@njit(cache=True)
def _resist(
    known: Floats, gravity: Floats, masses: Floats, damping: float, timestep: float
) -> Floats:
    """Find the torques whose explicit step is the implicit step with damping.

    With mass matrix M, bias b, damping D, torques t and step h, the implicit step has the
    acceleration ``a = (M + h D)^-1 (t - b - D v)``; the torques ``M a + b`` bring it about.

    Args:
        known: Positions [rad], velocities [rad/s] and torques [N m] of the joints, shape (3, 9).
        gravity: Shape (3,) [m/s²].
        masses: Of the moving links of each finger, shape (3, 3) [kg].
        damping: [N m s/rad].
        timestep: [s].
    """
    result = np.empty(9)
    for finger in range(3):
        start = 3 * finger
        angles, speeds = known[0, start : start + 3], known[1, start : start + 3]
        cos, sin = math.cos(_YAWS[finger]), math.sin(_YAWS[finger])
        along = cos * gravity[0] + sin * gravity[1]
        across = cos * gravity[1] - sin * gravity[0]
        pull = (along, across, gravity[2])
        bias = inverse_dynamics(angles, speeds, np.zeros(3), pull, masses[finger])
        inertia = mass_matrix(angles, masses[finger])
        wanted = known[2, start : start + 3] - bias - damping * speeds
        acceleration = _solve(inertia + timestep * damping * np.eye(3), wanted)
        for j in range(3):
            result[start + j] = bias[j] + dot(inertia[j], acceleration)
    return result


@njit(cache=True)
def mass_matrix(angles: Floats, masses: Floats) -> Floats:
    """Compute the mass matrix of one finger, shape (3, 3) [kg m²]; see ``inverse_dynamics``."""
    matrix = np.empty((3, 3))
    for j, unit in enumerate(np.eye(3)):
        matrix[j] = inverse_dynamics(angles, np.zeros(3), unit, (0.0, 0.0, 0.0), masses)
    return matrix


@njit(cache=True)
def inverse_dynamics(
    angles: Floats, speeds: Floats, accelerations: Floats, gravity: Vector, masses: Floats
) -> Floats:
    """Compute the torques of one finger that bring about some accelerations.

    Args:
        angles: Shape (3,) [rad].
        speeds: Shape (3,) [rad/s].
        accelerations: Shape (3,) [rad/s²].
        gravity: In the frame of the finger base, shape (3,) [m/s²].
        masses: Of links 1, 2, 3, shape (3,) [kg]; the tip is added.

    Returns:
        Shape (3,) [N m].

    Source:
        The recursive Newton-Euler algorithm; Featherstone, *Rigid Body Dynamics Algorithms*, 2008,
        section 5.3, with all vectors in the frames of the links.
    """
    forces, moments = np.zeros((3, 3)), np.zeros((3, 3))
    spin, growth, rise = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), scaled(-1.0, gravity)
    for link in range(3):
        axis, angle = vector(_AXES[link]), angles[link]
        rise = turned(axis, -angle, _moved(rise, growth, spin, vector(_OFFSETS[link])))
        spin, growth = turned(axis, -angle, spin), turned(axis, -angle, growth)
        twist = scaled(speeds[link], axis)
        growth = plus(plus(growth, cross(spin, twist)), scaled(accelerations[link], axis))
        spin = plus(spin, twist)
        _carry(link, masses[link], rise, growth, spin, forces[link], moments[link])
        if link == 2:
            _carry(_TIP, _TIP_MASS, rise, growth, spin, forces[link], moments[link])
    torques = np.empty(3)
    force, moment = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for link in (2, 1, 0):
        axis = vector(_AXES[link])
        force = plus(force, vector(forces[link]))
        moment = plus(moment, vector(moments[link]))
        torques[link] = dot(axis, moment)
        force, moment = turned(axis, angles[link], force), turned(axis, angles[link], moment)
        moment = plus(moment, cross(vector(_OFFSETS[link]), force))
    return torques


@njit(cache=True)
def _carry(
    part: int,
    mass: float,
    rise: Vector,
    growth: Vector,
    spin: Vector,
    force: Floats,
    moment: Floats,
) -> None:
    """Add what a part needs to move so: force, and moment about the origin of its link."""
    center = vector(_CENTERS[part])
    push = scaled(mass, _moved(rise, growth, spin, center))
    inertia = _INERTIAS[part]
    turning = cross(spin, applied(inertia, spin))
    turning = scaled(mass, plus(turning, applied(inertia, growth)))
    turning = plus(turning, cross(center, push))
    for k in range(3):
        force[k] += push[k]
        moment[k] += turning[k]


@njit(cache=True)
def _moved(rise: Vector, growth: Vector, spin: Vector, arm: Vector) -> Vector:
    """Give the acceleration of a point of a body from that of its origin [m/s²]."""
    return plus(plus(rise, cross(growth, arm)), cross(spin, cross(spin, arm)))


@njit(cache=True)
def _solve(matrix: Floats, right: Floats) -> Vector:
    """Solve three equations by Cramer's rule."""
    a, b, c = vector(matrix[0]), vector(matrix[1]), vector(matrix[2])
    bc, ca, ab = cross(b, c), cross(c, a), cross(a, b)
    total = plus(plus(scaled(right[0], bc), scaled(right[1], ca)), scaled(right[2], ab))
    return scaled(1.0 / dot(a, bc), total)
