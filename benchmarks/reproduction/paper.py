"""The settings of the CausalWorld paper, as recipes.

Source:
    Ahmed et al., *CausalWorld*, ICLR 2021, appendix, and the scripts of CausalWorld 1.2. Where a
    script leaves something out it has the default of Stable-Baselines 2.10. One thing is not the
    same: there policy and value of PPO shared their hidden layers.
"""

from __future__ import annotations

from typing import Any

from scm_world.training.recipe import Recipe

ENV: dict[str, Any] = {
    "action_mode": "joint_positions",
    "frame_skip": 3,  # 83 Hz
    "task_options": {"weights": "paper"},
}

FIELDS: dict[str, dict[str, Any]] = {
    "ppo": {
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
    },
    "sac": {
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
    },
    "td3": {
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
    },
}


def paper(task: str, algo: str, curriculum: int, env: dict[str, Any], **fields: Any) -> Recipe:
    """Return the published recipe; every task has the same settings.

    Args:
        task: Name of the task.
        algo: ``"ppo"``, ``"sac"`` or ``"td3"``.
        curriculum: 0: nothing varies; 1: goals; 2: everything.
        env: Options of the environment besides the published ones.
        fields: Other fields of the recipe.
    """
    usual = {"name": "paper", "staggered": False, "trials": {"times": 20}, **FIELDS[algo]}
    given = {"task": task, "algo": algo, "curriculum": curriculum, "env": {**ENV, **env}}
    return Recipe.model_validate({**usual, **given, **fields})
