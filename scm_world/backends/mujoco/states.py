"""The state of a model as MuJoCo has it, and as a vector.

MuJoCo's motion is ``qpos``, ``qvel`` and ``act`` in a row; a permutation makes a vector of it.
Bodies that are given in the world are in addition *turned*: their quaternions get a w that is not
negative, and their angular velocities, which MuJoCo has in the frame of the body, those in the
world.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats, Integers
from scm_world.geometry.numbers import njit
from scm_world.models.model import Model

MOST = mujoco.mjMAXVAL
"""The largest number of a state that MuJoCo does not call unstable (``mj_checkPos``, …): 1e10."""

MOTION = sum(int(getattr(mujoco.mjtState, f"mjSTATE_{part}")) for part in ("QPOS", "QVEL", "ACT"))


@njit(cache=True, error_model="numpy")
def rotate(turn: Floats, vector: Floats, sign: float) -> None:
    """Rotate a vector in place by a quaternion (x, y, z, w); back by it if the sign is -1."""
    x, y, z, w = turn[0], turn[1], turn[2], turn[3]
    scale = 2.0 / (w * w + x * x + y * y + z * z)
    w *= sign
    a, b, c = vector[0], vector[1], vector[2]
    # v + 2 w (q x v) + 2 q x (q x v)
    i, j, k = y * c - z * b, z * a - x * c, x * b - y * a
    vector[0] = a + scale * (w * i + y * k - z * j)
    vector[1] = b + scale * (w * j + z * i - x * k)
    vector[2] = c + scale * (w * k + x * j - y * i)


@njit(
    # MuJoCo's batch lends its forces for reading only
    "i8(f8[:, :], Array(f8, 2, 'A', readonly=True), i8[::1], i4[::1], f8[:, ::1])",
    cache=True,
    error_model="numpy",
)
def read_rows(
    motions: Floats, forces: Floats, table: Integers, which: NDArray[np.int32], into: Floats
) -> int:
    """Write some rows of motions as states; return the last with a number beyond ``MOST``, or -1.

    ``forces`` are those of ``qfrc_actuator``; see ``table_of``.
    """
    wrong, numbers, reported = -1, 3 + 2 * table[0], 3 + 2 * table[0] + 2 * table[1]
    for row in which:
        state, motion, beyond = into[row], motions[row], 0
        for i in range(3, numbers, 2):
            state[table[i + 1]] = motion[table[i]]
            beyond += not abs(motion[table[i]]) <= MOST  # also if it is nan
        if beyond:
            wrong = row
        for i in range(numbers, reported, 2):
            state[table[i + 1]] = forces[row, table[i]]
        for body in range(table[2]):
            q, v = table[reported + 2 * body], table[reported + 2 * body + 1]
            rotate(state[q : q + 4], state[v : v + 3], 1.0)
            if state[q + 3] < 0.0:
                for i in range(q, q + 4):
                    state[i] = -state[i]
    return wrong


def table_of(places: Integers, reported: Integers, turned: Integers) -> Integers:
    """Return how ``read_rows`` reads: three numbers of pairs, then the pairs, shape (n,).

    Args:
        places: Where each number is in a motion and in a state, shape (2, k).
        reported: The same of reported values in ``qfrc_actuator``, shape (2, m).
        turned: Places of quaternion and angular velocity of each turned body in a state, (n, 7).
    """
    counts = [places.shape[1], reported.shape[1], len(turned)]
    pairs = [places.T.ravel(), np.asarray(reported).T.ravel(), turned[:, [0, 4]].ravel()]
    return np.concatenate([counts, *pairs]).astype(np.int64)


@njit("b1(f8[:, ::1], i8[::1], i4[:])", cache=True, error_model="numpy")
def is_sound(motions: Floats, table: Integers, counts: NDArray[np.int32]) -> bool:
    """Return whether a step left no number beyond ``MOST``, and no warning: ``counts`` are ones."""
    beyond = 0
    for i in range(3, 3 + 2 * table[0], 2):
        beyond += not abs(motions[0, table[i]]) <= MOST
    for count in counts:
        beyond += count != 1
    return beyond == 0


def motion_of(data: mujoco.MjData) -> tuple[Floats, Integers]:
    """Return the memory of a simulation that has the motion, as a view, and where it is there.

    ``qpos``, ``qvel`` and ``act`` are parts of one block of memory, in which each begins at a
    multiple of 64 bytes. Reading them there saves a copy by ``mj_getState`` in every step.
    """
    arrays = [array for array in (data.qpos, data.qvel, data.act) if array.size]
    if not arrays:
        return np.empty((1, 0)), np.empty(0, dtype=np.int64)
    starts = [array.ctypes.data // 8 for array in arrays]
    first = starts.index(min(starts))
    sources = [
        np.arange(array.size) + at - starts[first] for at, array in zip(starts, arrays, strict=True)
    ]
    found = np.concatenate(sources)
    shape = 1, int(found.max()) + 1
    return np.lib.stride_tricks.as_strided(arrays[first], shape, (8 * shape[1], 8)), found


@njit("void(f8[::1], i8[:, ::1], i8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1])", cache=True)
def into_bodies(
    vector: Floats, turned: Integers, own: Integers, known: Floats, exact: Floats, motion: Floats
) -> None:
    """Turn angular velocities in the world into those in the frames of the bodies.

    A body whose quaternion and angular velocity are ``known``, read after the last step (nan for a
    new body), gets the ``exact`` numbers that MuJoCo had then: turning back and forth would change
    the last digits. ``turned`` and ``own`` have their places in the state and in the motion; all
    four have shape (n, 7).
    """
    spin = np.empty(3)
    for body in range(turned.shape[0]):
        q, v = turned[body, 0], turned[body, 4]
        turn, spin[:] = vector[q : q + 4], vector[v : v + 3]
        turns = (turn != known[body, :4]).any()
        spins = turns or (spin != known[body, 4:]).any()
        sign = -1.0 if turn[3] < 0.0 else 1.0
        for i in range(4):  # w comes first
            motion[own[body, i]] = sign * turn[(i + 3) % 4] if turns else exact[body, i]
        rotate(turn, spin, -1.0)
        for i in range(3):
            motion[own[body, 4 + i]] = spin[i] if spins else exact[body, 4 + i]


def turned_bodies(model: Model, mj: mujoco.MjModel) -> tuple[tuple[str, ...], Integers, Integers]:
    """Find the bodies that are given in the world.

    Returned are their names, and the places of their quaternions and angular velocities in the
    state vector and in the motion, shape (n, 7) each.
    """
    spins = {
        number
        for row in model.states
        if row.frame == "world" and row.array == "qvel"
        for number in row.numbers
    }
    (_, qpos), (_, qvel) = model.places("qpos"), model.places("qvel")
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
