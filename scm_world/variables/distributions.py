"""Distributions and keyed noise: every draw is a function of (seed, variable, episode, step).

Distributions are spaces, which stand for the uniform one, and those of statistics. The streams are
counter-based (Philox), so a draw does not depend on earlier draws, on the number of worlds or
workers, or on the order of calls. Nothing touches a global generator.

Source:
    Salmon et al., *Parallel random numbers: as easy as 1, 2, 3*, SC 2011.
"""
# ruff: noqa: D102 # ``Sampler`` describes the methods

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Annotated, Any, Literal, final

import numpy as np
from pydantic import AfterValidator, Field

from scm_world._arguments import typed, whole_number
from scm_world._types import ArrayLike, Floats, Value, Values
from scm_world.variables.spaces import (
    Box,
    Categories,
    Either,
    Integers,
    Rotations,
    Sampler,
    refuse_infinite,
)


@final
class Normal(Sampler):
    """The normal distribution, component by component, from two uniform numbers each.

    Attributes:
        mean: Mean.
        std: Standard deviation.

    Source:
        Box and Muller, *A note on the generation of random normal deviates*, 1958.
    """

    kind: Literal["normal"] = "normal"
    mean: float = 0.0
    std: float = Field(default=1.0, ge=0.0)

    def __init__(self, mean: float = 0.0, std: float = 1.0, **fields: object) -> None:
        super().__init__(mean=mean, std=std, **fields)

    def n_uniforms(self, shape: tuple[int, ...]) -> int:
        return 2 * int(np.prod(shape))

    def transform(self, uniforms: Floats, shape: tuple[int, ...], values: Values) -> Value:
        half = uniforms.shape[-1] // 2
        radius = np.sqrt(-2.0 * np.log1p(-uniforms[..., :half]))
        standard = radius * np.cos(2.0 * np.pi * uniforms[..., half:])
        return self.mean + self.std * standard.reshape(*uniforms.shape[:-1], *shape)

    def describe(self) -> str:
        return f"N({self.mean:g}, {self.std:g}²)"


@final
class Cylinder(Sampler):
    """Uniform over the volume of a box in cylindrical coordinates (radius, angle, …).

    A box of cylindrical coordinates, drawn component by component, crowds its points near the
    axis; here the radius is ``sqrt(U[r0², r1²])``.

    Attributes:
        box: The corners.

    Example:
        >>> Cylinder(Box((0.0, 0.0, 0.0), (2.0, 1.0, 1.0))).transform(
        ...     np.array([0.25, 0.5, 0.5]), (3,), {})
        array([1. , 0.5, 0.5])

    Source:
        CausalWorld 1.2, ``task_generators/base_task.py`` (the base goal sampler).
    """

    kind: Literal["cylinder"] = "cylinder"
    box: Box

    def __init__(self, box: object, **fields: object) -> None:
        super().__init__(box=box, **fields)

    def parents(self) -> frozenset[str]:
        return self.box.parents()

    def transform(self, uniforms: Floats, shape: tuple[int, ...], values: Values) -> Value:
        low, high = self.box.bounds(shape, values)
        points = np.array(self.box.transform(uniforms, shape, values))
        inner, outer = low[..., 0] ** 2, high[..., 0] ** 2
        points[..., 0] = np.sqrt(inner + (outer - inner) * uniforms[..., 0])
        return points

    def describe(self) -> str:
        return f"uniform by volume over {self.box.describe()}"


@final
class Continuous(Sampler):
    """A continuous distribution of scipy, by its name there, component by component.

    Attributes:
        family: Name of the distribution in ``scipy.stats``.
        parameters: Its arguments, ``loc`` and ``scale`` among them.

    Example:
        >>> Continuous("beta", a=2.0, b=5.0).describe()
        'beta(a=2, b=5)'
    """

    kind: Literal["continuous"] = "continuous"
    family: str
    parameters: dict[str, float]

    def __init__(self, family: str, **parameters: object) -> None:
        super().__init__(family=family, parameters=parameters.pop("parameters", parameters))

    def __hash__(self) -> int:
        return hash((self.family, frozenset(self.parameters.items())))

    @cached_property
    def frozen(self) -> Any:
        """The distribution of scipy, with its parameters."""
        from scipy import stats

        family = getattr(stats, self.family, None)
        if not isinstance(family, stats.rv_continuous):
            raise ValueError(f"{self.family!r} is not a continuous distribution of scipy.stats")
        try:
            frozen = family(**self.parameters)
        except TypeError as error:
            raise ValueError(f"scipy.stats.{self.family}: {error}") from None
        if not np.isfinite(frozen.median()):
            raise ValueError(f"{self.describe()} is not a distribution")
        return frozen

    def model_post_init(self, context: object) -> None:
        self.frozen.support()

    def transform(self, uniforms: Floats, shape: tuple[int, ...], values: Values) -> Value:
        inside = uniforms.reshape(*uniforms.shape[:-1], *shape) + 2.0**-54  # never 0
        return np.asarray(self.frozen.ppf(inside))

    def describe(self) -> str:
        return f"{self.family}({', '.join(f'{k}={v:g}' for k, v in self.parameters.items())})"


@final
class Discrete(Sampler):
    """A few numbers, such as those of a sample, each with a probability, component by component.

    Attributes:
        values: The numbers.
        probabilities: One for each number; all alike if None.

    Example:
        >>> Discrete((0, 10), (0.25, 0.75)).transform(np.array([[0.2], [0.3]]), (), {})
        array([ 0, 10])
    """

    kind: Literal["discrete"] = "discrete"
    values: tuple[int, ...] | tuple[float, ...] = Field(min_length=1)
    probabilities: tuple[float, ...] | None = None

    def __init__(
        self, values: ArrayLike, probabilities: ArrayLike | None = None, **fields: object
    ) -> None:
        listed = np.ravel(values).tolist()
        chances = None if probabilities is None else tuple(np.ravel(probabilities).tolist())
        super().__init__(values=tuple(listed), probabilities=chances, **fields)

    def model_post_init(self, context: object) -> None:
        chances = self.chances
        if chances.shape != (len(self.values),) or not np.all(chances >= 0.0):
            raise ValueError(f"{len(self.values)} values need as many probabilities, none negative")
        if abs(chances.sum() - 1.0) > 1e-9:
            raise ValueError(f"probabilities sum to {chances.sum():g}, not to 1")

    @property
    def chances(self) -> Floats:
        """The probability of each value, shape (n,)."""
        n = len(self.values)
        return np.full(n, 1.0 / n) if self.probabilities is None else np.array(self.probabilities)

    def transform(self, uniforms: Floats, shape: tuple[int, ...], values: Values) -> Value:
        unit = uniforms.reshape(*uniforms.shape[:-1], *shape)
        ends = np.cumsum(self.chances)[:-1]
        return np.asarray(self.values)[np.searchsorted(ends, unit, side="right")]

    def describe(self) -> str:
        pairs = zip(self.values[:5], self.chances.tolist(), strict=False)
        more = ", …" if len(self.values) > 5 else ""
        return "{" + ", ".join(f"{value:g}: {p:g}" for value, p in pairs) + more + "}"


@typed
def Bernoulli(p: float) -> Discrete:  # noqa: N802
    """Return the distribution of 1, with probability ``p``, and 0."""
    return Discrete((0, 1), (1.0 - p, p))


Distribution = Annotated[
    Box | Integers | Categories | Either | Rotations | Normal | Cylinder | Continuous | Discrete,
    Field(discriminator="kind"),
    AfterValidator(partial(refuse_infinite, "distribution")),
]
"""Anything one can draw from; a space stands for the uniform distribution over it."""


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
