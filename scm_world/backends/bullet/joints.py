"""Joints in the engine: their states from and to MuJoCo's coordinates, and forces on them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import partial
from typing import final

import mujoco
import numpy as np

from scm_world._types import Floats, Integers
from scm_world.backends.bullet.build import UNTURNED, Handle, composed, plain, rotated
from scm_world.backends.bullet.engine import Connection
from scm_world.backends.mujoco.fields import BALL, FREE
from scm_world.geometry.numbers import njit


@final
class Scalars:
    """The hinges and slides of a multibody, in one call of the engine."""

    def __init__(
        self, engine: Connection, data: mujoco.MjData, places: Mapping[int, Handle]
    ) -> None:
        joints, self._places, mj = list(places), list(places.values()), data.model
        multibody, links = self._places[0][0], [link for _, link in self._places]
        self._ask = partial(engine.getJointStates, multibody, links)
        self._tell = partial(
            engine.setJointMotorControlArray, multibody, links, engine.TORQUE_CONTROL
        )
        self._put, self._qpos, self._qvel = engine.resetJointState, data.qpos, data.qvel
        self._positions = _run(mj.jnt_qposadr[joints])
        self._velocities = _run(mj.jnt_dofadr[joints])
        self._references = mj.qpos0[self._positions]
        self._shifted = bool(self._references.any())

    def put(self) -> None:
        """Set the state in the engine to that of MuJoCo."""
        values = (self._qpos[self._positions] - self._references).tolist()
        speeds = self._qvel[self._velocities].tolist()
        for place, value, speed in zip(self._places, values, speeds, strict=True):
            self._put(*place, value, speed)

    def take(self) -> None:
        """Set the state of MuJoCo to that in the engine."""
        rows = self._ask()
        self._qpos[self._positions] = [row[0] for row in rows]
        if self._shifted:
            self._qpos[self._positions] += self._references
        self._qvel[self._velocities] = [row[1] for row in rows]

    def drive(self, forces: Floats) -> None:
        """Apply forces along the joints in the next step; MuJoCo has the positions before it."""
        self._tell(forces=forces[self._velocities].tolist())


def _run(numbers: Integers) -> slice | Integers:
    """Return a slice for numbers that follow one another, which is faster; else the numbers."""
    first, count = int(numbers[0]), len(numbers)
    run = bool((numbers == np.arange(first, first + count)).all())
    return slice(first, first + count) if run else numbers


@final
class Ball:
    """A ball joint. The engine has it about the principal axes of the body."""

    def __init__(self, engine: Connection, data: mujoco.MjData, joint: int, place: Handle) -> None:
        self._engine, self._data, self._place, mj = engine, data, place, data.model
        q, v, body = (int(a[joint]) for a in (mj.jnt_qposadr, mj.jnt_dofadr, mj.jnt_bodyid))
        self._turn, self._spin = slice(q, q + 4), slice(v, v + 3)
        last = mj.body_jntadr[body] + mj.body_jntnum[body] - 1 == joint  # others have no mass
        self._axes = mj.body_iquat[body].copy() if last else UNTURNED
        self._back = np.array([1.0, -1.0, -1.0, -1.0]) * self._axes

    def put(self) -> None:
        """Set the state in the engine to that of MuJoCo."""
        data = self._data
        turn = composed(composed(self._back, data.qpos[self._turn]), self._axes)
        spin = rotated(self._back, data.qvel[self._spin]).tolist()
        self._engine.resetJointStateMultiDof(*self._place, plain(turn), spin)

    def take(self) -> None:
        """Set the state of MuJoCo to that in the engine."""
        (x, y, z, w), spin, *_ = self._engine.getJointStateMultiDof(*self._place)
        turn = composed(composed(self._axes, np.array([w, x, y, z])), self._back)
        self._data.qpos[self._turn] = turn
        self._data.qvel[self._spin] = rotated(self._axes, np.array(spin))

    def drive(self, forces: Floats) -> None:
        """Apply a torque, which is given in the frame of the body."""
        torque, mode = rotated(self._back, forces[self._spin]), self._engine.TORQUE_CONTROL
        self._engine.setJointMotorControlMultiDof(*self._place, mode, force=torque.tolist())


@final
class Free:
    """Free bodies. The engine has the motion of their centers, and turns of their principal axes.

    Their coordinates in MuJoCo are positions of their frames.
    """

    def __init__(
        self, engine: Connection, data: mujoco.MjData, places: Mapping[int, Handle]
    ) -> None:
        self._engine, self._data, joints, mj = engine, data, list(places), data.model
        self._starts = np.stack([mj.jnt_qposadr[joints], mj.jnt_dofadr[joints]], axis=1)
        self._multibodies = [multibody for multibody, _ in places.values()]
        self._bodies = mj.jnt_bodyid[joints].tolist()
        self._centers, self._axes = mj.body_ipos[self._bodies], mj.body_iquat[self._bodies]
        self._pose, self._velocity = engine.getBasePositionAndOrientation, engine.getBaseVelocity

    def put(self) -> None:
        """Set the state in the engine to that of MuJoCo."""
        data = self._data
        rows = np.empty((len(self._multibodies), 13))
        _to_centers(data.qpos, data.qvel, self._starts, self._centers, self._axes, rows)
        for body, row in zip(self._multibodies, rows.tolist(), strict=True):
            self._engine.resetBasePositionAndOrientation(body, row[:3], row[3:7])
            self._engine.resetBaseVelocity(body, row[7:10], row[10:])

    def take(self) -> None:
        """Set the state of MuJoCo to that in the engine, with quaternions whose w >= 0.

        The engine keeps a matrix: which of two quaternions it makes of it has no meaning.
        """
        rows, data = [], self._data
        for body in self._multibodies:
            (position, turn), (speed, spin) = self._pose(body), self._velocity(body)
            rows.append(position + turn + speed + spin)
        _from_centers(np.array(rows), self._starts, self._centers, self._axes, data.qpos, data.qvel)

    def drive(self, forces: Floats) -> None:
        """Apply forces at the origins of the bodies, and torques that are given in their frames."""
        engine, data, world = self._engine, self._data, self._engine.WORLD_FRAME
        for multibody, body, v in zip(
            self._multibodies, self._bodies, self._starts[:, 1].tolist(), strict=True
        ):
            place, push = data.xpos[body].tolist(), forces[v : v + 3].tolist()
            torque = rotated(data.xquat[body], forces[v + 3 : v + 6]).tolist()
            engine.applyExternalForce(multibody, -1, push, place, world)
            engine.applyExternalTorque(multibody, -1, torque, world)


JointSet = Scalars | Ball | Free


def parts(
    engine: Connection, data: mujoco.MjData, places: Mapping[int, Handle], trees: Collection[int]
) -> list[JointSet]:
    """List what can move in some kinematic trees, as few parts as there can be.

    The arrays of the data are written and read as long as the parts are in use.
    """
    mj = data.model
    own = [j for j in sorted(places) if mj.body_treeid[mj.jnt_bodyid[j]] in trees]
    together: dict[int, dict[int, Handle]] = {}  # by multibody; free bodies by -1
    for joint in own:
        if mj.jnt_type[joint] != BALL:
            key = -1 if mj.jnt_type[joint] == FREE else places[joint][0]
            together.setdefault(key, {})[joint] = places[joint]
    balls = [Ball(engine, data, j, places[j]) for j in own if mj.jnt_type[j] == BALL]
    kinds = ((Free if key < 0 else Scalars, joints) for key, joints in together.items())
    return [*balls, *(kind(engine, data, joints) for kind, joints in kinds)]


@njit(cache=True)
def _turned(turn: Floats, vector: Floats, sign: float) -> Floats:
    """Rotate a vector by a unit quaternion (x, y, z, w), or back with the sign -1."""
    x, y, z, w = turn[0], turn[1], turn[2], sign * turn[3]
    a, b, c = vector[0], vector[1], vector[2]
    p, q, r = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return np.array(
        [a + w * p + y * r - z * q, b + w * q + z * p - x * r, c + w * r + x * q - y * p]
    )


@njit(cache=True)
def _product(p: Floats, q: Floats) -> Floats:
    """Compose two quaternions (x, y, z, w): first q, then p."""
    a, b, c, d = p[0], p[1], p[2], p[3]
    x, y, z, w = q[0], q[1], q[2], q[3]
    return np.array(
        [
            d * x + a * w + b * z - c * y,
            d * y + b * w + c * x - a * z,
            d * z + c * w + a * y - b * x,
            d * w - a * x - b * y - c * z,
        ]
    )


@njit(cache=True)
def _to_centers(
    positions: Floats,
    velocities: Floats,
    starts: Integers,
    centers: Floats,
    axes: Floats,
    into: Floats,
) -> None:
    """Compute the motion of the centers of free bodies, and of their principal axes.

    Bodies begin at ``starts`` in ``qpos`` and ``qvel``, shape (n, 2). In their frames they have
    centers of mass (n, 3) [m] and principal axes, quaternions (w, x, y, z). Written are position,
    quaternion (x, y, z, w), velocity and spin in the world, shape (n, 13).
    """
    for i in range(len(into)):
        q, v = starts[i, 0], starts[i, 1]
        turn = np.roll(positions[q + 3 : q + 7], -1)
        arm = _turned(turn, centers[i], 1.0)
        spin = _turned(turn, velocities[v + 3 : v + 6], 1.0)
        into[i, :3] = positions[q : q + 3] + arm
        into[i, 3:7] = _product(turn, np.roll(axes[i], -1))
        into[i, 7:10] = velocities[v : v + 3] + np.cross(spin, arm)
        into[i, 10:] = spin


@njit(cache=True)
def _from_centers(
    rows: Floats,
    starts: Integers,
    centers: Floats,
    axes: Floats,
    positions: Floats,
    velocities: Floats,
) -> None:
    """Compute the opposite of ``_to_centers``, with quaternions whose w is not negative."""
    back = np.array([-1.0, -1.0, -1.0, 1.0])
    for i in range(len(rows)):
        q, v = starts[i, 0], starts[i, 1]
        turn = _product(rows[i, 3:7], back * np.roll(axes[i], -1))
        if turn[3] < 0.0:
            turn = -turn
        arm, spin = _turned(turn, centers[i], 1.0), rows[i, 10:]
        positions[q : q + 3] = rows[i, :3] - arm
        positions[q + 3 : q + 7] = np.roll(turn, 1)
        velocities[v : v + 3] = rows[i, 7:10] - np.cross(spin, arm)
        velocities[v + 3 : v + 6] = _turned(turn, spin, -1.0)
