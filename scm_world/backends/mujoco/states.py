"""The state of a model as MuJoCo has it, and as a vector."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import mujoco
import numba
import numpy as np

from scm_world._types import Floats, Integers
from scm_world.backends.mujoco.reading import permutation
from scm_world.models.model import Model


@numba.njit("void(f8[::1], i8, f8[::1], b1)", cache=True, error_model="numpy")
def _rotate(turn: Floats, start: int, vector: Floats, inverse: bool) -> None:
    """Rotate a vector in place by the quaternion (x, y, z, w) that begins at ``start``."""
    x, y, z, w = turn[start], turn[start + 1], turn[start + 2], turn[start + 3]
    scale = 2.0 / (w * w + x * x + y * y + z * z)
    if inverse:
        w = -w
    a, b, c = vector[0], vector[1], vector[2]
    # v + 2 w (q x v) + 2 q x (q x v)
    i, j, k = y * c - z * b, z * a - x * c, x * b - y * a
    vector[0] = a + scale * (w * i + y * k - z * j)
    vector[1] = b + scale * (w * j + z * i - x * k)
    vector[2] = c + scale * (w * k + x * j - y * i)


@numba.njit("void(f8[::1], i8[:, ::1])", cache=True)
def _into_world(vector: Floats, turned: Integers) -> None:
    """Give quaternions a w that is not negative, and turn angular velocities into the world.

    Args:
        vector: A state, changed in place.
        turned: Where in it the quaternion and the angular velocity of each body begin, shape
            (n, 2).
    """
    spin = np.empty(3)
    for body in range(turned.shape[0]):
        q, v = turned[body, 0], turned[body, 1]
        for axis in range(3):
            spin[axis] = vector[v + axis]
        _rotate(vector, q, spin, False)
        for axis in range(3):
            vector[v + axis] = spin[axis]
        if vector[q + 3] < 0.0:
            for axis in range(4):
                vector[q + axis] = -vector[q + axis]


@numba.njit(
    "void(f8[::1], f8[::1], f8[::1], f8[::1], i8[::1], i8[:, ::1], i8[:, ::1], f8[::1])", cache=True
)
def read_vector(
    positions: Floats,
    velocities: Floats,
    activations: Floats,
    forces: Floats,
    places: Integers,
    turned: Integers,
    reported: Integers,
    into: Floats,
) -> None:
    """Copy MuJoCo's coordinates into a state vector.

    Args:
        positions: Shape (nq,).
        velocities: Shape (nv,).
        activations: Shape (na,).
        forces: ``qfrc_actuator``, shape (nv,).
        places: Where in the vector each of the first three stands, in this order, shape
            (nq + nv + na,).
        turned: See ``_into_world``.
        reported: Places in the vector, and in ``forces``, of what is reported, shape (m, 2).
        into: Written, shape (nq + nv + na + m,).
    """
    nq, nv = positions.shape[0], velocities.shape[0]
    for i in range(nq):
        into[places[i]] = positions[i]
    for i in range(nv):
        into[places[nq + i]] = velocities[i]
    for i in range(activations.shape[0]):
        into[places[nq + nv + i]] = activations[i]
    for i in range(reported.shape[0]):
        into[reported[i, 0]] = forces[reported[i, 1]]
    _into_world(into, turned)


@numba.njit("void(f8[::1], f8[::1], f8[::1], i8[::1], f8[::1])", cache=True)
def write_vector(
    positions: Floats, velocities: Floats, activations: Floats, places: Integers, vector: Floats
) -> None:
    """Copy a state vector into MuJoCo's coordinates; see ``read_vector``."""
    nq, nv = positions.shape[0], velocities.shape[0]
    for i in range(nq):
        positions[i] = vector[places[i]]
    for i in range(nv):
        velocities[i] = vector[places[nq + i]]
    for i in range(activations.shape[0]):
        activations[i] = vector[places[nq + nv + i]]


@numba.njit("void(f8[::1], i8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1])", cache=True)
def into_bodies(
    vector: Floats, turned: Integers, known: Floats, exact: Floats, into: Floats
) -> None:
    """Turn angular velocities in the world into those in the frames of the bodies.

    A body whose quaternion and angular velocity are those that were read after the last step gets
    MuJoCo's own numbers of that step: turning back and forth would change the last digits.

    Args:
        vector: The state to write.
        turned: See ``_into_world``; shape (n, 2).
        known: Quaternion and angular velocity that were read, nan for a new body, shape (n, 7).
        exact: MuJoCo's own: quaternion (w, x, y, z) and angular velocity, shape (n, 7).
        into: MuJoCo's numbers of the new state, shape (n, 7).
    """
    spin = np.empty(3)
    for body in range(turned.shape[0]):
        q, v = turned[body, 0], turned[body, 1]
        turns, spins = False, False
        for axis in range(4):
            turns |= vector[q + axis] != known[body, axis]
        for axis in range(3):
            spins |= vector[v + axis] != known[body, 4 + axis]
            spin[axis] = vector[v + axis]
        sign = -1.0 if vector[q + 3] < 0.0 else 1.0
        for axis in range(4):
            place = q + (axis + 3) % 4  # w comes first
            into[body, axis] = sign * vector[place] if turns else exact[body, axis]
        _rotate(vector, q, spin, True)
        for axis in range(3):
            into[body, 4 + axis] = spin[axis] if turns or spins else exact[body, 4 + axis]


_CLOSE = 1e-14  # relative; a few roundings, far less than any physics


@numba.njit("void(f8[::1], f8[::1], i8[:, ::1])", cache=True)
def settle(written: Floats, into: Floats, turned: Integers) -> None:
    """Read an angular velocity as it was written, where only roundings differ."""
    for body in range(turned.shape[0]):
        error, norm = 0.0, 0.0
        for axis in range(turned[body, 1], turned[body, 1] + 3):
            error += abs(into[axis] - written[axis])
            norm += abs(written[axis])
        if error <= _CLOSE * norm:
            for axis in range(turned[body, 1], turned[body, 1] + 3):
                into[axis] = written[axis]


_FORCES = numba.types.Array(numba.float64, 2, "C", readonly=True)


@numba.njit(
    numba.int64(
        numba.float64[:, ::1], _FORCES, numba.int64[::1], numba.int64[:, ::1],
        numba.int64[:, ::1], numba.int32[::1], numba.float64[:, ::1],
    ),
    cache=True,
)  # fmt: skip
def read_rows(
    states: Floats,
    forces: Floats,
    places: Integers,
    turned: Integers,
    reported: Integers,
    which: Any,
    into: Floats,
) -> int:
    """Copy some rows of MuJoCo's states (time, positions, velocities, activations, ...).

    Args:
        states: Of all simulations, one to a row.
        forces: ``qfrc_actuator`` of all, shape (n, nv); not read if nothing is reported.
        places: See ``read_vector``.
        turned: See ``read_vector``.
        reported: See ``read_vector``.
        which: The rows, shape (m,).
        into: The first columns of these rows are written.

    Returns:
        A row in which something is not finite; -1 if there is none.
    """
    wrong = -1
    for row in which:
        total = 0.0
        for i in range(places.shape[0]):
            value = states[row, 1 + i]
            into[row, places[i]] = value
            total += value * 0.0
        for i in range(reported.shape[0]):
            into[row, reported[i, 0]] = forces[row, reported[i, 1]]
        _into_world(into[row], turned)
        if total != 0.0:
            wrong = row
    return wrong


@final
@dataclass(frozen=True)
class Turned:
    """The bodies whose orientation and angular velocity are given in the world.

    Attributes:
        names: Of the bodies.
        vector: Where in the state vector quaternion and angular velocity begin, shape (n, 2).
        positions: The numbers of ``qpos`` that are their quaternions, shape (n, 4).
        velocities: The numbers of ``qvel`` that are their angular velocities, shape (n, 3).
    """

    names: tuple[str, ...]
    vector: Integers
    positions: Integers
    velocities: Integers

    @staticmethod
    def of(model: Model, mj: mujoco.MjModel) -> Turned:
        """Find them in the tables of a model."""
        in_world = {
            number
            for row in model.states
            if row.frame == "world" and row.array == "qvel"
            for number in row.numbers
        }
        qpos, qvel, _ = permutation(model)
        names, starts, own = [], [], []
        for joint in np.flatnonzero(mj.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)).tolist():
            q, v = int(mj.jnt_qposadr[joint]) + 3, int(mj.jnt_dofadr[joint]) + 3
            if v in in_world:
                names.append(model.body_names[int(mj.jnt_bodyid[joint])])
                starts.append((qpos[q + 1], qvel[v]))
                own.append((q, v))
        first = np.array(own, dtype=np.int64).reshape(-1, 2)
        return Turned(
            tuple(names),
            np.array(starts, dtype=np.int64).reshape(-1, 2),
            first[:, :1] + np.arange(4),
            first[:, 1:] + np.arange(3),
        )

    def read(self, vector: Floats) -> Floats:
        """Copy quaternions (x, y, z, w) and angular velocities of a state, shape (n, 7)."""
        starts = self.vector
        turns, spins = starts[:, :1] + np.arange(4), starts[:, 1:] + np.arange(3)
        return np.hstack([vector[turns], vector[spins]])

    def read_own(self, positions: Floats, velocities: Floats) -> Floats:
        """Copy MuJoCo's quaternions (w, x, y, z) and angular velocities, shape (n, 7)."""
        return np.hstack([positions[self.positions], velocities[self.velocities]])

    def write_own(self, numbers: Floats, positions: Floats, velocities: Floats) -> None:
        """Write MuJoCo's quaternions and angular velocities, shape (n, 7)."""
        positions[self.positions], velocities[self.velocities] = numbers[:, :4], numbers[:, 4:]


LastStep = tuple[tuple[str, ...], Floats, Floats]
"""What the last step left of bodies that are given in the world: their names, and the numbers that
were read and MuJoCo's own, shape (n, 7) each."""
