"""What a plan is worth: variables, weighted sums of them, or functions of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, final

import numpy as np

from scm_world._types import Floats
from scm_world.errors import ModelError, UnknownOption
from scm_world.tasks import Task


@final
@dataclass(frozen=True)
class Score:
    """A function of the values of some variables, for many rollouts at once.

    Attributes:
        names: Of the variables.
        function: Told the values in this order, each of shape (..., *shape) of its variable; gives
            numbers of shape (...), the higher the better. It can be pickled if it has a name.
        sums: Whether it is told the sum of a variable with several numbers instead, where it is
            known which axes are those of the variable.

    Example:
        >>> import numpy as np
        >>> heavy = Score(("tool_block.mass",), np.negative)
        >>> heavy.of({"tool_block.mass": np.array([[0.02, 0.08]])})
        array([[-0.02, -0.08]])
    """

    names: tuple[str, ...]
    function: Callable[..., Any]
    sums: bool = False

    def of(self, values: Mapping[str, Floats], shape: tuple[int, ...] | None = None) -> Floats:
        """Compute it.

        Args:
            values: By name, shape (..., *shape).
            shape: That what comes out must have; it is not checked if None.

        Returns:
            Shape (...).

        Raises:
            ModelError: The function gave something else, or numbers that are not finite.
        """
        given = [values[name] for name in self.names]
        if self.sums and shape is not None:
            given = [value.reshape(*shape, -1).sum(axis=-1) for value in given]
        try:
            found = np.asarray(self.function(*given), dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ModelError([f"the score of a plan cannot be computed: {error}"]) from error
        if not np.isfinite(found).all():
            names = ", ".join(self.names)
            raise ModelError([f"the score of a plan is not finite; it is a function of {names}"])
        if shape is not None and found.shape != shape:
            problem = f"the score of a plan has shape {found.shape}, not {shape}: one number each"
            raise ModelError([f"{problem}; values have shape (rollouts, steps, ...)"])
        return found


def as_score(given: Any) -> Score:
    """Read a score.

    Args:
        given: The name of a variable, weights by name, or a ``Score``. Of a variable with several
            numbers their sum counts.

    Raises:
        UnknownOption: It is none of these.

    Example:
        >>> import numpy as np
        >>> score = as_score({"reward": 1.0, "joint_velocities": -0.1})
        >>> score.of({"reward": np.ones(2), "joint_velocities": np.ones((2, 9))}, (2,)).round(3)
        array([0.1, 0.1])
    """
    allowed = ("the name of a variable", "weights by name", "a Score")
    if isinstance(given, Score):
        return given
    if isinstance(given, str):
        return as_score({given: 1.0})
    if not isinstance(given, Mapping) or not given:
        raise UnknownOption("objective", given, allowed)
    for name, weight in given.items():
        is_number = isinstance(weight, int | float | np.number) and np.isfinite(weight)
        if not isinstance(name, str) or not is_number:
            raise UnknownOption(f"weight of {name}", weight, ("a finite number",))
    return Score(tuple(given), partial(_weighted, tuple(map(float, given.values()))), sums=True)


def _weighted(weights: tuple[float, ...], *values: Floats) -> Floats:
    """Add values up."""
    shares = [weight * value for weight, value in zip(weights, values, strict=True)]
    return np.asarray(sum(shares))


def nearness(task: Task) -> Score:
    """Give the score that counts how near everything is to its goal, in minus meters.

    Of blocks that is the mean distance of the eight corners of each block from those of its goal,
    so that turning counts, and a tenth of the mean distance of the fingertips from the block; of
    a task without blocks the distance of what is achieved from what is desired. Of a task without
    goals it is the reward.

    Args:
        task: Of the world.

    Raises:
        UnknownOption: It has neither goals nor a reward.
    """
    have, want = task.goal_names()
    if not have and not task.weights:
        allowed = ("the name of a variable", "weights by name", "a Score")
        raise UnknownOption(f"objective of {task.name!r}, without goals and reward", None, allowed)
    if not have:
        return as_score("reward")
    custom = task.closeness()
    return Score((*have, *want), partial(_apart, len(have))) if custom is None else Score(*custom)


def _apart(count: int, *values: Floats) -> Floats:
    have, want = (np.concatenate(part, axis=-1) for part in (values[:count], values[count:]))
    return -np.asarray(np.linalg.norm(have - want, axis=-1))
