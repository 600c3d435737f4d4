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
        super().__init__(mean=mean, std=std, **fields)  # type: ignore[call-arg]

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


Distribution = Annotated[
    Box | Integers | Categories | Either | Rotations | Normal, Field(discriminator="kind")
]
"""Anything one can draw from; a space stands for the uniform distribution over it."""
