"""Names for the array types that the whole package speaks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
"""An array of 64-bit floats."""

Integers = NDArray[np.int64]
"""An array of 64-bit integers."""

Mask = NDArray[np.bool_]
"""Which worlds, or rows, are meant."""

Value = NDArray[Any]
"""The value of one variable: float64 for a real one, int64 for an integer or a category."""

Values = Mapping[str, Value]
"""The values of several variables, by name."""

Observation = NDArray[Any] | dict[str, NDArray[Any]]
"""The observation of an environment: an array, or arrays by name."""

__all__ = ["ArrayLike", "Floats", "Integers", "Mask", "Observation", "Value", "Values"]
