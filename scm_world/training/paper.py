"""The published settings.

Source:
    Ahmed et al., *CausalWorld*, ICLR 2021, appendix, and the scripts of CausalWorld 1.2. Where a
    script leaves something out it has the default of Stable-Baselines 2.10. One thing is not the
    same: there policy and value of PPO shared their hidden layers.
"""

from __future__ import annotations

from typing import Any

ENV: dict[str, Any] = {
    "action_mode": "joint_positions",
    "frame_skip": 3,  # 83 Hz
    "task_options": {"weights": "paper"},
}

_PPO: dict[str, Any] = {
    "worlds": 20,
    "steps": 100_000_000,
    "rate": {"initial": 2.5e-4},
    "network": {"hidden": (256, 256), "activation": "tanh"},
    "settings": {
        "n_steps": 6_000,
        "batch_size": 3_000,  # 40 minibatches
        "n_epochs": 4,
        "gamma": 0.99,
        "gae_lambda": 0.95,
        "clip_range": 0.2,
        "clip_range_vf": 0.2,
        "ent_coef": 0.01,
        "vf_coef": 0.5,
        "max_grad_norm": 0.5,
    },
}

_SAC: dict[str, Any] = {
    "worlds": 1,
    "steps": 10_000_000,
    "rate": {"initial": 1e-4},
    "network": {"hidden": (256, 256), "activation": "relu"},
    "settings": {
        "gamma": 0.95,
        "batch_size": 256,
        "ent_coef": 1e-3,
        "buffer_size": 1_000_000,
        "learning_starts": 1_000,
        "tau": 1e-3,
        "train_freq": 1,
        "gradient_steps": 1,
        "n_steps": 1,
    },
}

_TD3: dict[str, Any] = {
    "worlds": 1,
    "steps": 10_000_000,
    "rate": {"initial": 1e-4},
    "network": {"hidden": (256, 256), "activation": "relu"},
    "settings": {
        "gamma": 0.96,
        "batch_size": 128,
        "buffer_size": 500_000,
        "learning_starts": 1_000,
        "tau": 0.02,
        "noise": 0.1,
        "train_freq": 100,
        "gradient_steps": 100,
        "n_steps": 1,
    },
}

_PAPER = {"ppo": _PPO, "sac": _SAC, "td3": _TD3}


def paper(task: str, algo: str) -> dict[str, Any]:
    """Give the published fields of a recipe; every task has the same."""
    return {"env": ENV, "staggered": False, "trials": {"times": 20}, **_PAPER[algo]}
