"""Facts about how deep bodies lie in one another."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from scipy.spatial import ConvexHull

from scm_world._types import ArrayLike, Floats
from scm_world.geometry.penetration import (
    box_box_kernel,
    box_capsule,
    box_floor_kernel,
    box_wall_kernel,
    capsule_capsule_kernel,
    capsule_floor_kernel,
    capsule_wall_kernel,
)
from scm_world.geometry.rotations import from_rotation_vector, rotation_matrix

UPRIGHT = (0.0, 0.0, 0.0, 1.0)
HERE = (0.0, 0.0, 0.0)
CUBE = (1.0, 1.0, 1.0)
EIGHTH = from_rotation_vector([0.0, 0.0, np.pi / 4])
WALL = (0.242, 0.25)

Box = tuple[Floats, Floats, Floats]


def _random_box(rng: np.random.Generator, spread: float = 0.05) -> Box:
    return rng.uniform(0.02, 0.2, 3), rng.normal(size=3) * spread, rng.normal(size=4)


def _corners(box: Box) -> Floats:
    signs = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T
    corners: Floats = signs * box[0] @ rotation_matrix(box[2]).T + box[1]
    return corners


def _placed(size: ArrayLike, position: ArrayLike, orientation: ArrayLike) -> Box:
    """Give half edges, center and rotation, as compiled functions take them."""
    return 0.5 * np.array(size), np.array(position, dtype=float), rotation_matrix(orientation)


def box_box(*boxes: ArrayLike) -> float:
    """Measure how deep two boxes lie in one another."""
    return float(box_box_kernel(*_placed(*boxes[:3]), *_placed(*boxes[3:])))


def box_wall(size: ArrayLike, position: ArrayLike, orientation: ArrayLike, *wall: float) -> float:
    """Measure how deep a box stands in the wall."""
    return float(box_wall_kernel(*_placed(size, position, orientation), *wall))


def box_floor(size: ArrayLike, position: ArrayLike, orientation: ArrayLike) -> float:
    """Measure how deep a box lies in the floor."""
    return float(box_floor_kernel(*_placed(size, position, orientation)))


def capsule_capsule(*capsules: Any) -> float:
    """Measure how deep two capsules lie in one another."""
    return float(
        capsule_capsule_kernel(
            *(np.array(part, dtype=float) if np.ndim(part) else part for part in capsules)
        )
    )


def _along(start: Floats, end: Floats, n: int = 20_001) -> Floats:
    steps: Floats = start + np.linspace(0.0, 1.0, n)[:, None] * (end - start)
    return steps


def test_depth_of_boxes_is_that_of_their_minkowski_difference() -> None:
    """Where boxes intersect, the depth is the origin's from the hull of all corner differences."""
    rng, intersecting = np.random.default_rng(0), 0
    for _ in range(300):
        a, b = _random_box(rng), _random_box(rng)
        hull = ConvexHull((_corners(a)[:, None] - _corners(b)).reshape(-1, 3))
        expected = -np.max(hull.equations[:, 3])
        depth = box_box(*a, *b)
        if expected > 0.0:
            intersecting += 1
            assert depth == pytest.approx(expected, abs=1e-12)
        else:
            distance = np.min(np.linalg.norm(_corners(a)[:, None] - _corners(b), axis=-1))
            assert -distance <= depth <= 0.0
    assert 100 < intersecting < 250


def test_depth_of_boxes_does_not_depend_on_their_order() -> None:
    """Swapping two boxes that intersect changes their depth by rounding only."""
    rng = np.random.default_rng(1)
    for _ in range(200):
        a, b = _random_box(rng, 0.02), _random_box(rng, 0.02)
        assert box_box(*a, *b) == pytest.approx(box_box(*b, *a), abs=1e-15)


@pytest.mark.parametrize("turn", [0.0, 1e-9, 1e-6, 1e-3])
def test_boxes_that_are_almost_parallel_keep_their_depth(turn: float) -> None:
    """Edges that are almost parallel make no difference to two stacked cubes."""
    orientation = from_rotation_vector([turn, -turn, turn])
    depth = box_box(CUBE, HERE, UPRIGHT, CUBE, (0.0, 0.0, 0.75), orientation)
    assert depth == pytest.approx(0.25, abs=2.0 * turn + 1e-15)


def test_edges_that_cross_are_seen() -> None:
    """Two cubes that meet edge to edge are as deep in one another as the edges are."""
    about_x = from_rotation_vector([np.pi / 4, 0.0, 0.0])
    about_y = from_rotation_vector([0.0, np.pi / 4, 0.0])
    for gap in (-0.01, 0.01):
        apart = np.sqrt(2.0) + gap
        depth = box_box(CUBE, HERE, about_x, CUBE, (0.0, 0.0, apart), about_y)
        assert (depth > 0.0) == (gap < 0.0)
        assert depth == pytest.approx(-gap, abs=1e-12)


def test_boxes_that_touch_have_depth_zero() -> None:
    """A common face is no intersection."""
    assert box_box(CUBE, HERE, UPRIGHT, CUBE, (0.0, 1.0, 0.3), UPRIGHT) == 0.0


def test_distance_of_capsule_and_box_is_exact() -> None:
    """Beside a box, the depth of a capsule is its radius less the least distance of its segment."""
    rng, compared = np.random.default_rng(2), 0
    for _ in range(300):
        box = _random_box(rng)
        start, end = rng.normal(size=(2, 3)) * 0.12
        inner = (_along(start, end) - box[1]) @ rotation_matrix(box[2])
        outward = np.abs(inner) - 0.5 * box[0]
        distance = np.min(np.linalg.norm(np.maximum(outward, 0.0), axis=-1))
        depth = box_capsule(*box, start, end, 0.1)
        if distance > 1e-4:
            compared += depth > 0.0
            exact = pytest.approx(0.1 - distance, abs=1e-6)
            assert depth == exact or 0.1 - distance <= depth <= 0.0
        else:
            deepest = np.max(np.min(-outward, axis=-1))
            step = np.linalg.norm(end - start) / 20_000
            assert depth - 0.1 == pytest.approx(max(deepest, 0.0), abs=step)
    assert compared > 50


def test_a_segment_within_a_box_is_as_deep_as_its_deepest_point() -> None:
    """A capsule through the center of a cube lies half an edge and its radius deep."""
    for end in ((0.0, 0.0, 3.0), (2.0, 1.0, 0.5), (0.3, 0.0, 0.0)):
        start = -np.array(end)
        assert box_capsule(CUBE, HERE, UPRIGHT, start, end, 0.1) == pytest.approx(0.6)
    ball = (0.0, 0.0, 0.4)
    assert box_capsule(CUBE, HERE, UPRIGHT, ball, ball, 0.1) == pytest.approx(0.2)


def test_a_capsule_far_from_a_box_has_a_lower_bound() -> None:
    """Far away, minus the depth is positive and at most the distance."""
    depth = box_capsule(CUBE, HERE, EIGHTH, (5.0, 0.0, -1.0), (5.0, 0.0, 1.0), 0.1)
    assert -(5.0 - np.sqrt(0.5) - 0.1) <= depth < 0.0


def test_distance_of_capsules_is_that_of_least_squares() -> None:
    """The distance of two segments is the least over both, as a bounded solver finds it."""
    rng = np.random.default_rng(3)
    for _ in range(150):
        a, b, c, d = rng.normal(size=(4, 3)) * 0.1
        solved = lsq_linear(np.column_stack((b - a, c - d)), c - a, (0.0, 1.0), tol=1e-14)
        distance = np.sqrt(2.0 * solved.cost)
        assert capsule_capsule(a, b, 0.02, c, d, 0.03) == pytest.approx(0.05 - distance, abs=1e-9)


@pytest.mark.parametrize("turn", [0.0, 1e-12, 1e-8, 1e-6, 1e-4])
def test_capsules_that_are_almost_parallel_keep_their_distance(turn: float) -> None:
    """Two unit segments side by side, turned by a little, are as far apart as they are."""
    half = 0.5 * np.array([np.cos(turn), np.sin(turn), 0.0])
    beside = np.array([0.1, 0.0, 0.3])
    depth = capsule_capsule(
        (-0.5, 0.0, 0.0), (0.5, 0.0, 0.0), 0.1, beside - half, beside + half, 0.1
    )
    assert depth == pytest.approx(-0.1, abs=1e-12)


def test_capsules_of_length_zero_are_balls() -> None:
    """Two points have the distance of points, and a point that of a segment."""
    point, other = (0.0, 0.0, 0.0), (0.0, 3.0, 4.0)
    assert capsule_capsule(point, point, 1.0, other, other, 1.0) == pytest.approx(-3.0)
    assert capsule_capsule(point, point, 1.0, (1.5, -1, 0), (1.5, 1, 0), 1.0) == pytest.approx(0.5)


def test_the_lowest_corner_meets_the_floor() -> None:
    """A cube on its edge lies deeper in the floor than on its face, a capsule at its lower end."""
    assert box_floor(CUBE, (0, 0, 0.4), UPRIGHT) == pytest.approx(0.1)
    on_edge = from_rotation_vector([np.pi / 4, 0.0, 0.0])
    assert box_floor(CUBE, (0, 0, 0.4), on_edge) == pytest.approx(np.sqrt(0.5) - 0.4)
    assert capsule_floor_kernel(
        np.array([0, 0, 0.3]), np.array([0, 0, 0.05]), 0.06
    ) == pytest.approx(0.01)


def test_the_outermost_corner_meets_the_wall() -> None:
    """A box near the wall reaches beyond it with a corner, and one in the middle does not."""
    size, corner = (0.06, 0.04, 0.05), np.hypot(0.23, 0.02)
    assert box_wall(size, (0.2, 0.0, 0.1), UPRIGHT, *WALL) == pytest.approx(corner - 0.242)
    assert -0.242 < box_wall(size, (0.0, 0.0, 0.1), UPRIGHT, *WALL) < 0.0
    assert box_wall(size, (0.22, 0.0, 0.1), UPRIGHT, *WALL) == pytest.approx(
        np.hypot(0.25, 0.02) - 0.242
    )


def test_a_box_on_the_wall_has_only_to_be_lifted() -> None:
    """Above the wall there is no wall; a box that dips into it lies as deep as it dips."""
    size = (0.05, 0.05, 0.05)
    assert box_wall(size, (0.242, 0.0, 0.28), UPRIGHT, *WALL) == pytest.approx(-0.005)
    assert box_wall(size, (0.242, 0.0, 0.274), UPRIGHT, *WALL) == pytest.approx(0.001)


def test_only_the_part_below_the_rim_reaches_into_the_wall() -> None:
    """A long box that leans over the rim from within reaches as far as where it passes the rim."""
    lean = from_rotation_vector([0.0, np.pi / 4, 0.0])  # its x axis points outward and down
    center = np.array([0.2, 0.0, 0.3])
    box = (np.array([0.3, 1e-9, 1e-9]), center, lean)
    # On the line x = 0.2 + s, z = 0.3 - s the rim's height is passed at s = 0.05.
    end = 0.15 * np.sqrt(0.5)
    assert box_wall(*box, *WALL) == pytest.approx(min(0.2 + end - 0.242, end - 0.05), abs=1e-8)
    up = (box[0], np.array([0.2, 0.0, 0.2]), from_rotation_vector([0.0, -np.pi / 4, 0.0]))
    assert box_wall(*up, *WALL) == pytest.approx(0.2 + 0.05 - 0.242, abs=1e-8)


def test_capsules_meet_the_wall_as_their_deepest_point_does() -> None:
    """A capsule lies its radius and the depth of its deepest point in the wall, sampled finely."""
    rng, inside = np.random.default_rng(4), 0
    for _ in range(300):
        middle = np.append(rng.normal(size=2) * 0.15, rng.uniform(0.1, 0.35))
        offset = rng.normal(size=3) * 0.05
        points = _along(middle - offset, middle + offset)
        beyond = np.hypot(points[:, 0], points[:, 1]) - WALL[0]
        below = WALL[1] - points[:, 2]
        outside = -np.hypot(np.minimum(beyond, 0.0), np.minimum(below, 0.0))
        both = (beyond > 0.0) & (below > 0.0)
        expected = 0.01 + np.max(np.where(both, np.minimum(beyond, below), outside))
        depth = capsule_wall_kernel(middle - offset, middle + offset, 0.01, *WALL)
        if depth > 0.0:
            inside += 1
            assert depth == pytest.approx(expected, abs=1e-5)
        else:
            assert expected <= depth + 1e-12
    assert inside > 50
