"""Models to test with."""

from __future__ import annotations

from typing import Any

from scm_world.graph import SCM
from scm_world.variables import (
    Affine,
    Box,
    Derived,
    Exogenous,
    Fixed,
    Integers,
    Linear,
    Measured,
    Normal,
)


def plus_one(x: Any) -> Any:
    """Add one."""
    return x + 1.0


def minus_one(x: Any) -> Any:
    """Take one away."""
    return x - 1.0


def small() -> SCM:
    """Build a model with every kind of static variable: cause, effect, coordinates, readout."""
    return SCM(
        [
            Exogenous(
                name="block.mass",
                unit="kg",
                default=0.02,
                bounds=Box(0.0, 2.0),
                a=Box(0.01, 0.05),
                b=Box(0.05, 0.1),
                distribution=Box(0.01, 0.03),
            ),
            Exogenous(name="friction", default=0.5, distribution=Normal(0.5, 0.1)),
            Exogenous(name="count", dtype="integer", bounds=Integers(0, 9), default=3),
            Derived(
                name="weight",
                unit="N",
                parents=("block.mass",),
                mechanism=Linear(weights=(10.0,)),
                a=Box(0.0, Affine(parent="friction")),
            ),
            Derived(
                name="drag",
                parents=("weight", "friction"),
                mechanism=Linear(weights=(1.0, 2.0)),
                noise=Normal(0.0, 0.01),
            ),
            Derived(
                name="friction_plus",
                parents=("friction",),
                mechanism=plus_one,
                inverse=minus_one,
                a=Box(1.2, 1.4),
            ),
            Measured(name="readout", parents=("drag",), mechanism=plus_one),
            Fixed(name="kind", value=7.0),
        ]
    )
