"""Keeping the robot where it is."""

from __future__ import annotations

import numpy as np

from scm_world._types import Floats
from scm_world.world import World


def still(world: World) -> Floats:
    """Keep the robot where it is told to be: joints, fingertips, or no torque."""
    if world.action_mode == "joint_torques":
        return np.zeros(9)
    name = "end_effector_positions" if "effector" in world.action_mode else "joint_positions"
    found: Floats = np.array(world[name])
    return found
