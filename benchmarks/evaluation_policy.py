"""The small network that acts in ``evaluation.py``, with numpy alone.

Both sides of the comparison import it, each with its own interpreter.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

SIZES = (56, 64, 64, 9)  # the published observation of pushing, two hidden layers, the action


class Mlp:
    """A multilayer perceptron with random weights, the same every time.

    Weights have the variance 1 / inputs, so that no layer is saturated.

    Args:
        seed: Of the weights.
    """

    def __init__(self, seed: int = 0) -> None:
        generator = np.random.default_rng(seed)
        self._weights = [
            (generator.standard_normal((inputs, outputs)) / np.sqrt(inputs)).astype(np.float32)
            for inputs, outputs in pairwise(SIZES)
        ]

    def __call__(self, observation: Any) -> Any:
        """Choose an action in [-1, 1], shape (9,), from an observation, shape (56,)."""
        x = np.asarray(observation, dtype=np.float32)
        for weight in self._weights:
            x = np.tanh(x @ weight)
        return x
