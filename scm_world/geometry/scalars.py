"""Single numbers in compiled code."""

from __future__ import annotations

from typing import Any

from numba import types
from numba.extending import overload


def scalar(value: Any) -> float:
    """Return a number as a float, also one that comes as an array of shape ().

    Compiled code may call it, where ``float`` refuses arrays.
    """
    return float(value)


@overload(scalar)
def _scalar(value: Any) -> Any:
    def of_array(value: Any) -> Any:
        return float(value[()])

    def of_number(value: Any) -> Any:
        return float(value)

    return of_array if isinstance(value, types.Array) else of_number
