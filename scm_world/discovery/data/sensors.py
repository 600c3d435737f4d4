"""What sensors make of the values of a world: the noise that ``sensor_noise`` asks for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, final

import numpy as np

from scm_world._types import Floats
from scm_world.env.bounds import WIDE, bounds, spread
from scm_world.env.observer import published
from scm_world.errors import UnknownOption
from scm_world.queries.episodes import Episode
from scm_world.queries.outcomes import Outcome
from scm_world.variables import Noise, Normal
from scm_world.variables.reserved import SENSOR_NOISE
from scm_world.world import World

STREAM = "sensor of"
"""Begins the names of the streams; draws of ``sensor_noise`` itself have another one."""

NORMAL = Normal()


@final
class Sensors:
    """Reads variables off episodes, as the sensors of the world give them.

    Its parameter ``sensor_noise`` is the standard deviation, as a fraction of half the range of a
    number, as in the observations of the environment. It reaches real states and readouts that
    have bounds: no parameters, no actions, no counts.

    Args:
        world: That is watched.
        names: Of the variables that are read.
    """

    def __init__(self, world: World, names: Iterable[str]) -> None:
        sensed = tuple(names) if SENSOR_NOISE in world.model else ()
        self._half = {name: half_range(world, name) for name in sensed}

    def read(self, episode: Episode, outcome: Outcome) -> Floats:
        """Read what an episode came to."""
        if not self._is_noisy(episode, outcome.name):
            return _finite(outcome, outcome.of(episode))
        match outcome.how:
            case "final":
                steps: Iterable[int] = (episode.steps,)
            case "first":
                steps = (0,)
            case "change":
                steps = (0, episode.steps)
            case _:
                steps = range(1, episode.steps + 1)
        seen: Mapping[str, Any] = {outcome.name: self._sensed(episode, outcome.name, steps)}
        return _finite(outcome, outcome.of(seen))  # type: ignore[arg-type] # it is indexed only

    def instants(self, episode: Episode, name: str) -> Floats:
        """Read a variable at every instant, shape ``(steps + 1, *shape)``."""
        if not self._is_noisy(episode, name):
            return np.asarray(episode[name], dtype=np.float64)
        return self._sensed(episode, name, range(episode.steps + 1))

    def _is_noisy(self, episode: Episode, name: str) -> bool:
        half = self._half.get(name)
        return half is not None and bool(half.any()) and bool(np.any(episode[SENSOR_NOISE]))

    def _sensed(self, episode: Episode, name: str, steps: Iterable[int]) -> Floats:
        """Add noise at some instants; the same whatever else is read, and when."""
        values = np.array(episode[name], dtype=np.float64)
        noise, strength = Noise(episode.seed), episode[SENSOR_NOISE]
        half, shape = self._half[name], values.shape[1:]
        stream = f"{STREAM} {name}"
        for step in steps:
            drawn = noise.draw(NORMAL, stream, shape, {}, episode=episode.number, step=step)
            values[step] += float(strength[step]) * half.reshape(shape) * drawn[0]
        return values


def half_range(world: World, name: str) -> Floats:
    """Give half the range of each number of a variable that a sensor measures, shape (k,).

    It is that of the environment's observations. 0 where there is none, or no sensor.
    """
    variable = world.model.declared(name)
    if variable.role not in ("state", "readout") or variable.dtype != "real":
        return np.zeros(int(np.prod(variable.shape)))
    low, high = bounds(world.model, name)
    observed = published(world, world.compiled).get(name)
    if observed is not None and observed.low is not None:
        low, high = spread(observed.low, variable.shape), spread(observed.high, variable.shape)
    return np.where((low > -WIDE) & (high < WIDE), (high - low) / 2.0, 0.0)


def _finite(outcome: Outcome, value: Floats) -> Floats:
    if not np.isfinite(value).all():
        raise UnknownOption(f"value of {outcome}", value, ("finite numbers",))
    return value
