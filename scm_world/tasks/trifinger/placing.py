"""Where blocks and fingers are put, so that they are about to touch."""

from __future__ import annotations

from typing import Any

import numpy as np

from scm_world._types import Floats, Value
from scm_world.tasks.experiments import Dice
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.kinematics import inverse

TIP = hardware.COLLISION["tip"].radius  # [m]
CLEARANCE = 2e-4  # [m] how far apart bodies are put that are about to touch
LOOSE = 1.5e-3  # [m] the same for blocks on one another, which do not stand quite straight
HIGHEST = 6  # blocks that are stacked
REACH = 0.045  # [m] from here up all three fingers can press on something in the middle

Setting = tuple[dict[str, Value], Floats]
"""States to set, and the fingertip positions that the robot then drives at, shape (9,) [m]."""


# --- where bodies are ---------------------------------------------------------------------------


def top(world: Any, name: str) -> Floats:
    """Find the middle of the upper face of something upright, shape (3,) [m]."""
    center, size = world[f"{name}.cartesian_position"], world[f"{name}.size"]
    return np.array([center[0], center[1], center[2] + size[2] / 2])


def sizes(world: Any) -> Floats:
    """List the edge lengths of the blocks, shape (n, 3) [m]."""
    return np.array([world[f"{name}.size"] for name in world.composition.blocks]).reshape(-1, 3)


def touched(
    world: Any,
    dice: Dice,
    middle: Floats,
    bottom: float,
    *,
    heights: tuple[float, float],
    yaw: float,
) -> tuple[dict[str, Value], Floats, float]:
    """Stand the first block somewhere, with all three fingertips about to touch it.

    Args:
        world: Where.
        dice: Random numbers.
        middle: x and y of its center [m].
        bottom: Height of its lower face [m].
        heights: Between which parts of its height it is touched.
        yaw: How far it may be turned [rad].

    Returns:
        States to set, the direction in which each finger stands [rad], and their height [m].
    """
    name, size = world.composition.blocks[0], sizes(world)[0]
    angles = facing(dice)
    height = bottom + dice.between(*heights) * size[2]
    states = {
        f"{name}.cartesian_position": np.array([*middle, bottom + size[2] / 2]),
        f"{name}.euler_orientation": np.array([0.0, 0.0, dice.between(-yaw, yaw)]),
        "joint_positions": gripping(world, middle, beyond_corners(size), angles, height),
    }
    return states, angles, height


def pressed(world: Any, dice: Dice, middle: Floats, bottom: float, count: int = HIGHEST) -> Setting:
    """Stack the first blocks and let the fingers press on one of them that they reach."""
    edges = sizes(world)[:HIGHEST][:count]
    states = stacked(world, dice, middle, bottom, count=count)
    middles = bottom + np.cumsum(edges[:, 2]) - edges[:, 2] / 2
    which = int(np.flatnonzero(middles >= min(REACH, middles[-1]))[0])
    height = float(middles[which]) + dice.between(-0.2, 0.2) * edges[which, 2]
    angles = facing(dice)
    reach = beyond_faces(edges[which], angles)
    states["joint_positions"] = gripping(world, middle, reach, angles, height)
    center = np.array([*middle, 0.0])
    return states, around(center, dice.between(0.0, 0.01), angles + 0.4, height - 0.01)


def stacked(
    world: Any,
    dice: Dice,
    middle: Floats,
    bottom: float,
    yaw: float = 0.0,
    count: int = HIGHEST,
) -> dict[str, Value]:
    """Stand the first blocks on one another, not quite straight."""
    states: dict[str, Value] = {}
    names = world.composition.blocks[:HIGHEST][:count]
    for name, size in zip(names, sizes(world), strict=False):
        place = middle + dice.between(-0.001, 0.001, 2)
        turn = yaw + dice.between(-0.05, 0.05)
        states[f"{name}.cartesian_position"] = np.array([*place, bottom + size[2] / 2])
        states[f"{name}.euler_orientation"] = np.array([0.0, 0.0, turn])
        bottom += size[2]
    return states


def out_of_the_way(world: Any, dice: Dice) -> dict[str, Value]:
    """Stack the blocks in the middle, unless an obstacle may stand there."""
    if world.composition.obstacles:
        return {}
    return stacked(world, dice, np.zeros(2), 0.0)


# --- where fingers are --------------------------------------------------------------------------


def facing(dice: Dice) -> Floats:
    """Give the direction in which each finger stands, with a little spread [rad]."""
    tips = np.array([[-0.05945, 0.15864], [0.16711, -0.02783], [-0.10766, -0.13080]])
    directions: Floats = np.arctan2(tips[:, 1], tips[:, 0]) + dice.between(-0.2, 0.2, 3)
    return directions


def around(center: Floats, radius: float | Floats, angles: Floats, height: float) -> Floats:
    """Put three fingertips on a circle.

    Args:
        center: Shape (3,) [m]; its height does not matter.
        radius: Of the circle, or of one for each finger, shape (3,) [m].
        angles: Where on it, shape (3,) [rad].
        height: Of all of them [m].

    Returns:
        Shape (9,) [m].
    """
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(3)], axis=-1)
    points: Floats = center + ring * np.reshape(radius, (-1, 1))
    points[:, 2] = height
    return points.ravel()


def beyond_corners(size: Floats) -> float:
    """Compute how far from the middle of a block a tip is clear of it, whatever its yaw [m]."""
    return float(np.hypot(size[0], size[1])) / 2 + TIP + CLEARANCE


def beyond_faces(size: Floats, angles: Floats) -> Floats:
    """Compute how far out tips just do not touch a block that is hardly turned, shape (3,) [m].

    Args:
        size: Edge lengths of the block, shape (3,) [m].
        angles: In which directions, shape (3,) [rad].
    """
    across = np.abs(np.stack([np.cos(angles), np.sin(angles)], axis=-1))
    return np.asarray(((size[:2] / 2 + TIP + LOOSE) / np.maximum(across, 1e-9)).min(axis=-1))


def gripping(
    world: Any, middle: Floats, reach: float | Floats, angles: Floats, height: float
) -> Floats:
    """Find the joint positions with the tips around a place, shape (9,) [rad]."""
    return joints_for(world, around(np.array([*middle, 0.0]), reach, angles, height))


def present_tips(world: Any) -> Floats:
    """Give the fingertip positions, shape (9,) [m]."""
    return np.array(world["end_effector_positions"])


def joints_for(world: Any, tips: Floats) -> Floats:
    """Find joint positions for fingertip positions, near the resting pose.

    Args:
        world: Its robot may be higher or lower.
        tips: Shape (9,) [m].

    Returns:
        Shape (9,) [rad].
    """
    near = np.array(hardware.REST)
    return inverse(tips, float(world["robot_height"]), near).joint_positions
