"""Parts of recipes and lessons: settings of the algorithms, rates, networks, evaluations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self, final

from pydantic import AfterValidator, Field, ValidationError, field_validator, model_validator

from scm_world._arguments import one_of
from scm_world.curricula import resample
from scm_world.errors import ScmWorldError, UnknownOption
from scm_world.evaluation.episodes import METRICS
from scm_world.tasks import TASKS, Task, tasks
from scm_world.tasks.factories import FILES, is_model
from scm_world.variables.spaces import Frozen


def known_task(task: str) -> str:
    """Check that there is a task of this name, or that it may be a file or ``"module:function"``.

    Raises:
        UnknownOption: It is neither.
    """
    if task not in tasks() and not is_model(task) and ":" not in task:
        raise UnknownOption("task", task, (*tasks(), *(f"file{end}" for end in FILES), "module:f"))
    return task


TaskName = Annotated[str, AfterValidator(known_task)]
Count = Annotated[int, Field(ge=1)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Observations = Literal["plain", "privileged"]
"""What a policy observes: its task, or also every causal parameter."""


class AlgorithmSettings(Frozen):
    """Keyword arguments of an algorithm of Stable-Baselines3, by its names."""


@final
class Ppo(AlgorithmSettings):
    """Of ``stable_baselines3.PPO``; ``n_steps`` are control steps of each world."""

    n_steps: Count = 64
    batch_size: Annotated[int, Field(ge=2)] = 1024
    n_epochs: Count = 4
    gamma: Share = 0.98
    gae_lambda: Share = 0.95
    clip_range: Positive = 0.2
    clip_range_vf: Positive | None = None
    normalize_advantage: bool = True
    ent_coef: NotNegative = 0.0
    vf_coef: NotNegative = 0.5
    max_grad_norm: Positive = 0.5
    target_kl: Positive | None = None


class OffPolicy(AlgorithmSettings):
    """What SAC and TD3 have in common; ``train_freq`` are control steps of each world."""

    buffer_size: Count = 1_000_000
    learning_starts: Annotated[int, Field(ge=0)] = 5_000
    batch_size: Count = 256
    tau: Annotated[float, Field(gt=0.0, le=1.0)] = 0.005
    gamma: Share = 0.98
    train_freq: Count = 1
    gradient_steps: Annotated[int, Field(ge=-1)] = 8
    n_steps: Count = 3

    @field_validator("gradient_steps")
    @classmethod
    def _some(cls, number: int) -> int:
        if number == 0:
            raise UnknownOption("gradient_steps", 0, ("any whole number from 1 on", "-1"))
        return number


@final
class Sac(OffPolicy):
    """Of ``stable_baselines3.SAC``."""

    ent_coef: (
        Annotated[str, Field(pattern=r"^auto(_(0\.\d*[1-9]\d*|[1-9]\d*(\.\d+)?))?$")] | NotNegative
    ) = "auto"
    target_entropy: Literal["auto"] | Finite = "auto"
    target_update_interval: Count = 1


@final
class Td3(OffPolicy):
    """Of ``stable_baselines3.TD3``; ``noise`` is the standard deviation of its action noise."""

    noise: NotNegative = 0.1
    policy_delay: Count = 2
    target_policy_noise: NotNegative = 0.2
    target_noise_clip: NotNegative = 0.5


ALGORITHMS: dict[str, type[AlgorithmSettings]] = {"ppo": Ppo, "sac": Sac, "td3": Td3}
"""The settings of each algorithm."""


@final
class Hindsight(Frozen):
    """Keyword arguments of ``stable_baselines3.HerReplayBuffer``."""

    n_sampled_goal: Count = 4
    goal_selection_strategy: Literal["future", "final", "episode"] = "future"


@final
class Rate(Frozen):
    """The learning rate.

    Attributes:
        initial: At the beginning.
        schedule: ``"constant"``; ``"linear"``: falls in a straight line; ``"adaptive"`` (PPO):
            divided by 1.5 after an update whose divergence is more than twice ``target_kl``, and
            multiplied by 1.5 after one with less than half of it.
        final: Share of the initial rate that is left at the end of ``"linear"``.
        target_kl: Divergence that ``"adaptive"`` aims at.
        lowest: Least rate of ``"adaptive"``.
        highest: Largest rate of ``"adaptive"``.

    Source:
        The adaptive schedule is that of Rudin et al., *Learning to Walk in Minutes*, CoRL 2021,
        here once for each update.
    """

    initial: Positive = 3e-4
    schedule: Literal["constant", "linear", "adaptive"] = "constant"
    final: Share = 0.0
    target_kl: Positive = 0.01
    lowest: Positive = 1e-5
    highest: Positive = 1e-2

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.lowest > self.highest:
            allowed = (f"at most {self.highest}, the highest rate",)
            raise UnknownOption("lowest learning rate", self.lowest, allowed)
        return self


@final
class Network(Frozen):
    """A multilayer perceptron.

    Attributes:
        hidden: Widths of its hidden layers.
        activation: After each of them.
        log_std: Logarithm of the standard deviation with which PPO begins.
        log_std_end: Ceiling of it at the end of the training; it falls in a straight line from the
            beginning. None: there is no ceiling.
        orthogonal: Whether PPO's weights begin as orthogonal matrices.
        scaled: Whether observations are multiplied by fixed scales first; see ``SCALES``.
    """

    hidden: Annotated[tuple[Count, ...], Field(min_length=1)] = (256, 256)
    activation: Literal["tanh", "relu"] = "tanh"
    log_std: Finite = 0.0
    log_std_end: Finite | None = None
    orthogonal: bool = True
    scaled: bool = False


def known_metric(name: str) -> str:
    """Refuse what evaluations do not measure."""
    one_of("metric", name, METRICS)
    return name


Metric = Annotated[str, AfterValidator(known_metric)]
"""One of ``METRICS``."""


@final
class Trials(Frozen):
    """Evaluations while an agent is trained; they do not change what it learns.

    Attributes:
        protocols: Names, see ``protocols_of``; none for no evaluation.
        episodes: Of each protocol, each time.
        times: How many evaluations there are, evenly spread.
        metric: One of ``scm_world.evaluation.METRICS``, by which the best policy is kept; None: the
            last fractional success, of a task without it success, else the return.
    """

    protocols: tuple[str, ...] = ("P0", "P5")
    episodes: Count = 20
    times: Count = 10
    metric: Metric | None = None


def observed(env: Mapping[str, Any], observations: Observations) -> dict[str, Any]:
    """Return options of an environment with the observations that a policy gets.

    Example:
        >>> observed({"frame_skip": 5}, "privileged")
        {'frame_skip': 5, 'context': 'observation'}
    """
    return {**env, "context": "observation"} if observations == "privileged" else dict(env)


def nested(path: str, value: Any) -> tuple[str, Any]:
    """Turn ``a.b`` and a value into ``a`` and the part of it that has this value.

    Example:
        >>> nested("network.hidden", [8])
        ('network', {'hidden': [8]})
    """
    first, *rest = path.split(".")
    for part in reversed(rest):
        value = {part: value}
    return first, value


def merged(before: Any, value: Any) -> Any:
    """Change the parts that a value names; what has no parts is replaced.

    Example:
        >>> merged({"a": 1, "b": {"c": 2, "d": 3}}, {"b": {"c": 0}})
        {'a': 1, 'b': {'c': 0, 'd': 3}}
    """
    if not (isinstance(before, Mapping) and isinstance(value, Mapping)):
        return value
    return {**before, **{name: merged(before.get(name), part) for name, part in value.items()}}


def refused(what: str, error: ValidationError) -> ScmWorldError:
    """Return the first error of a validation as one of this package."""
    first = error.errors()[0]
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, ScmWorldError):
        return cause
    path = ".".join(str(step) for step in first["loc"]) or "value"
    said = "nothing: there is no such field"
    if first["type"] != "extra_forbidden":
        said = str(first["msg"])[:1].lower() + str(first["msg"])[1:]
    return UnknownOption(f"{path} of {what}", first["input"], (said,))


Fields = Mapping[str, Any]

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
_PICKING: Fields = {
    "terms": _CARRYING["terms"],
    "weights": {
        **_CARRYING["weights"],
        "reward.block_to_center": 0.0,
        "reward.tips_to_block": 20.0,
        "reward.grasp": 0.5,
        "reward.block_to_height": 200.0,
    },
}
_PLACING = {**_CARRYING, "weights": {**_CARRYING["weights"], "reward.block_to_goal": 0.0}}


def _reacting(*numbers: str, also: tuple[str, ...] = (), **task_options: Any) -> Fields:
    """Return what a grasp by feedback reacts to, and actions relative to its command.

    Neither velocities nor torques are observed, in which engines differ most. With relative
    commands a network corrects errors until they are gone, whatever the fingers weigh.

    Args:
        numbers: Ends of the names of blocks and goals; one of each, without, if there are none.
        also: What else is observed.
        task_options: Arguments of the task, if any.
    """
    robot = ("joint_positions", "end_effector_positions", "action")
    bodies = (
        f"{body}{number}.cartesian_position"
        for body in ("tool_block", "goal_block")
        for number in numbers or ("",)
    )
    return {
        **({"task_options": task_options} if task_options else {}),
        "delta_origin": "command",
        "observation_mode": "custom",
        "observe": [*robot, *bodies, *also],
        "keypoints": "view",
    }


_MOVING: Fields = {
    "delta_scale": 0.04,
    "delta_origin": "command",
    "observation_mode": "custom",
    "observe": _SEEN,
}
_BY_REWARD: Fields = {
    "settings": {"n_steps": 32, "batch_size": 512},
    "rate": {"initial": 5e-4, "schedule": "adaptive", "target_kl": 0.02, "lowest": 5e-5},
    "network": {"log_std_end": -2.3, "scaled": True},
}
"""What brings a block somewhere from random weights."""

_WALL = ("obstacle.size",)  # how high a block has to go
_WIDE = {"activation": "relu", "hidden": (384, 384)}
_FROM_A_CLONE: Fields = {
    "network": {**_WIDE, "log_std": -4.5},
    "rate": {"initial": 1e-5, "schedule": "adaptive", "target_kl": 0.005, "lowest": 1e-6},
    "critic_warmup": 150_000,
    "steps": 500_000,
}
"""For a policy that can grasp, which more noise or larger updates spoil. It did not improve one."""

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
            "env": {"task_options": _PUSHING, **_MOVING},
            "episode_length": 125,
            "curriculum": resample("goal_block.cylindrical_position", "A"),
        },
        "ppo": {"steps": 3_000_000, **_BY_REWARD},
    },
    "picking": {
        None: {
            "env": {"task_options": _PICKING, **_MOVING},
            "episode_length": 125,
            "curriculum": 1,
        },
        "ppo": {"steps": 5_000_000, **_BY_REWARD},
    },
    "pick_and_place": {
        None: {"env": _reacting(also=_WALL, **_PLACING), "curriculum": 1},
        "ppo": _FROM_A_CLONE,
    },
    "stacking2": {
        None: {"env": _reacting("_1", "_2"), "curriculum": 1},
        "ppo": _FROM_A_CLONE,
    },
}
"""What differs from that, by task and algorithm."""

_BY_FEEDBACK: Fields = {
    "env": _reacting(),
    "protocols": ("P7", "P10"),
    "episodes": 12_000,
    "rounds": 0,
    "noise": 0.05,
    "keep": 0.5,
    "settled": 60,
    "symmetric": True,
    "network": _WIDE,
    "updates": 60_000,
    "batch": 1_024,
    "trials": {"protocols": ("P4", "P5", "P7", "P10"), "episodes": 20},
}
"""A teacher whose actions follow from the present shows much of A."""

_LIFTED: Fields = {**_BY_FEEDBACK, "episodes": 3_000, "updates": 30_000, "noise": 0.03}

LESSONS: Mapping[str, Fields] = {
    "pushing": _BY_FEEDBACK,
    "picking": _LIFTED,
    "pick_and_place": {
        **_LIFTED,
        "env": _reacting(also=_WALL),
        "protocols": ("P7", "P10", "P10", "P10"),
        "episodes": 7_000,
        "updates": 45_000,
        "noise": 0.02,
        "symmetric": False,
    },
    "stacking2": {
        **_LIFTED,
        "env": _reacting("_1", "_2"),
        "protocols": ("P5",),
        "episodes": 2_000,
        "noise": 0.02,
        "keep": 0.7,
        "settled": 150,
        "symmetric": False,
        "memory": True,
        "trials": {"protocols": ("P0", "P5"), "episodes": 20},
    },
}
"""What differs from the usual lesson of imitation, by task; of the environment also from
``Task.training``."""


def tuned(task: Task, algo: str) -> dict[str, Any]:
    """Return the fields of a recipe that work for a task, as far as it or we know."""
    found = dict(COMMON[algo])
    mine = {name: value for name, value in task.training.items() if name not in ALGORITHMS}
    ours = TUNED.get(task.name, {}) if type(task) is TASKS.get(task.name) else {}
    for fields in (mine, task.training.get(algo, {}), ours.get(None, {}), ours.get(algo, {})):
        found |= {
            name: {**found[name], **value} if isinstance(found.get(name), Mapping) else value
            for name, value in fields.items()
        }
    return found
