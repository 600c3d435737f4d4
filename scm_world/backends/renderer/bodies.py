"""What stands in a picture: the solids of a scene as a table of numbers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scm_world._types import Floats, Integers
from scm_world.geometry.rotations import rotation_matrix
from scm_world.scene import trifinger
from scm_world.scene.kinematics import FRAMES_PER_FINGER, link_frames
from scm_world.scene.scene import Goal, Scene, Structure

BOX, ELLIPSOID, CAPSULE = range(3)

NOTHING, FLOOR, STAGE, ROBOT = range(-1, 3)
"""What a pixel shows, where it is none of the links or blocks; see ``body_names``."""

HUB_COLOR = (0.35, 0.35, 0.38)
HUB_HALVES = (0.034, 0.034, 0.012)  # [m] of the ellipsoid that carries the fingers
MOUNT = trifinger.Capsule((0.012, 0.0, 0.0), (-0.004, 0.0, 0.0), 0.0235)
"""What is drawn for link 0, whose published mesh is a frame that hides the arena from above."""


class Bodies(NamedTuple):
    """Solids: one row each, in the order in which they are drawn.

    A capsule lies along the third axis of its own frame.

    Attributes:
        shapes: ``BOX``, ``ELLIPSOID`` or ``CAPSULE``, shape (n,).
        centers: Shape (n, 3) [m].
        rotations: From the frame of the body to the world, shape (n, 3, 3).
        halves: Half the edges of the box around the body in its own frame, shape (n, 3) [m].
        colors: Red, green, blue in [0, 1], shape (n, 3).
        owners: What the body belongs to: an index into ``body_names``, shape (n,).
    """

    shapes: Integers
    centers: Floats
    rotations: Floats
    halves: Floats
    colors: Floats
    owners: Integers


def body_names(structure: Structure) -> tuple[str, ...]:
    """Name what the numbers of a segmentation stand for.

    Example:
        >>> from scm_world.scene import Structure
        >>> body_names(Structure(blocks=("tool_block",)))[:4]
        ('floor', 'stage', 'robot', 'robot_finger_60_link_0')
        >>> body_names(Structure(blocks=("tool_block",)))[-1]
        'tool_block'
    """
    return ("floor", "stage", "robot", *trifinger.LINK_NAMES, *structure.blocks)


def solid_bodies(scene: Scene) -> Bodies:
    """List the hub, the links and the blocks of a scene."""
    parts = [_hub(scene), _fingers(scene), _blocks(scene)]
    return Bodies(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def goal_bodies(goals: tuple[Goal, ...], eye: tuple[float, float, float]) -> Bodies:
    """List silhouettes from the farthest to the nearest: each is drawn over those behind."""
    ordered = sorted(goals, key=lambda goal: -float(np.linalg.norm(goal.position - eye)))
    n = len(ordered)
    return Bodies(
        np.array([BOX if goal.shape == "box" else ELLIPSOID for goal in ordered], dtype=np.int64),
        np.array([goal.position for goal in ordered], dtype=np.float64).reshape(n, 3),
        rotation_matrix(np.array([goal.orientation for goal in ordered]).reshape(n, 4)),
        np.array([goal.size for goal in ordered], dtype=np.float64).reshape(n, 3) / 2.0,
        np.array([goal.color for goal in ordered], dtype=np.float64).reshape(n, 3),
        np.full(n, NOTHING, dtype=np.int64),
    )


def _hub(scene: Scene) -> Bodies:
    height = float(scene.parameters["robot", "height"]) - trifinger.TABLE_OFFSET
    return Bodies(
        np.array([ELLIPSOID]),
        np.array([[0.0, 0.0, height]]),
        np.eye(3)[None],
        np.array([HUB_HALVES]),
        np.array([HUB_COLOR]),
        np.array([ROBOT]),
    )


def _along(capsule: trifinger.Capsule) -> tuple[Floats, Floats, Floats]:
    """Give center, rotation and halves of a capsule along x or z in the frame of its link."""
    start, end = np.array(capsule.start), np.array(capsule.end)
    length, radius = float(np.linalg.norm(end - start)), capsule.radius
    flat = abs(start[2] - end[2]) < length / 2.0
    rotation = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]) if flat else np.eye(3)
    return (start + end) / 2.0, rotation, np.array([radius, radius, radius + length / 2.0])


_COLLISION = trifinger.COLLISION
_CAPSULES = tuple(_along(capsule) for capsule in (MOUNT, *_COLLISION.values()))
_CENTERS, _ROTATIONS, _HALVES = (np.array(column) for column in zip(*_CAPSULES, strict=True))


def _fingers(scene: Scene) -> Bodies:
    """Hang one capsule into each frame: links 0 to 3 and the tip, which belongs to link 3."""
    height = float(scene.parameters["robot", "height"])
    positions, orientations = link_frames(scene.state.joint_positions, height)
    turns = rotation_matrix(orientations)  # (15, 3, 3)
    n_fingers = len(trifinger.FINGERS)
    shifts = np.einsum("nij,nj->ni", turns, np.tile(_CENTERS, (n_fingers, 1)))
    links = [
        4 * finger + min(i, 3) for finger in range(n_fingers) for i in range(FRAMES_PER_FINGER)
    ]
    colors = [scene.parameters[trifinger.LINK_NAMES[link], "color"] for link in links]
    return Bodies(
        np.full(len(links), CAPSULE),
        positions + shifts,
        turns @ np.tile(_ROTATIONS, (n_fingers, 1, 1)),
        np.tile(_HALVES, (n_fingers, 1)),
        np.array(colors),
        np.array(links) + ROBOT + 1,
    )


def _blocks(scene: Scene) -> Bodies:
    blocks = scene.structure.blocks
    n, first = len(blocks), ROBOT + 1 + len(trifinger.LINK_NAMES)
    parameters = scene.parameters
    return Bodies(
        np.full(n, BOX),
        scene.state.positions,
        rotation_matrix(scene.state.orientations),
        np.array([parameters[block, "size"] for block in blocks]).reshape(n, 3) / 2.0,
        np.array([parameters[block, "color"] for block in blocks]).reshape(n, 3),
        np.arange(first, first + n),
    )
