"""Kinds of state to experiment in, as a task knows them, and the random numbers to draw them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

from scm_world._types import Floats, Value
from scm_world.variables import Noise

_DRAWS = 96


@final
class Dice:
    """The random numbers of one probe state.

    They depend on seed, probe and attempt only, not on what was drawn before.

    Args:
        noise: The seed's noise.
        probe: Number of the probe state.
        attempt: Counts up where a choice was not feasible.
    """

    def __init__(self, noise: Noise, probe: int, attempt: int = 0) -> None:
        self._noise, self._probe, self._attempt = noise, probe, attempt
        self._numbers = self.of("probe", _DRAWS)
        self._used = 0

    def between(self, low: float, high: float, n: int | None = None) -> Any:
        """Draw one number, or an array of ``n``; at most 96 in all."""
        count = 1 if n is None else n
        drawn = self._numbers[self._used : self._used + count]
        self._used += count
        scaled = low + (high - low) * drawn
        return float(scaled[0]) if n is None else scaled

    def of(self, stream: str, n: int) -> Floats:
        """Draw numbers in [0, 1) that belong to a name, shape (n,)."""
        drawn = self._noise.uniforms(stream, n=n, episode=self._probe, step=self._attempt)
        found: Floats = drawn[0]
        return found


@final
@dataclass(frozen=True)
class Scenario:
    """A kind of probe state.

    Attributes:
        name: How the state comes about.
        prepare: Chooses what to set in a world that has just been reset. It may let the world go
            on before. What else it gives is handed to ``act``.
        act: Gives an action, shape (n_actions,).
        steps: How many control steps are taken before the experiments; drawn from 0 to 2 if None.
        fresh: Whether what was set counts as what was there: experiments then do not add up with
            it to one intervention, and are faster.
    """

    name: str
    prepare: Callable[[Any, Dice], tuple[dict[str, Value], Any]]
    act: Callable[[Any, Any, Dice], Floats]
    steps: int | None = None
    fresh: bool = False
