"""Facts about how much of the goals the blocks fill."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

import numpy as np
import pytest

from scm_world._types import ArrayLike, Floats
from scm_world.geometry import filling
from scm_world.geometry.filling import aabb_overlap_fraction
from scm_world.geometry.rotations import rotation_matrix

UPRIGHT = (0.0, 0.0, 0.0, 1.0)

Box = tuple[Floats, Floats, Floats]


def overlap_fraction(*boxes: ArrayLike) -> float:
    """Call the compiled function with lists, too."""
    widths = (3, 3, 4, 3, 3, 4)
    rows = (np.array(numbers, dtype=float) for numbers in boxes)
    return filling.overlap_fraction(*(r.reshape(-1, w) for r, w in zip(rows, widths, strict=True)))


def test_goals_are_filled_by_the_sum_of_their_blocks() -> None:
    """Two half blocks fill one of two equal goals: one half in all."""
    goals = ([(1, 1, 1)] * 2, [(0, 0, 0), (5, 0, 0)], [UPRIGHT] * 2)
    halves = ([(0.5, 1, 1)] * 2, [(-0.25, 0, 0), (0.25, 0, 0)], [UPRIGHT] * 2)
    assert overlap_fraction(*halves, *goals) == 0.5


def test_a_crowded_goal_does_not_make_up_for_an_empty_one() -> None:
    """Three blocks in one place fill one goal of two; the predecessor's rule counts them all."""
    goals = ([(1, 1, 1)] * 2, [(0, 0, 0), (5, 0, 0)], [UPRIGHT] * 2)
    crowd = ([(1, 1, 1)] * 3, [(0, 0, 0)] * 3, [UPRIGHT] * 3)
    assert overlap_fraction(*crowd, *goals) == 0.5
    assert aabb_overlap_fraction(*crowd, *goals) == 1.5


def _random_boxes(rng: np.random.Generator, n: int, spread: float) -> list[Box]:
    return [
        (rng.uniform(0.05, 0.2, 3), rng.normal(size=3) * spread, rng.normal(size=4))
        for _ in range(n)
    ]


def _subsets(boxes: list[Box]) -> list[tuple[float, tuple[Box, ...]]]:
    """List all that inclusion and exclusion add up, each with its sign."""
    return [
        ((-1.0) ** (k + 1), chosen)
        for k in range(1, len(boxes) + 1)
        for chosen in combinations(boxes, k)
    ]


def test_what_intersects_counts_once(shared_volume: Callable[[tuple[Box, ...]], float]) -> None:
    """Three blocks and two goals in one heap: inclusion and exclusion say the same."""
    rng = np.random.default_rng(0)
    for _ in range(12):
        blocks, goals = _random_boxes(rng, 3, 0.02), _random_boxes(rng, 2, 0.02)
        wanted = sum(sign * shared_volume(some) for sign, some in _subsets(goals))
        filled = sum(
            sign * other * shared_volume(some + others)
            for sign, some in _subsets(goals)
            for other, others in _subsets(blocks)
        )
        columns = [list(part) for boxes in (blocks, goals) for part in zip(*boxes, strict=True)]
        assert overlap_fraction(*columns) == pytest.approx(filled / wanted, abs=1e-7)


def test_a_block_in_two_goals_fills_both_once() -> None:
    """A block that lies where two goals intersect fills that part of their union."""
    goals = ([(2, 1, 1)] * 2, [(0, 0, 0), (1, 0, 0)], [UPRIGHT] * 2)
    assert overlap_fraction([(1, 1, 1)], [(0.5, 0, 0)], [UPRIGHT], *goals) == pytest.approx(1 / 3)


def test_equal_goals_are_one() -> None:
    """Goals in one place count as one, and a block that fills it fills all."""
    rng = np.random.default_rng(1)
    for size, position, orientation in _random_boxes(rng, 20, 0.1):
        goals = ([size] * 4, [position] * 4, [orientation] * 4)
        exact = overlap_fraction([size], [position], [orientation], *goals)
        assert exact == pytest.approx(1.0, abs=1e-12)
        half = size * [0.5, 1.0, 1.0]
        shift = position + rotation_matrix(orientation) @ (0.25 * size * [1.0, 0.0, 0.0])
        assert overlap_fraction([half] * 2, [shift] * 2, [orientation] * 2, *goals) == (
            pytest.approx(0.5, abs=1e-12)
        )


def test_blocks_that_press_into_one_another_do_not_fill_more() -> None:
    """A stack that sinks into itself by a hundredth of its height has lost just that."""
    cube, up = (0.1, 0.1, 0.1), [UPRIGHT] * 3
    goals = ([cube] * 3, [(0, 0, z) for z in (0.05, 0.15, 0.25)], up)
    sunk = [(0, 0, z) for z in (0.05, 0.149, 0.248)]
    assert overlap_fraction([cube] * 3, sunk, up, *goals) == pytest.approx(0.298 / 0.3, abs=1e-12)
    order = np.array([2, 0, 1])
    assert overlap_fraction([cube] * 3, np.array(sunk)[order], up, *goals) == pytest.approx(
        0.298 / 0.3, abs=1e-12
    )
