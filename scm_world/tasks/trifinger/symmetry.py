"""The robot looks the same after a third of a turn, and so does what it does to a scene."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from typing import Any

import numpy as np

from scm_world._types import Floats, Value
from scm_world.errors import UnknownOption
from scm_world.tasks.trifinger.kinematics import N_FINGERS

JOINTS = ("joint_positions", "joint_velocities", "joint_torques", "action")
UNTURNED = ("size", "mass", "friction")
_BEFORE = np.array([1, 2, 0])
"""Which finger stands, before the scene is turned by a third, where each one stands afterwards."""


def swapped(joints: Floats, thirds: int) -> Floats:
    """Give what belongs to joints, shape (9,), after the scene is turned by thirds of a turn."""
    fingers = np.asarray(joints, dtype=float).reshape(N_FINGERS, -1)
    for _ in range(thirds):
        fingers = fingers[_BEFORE]
    return fingers.ravel()


def turned(
    values: Mapping[str, Value], names: Iterable[str], thirds: int, bodies: Collection[str]
) -> dict[str, Any]:
    """Give the values of a scene that is turned about the vertical by thirds of a turn.

    Args:
        values: Of these variables.
        names: Of the variables that are wanted.
        thirds: How many.
        bodies: Names of blocks and goals.

    Raises:
        UnknownOption: It is not known how a variable turns.
    """
    angle = 2.0 * math.pi / 3.0 * thirds
    cos, sin = math.cos(angle), math.sin(angle)
    axes = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    half, rest = math.sin(angle / 2.0), math.cos(angle / 2.0)

    def one(name: str) -> Any:
        body, _, part = name.rpartition(".")
        value = np.asarray(values[name], dtype=float)
        if name in JOINTS:
            return swapped(value, thirds)
        if name == "end_effector_positions":
            return swapped((value.reshape(N_FINGERS, 3) @ axes.T).ravel(), thirds)
        if part in ("cartesian_position", "linear_velocity"):
            return axes @ value
        if part == "orientation":
            x, y, z, w = value.tolist()
            turn = np.array(
                [rest * x - half * y, rest * y + half * x, rest * z + half * w, rest * w - half * z]
            )
            return turn if turn[3] >= 0.0 else -turn
        if part in UNTURNED and body in bodies:
            return value
        allowed = (*JOINTS, "end_effector_positions", "poses and sizes of blocks and goals")
        raise UnknownOption("observed variable of a symmetric lesson", name, allowed)

    return {name: one(name) for name in names}
