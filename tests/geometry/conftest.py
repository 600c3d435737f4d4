"""What other libraries say of boxes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection

from scm_world._types import Floats
from scm_world.geometry.rotations import rotation_matrix

Box = tuple[Floats, Floats, Floats]


@pytest.fixture
def shared_volume() -> Callable[[Sequence[Box]], float]:
    """Give a function that computes the volume in all of some boxes with scipy, slowly."""
    return _common


def _common(boxes: Sequence[Box]) -> float:
    """Compute the volume in all of some boxes with scipy, slowly."""
    rows = []
    for size, position, orientation in boxes:
        axes = rotation_matrix(orientation).T
        normals = np.concatenate((axes, -axes))
        rows.append(np.column_stack((normals, -normals @ position - 0.5 * np.tile(size, 2))))
    sides = np.concatenate(rows)
    widest = linprog(  # the center of the largest ball that fits
        [0.0, 0.0, 0.0, -1.0],
        A_ub=np.column_stack((sides[:, :3], np.ones(len(sides)))),
        b_ub=-sides[:, 3],
        bounds=[(None, None)] * 4,
    ).x
    if widest[3] <= 1e-7:
        return 0.0
    return float(ConvexHull(HalfspaceIntersection(sides, widest[:3]).intersections).volume)
