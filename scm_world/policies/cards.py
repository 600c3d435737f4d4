"""Metadata of trained policies: task, observations, actions, and a card."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from contextlib import suppress
from types import MappingProxyType
from typing import Any, Literal, Protocol, Self, cast, final

import gymnasium
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, JsonValue, ValidationError, field_validator
from pydantic_core import to_jsonable_python

from scm_world._arguments import plain
from scm_world._patterns import as_names
from scm_world._types import ArrayLike, Observation
from scm_world.errors import ModelError, UnknownOption
from scm_world.tasks import tasks
from scm_world.variables.spaces import Frozen, problems_of
from scm_world.world import Simulation

KEY = "scm_world"
"""Metadata entry of a policy file that holds a ``PolicyAbout``."""

HISTORY = "history"
"""Part of an observation with its last pairs, shape (k, n), where it stands by itself."""

FORM: Mapping[str, JsonValue] = {
    "action_mode": None,
    "delta_scale": 1.0,
    "delta_origin": "command",
    "normalize_actions": True,
    "observation_mode": "structured",
    "observe": [],
    "include": [],
    "context": "none",
    "keypoints": False,
    "pad": None,
    "normalize_observations": True,
    "history": 0,
    "stack_history": False,
    "goal_env": False,
}
"""Options of an environment that define observations and actions, with the defaults of files."""

COMMON: Mapping[str, JsonValue] = {"frame_skip": None, "conventions": "scm_world"}
"""Options that must be equal for all compared policies, and equal to those of the training."""

FREE: Mapping[str, JsonValue] = {"preset": None, "max_episode_length": None}
"""Options of the training that may differ in an evaluation."""

ANY = "any"
"""The task of a policy that says how it observes and acts, and not for which task."""

USUAL: Mapping[str, JsonValue] = {**FORM, **COMMON, **FREE}
"""Defaults of all these options, which are those of the environment; None is the task's own."""

OPTIONS = tuple(USUAL)


CONTEXTS = ("none", "observation", "privileged")
"""Where an environment has the values of parameters: nowhere, in the observation, beside it."""

EVERY = ("*",)
"""The pattern of all parameters."""


def context_of(given: Any) -> tuple[str, tuple[str, ...]]:
    """Return where the option ``context`` has parameters, and their names and patterns.

    Example:
        >>> context_of("privileged"), context_of({"privileged": "*.mass"})
        (('privileged', ('*',)), ('privileged', ('*.mass',)))
    """
    if isinstance(given, str) and given in CONTEXTS:
        return given, EVERY
    mode, names = "observation", given
    if isinstance(given, Mapping):
        (mode, names) = next(iter(given.items()), ("", ()))
    wanted = as_names(names) if isinstance(names, Iterable) else ()
    is_text = bool(wanted) and all(isinstance(name, str) for name in wanted)
    if not is_text or mode not in CONTEXTS[1:] or (isinstance(given, Mapping) and len(given) > 1):
        allowed = (*CONTEXTS, "names or patterns of parameters", "{'privileged': names}")
        raise UnknownOption("context", given, allowed)
    return mode, wanted


def option_form(name: str, given: object) -> JsonValue:
    """Return an option of the environment as JSON, for comparisons: equal contexts are equal."""
    if name == "context":
        with suppress(UnknownOption):
            mode, names = context_of(given)
            return mode if names == EVERY else {mode: [*names]}
    return cast("JsonValue", to_jsonable_python(given, fallback=plain))


class PolicyEnv(Protocol):
    """An environment in which a policy acts: a ``ScmWorldEnv``."""

    action_space: gymnasium.Space[Any]

    @property
    def world(self) -> Simulation:
        """Its world."""

    @property
    def made_with(self) -> Mapping[str, Any]:
        """Its options, by name."""

    def observe(self) -> Observation:
        """Return the present observation."""

    def as_action(self, command: ArrayLike) -> NDArray[np.float64]:
        """Return the action that leads to a command [SI units]."""


def usual(option: str, task: str) -> JsonValue:
    """Return the default of an option; None where only the task itself knows it.

    Example:
        >>> usual("frame_skip", "pushing"), usual("frame_skip", "cartpole.xml")
        (10, None)
    """
    kind = tasks().get(task)
    if kind is None or option not in ("action_mode", "preset", "frame_skip"):
        return USUAL[option]
    if option == "frame_skip":
        return cast("int | None", getattr(kind, option, None))
    return next(iter(getattr(kind, f"{option}s", ())), None)


@final
class PolicyAbout(Frozen):
    """Metadata of a trained policy.

    Attributes:
        format: Name of the format.
        version: Version of the format.
        task: Name of the task, or ``"any"``.
        env: Options of the environment, those of ``OPTIONS``; the others have their defaults.
        activation: After each hidden layer.
        output: Keeps actions in [-1, 1].
        inputs: Parts of a dictionary observation in the order in which they are joined; None: the
            observation is one array.
        memory: How many numbers the network gives after its action; it gets their signs back after
            the next observation, and zeros in an episode's first control step.
        card: How it was trained and how well it does, as JSON.
    """

    format: Literal["scm_world.policy"] = "scm_world.policy"
    version: Literal[1] = 1
    task: str = Field(min_length=1)
    env: dict[str, JsonValue] = Field(default_factory=dict)
    activation: Literal["tanh", "relu"] = "tanh"
    output: Literal["clip", "tanh"] = "clip"
    inputs: tuple[str, ...] | None = None
    memory: int = Field(default=0, ge=0)
    card: dict[str, JsonValue] = Field(default_factory=dict)

    @field_validator("env", "card")
    @classmethod
    def _finite(cls, given: object) -> object:
        try:
            json.dumps(given, allow_nan=False)
        except ValueError:
            raise ValueError("JSON has no numbers that are not finite; give None instead") from None
        return given

    @field_validator("env", mode="before")
    @classmethod
    def _as_json(cls, env: object) -> object:
        if not isinstance(env, Mapping):
            return env
        for name in env:
            if name not in OPTIONS:
                raise ValueError(f"{name!r} is not one of the options {', '.join(OPTIONS)}")
        return {name: option_form(name, given) for name, given in env.items()}

    @field_validator("inputs")
    @classmethod
    def _each_once(cls, inputs: tuple[str, ...] | None) -> tuple[str, ...] | None:
        if inputs is not None and not 0 < len(set(inputs)) == len(inputs):
            raise ValueError(f"parts of an observation, each once; got {inputs}")
        return inputs

    @classmethod
    def in_env(cls, env: object, card: Mapping[str, object] = MappingProxyType({})) -> Self:
        """Return the metadata of a policy that was trained in an environment.

        Args:
            env: An environment of this package, in any wrappers, or many of them.
            card: How it was trained, as JSON.

        Raises:
            UnknownOption: It is not of this package.
        """
        inner: Any = getattr(env, "unwrapped", env)
        try:
            many = env.get_attr("made_with") if hasattr(env, "get_attr") else (inner.made_with,)
        except AttributeError:
            given = type(inner).__name__
            raise UnknownOption("environment of a policy", given, ("ScmWorldEnv",)) from None
        made_with = many[0]
        task = made_with["task"]
        name = task if isinstance(task, str) else getattr(task, "name", str(task))
        return cls(task=name, env={name: made_with[name] for name in OPTIONS}, card=dict(card))

    def option(self, name: str) -> JsonValue:
        """Return an option of the environment, as JSON has it; None is the task's own."""
        return self.env.get(name, usual(name, self.task))

    def unusual(self, names: Iterable[str]) -> dict[str, Any]:
        """Return those of some options that differ from their defaults."""
        found = {name: self.option(name) for name in names}
        return {name: v for name, v in found.items() if v != usual(name, self.task)}

    def with_card(self, **entries: object) -> Self:
        """Return a copy with other entries of the card."""
        return type(self)(**{**self.model_dump(), "card": {**self.card, **entries}})

    def text(self) -> str:
        """Return it as JSON; without the field ``memory``, which is newer, where that is 0."""
        left_out = set() if self.memory else {"memory"}
        return json.dumps(self.model_dump(mode="json", exclude=left_out), allow_nan=False)

    @classmethod
    def of(cls, given: Mapping[str, Any] | str | PolicyAbout) -> Self:
        """Make it from its fields or its JSON.

        Raises:
            ModelError: Some fields are wrong; all of them are named.
        """
        if isinstance(given, cls):
            return given
        try:
            if isinstance(given, str):
                return cls.model_validate_json(given)
            return cls.model_validate(given)
        except ValidationError as error:
            raise ModelError(problems_of(error)) from None

    def check(self, env: PolicyEnv, name: str) -> None:
        """Check that an environment has the observations and actions of the training.

        Args:
            env: The environment in which the policy should act.
            name: Name of the policy, for the message.

        Raises:
            UnknownOption: An option differs from that of the training.
        """
        for option in (*FORM, *COMMON):
            given, wanted = option_form(option, env.made_with[option]), self.option(option)
            if wanted is not None and given != wanted:
                raise contradiction(option, given, wanted, name)


def contradiction(option: str, given: object, wanted: object, name: str) -> UnknownOption:
    """Return the error that an option differs from that of the training."""
    return UnknownOption(f"{option} for {name!r}", given, (f"{wanted!r}, as in its training",))
