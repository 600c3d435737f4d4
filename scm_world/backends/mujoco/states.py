"""The state of a model as MuJoCo has it, and as a vector.

MuJoCo's motion is ``qpos``, ``qvel`` and ``act`` in a row; a permutation makes a vector of it.
Bodies that are given in the world are in addition *turned*: their quaternions get a w that is not
negative, and their angular velocities, which MuJoCo has in the frame of the body, those in the
world.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numba
import numpy as np

from scm_world._types import Floats, Integers
from scm_world.backends.mujoco.reading import permutation
from scm_world.models.model import Model

MOTION = sum(int(getattr(mujoco.mjtState, f"mjSTATE_{part}")) for part in ("QPOS", "QVEL", "ACT"))


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


@numba.njit("void(f8[:, ::1], i4[::1], i8[:, ::1])", cache=True)
def into_world(vectors: Floats, which: Any, turned: Integers) -> None:
    """Make w of quaternions not negative, and turn angular velocities into the world.

    Args:
        vectors: States, one to a row, changed in place.
        which: The rows.
        turned: Where in a row the quaternion and the angular velocity of each body are, shape
            (n, 7).
    """
    spin = np.empty(3)
    for row in which:
        vector = vectors[row]
        for body in range(turned.shape[0]):
            q, v = turned[body, 0], turned[body, 4]
            for axis in range(3):
                spin[axis] = vector[v + axis]
            _rotate(vector, q, spin, False)
            for axis in range(3):
                vector[v + axis] = spin[axis]
            if vector[q + 3] < 0.0:
                for axis in range(4):
                    vector[q + axis] = -vector[q + axis]


@numba.njit("void(f8[::1], i8[:, ::1], i8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1])", cache=True)
def into_bodies(
    vector: Floats, turned: Integers, own: Integers, known: Floats, exact: Floats, motion: Floats
) -> None:
    """Turn angular velocities in the world into those in the frames of the bodies.

    A body whose quaternion and angular velocity are those that were read after the last step gets
    MuJoCo's own numbers of that step: turning back and forth would change the last digits.

    Args:
        vector: The state to write.
        turned: Where in it the seven numbers of each body are, shape (n, 7).
        own: Where in the motion they are: quaternion (w, x, y, z) and angular velocity.
        known: Quaternion and angular velocity that were read, nan for a new body, shape (n, 7).
        exact: MuJoCo's own numbers then, shape (n, 7).
        motion: Written.
    """
    spin = np.empty(3)
    for body in range(turned.shape[0]):
        q, v = turned[body, 0], turned[body, 4]
        turns, spins = False, False
        for axis in range(4):
            turns |= vector[q + axis] != known[body, axis]
        for axis in range(3):
            spins |= vector[v + axis] != known[body, 4 + axis]
            spin[axis] = vector[v + axis]
        sign = -1.0 if vector[q + 3] < 0.0 else 1.0
        for axis in range(4):
            place = q + (axis + 3) % 4  # w comes first
            motion[own[body, axis]] = sign * vector[place] if turns else exact[body, axis]
        _rotate(vector, q, spin, True)
        for axis in range(4, 7):
            motion[own[body, axis]] = spin[axis - 4] if turns or spins else exact[body, axis]


_CLOSE = 1e-14  # relative; a few roundings, far less than any physics


@numba.njit("void(f8[::1], f8[::1], i8[:, ::1])", cache=True)
def settle(written: Floats, into: Floats, turned: Integers) -> None:
    """Read an angular velocity as it was written, where only roundings differ."""
    for places in turned:
        error, norm = 0.0, 0.0
        for place in places[4:]:
            error += abs(into[place] - written[place])
            norm += abs(written[place])
        if error <= _CLOSE * norm:
            for place in places[4:]:
                into[place] = written[place]


def read_rows(
    states: Floats,
    forces: Any,
    places: Integers,
    turned: Integers,
    reported: Integers,
    which: Any,
    into: Floats,
) -> int:
    """Copy some rows of MuJoCo's states (time, positions, velocities, activations, ...).

    Args:
        states: Of all simulations, one to a row.
        forces: ``qfrc_actuator`` of all, shape (n, nv); None if nothing is reported.
        places: Where in a vector each number of the motion is.
        turned: See ``into_world``.
        reported: Places in a vector, and in ``forces``, of what is reported, shape (2, m).
        which: The rows, shape (m,).
        into: The first columns of these rows are written.

    Returns:
        A row in which something is not finite; -1 if there is none.
    """
    rows, motion = which[:, None], states[which, 1 : 1 + len(places)]
    into[rows, places] = motion
    if reported.size:
        into[rows, reported[0]] = forces[rows, reported[1]]
    if len(turned):
        into_world(into, which, turned)
    wrong = which[~np.isfinite(motion).all(axis=1)]
    return int(wrong[-1]) if len(wrong) else -1


def turned_bodies(model: Model, mj: mujoco.MjModel) -> tuple[tuple[str, ...], Integers, Integers]:
    """Find the bodies that are given in the world.

    Returns:
        Their names, and the places of their quaternions and angular velocities in the state vector
        and in the motion, shape (n, 7) each.
    """
    spins = {
        number
        for row in model.states
        if row.frame == "world" and row.array == "qvel"
        for number in row.numbers
    }
    qpos, qvel, _ = permutation(model)
    names, turned, own = [], [], []
    for joint in np.flatnonzero(mj.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)).tolist():
        q, v = int(mj.jnt_qposadr[joint]) + 3, int(mj.jnt_dofadr[joint]) + 3
        if v in spins:
            names.append(model.body_names[int(mj.jnt_bodyid[joint])])
            turned.append([*range(qpos[q + 1], qpos[q + 1] + 4), *range(qvel[v], qvel[v] + 3)])
            own.append([*range(q, q + 4), *range(mj.nq + v, mj.nq + v + 3)])
    places = np.array([turned, own], dtype=np.int64).reshape(2, -1, 7)
    return tuple(names), places[0], places[1]


LastStep = tuple[tuple[str, ...], Floats, Floats]
"""What the last step left of bodies that are given in the world: their names, and the numbers that
were read and MuJoCo's own, shape (n, 7) each."""
