"""Distributions: spaces, which stand for the uniform one, and the normal one."""

from __future__ import annotations

from typing import Annotated, Any, Literal, final

import numpy as np
from pydantic import Field

from scm_world._types import Floats, Value, Values
from scm_world.variables.spaces import (
    Box,
    Categories,
    Either,
    Frozen,
    Integers,
    Rotations,
)


@final
class Normal(Frozen):
    """The normal distribution, component by component.

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

    def parents(self) -> frozenset[str]:
        """Name the variables that it depends on: there are none."""
        return frozenset()

    def n_uniforms(self, shape: tuple[int, ...]) -> int:
        """Count the uniform numbers that one draw takes: two for each component."""
        return 2 * int(np.prod(shape))

    def transform(self, uniforms: Floats, shape: tuple[int, ...], values: Values) -> Value:
        """Turn pairs of uniform numbers into normal ones."""
        half = uniforms.shape[-1] // 2
        radius = np.sqrt(-2.0 * np.log1p(-uniforms[..., :half]))
        standard = radius * np.cos(2.0 * np.pi * uniforms[..., half:])
        return self.mean + self.std * standard.reshape(*uniforms.shape[:-1], *shape)

    def describe(self, shape: tuple[int, ...], values: Values) -> str:
        """Write the distribution down."""
        return f"N({self.mean:g}, {self.std:g}²)"


@final
class Cylinder(Frozen):
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
        """Name the variables that the corners depend on."""
        return self.box.parents()

    def n_uniforms(self, shape: tuple[int, ...]) -> int:
        """Count the uniform numbers that one draw takes."""
        return self.box.n_uniforms(shape)

    def transform(self, uniforms: Floats, shape: tuple[int, ...], values: Values) -> Value:
        """Turn uniform numbers into points, the radius first."""
        low, high = self.box.bounds(shape, values)
        points = np.array(self.box.transform(uniforms, shape, values))
        inner, outer = low[..., 0] ** 2, high[..., 0] ** 2
        points[..., 0] = np.sqrt(inner + (outer - inner) * uniforms[..., 0])
        return points

    def describe(self, shape: tuple[int, ...], values: Values) -> str:
        """Write the distribution down."""
        return f"uniform by volume over {self.box.describe(shape, values)}"


Distribution = Annotated[
    Box | Integers | Categories | Either | Rotations | Normal | Cylinder,
    Field(discriminator="kind"),
]
"""Anything one can draw from; a space stands for the uniform distribution over it."""
