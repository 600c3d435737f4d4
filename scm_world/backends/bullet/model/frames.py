"""Frames of bodies, and those of their principal axes of inertia, which the engine has.

In plain floats: it runs for every free body and ball joint whenever a state is set or read.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

Numbers = Sequence[float]


@final
class Frame:
    """The frame of a free body.

    Args:
        multibody: Its number in the engine.
        start: Where its joint begins in the state.
        center: Center of mass in the frame of the body [m].
        axes: From the principal axes of inertia to the frame of the body (x, y, z, w).
    """

    def __init__(self, multibody: int, start: int, center: Numbers, axes: Numbers) -> None:
        self.multibody, self.start = multibody, start
        self._center, self._axes = center, axes
        self._back = (-axes[0], -axes[1], -axes[2], axes[3])

    def to_engine(self, state: list[float]) -> tuple[Numbers, Numbers, Numbers, Numbers]:
        """Turn the state of the body into what the engine has.

        Returns:
            Position of the center and orientation of the principal axes, velocity of the center
            and angular velocity, all in the world.
        """
        at = self.start
        turn, linear = state[at + 3 : at + 7], state[at + 7 : at + 10]
        arm, spin = rotated(turn, self._center), rotated(turn, state[at + 10 : at + 13])
        return (
            [state[at + k] + arm[k] for k in range(3)],
            composed(turn, self._axes),
            _carried(linear, spin, arm, 1.0),
            spin,
        )

    def from_engine(
        self, pose: tuple[Numbers, Numbers], twist: tuple[Numbers, Numbers]
    ) -> list[float]:
        """Turn what the engine has into the state of the body, with a quaternion whose w >= 0.

        The engine keeps a matrix: which of two quaternions it makes of it has no meaning.
        """
        (position, orientation), (linear, spin) = pose, twist
        turn = composed(orientation, self._back)
        if turn[3] < 0.0:
            turn = [-part for part in turn]
        arm = rotated(turn, self._center)
        back = (-turn[0], -turn[1], -turn[2], turn[3])
        return [
            position[0] - arm[0],
            position[1] - arm[1],
            position[2] - arm[2],
            *turn,
            *_carried(linear, spin, arm, -1.0),
            *rotated(back, spin),
        ]


@final
class Ball:
    """A ball joint. The engine has it about the principal axes of the body.

    Args:
        multibody: Its number in the engine.
        link: Its link.
        start: Where it begins in the state.
        axes: From the principal axes of inertia to the frame of the body (x, y, z, w).
    """

    def __init__(self, multibody: int, link: int, start: int, axes: Numbers) -> None:
        self.multibody, self.link, self.start = multibody, link, start
        self._axes = axes
        self._back = (-axes[0], -axes[1], -axes[2], axes[3])

    def to_engine(self, state: list[float]) -> tuple[Numbers, Numbers]:
        """Turn the state of the joint into orientation and angular velocity in the engine."""
        at = self.start
        turn, spin = state[at : at + 4], state[at + 4 : at + 7]
        return composed(composed(self._back, turn), self._axes), rotated(self._back, spin)

    def from_engine(self, turn: Numbers, spin: Numbers) -> list[float]:
        """Turn what the engine has into the state of the joint."""
        own = composed(composed(self._axes, turn), self._back)
        return [*own, *rotated(self._axes, spin)]

    def torque(self, torque: Numbers) -> Numbers:
        """Turn a torque in the frame of the body into one about the principal axes."""
        return rotated(self._back, torque)


def rotated(turn: Numbers, v: Numbers) -> Numbers:
    """Rotate a vector by a unit quaternion (x, y, z, w)."""
    x, y, z, w = turn
    a, b, c = v
    p, q, r = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return (
        a + w * p + (y * r - z * q),
        b + w * q + (z * p - x * r),
        c + w * r + (x * q - y * p),
    )


def composed(p: Numbers, q: Numbers) -> Numbers:
    """Compose two rotations (x, y, z, w): first q, then p."""
    a, b, c, d = p
    x, y, z, w = q
    return (
        d * x + a * w + b * z - c * y,
        d * y + b * w + c * x - a * z,
        d * z + c * w + a * y - b * x,
        d * w - a * x - b * y - c * z,
    )


def _carried(linear: Numbers, spin: Numbers, arm: Numbers, sign: float) -> Numbers:
    """Give the velocity of the point at an arm from the one that has the linear velocity."""
    return (
        linear[0] + sign * (spin[1] * arm[2] - spin[2] * arm[1]),
        linear[1] + sign * (spin[2] * arm[0] - spin[0] * arm[2]),
        linear[2] + sign * (spin[0] * arm[1] - spin[1] * arm[0]),
    )
