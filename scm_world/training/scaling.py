"""Fixed scales of what is observed, so that what matters varies by about one.

An observation is normalized by bounds that are wide enough for all that can happen: a meter for
positions, 50 rad/s for joints. What does happen fills a small part of them, and networks learn
slowly from small numbers. A scale multiplies each number before the first layer. It is a part of
the first layer in a policy file, so nobody else has to know it.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np

from scm_world._types import Floats
from scm_world.errors import UnknownOption
from scm_world.graph.exchange.libraries import load

OBSERVATION = "observation"

SCALES: Mapping[str, float] = {
    "cartesian_position": 10.0,  # one for 0.1 m, the radius of where blocks and goals are
    "end_effector_positions": 10.0,
    "joint_positions": 2.0,
    "joint_velocities": 10.0,  # one for 5 rad/s
    "linear_velocity": 20.0,  # one for 0.5 m/s
    "angular_velocity": 10.0,  # one for 10 rad/s
    "orientation": 2.0,
}
"""What a normalized number is multiplied by, by its quantity; 1 where nothing is said."""


def scales(layout: Mapping[str, slice], size: int) -> Floats:
    """Give the scale of each number of an observation.

    Args:
        layout: Where each variable stands.
        size: How many numbers there are.

    Returns:
        Shape (size,), dimensionless.

    Example:
        >>> scales({"time_left": slice(0, 1), "block.linear_velocity": slice(1, 3)}, 4)
        array([ 1., 20., 20.,  1.])
    """
    found = np.ones(size)
    for name, where in layout.items():
        found[where] = SCALES.get(name.rpartition(".")[2], 1.0)
    return found


def scales_of(vec_env: Any, env: Mapping[str, Any]) -> Floats:
    """Give the scales of the observations of worlds, in the order in which they reach a network.

    Args:
        vec_env: For Stable-Baselines3.
        env: Options of the environment.

    Raises:
        UnknownOption: Observations are pictures, or not normalized.
    """
    for name, wrong, right in (
        ("observation_mode", "pixel", "a vector"),
        ("normalize_observations", False, "True"),
    ):
        if env.get(name) == wrong:
            raise UnknownOption(f"{name} with network.scaled", env[name], (right,))
    (layout, *_) = vec_env.get_attr("layout")
    space = vec_env.observation_space
    parts = getattr(space, "spaces", {OBSERVATION: space})
    each = [
        scales(layout if key == OBSERVATION else {}, part.shape[0]) for key, part in parts.items()
    ]
    return np.concatenate(each)


@functools.cache
def extractor() -> Any:
    """Make the class that scales in Stable-Baselines3, when it is first needed.

    Raises:
        MissingExtra: Stable-Baselines3 or torch is not installed.
    """
    torch: Any = load("torch", "torch", "train")
    layers = load("stable_baselines3.common.torch_layers", "stable-baselines3", "train")

    class Scaled(layers.BaseFeaturesExtractor):  # type: ignore[misc, name-defined] # made lazily
        """Observations, one part after another, times their scales.

        Args:
            space: Of observations.
            scale: Of each number.
        """

        def __init__(self, space: Any, scale: Floats) -> None:
            super().__init__(space, len(scale))
            kept = torch.as_tensor(np.asarray(scale, np.float32))
            self.register_buffer("scale", kept, persistent=False)

        def forward(self, observations: Any) -> Any:
            """Scale a batch of observations."""
            if isinstance(observations, dict):
                observations = torch.cat([part.flatten(1) for part in observations.values()], 1)
            return observations.float() * self.scale

    return Scaled
