"""Policies that need nothing but numpy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import ArrayLike

Weights = NDArray[np.float32]


@final
@dataclass(frozen=True)
class Layer:
    """A weighted sum of its inputs.

    Attributes:
        weight: Shape (inputs, outputs).
        bias: Shape (outputs,).
    """

    weight: Weights
    bias: Weights

    def __call__(self, x: Weights) -> Weights:
        """Compute ``x weight + bias``, shape (..., outputs)."""
        total: Weights = x @ self.weight + self.bias
        return total


@final
@dataclass(frozen=True)
class MlpPolicy:
    """A normal distribution over actions whose mean is a multilayer perceptron.

    Attributes:
        hidden: Layers that end in a hyperbolic tangent.
        mean: The layer that gives the mean of the actions.
        log_std: Logarithm of the standard deviations, shape (actions,).
        value: The layer that gives the value of the state, if it is kept.
    """

    hidden: tuple[Layer, ...]
    mean: Layer
    log_std: Weights
    value: Layer | None = None

    @property
    def n_observed(self) -> int:
        """How many numbers it observes."""
        return int((self.hidden or (self.mean,))[0].weight.shape[0])

    def features(self, observation: ArrayLike) -> Weights:
        """Compute what the last hidden layer says, shape (..., features).

        Raises:
            ValueError: The observation has another number of components.
        """
        x: Any = np.asarray(observation, dtype=np.float32)
        if x.ndim == 0 or x.shape[-1] != self.n_observed:
            raise ValueError(
                f"the policy observes {self.n_observed} numbers, got the shape {x.shape}; "
                "use the task, the layout and the conventions that it was trained with"
            )
        for layer in self.hidden:
            x = np.tanh(layer(x))
        found: Weights = x
        return found

    def __call__(
        self,
        observation: ArrayLike,
        *,
        deterministic: bool = True,
        generator: np.random.Generator | None = None,
    ) -> Weights:
        """Choose an action.

        Args:
            observation: Shape (..., n).
            deterministic: Take the mean instead of a draw.
            generator: What draws are made with; the mean leaves it alone.

        Returns:
            Shape (..., actions), clipped to [-1, 1].

        Raises:
            ValueError: The observation has another number of components, or there is no
                generator to draw with.

        Source:
            Stable-Baselines 2.10, ``common/base_class.py``, ``ActorCriticRLModel.predict``.
        """
        action: Any = self.mean(self.features(observation))
        if not deterministic:
            if generator is None:
                raise ValueError(
                    "a draw needs a generator, got None; call policy(observation, "
                    "deterministic=False, generator=numpy.random.default_rng(0))"
                )
            noise = generator.standard_normal(action.shape, dtype=np.float32)
            action = action + np.exp(self.log_std) * noise
        clipped: Weights = np.clip(action, np.float32(-1.0), np.float32(1.0))
        return clipped

    def predict(
        self,
        observation: ArrayLike,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Weights, None]:
        """Choose an action, as Stable-Baselines3 asks for one.

        Args:
            observation: Shape (..., n).
            state: Not used: the policy has no memory.
            episode_start: Not used either.
            deterministic: It must be true.

        Returns:
            The action, shape (..., actions), and no state.

        Raises:
            ValueError: ``deterministic`` is false, as there is no generator to draw with, or the
                observation has another number of components.
        """
        return self(observation, deterministic=deterministic), None
