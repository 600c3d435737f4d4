"""The bodies of a model, for backends that do not read its file: what moves how, and is driven how.

Frames, axes and joint coordinates are as in MJCF: bodies are given in the frame of their parent,
with every joint at its reference; joints of one body act one after another, each in the frame
that those before it have moved.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple, final

from scm_world.models.scene import ParameterKey

UNIT = 1e-14  # a squared length this near to 1 is taken as it is

Vector = tuple[float, float, float]
Rotation = tuple[float, float, float, float]
"""A unit quaternion (x, y, z, w)."""


@final
@dataclass(frozen=True)
class Body:
    """A rigid body.

    Attributes:
        name: As contacts and errors call it.
        parent: Number of the body that carries it; the world is body 0 and its own parent.
        position: Of its frame in that of the parent [m].
        orientation: The same.
        mass: [kg].
        inertia: Principal moments [kg m²].
        center: Center of mass in its frame [m].
        axes: From the principal axes of inertia to its frame.
    """

    name: str
    parent: int
    position: Vector
    orientation: Rotation
    mass: float
    inertia: Vector
    center: Vector
    axes: Rotation


@final
@dataclass(frozen=True)
class Joint:
    """What a body can do relative to its parent.

    Attributes:
        name: As errors call it.
        kind: How it moves.
        body: Number of the body.
        start: Where its numbers begin in the state: first where it is, then its velocity. A
            hinge or slide has one and one; a ball an orientation (4) and an angular velocity in
            the frame of the body (3); a free body the position of its frame (3), orientation (4),
            velocity of that frame's origin (3) and angular velocity in its own frame (3).
        position: A point on its axis, in the frame of the body [m].
        axis: Unit vector in that frame, of hinges and slides.
        reference: Coordinate at which the body is where it is given [rad] or [m].
        range: Lowest and highest coordinate; None where there is no limit.
        damping: [N m s/rad] or [N s/m].
        stiffness: Of the spring [N m/rad] or [N/m].
        rest: Coordinate at which the spring is at rest.
        friction: Loss to dry friction [N m] or [N].
        armature: Inertia of the motor [kg m²] or [kg].
        effort: Smallest and largest force that all actuators exert together; None if any.
    """

    name: str
    kind: Literal["hinge", "slide", "ball", "free"]
    body: int
    start: int
    position: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (0.0, 0.0, 1.0)
    reference: float = 0.0
    range: tuple[float, float] | None = None
    damping: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0
    friction: float = 0.0
    armature: float = 0.0
    effort: tuple[float, float] | None = None


@final
@dataclass(frozen=True)
class Geom:
    """A shape that bodies touch with. Shapes that touch nothing are left out.

    Attributes:
        name: As errors call it.
        kind: Capsules and cylinders lie along the third axis; a plane is the half space below it.
        body: Number of the body.
        position: Of its frame in that of the body [m].
        orientation: The same.
        size: Half edges of a box; radius of a sphere; radius and half length of a capsule (of
            its straight part) or cylinder [m]; nothing of a plane or mesh.
        vertices: Corners of the convex hull of a mesh [m].
        friction: Sliding coefficient.
        slippery: Whether it asks for contacts without friction.
    """

    name: str
    kind: Literal["plane", "sphere", "capsule", "cylinder", "box", "mesh"]
    body: int
    position: Vector
    orientation: Rotation
    size: tuple[float, ...] = ()
    vertices: tuple[Vector, ...] = ()
    friction: float = 1.0
    slippery: bool = False


@final
@dataclass(frozen=True)
class Actuator:
    """A force on one joint, from a number that is commanded.

    With length ``l = gear * coordinate`` and its rate ``r``, the force is
    ``(gain[0] + gain[1] l + gain[2] r) control + bias[0] + bias[1] l + bias[2] r``, and the
    joint feels ``gear`` times as much.

    Attributes:
        name: As errors call it.
        joint: Number of the joint.
        control: Which component of the command it follows.
        gear: One number; three for a ball, about the axes of the body.
        gain: See above.
        bias: See above; zeros for a ball.
        control_range: To which commands are cut; None if they are not.
        force_range: To which the force is cut; None if it is not.
    """

    name: str
    joint: int
    control: int
    gear: tuple[float, ...] = (1.0,)
    gain: Vector = (1.0, 0.0, 0.0)
    bias: Vector = (0.0, 0.0, 0.0)
    control_range: tuple[float, float] | None = None
    force_range: tuple[float, float] | None = None


@final
@dataclass(frozen=True)
class Coupling:
    """A joint that follows another one: ``x - reference = offset + ratio (x' - reference')``.

    Attributes:
        name: As errors call it.
        joint: Number of the hinge or slide with the coordinate x.
        leader: Number of that with the coordinate x'.
        offset: [rad] or [m].
        ratio: See above.
    """

    name: str
    joint: int
    leader: int
    offset: float
    ratio: float


class RowPart(NamedTuple):
    """Where a number of a parameter stands in a row.

    Attributes:
        field: Of the row.
        component: Which number of the field; None for all of it.
        sign: 1, or -1 where the row has the opposite of the parameter.
    """

    field: str
    component: int | None = None
    sign: float = 1.0


class Place(NamedTuple):
    """Where a parameter stands in the description.

    Attributes:
        table: ``"bodies"``, ``"joints"``, ``"geoms"`` or ``"actuators"``; ``""`` for what all
            bodies share.
        row: Number in that table.
        parts: What it is there.
    """

    table: str
    row: int
    parts: tuple[RowPart, ...]


@final
@dataclass(frozen=True, eq=False)
class ModelBodies:
    """All of a model that a backend needs to build and to drive it.

    Attributes:
        bodies: In an order in which parents come before their children; the world first.
        joints: In the order in which they act.
        geoms: What can touch something.
        actuators: What follows commands.
        couplings: Joints that follow others.
        touching: The pairs of geoms that may touch each other, in ascending order.
        gravity: [m/s²].
        timestep: Physics step [s].
        places: Where the parameters of the model stand in here; those that are missing have no
            meaning to this description.
        missing: What acts in the model and has no words here, one sentence each.
    """

    bodies: tuple[Body, ...]
    joints: tuple[Joint, ...]
    geoms: tuple[Geom, ...]
    actuators: tuple[Actuator, ...]
    couplings: tuple[Coupling, ...]
    touching: tuple[tuple[int, int], ...]
    gravity: Vector
    timestep: float
    places: Mapping[ParameterKey, Place] = field(default_factory=dict, repr=False)
    missing: tuple[str, ...] = ()

    def with_parameters(self, values: Mapping[ParameterKey, Any]) -> ModelBodies:
        """Give the same bodies with other values of some parameters, which have a place here.

        Args:
            values: Numbers, or sequences of them.
        """
        tables: dict[str, list[Any]] = {
            "bodies": list(self.bodies),
            "joints": list(self.joints),
            "geoms": list(self.geoms),
            "actuators": list(self.actuators),
        }
        changed: dict[str, Any] = {}
        for key, value in values.items():
            table, row, parts = self.places[key]
            plain = tuple(value) if isinstance(value, Sequence) else float(value)
            if not table:
                changed[parts[0].field] = plain
                continue
            for part in parts:
                element = tables[table][row]
                value_there = _with_part(element, part, plain)
                tables[table][row] = replace(element, **{part.field: value_there})
        changed.update((name, tuple(rows)) for name, rows in tables.items())
        return replace(self, **changed)

    @cached_property
    def roots(self) -> tuple[int, ...]:
        """For each body the one at the root of all that moves with it; 0 if it is fixed."""
        jointed = {joint.body for joint in self.joints}
        roots = [0]
        for number, body in enumerate(self.bodies[1:], start=1):
            roots.append(roots[body.parent] or (number if number in jointed else 0))
        return tuple(roots)

    def joints_of(self, body: int) -> Iterator[int]:
        """List the joints between a body and its parent."""
        return (number for number, joint in enumerate(self.joints) if joint.body == body)


def _with_part(row: Any, part: RowPart, value: Any) -> Any:
    """Give a field of a row with another value, or with one other number in it.

    Raises:
        ValueError: It is a direction or a rotation without length.
    """
    if part.component is not None:
        numbers = list(getattr(row, part.field))
        numbers[part.component] = part.sign * value
        return tuple(numbers)
    if part.field not in ("orientation", "axis"):
        return value
    squared = sum(number * number for number in value)
    if squared == 0.0:
        raise ValueError(f"the {part.field} of {row.name!r} has no length")
    length = 1.0 if abs(squared - 1.0) < UNIT else math.sqrt(squared)
    return tuple(number / length for number in value)
