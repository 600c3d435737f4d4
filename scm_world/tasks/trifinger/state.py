"""The state of the robot and its blocks, with named views."""

from __future__ import annotations

from typing import final

from scm_world._types import Floats
from scm_world.models.scene import State
from scm_world.tasks.trifinger.hardware import N_JOINTS

ROBOT_SIZE = 3 * N_JOINTS
BLOCK_SIZE = 13


@final
class PhysicalState(State):
    """What moves.

    The vector is ``[joint positions (9) | joint velocities (9) | joint torques (9) | block 0 (13)
    | block 1 (13) | …]`` and a block is ``[position (3) | orientation (4) | linear velocity (3) |
    angular velocity (3)]``. All properties are views: writing into them writes the vector.

    Positions are in the world frame with the table top at z = 0 [m], orientations are unit
    quaternions (x, y, z, w) with w >= 0, velocities are those of the center in the world frame
    [m/s], [rad/s]. Joint torques [N m] are the ones of the last physics step; they can be read
    but not set.
    """

    __slots__ = ()

    @property
    def joint_positions(self) -> Floats:
        """Shape (9,) [rad]."""
        return self.vector[:9]

    @property
    def joint_velocities(self) -> Floats:
        """Shape (9,) [rad/s]."""
        return self.vector[9:18]

    @property
    def joint_torques(self) -> Floats:
        """Shape (9,) [N m], of the last physics step."""
        return self.vector[18:27]

    @property
    def blocks(self) -> Floats:
        """Shape (n, 13): position, orientation, linear and angular velocity."""
        return self.vector[ROBOT_SIZE:].reshape(-1, BLOCK_SIZE)

    @property
    def positions(self) -> Floats:
        """Centers of the blocks, shape (n, 3) [m]."""
        return self.blocks[:, 0:3]

    @property
    def orientations(self) -> Floats:
        """Quaternions (x, y, z, w) of the blocks, shape (n, 4)."""
        return self.blocks[:, 3:7]

    @property
    def linear_velocities(self) -> Floats:
        """Shape (n, 3) [m/s]."""
        return self.blocks[:, 7:10]

    @property
    def angular_velocities(self) -> Floats:
        """Shape (n, 3) [rad/s], in the world frame."""
        return self.blocks[:, 10:13]
