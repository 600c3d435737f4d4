"""What stands in a picture: the solids of a scene as a table of numbers."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba import njit

from scm_world._types import Floats, Integers
from scm_world.errors import ModelError, UnknownOption
from scm_world.geometry.hulls import Hull, solid
from scm_world.geometry.rotations import rotation_kernel
from scm_world.models.model import Model
from scm_world.models.scene import Goal, Scene
from scm_world.models.shapes import Shape
from scm_world.scene import trifinger
from scm_world.scene.camera import Camera
from scm_world.scene.kinematics import FRAMES_PER_FINGER, link_frames
from scm_world.scene.scene import Structure

if TYPE_CHECKING:
    from scm_world.backends.mujoco.drawing import Drawing

BOX, ELLIPSOID, CAPSULE, HULL, CYLINDER = range(5)
GOAL_SHAPES = {"box": BOX, "sphere": ELLIPSOID, "hull": HULL}

NOTHING, FLOOR, STAGE, ROBOT = range(-1, 3)
"""What a pixel shows, where it is none of the links, blocks or obstacles; see ``body_names``."""

HUB_COLOR = (0.35, 0.35, 0.38)
HUB_HALVES = (0.034, 0.034, 0.012)  # [m] of the ellipsoid that carries the fingers
MOUNT = trifinger.Capsule((0.012, 0.0, 0.0), (-0.004, 0.0, 0.0), 0.0235)
"""What is drawn for link 0, whose published mesh is a frame that hides the arena from above."""


class Bodies(NamedTuple):
    """Solids: one row each, in the order in which they are drawn.

    Capsules and cylinders lie along the third axis of their own frame.

    Attributes:
        shapes: ``BOX``, ``ELLIPSOID``, ``CAPSULE``, ``HULL`` or ``CYLINDER``, shape (n,).
        centers: Origin of the frame of the body, shape (n, 3) [m].
        rotations: From the frame of the body to the world, shape (n, 3, 3).
        halves: Half the edges of a box around its origin that holds it, in its own frame; it is
            tight but for hulls, shape (n, 3) [m].
        colors: Red, green, blue in [0, 1], shape (n, 3).
        owners: What the body belongs to: an index into ``body_names``, shape (n,).
        facets: Planes of all hulls, in their own frames: outward normals and offsets, shape
            (p, 4).
        first: The planes of hull i are the rows from ``first[i]`` to ``first[i + 1]``, shape
            (n + 1,).
    """

    shapes: Integers
    centers: Floats
    rotations: Floats
    halves: Floats
    colors: Floats
    owners: Integers
    facets: Floats
    first: Integers


def body_names(structure: Structure | Model) -> tuple[str, ...]:
    """Name what the numbers of a segmentation stand for.

    Example:
        >>> from scm_world.scene import Structure
        >>> body_names(Structure(blocks=("tool_block",)))[:4]
        ('floor', 'stage', 'robot', 'robot_finger_60_link_0')
        >>> body_names(Structure(blocks=("tool_block",), obstacles=("wall",)))[-2:]
        ('tool_block', 'wall')
    """
    if isinstance(structure, Model):
        return model_shapes(structure.default_scene())[1]
    links = trifinger.LINK_NAMES
    return ("floor", "stage", "robot", *links, *structure.blocks, *structure.obstacles)


def model_shapes(scene: Scene) -> tuple[list[Shape], tuple[str, ...]]:
    """List the shapes of a scene of a ``Model``, without goals, and name its bodies.

    Raises:
        ModelError: It has no shapes.
    """
    drawing, data = _drawn(scene)
    return drawing.shapes(data), drawing.names


def model_camera(scene: Scene, name: str, size: tuple[int, int]) -> Camera:
    """Give one of the cameras in the file of a ``Model``, where it stands now.

    Args:
        scene: Of the model.
        name: Of the camera.
        size: Height and width of the picture [pixels].

    Raises:
        UnknownOption: There is no such camera.
        ModelError: The structure has no shapes.
    """
    drawing, data = _drawn(scene)
    if name not in drawing.cameras:
        raise UnknownOption("camera", name, ("automatic", *drawing.cameras))
    return drawing.camera(data, name, size)


def _drawn(scene: Scene) -> tuple[Drawing, Any]:
    """Put a scene of a ``Model`` into MuJoCo, which is imported only where it is needed."""
    if not isinstance(scene.structure, Model):
        kind = type(scene.structure).__name__
        raise ModelError([f"{kind} says nothing about shapes, so there are no pictures of it"])
    from scm_world.backends.mujoco.drawing import drawn

    return drawn(scene)


def solid_bodies(scene: Scene) -> Bodies:
    """List the hub, the links, the blocks and the obstacles of a scene."""
    structure, parameters, state = scene.structure, scene.parameters, scene.state
    names = (*structure.blocks, *structure.obstacles)
    hulls = dict(structure.hulls)
    n, n_blocks = N_ROBOT + len(names), N_ROBOT + len(structure.blocks)
    bodies = _empty(n, [hulls.get(name) for name in names])
    _place_robot(bodies, scene)
    bodies.centers[N_ROBOT:n_blocks] = state.positions
    turn_kernel(np.ascontiguousarray(state.orientations), bodies.rotations[N_ROBOT:n_blocks])
    for i, name in enumerate(names, start=N_ROBOT):
        bodies.colors[i] = parameters[name, "color"]
        if name not in hulls:
            bodies.halves[i] = parameters[name, "size"]
            bodies.halves[i] *= 0.5
    if structure.obstacles:
        poses = [parameters[name, "orientation"] for name in structure.obstacles]
        turn_kernel(np.array(poses, dtype=np.float64), bodies.rotations[n_blocks:])
        bodies.centers[n_blocks:] = [parameters[name, "position"] for name in structure.obstacles]
    bodies.owners[N_ROBOT:] = np.arange(FIRST_BLOCK, FIRST_BLOCK + len(names))
    return bodies


def goal_bodies(goals: tuple[Goal, ...], eye: tuple[float, float, float]) -> Bodies:
    """List silhouettes from the farthest to the nearest: each is drawn over those behind."""
    ordered = sorted(goals, key=lambda goal: -float(np.linalg.norm(goal.position - eye)))
    bodies = _empty(len(goals), [goal.hull for goal in ordered])
    for i, goal in enumerate(ordered):
        bodies.shapes[i] = GOAL_SHAPES[goal.shape]
        bodies.centers[i] = goal.position
        bodies.colors[i] = goal.color
        if goal.hull is None:
            bodies.halves[i] = np.multiply(goal.size, 0.5)
    orientations = [goal.orientation for goal in ordered]
    turn_kernel(np.array(orientations, dtype=np.float64).reshape(-1, 4), bodies.rotations)
    bodies.owners[:] = NOTHING
    return bodies


@njit(cache=True)
def turn_kernel(quaternions: Floats, rotations: Floats) -> None:
    """Write the rotation matrices (n, 3, 3) of quaternions (n, 4)."""
    for i in range(len(quaternions)):
        rotation_kernel(quaternions[i], rotations[i])


@lru_cache(maxsize=128)
def _hull_parts(hull: Hull) -> tuple[Floats, Floats]:
    """Give the planes (p, 4) of a hull and half the edges (3,) of a box that holds it [m]."""
    parts = solid(hull)
    halves: Floats = np.abs(parts.vertices).max(axis=0)
    return parts.planes, halves


def _empty(n: int, hulls: list[Hull | None]) -> Bodies:
    """Make room for n bodies; the last ones are boxes, or hulls where one is given."""
    bodies = Bodies(
        np.full(n, BOX), np.empty((n, 3)), np.empty((n, 3, 3)), np.empty((n, 3)),
        np.empty((n, 3)), np.empty(n, dtype=np.int64), np.empty((0, 4)),
        np.zeros(n + 1, dtype=np.int64),
    )  # fmt: skip
    facets = []
    for i, hull in enumerate(hulls, start=n - len(hulls)):
        if hull is not None:
            planes, bodies.halves[i] = _hull_parts(hull)
            bodies.shapes[i] = HULL
            bodies.first[i + 1 :] += len(planes)
            facets.append(planes)
    return bodies._replace(facets=np.concatenate(facets)) if facets else bodies


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
_N_FINGERS = len(trifinger.FINGERS)
_LINKS = np.array([4 * f + min(i, 3) for f in range(_N_FINGERS) for i in range(FRAMES_PER_FINGER)])
"""The link that each capsule belongs to: links 0 to 3 and the tip, which belongs to link 3."""

N_ROBOT = 1 + len(_LINKS)
"""How many bodies the robot is drawn with: its hub and the capsules of its fingers."""

FIRST_BLOCK = ROBOT + 1 + len(trifinger.LINK_NAMES)

_ROBOT_SHAPES = np.array([ELLIPSOID] + [CAPSULE] * len(_LINKS))
_ROBOT_HALVES = np.vstack([HUB_HALVES, np.tile(_HALVES, (_N_FINGERS, 1))])
_ROBOT_OWNERS = np.array([ROBOT, *(_LINKS + ROBOT + 1)])


@njit(cache=True)
def _hang(
    origins: Floats, orientations: Floats, centers: Floats, turns: Floats, bodies: Bodies
) -> None:
    """Hang one capsule into each frame of the fingers, behind the hub."""
    frame = np.empty((3, 3))
    for n in range(len(origins)):
        rotation_kernel(orientations[n], frame)
        kind = n % len(centers)
        for i in range(3):
            bodies.centers[n + 1, i] = origins[n, i]
            for j in range(3):
                bodies.centers[n + 1, i] += frame[i, j] * centers[kind, j]
                bodies.rotations[n + 1, i, j] = 0.0
                for k in range(3):
                    bodies.rotations[n + 1, i, j] += frame[i, k] * turns[kind, k, j]


def _place_robot(bodies: Bodies, scene: Scene) -> None:
    """Write the first rows: the hub and the fingers."""
    height = float(scene.parameters["robot", "height"])
    bodies.shapes[:N_ROBOT] = _ROBOT_SHAPES
    bodies.halves[:N_ROBOT] = _ROBOT_HALVES
    bodies.owners[:N_ROBOT] = _ROBOT_OWNERS
    bodies.centers[0] = (0.0, 0.0, height - trifinger.TABLE_OFFSET)
    bodies.rotations[0] = np.eye(3)
    bodies.colors[0] = HUB_COLOR
    colors = np.array([scene.parameters[link, "color"] for link in trifinger.LINK_NAMES])
    bodies.colors[1:N_ROBOT] = colors[_LINKS]
    frames = link_frames(scene.state.joint_positions, height)
    _hang(*frames, _CENTERS, _ROTATIONS, bodies)
