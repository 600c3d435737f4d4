"""Noise is a value: every draw is a function of (seed, variable, episode, step).

The streams are counter-based (Philox), so a draw does not depend on what else was drawn before
it, on the number of worlds or workers, or on the order of calls. Nothing touches a global
generator.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from functools import lru_cache
from typing import final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.variables.distributions import Distribution


@lru_cache(maxsize=2**16)
def _word(text: str) -> int:
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")


@final
class Noise:
    """All the noise of one seed.

    Args:
        seed: Any whole number that is not negative.

    Example:
        >>> noise = Noise(7)
        >>> both = noise.uniforms("mass", episode=0, n=2, count=2)
        >>> bool((noise.uniforms("mass", episode=1, n=2) == both[1:]).all())
        True
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self._key = _word(f"seed {seed}")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Noise) and self.seed == other.seed

    def __hash__(self) -> int:
        return hash(("Noise", self.seed))

    def __repr__(self) -> str:
        return f"Noise({self.seed})"

    def uniforms(
        self, variable: str, *, n: int, episode: int = 0, step: int = 0, count: int = 1
    ) -> Floats:
        """Draw the uniform numbers of a variable.

        Args:
            variable: Its name.
            n: How many numbers one draw takes.
            episode: The first episode.
            step: The control step.
            count: For how many episodes in a row.

        Returns:
            Numbers in [0, 1), shape ``(count, n)``.
        """
        found: Floats = self.streams([variable], n=n, episode=episode, step=step, count=count)[0]
        return found

    def streams(
        self, variables: Iterable[str], *, n: int, episode: int = 0, step: int = 0, count: int = 1
    ) -> Floats:
        """Draw the uniform numbers of several variables; see ``uniforms``.

        Returns:
            Numbers in [0, 1), shape ``(len(variables), count, n)``.
        """
        from scm_world.variables.philox import philox  # takes a while, and only draws need it

        keys = np.array([_word(name) for name in variables], dtype=np.uint64)
        found = np.empty((keys.size, count, n))
        philox(np.uint64(self._key), keys, np.uint64(episode), np.uint64(step), found)
        return found

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
        """Draw values of a variable, one for each of ``count`` episodes.

        Returns:
            Shape ``(count, *shape)``.
        """
        n = distribution.n_uniforms(shape)
        uniforms = self.uniforms(variable, n=n, episode=episode, step=step, count=count)
        return distribution.transform(uniforms, shape, values)
