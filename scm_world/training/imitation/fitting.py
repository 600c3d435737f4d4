"""A network is fitted to demonstrations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.errors import ModelError
from scm_world.training.imitation.demonstrations import Demonstrations
from scm_world.training.imitation.lessons import Lesson
from scm_world.training.learners import torch

UNIT = 0.1
"""Of actions, while they are learned: errors of that size count fully, larger ones linearly."""

LEAST = 1e-3
"""Standard deviation of an observed direction below which it is taken as less important."""

FIXED = 1e-4
"""Standard deviation of a direction that is taken as constant."""


@final
@dataclass(frozen=True)
class Fitted:
    """What was learned.

    Attributes:
        tensors: Of the network, by the names in a policy file.
        loss: Mean over the last tenth of the updates.
    """

    tensors: dict[str, NDArray[np.float32]]
    loss: float


def fitted(shown: Demonstrations, lesson: Lesson, *, seed: int) -> Fitted:
    """Fit a network to demonstrations, by Adam on Huber's loss.

    Observations are whitened: turned into their principal components, each with a standard
    deviation of one. So how far a fingertip is from a block counts as much as where both are. The
    first layer of the result has this turned back.

    Args:
        shown: What is learned.
        lesson: How it is learned.
        seed: Of everything that is drawn.

    Raises:
        MissingExtra: torch is not installed.
        ModelError: The rate is so large that the network's weights grow without end.
    """
    lib = torch()
    turn, shift = whitening(shown.observations)
    seen = lib.from_numpy((shown.observations @ turn.T + shift).astype(np.float32))
    done = lib.from_numpy(shown.actions / np.float32(UNIT))
    with lib.random.fork_rng(devices=[]):
        lib.manual_seed(seed)
        network = _network(lib, lesson, seen.shape[1], done.shape[1])
        loss = _optimized(lib, network, (seen, done), lesson)
    if not np.isfinite(loss):
        raise ModelError(["the loss is no finite number any more: take a smaller rate"])
    return Fitted(_folded(network, turn, shift), loss)


def whitening(observations: NDArray[Any]) -> tuple[Floats, Floats]:
    """Find what turns observations into uncorrelated features with a variance of one.

    Args:
        observations: Shape (n, k).

    Returns:
        Matrix, shape (m, k), and shift, shape (m,), of a linear map. Directions that do not vary
        are left out, unless none does.

    Example:
        >>> points = np.random.default_rng(0).normal(size=(1000, 2)) * [3.0, 0.1] + 5.0
        >>> matrix, shift = whitening(points)
        >>> np.allclose(np.cov((points @ matrix.T + shift).T), np.eye(2), atol=1e-3)
        True
    """
    points = observations.astype(np.float64)
    mean = points.mean(axis=0)
    centered = points - mean
    variances, axes = np.linalg.eigh(centered.T @ centered / len(points))
    varied = variances > FIXED**2
    varied[-1] = True
    matrix = (axes[:, varied] / np.sqrt(variances[varied] + LEAST**2)).T
    return matrix, -matrix @ mean


def _network(lib: Any, lesson: Lesson, inputs: int, outputs: int) -> Any:
    """Make the network, shape (inputs,) to (outputs,)."""
    after = {"tanh": lib.nn.Tanh, "relu": lib.nn.ReLU}[lesson.network.activation]
    layers: list[Any] = []
    for width in lesson.network.hidden:
        layers += [lib.nn.Linear(inputs, width), after()]
        inputs = width
    return lib.nn.Sequential(*layers, lib.nn.Linear(inputs, outputs))


def _optimized(lib: Any, network: Any, pairs: tuple[Any, Any], lesson: Lesson) -> float:
    """Fit a network; give the loss in the end."""
    seen, done = pairs
    optimizer = lib.optim.Adam(network.parameters(), lr=lesson.rate)
    falling = lib.optim.lr_scheduler.CosineAnnealingLR(
        optimizer, lesson.updates, eta_min=0.01 * lesson.rate
    )
    losses = []
    for _ in range(lesson.updates):
        rows = lib.randint(0, len(seen), (lesson.batch,))
        loss = lib.nn.functional.smooth_l1_loss(network(seen[rows]), done[rows])
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        falling.step()
        losses.append(loss.item())
    return float(np.mean(losses[-max(lesson.updates // 10, 1) :]))


def _folded(network: Any, turn: Floats, shift: Floats) -> dict[str, NDArray[np.float32]]:
    """Give the tensors of a network that takes observations as they are, and gives actions."""
    linear = [part for part in network if hasattr(part, "weight")]
    layers = [
        [tensor.detach().numpy().astype(np.float64) for tensor in (part.weight, part.bias)]
        for part in linear
    ]
    weight, bias = layers[0]
    layers[0] = [weight @ turn, weight @ shift + bias]
    layers[-1] = [UNIT * part for part in layers[-1]]
    names = ("weight", "bias")
    return {
        f"layers.{number}.{name}": part.astype(np.float32)
        for number, layer in enumerate(layers)
        for name, part in zip(names, layer, strict=True)
    }
