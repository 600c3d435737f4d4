"""The counter-based generator Philox 4x64-10, compiled.

Source:
    Salmon et al., *Parallel random numbers: as easy as 1, 2, 3*, SC 2011.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats, Integers
from scm_world.geometry.numbers import njit
from scm_world.variables import Noise
from scm_world.variables.distributions import word_of
from scm_world.variables.moments import NoiseKey, stream_of

Words = NDArray[np.uint64]

_MULTIPLIERS = np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157)
_INCREMENTS = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBB67AE8584CAA73B)
_LOW, _HALF, _LAST, _ONE = np.uint64(0xFFFFFFFF), np.uint64(32), np.uint64(11), np.uint64(1)


@njit(cache=True)
def _high(a: np.uint64, b: np.uint64) -> np.uint64:
    """Multiply two words of 64 bits; return the upper 64 bits of the product."""
    a0, a1, b0, b1 = a & _LOW, a >> _HALF, b & _LOW, b >> _HALF
    middle = a1 * b0 + (a0 * b0 >> _HALF)
    return a1 * b1 + (middle >> _HALF) + ((a0 * b1 + (middle & _LOW)) >> _HALF)


@njit("void(u8[::1], u8[::1], f8[:, ::1])", cache=True)
def philox(where: Words, keys: Words, out: Floats) -> None:
    """Write the uniform numbers of several streams, as ``Noise.uniforms`` does for one episode.

    Args:
        where: Key of the seed, episode and control step, shape (3,).
        keys: Keys of the streams, shape (m,).
        out: The result, shape (m, n).
    """
    n = out.shape[1]
    blocks = np.uint64((n + 3) // 4)
    for row in range(out.shape[0]):
        counter = where[1] * blocks
        for block in range((n + 3) // 4):
            counter += _ONE
            c0, c1, c2, c3 = counter, where[2], np.uint64(0), np.uint64(0)
            k0, k1 = where[0], keys[row]
            for _ in range(10):
                h0, l0 = _high(_MULTIPLIERS[0], c0), _MULTIPLIERS[0] * c0
                h1, l1 = _high(_MULTIPLIERS[1], c2), _MULTIPLIERS[1] * c2
                c0, c1, c2, c3 = h1 ^ c1 ^ k0, l1, h0 ^ c3 ^ k1, l0
                k0, k1 = k0 + _INCREMENTS[0], k1 + _INCREMENTS[1]
            words = (c0, c1, c2, c3)
            for i in range(min(4, n - 4 * block)):
                out[row, 4 * block + i] = np.float64(words[i] >> _LAST) * 2.0**-53


@njit("void(u8[:, ::1], u8[::1], f8[:, :, ::1])", cache=True)
def _philox_of_many(where: Words, keys: Words, out: Floats) -> None:
    for world in range(where.shape[0]):
        philox(where[world], keys, out[world])


@lru_cache(maxsize=2**8)
def words_of(name: str, stream: str | None, attempts: range) -> Any:
    """Return the keys of the streams of several attempts to draw a variable, shape (attempts,)."""
    return np.array([word_of(stream_of(name, stream, n)) for n in attempts], dtype=np.uint64)


def uniforms(key: NoiseKey | NDArray[np.uint64], words: NDArray[np.uint64], n: int) -> Floats:
    """Draw numbers of several streams, given by their keys, at one control step: (streams, n).

    ``key`` is a noise key; or has the keys of the seeds, the episodes and the control steps of
    several worlds, shape (worlds, 3), and then the numbers have shape (worlds, streams, n).
    """
    if not isinstance(key, NoiseKey):
        many = np.empty((len(key), len(words), n))
        _philox_of_many(key, words, many)
        return many
    found = np.empty((len(words), n))
    philox(np.array([key.noise.key, key.episode, key.step], dtype=np.uint64), words, found)
    return found


@final
class CompiledNoise(Noise):
    """The noise of one seed; single episodes are drawn by the compiled generator, with equal bits.

    Args:
        seed: Any whole number that is not negative.
    """

    def uniforms(
        self, variable: str, *, n: int, episode: int = 0, step: int = 0, count: int = 1
    ) -> Floats:
        """Draw the uniform numbers of a variable, shape ``(count, n)``; see ``Noise``."""
        if count != 1:
            return super().uniforms(variable, n=n, episode=episode, step=step, count=count)
        found = np.empty((1, n))
        where = np.array([self.key, episode, step], dtype=np.uint64)
        philox(where, np.array([word_of(variable)], dtype=np.uint64), found)
        return found


@final
class NoiseOfRows(Noise):
    """The noise of several episodes that are drawn together, each with its own seed.

    Each episode has the numbers that it has alone, bit for bit.

    Args:
        seeds: The seed of each episode, or of all.
        count: Number of episodes.
    """

    def __init__(self, seeds: int | Sequence[int], count: int) -> None:
        given = seeds if isinstance(seeds, Sequence | np.ndarray) else [seeds]
        whole = [s if type(s) is int and s >= 0 else CompiledNoise(s).seed for s in given]
        seed = tuple(whole * count if len(whole) < count else whole)
        where = np.zeros((count, 3), dtype=np.uint64)
        where[:, 0] = [word_of(f"seed {seed}") for seed in whole]
        vars(self).update(seed=seed, where=where, at=None)

    def uniforms(
        self, variable: str, *, n: int, episode: int | Integers = 0, step: int = 0, count: int = 1
    ) -> Floats:
        """Draw the uniform numbers of a variable, shape ``(count, n)``; ``episode`` has as many."""
        found, kept = np.empty((count, 1, n)), vars(self)
        where, at = kept["where"], kept["at"]
        if at is None or at[0] is not episode or at[1] != step:
            where[:, 1], where[:, 2] = episode, step
            kept["at"] = episode, step
        _philox_of_many(where, np.array([word_of(variable)], dtype=np.uint64), found)
        return found[:, 0]
