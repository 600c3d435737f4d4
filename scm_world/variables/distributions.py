"""Distributions: spaces, which stand for the uniform one, and those of statistics."""
# ruff: noqa: D102 # ``Sampler`` describes the methods

from __future__ import annotations

from functools import cached_property, partial
from typing import Annotated, Any, Literal, final

import numpy as np
from pydantic import AfterValidator, Field

from scm_world._types import Floats, Value, Values
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

    def __init__(self, mean: float = 0.0, std: float = 1.0, **fields: Any) -> None:
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

    def __init__(self, box: Any, **fields: Any) -> None:
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

    def __init__(self, family: str, **parameters: Any) -> None:
        super().__init__(family=family, parameters=parameters.pop("parameters", parameters))

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

    def model_post_init(self, context: Any) -> None:
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

    def __init__(self, values: Any, probabilities: Any = None, **fields: Any) -> None:
        listed = np.ravel(values).tolist()
        chances = None if probabilities is None else tuple(np.ravel(probabilities).tolist())
        super().__init__(values=tuple(listed), probabilities=chances, **fields)

    def model_post_init(self, context: Any) -> None:
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


def Bernoulli(p: float) -> Discrete:  # noqa: N802
    """Return the distribution of 1, with probability ``p``, and 0."""
    return Discrete((0, 1), (1.0 - p, p))


Distribution = Annotated[
    Box | Integers | Categories | Either | Rotations | Normal | Cylinder | Continuous | Discrete,
    Field(discriminator="kind"),
    AfterValidator(partial(refuse_infinite, "distribution")),
]
"""Anything one can draw from; a space stands for the uniform distribution over it."""
