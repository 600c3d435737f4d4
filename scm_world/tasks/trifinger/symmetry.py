"""The robot looks the same after a third of a turn, and so do its effects on a scene."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.errors import UnknownOption
from scm_world.geometry.rotations import canonical, quaternion_product
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.kinematics import N_FINGERS

JOINTS = ("joint_positions", "joint_velocities", "joint_torques", "action")
UNTURNED = (
    *("size", "mass", "friction", "color", "type"),
    *("position_gains", "velocity_gains", "safety_damping", "floor_color", "stage_color"),
)
"""What keeps its numbers: parts of bodies, and vectors that do not point anywhere."""

VECTORS = ("gravity", "light_direction")
"""What turns like a position, apart from parts of bodies."""

FINGERS = tuple(f"robot_finger_{name}_" for name in hardware.FINGERS)


def swapped(joints: Floats, thirds: int) -> Floats:
    """Return what belongs to joints, shape (9,), after the scene is turned by thirds of a turn.

    The numbers of a finger go to the one that stands there afterwards: the one before it.
    """
    fingers = np.asarray(joints, dtype=float).reshape(N_FINGERS, -1)
    return np.roll(fingers, -thirds, axis=0).ravel()


def turned(values: Mapping[str, Value], names: Iterable[str], thirds: int) -> dict[str, Any]:
    """Return the values of a scene that is turned about the vertical by thirds of a turn.

    What belongs to a finger goes to the one that stands there afterwards; cameras are turned, too.

    Raises:
        UnknownOption: It is not known how a variable turns.
    """
    angle = 2.0 * math.pi / 3.0 * thirds
    cos, sin = math.cos(angle), math.sin(angle)
    axes = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    half, rest = math.sin(angle / 2.0), math.cos(angle / 2.0)

    def one(name: str) -> Any:
        body, _, part = name.rpartition(".")
        finger = next((i for i, own in enumerate(FINGERS) if body.startswith(own)), None)
        if finger is not None:
            before = FINGERS[(finger + thirds) % N_FINGERS]
            return np.asarray(values[name.replace(FINGERS[finger], before)], dtype=float)
        value = np.asarray(values[name], dtype=float)
        if name in JOINTS:
            return swapped(value, thirds)
        if name == "end_effector_positions":
            return swapped((value.reshape(N_FINGERS, 3) @ axes.T).ravel(), thirds)
        if name in VECTORS or part in ("cartesian_position", "linear_velocity", "position"):
            return axes @ value
        if part == "orientation":
            return canonical(quaternion_product((0.0, 0.0, half, rest), value))
        if part in ("polar", "cylindrical_position"):
            around = value + np.eye(len(value))[1] * angle
            around[1] = math.remainder(around[1], 2.0 * math.pi)
            return around
        if part in UNTURNED or value.ndim == 0:
            return value
        allowed = (*JOINTS, "end_effector_positions", "poses, and parameters that are known")
        raise UnknownOption("observed variable of a symmetric lesson", name, allowed)

    return {name: one(name) for name in names}


def thirds(values: Values, names: Iterable[str]) -> Iterable[tuple[Values, Sequence[int]]]:
    """Turn the scene by one and by two thirds of a turn; actions are of joints."""
    wanted = tuple(names)
    for count in (1, 2):
        order = swapped(np.arange(float(hardware.N_JOINTS)), count).astype(int).tolist()
        yield turned(values, wanted, count), order
