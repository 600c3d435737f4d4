"""Calling compiled functions without a look at the types of the arguments."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any
from weakref import WeakKeyDictionary

import numba
import numpy as np
from numba.extending import is_jitted

typeof: Callable[[Any], Hashable] = numba.typeof  # numba is untyped

_MADE: WeakKeyDictionary[Any, dict[tuple[Hashable, ...], Callable[..., Any]]] = WeakKeyDictionary()
"""What was given before: asking numba takes longer than most of these functions."""


def direct(function: Callable[..., Any], *like: Any) -> Callable[..., Any]:
    """Give what a compiled function does with arguments of some types, for loops.

    A call of a compiled function spends half of its time on finding out which types it was given.
    This leaves that out, so every call has to have arguments of the very types given here; arrays
    also of the same layout. Numbers may be of any kind. What is not compiled is given back.

    Args:
        function: Compiled or not.
        like: Arguments that have the types.

    Example:
        >>> import numpy as np
        >>> from numba import njit
        >>> double = direct(njit(lambda x: 2.0 * x[0]), np.zeros(1))
        >>> double(np.array([4.0]))
        8.0
    """
    if not is_jitted(function):
        return function
    compiled: Any = function
    made = _MADE.setdefault(compiled, {})
    kinds = tuple(map(_kind, like))
    found = made.get(kinds)
    if found is None:
        found = made[kinds] = compiled.compile(tuple(map(typeof, like)))
    return found


def _kind(value: Any) -> Hashable:
    """Give something that is the same for two values only if their types are."""
    if type(value) is np.ndarray:
        return value.dtype, value.ndim, value.flags.num
    return float if type(value) is float else typeof(value)
