"""Players: policies of every kind behind two methods, ``begin`` and ``act``."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, final, runtime_checkable

import gymnasium
import numpy as np
from numpy.typing import NDArray

from scm_world.env import ScmWorldEnv
from scm_world.errors import ActionError, UnknownOption
from scm_world.evaluation.policies.cards import PolicyAbout
from scm_world.evaluation.policies.mlp import MlpPolicy
from scm_world.queries.policies import Policy

Actions = NDArray[Any]
About = dict[str, Any]
"""What a policy is, as plain data: its kind, its name, and where it comes from."""

_FLOATS = (np.dtype(np.float32), np.dtype(np.float64))


@runtime_checkable
class Player(Protocol):
    """Someone who acts in an environment, episode after episode."""

    @property
    def about(self) -> About:
        """What the policy is; ``player_from`` makes it again where that is possible."""

    def begin(self, env: ScmWorldEnv) -> None:
        """Take note of a new episode; called after every reset.

        Args:
            env: Whose episode has begun.
        """

    def act(self, observation: Any) -> Actions:
        """Choose an action of the environment, shape (n_actions,).

        Args:
            observation: What the environment shows: an array, or arrays by name.

        Raises:
            ActionError: The policy gave something else.
        """


def checked(action: Any, env: gymnasium.Env[Any, Any] | None, name: str) -> Actions:
    """Check that a policy gave finite numbers; numbers beyond the range are left alone.

    Args:
        action: What it gave.
        env: Where it acts, which says how many numbers there are; any number if None.
        name: Of the policy.

    Returns:
        The same array; anything but floats becomes 64-bit floats.

    Raises:
        ActionError: It is no such array.

    Example:
        >>> checked([0] * 9, None, "lazy")
        array([0., 0., 0., 0., 0., 0., 0., 0., 0.])
        >>> checked([0.0, float("nan")], None, "wild")
        Traceback (most recent call last):
        scm_world.errors.ActionError: the policy 'wild' gave [0.0, nan]; an action is an array of
        shape (n,) with finite numbers
    """
    shape = None if env is None else env.action_space.shape
    if type(action) is np.ndarray and action.dtype in _FLOATS and action.shape == shape:
        found: Actions = action
        if math.isfinite(sum(action.tolist())):  # faster than numpy for a few numbers
            return found
    else:
        found = _as_floats(action)
    if (found.shape == shape or (shape is None and found.ndim == 1)) and np.isfinite(found).all():
        return found
    where = "" if env is None else f" of {env.action_space}"
    raise ActionError(
        f"the policy {name!r} gave {action!r}; an action is an array of shape {shape or '(n,)'} "
        f"with finite numbers{where}",
        action,
    )


def _as_floats(action: Any) -> Actions:
    try:
        found = np.asarray(action)
        if found.dtype.kind == "f":
            return found
        return found.astype(np.float64, casting="safe" if found.dtype.kind in "bui" else "no")
    except (TypeError, ValueError):
        return np.empty((0, 0))


@final
@dataclass(frozen=True)
class WorldPolicy:
    """Marks a policy that looks at the world instead of the observation.

    It is called with the world of the environment and gives an action in the units of the action
    mode (rad, N m or m), shape (n_actions,). It serves as a decorator.

    Attributes:
        policy: The function; a class is made anew for every episode.

    Example:
        >>> @WorldPolicy
        ... def lazy(world):
        ...     return 0.5 * (world.action_low + world.action_high)
    """

    policy: Callable[..., Any]

    def __call__(self, world: Any) -> Any:
        """Choose the action."""
        return self.policy(world)


class Playing:
    """What all players here share: who they are, and where they act."""

    def __init__(self, about: Mapping[str, Any]) -> None:
        self._about, self._name = dict(about), str(about["name"])
        self._env: ScmWorldEnv | None = None

    @property
    def about(self) -> About:
        """What the policy is, as plain data."""
        return dict(self._about)

    @property
    def is_plain(self) -> bool:
        """Whether its actions are known to follow from what it observed in the episode alone."""
        return False

    @property
    def made_for(self) -> PolicyAbout | None:
        """What the policy was trained for, if it says so."""
        return None

    def twin(self) -> Player | None:
        """Give a player of the same policy for another episode at the same time.

        Returns:
            None if the policy plays one episode at a time.
        """
        return None

    def _checked(self, action: Any) -> Actions:
        return checked(action, self._env, self._name)


def inner(env: gymnasium.Env[Any, Any]) -> ScmWorldEnv:
    """Give the environment of this package that a wrapper is about.

    Raises:
        UnknownOption: There is none.
    """
    found = env.unwrapped
    if not isinstance(found, ScmWorldEnv):
        raise UnknownOption("environment", type(found).__name__, ("an environment of scm_world",))
    return found


@final
class ByObservation(Playing):
    """Calls a function of the observation; its method ``reset`` begins an episode, if it has one.

    Args:
        policy: Gives an action.
        about: What it is.
    """

    def __init__(self, policy: Callable[[Any], Any], about: Mapping[str, Any]) -> None:
        super().__init__(about)
        self._policy = policy

    def begin(self, env: ScmWorldEnv) -> None:
        """Let the policy forget the last episode."""
        self._env = env
        forget(self._policy)

    def twin(self) -> Player | None:
        """Give another player of the policy, unless that has to be told when an episode begins."""
        return None if _forgets(self._policy) else ByObservation(self._policy, self._about)

    def act(self, observation: Any) -> Actions:
        """Choose an action, shape (n_actions,)."""
        return self._checked(self._policy(observation))


def forget(policy: Any) -> None:
    """Call the method ``reset`` of a policy, if it has one."""
    if _forgets(policy):
        policy.reset()


def _forgets(policy: Any) -> bool:
    return callable(getattr(policy, "reset", None))


_LIBRARIES = ("stable_baselines3", "sb3_contrib")
"""Whose models are told what they remember, and keep nothing to themselves."""


@final
class ByPrediction(Playing):
    """Asks a model of Stable-Baselines3, or whatever has its method ``predict``.

    What a recurrent model remembers is carried from step to step, and forgotten at a reset.

    Args:
        model: It is asked for its deterministic action.
        about: What it is.
    """

    def __init__(self, model: Any, about: Mapping[str, Any]) -> None:
        super().__init__(about)
        self._model, self._state, self._first = model, None, True

    def begin(self, env: ScmWorldEnv) -> None:
        """Forget the last episode."""
        self._env, self._state, self._first = env, None, True

    @property
    def is_plain(self) -> bool:
        """Whether it is a policy of this package, or a model of Stable-Baselines3 itself."""
        package = type(self._model).__module__.partition(".")[0]
        return isinstance(self._model, MlpPolicy) or package in _LIBRARIES

    def twin(self) -> Player:
        """Give another player of the model; what is remembered is the player's."""
        return ByPrediction(self._model, self._about)

    def act(self, observation: Any) -> Actions:
        """Choose an action, shape (n_actions,)."""
        action, self._state = self._model.predict(
            observation,
            state=self._state,
            episode_start=np.array([self._first]),
            deterministic=True,
        )
        self._first = False
        return self._checked(action)


@final
class ByWorld(Playing):
    """Asks a policy that looks at the world.

    Args:
        make: Gives the policy of one episode.
        about: What it is.
    """

    def __init__(self, make: Callable[[], Policy], about: Mapping[str, Any]) -> None:
        super().__init__(about)
        self._make = make

    def begin(self, env: ScmWorldEnv) -> None:
        """Make the policy of a new episode."""
        self._env, self._policy = env, self._make()
        forget(self._policy)

    def act(self, observation: Any) -> Actions:
        """Choose an action, shape (n_actions,), dtype float64; it is not rounded.

        Where actions are relative it leads as near to what the policy asks for as one can.
        """
        if self._env is None:
            raise ActionError(f"the policy {self._name!r} acts in no episode; call begin()", None)
        command = self._checked(self._policy(self._env.world))
        return self._env.toward(command)
