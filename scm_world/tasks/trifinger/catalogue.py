"""The ranges, bounds and defaults of the benchmark, as numbers only.

Source:
    Ahmed et al., *CausalWorld: A Robotic Manipulation Benchmark for Causal Structure and
    Transfer Learning*, ICLR 2021, and release 1.2 of its code for names and values.
"""

from __future__ import annotations

import math

from scm_world.variables.spaces import Affine, Bound, Box, Categories, Integers, Rotations

# --- what is physically possible -----------------------------------------------------------------
COLOR_BOUNDS = Box(0.0, 1.0)
FRICTION_BOUNDS = Box(0.0, 2.0)
BLOCK_MASS_BOUNDS = Box(0.001, 2.0)  # [kg]
LINK_MASS_BOUNDS = Box(0.005, 5.0)  # [kg]
SIZE_BOUNDS = Box(0.02, 0.2)  # [m]
GRAVITY_BOUNDS = Box(-30.0, 30.0)  # [m/s²]
ROBOT_HEIGHT_BOUNDS = Box(0.2, 0.6)  # [m]
POSITION_BOUNDS = Box((-0.24, -0.24, 0.0), (0.24, 0.24, 0.5))  # [m]
POLAR_BOUNDS = Box((0.0, -math.pi), (0.24, math.pi))  # [m, rad]
QUATERNION_BOUNDS = Rotations()
LINEAR_VELOCITY_BOUNDS = Box(-10.0, 10.0)  # [m/s]
ANGULAR_VELOCITY_BOUNDS = Box(-100.0, 100.0)  # [rad/s]
JOINT_BOUNDS = Box((-1.67, -1.67, -3.24) * 3, (1.67, 1.67, 3.24) * 3)
"""The stops at a quarter and half a turn, and 0.1 rad that a joint may press into them [rad]."""
JOINT_VELOCITY_BOUNDS = Box(-50.0, 50.0)  # [rad/s]
CONTROL_INDEX_BOUNDS = Integers(0, 10**9)
OBSTACLE_SIZE_BOUNDS = Box(0.005, 0.6)  # [m]
RESTITUTION_BOUNDS = Box(0.0, 0.8)
SPINNING_BOUNDS = Box(0.0, 0.1)
DAMPING_BOUNDS = Box(0.0, 0.5)  # [N m s/rad]
POSITION_GAIN_BOUNDS = Box(0.0, 50.0)  # [N m/rad]
TORQUE_BOUNDS = Box(0.05, 1.0)  # [N m]
NOISE_BOUNDS = Box(0.0, 1.0)
PRESET_BOUNDS = Categories((0, 1))
SIDE_BOUNDS = Categories((0, 1))
TYPE_BOUNDS = Categories((1, 2, 10, 20, 21, 23))

# --- training space A and held-out space B ---------------------------------
JOINTS_A = Box((-1.57, -1.2, -3.0) * 3, (-0.69, 0.0, 0.0) * 3)
JOINTS_B = Box((-0.69, 0.0, 0.0) * 3, (1.0, 1.57, 3.0) * 3)
SIZE_A = Box(0.055, 0.075)
SIZE_B = Box(0.075, 0.095)
MASS_A = Box(0.015, 0.045)
MASS_B = Box(0.045, 0.100)
FRICTION_A = Box(0.3, 0.6)
FRICTION_B = Box(0.6, 0.8)
BLOCK_FRICTION_A = Box(0.6, 1.0)
BLOCK_FRICTION_B = Box(1.0, 1.4)
ROBOT_HEIGHT_A = Box(0.33, 0.35)
ROBOT_HEIGHT_B = Box(0.35, 0.36)
DARK = Box(0.0, 0.5)
BRIGHT = Box(0.5, 1.0)
YAW = Box((0.0, 0.0, -math.pi), (0.0, 0.0, math.pi))  # a rotation about z, as a rotation vector
GRAVITY_A = Box((0.0, 0.0, -10.0), (0.0, 0.0, -7.0))  # the paper; its code has no space
GRAVITY_B = Box((0.0, 0.0, -7.0), (0.0, 0.0, -4.0))

RADIUS_A = (0.0, 0.11)  # [m]
RADIUS_B = (0.11, 0.15)  # [m]
HEIGHT_A = 0.15  # [m] highest center of an object
HEIGHT_B = 0.3  # [m]

POLAR_A = Box((RADIUS_A[0], -math.pi), (RADIUS_A[1], math.pi))
POLAR_B = Box((RADIUS_B[0], -math.pi), (RADIUS_B[1], math.pi))


def half_height(size: str) -> Affine:
    """Give the height of the center of an object that stands on the floor.

    Args:
        size: Name of the variable that holds its edge lengths.
    """
    return Affine(parent=size, index=2, scale=0.5)


def cylindrical(radii: tuple[float, float], low: Bound, high: Bound) -> Box:
    """Give the space of cylindrical positions between two radii and two heights [m, rad, m]."""
    return Box((radii[0], -math.pi, low), (radii[1], math.pi, high))


# --- goal families whose blocks follow from a few numbers -----------------------------------------
PART_SIZE_BOUNDS = Box(0.005, 0.3)  # [m] edges of a block that is a part of something
BLOCKS_MASS_A = Box(0.02, 0.06)  # [kg]
BLOCKS_MASS_B = Box(0.06, 0.08)
BLOCKS_MASS = 0.08  # [kg]

TOWER_COUNT_BOUNDS = Integers(1, 6)
TOWER_COUNT_A = Integers(1, 4)
TOWER_COUNT_B = Integers(4, 6)
TOWER_DIMS_BOUNDS = Box(0.02, 0.24)  # [m]
TOWER_DIMS_A = Box(0.08, 0.12)
TOWER_DIMS_B = Box(0.12, 0.20)
TOWER_CENTER_BOUNDS = Box(-0.15, 0.15)  # [m]
TOWER_CENTER_A = Box(-0.1, 0.05)
TOWER_CENTER_B = Box(0.05, 0.1)

STACK_LEVELS_BOUNDS = Integers(1, 10)
STACK_LEVELS_A = Integers(1, 5)
STACK_LEVELS_B = Integers(6, 8)
CREATIVE_LEVELS_A = Integers(3, 5)
MIN_SIZE_BOUNDS = Box(0.02, 0.1)  # [m]
MIN_SIZE_A = Box(0.035, 0.065)
MIN_SIZE_B = Box(0.065, 0.075)
LEVEL_WIDTH_BOUNDS = Box(0.02, 0.3)  # [m]
LEVEL_WIDTH_A = Box(0.035, 0.12)
LEVEL_WIDTH_B = Box(0.12, 0.15)

NUMS_OBJECTS_BOUNDS = Integers(1, 9)
NUMS_OBJECTS_A = Integers(1, 5)
NUMS_OBJECTS_B = Integers(6, 9)
DROPPED_SIZE_BOUNDS = Box(0.02, 0.1)  # [m]
DROPPED_SIZE_A = Box(0.05, 0.07)
DROPPED_SIZE_B = Box(0.04, 0.05)
DROP_REGION = ((-0.11, -0.11, 0.0), (0.11, 0.11, 0.22))  # [m]

# --- spaces of what the predecessor hides: ours, around the defaults -----------------------------
RESTITUTION_A = Box(0.0, 0.3)
RESTITUTION_B = Box(0.3, 0.6)
SPINNING_A = Box(0.0, 0.002)
SPINNING_B = Box(0.002, 0.01)
JOINT_DAMPING_A = Box(0.0, 0.01)  # [N m s/rad]
JOINT_DAMPING_B = Box(0.01, 0.03)
POSITION_GAINS_A = Box(8.0, 12.0)  # [N m/rad]
POSITION_GAINS_B = Box(12.0, 15.0)
VELOCITY_GAINS_A = Box((0.08, 0.24, 0.0), (0.12, 0.36, 0.002))  # [N m s/rad]
VELOCITY_GAINS_B = Box((0.12, 0.36, 0.002), (0.2, 0.5, 0.005))
SAFETY_DAMPING_A = Box((0.06, 0.06, 0.03), (0.1, 0.1, 0.05))  # [N m s/rad]
SAFETY_DAMPING_B = Box((0.1, 0.1, 0.05), (0.15, 0.15, 0.08))
TORQUE_A = Box(0.3, 0.4)  # [N m]
TORQUE_B = Box(0.4, 0.5)
NOISE_A = Box(0.0, 0.01)
NOISE_B = Box(0.01, 0.05)

# --- defaults ------------------------------------------------------------------------------
GRAVITY = (0.0, 0.0, -9.81)  # [m/s²]
SURFACE_FRICTION = 0.5
BLOCK_FRICTION = 1.0
BLOCK_MASS = 0.02  # [kg]
BLOCK_SIZE = (0.065, 0.065, 0.065)  # [m]
FLOOR_COLOR = (0.31, 0.27, 0.25)
STAGE_COLOR = (0.95, 0.95, 0.95)
BLOCK_COLOR = (1.0, 0.0, 0.0)
GOAL_COLOR = (0.0, 1.0, 0.0)
OBSTACLE_SIZE = (0.01, 0.01, 0.01)  # [m]
FINGER_FRICTION = 0.5
SPINNING_FRICTION = 0.001
IDENTITY = (0.0, 0.0, 0.0, 1.0)  # quaternion (x, y, z, w)
