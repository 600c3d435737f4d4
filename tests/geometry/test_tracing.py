"""Functions of numbers that are traced: the same numbers as numba's, or a refusal."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from scm_world.geometry.numbers import njit
from scm_world.geometry.tracing import Expressions, Symbol, Trace, Untraceable

torch = pytest.importorskip("torch")

N = 50


@njit(cache=True)
def turned(point: Any, angle: float) -> Any:
    """Write into an array of its own, and return it."""
    found = np.empty(2)
    found[0] = math.cos(angle) * point[0] - math.sin(angle) * point[1]
    found[1] = math.sin(angle) * point[0] + math.cos(angle) * point[1]
    return found


@njit(cache=True)
def _stretch(point: Any, factor: float) -> None:
    if factor < 0.0:
        factor = -2.0 * factor
    for i in range(point.size):
        point[i] *= factor


@njit(cache=True)
def decided(point: Any, angle: float) -> float:
    """Decide by values, within a function that writes to its argument, too."""
    other = turned(point, angle)
    _stretch(other, point[0])
    if other[0] > other[1] and other[0] > 0.1:
        return 0.1
    if abs(other[1]) < 0.3:
        return 0.7
    total = 0.0
    for i in range(2):
        total += max(min(other[i], 0.4), -0.2) * (other[i] >= point[i]) + np.sign(other[i])
    return math.atan2(total, 1.5) ** 2 / (1.0 + math.exp(-abs(total)))


@njit(cache=True)
def counted(point: Any, angle: float) -> int:
    """Return a truth as a number."""
    return int(point[0] < angle)


@njit(cache=True)
def _five(array: Any) -> None:
    array[1] = 5.0


@njit(cache=True)
def truths(point: Any, angle: float) -> Any:
    """Count, subtract and weigh truths, and ask whether a number is not zero."""
    a, b = point[0] > 0.0, point[1] > angle
    found = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8])
    _five(found)
    seen = np.zeros(9)
    seen[0], seen[1], seen[2], seen[3] = 0.1 * a, a + b, a - (b + 0), -(a + 0.0)
    seen[4], seen[5], seen[6] = a / 3.0, a * b * 0.3, abs(a - 1.0) * 0.7
    seen[7] = (2.0 if point[0] else 1.0) + np.sign(a + 0.0) * 0.1
    seen[8] = found[1]
    return seen


@njit(cache=True)
def _marked(array: Any, number: float) -> None:
    if number > 0.0:
        array[0] = 1.0


@njit(cache=True)
def _both(one: Any, other: Any) -> None:
    one[0] = 3.0
    other[0] += one[0]


def _twice(point: Any, _: float) -> Any:
    _both(point, point)
    return point[0]


def _columns(function: Any, size: int) -> tuple[Any, Any]:
    trace = Trace()
    point = np.array([trace.column(0), trace.column(1)])
    found = np.atleast_1d(trace.call(function, [point, trace.column(2)]))
    results = {3 + i: one for i, one in enumerate(found.tolist())}
    given = np.random.default_rng(0).normal(size=(3, N))
    table = torch.as_tensor(np.vstack([given, np.zeros((size, N))]))
    Expressions(trace, results, torch)(table)
    return given, table[3:].numpy()


@pytest.mark.parametrize(
    ("function", "size"), [(turned, 2), (decided, 1), (counted, 1), (truths, 9)]
)
def test_columns_have_the_numbers_of_the_compiled_function(function: Any, size: int) -> None:
    """Also where a world takes another branch than its neighbour."""
    given, found = _columns(function, size)
    wanted = np.array([np.atleast_1d(function(row[:2], row[2])) for row in given.T.copy()]).T
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-14)
    assert len(np.unique(found[0].round(12))) > 1


@pytest.mark.parametrize(
    ("source", "why"),
    [
        (lambda point, _: float(len(range(int(point[0])))), "whole number"),
        (lambda point, _: math.floor(point[0]), "real number"),
        (lambda point, _: 1.0 if isinstance(point[0], float) else 2.0, "kind"),
        (lambda point, _: sum(1.0 for one in np.linspace(0.0, 1.0, 40) if one < point[0]), "often"),
        (lambda point, _: np.array([0.0]).__setitem__(0, point[0]), "float"),
        (lambda point, _: point[0] ** 3, "power"),
        (lambda point, _: _marked(np.array([0.0]), point[0]), "float"),
        (_twice, "parts of one array"),
    ],
)
def test_what_symbols_cannot_say_is_refused(source: Any, why: str) -> None:
    """No number comes out that could be another one in some world."""
    with pytest.raises(Untraceable, match=why):
        _columns(source, 1)


def test_symbols_are_not_numbers() -> None:
    """Nothing reads one as a number in silence."""
    symbol = Trace().column(0)
    assert isinstance(symbol, Symbol)
    for read in (float, int, math.sqrt, np.float64):
        with pytest.raises((TypeError, ValueError, AttributeError)):
            read(symbol)
