"""Friction of pairs of shapes, in an engine that multiplies two numbers for each contact."""

from __future__ import annotations

import math

from scm_world.models.bodies import Bodies


def shares(bodies: Bodies) -> list[float]:
    """Give each shape a number, so that a contact has the product of two as its friction.

    A model says the larger of two coefficients. With that of the first fixed shape as measure,
    the product is the larger one wherever all coefficients are alike, and wherever a moving
    shape touches fixed ones that are all alike. The number of a moving shape depends on its own
    coefficient and on the measure alone, so that shapes which never touch leave one another
    alone to the last bit.
    """
    roots = bodies.roots
    coefficients = [0.0 if geom.slippery else geom.friction for geom in bodies.geoms]
    fixed = [not roots[geom.body] for geom in bodies.geoms]
    measure = next((c for c, still in zip(coefficients, fixed, strict=True) if still), None)
    if measure is None:
        return [math.sqrt(c) for c in coefficients]
    scale = math.sqrt(measure) if measure else 1.0  # a smooth floor counts as 1: the other decides
    return [
        (c or (0.0 if measure else 1.0)) / scale if still else max(c, measure) / scale
        for c, still in zip(coefficients, fixed, strict=True)
    ]


def worst_pairs(bodies: Bodies, tolerance: float = 0.01) -> list[tuple[int, int, float, float]]:
    """List the pairs whose friction is off: two shapes, what they have and what they should have.

    Args:
        bodies: All of them.
        tolerance: What may be off, as a share.
    """
    numbers, found = shares(bodies), []
    for first, second in bodies.touching:
        has, wanted = numbers[first] * numbers[second], bodies.friction(first, second)
        if abs(has - wanted) > tolerance * max(has, wanted):
            found.append((first, second, has, wanted))
    return found
