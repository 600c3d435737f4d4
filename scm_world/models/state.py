"""The state of a system, as one flat vector with named views."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self, final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats


@final
@dataclass(frozen=True)
class StateLayout:
    """Where each state stands in the vector.

    Attributes:
        names: Of the states, in their order.
        sizes: How many numbers each of them has.
        start: The vector before anything is set, shape (size,).
        reported: Names of those that the engine reports and nobody can set.
    """

    names: tuple[str, ...]
    sizes: tuple[int, ...]
    start: tuple[float, ...]
    reported: frozenset[str] = frozenset()

    @property
    def size(self) -> int:
        """How many numbers there are."""
        return len(self.start)

    @cached_property
    def slices(self) -> dict[str, slice]:
        """The place of each state."""
        ends = np.cumsum((0, *self.sizes)).tolist()
        return {n: slice(a, b) for n, a, b in zip(self.names, ends, ends[1:], strict=False)}

    @cached_property
    def can_be_set(self) -> NDArray[np.bool_]:
        """Which numbers can be set, shape (size,)."""
        found = np.ones(self.size, dtype=np.bool_)
        for name in self.reported:
            found[self.slices[name]] = False
        return found

    def __getstate__(self) -> dict[str, Any]:
        return {f: getattr(self, f) for f in self.__dataclass_fields__}


class State:
    """Where everything is and how it moves. All views write the vector.

    Args:
        layout: Of the vector.
        vector: The numbers, shape (layout.size,); those of ``layout.start`` if not given.
    """

    __slots__ = ("layout", "vector")

    def __init__(self, layout: StateLayout, vector: Floats | None = None) -> None:
        self.layout = layout
        self.vector = np.array(layout.start, dtype=np.float64) if vector is None else vector

    def copy(self) -> Self:
        """Copy the numbers."""
        return self.with_vector(self.vector.copy())

    def with_vector(self, vector: Floats) -> Self:
        """Give a state of the same layout with other numbers."""
        other = object.__new__(type(self))
        other.layout, other.vector = self.layout, vector
        return other

    def __getitem__(self, name: str) -> Floats:
        """Give one state by its name, as a view."""
        return self.vector[self.layout.slices[name]]

    def __iter__(self) -> Iterator[str]:
        return iter(self.layout.names)

    def coincides(self, other: State) -> bool:
        """Tell whether all numbers that can be set are the same."""
        same = self.vector == other.vector
        return bool((same if same.all() else same | ~self.layout.can_be_set).all())

    def settable(self) -> Floats:
        """Copy the numbers that can be set."""
        found: Floats = self.vector[self.layout.can_be_set]
        return found

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, State):
            return NotImplemented
        return bool(np.array_equal(self.vector, other.vector))

    __hash__ = None  # type: ignore[assignment] # mutable

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.vector!r})"
