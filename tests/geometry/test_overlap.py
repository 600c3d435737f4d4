"""Facts about the volume that boxes share."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scm_world._types import ArrayLike, Floats
from scm_world.geometry import filling
from scm_world.geometry.filling import aabb_overlap_fraction
from scm_world.geometry.rotations import (
    from_rotation_vector,
    quaternion_product,
    rotation_matrix,
)

UPRIGHT = (0.0, 0.0, 0.0, 1.0)
HERE = (0.0, 0.0, 0.0)
EIGHTH = from_rotation_vector([0.0, 0.0, np.pi / 4])

Box = tuple[Floats, Floats, Floats]


def overlap_fraction(*boxes: ArrayLike) -> float:
    """Call the compiled function with lists, too."""
    widths = (3, 3, 4, 3, 3, 4)
    rows = (np.array(numbers, dtype=float) for numbers in boxes)
    return filling.overlap_fraction(*(r.reshape(-1, w) for r, w in zip(rows, widths, strict=True)))


def overlap_volume(*boxes: ArrayLike) -> float:
    """Compute the volume that two boxes share: sizes, positions and orientations."""
    goal = float(np.prod(boxes[3]))
    return overlap_fraction(*boxes) * goal


def _vectors(low: float, high: float) -> st.SearchStrategy[Floats]:
    numbers = st.floats(low, high, allow_subnormal=False)
    return st.tuples(numbers, numbers, numbers).map(np.array)


boxes = st.tuples(
    _vectors(0.01, 0.2), _vectors(-0.1, 0.1), _vectors(-3.0, 3.0).map(from_rotation_vector)
)


def _random_box(rng: np.random.Generator, spread: float) -> Box:
    return rng.uniform(0.02, 0.2, 3), rng.normal(size=3) * spread, rng.normal(size=4)


def test_volumes_are_those_of_scipy(shared_volume: Callable[[Sequence[Box]], float]) -> None:
    """Random pairs share what a general half-space intersection says, to 1e-9 of the smaller."""
    rng, shared = np.random.default_rng(0), 0
    for _ in range(300):
        a, b = _random_box(rng, 0.03), _random_box(rng, 0.03)
        expected = shared_volume((a, b))
        smaller = min(np.prod(a[0]), np.prod(b[0]))
        assert overlap_volume(*a, *b) == pytest.approx(expected, abs=1e-9 * smaller)
        shared += expected > 0.0
    assert shared > 250


def test_small_overlaps_have_nine_digits(shared_volume: Callable[[Sequence[Box]], float]) -> None:
    """Also where boxes share a thousandth of their volume, or less, nine digits are right."""
    rng, compared = np.random.default_rng(1), 0
    for _ in range(150):
        a, b = _random_box(rng, 0.08), _random_box(rng, 0.08)
        expected = shared_volume((a, b))
        if expected > 1e-4 * min(np.prod(a[0]), np.prod(b[0])):
            compared += 1
            assert overlap_volume(*a, *b) == pytest.approx(expected, rel=1e-9)
    assert compared >= 40


@settings(max_examples=200, deadline=None)
@given(boxes, boxes)
def test_the_order_of_the_boxes_does_not_matter(a: Box, b: Box) -> None:
    """Swapping the boxes changes the volume by less than 1e-12 of the smaller one."""
    smaller = min(np.prod(a[0]), np.prod(b[0]))
    assert overlap_volume(*a, *b) == pytest.approx(overlap_volume(*b, *a), abs=1e-12 * smaller)


@settings(max_examples=200, deadline=None)
@given(boxes, boxes)
def test_the_volume_is_bounded_by_the_smaller_box(a: Box, b: Box) -> None:
    """It is at least zero and, but for rounding, at most the volume of the smaller box."""
    smaller = min(np.prod(a[0]), np.prod(b[0]))
    assert 0.0 <= overlap_volume(*a, *b) <= (1.0 + 1e-14) * smaller


@settings(max_examples=200, deadline=None)
@given(boxes, boxes, _vectors(-1.0, 1.0), _vectors(-3.0, 3.0).map(from_rotation_vector))
def test_moving_both_boxes_changes_nothing(a: Box, b: Box, shift: Floats, turn: Floats) -> None:
    """A rigid motion of both boxes leaves what they share."""

    def moved(box: Box) -> Box:
        position = rotation_matrix(turn) @ box[1] + shift
        return box[0], position, quaternion_product(turn, box[2])

    smaller = min(np.prod(a[0]), np.prod(b[0]))
    still = overlap_volume(*a, *b)
    assert overlap_volume(*moved(a), *moved(b)) == pytest.approx(still, abs=1e-11 * smaller)


@settings(max_examples=200, deadline=None)
@given(boxes)
def test_a_box_fills_itself(box: Box) -> None:
    """A box in its own place fills it to 1e-12, in any pose and by either quaternion."""
    volume = np.prod(box[0])
    assert overlap_volume(*box, *box) == pytest.approx(volume, rel=1e-12)
    assert overlap_volume(*box, box[0], box[1], -box[2]) == pytest.approx(volume, rel=1e-12)


@settings(max_examples=100, deadline=None)
@given(boxes, _vectors(-1.0, 1.0), st.integers(-17, -3))
def test_the_volume_is_continuous_at_coplanar_faces(
    box: Box, direction: Floats, exponent: int
) -> None:
    """A box moved and turned by a little in its own place still fills all but a little."""
    little = 10.0**exponent * direction
    moved = box[1] + 0.01 * little
    turned = quaternion_product(from_rotation_vector(little), box[2])
    lost = 1.0 - overlap_volume(box[0], moved, turned, *box) / np.prod(box[0])
    assert -1e-12 <= lost <= 1e-12 + 100.0 * np.linalg.norm(little)


def test_a_turned_cube_fills_two_root_two_less_two_of_its_place() -> None:
    """A cube yawed by 45 degrees fills 2 (√2 - 1) of its own goal, and the AABB rule says all."""
    cube = (0.065, 0.065, 0.065)
    expected = 2.0 * (np.sqrt(2.0) - 1.0)
    volume = overlap_volume(cube, HERE, EIGHTH, cube, HERE, UPRIGHT)
    assert volume / 0.065**3 == pytest.approx(expected, rel=1e-14)
    pair = ([cube], [HERE], [EIGHTH], [cube], [HERE], [UPRIGHT])
    assert overlap_fraction(*pair) == pytest.approx(expected, rel=1e-14)
    assert aabb_overlap_fraction(*pair) == pytest.approx(1.0, rel=1e-14)


@pytest.mark.parametrize("orientation", [UPRIGHT, tuple(EIGHTH), (0.5, 0.5, 0.5, 0.5)])
def test_boxes_that_touch_share_nothing(orientation: tuple[float, ...]) -> None:
    """A common face, edge or corner has no volume."""
    axes = rotation_matrix(orientation)
    for offset in ([1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 1.0], [0.0, 0.3, 1.0]):
        other = axes @ offset
        shared = overlap_volume((1, 1, 1), HERE, orientation, (1, 1, 1), other, orientation)
        assert shared == pytest.approx(0.0, abs=1e-15)


def test_a_small_box_within_a_large_one_is_all_shared() -> None:
    """Whatever lies inside is counted whole, also with faces of both in one plane."""
    inside = ((0.1, 0.2, 0.3), (0.05, -0.1, 0.1), EIGHTH)
    assert overlap_volume(*inside, (2, 2, 2), HERE, UPRIGHT) == pytest.approx(0.006, rel=1e-14)
    flush = ((0.5, 1.0, 1.0), (0.25, 0.0, 0.0), UPRIGHT)
    assert overlap_volume(*flush, (1, 1, 1), HERE, UPRIGHT) == 0.5


def test_a_box_without_volume_shares_none() -> None:
    """A plate without thickness, a point, and a quaternion of zero make zero, not NaN."""
    for size in ((0.0, 1.0, 1.0), (0.0, 0.0, 0.0)):
        assert overlap_volume(size, HERE, EIGHTH, (1, 1, 1), HERE, UPRIGHT) == 0.0
        assert overlap_volume((1, 1, 1), HERE, EIGHTH, size, HERE, UPRIGHT) == 0.0
    assert overlap_volume((1, 1, 1), HERE, (0, 0, 0, 0), (1, 1, 1), HERE, UPRIGHT) == 1.0


def test_thin_plates_keep_their_precision() -> None:
    """Plates of a millionth of their width cross in an exact strip."""
    plate, upright = (1.0, 1.0, 1e-6), from_rotation_vector([np.pi / 2, 0.0, 0.0])
    assert overlap_volume(plate, HERE, UPRIGHT, plate, HERE, upright) == pytest.approx(
        1e-12, rel=1e-9
    )


@pytest.mark.parametrize("fraction", [overlap_fraction, aabb_overlap_fraction])
def test_no_goal_is_fulfilled_and_no_block_fills_nothing(fraction) -> None:  # type: ignore[no-untyped-def]
    """A world without goals scores 1, one without blocks 0."""
    one, none = ([(1, 1, 1)], [(0, 0, 0)], [UPRIGHT]), ([], [], [])
    assert fraction(*one, *none) == 1.0
    assert fraction(*none, *one) == 0.0
    assert fraction(*none, *none) == 1.0


def test_aabb_overlap_is_an_intersection_of_hulls() -> None:
    """The predecessor's goal is the hull of the turned box: a turned goal is twice as large."""
    cube = [(1, 1, 1)]
    turned_goal = (cube, [HERE], [EIGHTH])
    assert aabb_overlap_fraction(cube, [HERE], [UPRIGHT], *turned_goal) == pytest.approx(0.5)
