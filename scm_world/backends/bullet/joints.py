"""Joints in the engine: their states from and to MuJoCo's coordinates, and forces on them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import Any, final

import mujoco
import numpy as np

from scm_world._types import Floats, Integers
from scm_world.backends.bullet.build import BALL, FREE, UNTURNED, Handle, composed, plain, rotated

_SIGNS = np.array([1.0, -1.0, -1.0, -1.0])
"""What turns a quaternion (w, x, y, z) into its inverse."""


class Part(ABC):
    """Joints that the engine is asked and told of together."""

    @abstractmethod
    def put(self, data: mujoco.MjData) -> None:
        """Give the engine the state that MuJoCo has."""

    @abstractmethod
    def take(self, data: mujoco.MjData) -> None:
        """Give MuJoCo the state that the engine has."""

    @abstractmethod
    def drive(self, data: mujoco.MjData, forces: Floats) -> None:
        """Apply generalized forces in the next step. MuJoCo has bodies where they are before it."""


@final
class Scalars(Part):
    """Hinges and slides.

    Args:
        engine: The module ``pybullet``.
        handle: The number of the client.
        mj: The model.
        places: The link of each joint, by the number of the joint.
    """

    def __init__(
        self, engine: Any, handle: int, mj: mujoco.MjModel, places: Mapping[int, Handle]
    ) -> None:
        self._engine, self._handle = engine, handle
        links: dict[int, dict[int, int]] = {}
        for joint, (multibody, link) in places.items():
            links.setdefault(multibody, {})[joint] = link
        joints = [joint for own in links.values() for joint in own]
        self._links = [(multibody, list(own.values())) for multibody, own in links.items()]
        self._positions = _run(mj.jnt_qposadr[joints])
        self._velocities = _run(mj.jnt_dofadr[joints])
        self._references = mj.qpos0[self._positions]

    def put(self, data: mujoco.MjData) -> None:
        """Give the engine the state that MuJoCo has."""
        values = (data.qpos[self._positions] - self._references).tolist()
        speeds = data.qvel[self._velocities].tolist()
        places = [(multibody, link) for multibody, links in self._links for link in links]
        for place, value, speed in zip(places, values, speeds, strict=True):
            self._engine.resetJointState(*place, value, speed, physicsClientId=self._handle)

    def take(self, data: mujoco.MjData) -> None:
        """Give MuJoCo the state that the engine has."""
        ask, handle = self._engine.getJointStates, self._handle
        rows = [
            row for body, links in self._links for row in ask(body, links, physicsClientId=handle)
        ]
        data.qpos[self._positions] = [row[0] for row in rows]
        data.qpos[self._positions] += self._references
        data.qvel[self._velocities] = [row[1] for row in rows]

    def drive(self, data: mujoco.MjData, forces: Floats) -> None:
        """Apply forces along the joints."""
        tell, torque, given = (
            self._engine.setJointMotorControlArray,
            self._engine.TORQUE_CONTROL,
            forces[self._velocities].tolist(),
        )
        for multibody, links in self._links:
            own, given = given[: len(links)], given[len(links) :]
            tell(multibody, links, torque, forces=own, physicsClientId=self._handle)


def _run(numbers: Integers) -> Any:
    """Give a slice for numbers that follow one another, which is faster; else the numbers."""
    first, count = int(numbers[0]), len(numbers)
    run = bool((numbers == np.arange(first, first + count)).all())
    return slice(first, first + count) if run else numbers


class _Rigid(Part):
    """A joint that turns a body freely.

    Args:
        engine: The module ``pybullet``.
        handle: The number of the client.
        mj: The model.
        joint: Its number.
        place: Its link.
    """

    def __init__(
        self, engine: Any, handle: int, mj: mujoco.MjModel, joint: int, place: Handle
    ) -> None:
        self._engine, self._handle = engine, handle
        self._multibody, self._link = place
        self._q, self._v = int(mj.jnt_qposadr[joint]), int(mj.jnt_dofadr[joint])
        self._body = body = int(mj.jnt_bodyid[joint])
        last = mj.body_jntadr[body] + mj.body_jntnum[body] - 1 == joint  # others have no mass
        self._axes = mj.body_iquat[body].copy() if last else UNTURNED
        self._center = mj.body_ipos[body].copy()


@final
class Ball(_Rigid):
    """A ball joint. The engine has it about the principal axes of the body."""

    def put(self, data: mujoco.MjData) -> None:
        """Give the engine the state that MuJoCo has."""
        back = _SIGNS * self._axes
        turn = composed(composed(back, data.qpos[self._q : self._q + 4]), self._axes)
        spin = rotated(back, data.qvel[self._v : self._v + 3]).tolist()
        self._engine.resetJointStateMultiDof(
            self._multibody, self._link, plain(turn), spin, physicsClientId=self._handle
        )

    def take(self, data: mujoco.MjData) -> None:
        """Give MuJoCo the state that the engine has."""
        (x, y, z, w), spin, *_ = self._engine.getJointStateMultiDof(
            self._multibody, self._link, physicsClientId=self._handle
        )
        turn = composed(composed(self._axes, np.array([w, x, y, z])), _SIGNS * self._axes)
        data.qpos[self._q : self._q + 4] = turn
        data.qvel[self._v : self._v + 3] = rotated(self._axes, np.array(spin))

    def drive(self, data: mujoco.MjData, forces: Floats) -> None:
        """Apply a torque, which is given in the frame of the body."""
        torque = rotated(_SIGNS * self._axes, forces[self._v : self._v + 3])
        self._engine.setJointMotorControlMultiDof(
            self._multibody,
            self._link,
            self._engine.TORQUE_CONTROL,
            force=torque.tolist(),
            physicsClientId=self._handle,
        )


@final
class Free(_Rigid):
    """A free body. The engine has the motion of its center, and turns of its principal axes."""

    def put(self, data: mujoco.MjData) -> None:
        """Give the engine the state that MuJoCo has."""
        q, v = self._q, self._v
        turn = data.qpos[q + 3 : q + 7]
        arm, spin = rotated(turn, self._center), rotated(turn, data.qvel[v + 3 : v + 6])
        speed = data.qvel[v : v + 3] + _cross(spin, arm)
        self._engine.resetBasePositionAndOrientation(
            self._multibody,
            (data.qpos[q : q + 3] + arm).tolist(),
            plain(composed(turn, self._axes)),
            physicsClientId=self._handle,
        )
        self._engine.resetBaseVelocity(
            self._multibody, speed.tolist(), spin.tolist(), physicsClientId=self._handle
        )

    def take(self, data: mujoco.MjData) -> None:
        """Give MuJoCo the state that the engine has, with a quaternion whose w >= 0.

        The engine keeps a matrix: which of two quaternions it makes of it has no meaning.
        """
        engine, handle, q, v = self._engine, self._handle, self._q, self._v
        position, (x, y, z, w) = engine.getBasePositionAndOrientation(
            self._multibody, physicsClientId=handle
        )
        speed, spin = map(np.array, engine.getBaseVelocity(self._multibody, physicsClientId=handle))
        turn = composed(np.array([w, x, y, z]), _SIGNS * self._axes)
        turn = -turn if turn[0] < 0.0 else turn
        arm = rotated(turn, self._center)
        data.qpos[q : q + 3], data.qpos[q + 3 : q + 7] = position - arm, turn
        data.qvel[v : v + 3] = speed - _cross(spin, arm)
        data.qvel[v + 3 : v + 6] = rotated(_SIGNS * turn, spin)

    def drive(self, data: mujoco.MjData, forces: Floats) -> None:
        """Apply a force at the origin of the body, and a torque that is given in its frame."""
        v, engine, world = self._v, self._engine, self._engine.WORLD_FRAME
        place, turn = data.xpos[self._body].tolist(), data.xquat[self._body]
        push, torque = forces[v : v + 3].tolist(), rotated(turn, forces[v + 3 : v + 6]).tolist()
        engine.applyExternalForce(
            self._multibody, -1, push, place, world, physicsClientId=self._handle
        )
        engine.applyExternalTorque(self._multibody, -1, torque, world, physicsClientId=self._handle)


def _cross(first: Floats, second: Floats) -> Floats:
    """Compute the outer product of two vectors."""
    found = np.empty(3)
    mujoco.mju_cross(found, first, second)
    return found


def parts(
    engine: Any, handle: int, mj: mujoco.MjModel, places: Mapping[int, Handle]
) -> Iterator[Part]:
    """List what can move, as few parts as there can be.

    Args:
        engine: The module ``pybullet``.
        handle: The number of the client.
        mj: The model.
        places: The link of each joint, by the number of the joint.
    """
    scalars: dict[int, Handle] = {}
    for joint, place in sorted(places.items()):
        kind = mj.jnt_type[joint]
        if kind in (FREE, BALL):
            yield (Free if kind == FREE else Ball)(engine, handle, mj, joint, place)
        else:
            scalars[joint] = place
    if scalars:
        yield Scalars(engine, handle, mj, scalars)
