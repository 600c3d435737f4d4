"""Scenes: the input of a backend and of a picture."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol, Self, final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.errors import UnknownOption
from scm_world.geometry.hulls import Hull
from scm_world.models.camera import Views


@final
@dataclass(frozen=True)
class StateLayout:
    """Where each state stands in the vector.

    Attributes:
        names: Names of the states, in their order.
        sizes: How many numbers each of them has.
        start: The vector before anything is set, shape (size,).
        reported: Names of those that the engine reports and that cannot be set.
        held: Names of those that no engine has: the world keeps them.
    """

    names: tuple[str, ...]
    sizes: tuple[int, ...]
    start: tuple[float, ...]
    reported: frozenset[str] = frozenset()
    held: frozenset[str] = frozenset()

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
        return self._without(self.reported)

    @cached_property
    def engine_takes(self) -> NDArray[np.bool_]:
        """Which numbers an engine is given, shape (size,)."""
        return self._without(self.reported | self.held)

    def _without(self, names: frozenset[str]) -> NDArray[np.bool_]:
        found = np.ones(self.size, dtype=np.bool_)
        for name in names:
            found[self.slices[name]] = False
        return found

    def __getstate__(self) -> dict[str, Any]:
        return kept_fields(self)


def kept_fields(made: Any) -> dict[str, Any]:
    """Return the fields of a dataclass, without cached values."""
    return {name: getattr(made, name) for name in made.__dataclass_fields__}


class State:
    """Where everything is and how it moves. All views write the vector.

    Args:
        layout: Layout of the vector.
        vector: The numbers, shape (layout.size,); those of ``layout.start`` if not given.
    """

    __slots__ = ("layout", "vector")

    def __init__(self, layout: StateLayout, vector: Floats | None = None) -> None:
        if not isinstance(layout, StateLayout):
            raise UnknownOption("layout", layout, ("a StateLayout",))
        self.layout = layout
        self.vector = np.array(layout.start, dtype=np.float64) if vector is None else vector

    def copy(self) -> Self:
        """Copy the numbers."""
        return self.with_vector(self.vector.copy())

    def with_vector(self, vector: Floats) -> Self:
        """Return a state of the same layout with other numbers."""
        other = object.__new__(type(self))
        other.layout, other.vector = self.layout, vector
        return other

    def __getitem__(self, name: str) -> Floats:
        """Return one state by its name, as a view."""
        return self.vector[self.layout.slices[name]]

    def __iter__(self) -> Iterator[str]:
        return iter(self.layout.names)

    def carry(self, before: State) -> None:
        """Copy the states that another one has, too: of one name and one size."""
        there = before.layout.slices
        for name, where in self.layout.slices.items():
            if name in there and there[name].stop - there[name].start == where.stop - where.start:
                self.vector[where] = before.vector[there[name]]

    def settable(self) -> Floats:
        """Copy the numbers that can be set."""
        return self.vector[self.layout.can_be_set]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, State):
            return NotImplemented
        return bool(np.array_equal(self.vector, other.vector))

    __hash__ = None  # type: ignore[assignment] # mutable

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.vector!r})"


ParameterKey = tuple[str, str]
"""An element and a property of it, for example ``("tool_block", "mass")``."""

Parameters = Mapping[ParameterKey, Floats]
"""Physical parameters: scalars have shape (), sizes, colors and gravity shape (3,)."""

SURFACES = frozenset({"size", "height", "position", "orientation", "axis", "anchor", "ref"})
"""Properties that decide where the surfaces of bodies are."""
RANGES = frozenset({"range", "springlength", "ctrlrange", "forcerange", "actuatorfrcrange"})
"""Properties that are a lower and an upper end."""
REVERSED = "the upper end comes first; give the lower end first"


def reversed_ranges(parameters: Mapping[ParameterKey, Any]) -> list[ParameterKey]:
    """List the ranges whose lower end is above the upper one."""
    return [key for key, ends in parameters.items() if key[1] in RANGES and ends[0] > ends[1]]


@final
@dataclass(frozen=True)
class BodyRow:
    """A rigid body.

    Attributes:
        name: As contacts call it.
        tree: Number of the kinematic tree that it moves with; -1 if it cannot move.
        shapes: Names of its shapes.
        joints: Names of the joints between it and its parent.
    """

    name: str
    tree: int
    shapes: tuple[str, ...]
    joints: tuple[str, ...]


class Row(Protocol):
    """A row of a table of states."""

    @property
    def name(self) -> str:
        """Name of its variable."""


class ParameterRow(Row, Protocol):
    """A row of a table of parameters."""

    @property
    def key(self) -> ParameterKey:
        """The element and the property, as backends know it."""


class Structure(ABC):
    """A system as a backend compiles it; another one is compiled when bodies come or go.

    Equal ones compile the same. It can be hashed and pickled.

    Attributes:
        name: Name of the system.
        digest: Hash of everything that decides the compiled system.
        timestep: Physics step [s].
        parameters: What can be set and holds.
        states: What moves, in the order of the state vector.
        bodies: All rigid bodies; empty where the physics is a function.
        views: Its cameras, and the background of pictures of goals; None for those of its file.
    """

    name: str
    digest: str
    timestep: float
    parameters: tuple[ParameterRow, ...]
    states: tuple[Row, ...]
    bodies: tuple[BodyRow, ...] = ()
    views: Views | None = None

    @cached_property
    def body_names(self) -> tuple[str, ...]:
        """Names of all bodies; the first is the world."""
        return tuple(body.name for body in self.bodies)

    @property
    def refused(self) -> dict[str, str]:
        """What cannot be set or exposed, by name, with the reason."""
        return {}

    @property
    @abstractmethod
    def n_commands(self) -> int:
        """How many numbers a command has."""

    @cached_property
    @abstractmethod
    def layout(self) -> StateLayout:
        """Where each state stands in the vector."""

    @cached_property
    @abstractmethod
    def defaults(self) -> Parameters:
        """The default of every parameter, by key."""

    def empty_state(self) -> State:
        """Return a state to read into."""
        return State(self.layout)

    def default_scene(self) -> Scene:
        """Return the scene in which every parameter and every state has its default."""
        return Scene(self, self.defaults, self.empty_state())

    def __getstate__(self) -> dict[str, Any]:
        return kept_fields(self)


@final
@dataclass(frozen=True)
class Light:
    """How a picture is lit.

    Attributes:
        direction: Towards the light, of any length, shape (3,).
        ambient: How bright surfaces are that the light does not reach, in [0, 1].
    """

    direction: tuple[float, float, float] = (0.25, -0.5, 0.83)
    ambient: float = 0.3


@final
@dataclass(frozen=True)
class GoalRegion:
    """A place where something should be. Goals are never bodies: nothing can touch them.

    Attributes:
        name: Name of the entity.
        shape: ``"box"``, ``"sphere"`` or ``"hull"``.
        size: Full edge lengths, or three times the diameter, shape (3,) [m].
        position: Center, shape (3,) [m].
        orientation: Quaternion (x, y, z, w).
        color: Red, green, blue in [0, 1].
        hull: The shape where it is a ``"hull"``.
    """

    name: str
    shape: str
    size: Floats
    position: Floats
    orientation: Floats
    color: Floats
    hull: Hull | None = None


@final
@dataclass(frozen=True)
class Scene:
    """Everything a backend needs to know, and everything a picture shows.

    Attributes:
        structure: The bodies there are.
        parameters: Their properties, complete.
        state: Where everything is and how it moves.
        goals: Silhouettes, for pictures and rewards.
        light: Of pictures; no backend knows it.
    """

    structure: Structure
    parameters: Parameters
    state: State
    goals: tuple[GoalRegion, ...] = ()
    light: Light = field(default_factory=Light)

    def with_(self, **changes: Any) -> Scene:
        """Copy the scene with some fields replaced."""
        return replace(self, **changes)


TOLERANCE = 1e-3
"""How deep two bodies may lie in one another after an intervention [m]."""


@final
@dataclass(frozen=True)
class Overlap:
    """Two bodies in one place.

    Attributes:
        bodies: Their names: those that can be moved first.
        depth: How far they would have to be moved to come apart [m].
    """

    bodies: tuple[str, str]
    depth: float

    def __str__(self) -> str:
        first, second = self.bodies
        return f"{first!r} lies {1e3 * self.depth:.3g} mm deep in {second!r}"


@final
@dataclass(frozen=True)
class Difference:
    """What a backend has to change.

    Attributes:
        structure: The new structure, or None where it stays.
        parameters: Only the parameters that change.
        state: The complete new state, or None where nothing is moved.
    """

    structure: Structure | None = None
    parameters: Parameters = field(default_factory=dict)
    state: State | None = None

    def __bool__(self) -> bool:
        return self.structure is not None or bool(self.parameters) or self.state is not None


def complete(now: Scene, structure: Structure, difference: Difference) -> Difference:
    """Fill in the parameters and the state that a change to another structure leaves unsaid.

    Bodies that stay keep their parameters and their state, new ones get the defaults.
    """
    default = structure.default_scene()
    stays = {key: value for key, value in now.parameters.items() if key in default.parameters}
    state = difference.state
    if state is None:
        state = default.state
        state.carry(now.state)
    return Difference(structure, {**default.parameters, **stays, **difference.parameters}, state)
