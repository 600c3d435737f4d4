"""Names for the array types that the whole package speaks."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
"""An array of 64-bit floats."""

Integers = NDArray[np.int64]
"""An array of 64-bit integers."""

Value = NDArray[np.float64] | NDArray[np.int64]
"""The value of one variable."""

Values = Mapping[str, Value]
"""The values of several variables, by name."""

__all__ = ["ArrayLike", "Floats", "Integers", "Value", "Values"]
