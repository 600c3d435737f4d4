"""Where each parameter lives in a compiled model, and how it is written and read there.

Every write is a pure function of the values in force afterwards, so that any order of changes
ends in the same model bit for bit. Derived constants of the model (bounding radii, inverse
weights) follow with ``mj_setConst``, wherever ``constant`` says so; frictions of pairs with
``couple``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import mujoco
import numba
import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.backends.mujoco.slots import Place, Slot
from scm_world.geometry.hulls import Hull
from scm_world.models.scene import ParameterKey
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.mujoco.model import (
    FLOOR,
    STAGE,
    base_name,
    link_shapes,
    shape_owners,
    wall_name,
)
from scm_world.tasks.trifinger.mujoco.servos import controller_slots
from scm_world.tasks.trifinger.mujoco.settings import settings
from scm_world.tasks.trifinger.structure import WALL_SEGMENTS, Structure


@final
@dataclass(frozen=True)
class _Everywhere(Slot):
    """A number that stands in many places."""

    places: Floats

    def write(self, value: Floats) -> None:
        self.places[:] = value

    def read(self) -> Floats:
        return np.array(self.places[0])


@final
@dataclass(frozen=True)
class _Height(Slot):
    """Of the robot's base over the plane it is measured from [m]."""

    positions: Floats
    bodies: tuple[int, ...]
    constant = True

    def write(self, value: Floats) -> None:
        for body in self.bodies:
            self.positions[body, 2] = value - hardware.TABLE_OFFSET

    def read(self) -> Floats:
        return np.array(self.positions[self.bodies[0], 2] + hardware.TABLE_OFFSET)


@final
@dataclass(frozen=True)
class _Friction(Slot):
    """Factor of one body. Contact pairs get products; the factors rest in the shapes."""

    friction: Floats
    shapes: tuple[int, ...]

    def write(self, value: Floats) -> None:
        for shape in self.shapes:
            self.friction[shape, 0] = value

    def read(self) -> Floats:
        return np.array(self.friction[self.shapes[0], 0])


@final
@dataclass(frozen=True)
class _Color(Slot):
    """Red, green, blue, shape (3,); MuJoCo keeps 32 bits of each."""

    colors: NDArray[np.float32]
    shapes: tuple[int, ...]

    def write(self, value: Floats) -> None:
        for shape in self.shapes:
            self.colors[shape, :3] = value

    def read(self) -> Floats:
        return self.colors[self.shapes[0], :3].astype(np.float64)


@final
@dataclass(frozen=True)
class _ScaledMass(Slot):
    """Mass of a link or a hull [kg]; its moments of inertia scale with it."""

    masses: Floats
    inertia: Floats
    body: int
    per_mass: Floats
    constant = True

    def write(self, value: Floats) -> None:
        self.masses[self.body] = value
        self.inertia[:] = value * self.per_mass

    def read(self) -> Floats:
        return np.array(self.masses[self.body])


@final
@dataclass(frozen=True)
class _BoxMass(Slot):
    """Mass of a box [kg]."""

    masses: Floats
    inertia: Floats
    half: Floats
    body: int
    constant = True

    def write(self, value: Floats) -> None:
        self.masses[self.body] = value
        _fill_box(self.masses[self.body], self.half, self.inertia)

    def read(self) -> Floats:
        return np.array(self.masses[self.body])


@final
@dataclass(frozen=True)
class _BoxSize(Slot):
    """Full edge lengths of a box that can move, shape (3,) [m]."""

    masses: Floats
    inertia: Floats
    half: Floats
    body: int
    constant = True

    def write(self, value: Floats) -> None:
        np.multiply(value, 0.5, out=self.half)
        _fill_box(self.masses[self.body], self.half, self.inertia)

    def read(self) -> Floats:
        return 2.0 * self.half


@final
@dataclass(frozen=True)
class _FixedSize(Slot):
    """Full edge lengths of an obstacle, shape (3,) [m]."""

    half: Floats
    constant = True

    def write(self, value: Floats) -> None:
        np.multiply(value, 0.5, out=self.half)

    def read(self) -> Floats:
        return 2.0 * self.half


@final
@dataclass(frozen=True)
class _Orientation(Slot):
    """Of an obstacle, quaternion (x, y, z, w); MuJoCo keeps (w, x, y, z)."""

    quaternion: Floats
    constant = True

    def write(self, value: Floats) -> None:
        self.quaternion[:] = np.roll(value, 1)

    def read(self) -> Floats:
        return np.roll(self.quaternion, -1)


@final
@dataclass(frozen=True)
class _Restitution(Slot):
    """How much of its speed a body keeps when it bounces, in [0, 1).

    A contact is a spring and a damper. A damping ratio z leaves ``exp(-pi z / sqrt(1 - z²))`` of
    the speed after half a period; the frequency stays, and with it how far a body sinks in.

    Attributes:
        references: Time constant [s] and damping ratio of every pair, shape (n, 2).
        rigid: Both of a contact without restitution, which is critically damped.
    """

    references: Floats
    rigid: tuple[float, float]

    def write(self, value: Floats) -> None:
        time, ratio = self.rigid
        loss = -math.log(value) if value > 0.0 else math.inf
        damping = loss / math.hypot(math.pi, loss) if loss < math.inf else 1.0
        self.references[:, 0], self.references[:, 1] = time / damping, ratio * damping

    def read(self) -> Floats:
        damping = float(self.references[0, 1]) / self.rigid[1]
        if damping >= 1.0:
            return np.array(0.0)
        return np.array(math.exp(-math.pi * damping / math.sqrt(1.0 - damping * damping)))


@numba.njit("void(f8, f8[::1], f8[::1])", cache=True)
def _fill_box(mass: float, half: Floats, inertia: Floats) -> None:
    """Give a solid box its moments of inertia, m/12 (b² + c²)."""
    for axis in range(3):
        b, c = half[(axis + 1) % 3], half[(axis + 2) % 3]
        inertia[axis] = mass / 3.0 * (b * b + c * c)


SPINNING_LIMIT = 1.0
"""At most this many times its sliding friction is the spinning friction of a pair [m]. Above about
five times the solver of the engine speeds a spinning body up, tenfold and more in a step; a real
patch of contact gives two thirds of its radius."""


@numba.njit("void(f8[:, ::1], i4[::1], i4[::1], f8[:, ::1])", cache=True)
def couple(
    factors: Floats, first: NDArray[np.int32], second: NDArray[np.int32], pairs: Floats
) -> None:
    """Give every contact pair the product of its two frictions, and its friction of spinning."""
    for i in range(first.shape[0]):
        product = factors[first[i], 0] * factors[second[i], 0]
        pairs[i, 0] = product
        pairs[i, 1] = product
        pairs[i, 2] = min(factors[first[i], 1], SPINNING_LIMIT * product)


def slots(model: mujoco.MjModel, structure: Structure) -> dict[ParameterKey, Slot]:
    """Find the place of every parameter of this structure in this model."""
    hanging = [name(finger) for finger in hardware.FINGERS for name in (base_name, _fixed_link)]
    found: dict[ParameterKey, Slot] = {
        ("world", "gravity"): Place(model.opt.gravity),
        ("world", "restitution"): _Restitution(
            model.pair_solref, settings(structure.preset).contact
        ),
        ("world", "spinning_friction"): _Everywhere(model.geom_friction[:, 1]),
        ("robot", "height"): _Height(
            model.body_pos, tuple(int(model.body(name).id) for name in hanging)
        ),
        ("robot", "joint_damping"): _Everywhere(model.dof_damping[: hardware.N_JOINTS]),
        **controller_slots(model),
    }
    owners = shape_owners(structure)
    links = [name for name, owner in owners.items() if owner in hardware.LINK_NAMES]
    _add_surface(found, model, "robot", links, color=False)
    _add_surface(found, model, FLOOR, [FLOOR])
    _add_surface(found, model, STAGE, [wall_name(i) for i in range(WALL_SEGMENTS)])
    _add_links(found, model)
    for block in structure.blocks:
        _add_block(found, model, block, structure.hull(block))
    for obstacle in structure.obstacles:
        _add_obstacle(found, model, obstacle)
    return found


def _add_links(found: dict[ParameterKey, Slot], model: mujoco.MjModel) -> None:
    for finger in hardware.FINGERS:
        for index, inertial in enumerate(hardware.INERTIAL):
            link = hardware.link_name(finger, index)
            found[link, "mass"] = _scaled_mass(model, link, inertial.per_mass)
            found[link, "color"] = _Color(
                model.geom_rgba, _ids(model, list(link_shapes(finger, index)))
            )


def _add_block(
    found: dict[ParameterKey, Slot], model: mujoco.MjModel, name: str, hull: Hull | None
) -> None:
    if hull is None:
        body, shape = model.body(name).id, model.geom(name).id
        box = (model.body_mass, model.body_inertia[body], model.geom_size[shape], body)
        found[name, "mass"], found[name, "size"] = _BoxMass(*box), _BoxSize(*box)
    else:
        found[name, "mass"] = _scaled_mass(model, name, hull.moments)
    _add_surface(found, model, name, [name])


def _add_obstacle(found: dict[ParameterKey, Slot], model: mujoco.MjModel, name: str) -> None:
    shape = model.geom(name).id
    found[name, "size"] = _FixedSize(model.geom_size[shape])
    found[name, "position"] = Place(model.geom_pos[shape], constant=True)
    found[name, "orientation"] = _Orientation(model.geom_quat[shape])
    _add_surface(found, model, name, [name])


def _scaled_mass(model: mujoco.MjModel, name: str, per_mass: tuple[float, ...]) -> _ScaledMass:
    body = model.body(name).id
    return _ScaledMass(model.body_mass, model.body_inertia[body], body, np.array(per_mass))


def _add_surface(
    found: dict[ParameterKey, Slot],
    model: mujoco.MjModel,
    name: str,
    shapes: list[str],
    *,
    color: bool = True,
) -> None:
    ids = _ids(model, shapes)
    found[name, "friction"] = _Friction(model.geom_friction, ids)
    if color:
        found[name, "color"] = _Color(model.geom_rgba, ids)


def _fixed_link(finger: str) -> str:
    return hardware.link_name(finger, 0)


def _ids(model: mujoco.MjModel, shapes: list[str]) -> tuple[int, ...]:
    return tuple(int(model.geom(name).id) for name in shapes)
