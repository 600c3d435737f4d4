"""How deep two convex bodies lie in one another, judged by their flat sides alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scm_world._types import ArrayLike, Floats
from scm_world.geometry.hulls import Hull
from scm_world.geometry.rotations import rotation_matrix


class Convex(NamedTuple):
    """All points within a radius of the convex hull of some corners.

    Attributes:
        corners: Shape (n, 3) [m].
        normals: Of the flat sides that are to be looked at, shape (k, 3).
        radius: Not negative [m].
    """

    corners: Floats
    normals: Floats
    radius: float = 0.0


def placed(hull: Hull, position: ArrayLike, orientation: ArrayLike) -> Convex:
    """Put a polyhedron into the world.

    Args:
        hull: The shape.
        position: Of its center of mass, shape (3,) [m].
        orientation: Quaternion (x, y, z, w).
    """
    turn = rotation_matrix(orientation).T
    corners = np.asarray(position) + np.array(hull.vertices) @ turn
    return Convex(corners, np.array(hull.planes)[:, :3] @ turn)


def sides_depth(first: Convex, second: Convex) -> float:
    """Bound how far two bodies would have to be moved to come apart.

    Args:
        first: A body. It or the second one has flat sides.
        second: Another.

    Returns:
        The least depth along the normals of all sides [m]. The true one is at most that, and is
        less only where an edge or a corner of one body meets an edge of the other.

    Example:
        >>> from scm_world.geometry.hulls import box_hull
        >>> cube, upright = box_hull([1.0, 1.0, 1.0]), [0.0, 0.0, 0.0, 1.0]
        >>> at = [placed(cube, [x, 0.0, 0.0], upright) for x in (0.0, 0.75)]
        >>> sides_depth(*at)
        0.25
    """
    axes = np.vstack([first.normals, second.normals]).T
    one, other = first.corners @ axes, second.corners @ axes  # (n, k) each
    ahead = one.max(axis=0) - other.min(axis=0)
    behind = other.max(axis=0) - one.min(axis=0)
    return float(np.minimum(ahead, behind).min()) + first.radius + second.radius
