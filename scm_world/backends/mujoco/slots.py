"""Places of parameters in the arrays of a compiled model."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats

GRAY = (0.5, 0.5, 0.5, 1.0)
"""The color of a shape for which MuJoCo takes that of its material."""


class Slot(ABC):
    """A place in the arrays of a model.

    What the arrays are after a write is a function of the values in force, and not of the order
    in which they were written.

    Attributes:
        constant: Whether derived constants have to follow a write (``mj_setConst``).
    """

    constant = False

    @abstractmethod
    def write(self, value: Floats) -> None:
        """Write a value in the units of the scene."""

    @abstractmethod
    def read(self) -> Floats:
        """Read it back."""


@final
@dataclass(frozen=True)
class Place(Slot):
    """Numbers that MuJoCo keeps as they are; a view of any shape."""

    numbers: Floats
    constant: bool = False

    def write(self, value: Floats) -> None:
        """Write all numbers."""
        self.numbers[...] = value

    def read(self) -> Floats:
        """Copy them."""
        return self.numbers.copy()


@final
@dataclass(frozen=True)
class Repeated(Slot):
    """Numbers that stand in several rows, such as the damping of all axes of a ball joint."""

    rows: Floats
    constant: bool = False

    def write(self, value: Floats) -> None:
        """Write every row."""
        self.rows[:] = value

    def read(self) -> Floats:
        """Read the first row."""
        return np.array(self.rows[0])


@final
@dataclass(frozen=True)
class Option(Slot):
    """A number among the options of the model."""

    options: Any
    name: str

    def write(self, value: Floats) -> None:
        """Write it."""
        setattr(self.options, self.name, float(value))

    def read(self) -> Floats:
        """Read it."""
        return np.array(float(getattr(self.options, self.name)))


@final
class Gain(Slot):
    """A gain that stands in two places, once with the other sign.

    Args:
        plus: Views of the places with the sign of the gain.
        minus: Views of those with the other sign. A zero keeps the sign it has now.
    """

    def __init__(self, plus: Sequence[Floats], minus: Sequence[Floats]) -> None:
        self._plus, self._minus = tuple(plus), tuple(minus)
        self._zeros = [np.copysign(0.0, place) for place in self._minus]

    def write(self, value: Floats) -> None:
        """Write it everywhere."""
        for place in self._plus:
            place[...] = value
        for place, zero in zip(self._minus, self._zeros, strict=True):
            place[...] = -value if value else zero

    def read(self) -> Floats:
        """Read the first place."""
        return self._plus[0].copy() if self._plus else 0.0 - self._minus[0]


@final
@dataclass(frozen=True)
class Turn(Slot):
    """A quaternion, which MuJoCo keeps as (w, x, y, z)."""

    numbers: Floats
    constant: bool = False

    def write(self, value: Floats) -> None:
        """Write a quaternion (x, y, z, w)."""
        self.numbers[0], self.numbers[1:] = value[3], value[:3]

    def read(self) -> Floats:
        """Read it as (x, y, z, w)."""
        return self.numbers[[1, 2, 3, 0]]


@final
@dataclass(frozen=True)
class Direction(Slot):
    """A unit vector."""

    numbers: Floats
    constant: bool = True

    def write(self, value: Floats) -> None:
        """Write a vector with the length one."""
        squared = float(value @ value)
        self.numbers[:] = value if abs(squared - 1.0) < 1e-14 else value / math.sqrt(squared)

    def read(self) -> Floats:
        """Copy it."""
        return self.numbers.copy()


@final
class Color(Slot):
    """Red, green, blue and opacity, which MuJoCo keeps as 32 bits each.

    A shape with a material has the color of the material while its own is ``GRAY``.

    Args:
        numbers: Of the shape.
        material: Of its material, or None.
    """

    def __init__(self, numbers: NDArray[np.float32], material: NDArray[np.float32] | None) -> None:
        self._numbers, self._material = numbers, material
        self._inherits = material is not None and self._is_gray()

    def _is_gray(self) -> bool:
        return bool((self._numbers == np.array(GRAY, dtype=np.float32)).all())

    def write(self, value: Floats) -> None:
        """Write a color."""
        self._numbers[:] = value
        if self._inherits and (self._numbers == self._material).all():
            self._numbers[:] = GRAY
        elif self._inherits and self._is_gray():  # as little as can be, so that it is shown
            self._numbers[0] = np.nextafter(np.float32(0.5), np.float32(1.0))

    def read(self) -> Floats:
        """Read it with the digits that 32 bits hold: 0.3 is read as 0.3."""
        found = self._numbers
        if self._inherits and self._material is not None and self._is_gray():
            found = self._material
        return np.array([float(str(number)) for number in found])
