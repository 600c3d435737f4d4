"""Places of parameters in the arrays of a compiled model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import final

from scm_world._types import Floats


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
