"""Between MuJoCo's coordinates and the state of a scene.

MuJoCo keeps quaternions as (w, x, y, z) of either sign and angular velocities in the frame of the
body. Neither conversion can be undone bit for bit, so an ``Instant`` remembers what the last
physics step left: whatever is set back to it gets MuJoCo's own numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numba
import numpy as np

from scm_world._types import Floats, Integers
from scm_world.tasks.trifinger.hardware import N_JOINTS
from scm_world.tasks.trifinger.state import BLOCK_SIZE, ROBOT_SIZE

_CLOSE = 1e-14  # relative; a few roundings, far less than any physics


@final
@dataclass(frozen=True)
class Instant:
    """What the last physics step left.

    Attributes:
        blocks: The blocks there were.
        vector: The state in the units of the scene, shape (27 + 13 n,).
        positions: MuJoCo's own, shape (9 + 7 n,).
        velocities: MuJoCo's own, shape (9 + 6 n,).
    """

    blocks: tuple[str, ...]
    vector: Floats
    positions: Floats
    velocities: Floats

    def source(self, blocks: tuple[str, ...]) -> Integers:
        """Find blocks in the instant; -1 where one is new. Shape (n,)."""
        where = {name: index for index, name in enumerate(self.blocks)}
        return np.array([where.get(name, -1) for name in blocks], dtype=np.int64)


def nothing() -> Instant:
    """Describe a world in which no physics step was made."""
    return Instant((), np.zeros(ROBOT_SIZE), np.zeros(N_JOINTS), np.zeros(N_JOINTS))


@numba.njit("void(f8[::1], i8, f8[::1], b1)", cache=True, error_model="numpy")
def _rotate(quaternion: Floats, start: int, vector: Floats, inverse: bool) -> None:
    """Rotate a vector in place by the quaternion (w, x, y, z) that begins at ``start``."""
    w, x, y, z = (
        quaternion[start],
        quaternion[start + 1],
        quaternion[start + 2],
        quaternion[start + 3],
    )
    scale = 2.0 / (w * w + x * x + y * y + z * z)
    if inverse:
        w = -w
    a, b, c = vector[0], vector[1], vector[2]
    # v + 2 w (q x v) + 2 q x (q x v)
    i, j, k = y * c - z * b, z * a - x * c, x * b - y * a
    vector[0] = a + scale * (w * i + y * k - z * j)
    vector[1] = b + scale * (w * j + z * i - x * k)
    vector[2] = c + scale * (w * k + x * j - y * i)


@numba.njit("void(f8[::1], f8[::1], f8[::1], f8[::1])", cache=True)
def read_state(positions: Floats, velocities: Floats, torques: Floats, into: Floats) -> None:
    """Convert MuJoCo's coordinates into the vector of a ``PhysicalState``."""
    spin = np.empty(3)
    for i in range(9):
        into[i] = positions[i]
        into[9 + i] = velocities[i]
        into[18 + i] = torques[i]
    for block in range((into.shape[0] - ROBOT_SIZE) // BLOCK_SIZE):
        q, v, s = 9 + 7 * block, 9 + 6 * block, ROBOT_SIZE + BLOCK_SIZE * block
        sign = -1.0 if positions[q + 3] < 0.0 else 1.0
        for axis in range(3):
            into[s + axis] = positions[q + axis]
            into[s + 3 + axis] = sign * positions[q + 4 + axis]
            into[s + 7 + axis] = velocities[v + axis]
            spin[axis] = velocities[v + 3 + axis]
        into[s + 6] = sign * positions[q + 3]
        _rotate(positions, q + 3, spin, False)
        for axis in range(3):
            into[s + 10 + axis] = spin[axis]


@numba.njit("void(f8[::1], f8[::1])", cache=True)
def settle(written: Floats, into: Floats) -> None:
    """Give back an angular velocity as it was written, where only roundings differ."""
    for s in range(ROBOT_SIZE, into.shape[0], BLOCK_SIZE):
        error, norm = 0.0, 0.0
        for axis in range(s + 10, s + 13):
            error += abs(into[axis] - written[axis])
            norm += abs(written[axis])
        if error <= _CLOSE * norm:
            for axis in range(s + 10, s + 13):
                into[axis] = written[axis]


@numba.njit(
    "void(f8[::1], f8[::1], f8[::1], i8[::1], f8[::1], f8[::1], f8[::1])",
    cache=True,
)
def write_state(
    vector: Floats,
    positions: Floats,
    velocities: Floats,
    source: Integers,
    last: Floats,
    last_positions: Floats,
    last_velocities: Floats,
) -> None:
    """Convert the vector of a ``PhysicalState`` into MuJoCo's coordinates.

    Args:
        vector: What to write; orientations of either sign.
        positions: Written, shape (9 + 7 n,).
        velocities: Written, shape (9 + 6 n,).
        source: Index of each block in the last instant, or -1, shape (n,).
        last: State of the last instant.
        last_positions: MuJoCo's own of that instant.
        last_velocities: MuJoCo's own of that instant.
    """
    spin = np.empty(3)
    for i in range(9):
        positions[i] = vector[i]
        velocities[i] = vector[9 + i]
    for block in range(source.shape[0]):
        q, v, s = 9 + 7 * block, 9 + 6 * block, ROBOT_SIZE + BLOCK_SIZE * block
        known = source[block] >= 0
        lq, lv = 9 + 7 * source[block], 9 + 6 * source[block]
        ls = ROBOT_SIZE + BLOCK_SIZE * source[block]
        turned, spun = not known, not known
        if known:
            for axis in range(4):
                turned |= vector[s + 3 + axis] != last[ls + 3 + axis]
            for axis in range(3):
                spun |= vector[s + 10 + axis] != last[ls + 10 + axis]
        sign = -1.0 if vector[s + 6] < 0.0 else 1.0
        for axis in range(3):
            positions[q + axis] = vector[s + axis]
            velocities[v + axis] = vector[s + 7 + axis]
            spin[axis] = vector[s + 10 + axis]
        positions[q + 3] = last_positions[lq + 3] if not turned else sign * vector[s + 6]
        for axis in range(3):
            raw = last_positions[lq + 4 + axis] if not turned else sign * vector[s + 3 + axis]
            positions[q + 4 + axis] = raw
        _rotate(positions, q + 3, spin, True)
        for axis in range(3):
            same = not (turned or spun)
            velocities[v + 3 + axis] = last_velocities[lv + 3 + axis] if same else spin[axis]


@numba.njit("b1(f8[::1], f8[::1])", cache=True)
def finite(positions: Floats, velocities: Floats) -> bool:
    """Tell whether no number is infinite or not a number."""
    total = 0.0
    for value in positions:
        total += value * 0.0
    for value in velocities:
        total += value * 0.0
    return total == 0.0


_OUTPUT = numba.types.Array(numba.float64, 2, "C", readonly=True)


@numba.njit(
    numba.int64(
        numba.float64[:, :], numba.float64[:, :], _OUTPUT, numba.int32[::1], numba.float64[:, ::1]
    ),
    cache=True,
)
def read_states(
    positions: Floats, velocities: Floats, torques: Floats, which: Any, into: Floats
) -> int:
    """Convert MuJoCo's coordinates of several scenes, one to a row.

    Args:
        positions: MuJoCo's own, shape (n, 9 + 7 k).
        velocities: MuJoCo's own, shape (n, 9 + 6 k).
        torques: MuJoCo's own, shape (n, 9 + 6 k).
        which: The rows, shape (m,).
        into: Their first columns are written, shape (n, at least 27 + 13 k).

    Returns:
        A row in which something is not finite; -1 if there is none.
    """
    position, velocity = np.empty(positions.shape[1]), np.empty(velocities.shape[1])
    torque = np.empty(N_JOINTS)
    end = ROBOT_SIZE + BLOCK_SIZE * ((positions.shape[1] - N_JOINTS) // 7)
    wrong = -1
    for i in which:
        position[:] = positions[i]
        velocity[:] = velocities[i]
        torque[:] = torques[i, :N_JOINTS]
        read_state(position, velocity, torque, into[i, :end])
        if not finite(position, velocity):
            wrong = i
    return wrong
