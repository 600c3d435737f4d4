"""The arrays of many environments: one row for each, written in place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.spaces import Dict
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.env.environment import ScmWorldEnv
from scm_world.errors import InterventionError
from scm_world.tasks.rewards import FRACTION, SUCCESS

Column = NDArray[Any] | dict[str, NDArray[Any]]
"""What all environments say about one thing, shape (n, ...); or several of them, by name."""

FLAGS = ("is_success", "success")
GOALS = ("achieved_goal", "desired_goal")
TERMS = "reward_terms"


@final
@dataclass(frozen=True)
class Form:
    """What the environments of an executor have in common.

    Attributes:
        observation_space: Of one of them.
        action_space: Of one of them.
        goals: How many numbers ``achieved_goal`` and ``desired_goal`` have, if there are goals.
        counted: Which of the variables that count there are.
        terms: Names of the reward terms.
        metadata: As in Gymnasium.
        render_mode: Of all of them.
    """

    observation_space: gymnasium.Space[Any]
    action_space: gymnasium.Space[Any]
    goals: tuple[int, int] | None
    counted: frozenset[str]
    terms: tuple[str, ...]
    metadata: Mapping[str, Any] = field(compare=False)
    render_mode: str | None

    @classmethod
    def of(cls, env: ScmWorldEnv) -> Form:
        """Read it from one of them."""
        return cls(
            env.observation_space,
            env.action_space,
            _goal_sizes(env),
            env._counted,
            tuple(env.world.task.weights),
            env.metadata,
            env.render_mode,
        )

    def check(self, env: ScmWorldEnv, variable: str) -> None:
        """Refuse an environment that is not observed like the others any more.

        Args:
            env: It was reset, intervened on or restored a moment ago.
            variable: What was set, or what else brought this about.

        Raises:
            InterventionError: There are other bodies in it than in the others.
        """
        seen, goals = env.observation_space, _goal_sizes(env)
        if (seen, goals) == (self.observation_space, self.goals):
            return
        before, after = _shape(self.observation_space), _shape(seen)
        if before == after:
            before, after = f"goals of {self.goals} numbers", f"goals of {goals}"
        raise InterventionError(
            f"{variable} changes which bodies exist, and with them what is observed, from "
            f"{before} to {after}; environments in a batch are all observed alike: set it for all "
            "of them with start={…} when they are made, leave it out of a curriculum (besides=…), "
            "or use single environments",
            variable=variable,
        )


def _goal_sizes(env: ScmWorldEnv) -> tuple[int, int] | None:
    if env._goals is None:
        return None
    achieved, desired = (space.shape or () for space in env._goals.spaces.values())
    return int(np.prod(achieved)), int(np.prod(desired))


def _shape(space: gymnasium.Space[Any]) -> str:
    if isinstance(space, Dict):
        return ", ".join(f"{name} {_shape(part)}" for name, part in space.items())
    return f"shape {space.shape}"


@final
@dataclass
class Buffers:
    """What n environments said last.

    Attributes:
        observations: Shape (n, ...), dtype of the space; by name where the space is a dictionary.
        rewards: Shape (n,). Only steps write them, and the flags.
        terminations: Shape (n,).
        truncations: Shape (n,).
        infos: Everything in ``info``, by its key.
    """

    observations: Any
    rewards: Floats
    terminations: NDArray[np.bool_]
    truncations: NDArray[np.bool_]
    infos: dict[str, Column]

    @classmethod
    def empty(cls, form: Form, size: int) -> Buffers:
        """Make one for some environments of a form."""
        infos: dict[str, Column] = {}
        if SUCCESS in form.counted:
            infos = {name: np.zeros((size,), np.bool_) for name in FLAGS}
        if FRACTION in form.counted:
            infos[FRACTION] = np.zeros((size,), np.float64)
        if form.goals is not None:
            for name, width in zip(GOALS, form.goals, strict=True):
                infos[name] = np.zeros((size, width), np.float64)
        infos[TERMS] = {name: np.zeros((size,), np.float64) for name in form.terms}
        return cls(
            observations=_rows(form.observation_space, size),
            rewards=np.zeros((size,), np.float64),
            terminations=np.zeros((size,), np.bool_),
            truncations=np.zeros((size,), np.bool_),
            infos=infos,
        )

    def put(self, where: slice, other: Buffers) -> None:
        """Copy what other environments said into some rows."""
        for name, mine in vars(self).items():
            _copy(vars(other)[name], mine, where)

    def write(self, row: int, observation: Any, info: Mapping[str, Any]) -> None:
        """Write what one environment shows."""
        if isinstance(self.observations, dict):
            for name, part in self.observations.items():
                part[row] = observation[name]
        else:
            self.observations[row] = observation
        for name, column in self.infos.items():
            if isinstance(column, dict):
                for term, value in info[name].items():
                    column[term][row] = value
            else:
                column[row] = info[name]

    def observation(self, row: int) -> Any:
        """Copy the observation of one environment."""
        if isinstance(self.observations, dict):
            return {name: part[row].copy() for name, part in self.observations.items()}
        return self.observations[row].copy()


def _rows(space: gymnasium.Space[Any], size: int) -> Any:
    if isinstance(space, Dict):
        return {name: _rows(part, size) for name, part in space.items()}
    return np.zeros((size, *(space.shape or ())), space.dtype)


def _copy(rows: Any, column: Any, where: slice) -> None:
    if isinstance(column, dict):
        for name, one in column.items():
            _copy(rows[name], one, where)
    else:
        column[where] = rows


def gymnasium_infos(columns: Mapping[str, Column], which: NDArray[np.bool_]) -> dict[str, Any]:
    """Copy what some environments said, in Gymnasium's form.

    Args:
        columns: What all of them said.
        which: Those that are meant, shape (n,).

    Returns:
        Every column, zeros elsewhere; and beside each, after a ``_``, which ones are meant.

    Example:
        >>> gymnasium_infos({"x": np.array([1.0, 2.0])}, np.array([False, True]))
        {'x': array([0., 2.]), '_x': array([False,  True])}
    """
    found: dict[str, Any] = {}
    everyone = bool(which.all())
    for name, column in columns.items():
        if isinstance(column, dict):
            found[name] = gymnasium_infos(column, which)
        elif everyone:
            found[name] = column.copy()
        else:
            found[name] = np.zeros_like(column)
            found[name][which] = column[which]
        found[f"_{name}"] = which.copy()
    return found
