"""Arguments of vectorised calls, split into those of each environment."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import whole_number
from scm_world._types import Floats
from scm_world.env.arguments import doubles, finite
from scm_world.errors import ActionError, UnknownOption

MASK = "reset_mask"


def seeds_of(seed: Any, size: int) -> list[int | None]:
    """Give each environment its seed.

    Args:
        seed: One for the first, the next numbers are for the others; a list; or None.
        size: How many environments there are.

    Raises:
        UnknownOption: It is none of these.

    Example:
        >>> seeds_of(7, 3)
        [7, 8, 9]
    """
    if seed is None:
        return [None] * size
    try:
        if not isinstance(seed, Sequence | np.ndarray):
            return [whole_number("seed", seed, least=0) + i for i in range(size)]
        seeds = [None if one is None else whole_number("seed", one, least=0) for one in seed]
    except UnknownOption:
        seeds = []
    if len(seeds) != size:
        raise UnknownOption("seed", seed, ("a whole number", f"a list of {size} of them or None"))
    return seeds


def masked(mask: Any, size: int) -> NDArray[np.bool_]:
    """Read which environments are meant.

    Raises:
        UnknownOption: It is no array of truth values, or none of them is true.
    """
    if mask is None:
        return np.ones(size, bool)
    read = isinstance(mask, np.ndarray) and mask.shape == (size,) and mask.dtype == np.bool_
    if not (read and mask.any()):
        allowed = (f"an array of {size} truth values, at least one of them true",)
        raise UnknownOption(MASK, mask, allowed)
    return np.array(mask)


def options_of(given: Mapping[str, Any], which: NDArray[np.bool_]) -> list[dict[str, Any] | None]:
    """Give each environment that is reset its options.

    Args:
        given: ``"do"`` and ``"episode"``, each one for all, a list, or a mapping by index.
        which: The environments that are reset, shape (n,).

    Raises:
        UnknownOption: There is a wrong number of them.

    Example:
        >>> options_of({"episode": 2, "do": {1: {"floor_friction": 0.4}}}, np.ones(2, bool))
        [{'episode': 2}, {'episode': 2, 'do': {'floor_friction': 0.4}}]
    """
    if not given:
        return [None] * which.size
    found: list[dict[str, Any] | None] = [{} for _ in range(which.size)]
    for name, value in given.items():
        wanted = spread(name, value, which.size)
        if _is_by_index(value) and not which[list(wanted)].all():
            raise UnknownOption(f"environments for {name}", [*wanted], ("those that are reset",))
        for index, one in wanted.items():
            mine = found[index]
            if mine is not None:
                mine[name] = one
    return [one if reset else None for one, reset in zip(found, which, strict=True)]


def spread(what: str, given: Any, size: int) -> dict[int, Any]:
    """Give each environment that is meant its part of what is asked.

    Args:
        what: Said in the error.
        given: One for all; a list with one, or None, for each; or a mapping by index.
        size: How many environments there are.

    Raises:
        UnknownOption: A list of another length, or an index that does not exist.

    Example:
        >>> spread("do", [None, {"floor_friction": 0.4}], 2)
        {1: {'floor_friction': 0.4}}
        >>> spread("do", {"floor_friction": 0.4}, 2)
        {0: {'floor_friction': 0.4}, 1: {'floor_friction': 0.4}}
    """
    if _is_by_index(given):
        return {index_of(key, size): one for key, one in given.items() if one is not None}
    if isinstance(given, Sequence | np.ndarray) and not isinstance(given, str):
        if len(given) != size:
            raise UnknownOption(f"list for {what}", given, (f"one of length {size}",))
        return {index: one for index, one in enumerate(given) if one is not None}
    return {} if given is None else dict.fromkeys(range(size), given)


def _is_by_index(given: Any) -> bool:
    return isinstance(given, Mapping) and any(not isinstance(key, str) for key in given)


def chosen_of(into: Any, size: int) -> list[int]:
    """Read indices, or a mask.

    Raises:
        UnknownOption: There is no such environment, or the mask has another shape.

    Example:
        >>> chosen_of([1], 2), chosen_of(np.array([False, True]), 2)
        ([1], [1])
    """
    given = np.asarray(into)
    if given.dtype == np.bool_:
        return [int(index) for index in np.flatnonzero(masked(given, size))]
    return [index_of(index, size) for index in np.atleast_1d(given).tolist()]


def index_of(index: Any, size: int) -> int:
    """Read the index of an environment.

    Raises:
        UnknownOption: There is none.
    """
    try:
        number = operator.index(index)
    except TypeError:
        number = -1
    if isinstance(index, bool) or not 0 <= number < size:
        raise UnknownOption("environment", index, (f"any whole number from 0 to {size - 1}",))
    return number


def actions_of(actions: Any, which: NDArray[np.bool_], size: int) -> Floats:
    """Read the actions of all environments.

    Args:
        actions: One for each.
        which: The environments that are stepped, shape (n,).
        size: How many numbers an action has.

    Returns:
        Shape (n, size).

    Raises:
        ActionError: Another shape, or a number that is not finite, where one is stepped.
    """
    given = doubles(actions, size)
    if given.shape != (which.size, size):
        shape = f"actions of {which.size} environments have shape ({which.size}, {size})"
        raise ActionError(f"{shape}, got {given.shape}", actions)
    if not np.isfinite(given).all():
        wrong = np.flatnonzero(which & ~np.isfinite(given).all(axis=1))
        if wrong.size:
            text = f"environment {wrong[0]}: an action is {finite(size)}"
            raise ActionError(f"{text}, got {given[wrong[0]]!r}", actions)
    return given
