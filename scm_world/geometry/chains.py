"""Where a link of a chain of joints is: forward kinematics in one compiled function.

Source:
    MuJoCo, ``mj_kinematics``: the same steps in the same order.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import final

import numpy as np

from scm_world._types import ArrayLike, Floats
from scm_world.geometry.numbers import njit

OFFSET, HINGE, SLIDE, BALL, FREE = 0.0, 1.0, 2.0, 3.0, 4.0
WIDTH = 9
"""Numbers of a step: its kind, which number it begins with, and up to seven of its own."""


@final
@dataclass(frozen=True)
class Chain:
    """A function of joint positions: where the end of a chain is.

    Steps are ``(OFFSET, 0, place(3), turn(4))`` with quaternions (w, x, y, z),
    ``(HINGE, i, axis(3), anchor(3), reference)``, ``(SLIDE, i, axis(3), 0, 0, 0, reference)``,
    ``(BALL, i, anchor(3))`` and ``(FREE, i)``. The i-th number of all values, one after another,
    is the angle [rad], the way [m], or the first of a quaternion (x, y, z, w), or of a place and a
    quaternion.

    Attributes:
        links: First 0 for the place of the end, shape (3,) [m], or 1 for its orientation,
            (x, y, z, w) with w >= 0; then the steps from the world to it, ``WIDTH`` numbers each.
    """

    links: tuple[float, ...]

    @classmethod
    def of(cls, steps: Iterable[tuple[float, ...]], *, turn: bool) -> Chain:
        """Make one of steps; ``turn`` asks for the orientation."""
        padded = [(*step, *(0.0,) * (WIDTH - len(step))) for step in steps]
        return cls((float(turn), *(float(number) for step in padded for number in step)))

    def __call__(self, *values: ArrayLike) -> Floats:
        """Compute it from the positions of the joints, in the order of the steps' numbers."""
        numbers = np.concatenate([np.ravel(value) for value in values]).astype(np.float64)
        return end_of_chain(numbers, np.array(self.links))


@njit(cache=True)
def _product(a: Floats, w: float, x: float, y: float, z: float) -> None:
    """Multiply a quaternion (w, x, y, z) by another one from the right, in place."""
    w0, x0, y0, z0 = a[0], a[1], a[2], a[3]
    a[0] = w0 * w - x0 * x - y0 * y - z0 * z
    a[1] = w0 * x + x0 * w + y0 * z - z0 * y
    a[2] = w0 * y - x0 * z + y0 * w + z0 * x
    a[3] = w0 * z + x0 * y - y0 * x + z0 * w


@njit(cache=True)
def _add_turned(place: Floats, q: Floats, x: float, y: float, z: float, scale: float) -> None:
    """Add a vector that is turned by a quaternion (w, x, y, z), times a factor, in place."""
    tx = q[0] * x + q[2] * z - q[3] * y
    ty = q[0] * y + q[3] * x - q[1] * z
    tz = q[0] * z + q[1] * y - q[2] * x
    place[0] += scale * (x + 2.0 * (q[2] * tz - q[3] * ty))
    place[1] += scale * (y + 2.0 * (q[3] * tx - q[1] * tz))
    place[2] += scale * (z + 2.0 * (q[1] * ty - q[2] * tx))


@njit(cache=True)
def _normalize(q: Floats) -> None:
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if norm < 1e-15:
        q[0], q[1], q[2], q[3] = 1.0, 0.0, 0.0, 0.0
    else:
        for k in range(4):
            q[k] /= norm


@njit(cache=True)
def end_of_chain(numbers: Floats, links: Floats) -> Floats:
    """Compute where the end of a chain is, shape (3,) [m] or (4,); see ``Chain``."""
    place, turn, ball = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.empty(4)
    for step in range((links.size - 1) // WIDTH):
        at = links[1 + step * WIDTH : 1 + (step + 1) * WIDTH]
        i = int(at[1])
        if at[0] == OFFSET:
            _add_turned(place, turn, at[2], at[3], at[4], 1.0)
            _product(turn, at[5], at[6], at[7], at[8])
            _normalize(turn)
        elif at[0] == HINGE:
            half = 0.5 * (numbers[i] - at[8])
            sine = math.sin(half)
            _add_turned(place, turn, at[5], at[6], at[7], 1.0)
            _product(turn, math.cos(half), at[2] * sine, at[3] * sine, at[4] * sine)
            _add_turned(place, turn, at[5], at[6], at[7], -1.0)
        elif at[0] == SLIDE:
            _add_turned(place, turn, at[2], at[3], at[4], numbers[i] - at[8])
        elif at[0] == BALL:
            ball[0] = numbers[i + 3]
            ball[1:] = numbers[i : i + 3]
            _normalize(ball)
            _add_turned(place, turn, at[2], at[3], at[4], 1.0)
            _product(turn, ball[0], ball[1], ball[2], ball[3])
            _add_turned(place, turn, at[2], at[3], at[4], -1.0)
        else:
            for k in range(3):
                place[k], turn[1 + k] = numbers[i + k], numbers[i + 3 + k]
            turn[0] = numbers[i + 6]
            _normalize(turn)
    if links[0] == 0.0:
        return place
    _normalize(turn)
    sign = -1.0 if turn[0] < 0.0 else 1.0
    return np.array([sign * turn[1], sign * turn[2], sign * turn[3], sign * turn[0]])
