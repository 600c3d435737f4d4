"""The cross-entropy method: sampling, keeping the best, sampling around them.

Source:
    Rubinstein, *The cross-entropy method for combinatorial and continuous optimization*, 1999; with
    noise that is correlated in time, elites that are kept, and a mean that is shifted, as in
    Pinneri et al., *Sample-efficient cross-entropy method for real-time planning*, CoRL 2020.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import Floats
from scm_world.errors import UnknownOption
from scm_world.variables import Noise, Normal

KEPT = 0.3
"""Share of the elites that take part in the next round again."""


@final
@dataclass(frozen=True)
class Search:
    """The numbers of a search.

    Attributes:
        samples: Sequences of actions in each round.
        horizon: Their length in control steps.
        iterations: Rounds.
        elites: How many of the best ones the next round is drawn around; a sixth of the samples if
            None.
        spread: Standard deviation of the first round, as a share of half the range of an action.
        color: How much noise is correlated in time: its power falls with this power of the
            frequency. 0 is white noise, 2 that of a random walk.
        momentum: Share of the old mean and standard deviation in the new ones.

    Raises:
        UnknownOption: A number is none, or out of its range.
    """

    samples: int = 48
    horizon: int = 12
    iterations: int = 2
    elites: int | None = None
    spread: float = 0.1
    color: float = 3.0
    momentum: float = 0.1

    def __post_init__(self) -> None:
        for name, least in (("samples", 2), ("horizon", 1), ("iterations", 1)):
            whole_number(name, getattr(self, name), least=least)
        if self.elites is not None and whole_number("elites", self.elites, least=1) > self.samples:
            raise UnknownOption("elites", self.elites, (f"1 to {self.samples}, the samples",))
        for name, low, high in (
            ("spread", 0.0, 10.0),
            ("color", 0.0, 10.0),
            ("momentum", 0.0, 1.0),
        ):
            _check(name, getattr(self, name), low, high)

    @property
    def n_elites(self) -> int:
        """How many samples are elites."""
        return self.elites or max(1, self.samples // 6)

    def noise(self, noise: Noise, stream: str, n: int, *, episode: int, step: int) -> Floats:
        """Draw noise of variance one that is correlated in time.

        Args:
            noise: Where to draw.
            stream: Of the noise.
            n: How many numbers an action has.
            episode: Number of the episode.
            step: The control step.

        Returns:
            Shape (samples, horizon, n).
        """
        length = self.horizon
        frequencies = np.fft.rfftfreq(length)
        frequencies[0] = 1.0 / length
        size = frequencies ** (-0.5 * self.color)
        counts = np.full(len(size), 4.0)  # a frequency stands for its negative one, too
        counts[0] = 1.0
        if length % 2 == 0:
            counts[-1] = 1.0
        size *= length / math.sqrt(float((counts * size**2).sum()))
        shape = (self.samples, n, 2, len(size))
        drawn = noise.draw(Normal(), stream, shape, {}, episode=episode, step=step)[0]
        waves = (drawn[:, :, 0] + 1j * drawn[:, :, 1]) * size
        return np.asarray(np.fft.irfft(waves, length, axis=-1)).swapaxes(1, 2)


@final
@dataclass(frozen=True)
class Found:
    """What a search has found.

    Attributes:
        actions: The best sequence, shape (horizon, n_actions).
        score: Its score.
        mean: Of the elites, shape (horizon, n_actions).
        elites: The best sequences, shape (k, horizon, n_actions), best first.
    """

    actions: Floats
    score: float
    mean: Floats
    elites: Floats

    def later(self, steps: int) -> Found:
        """Give what is left of it after some control steps; the last action is kept."""
        return Found(
            _later(self.actions, steps),
            self.score,
            _later(self.mean, steps),
            _later(self.elites, steps),
        )


def search(
    setting: Search,
    evaluate: Callable[[Floats], Floats],
    noise: Callable[[int], Floats],
    bounds: tuple[Floats, Floats],
    start: Found,
) -> Found:
    """Look for the sequence of actions with the highest score.

    Args:
        setting: The numbers of the search.
        evaluate: Scores sequences, shape (n, horizon, n_actions) with up to as many as there are
            samples; gives shape (n,).
        noise: Gives that of a round, see ``Search.noise``.
        bounds: Lower and upper end of an action, shape (n_actions,) each.
        start: What is known already; the first round is drawn around its mean.

    Returns:
        The best sequence that was tried, the last mean among them, and what a search that goes on
        needs.
    """
    low, high = bounds
    mean, kept = start.mean, start.elites
    std = np.broadcast_to(0.5 * setting.spread * (high - low), mean.shape)
    best = start
    keep = math.ceil(KEPT * setting.n_elites)
    for round_ in range(setting.iterations):
        tried = mean + std * noise(round_)
        tried[0] = mean
        again = kept[: min(keep, setting.samples - 1)]
        tried[1 : 1 + len(again)] = again
        tried = np.clip(tried, low, high)
        scores = evaluate(tried)
        order = np.argsort(-scores, kind="stable")[: setting.n_elites]
        kept = tried[order]
        if round_ == 0 or scores[order[0]] > best.score:
            best = Found(kept[0], float(scores[order[0]]), mean, kept)
        old = setting.momentum
        mean = old * mean + (1.0 - old) * kept.mean(axis=0)
        std = old * std + (1.0 - old) * kept.std(axis=0)
    middle = np.clip(mean, low, high)
    score = float(evaluate(middle[None])[0])
    if score > best.score:
        return Found(middle, score, mean, kept)
    return Found(best.actions, best.score, mean, kept)


def _later(actions: Floats, steps: int) -> Floats:
    """Shift sequences, shape (..., horizon, n_actions)."""
    length = actions.shape[-2]
    found: Floats = actions[..., np.minimum(np.arange(length) + steps, length - 1), :]
    return found


def _check(name: str, value: Any, low: float, high: float) -> None:
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not is_number or not np.isfinite(value) or not low <= value <= high:
        raise UnknownOption(name, value, (f"a number from {low:g} to {high:g}",))
