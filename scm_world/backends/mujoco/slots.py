"""Places of parameters in the arrays of a compiled model."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import mujoco
import numpy as np

from scm_world._types import Floats

GRAY = np.array([0.5, 0.5, 0.5, 1.0], dtype=np.float32)
"""The color of a shape for which MuJoCo takes that of its material. Source: MuJoCo, XML."""

Finder = Callable[[mujoco.MjModel, mujoco.MjData], "Slot"]
"""Finds a place in a model and its data. It can be pickled."""


@final
@dataclass(frozen=True)
class Slot:
    """A place in the arrays of a model.

    What the arrays are after a write is a function of the values in force, and not of the order
    in which they were written.

    Attributes:
        write: Writes a value in the units of the scene.
        read: Reads it back.
        constant: Whether derived constants have to follow a write (``mj_setConst``).
        follow_up: Called with the model after writes, before constants are derived.
    """

    write: Callable[[Floats], None]
    read: Callable[[], Floats]
    constant: bool = False
    follow_up: Callable[[Any], None] | None = None


def place(
    *views: Floats,
    constant: bool = False,
    to: Callable[[Floats], Any] = lambda value: value,
    back: Callable[[Any], Any] = lambda view: view,
    follow_up: Callable[[Any], None] | None = None,
) -> Slot:
    """Return the slot of a value that stands in some views of arrays, alike in all of them.

    ``to`` returns the numbers that MuJoCo keeps of a value, and ``back`` the value of those in the
    first view.
    """

    def write(value: Floats) -> None:
        kept = to(value)
        for view in views:
            view[...] = kept

    return Slot(write, lambda: np.array(back(views[0]), dtype=np.float64), constant, follow_up)


def first(view: Floats) -> Floats:
    """Return the first row of several that are alike."""
    found: Floats = view[0]
    return found


def turn(view: Floats, *, constant: bool = True, **_: object) -> Slot:
    """Return the slot of a quaternion (x, y, z, w), which MuJoCo keeps as (w, x, y, z)."""
    return place(view, to=lambda q: np.roll(q, 1), back=lambda q: np.roll(q, -1), constant=constant)


def direction(view: Floats, **_: object) -> Slot:
    """Return the slot of a vector of which MuJoCo keeps the direction alone, of length one."""

    def unit(vector: Floats) -> Floats:
        squared = float(vector @ vector)
        return vector if abs(squared - 1.0) < 1e-14 else vector / math.sqrt(squared)

    return place(view, to=unit, constant=True)


# --- finders, with the model and its data as the last arguments -----------------------------------


@final
@dataclass(frozen=True, eq=False, slots=True)
class At:
    """Finds a value at one place of some arrays: ``"body_mass"``, ``"opt.gravity data.eq_active"``.

    At a slice, several rows are alike and the value stands in each.
    """

    form: Callable[..., Slot]
    arrays: str
    index: tuple[Any, ...]
    constant: bool

    def __call__(self, mj: mujoco.MjModel, data: mujoco.MjData) -> Slot:
        """Find it in a model and its data."""
        views = []
        for array in self.arrays.split():
            of, _, name = array.rpartition(".")
            owner = {"": mj, "opt": mj.opt, "data": data}[of]
            views.append(getattr(owner, name)[(*self.index, ...)])
        rest = {"back": first} if self.index and isinstance(self.index[0], slice) else {}
        return self.form(*views, constant=self.constant, **rest)


def option(name: str, mj: mujoco.MjModel, _: mujoco.MjData) -> Slot:
    """Find a number among the options of the model."""
    return Slot(
        lambda value: setattr(mj.opt, name, float(value)),
        lambda: np.array(float(getattr(mj.opt, name))),
    )


def gain(
    actuator: int,
    places: tuple[tuple[str, int, int], ...],
    zeros: tuple[float, ...],
    mj: mujoco.MjModel,
    _: mujoco.MjData,
) -> Slot:
    """Find a gain of an actuator in arrays, each with a column, a sign, and a zero with a sign."""
    views = [(getattr(mj, f"actuator_{a}")[actuator, column, ...], s) for a, column, s in places]

    def write(value: Floats) -> None:
        for (view, sign), zero in zip(views, zeros, strict=True):
            view[...] = sign * value if value or sign > 0 else zero

    view, sign = views[0]
    return Slot(write, lambda: view.copy() if sign > 0 else 0.0 - view)


def color(geom: int, material: int, mj: mujoco.MjModel, _: mujoco.MjData) -> Slot:
    """Find red, green, blue and opacity of a shape, which MuJoCo keeps as 32 bits each.

    A shape that has the color of a material (not -1) does so while its own is ``GRAY``. Colors are
    read with the digits that 32 bits hold: 0.3 is read as 0.3.
    """
    own = mj.geom_rgba[geom]
    inherits = material >= 0
    other = mj.mat_rgba[material] if inherits else own

    def write(value: Floats) -> None:
        own[:] = value
        if inherits and (own == other).all():
            own[:] = GRAY
        elif inherits and (own == GRAY).all():  # as little as can be, so that it is shown
            own[0] = np.nextafter(np.float32(0.5), np.float32(1.0))

    def read() -> Floats:
        found = other if inherits and (own == GRAY).all() else own
        return np.array([float(str(number)) for number in found])

    return Slot(write, read)
