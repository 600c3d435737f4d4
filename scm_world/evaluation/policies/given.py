"""Players whose actions are given from the beginning: episodes that are played again."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world.env import ScmWorldEnv
from scm_world.env.delta import PREFIX
from scm_world.env.given import action_scale
from scm_world.errors import ActionError, UnknownOption
from scm_world.evaluation.policies.players import Actions, Player, Playing
from scm_world.world import World


@final
class OpenLoop(Playing):
    """Plays given actions, whatever happens; the last one is held.

    In an environment with the same kind of actions they are played as they are, bit for bit. In
    one with other units they are converted, which rounds them to 64-bit floats.

    Args:
        actions: Shape (steps, n).
        about: What they are.
        action_mode: What they mean; the same as the environment's if None.
        normalized: Whether they lie in [-1, 1], or are in SI units.
        relative: Options of the environment that say what relative actions mean, if it is known.

    Raises:
        ActionError: They have another shape, or are not finite.
    """

    def __init__(
        self,
        actions: NDArray[Any],
        about: Mapping[str, Any],
        *,
        action_mode: str | None = None,
        normalized: bool = False,
        relative: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(about)
        given = np.asarray(actions)
        if given.ndim != 2 or not len(given):
            raise ActionError("actions have shape (steps, n), with one step at least", actions)
        for action in given:
            self._checked(action)
        self._given, self._mode, self._normalized = given, action_mode, normalized
        self._relative = dict(relative or {})
        self._actions, self._step = given, 0

    @property
    def is_plain(self) -> bool:
        """Whether its actions depend on nothing but the control step: they do."""
        return True

    def twin(self) -> Player:
        """Give another player of the same actions."""
        return copy(self)

    def begin(self, env: ScmWorldEnv) -> None:
        """Begin with the first action.

        Raises:
            UnknownOption: The environment has another action mode, or relative actions mean
                something else in it.
            ActionError: Its actions have another number of components.
        """
        self._env, self._step = env, 0
        self._checked(self._given[0])
        self._actions = self._given if self._mode is None else self._converted(env, self._mode)

    def act(self, observation: Any) -> Actions:
        """Give the next action, shape (n,)."""
        found: Actions = self._actions[min(self._step, len(self._actions) - 1)]
        self._step += 1
        return found

    def _converted(self, env: ScmWorldEnv, mode: str) -> Actions:
        if env.action_mode != mode:
            raise UnknownOption(f"action_mode for {self._name!r}", env.action_mode, (mode,))
        for option, wanted in self._relative.items():
            if (there := env.made_with[option]) != wanted:
                raise UnknownOption(f"{option} for {self._name!r}", there, (repr(wanted),))
        if is_normalized(env) == self._normalized:
            return self._given
        if env.action_mode.startswith(PREFIX):
            allowed = f"normalize_actions={self._normalized}, as the relative actions given"
            raise UnknownOption(f"environment for {self._name!r}", env.action_mode, (allowed,))
        actions = np.asarray(self._given, dtype=np.float64)
        if self._normalized:
            return commands(actions, env.world)
        return np.array([env.as_action(command) for command in actions])


def is_normalized(env: ScmWorldEnv) -> bool:
    """Tell whether actions in [-1, 1] stand for the range of commands."""
    return bool(env.made_with["normalize_actions"])


def commands(actions: Actions, world: World) -> Actions:
    """Turn actions in [-1, 1] into commands in SI units, shape (..., n)."""
    middle, half = action_scale(world)
    found: Actions = middle + half * actions
    return found
