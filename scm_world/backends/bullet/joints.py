"""Joints in the engine: their states from and to MuJoCo's coordinates, and forces on them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, final

import mujoco
import numpy as np

from scm_world._types import Floats
from scm_world.backends.bullet.build import BALL, FREE, Built, composed, plain, rotated

_SIGNS = np.array([1.0, -1.0, -1.0, -1.0])
"""What turns a quaternion (w, x, y, z) into its inverse."""


class Part(ABC):
    """Joints of one multibody that the engine is asked and told of together.

    Args:
        engine: The module ``pybullet``.
        handle: The number of the client.
        mj: The model.
        multibody: The number of the multibody.
        links: The link of each joint, by the number of the joint.

    Attributes:
        tree: Number of the kinematic tree.
    """

    def __init__(
        self, engine: Any, handle: int, mj: mujoco.MjModel, multibody: int, links: dict[int, int]
    ) -> None:
        self._engine, self._handle, self._multibody = engine, handle, multibody
        joints = list(links)
        self._links, self._link = list(links.values()), links[joints[0]]
        self._q, self._v = int(mj.jnt_qposadr[joints[0]]), int(mj.jnt_dofadr[joints[0]])
        body = int(mj.jnt_bodyid[joints[0]])
        self.tree = int(mj.body_treeid[body])
        last = mj.body_jntadr[body] + mj.body_jntnum[body] - 1 == joints[0]  # others have no mass
        self._axes = mj.body_iquat[body].copy() if last else np.array([1.0, 0.0, 0.0, 0.0])
        self._center = mj.body_ipos[body].copy()
        self._positions, self._velocities = mj.jnt_qposadr[joints], mj.jnt_dofadr[joints]
        self._references = mj.qpos0[self._positions]

    @abstractmethod
    def put(self, data: mujoco.MjData) -> None:
        """Give the engine the state that MuJoCo has."""

    @abstractmethod
    def take(self, data: mujoco.MjData) -> None:
        """Give MuJoCo the state that the engine has."""

    @abstractmethod
    def drive(self, data: mujoco.MjData, forces: Floats) -> None:
        """Apply generalized forces, which are those at MuJoCo's state, in the next step."""


@final
class Scalars(Part):
    """Hinges and slides."""

    def put(self, data: mujoco.MjData) -> None:
        """Give the engine the state that MuJoCo has."""
        values = (data.qpos[self._positions] - self._references).tolist()
        speeds = data.qvel[self._velocities].tolist()
        for link, value, speed in zip(self._links, values, speeds, strict=True):
            self._engine.resetJointState(
                self._multibody, link, value, speed, physicsClientId=self._handle
            )

    def take(self, data: mujoco.MjData) -> None:
        """Give MuJoCo the state that the engine has."""
        rows = self._engine.getJointStates(
            self._multibody, self._links, physicsClientId=self._handle
        )
        data.qpos[self._positions] = self._references + [row[0] for row in rows]
        data.qvel[self._velocities] = [row[1] for row in rows]

    def drive(self, data: mujoco.MjData, forces: Floats) -> None:
        """Apply forces along the joints."""
        self._engine.setJointMotorControlArray(
            self._multibody,
            self._links,
            self._engine.TORQUE_CONTROL,
            forces=forces[self._velocities].tolist(),
            physicsClientId=self._handle,
        )


@final
class Ball(Part):
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
class Free(Part):
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
        q, v = self._q, self._v
        engine, world = self._engine, self._engine.WORLD_FRAME
        place, turn = data.qpos[q : q + 3].tolist(), data.qpos[q + 3 : q + 7]
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


def parts(engine: Any, handle: int, mj: mujoco.MjModel, built: Built) -> Iterator[Part]:
    """List everything that can move, as few parts as there can be."""
    scalars: dict[int, dict[int, int]] = {}
    for joint, (multibody, link) in sorted(built.joints.items()):
        kind = mj.jnt_type[joint]
        if kind in (FREE, BALL):
            one = Free if kind == FREE else Ball
            yield one(engine, handle, mj, multibody, {joint: link})
        else:
            scalars.setdefault(multibody, {})[joint] = link
    for multibody, links in scalars.items():
        yield Scalars(engine, handle, mj, multibody, links)
