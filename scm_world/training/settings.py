"""Settings of the algorithms, by the names that Stable-Baselines3 has for them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self, final

from pydantic import AfterValidator, Field, ValidationError, field_validator, model_validator

from scm_world.errors import ScmWorldError, UnknownOption
from scm_world.tasks import tasks
from scm_world.tasks.model import FILES
from scm_world.variables.spaces import Frozen


def known_task(task: str) -> str:
    """Check that there is a task of this name, or that it may be a file or ``"module:function"``.

    Raises:
        UnknownOption: It is neither.
    """
    if task not in tasks() and not task.endswith(FILES) and ":" not in task:
        raise UnknownOption("task", task, (*tasks(), *(f"file{end}" for end in FILES), "module:f"))
    return task


TaskName = Annotated[str, AfterValidator(known_task)]
Count = Annotated[int, Field(ge=1)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Observations = Literal["plain", "privileged"]
"""What a policy sees: its task, or every causal parameter besides."""
AUTO = r"^auto(_(0\.\d*[1-9]\d*|[1-9]\d*(\.\d+)?))?$"


def seen(env: Mapping[str, Any], observations: Observations) -> dict[str, Any]:
    """Give options of an environment in which a policy sees what it may.

    Example:
        >>> seen({"frame_skip": 5}, "privileged")
        {'frame_skip': 5, 'context': 'observation'}
    """
    return {**env, "context": "observation"} if observations == "privileged" else dict(env)


class Settings(Frozen):
    """Settings of an algorithm."""


@final
class Ppo(Settings):
    """Proximal policy optimization: Schulman et al., arXiv:1707.06347.

    Attributes:
        n_steps: Control steps of each world between updates.
        batch_size: Steps of a minibatch.
        n_epochs: How often each step is used.
        gamma: Discount of a control step.
        gae_lambda: Of the generalized advantage.
        clip_range: How far the ratio of probabilities may go.
        clip_range_vf: How far the value may go; any distance if None.
        normalize_advantage: Whether advantages of a minibatch are standardized.
        ent_coef: Weight of the entropy.
        vf_coef: Weight of the error of the value.
        max_grad_norm: To which gradients are clipped.
        target_kl: Updates stop at 1.5 times this divergence; never if None.
    """

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


class OffPolicy(Settings):
    """What SAC and TD3 have in common.

    Attributes:
        buffer_size: Control steps that are remembered, of all worlds together.
        learning_starts: Control steps before the first update; actions are random until then.
        batch_size: Steps of a minibatch.
        tau: How much of the network goes into the target network with each update.
        gamma: Discount of a control step.
        train_freq: Control steps of each world between updates.
        gradient_steps: Updates each time; -1 for as many as there were control steps.
        n_steps: Control steps over which rewards are summed before the value is asked.
    """

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
    """Soft actor-critic: Haarnoja et al., arXiv:1812.05905.

    Attributes:
        ent_coef: Weight of the entropy; ``"auto"``, or ``"auto_0.1"`` to begin with 0.1.
        target_entropy: At which ``"auto"`` aims; minus the number of actions with ``"auto"``.
        target_update_interval: Updates between those of the target network.
    """

    ent_coef: Annotated[str, Field(pattern=AUTO)] | NotNegative = "auto"
    target_entropy: Literal["auto"] | Finite = "auto"
    target_update_interval: Count = 1


@final
class Td3(OffPolicy):
    """Twin delayed deep deterministic policy gradient: Fujimoto et al., arXiv:1802.09477.

    Attributes:
        noise: Standard deviation of what is added to actions while collecting.
        policy_delay: Updates of the values for each one of the policy.
        target_policy_noise: Standard deviation of what is added to actions of the target.
        target_noise_clip: To which that is clipped.
    """

    noise: NotNegative = 0.1
    policy_delay: Count = 2
    target_policy_noise: NotNegative = 0.2
    target_noise_clip: NotNegative = 0.5


@final
class Hindsight(Frozen):
    """Hindsight experience replay: Andrychowicz et al., arXiv:1707.01495.

    Attributes:
        n_sampled_goal: Goals that are made up for each one that was given.
        goal_selection_strategy: Where they come from: later in the episode, at its end, or
            anywhere in it.
    """

    n_sampled_goal: Count = 4
    goal_selection_strategy: Literal["future", "final", "episode"] = "future"


@final
class Rate(Frozen):
    """The learning rate, and how it changes.

    Attributes:
        initial: At the beginning.
        schedule: ``"constant"``; ``"linear"``: falls in a straight line; ``"adaptive"``: after
            each update of PPO it is divided by 1.5 if the divergence of the new policy from the
            old one is more than twice ``target_kl``, and multiplied by 1.5 if it is less than
            half of it.
        final: Share of the initial rate that is left at the end of ``"linear"``.
        target_kl: Divergence that ``"adaptive"`` aims at.
        lowest: Where ``"adaptive"`` ends.
        highest: Likewise.

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
        activation: What follows each of them.
        log_std: Logarithm of the standard deviation with which PPO begins.
        log_std_end: Ceiling of it at the end of the training; it falls in a straight line from the
            beginning. None: there is no ceiling.
        orthogonal: Whether PPO's weights begin as orthogonal matrices.
        scaled: Whether observations are multiplied by fixed scales first; see ``scales``.
    """

    hidden: Annotated[tuple[Count, ...], Field(min_length=1)] = (256, 256)
    activation: Literal["tanh", "relu"] = "tanh"
    log_std: Finite = 0.0
    log_std_end: Finite | None = None
    orthogonal: bool = True
    scaled: bool = False


@final
class Trials(Frozen):
    """Evaluations while an agent is trained; they do not change what it learns.

    Attributes:
        protocols: Names, see ``protocols_of``; none for no evaluation.
        episodes: Of each protocol, each time.
        times: How many evaluations there are, evenly spread.
    """

    protocols: tuple[str, ...] = ("P0", "P5")
    episodes: Count = 20
    times: Count = 10


ALGORITHMS: dict[str, type[Settings]] = {"ppo": Ppo, "sac": Sac, "td3": Td3}
"""The algorithms, each with its settings."""


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
    """Say in the words of this package what was wrong first."""
    first = error.errors()[0]
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, ScmWorldError):
        return cause
    path = ".".join(str(step) for step in first["loc"]) or "value"
    if first["type"] == "extra_forbidden":
        allowed = ("nothing: there is no such field",)
        return UnknownOption(f"{path} of {what}", first["input"], allowed)
    said = str(first["msg"])
    return UnknownOption(f"{path} of {what}", first["input"], (said[:1].lower() + said[1:],))
