"""Places of parameters in the arrays of a compiled model."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats

GRAY = (0.5, 0.5, 0.5, 1.0)
"""The color of a shape for which MuJoCo takes that of its material."""


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
    *views: Any,
    constant: bool = False,
    to: Callable[[Floats], Any] | None = None,
    back: Callable[[Any], Any] | None = None,
    follow_up: Callable[[Any], None] | None = None,
) -> Slot:
    """Give the slot of a value that stands in some views of arrays, alike in all of them.

    Args:
        views: Of any shape; the first one is read.
        constant: See ``Slot``.
        to: What MuJoCo keeps of a value; the value itself if None.
        back: The value of what stands in a view; all of it if None.
        follow_up: See ``Slot``.
    """

    def write(value: Floats) -> None:
        kept = value if to is None else to(value)
        for view in views:
            view[...] = kept

    def read() -> Floats:
        return np.array(views[0] if back is None else back(views[0]), dtype=np.float64)

    return Slot(write, read, constant, follow_up)


def first(view: Floats) -> Any:
    """Give the first row of several that are alike."""
    return view[0]


def turn(view: Floats, *, constant: bool = True) -> Slot:
    """Give the slot of a quaternion (x, y, z, w), which MuJoCo keeps as (w, x, y, z)."""
    return place(view, to=lambda q: np.roll(q, 1), back=lambda q: np.roll(q, -1), constant=constant)


def direction(view: Floats) -> Slot:
    """Give the slot of a vector of which MuJoCo keeps the direction alone, with the length one."""

    def unit(vector: Floats) -> Floats:
        squared = float(vector @ vector)
        return vector if abs(squared - 1.0) < 1e-14 else vector / math.sqrt(squared)

    return place(view, to=unit, constant=True)


def option(options: Any, name: str) -> Slot:
    """Give the slot of a number among the options of the model."""
    return Slot(
        lambda value: setattr(options, name, float(value)),
        lambda: np.array(float(getattr(options, name))),
    )


def gain(plus: Sequence[Floats], minus: Sequence[Floats]) -> Slot:
    """Give the slot of a gain that stands in some places, and in others with the other sign.

    Args:
        plus: Views of the places with the sign of the gain.
        minus: Views of those with the other sign. A zero keeps the sign it has now.
    """
    zeros = [np.copysign(0.0, view) for view in minus]

    def write(value: Floats) -> None:
        for view in plus:
            view[...] = value
        for view, zero in zip(minus, zeros, strict=True):
            view[...] = -value if value else zero

    return Slot(write, lambda: plus[0].copy() if plus else 0.0 - minus[0])


def color(own: NDArray[np.float32], material: NDArray[np.float32] | None) -> Slot:
    """Give the slot of red, green, blue and opacity, which MuJoCo keeps as 32 bits each.

    A shape with a material has the color of the material while its own is ``GRAY``. Colors are
    read with the digits that 32 bits hold: 0.3 is read as 0.3.

    Args:
        own: Of the shape.
        material: Of its material, or None.
    """

    def is_gray() -> bool:
        return bool((own == np.array(GRAY, dtype=np.float32)).all())

    inherits = material is not None and is_gray()

    def write(value: Floats) -> None:
        own[:] = value
        if inherits and (own == material).all():
            own[:] = GRAY
        elif inherits and is_gray():  # as little as can be, so that it is shown
            own[0] = np.nextafter(np.float32(0.5), np.float32(1.0))

    def read() -> Floats:
        found = material if inherits and material is not None and is_gray() else own
        return np.array([float(str(number)) for number in found])

    return Slot(write, read)
