"""What the statistics accept."""

from __future__ import annotations

from typing import Any

import numpy as np

from scm_world._types import ArrayLike, Floats, Integers
from scm_world.errors import UnknownOption


def numbers(name: str, values: ArrayLike, *, ndim: tuple[int, ...] = (1,)) -> Floats:
    """Take an array of finite numbers.

    Args:
        name: What they are, for the message.
        values: Any numbers.
        ndim: How many axes the array may have.

    Raises:
        UnknownOption: It has other axes, is empty, or something in it is no finite number.

    Example:
        >>> numbers("values", [])
        Traceback (most recent call last):
            ...
        scm_world.errors.UnknownOption: values cannot be 'an array of shape (0,)'; it can be: ...
    """
    axes = " or ".join(map(str, ndim))
    wanted = f"one finite number or more, in an array of {axes} axes"
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise UnknownOption(name, "something else than numbers", (wanted,)) from None
    if array.ndim not in ndim or array.size == 0:
        raise UnknownOption(name, f"an array of shape {array.shape}", (wanted,))
    if not np.isfinite(array).all():
        place = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise UnknownOption(name, f"{array[place]} at {place}", (wanted,))
    return array


def checked_level(level: float) -> float:
    """Take a level of confidence.

    Raises:
        UnknownOption: It is not between 0 and 1.
    """
    if not 0.0 < level < 1.0:
        raise UnknownOption("level", level, ("a number between 0 and 1, such as 0.95",))
    return float(level)


def checked_draws(name: str, draws: int) -> int:
    """Take a number of resamples or of permutations.

    Raises:
        UnknownOption: It is not a whole number, or less than 1.
    """
    if isinstance(draws, bool) or not isinstance(draws, int | np.integer) or draws < 1:
        raise UnknownOption(name, draws, ("a whole number, 1 or more",))
    return int(draws)


def strata_of(values: Floats, strata: ArrayLike | None) -> list[Floats]:
    """Part values by their strata; without strata, they are one.

    Args:
        values: Shape ``(n,)``.
        strata: A number or a name for each, shape ``(n,)``.

    Raises:
        UnknownOption: There is not one stratum for each value.
    """
    if strata is None:
        return [values]
    labels: Any = np.asarray(strata)
    if labels.shape != values.shape:
        raise UnknownOption(
            "strata",
            f"an array of shape {labels.shape}",
            (f"one for each of the {values.size} values",),
        )
    places: Integers = np.unique(labels, return_inverse=True)[1]
    return [values[places == k] for k in range(int(places.max()) + 1)]


__all__ = ["checked_draws", "checked_level", "numbers", "strata_of"]
