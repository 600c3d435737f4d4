"""Where each parameter lives in a compiled model, and how it is written and read there.

Every write is a pure function of the values in force afterwards, so that any order of changes
ends in the same model bit for bit. Derived constants of the model (bounding radii, inverse
weights) follow with ``mj_setConst``, wherever ``constant`` says so.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import final

import mujoco
import numba
import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.backends.mujoco.model import (
    FLOOR,
    STAGE,
    base_name,
    link_shapes,
    shape_owners,
    wall_name,
)
from scm_world.scene import trifinger
from scm_world.scene.scene import WALL_SEGMENTS, ParameterKey, Structure


class Slot(ABC):
    """A place in the arrays of a model.

    Attributes:
        constant: Whether derived constants have to follow a write.
        coupled: Whether the friction of the pairs has to follow a write.
    """

    constant = False
    coupled = False

    @abstractmethod
    def write(self, value: Floats) -> None:
        """Write a value in the units of the scene."""

    @abstractmethod
    def read(self) -> Floats:
        """Read it back."""


@final
@dataclass(frozen=True)
class _Gravity(Slot):
    """Acceleration, shape (3,) [m/s²]."""

    vector: Floats

    def write(self, value: Floats) -> None:
        self.vector[:] = value

    def read(self) -> Floats:
        return self.vector.copy()


@final
@dataclass(frozen=True)
class _Height(Slot):
    """Of the robot's base over the plane it is measured from [m]."""

    positions: Floats
    bodies: tuple[int, ...]
    constant = True

    def write(self, value: Floats) -> None:
        for body in self.bodies:
            self.positions[body, 2] = value - trifinger.TABLE_OFFSET

    def read(self) -> Floats:
        return np.array(self.positions[self.bodies[0], 2] + trifinger.TABLE_OFFSET)


@final
@dataclass(frozen=True)
class _Friction(Slot):
    """Factor of one body. Contact pairs get products; the factors rest in the shapes."""

    friction: Floats
    shapes: tuple[int, ...]
    coupled = True

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
class _LinkMass(Slot):
    """Mass of a link [kg]; its moments of inertia scale with it."""

    masses: Floats
    inertias: Floats
    body: int
    per_mass: Floats
    constant = True

    def write(self, value: Floats) -> None:
        self.masses[self.body] = value
        self.inertias[self.body] = value * self.per_mass

    def read(self) -> Floats:
        return np.array(self.masses[self.body])


@final
@dataclass(frozen=True)
class _BlockMass(Slot):
    """Mass of a block [kg]."""

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
class _BlockSize(Slot):
    """Full edge lengths of a block, shape (3,) [m]."""

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


@numba.njit("void(f8, f8[::1], f8[::1])", cache=True)
def _fill_box(mass: float, half: Floats, inertia: Floats) -> None:
    """Give a solid box its moments of inertia, m/12 (b² + c²)."""
    for axis in range(3):
        b, c = half[(axis + 1) % 3], half[(axis + 2) % 3]
        inertia[axis] = mass / 3.0 * (b * b + c * c)


@numba.njit("void(f8[:, ::1], i4[::1], i4[::1], f8[:, ::1])", cache=True)
def couple(
    factors: Floats, first: NDArray[np.int32], second: NDArray[np.int32], pairs: Floats
) -> None:
    """Give every contact pair the product of its two frictions."""
    for i in range(first.shape[0]):
        product = factors[first[i], 0] * factors[second[i], 0]
        pairs[i, 0] = product
        pairs[i, 1] = product


def slots(model: mujoco.MjModel, structure: Structure) -> dict[ParameterKey, Slot]:
    """Find the place of every parameter of this structure in this model."""
    hanging = [name(finger) for finger in trifinger.FINGERS for name in (base_name, _fixed_link)]
    found: dict[ParameterKey, Slot] = {
        ("world", "gravity"): _Gravity(model.opt.gravity),
        ("robot", "height"): _Height(
            model.body_pos, tuple(int(model.body(name).id) for name in hanging)
        ),
    }
    owners = shape_owners(structure)
    links = [name for name, owner in owners.items() if owner in trifinger.LINK_NAMES]
    _add_surface(found, model, "robot", links, color=False)
    _add_surface(found, model, FLOOR, [FLOOR])
    _add_surface(found, model, STAGE, [wall_name(i) for i in range(WALL_SEGMENTS)])
    for finger in trifinger.FINGERS:
        for index, inertial in enumerate(trifinger.INERTIAL):
            link = trifinger.link_name(finger, index)
            found[link, "mass"] = _LinkMass(
                model.body_mass,
                model.body_inertia,
                model.body(link).id,
                np.array(inertial.per_mass),
            )
            found[link, "color"] = _Color(
                model.geom_rgba, _ids(model, list(link_shapes(finger, index)))
            )
    for block in structure.blocks:
        body, shape = model.body(block).id, model.geom(block).id
        box = (model.body_mass, model.body_inertia[body], model.geom_size[shape], body)
        found[block, "mass"] = _BlockMass(*box)
        found[block, "size"] = _BlockSize(*box)
        _add_surface(found, model, block, [block])
    return found


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
    return trifinger.link_name(finger, 0)


def _ids(model: mujoco.MjModel, shapes: list[str]) -> tuple[int, ...]:
    return tuple(int(model.geom(name).id) for name in shapes)
