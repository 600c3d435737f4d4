"""The ranges, bounds and defaults of the benchmark.

Source:
    Ahmed et al., *CausalWorld: A Robotic Manipulation Benchmark for Causal Structure and
    Transfer Learning*, ICLR 2021, and release 1.2 of its code for names and values.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, final

from scm_world._types import Floats
from scm_world.models.model import Numbers as Numbers
from scm_world.tasks.base import checked
from scm_world.variables import Derived, Exogenous, Function, Measured, Variable
from scm_world.variables.kinds import parent_of
from scm_world.variables.spaces import Affine, Bound, Box, Categories, Integers, Rotations, Space

Constants = Mapping[str, Any] | None
Inverse = Callable[[Floats], Floats] | None
Causes = str | tuple[Any, ...]
"""The name of a variable to copy, or ``(function, "parent", …)``: a function of their values."""


def same(parent: Floats) -> Floats:
    """Copy the value of the parent."""
    return parent


@final
@dataclass(frozen=True)
class Range:
    """Common properties of variables of one kind.

    Attributes:
        bounds: The physically possible values.
        a: The training space.
        b: The held-out space.
        unit: Unit of each number.
        shape: Shape of the value.
        dtype: Type of the value.
        doc: One sentence, unless a declaration has its own.
    """

    bounds: Any
    a: Space | None = None
    b: Space | None = None
    unit: str = "1"
    shape: tuple[int, ...] = ()
    dtype: Literal["real", "integer", "categorical"] = "real"
    doc: str = ""

    def root(self, name: str, default: Numbers, doc: str = "") -> Variable:
        """Declare a variable without causes."""
        fields = {**vars(self), "name": name, "doc": doc or self.doc}
        return Exogenous(default=default, **fields)

    def derived(
        self,
        name: str,
        causes: Causes,
        doc: str = "",
        constants: Constants = None,
        inverse: Inverse = None,
    ) -> Variable:
        """Declare a copy of a variable, or a function of variables and of constants."""
        function, *parents = (same, causes) if isinstance(causes, str) else causes
        mechanism = Function(function, constants=constants or {})
        fields = {**vars(self), "name": name, "doc": doc or self.doc, "inverse": inverse}
        return Derived(parents=tuple(parents), mechanism=mechanism, **fields)

    def either(
        self, name: str, default: Numbers, causes: Causes | None, constants: Constants = None
    ) -> Variable:
        """Declare a root if there are no causes, else what follows from them."""
        if causes is None:
            return self.root(name, default)
        return self.derived(name, causes, constants=constants)

    def state(
        self, name: str, default: Numbers, doc: str = "", on_set: Iterable[str] = (), **how: object
    ) -> Measured:
        """Declare a quantity of physics; ``on_set`` names what moves it when that is set."""
        parents = tuple(parent_of(cause, 0, "set") for cause in on_set)
        fields = {**vars(self), "doc": doc or self.doc, "settable_state": True, **how}
        return Measured(name=name, default=default, parents=parents, **fields)

    def option(self, name: str, value: object, doc: str = "", option: str = "") -> Variable:
        """Declare a root whose default is an option of the task, by default of the same name.

        Raises:
            UnknownOption: It is out of bounds.
        """
        return self.root(name, checked(option or name, value, self.bounds, shape=self.shape), doc)


# --- places and their spaces ---------------------------------------------------------------------
POSITION_ENDS = ((-0.24, -0.24, 0.0), (0.24, 0.24, 0.5))  # [m]
POSITION_BOUNDS = Box(*POSITION_ENDS)
QUATERNION_BOUNDS = Rotations()
RADIUS_A = (0.0, 0.11)  # [m]
RADIUS_B = (0.11, 0.15)  # [m]
HEIGHT_A = 0.15  # [m] highest center of an object
HEIGHT_B = 0.3  # [m]
_YAW = Box((0.0, 0.0, -math.pi), (0.0, 0.0, math.pi))  # a rotation about z, as a rotation vector


def half_height(size: str) -> Affine:
    """Return the height of the center of an object on the floor; ``size`` holds its edges."""
    return Affine(parent=size, index=2, scale=0.5)


def cylindrical(radii: tuple[float, float], low: Bound, high: Bound) -> Box:
    """Return the space of cylindrical positions between two radii and two heights [m, rad, m]."""
    return Box((radii[0], -math.pi, low), (radii[1], math.pi, high))


def places(low: Bound, *, airborne: bool) -> tuple[Box, Box]:
    """Return the spaces A and B of the cylindrical position of a body.

    Args:
        low: Height of its center on the floor [m].
        airborne: Whether it may be in the air.
    """
    tops = (HEIGHT_A, HEIGHT_B) if airborne else (low, low)
    return cylindrical(RADIUS_A, low, tops[0]), cylindrical(RADIUS_B, low, tops[1])


# --- kinds of variables: bounds, A, B; those of what the predecessor hides are ours ---------------
RESTITUTION = Range(
    *(Box(0.0, 0.8), Box(0.0, 0.3), Box(0.3, 0.6)),
    doc="Speed after a head-on impact over speed before it, for every contact.",
)
SPINNING = Range(
    *(Box(0.0, 0.1), Box(0.0, 0.002), Box(0.002, 0.01), "m"),
    doc="Friction of every contact against turning about its normal.",
)
NOISE = Range(Box(0.0, 1.0), Box(0.0, 0.01), Box(0.01, 0.05))
ROBOT_HEIGHT = Range(
    *(Box(0.2, 0.6), Box(0.33, 0.35), Box(0.35, 0.36), "m"),
    doc="Height of the robot's base above a plane 0.011 m below the table top.",
)
BLOCK_SIZES = Range(
    Box(0.02, 0.2), Box(0.055, 0.075), Box(0.075, 0.095), "m", (3,), doc="Full edge lengths."
)
TOWER_COUNT = Range(Integers(1, 6), Integers(1, 4), Integers(4, 6), shape=(3,), dtype="integer")
TOWER_DIMS = Range(Box(0.02, 0.24), Box(0.08, 0.12), Box(0.12, 0.20), unit="m", shape=(3,))
TOWER_CENTER = Range(Box(-0.15, 0.15), Box(-0.1, 0.05), Box(0.05, 0.1), unit="m", shape=(2,))
MIN_SIZE = Range(Box(0.02, 0.1), Box(0.035, 0.065), Box(0.065, 0.075), unit="m")
LEVEL_WIDTH = Range(Box(0.02, 0.3), Box(0.035, 0.12), Box(0.12, 0.15), unit="m")
NUMS_OBJECTS = Range(Integers(1, 9), Integers(1, 5), Integers(6, 9), dtype="integer")
DROPPED_SIZE = Range(Box(0.02, 0.1), Box(0.05, 0.07), Box(0.04, 0.05), unit="m")
COLOR = Range(  # A is dark and B is bright, as in the paper
    *(Box(0.0, 1.0), Box(0.0, 0.5), Box(0.5, 1.0)),
    shape=(3,),
    doc="Red, green and blue; nothing physical depends on it.",
)
GRAVITIES = Range(  # A and B of the paper; its code has no space
    Box(-30.0, 30.0),
    Box((0.0, 0.0, -10.0), (0.0, 0.0, -7.0)),
    Box((0.0, 0.0, -7.0), (0.0, 0.0, -4.0)),
    "m/s^2",
    (3,),
    doc="Acceleration of free fall; it pulls the fingers too.",
)
FRICTION = Range(Box(0.0, 2.0), Box(0.3, 0.6), Box(0.6, 0.8))
BLOCK_FRICTIONS = Range(
    *(Box(0.0, 2.0), Box(0.6, 1.0), Box(1.0, 1.4)),
    doc="Friction of its surface; a contact has the product of two frictions.",
)
LINK_MASSES = Range(Box(0.005, 5.0), Box(0.015, 0.045), Box(0.045, 0.100), "kg")
BLOCK_MASSES = Range(
    *(Box(0.001, 2.0), Box(0.015, 0.045), Box(0.045, 0.100)),
    unit="kg",
    doc="Mass; the inertia of the solid follows from it.",
)
SHARED_MASSES = Range(Box(0.001, 2.0), Box(0.02, 0.06), Box(0.06, 0.08), "kg")
JOINT_DAMPING = Range(Box(0.0, 0.5), Box(0.0, 0.01), Box(0.01, 0.03), "N m s/rad")
POSITION_GAINS = Range(
    *(Box(0.0, 50.0), Box(8.0, 12.0), Box(12.0, 15.0), "N m/rad", (3,)),
    doc="Proportional gain of the three joints of a finger.",
)
VELOCITY_GAINS = Range(
    Box(0.0, 0.5),
    Box((0.08, 0.24, 0.0), (0.12, 0.36, 0.002)),
    Box((0.12, 0.36, 0.002), (0.2, 0.5, 0.005)),
    "N m s/rad",
    (3,),
    doc="Derivative gain of the three joints of a finger.",
)
SAFETY_DAMPING = Range(
    Box(0.0, 0.5),
    Box((0.06, 0.06, 0.03), (0.1, 0.1, 0.05)),
    Box((0.1, 0.1, 0.05), (0.15, 0.15, 0.08)),
    "N m s/rad",
    (3,),
    doc="Damping of the safety filter, for the three joints of a finger.",
)
TORQUE = Range(
    *(Box(0.05, 1.0), Box(0.3, 0.4), Box(0.4, 0.5), "N m"),
    doc="Largest torque of a joint. Torques that are commanded end at 0.36 N m for any value.",
)
PRESETS = Range(
    *(Categories((0, 1)), Categories((0,)), Categories((1,))),
    dtype="categorical",
    doc="How finely time is cut: 0 is fast (4 ms), 1 is precise (2 ms).",
)
_SIDE = Categories((0, 1))
SIDES = Range(_SIDE, _SIDE, _SIDE, dtype="categorical")
STACK_LEVELS = Range(Integers(1, 10), Integers(1, 5), Integers(6, 8), dtype="integer")
CREATIVE_LEVELS = Range(Integers(1, 10), Integers(3, 5), Integers(6, 8), dtype="integer")

POLAR = Range(
    Box((0.0, -math.pi), (0.24, math.pi)),
    Box((RADIUS_A[0], -math.pi), (RADIUS_A[1], math.pi)),
    Box((RADIUS_B[0], -math.pi), (RADIUS_B[1], math.pi)),
    "m, rad",
    (2,),
    doc="Radius and angle of its center; the height follows from the size.",
)
POSITIONS = Range(POSITION_BOUNDS, unit="m", shape=(3,), doc="Position of the center.")
ORIENTATIONS = Range(
    QUATERNION_BOUNDS, shape=(4,), doc="Orientation as a unit quaternion (x, y, z, w)."
)
TURNS = Range(
    QUATERNION_BOUNDS,
    shape=(4,),
    doc="Orientation as a unit quaternion (x, y, z, w) with w >= 0.",
)
YAWS = Range(  # rotation vectors with the turns about z as their spaces
    *(None, _YAW, _YAW, "rad", (3,)),
    doc="Orientation as a rotation vector; setting it sets the quaternion.",
)
LINEAR_VELOCITIES = Range(Box(-10.0, 10.0), unit="m/s", shape=(3,), doc="Velocity of the center.")
ANGULAR_VELOCITIES = Range(
    Box(-100.0, 100.0), unit="rad/s", shape=(3,), doc="Angular velocity in the world frame."
)
JOINTS = Range(
    Box((-1.67, -1.67, -3.24) * 3, (1.67, 1.67, 3.24) * 3),
    Box((-1.57, -1.2, -3.0) * 3, (-0.69, 0.0, 0.0) * 3),
    Box((-0.69, 0.0, 0.0) * 3, (1.0, 1.57, 3.0) * 3),
    "rad",
)
"""The stops at a quarter and half a turn, and 0.1 rad that a joint may press into them."""
PART_SIZES = Range(Box(0.005, 0.3), unit="m", shape=(3,), doc="Full edge lengths.")
"""Edges of a block that is a part of something."""
OBSTACLE_SIZES = Range(Box(0.005, 0.6), unit="m", shape=(3,), doc="Full edge lengths.")

# --- defaults ------------------------------------------------------------------------------
SURFACE_FRICTION = 0.5
BLOCK_MASS = 0.02  # [kg]
BLOCKS_MASS = 0.08  # [kg] in families whose blocks follow from a few numbers
BLOCK_SIZE = (0.065, 0.065, 0.065)  # [m]
GOAL_COLOR = (0.0, 1.0, 0.0)
OBSTACLE_SIZE = (0.01, 0.01, 0.01)  # [m]
ZERO = (0.0, 0.0, 0.0)
IDENTITY = (0.0, 0.0, 0.0, 1.0)  # quaternion (x, y, z, w)
