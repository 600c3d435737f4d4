"""Settings that we found to work: a plain table, task by task.

An entry says what differs from ``COMMON``, by algorithm; ``None`` holds for all of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from scm_world.curricula import resample

Fields = Mapping[str, Any]

ENV: Fields = {
    "action_mode": "delta_joint_positions",
    "delta_scale": 0.1,
    "delta_origin": "measured",
    "frame_skip": 10,
}

_OFF_POLICY: Fields = {
    "worlds": 64,
    "steps": 1_000_000,
    "rate": {"initial": 3e-4},
    "network": {"hidden": (256, 256), "activation": "relu"},
    "settings": {"gamma": 0.98, "batch_size": 256, "gradient_steps": 8, "n_steps": 3},
}

COMMON: Mapping[str, Fields] = {
    "ppo": {
        "worlds": 64,
        "steps": 3_000_000,
        "scale_rewards": True,
        "rate": {"initial": 5e-4, "schedule": "linear", "final": 0.1},
        "network": {"hidden": (256, 256), "activation": "tanh", "log_std": -0.7},
        "settings": {
            "n_steps": 64,
            "batch_size": 1024,
            "n_epochs": 4,
            "gamma": 0.98,
            "gae_lambda": 0.95,
            "clip_range": 0.2,
        },
    },
    "sac": _OFF_POLICY,
    "td3": _OFF_POLICY,
}
"""What holds for every task, by algorithm."""

_PUSHING: Fields = {
    "terms": [
        "reward.tip_behind_block",
        "reward.corners_to_goal",
        "reward.goal_kernel",
        "reward.goal_kernel_fine",
        "reward.speed",
    ],
    "weights": {
        "reward.tips_to_block": 0.0,
        "reward.block_to_goal": 0.0,
        "reward.orientation": 0.0,
        "reward.tip_behind_block": 20.0,
        "reward.corners_to_goal": 30.0,
        "reward.goal_kernel": 0.1,
        "reward.goal_kernel_fine": 0.1,
        "fractional_success": 0.2,
        "reward.speed": 5e-4,
    },
}

_POSE = ("cartesian_position", "orientation")
_MOTION = ("linear_velocity", "angular_velocity")

_ROBOT = ("joint_positions", "joint_velocities", "end_effector_positions")
_SEEN = [
    *_ROBOT,
    *(f"tool_block.{part}" for part in (*_POSE, *_MOTION)),
    *(f"goal_block.{part}" for part in _POSE),
    "joint_torques",
]
"""All that moves. Without the time, what is learned in short episodes holds in long ones."""

_REACHING: Fields = {
    "terms": ["reward.reach_kernel", "reward.reach_kernel_fine", "reward.speed"],
    "weights": {
        "reward.tips_to_goals": 10.0,
        "reward.reach_kernel": 0.1,
        "reward.reach_kernel_fine": 0.1,
        "fractional_success": 0.1,
        "reward.speed": 5e-4,
    },
}

_CARRYING: Fields = {
    "terms": _PUSHING["terms"],
    "weights": {
        "reward.tips_to_block": 0.0,
        "reward.block_to_height": 0.0,
        "reward.smoothness": 0.0,
        "reward.corners_to_goal": 30.0,
        "reward.goal_kernel": 0.1,
        "reward.goal_kernel_fine": 0.1,
        "fractional_success": 0.2,
        "reward.speed": 5e-4,
    },
}
_PICKING = {**_CARRYING, "weights": {**_CARRYING["weights"], "reward.block_to_center": 0.0}}
_PLACING = {**_CARRYING, "weights": {**_CARRYING["weights"], "reward.block_to_goal": 0.0}}

_FROM_A_CLONE: Fields = {
    "network": {"activation": "relu", "log_std": -3.0},
    "rate": {"initial": 3e-5},
    "critic_warmup": 200_000,
    "steps": 1_000_000,
}
"""PPO does not find out by itself how to grasp: this is for a policy that can. It is a guess."""

TUNED: Mapping[str, Mapping[str | None, Fields]] = {
    "reaching": {
        None: {
            "env": {
                "task_options": _REACHING,
                "observation_mode": "custom",
                "observe": [*_ROBOT, *(f"goal_{f}.cartesian_position" for f in (60, 120, 300))],
            },
            "episode_length": 50,
            "curriculum": resample("goal_*.cylindrical_position", "A"),
        },
        "ppo": {
            "steps": 200_000,
            "settings": {"n_steps": 16, "batch_size": 256, "gamma": 0.95},
            "network": {"scaled": True},
        },
    },
    "pushing": {
        None: {
            "env": {
                "task_options": _PUSHING,
                "delta_scale": 0.04,
                "delta_origin": "command",
                "observation_mode": "custom",
                "observe": _SEEN,
            },
            "episode_length": 125,
            "curriculum": resample("goal_block.cylindrical_position", "A"),
        },
        "ppo": {
            "steps": 3_000_000,
            "settings": {"n_steps": 32, "batch_size": 512},
            "rate": {"initial": 5e-4, "schedule": "adaptive", "target_kl": 0.02, "lowest": 5e-5},
            "network": {"log_std_end": -2.3, "scaled": True},
        },
    },
    "picking": {
        None: {"env": {"task_options": _PICKING}, "curriculum": 1},
        "ppo": _FROM_A_CLONE,
    },
    "pick_and_place": {
        None: {"env": {"task_options": _PLACING}, "curriculum": 1},
        "ppo": _FROM_A_CLONE,
    },
    "stacking2": {None: {"curriculum": 1}, "ppo": _FROM_A_CLONE},
}
"""What differs from that, by task and algorithm."""

_PLACED: Fields = {"protocols": ("P1", "P5"), "episodes": 400, "rounds": 0}

LESSONS: Mapping[str, Fields] = {
    # A block that was let go of is dragged along by fingers that retreat a little too early.
    "pushing": {
        "teacher": "hold",
        "protocols": ("P5",),
        "episodes": 1_200,
        "rounds": 0,
        "trials": {"protocols": ("P0", "P5"), "episodes": 40},
    },
    "picking": {"updates": 4_000},
    "pick_and_place": _PLACED,
    "stacking2": {**_PLACED, "episodes": 350},
}
"""What differs from the usual lesson of imitation, by task."""


def tuned(task: str, algo: str) -> dict[str, Any]:
    """Return the fields of a recipe that work for a task, as far as we know."""
    found: dict[str, Any] = {"env": dict(ENV), **COMMON[algo]}
    for fields in (TUNED.get(task, {}).get(key, {}) for key in (None, algo)):
        found |= {
            name: {**found[name], **value} if isinstance(found.get(name), Mapping) else value
            for name, value in fields.items()
        }
    return found
