"""Observations that are one vector of numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats, Value
from scm_world.entities.stage import SENSOR_NOISE
from scm_world.env.bounds import WIDE
from scm_world.env.keypoints import KEYPOINTS, Keypoints
from scm_world.geometry.direct import direct
from scm_world.geometry.gather import gather_scaled, places
from scm_world.tasks import TIME
from scm_world.variables import Normal
from scm_world.world import World
from scm_world.world.declaration import Declaration

Layouts = Mapping[str, Mapping[str, slice]]
"""Where each variable stands, for every vector by its name."""

NOTHING = places(())

STREAM = "observation"
"""The stream of the noise of the sensors; draws of ``sensor_noise`` itself have another one."""


@final
@dataclass(frozen=True)
class Part:
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
        keypoints: Where the corners come from, if they are a part.

    Attributes:
        names: The variables that have to be computed.
        layouts: Where each part stands, under the name of the vector.
        space: In which the observation lies.
    """

    def __init__(
        self,
        world: World,
        declaration: Declaration,
        parts: Sequence[Part],
        *,
        normalize: bool,
        keypoints: Keypoints | None = None,
    ) -> None:
        self._world, self._keypoints = world, keypoints
        self._slices = _places(parts)
        self.layouts: Layouts = {"observation": self._slices}
        self.names = tuple(part.name for part in parts if part.name != KEYPOINTS)
        self.names += () if keypoints is None else keypoints.names
        low = np.concatenate([part.low for part in parts])
        high = np.concatenate([part.high for part in parts])
        bounded = (low > -WIDE) & (high < WIDE)
        sensed = np.concatenate([np.full(part.low.size, part.sensed) for part in parts])
        self._spread = np.where(bounded & sensed, (high - low) / 2.0, 0.0)
        self._raw = np.empty(low.size)
        self._arrange(declaration)
        self._published = world.conventions.published_observation
        hard = np.concatenate([np.full(part.low.size, part.saturates) for part in parts])
        self._scale(low, high, normalize & bounded & (high > low), hard)
        self._version = -1
        self._senses = SENSOR_NOISE in declaration.model
        self._noise = 0.0

    def _arrange(self, declaration: Declaration) -> None:
        """Sort the parts by how they are read."""
        still, states = set(declaration.static_names), declaration.slices
        fields = [(n, where) for n, where in self._slices.items() if n != KEYPOINTS]
        read = [(where, states[n]) for n, where in fields if n in states]
        self._read = (places(at for _, at in read), places(where for where, _ in read))
        views = [
            (n, self._raw[where].reshape(declaration.model.declared(n).shape))
            for n, where in fields
            if n not in states
        ]
        self._still = [view for view in views if view[0] in still]
        computed = [view for view in views if view[0] not in still]
        self._computed = [view for view in computed if view[1].ndim]
        self._single = [(n, self._slices[n].start) for n, view in computed if not view.ndim]

    def _scale(
        self, low: Floats, high: Floats, scaled: NDArray[np.bool_], hard: NDArray[np.bool_]
    ) -> None:
        width = np.where(scaled, high - low, 2.0)
        gain = np.where(scaled, 2.0 / width, 1.0)
        offset = np.where(scaled, -low * gain - 1.0, 0.0)
        everything = np.full(low.size, np.inf)
        limits = (np.where(hard, low, -everything), np.where(hard, high, everything))
        limits = (-everything, everything) if self._published else limits
        self._scales = np.stack([*limits, gain, offset])
        single = np.empty(0, dtype=np.float32)
        like = (self._raw, *self._read, self._raw, self._scales, single)
        self._write = direct(gather_scaled, *like)
        inside = (np.where(scaled, -1.0, low), np.where(scaled, 1.0, high))
        inside = (np.where(hard, inside[0], -WIDE), np.where(hard, inside[1], WIDE))
        self.space = box(*(limits if self._published else inside))
        world = self._world
        self._shift = 0.0
        if self._published and TIME in self._slices and world.given_length is not None:
            # The predecessor subtracts seconds from a number of steps.
            self._shift = world.given_length * (1.0 - world.control_period)

    def observe(self, now: Mapping[str, Value]) -> NDArray[np.float32]:
        """Write the observation, shape (n,)."""
        raw = self._raw
        if self._version != self._world.version:
            self._version = self._world.version
            self._noise = float(now[SENSOR_NOISE]) if self._senses else 0.0
            for name, place in self._still:
                place[...] = now[name]
        for name, place in self._computed:
            place[...] = now[name]
        for name, index in self._single:
            raw[index] = now[name]
        if self._keypoints is not None:
            raw[self._slices[KEYPOINTS]] = self._keypoints.observe(now)
        if self._shift:
            raw[self._slices[TIME]] += self._shift
        vector = self._world.current()[1].vector
        observation = np.empty(raw.size, dtype=np.float32)
        self._write(vector, *self._read, raw, self._scales, observation)
        if self._noise:
            self._write(vector, NOTHING, NOTHING, self._sensed(raw), self._scales, observation)
        return observation

    def _sensed(self, raw: Floats) -> Floats:
        """Add the noise of the sensors, the same whenever this instant is observed."""
        moment = self._world.moment(self._world.index)
        drawn: Any = moment.draw(Normal(), STREAM, raw.shape, {})
        noisy: Floats = raw + self._noise * self._spread * drawn
        return noisy


def box(low: Floats, high: Floats) -> gymnasium.Space[NDArray[np.float32]]:
    """Give a space of 32-bit floats."""
    bounds: Any = (low.astype(np.float32), high.astype(np.float32))
    return gymnasium.spaces.Box(*bounds, dtype=np.float32)


def _places(parts: Sequence[Part]) -> dict[str, slice]:
    ends = np.cumsum([part.low.size for part in parts])
    pairs = zip(parts, ends, strict=True)
    return {part.name: slice(int(end) - part.low.size, int(end)) for part, end in pairs}
