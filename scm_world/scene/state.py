"""The instantaneous state of a scene, as one flat vector with named views."""

from __future__ import annotations

from typing import final

import numpy as np

from scm_world._types import Floats
from scm_world.scene.trifinger import N_JOINTS

ROBOT_SIZE = 3 * N_JOINTS
BLOCK_SIZE = 13


@final
class PhysicalState:
    """What moves.

    The vector is ``[joint positions (9) | joint velocities (9) | joint torques (9) | block 0 (13)
    | block 1 (13) | …]`` and a block is ``[position (3) | orientation (4) | linear velocity (3) |
    angular velocity (3)]``. All properties are views: writing into them writes the vector.

    Positions are in the world frame with the table top at z = 0 [m], orientations are unit
    quaternions (x, y, z, w) with w >= 0, velocities are those of the center in the world frame
    [m/s], [rad/s]. Joint torques [N m] are the ones of the last physics step; they can be read
    but not set.

    Args:
        n_blocks: How many movable blocks there are.
        vector: The numbers, shape (27 + 13 n,); zeros and unit quaternions if not given.
    """

    __slots__ = ("n_blocks", "vector")

    def __init__(self, n_blocks: int, vector: Floats | None = None) -> None:
        self.n_blocks = n_blocks
        if vector is None:
            vector = np.zeros(ROBOT_SIZE + BLOCK_SIZE * n_blocks)
            vector[ROBOT_SIZE + 6 :: BLOCK_SIZE] = 1.0
        self.vector = vector

    def copy(self) -> PhysicalState:
        """Copy the numbers."""
        return PhysicalState(self.n_blocks, self.vector.copy())

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
        return self.vector[ROBOT_SIZE:].reshape(self.n_blocks, BLOCK_SIZE)

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

    def coincides(self, other: PhysicalState) -> bool:
        """Tell whether all numbers but the torques are the same."""
        mine, others = self.vector, other.vector
        return bool((mine[:18] == others[:18]).all() and (mine[27:] == others[27:]).all())

    def settable(self) -> Floats:
        """Copy all numbers but the torques, shape (18 + 13 n,)."""
        return np.concatenate([self.vector[:18], self.vector[27:]])

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, PhysicalState):
            return NotImplemented
        return bool(np.array_equal(self.vector, other.vector))

    __hash__ = None  # type: ignore[assignment] # mutable

    def __repr__(self) -> str:
        return f"PhysicalState(n_blocks={self.n_blocks}, vector={self.vector!r})"
