"""Observations that are one vector of numbers."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from scm_world._types import ArrayLike, Floats, Values
from scm_world.geometry.numbers import scale_rows
from scm_world.graph import SCM
from scm_world.tasks import TIME
from scm_world.variables import Box, Categories, Normal, Rotations
from scm_world.variables import Integers as WholeNumbers
from scm_world.variables.reserved import SENSOR_NOISE
from scm_world.world import Simulation
from scm_world.world.compiled_task import CompiledTask
from scm_world.world.mechanisms import Rows, places

# --- bounds ---------------------------------------------------------------------------------------

WIDE = float(np.finfo(np.float32).max)
"""Stands for no bound: Gymnasium requires finite ones, and no 32-bit number lies beyond."""

_COORDINATES: dict[str, tuple[Any, Any]] = {
    "cylindrical_position": ((0.0, -np.pi, -1.0), (1.5, np.pi, 1.0)),  # [m, rad, m]
    "euler_orientation": (-np.pi, np.pi),  # [rad]
}
"""Other coordinates of a pose declare no bounds: those of the pose hold for them."""


def bounds(model: SCM, name: str) -> tuple[Floats, Floats]:
    """Return the bounds of every component of a variable.

    A declared bound that follows another variable has its widest value.

    Returns:
        Lower and upper bound, shape (n,) each; ``∓WIDE`` where none is declared.
    """
    variable = model.declared(name)
    extent = _extent(model, variable.bounds, name.rpartition(".")[2], variable.shape)
    low, high = (spread(np.clip(end, -WIDE, WIDE), variable.shape) for end in extent)
    room = np.where(high > low, 0.0, 0.5)  # a space of one point has no room
    return low - room, high + room


def spread(bound: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """Return one bound for each of the components, shape (n,)."""
    flat = np.asarray(bound, dtype=np.float64).ravel()
    return np.broadcast_to(flat, (int(np.prod(shape)),))


def _extent(model: SCM, space: Any, quantity: str, shape: tuple[int, ...]) -> tuple[Any, Any]:
    match space:
        case None:
            return _COORDINATES.get(quantity, (-WIDE, WIDE))
        case WholeNumbers():
            return space.low, space.high
        case Categories():
            return min(space.members), max(space.members)
        case Rotations():
            return -1.0, 1.0
        case Box():
            followed = {
                name: [end.reshape(model.declared(name).shape) for end in bounds(model, name)]
                for name in sorted(space.parents())
            }
            found = [
                space.bounds(shape, dict(zip(followed, ends, strict=True)))
                for ends in itertools.product(*followed.values())
            ]
        case _:  # the union of two spaces
            found = [_extent(model, one, quantity, shape) for one in (space.first, space.second)]
    lows, highs = zip(*found, strict=True)
    return reduce(np.minimum, lows), reduce(np.maximum, highs)


# --- vectors --------------------------------------------------------------------------------------

KEYPOINTS = "keypoints"
"""What the view of a hand is called among the parts of an observation."""

View = tuple[tuple[str, ...], int, Callable[[Values], Floats]]
"""Names of variables, how many numbers are computed from them, and the function that does so."""

SINGLE = np.dtype(np.float32)

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
        declaration: The structure for which the layout holds.
        parts: In their order.
        how: The options of the environment: ``normalize_observations``, and ``pad``, with which
            parts may be missing in the structure: their numbers are 0.
        view: How the view of a hand is computed, if it is a part.

    Attributes:
        names: The variables that have to be computed.
        layout: Where each part stands.
        appended: The parts that the noise of the sensors does not reach: parameters.
        space: In which the observation lies.
        together: Whether several worlds can be observed in one call.
    """

    def __init__(
        self,
        world: Simulation,
        declaration: CompiledTask,
        parts: Sequence[ObservedPart],
        how: Mapping[str, Any],
        view: View | None = None,
    ) -> None:
        self._world, self._view, self.together = world, view, view is None
        sizes = [part.low.size for part in parts]
        ends = zip(parts, np.cumsum(sizes).tolist(), strict=True)
        self.layout = {part.name: slice(end - part.low.size, end) for part, end in ends}
        self.appended = tuple(part.name for part in parts if not part.sensed)
        where, options = declaration.where, world.options
        self.names = tuple(part.name for part in parts if part.name in where)
        self.names += () if view is None else view[0]
        low = np.concatenate([part.low for part in parts])
        high = np.concatenate([part.high for part in parts])
        bounded = (low > -WIDE) & (high < WIDE)
        sensed = np.repeat([part.sensed for part in parts], sizes)
        there = np.repeat([part.name in (*where, KEYPOINTS) for part in parts], sizes)
        self._spread = np.where(bounded & sensed & there, (high - low) / 2.0, 0.0)
        self._read = np.concatenate(
            [  # an absent body reads any column, times 0
                places([where[part.name]]) if part.name in where else np.zeros(part.low.size, int)
                for part in parts
                if part.name != KEYPOINTS
            ]
        )
        shifts, self._turns = np.zeros(low.size), list[slice]()
        hard = np.repeat([part.saturates for part in parts], sizes)
        beyond = WIDE
        if options.conventions.published:
            hard, beyond = np.zeros(low.size, bool), np.inf
            self._turns = [at for n, at in self.layout.items() if n.endswith(".orientation")]
            if TIME in self.layout and options.given_length is not None:
                # The predecessor subtracts seconds from a number of steps.
                shift = options.given_length * (1.0 - options.control_period)
                shifts[self.layout[TIME]] = shift
        scaled = bool(how["normalize_observations"]) & bounded & (high > low)
        gain = np.where(scaled, 2.0 / np.where(scaled, high - low, 2.0), 1.0)
        offset = np.where(scaled, -low * gain - 1.0, 0.0)
        limits = np.where(hard, low, -np.inf), np.where(hard, high, np.inf)
        columns = np.arange(low.size) if view is not None else self._read
        self._scales = np.stack([*limits, gain, offset, shifts, columns])
        least = np.where(hard, np.where(scaled, -1.0, low), -beyond)
        most = np.where(hard, np.where(scaled, 1.0, high), beyond)
        if how["pad"] is not None:
            self._scales[:, ~there] = [[-np.inf], [np.inf], [0.0], [0.0], [0.0], [0.0]]
            least, most = np.minimum(least, 0.0), np.maximum(most, 0.0)
        self.space = box(least, most)
        self._noise = where[SENSOR_NOISE].start if SENSOR_NOISE in where else None

    def observe(self, now: Rows) -> NDArray[np.float32]:
        """Return the observation of one world, shape (n,), or of several, shape (m, n).

        The noise of the sensors is that of one world, the same whenever an instant is observed.
        """
        matrix, single = now.matrix, now.numbers.ndim == 1
        noise = now.numbers.item(self._noise) if single and self._noise is not None else 0.0
        if not (single and (noise or self._view is not None)):
            size = self._spread.size
            found: NDArray[np.float32] = np.empty(size if single else (len(matrix), size), SINGLE)
            scale_rows(matrix, self._scales, found if single else found.reshape(-1))
            if self._turns:
                self._turn(found.reshape(-1, size))
            return found
        world, raw = self._world, now.numbers.take(self._read)
        if self._view is not None:
            raw = np.insert(raw, self.layout[KEYPOINTS].start, self._view[2](now))
        raw = raw + self._scales[4]
        if noise:
            drawn: Any = world.noise_key(world.index).draw(Normal(), STREAM, raw.shape, {})
            raw = raw + noise * self._spread * drawn
        return self._of(raw)

    def on_columns(self, made: Callable[[Floats], Any]) -> Callable[..., Any] | None:
        """Return what observes columns of values, shape (width, n), as an array (n, k).

        It takes the numbers that the noise of the sensors scales, too, shape (n, k).

        None if that cannot be: a view of a hand, or the signs of the predecessor's quaternions.

        Args:
            made: Makes an array of the library of the columns.
        """
        if self._turns or self._view is not None:
            return None
        shifts = np.where(self._scales[4] == 0.0, -0.0, self._scales[4])  # it changes no zero
        low, high, gain, offset, more = (made(one[:, None]) for one in (*self._scales[:4], shifts))
        where, spread = self._scales[5].astype(int), made(self._spread[:, None])

        def observe(table: Any, drawn: Any = None) -> Any:
            raw = table[where] + more
            if drawn is not None:
                raw = raw + table[self._noise] * spread * drawn.T
            return (raw.clip(low, high) * gain + offset).T

        return observe

    def observe_values(self, values: Values) -> NDArray[np.float32]:
        """Return the observation of other values, without noise, shape (n,)."""
        given = {n: np.zeros(at.stop - at.start) for n, at in self.layout.items()} | {**values}
        if self._view is not None:
            given[KEYPOINTS] = self._view[2](values)
        return self._of(np.concatenate([np.ravel(given[name]) for name in self.layout]))

    def numbers(self, observation: ArrayLike) -> Floats:
        """Return what the first numbers of an observation show, in SI units, shape (n,)."""
        _, _, gain, offset, shifts, _ = self._scales
        shown = np.asarray(observation, np.float64)[: gain.size]
        return np.asarray((shown - offset) / gain - shifts)

    def _of(self, raw: Floats) -> NDArray[np.float32]:
        """Observe the numbers themselves, shape (n,)."""
        scales = np.vstack([self._scales[:4], np.zeros(raw.size), np.arange(raw.size)])
        found: NDArray[np.float32] = np.empty(raw.size, SINGLE)
        scale_rows(raw[None], scales, found)
        self._turn(found[None])
        return found

    def _turn(self, found: NDArray[np.float32]) -> None:
        """Set the signs of quaternions (x, y, z, w) to those of the predecessor, shape (m, n).

        Its backend reads them from a rotation matrix: w is positive where its trace is, up to 120°;
        beyond, the greatest of the other three is.
        """
        for place in self._turns:
            turns = found[:, place]
            near = 4.0 * turns[:, 3] ** 2 > (turns**2).sum(axis=1)
            first = np.where(near, 3, np.abs(turns[:, :3]).argmax(axis=1))
            turns[turns[np.arange(len(turns)), first] < 0.0] *= -1.0


def box(low: Floats, high: Floats) -> gymnasium.spaces.Box[np.float32]:
    """Return a space of 32-bit floats."""
    bounds: tuple[Any, Any] = (low.astype(np.float32), high.astype(np.float32))
    return gymnasium.spaces.Box(*bounds, dtype=np.float32)
