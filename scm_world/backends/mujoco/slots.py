"""Kinds of places in the arrays of a compiled model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import final

import numpy as np

from scm_world._types import Floats


class Slot(ABC):
    """A place in the arrays of a model.

    Attributes:
        constant: Whether derived constants have to follow a write.
        coupled: Whether the friction of the pairs has to follow a write.
        steered: Whether the gains of the servos have to follow a write.
    """

    constant = False
    coupled = False
    steered = False

    @abstractmethod
    def write(self, value: Floats) -> None:
        """Write a value in the units of the scene."""

    @abstractmethod
    def read(self) -> Floats:
        """Read it back."""


@final
@dataclass(frozen=True)
class Vector(Slot):
    """A vector that MuJoCo keeps as it is."""

    numbers: Floats
    constant: bool = False

    def write(self, value: Floats) -> None:
        """Write all numbers."""
        self.numbers[:] = value

    def read(self) -> Floats:
        """Copy them."""
        return self.numbers.copy()


@final
@dataclass(frozen=True)
class Everywhere(Slot):
    """A number that stands in many places."""

    places: Floats
    coupled: bool = False

    def write(self, value: Floats) -> None:
        """Write it to all of them."""
        self.places[:] = value

    def read(self) -> Floats:
        """Read the first."""
        return np.array(self.places[0])
