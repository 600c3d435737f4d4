"""Reading the arguments of a task."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from scm_world._types import Floats
from scm_world.errors import UnknownOption
from scm_world.variables import Box, Integers


def numbers_of(value: Any) -> Floats | None:
    """Read finite numbers; None if these are none."""
    try:
        found = np.asarray(value)
    except ValueError:  # a ragged list
        return None
    numeric = np.issubdtype(found.dtype, np.number) and np.isfinite(found).all()
    return found.astype(np.float64) if numeric else None


def checked(
    option: str, value: Any, allowed: Box | Integers, *, shape: tuple[int, ...] = ()
) -> Any:
    """Check an argument of a task against the bounds of the variable that it is the default of.

    Args:
        option: Its name.
        value: What was given.
        allowed: The bounds.
        shape: Of the variable.

    Returns:
        What was given.

    Raises:
        UnknownOption: It is no number, of another shape, or out of bounds.
    """
    number = numbers_of(value)
    if number is None or number.shape != shape or not allowed.contains(number):
        many = f"{shape[0]} numbers in " if shape else "a number in "
        raise UnknownOption(option, value, (many + allowed.describe(shape, {}),))
    return value


def checked_weight(name: str, weight: Any) -> float:
    """Check the weight of a reward term.

    Raises:
        UnknownOption: It is no finite number.
    """
    try:
        number = float(weight)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise UnknownOption(f"weight of {name}", weight, ("any finite number",))
    return number
