"""The TriFinger robot: its published constants, its joint controller, and how finely time is cut.

Every backend realises the controller and must match it.

Three fingers hang from a base above the table. Each is a chain of three hinges; the axes of the
second and third are parallel. All numbers are those of the TriFinger-edu description as
CausalWorld 1.2 ships it; the link inertias are the ones that are in force there after the first
reset (computed by the backend from the collision hulls), which scale with the mass of the link.

Frames: the world's z axis points up and the table top is at z = 0. The nominal robot height of
0.34 m was measured from a plane 0.011 m below the table top.

Source:
    Ahmed et al., *CausalWorld*, ICLR 2021, release 1.2, ``trifinger_edu.urdf``;
    Wüthrich et al., *TriFinger*, CoRL 2020.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, final

from scm_world.variables import Box
from scm_world.variables.bundles import part_of

FINGERS = ("60", "120", "300")
"""The fingers, in the order of every joint vector."""

N_JOINTS = 9

NOMINAL_HEIGHT = 0.34  # [m]
TABLE_OFFSET = 0.011  # [m] how far the table top lies above the plane the height is measured from
WORLD_YAW = -1.57079632679  # [rad] of the robot's base about z

FINGER_YAW = (0.0, -2.09439510239, -4.18879020479)  # [rad] of each finger in the robot's frame
FINGER_OFFSET = (
    (-0.0455, 0.0, 0.0),
    (0.02275, 0.0394041558722, 0.0),
    (0.02275, -0.0394041558722, 0.0),
)  # [m] of each finger base in the robot's frame

JOINT_AXES = ((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 1.0, 0.0))
JOINT_ORIGINS = ((0.0, 0.0, 0.0), (0.0, -0.014, 0.0), (0.0, -0.03745, -0.16))  # [m]
TIP_ORIGIN = (0.0, -0.008, -0.16)  # [m] in the frame of the lower link

LEG_LENGTH = 0.16  # [m] of the middle and of the lower link
LATERAL_OFFSET = 0.05945  # [m] 0.014 + 0.03745 + 0.008

ENGINE_LIMITS = (1.57079632679, 1.57079632679, 3.14159265359)  # [rad] ± of each joint of a finger
JOINT_LOW = (-1.57, -1.2, -3.0) * 3  # [rad] what a command may ask for
JOINT_HIGH = (1.0, 1.57, 3.0) * 3  # [rad]
REST = (0.0, math.pi / 4, -math.pi / 4) * 3  # [rad]
RAISED = (-1.56, -0.08, -2.7) * 3  # [rad]
ASIDE = (0.0, 1.5, -1.5) * 3  # [rad] stretched outward, the lower links hanging

LINK_MASS = (1.0, 0.14854, 0.14854, 0.0307)  # [kg] links 0 to 3 of a finger
TIP_MASS = 0.01  # [kg] in the origin of its frame
TIP_INERTIA = (1.66666666667e-07,) * 3  # [kg m²]


class Inertial(NamedTuple):
    """How the mass of a link is spread.

    Attributes:
        center: Center of mass in the frame of the link, shape (3,) [m].
        orientation: Orientation of the principal axes in that frame, (x, y, z, w).
        per_mass: Principal moments divided by the mass, shape (3,) [m²].
    """

    center: tuple[float, float, float]
    orientation: tuple[float, float, float, float]
    per_mass: tuple[float, float, float]


_SIN, _COS = 0.06428656600424204, 0.9979314793268034
_HUB = (6.666666667e-07, 6.666666667e-07, 6.666666667e-07)
_UPPER = (0.0006348703448, 0.003867126589, 0.004068646656)
_MIDDLE = (0.003995456002, 0.003794130796, 0.0006246851904)
_LOWER = (0.00305712137, 0.003088667937, 0.0001609475214)

INERTIAL = (
    Inertial((-0.1, 0.0, 0.4), (0.0, 0.0, 0.0, 1.0), _HUB),
    Inertial((-0.079, 0.0, 0.0), (0.0, 0.0, -_SIN, _COS), _UPPER),
    Inertial((0.0, -0.019, -0.079), (_SIN, 0.0, 0.0, _COS), _MIDDLE),
    Inertial((0.0, -0.009, -0.089), (0.0, 0.0, 0.0, 1.0), _LOWER),
)


class Capsule(NamedTuple):
    """A collision shape: all points within ``radius`` of a segment in the frame of the link [m]."""

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float


COLLISION = {
    "upper": Capsule((-0.177, 0.0055, 0.0), (-0.0225, 0.0055, 0.0), 0.0225),
    "middle": Capsule((0.0, -0.018, 0.0), (0.0, -0.018, -0.16), 0.0195),
    "lower": Capsule((0.0, -0.008, -0.0), (0.0, -0.008, -0.14), 0.009),
    "tip": Capsule((0.0, 0.0, 0.0), (0.0, 0.0, 0.012), 0.0095),
}
"""One shape per link, fitted to the bounding boxes and radii of the published meshes."""

ARENA_HALF_WIDTH = 0.15  # [m]
ARENA_HEIGHT = 0.3  # [m]
WALL_RADIUS = 0.242  # [m] inner radius of the ring
WALL_HEIGHT = 0.25  # [m]
WALL_THICKNESS = 0.02  # [m] outward, so that nothing tunnels through it
WALL_SEGMENTS = 24

SPINNING_FRICTION = 0.001  # [m] torsional coefficient of every contact

LINK_COLORS = {"60": (0.6, 0.0, 0.0), "120": (0.0, 0.6, 0.0), "300": (0.0, 0.0, 0.6)}


def link_name(finger: str, index: int) -> str:
    """Return the published name of a link.

    Example:
        >>> link_name("60", 1)
        'robot_finger_60_link_1'
    """
    return f"robot_finger_{finger}_link_{index}"


LINK_NAMES = tuple(link_name(finger, i) for finger in FINGERS for i in range(4))
"""Finger by finger: 0 is the fixed base, 1 the upper, 2 the middle and 3 the lower link."""

RESOLUTIONS = ("vector", "finger", "joint")
"""Whether all joints, those of a finger, or each are a variable; the first is the default."""

QUANTITIES = ("joint_positions", "joint_velocities", "joint_torques")
"""What moves, in the order of the state vector, by its names for the whole robot."""


@final
@dataclass(frozen=True)
class JointGroup:
    """Some joints that are variables together.

    Attributes:
        where: Their places among the nine.
        fingers: Those that they belong to.
        names: Of ``QUANTITIES``.
        action: Name of their action.
        of: Body of the joints, for sentences.
    """

    where: slice
    fingers: tuple[str, ...]
    names: tuple[str, ...]
    action: str
    of: str

    @property
    def shape(self) -> tuple[int, ...]:
        """Of each of their variables."""
        n = self.where.stop - self.where.start
        return (n,) if n > 1 else ()

    def cut(self, box: Box) -> Box:
        """Return their part of a box of all nine."""
        return box if self.shape == (N_JOINTS,) else part_of(box, self.where, N_JOINTS, self.shape)


def joints_of(resolution: str) -> tuple[JointGroup, ...]:
    """Cut the nine joints into those that are variables together, in their order.

    Args:
        resolution: One of ``RESOLUTIONS``.

    Example:
        >>> [joints.names[0] for joints in joints_of("finger")]
        ['finger_60.joint_positions', 'finger_120.joint_positions', 'finger_300.joint_positions']
        >>> joints_of("joint")[8].action
        'finger_300_joint_2.action'
    """
    found, size = [], {"vector": N_JOINTS, "finger": 3, "joint": 1}[resolution]
    for first in range(0, N_JOINTS, size):
        finger, joint = FINGERS[first // 3], first % 3
        stem, of, names = f"finger_{finger}.", f"finger {finger}", QUANTITIES
        if size == N_JOINTS:
            stem, of = "", "all fingers"
        elif size == 1:
            stem, of = f"finger_{finger}_joint_{joint}.", f"joint {joint} of finger {finger}"
            names = ("position", "velocity", "torque")
        fingers = FINGERS if size == N_JOINTS else (finger,)
        where, named = slice(first, first + size), tuple(stem + name for name in names)
        found.append(JointGroup(where, fingers, named, f"{stem}action", of))
    return tuple(found)


TIMESTEP = 0.004  # [s] the unit in which ``frame_skip`` counts, for every preset


POSITION_GAINS = (10.0, 10.0, 10.0)  # [N m/rad] of the three joints of a finger
VELOCITY_GAINS = (0.1, 0.3, 0.001)  # [N m s/rad]
SAFETY_DAMPING = (0.08, 0.08, 0.04)  # [N m s/rad] of the safety filter
TORQUE_LIMIT = 0.36  # [N m]
"""Published gains of a proportional-derivative law with a safety filter.

The law is evaluated at every physics step. In ``joint_positions`` mode, with target q*, position q
and velocity v of a joint::

    tau = clip(clip(kp (q* - q) - kd v, ±limit) - safety v, ±limit)

In ``joint_torques`` mode the inner clip is applied to the commanded torque instead.

Source:
    CausalWorld 1.2, ``envs/robot/trifinger.py`` (the law in force there).
"""


class Preset(NamedTuple):
    """Numerical settings that every backend understands in its own way.

    Attributes:
        name: ``"fast"`` or ``"precise"``.
        timestep: Physics step [s].
        contact: Time constant [s] and damping ratio of contacts.
        sliding: The same for friction between blocks, floor and stage.
    """

    name: str
    timestep: float
    contact: tuple[float, float]
    sliding: tuple[float, float]


FAST = Preset("fast", 0.004, contact=(0.010, 1.0), sliding=(0.04, 1.0))
PRECISE = Preset("precise", 0.002, contact=(0.004, 1.0), sliding=(0.02, 1.0))

PRESETS = {preset.name: preset for preset in (FAST, PRECISE)}
"""By name, in the order of the categories of ``timestep_preset``."""
