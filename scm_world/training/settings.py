"""Parts of recipes and lessons: settings of the algorithms, rates, networks, evaluations."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar, final

from pydantic import AfterValidator, Field, ValidationError, field_validator, model_validator

from scm_world._arguments import load, one_of, plain
from scm_world.errors import ScmWorldError, UnknownOption
from scm_world.evaluation.episodes import METRICS
from scm_world.policies.cards import EVERY, context_of
from scm_world.tasks import TASKS, Task, tasks
from scm_world.tasks.sources import FILES, is_named
from scm_world.variables.spaces import Frozen


def known_task(task: str) -> str:
    """Check that a text is the name of a task, or may be a file or ``"module:function"``."""
    if not is_named(task):
        raise UnknownOption("task", task, (*tasks(), *(f"file{end}" for end in FILES), "module:f"))
    return task


TaskName = Annotated[str, AfterValidator(known_task)]
Count = Annotated[int, Field(ge=1)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Observations = Literal["plain", "privileged"]
"""What a policy observes: its task, or also the causal parameters."""


Made = TypeVar("Made", bound=Frozen)


@final
class Ppo(Frozen):
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


class OffPolicy(Frozen):
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


ALGORITHMS: dict[str, type[Ppo | OffPolicy]] = {
    "ppo": Ppo,
    "sac": Sac,
    "td3": Td3,
    "rsl_ppo": Ppo,
    "recurrent_ppo": Ppo,
}
"""The settings of each algorithm: keyword arguments of Stable-Baselines3, by its names. The last
ones are PPO of rsl-rl, for thousands of worlds, and recurrent PPO of sb3-contrib."""


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
        recurrent: Width of an LSTM before them, whose state lasts an episode. None: without one.
        activation: After each of them.
        log_std: Logarithm of the standard deviation with which PPO begins.
        log_std_end: Ceiling of it at the end of the training; it falls in a straight line from the
            beginning. None: without a ceiling.
        orthogonal: Whether PPO's weights begin as orthogonal matrices.
        scaled: Whether observations are multiplied by fixed scales first; see ``SCALES``.
    """

    hidden: Annotated[tuple[Count, ...], Field(min_length=1)] = (256, 256)
    recurrent: Count | None = None
    activation: Literal["tanh", "relu"] = "tanh"
    log_std: Finite = 0.0
    log_std_end: Finite | None = None
    orthogonal: bool = True
    scaled: bool = False


def known_metric(name: str) -> str:
    """Refuse a metric that evaluations do not have."""
    one_of("metric", name, METRICS)
    return name


Metric = Annotated[str, AfterValidator(known_metric)]
"""One of ``METRICS``."""


@final
class Trials(Frozen):
    """Evaluations while an agent is trained; they do not change the training.

    Attributes:
        protocols: Names, see ``protocols_of``; none for no evaluation.
        episodes: Episodes of each protocol, each time.
        times: How many evaluations there are, evenly spread.
        backend: Name of their engine; that of the training if None.
        metric: One of ``scm_world.evaluation.METRICS``, by which the best policy is kept; None: the
            last fractional success, of a task without it success, else the return.
    """

    protocols: tuple[str, ...] = ("P0", "P5")
    episodes: Count = 20
    times: Count = 10
    backend: str | None = None
    metric: Metric | None = None


def observed(env: Mapping[str, Any], observations: str) -> dict[str, Any]:
    """Return options of an environment with the observations that a policy or its critic gets.

    All parameters are observed, or those of ``env["context"]``.

    Example:
        >>> observed({"frame_skip": 5}, "privileged")
        {'frame_skip': 5, 'context': 'observation'}
    """
    if observations == "plain":
        return dict(env)
    _, names = context_of(env.get("context", "none"))
    return {**env, "context": "observation" if names == EVERY else {"observation": [*names]}}


def built(
    kind: type[Made],
    what: str,
    fields: Mapping[str, Any],
    changes: Mapping[str, Any] | None = None,
    settings: Collection[str] = (),
) -> Made:
    """Make a recipe or a lesson of fields and changes.

    A change named ``a.b`` is one of the part ``b`` of ``a``. Parts of a mapping that it does not
    name stay as they are; any other value replaces the old one.

    Args:
        kind: Class that is made.
        what: Its name in an error, such as ``"a recipe"``.
        fields: Its fields.
        changes: Settings that differ from these.
        settings: Names that stand for the part ``settings.name``.

    Raises:
        UnknownOption: A field is unknown, or a value is impossible.

    Example:
        >>> built(Rate, "a rate", {"initial": 0.1}, {"final": 0.5}).final
        0.5
    """
    found = copy.deepcopy(dict(fields))
    for name, given in (changes or {}).items():
        value, (first, *rest) = given, name.split(".")
        if first not in kind.model_fields and first in settings:
            first, rest = "settings", [first, *rest]
        if first not in kind.model_fields:
            raise UnknownOption(f"field of {what}", name, (*kind.model_fields, *settings))
        for part in reversed(rest):
            value = {part: value}
        found[first] = _merged(found.get(first), value)
    try:
        return kind.model_validate(plain(found))
    except ValidationError as error:
        first_error = error.errors()[0]
    cause = first_error.get("ctx", {}).get("error")
    if isinstance(cause, ScmWorldError):
        raise cause
    path = ".".join(str(step) for step in first_error["loc"]) or "value"
    said = "left out: this field is unknown"
    if first_error["type"] != "extra_forbidden":
        said = str(first_error["msg"])[:1].lower() + str(first_error["msg"])[1:]
    raise UnknownOption(f"{path} of {what}", first_error["input"], (said,))


def _merged(before: object, value: object) -> Any:
    if not (isinstance(before, Mapping) and isinstance(value, Mapping)):
        return value
    return {**before, **{name: _merged(before.get(name), part) for name, part in value.items()}}


@cache
def presets() -> Mapping[str, Any]:
    """Return the settings that work, of ``presets.yaml``: algorithms, recipes, lessons."""
    yaml = load("yaml", "pyyaml")
    text = (Path(__file__).parent / "presets.yaml").read_text("utf-8")
    found: Mapping[str, Any] = yaml.safe_load(text)
    return found


def tuned(task: Task, algo: str) -> dict[str, Any]:
    """Return the fields of a recipe that work for a task, as far as it or we know."""
    found: dict[str, Any] = copy.deepcopy(presets()["algorithms"][algo])
    mine = {name: value for name, value in task.training.items() if name not in ALGORITHMS}
    is_ours = type(task) is TASKS.get(task.name)
    ours = presets()["recipes"].get(task.name, {}) if is_ours else {}
    for fields in (mine, task.training.get(algo, {}), ours.get("all", {}), ours.get(algo, {})):
        found = _merged(found, fields)
    return found
