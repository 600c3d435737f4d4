"""What a trained policy says of itself: its task, how it sees and acts, and how it was made."""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping
from typing import Any, Literal, Self, final

from pydantic import Field, JsonValue, ValidationError, field_validator

from scm_world.env import ScmWorldEnv
from scm_world.errors import ModelError, UnknownOption
from scm_world.tasks import tasks
from scm_world.variables.spaces import Frozen

KEY = "scm_world"
"""Under which a file keeps it, among its metadata."""

RELATIVE = ("delta_scale", "delta_origin")
"""Options of an environment that say what relative actions mean."""

FORM = (
    "action_mode",
    *RELATIVE,
    "normalize_actions",
    "observation_mode",
    "observe",
    "include",
    "context",
    "keypoints",
    "normalize_observations",
    "goal_env",
)
"""Options of an environment that decide what is observed and what actions mean."""

COMMON = ("frame_skip", "conventions")
"""Options that have to be the same for all who are compared, and for the policy itself."""

FREE = ("preset", "max_episode_length")
"""Options that a policy was trained with, and that may be others."""

OPTIONS = (*FORM, *COMMON, *FREE)


def plain(value: Any) -> Any:
    """Give an option as JSON has it, for comparisons.

    Example:
        >>> plain(("a", "b"))
        ['a', 'b']
    """
    return [plain(one) for one in value] if isinstance(value, tuple | list) else value


USUAL: Mapping[str, Any] = {
    name: plain(inspect.signature(ScmWorldEnv).parameters[name].default) for name in OPTIONS
}
"""What these options are if nothing is said; None is the task's own."""


def usual(option: str, task: str) -> Any:
    """Give what an option is if nothing is said; None where only the task itself knows it.

    Example:
        >>> usual("frame_skip", "pushing"), usual("frame_skip", "cartpole.xml")
        (10, None)
    """
    kind = tasks().get(task)
    if kind is None or option not in ("action_mode", "preset", "frame_skip"):
        return USUAL[option]
    if option == "frame_skip":
        return getattr(kind, option, None)
    return next(iter(getattr(kind, f"{option}s", ())), None)


@final
class PolicyAbout(Frozen):
    """What stands in the file of a trained policy besides its weights.

    Attributes:
        format: Of this text.
        version: Of the format.
        task: Name of the task.
        env: Options of the environment, those of ``OPTIONS``; what is not named is as usual.
        activation: After each hidden layer.
        output: What keeps actions in [-1, 1].
        inputs: Parts of an observation in a dictionary, in the order in which they are joined;
            None: the observation is one array.
        card: How it was made and how well it does, as JSON.
    """

    format: Literal["scm_world.policy"] = "scm_world.policy"
    version: Literal[1] = 1
    task: str = Field(min_length=1)
    env: dict[str, JsonValue] = Field(default_factory=dict)
    activation: Literal["tanh", "relu"] = "tanh"
    output: Literal["clip", "tanh"] = "clip"
    inputs: tuple[str, ...] | None = None
    card: dict[str, JsonValue] = Field(default_factory=dict)

    @field_validator("env", "card")
    @classmethod
    def _finite(cls, given: Any) -> Any:
        try:
            json.dumps(given, allow_nan=False)
        except ValueError:
            raise ValueError("JSON has no numbers that are not finite; give None instead") from None
        return given

    @field_validator("env", mode="before")
    @classmethod
    def _as_json(cls, env: Any) -> Any:
        if not isinstance(env, Mapping):
            return env
        for name in env:
            if name not in OPTIONS:
                raise ValueError(f"{name!r} is none of the options {', '.join(OPTIONS)}")
        return {name: plain(value) for name, value in env.items()}

    @field_validator("inputs")
    @classmethod
    def _each_once(cls, inputs: tuple[str, ...] | None) -> tuple[str, ...] | None:
        if inputs is not None and not 0 < len(set(inputs)) == len(inputs):
            raise ValueError(f"parts of an observation, each once; got {inputs}")
        return inputs

    def option(self, name: str) -> Any:
        """Give an option of the environment, as JSON has it; None is the task's own."""
        return self.env.get(name, usual(name, self.task))

    def unusual(self, names: tuple[str, ...]) -> dict[str, Any]:
        """Give those of some options that are not as usual."""
        found = {name: self.option(name) for name in names}
        return {name: v for name, v in found.items() if v != usual(name, self.task)}

    def with_card(self, **entries: Any) -> Self:
        """Give the same with other entries of the card."""
        return type(self)(**{**self.model_dump(), "card": {**self.card, **entries}})

    def text(self) -> str:
        """Write it down as JSON."""
        return json.dumps(self.model_dump(mode="json"), allow_nan=False)

    @classmethod
    def of(cls, given: Mapping[str, Any] | str | PolicyAbout) -> Self:
        """Make it from what it has, or from its text.

        Raises:
            ModelError: Something is wrong; all of it is named.
        """
        if isinstance(given, cls):
            return given
        try:
            if isinstance(given, str):
                return cls.model_validate_json(given)
            return cls.model_validate(given)
        except ValidationError as error:
            raise ModelError([_said(problem) for problem in error.errors()]) from None


def refuse_other_form(made_for: PolicyAbout | None, env: ScmWorldEnv, name: str) -> None:
    """Refuse an environment that shows other things, or in which actions mean others.

    Args:
        made_for: What the policy was trained for, if it says so.
        env: Where it should act.
        name: Of the policy, for the message.

    Raises:
        UnknownOption: An option is not the one that the policy was trained with.
    """
    if made_for is None:
        return
    for option in (*FORM, *COMMON):
        given, wanted = plain(env.made_with[option]), made_for.option(option)
        if wanted is not None and given != wanted:
            raise contradiction(option, given, wanted, name)


def contradiction(option: str, given: Any, wanted: Any, name: str) -> UnknownOption:
    """Say that an option is not the one that a policy was trained with."""
    return UnknownOption(f"{option} for {name!r}", given, (f"{wanted!r}, as in its training",))


def _said(problem: Any) -> str:
    where = ".".join(map(str, problem["loc"])) or "the text"
    return f"{where}: {problem['msg']}"
