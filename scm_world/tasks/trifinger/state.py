"""The instantaneous state of a scene, as one flat vector with named views."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, final

from scm_world._types import Floats
from scm_world.models.scene import State, StateLayout
from scm_world.tasks.trifinger.hardware import N_JOINTS

ROBOT_SIZE = 3 * N_JOINTS
BLOCK_SIZE = 13


@lru_cache(maxsize=128)
def state_layout(n_blocks: int) -> StateLayout:
    """Give the layout of the state of the robot and some blocks."""
    robot = ("joint_positions", "joint_velocities", "joint_torques")
    block = ((0.0,) * 6, 1.0, (0.0,) * 6)
    return StateLayout(
        (*robot, *map(str, range(n_blocks))),
        (N_JOINTS,) * 3 + (BLOCK_SIZE,) * n_blocks,
        (0.0,) * ROBOT_SIZE + (*block[0], block[1], *block[2]) * n_blocks,
        frozenset({"joint_torques"}),
    )


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

    Args:
        n_blocks: How many movable blocks there are.
        vector: The numbers, shape (27 + 13 n,); zeros and unit quaternions if not given.
    """

    __slots__ = ()

    def __init__(self, n_blocks: int, vector: Floats | None = None) -> None:
        super().__init__(state_layout(n_blocks), vector)

    def __reduce__(self) -> tuple[Any, ...]:
        return PhysicalState, (self.n_blocks, self.vector)

    @property
    def n_blocks(self) -> int:
        """How many movable blocks there are."""
        return len(self.layout.names) - 3

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

    def __repr__(self) -> str:
        return f"PhysicalState(n_blocks={self.n_blocks}, vector={self.vector!r})"
