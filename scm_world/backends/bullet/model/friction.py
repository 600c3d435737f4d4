"""Friction of pairs of shapes, in an engine that multiplies two numbers for each contact."""

from __future__ import annotations

import math
import statistics

from scm_world.models.bodies import Bodies


def shares(bodies: Bodies, usual: float) -> list[float]:
    """Give each shape a number, so that a contact has the product of two as its friction.

    A model says the larger of two coefficients. The product is that wherever a moving shape
    touches fixed ones that are all alike, and wherever one of two moving shapes has the usual
    coefficient and the other at least that, if the floor has no more than it. The number of a
    moving shape depends on its own coefficient and on that of the first fixed shape alone, so
    that shapes which never touch leave one another alone to the last bit.

    Args:
        bodies: All of them, with the coefficients in force.
        usual: See ``usual_friction``.
    """
    fixed = [not bodies.roots[geom.body] for geom in bodies.geoms]
    coefficients = [0.0 if geom.slippery else geom.friction for geom in bodies.geoms]
    measure = next((c for c, still in zip(coefficients, fixed, strict=True) if still), None)
    if not measure:  # nothing is fixed, or it is smooth: the other shape decides
        scale = math.sqrt(usual) if measure is None and usual else 1.0
        return [
            (c or 1.0) if still else c / scale for c, still in zip(coefficients, fixed, strict=True)
        ]
    scale = math.sqrt(max(measure, usual))
    return [
        c / measure * scale if still else max(c, measure) / scale
        for c, still in zip(coefficients, fixed, strict=True)
    ]


def usual_friction(bodies: Bodies) -> float:
    """Give the coefficient in the middle of those of the moving shapes, as in the model's file."""
    moving = [geom for geom in bodies.geoms if bodies.roots[geom.body]]
    return statistics.median_low([0.0 if g.slippery else g.friction for g in moving] or [0.0])


def worst_pairs(bodies: Bodies, tolerance: float = 0.01) -> list[tuple[int, int, float, float]]:
    """List the pairs whose friction is off: two shapes, what they have and what they should have.

    Args:
        bodies: All of them.
        tolerance: What may be off, as a share.
    """
    numbers, found = shares(bodies, usual_friction(bodies)), []
    for first, second in bodies.touching:
        has, wanted = numbers[first] * numbers[second], bodies.friction(first, second)
        if abs(has - wanted) > tolerance * max(has, wanted):
            found.append((first, second, has, wanted))
    return found
