"""What stands in a picture: the solids of a scene as a table of numbers."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba import njit

from scm_world._types import Floats, Integers
from scm_world.errors import ModelError, UnknownOption
from scm_world.geometry.hulls import Hull
from scm_world.geometry.rotations import rotation_kernel
from scm_world.models.camera import Camera
from scm_world.models.model import Model
from scm_world.models.scene import GoalRegion, Scene
from scm_world.models.shapes import Shape

if TYPE_CHECKING:
    from scm_world.backends.mujoco.drawing import VisibleModel

BOX, ELLIPSOID, CAPSULE, HULL, CYLINDER = range(5)
GOAL_SHAPES = {"box": BOX, "sphere": ELLIPSOID, "hull": HULL}

NOTHING = -1
"""What a pixel shows where there is no body."""


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


def _drawn(scene: Scene) -> tuple[VisibleModel, Any]:
    """Put a scene of a ``Model`` into MuJoCo, which is imported only where it is needed."""
    if not isinstance(scene.structure, Model):
        kind = type(scene.structure).__name__
        raise ModelError([f"{kind} says nothing about shapes, so there are no pictures of it"])
    from scm_world.backends.mujoco.drawing import drawn

    return drawn(scene)


def goal_bodies(goals: tuple[GoalRegion, ...], eye: tuple[float, float, float]) -> Bodies:
    """List silhouettes from the farthest to the nearest: each is drawn over those behind."""
    ordered = sorted(goals, key=lambda goal: -float(np.linalg.norm(goal.position - eye)))
    bodies = empty_bodies(len(goals), [goal.hull for goal in ordered])
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
    halves: Floats = np.abs(hull.vertices).max(axis=0)
    return np.array(hull.planes), halves


def empty_bodies(n: int, hulls: list[Hull | None]) -> Bodies:
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
