"""Keyed noise: every draw is a function of (seed, variable, episode, step).

The streams are counter-based (Philox), so a draw does not depend on earlier draws, on the number of
worlds or workers, or on the order of calls. Nothing touches a global generator.

Source:
    Salmon et al., *Parallel random numbers: as easy as 1, 2, 3*, SC 2011.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import Floats, Value, Values
from scm_world.variables.distributions import Distribution

_WORDS = 4  # 64-bit words that one increment of the Philox counter yields


@lru_cache(maxsize=2**16)
def word_of(text: str) -> int:
    """Return the 64 bits by which a name selects a stream."""
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")


@dataclass(frozen=True)
class Noise:
    """All the noise of one seed.

    Attributes:
        seed: Any whole number that is not negative.

    Example:
        >>> noise = Noise(7)
        >>> both = noise.uniforms("mass", episode=0, n=2, count=2)
        >>> bool((noise.uniforms("mass", episode=1, n=2) == both[1:]).all())
        True
    """

    seed: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "seed", whole_number("seed", self.seed, least=0))

    @cached_property
    def key(self) -> int:
        """The 64 bits by which the seed selects its streams."""
        return word_of(f"seed {self.seed}")

    def uniforms(
        self, variable: str, *, n: int, episode: int = 0, step: int = 0, count: int = 1
    ) -> Floats:
        """Draw uniform numbers of a variable in [0, 1), ``n`` for each episode.

        ``count`` episodes in a row have rows of their own: the shape is ``(count, n)``.
        """
        if n == 0:
            return np.empty((count, 0))
        blocks = -(-n // _WORDS)
        generator = np.random.Philox(
            key=np.array([self.key, word_of(variable)], dtype=np.uint64),
            counter=np.array([episode * blocks, step, 0, 0], dtype=np.uint64),
        )
        raw = generator.random_raw(count * blocks * _WORDS)
        words = np.asarray(raw, dtype=np.uint64).reshape(count, blocks * _WORDS)[:, :n]
        uniform: Floats = np.multiply(words >> np.uint64(11), 2.0**-53, dtype=np.float64)
        return uniform

    def draw(
        self,
        distribution: Distribution,
        variable: str,
        shape: tuple[int, ...],
        values: Values,
        *,
        episode: int = 0,
        step: int = 0,
        count: int = 1,
    ) -> Value:
        """Draw values of a variable, one for each of ``count`` episodes: ``(count, *shape)``."""
        n = distribution.n_uniforms(shape)
        uniforms = self.uniforms(variable, n=n, episode=episode, step=step, count=count)
        return distribution.transform(uniforms, shape, values)
