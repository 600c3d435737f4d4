"""Small trained policies, made up."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from scm_world.policies import MlpPolicy, save_policy

RELATIVE = {
    "action_mode": "delta_joint_positions",
    "delta_scale": 0.1,
    "delta_origin": "measured",
}
"""Options of the environment with which most policies are trained."""


def tensors(*sizes: int, seed: int = 0, prefix: str = "layers") -> dict[str, Any]:
    """Draw the weights of a network with layers of these sizes, as a file has them."""
    rng = np.random.default_rng(seed)
    found: dict[str, Any] = {}
    for number, (inputs, outputs) in enumerate(pairwise(sizes)):
        weight = rng.normal(size=(outputs, inputs)) / np.sqrt(inputs)
        found[f"{prefix}.{number}.weight"] = weight.astype(np.float32)
        found[f"{prefix}.{number}.bias"] = rng.normal(size=outputs).astype(np.float32) / 10
    return found


def policy(n: int = 56, *, seed: int = 0, **about: Any) -> MlpPolicy:
    """Give a policy that observes n numbers."""
    return MlpPolicy.of(tensors(n, 16, 9, seed=seed), {"task": "pushing", **about})


def trained(path: Path, n: int = 56, *, seed: int = 0, **about: Any) -> Path:
    """Write such a policy; relative actions if nothing else is said."""
    path.parent.mkdir(parents=True, exist_ok=True)
    save_policy(path, policy(n, seed=seed, **{"env": RELATIVE, **about}))
    return path
