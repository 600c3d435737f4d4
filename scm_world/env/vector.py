"""Observations that are one vector of numbers."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats, Integers, Values
from scm_world.geometry.numbers import scale_rows
from scm_world.geometry.rotations import rotation_matrix
from scm_world.graph import SCM
from scm_world.tasks import TIME
from scm_world.variables import Box, Categories, Normal, Rotations
from scm_world.variables import Integers as WholeNumbers
from scm_world.variables.reserved import SENSOR_NOISE
from scm_world.variables.spaces import Affine, Switch
from scm_world.world import Simulation
from scm_world.world.compiled_task import CompiledTask
from scm_world.world.mechanisms import FIRST, Rows, places

# --- bounds ---------------------------------------------------------------------------------------

WIDE = float(np.finfo(np.float32).max)
"""Stands for no bound: Gymnasium requires finite ones, and no 32-bit number lies beyond."""

_COORDINATES: dict[str, tuple[Any, Any]] = {
    "cylindrical_position": ((0.0, -np.pi, -1.0), (1.5, np.pi, 1.0)),  # [m, rad, m]
    "euler_orientation": (-np.pi, np.pi),  # [rad]
}
"""Other coordinates of a pose declare no bounds: those of the pose hold for them."""


def bounds(model: SCM, name: str) -> tuple[Floats, Floats]:
    """Give the bounds of every component of a variable.

    A declared bound that follows another variable is taken where that one makes it widest.

    Returns:
        Lower and upper bound, shape (n,) each; ``∓WIDE`` where none is declared.
    """
    variable = model.declared(name)
    extent = _extent(model, variable.bounds, name.rpartition(".")[2])
    low, high = (spread(np.clip(end, -WIDE, WIDE), variable.shape) for end in extent)
    room = np.where(high > low, 0.0, 0.5)  # a space with one point is none
    return low - room, high + room


def spread(bound: Any, shape: tuple[int, ...]) -> Floats:
    """Give one bound to each of the components, shape (n,)."""
    flat = np.asarray(bound, dtype=np.float64).ravel()
    return np.broadcast_to(flat, (int(np.prod(shape)),))


def _extent(model: SCM, space: Any, quantity: str) -> tuple[Any, Any]:
    match space:
        case None:
            return _COORDINATES.get(quantity, (-WIDE, WIDE))
        case Box():
            return _ends(model, space.low)[0], _ends(model, space.high)[1]
        case WholeNumbers():
            return space.low, space.high
        case Categories():
            return min(space.members), max(space.members)
        case Rotations():
            return -1.0, 1.0
        case _:  # the union of two spaces
            parts = [_extent(model, part, quantity) for part in (space.first, space.second)]
            (low_a, high_a), (low_b, high_b) = parts
            return np.minimum(low_a, low_b), np.maximum(high_a, high_b)


def _ends(model: SCM, bound: Any) -> tuple[Any, Any]:
    """Give the least and the greatest value that a bound can have."""
    match bound:
        case tuple():
            pairs = [_ends(model, part) for part in bound]
            return tuple(low for low, _ in pairs), tuple(high for _, high in pairs)
        case Affine():
            parents = [side[bound.index or 0] for side in bounds(model, bound.parent)]
            both = [bound.offset + bound.scale * float(parent) for parent in parents]
            return min(both), max(both)
        case Switch():
            return min(bound.below, bound.above), max(bound.below, bound.above)
        case _:
            return bound, bound


# --- corners --------------------------------------------------------------------------------------

KEYPOINTS = "keypoints"
"""What corners or a view are called among the parts of an observation."""

View = tuple[tuple[str, ...], int, Callable[[Values], Floats]]
"""Names of variables, how many numbers are computed from them, and the function that does so."""

CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
"""The corners of a box with edges of length 1, shape (8, 3)."""

_POSE = ("size", "cartesian_position", "orientation")


def corners(size: Floats, position: Floats, orientation: Floats) -> Floats:
    """Compute the corners of boxes.

    Args:
        size: Edge lengths, shape (..., 3) [m].
        position: Centers, shape (..., 3) [m].
        orientation: Quaternions (x, y, z, w), shape (..., 4).

    Returns:
        Shape (..., 8, 3) [m]; the last axis of the box changes fastest, from low to high.

    Example:
        >>> corners(np.array([2.0, 2.0, 2.0]), np.ones(3), np.array([0.0, 0.0, 0.0, 1.0]))[:2]
        array([[0., 0., 0.], [0., 0., 2.]])
    """
    local = CORNERS * np.asarray(size)[..., None, :]  # (..., 8, 3)
    turned = local @ np.swapaxes(rotation_matrix(np.asarray(orientation)), -1, -2)
    found: Floats = turned + np.asarray(position)[..., None, :]
    return found


def keypoints(bodies: tuple[str, ...]) -> View:
    """Describe the corners of some boxes: body by body, shape (24 n,) [m]."""

    def observe(now: Values) -> Floats:
        parts = [np.array([now[f"{body}.{part}"] for body in bodies]) for part in _POSE]
        return corners(*parts).ravel()

    names = tuple(f"{body}.{part}" for body in bodies for part in _POSE)
    return names, CORNERS.size * len(bodies), observe


# --- vectors --------------------------------------------------------------------------------------

STREAM = "observation"
"""The stream of the noise of the sensors; draws of ``sensor_noise`` itself have another one."""


@final
@dataclass(frozen=True)
class ObservedPart:
    """Some numbers of an observation that belong together.

    Attributes:
        name: The variable, or ``KEYPOINTS``.
        low: Lower bound of each number, shape (n,).
        high: Upper bound.
        sensed: Whether the noise of the sensors reaches it.
        saturates: Whether numbers beyond the bounds are cut off; else the bounds only scale.
    """

    name: str
    low: Floats
    high: Floats
    sensed: bool = True
    saturates: bool = True


@final
class Vector:
    """Where each variable stands in a vector, and how it is scaled.

    Args:
        world: That is observed.
        declaration: Of the structure for which the layout holds.
        parts: In their order.
        normalize: Whether the numbers are scaled to [-1, 1].
        keypoints: How corners or a view are computed, if they are a part.
        padded: Whether parts may be missing in the structure: their numbers are 0.

    Attributes:
        names: The variables that have to be computed.
        layout: Where each part stands.
        space: In which the observation lies.
    """

    def __init__(
        self,
        world: Simulation,
        declaration: CompiledTask,
        parts: Sequence[ObservedPart],
        *,
        normalize: bool,
        keypoints: View | None = None,
        padded: bool = False,
    ) -> None:
        self._world, self._keypoints = world, keypoints
        self._slices = _places(parts)
        self.layout = self._slices
        where = declaration.mechanisms.where
        self.names = tuple(part.name for part in parts if part.name in where)
        self.names += () if keypoints is None else keypoints[0]
        low = np.concatenate([part.low for part in parts])
        high = np.concatenate([part.high for part in parts])
        bounded = (low > -WIDE) & (high < WIDE)
        sensed = np.concatenate([np.full(part.low.size, part.sensed) for part in parts])
        there = np.concatenate(
            [np.full(part.low.size, part.name in (*where, KEYPOINTS)) for part in parts]
        )
        self._spread = np.where(bounded & sensed & there, (high - low) / 2.0, 0.0)
        self._size = low.size
        self._read = np.concatenate(
            [  # what is not there reads any column, times 0
                places([where[part.name]]) if part.name in where else np.zeros(part.low.size, int)
                for part in parts
                if part.name != KEYPOINTS
            ]
        )
        self._published = world.options.conventions.published
        self._turns = [
            place
            for name, place in self._slices.items()
            if self._published and name.endswith(".orientation")
        ]
        hard = np.concatenate([np.full(part.low.size, part.saturates) for part in parts])
        self._scale(low, high, normalize & bounded & (high > low), hard, padded=padded)
        if padded:
            self._scales[:, ~there] = [[-np.inf], [np.inf], [0.0], [0.0]]
        self._version = -1
        self._senses = SENSOR_NOISE in declaration.model
        self._noise = 0.0

    def _scale(
        self,
        low: Floats,
        high: Floats,
        scaled: NDArray[np.bool_],
        hard: NDArray[np.bool_],
        *,
        padded: bool,
    ) -> None:
        width = np.where(scaled, high - low, 2.0)
        gain = np.where(scaled, 2.0 / width, 1.0)
        offset = np.where(scaled, -low * gain - 1.0, 0.0)
        everything = np.full(low.size, np.inf)
        limits = (np.where(hard, low, -everything), np.where(hard, high, everything))
        limits = (-everything, everything) if self._published else limits
        self._scales = np.stack([*limits, gain, offset])
        inside = (np.where(scaled, -1.0, low), np.where(scaled, 1.0, high))
        inside = (np.where(hard, inside[0], -WIDE), np.where(hard, inside[1], WIDE))
        ends = limits if self._published else inside
        ends = (np.minimum(ends[0], 0.0), np.maximum(ends[1], 0.0)) if padded else ends
        self.space = box(*ends)
        world = self._world
        self._shift, self._shifts = 0.0, np.zeros(self._read.size)
        if self._published and TIME in self._slices and world.options.given_length is not None:
            # The predecessor subtracts seconds from a number of steps.
            self._shift = world.options.given_length * (1.0 - world.options.control_period)
            self._shifts[self._slices[TIME]] = self._shift

    @property
    def together(self) -> bool:
        """Whether several worlds can be observed in one call; not with corners of blocks."""
        return self._keypoints is None

    def observe(self, now: Rows) -> NDArray[np.float32]:
        """Return the observation of one world, shape (n,), or of several, shape (m, n).

        The noise of the sensors is that of one world.
        """
        numbers = now.numbers
        if numbers.ndim > 1:
            return self._scaled(numbers, self._read, self._shifts)
        if self._version != self._world.version:
            self._version = self._world.version
            self._noise = float(now[SENSOR_NOISE]) if self._senses else 0.0
        if self._keypoints is None and not self._noise:
            return self._scaled(numbers, self._read, self._shifts)
        raw = numbers.take(self._read)
        raw[self._shifts != 0.0] += self._shift
        if self._keypoints is not None:
            raw = np.insert(raw, self._slices[KEYPOINTS].start, self._keypoints[2](now))
        raw = self._sensed(raw) if self._noise else raw
        return self._scaled(raw, np.arange(raw.size), np.zeros(raw.size))

    def observe_values(self, values: Values) -> NDArray[np.float32]:
        """Give the observation of other values of what is observed, without noise, shape (n,)."""
        seen = {} if self._keypoints is None else {KEYPOINTS: self._keypoints[2](values)}
        given = {**values, **seen}
        absent = {n: np.zeros(s.stop - s.start) for n, s in self._slices.items() if n not in given}
        raw = np.concatenate([np.ravel({**given, **absent}[name]) for name in self._slices])
        return self._scaled(raw, np.arange(raw.size), np.zeros(raw.size))

    def _scaled(self, numbers: Floats, columns: Integers, shifts: Floats) -> NDArray[np.float32]:
        """Observe columns of the values of one world, shape (width,), or of several."""
        single = numbers.ndim == 1
        matrix, rows = (numbers[None], FIRST) if single else (numbers, np.arange(len(numbers)))
        found: NDArray[np.float32] = np.empty((len(rows), self._size), dtype=np.float32)
        scale_rows(matrix, rows, columns, shifts, self._scales, found)
        for place in self._turns:
            found[:, place] *= _signs(found[:, place])
        shown: NDArray[np.float32] = found[0] if single else found
        return shown

    def _sensed(self, raw: Floats) -> Floats:
        """Add the noise of the sensors, the same whenever this instant is observed."""
        key = self._world.noise_key(self._world.index)
        drawn: Any = key.draw(Normal(), STREAM, raw.shape, {})
        noisy: Floats = raw + self._noise * self._spread * drawn
        return noisy


def box(low: Floats, high: Floats) -> gymnasium.Space[NDArray[np.float32]]:
    """Give a space of 32-bit floats."""
    bounds: Any = (low.astype(np.float32), high.astype(np.float32))
    return gymnasium.spaces.Box(*bounds, dtype=np.float32)


def _signs(turns: NDArray[np.float32]) -> Floats:
    """Give the signs with which quaternions (x, y, z, w) are read from a rotation matrix.

    The predecessor's backend does so: w is positive where the trace of the matrix is, which is up
    to 120°; beyond, the greatest of the other three is.

    Args:
        turns: Shape (n, 4), of any length.

    Returns:
        1 or -1, shape (n, 1).
    """
    near = 4.0 * turns[:, 3] ** 2 > (turns**2).sum(axis=1)
    first = np.where(near, 3, np.abs(turns[:, :3]).argmax(axis=1))
    return np.where(turns[np.arange(len(turns)), first] < 0.0, -1.0, 1.0)[:, None]


def _places(parts: Sequence[ObservedPart]) -> dict[str, slice]:
    ends = np.cumsum([part.low.size for part in parts])
    pairs = zip(parts, ends, strict=True)
    return {part.name: slice(int(end) - part.low.size, int(end)) for part, end in pairs}
