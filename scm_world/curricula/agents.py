"""Agents that intervene themselves: an intervention is a part of the action."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from scm_world._arguments import whole_number
from scm_world._types import Floats, Value, Values
from scm_world.curricula.base import words
from scm_world.curricula.targets import matching
from scm_world.env.wrappers import unwrapped_env
from scm_world.errors import ActionError, InterventionError, UnknownOption
from scm_world.variables import Box, Integers, Subset
from scm_world.variables.kinds import SpaceName, Variable
from scm_world.variables.subsets import as_region


@final
class InterveningAgent(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Lets an agent set variables of the world, besides moving the robot.

    An action is a dictionary: ``"action"``, as without this wrapper; ``"which"``, for each
    variable 1 if it is to be set and 0 if not; ``"values"``, all their numbers in [-1, 1], which
    stand for the region that each may lie in. The intervention is made before the control step,
    all of it or nothing. ``info["refused"]`` says why it was not made, and is empty otherwise;
    ``info["interventions_left"]`` is how many more there may be, -1 for any number.

    With ``flat=True`` an action is one vector: the action, then one number for each variable, of
    which those above 0 are set, then the values; for learners that know boxes only.

    Args:
        env: Of this package, with actions in a box.
        what: Names, patterns or groups of what may be set, as in ``resample``.
        space: Where values may lie: ``"A"``, ``"B"``, ``"A|B"`` or a ``Subset``; if None, where
            interventions on the environment may (its ``variables_space``), or else ``"A"``.
        most: How often it may intervene in an episode; any number if None.
        flat: Whether an action is one vector.

    Raises:
        UnknownOption: A variable has no region with two ends, actions are no vector, or an option
            is none.
        UnknownVariable: A pattern names nothing.

    Example:
        >>> env = gymnasium.make("scm_world/Pushing-v0", backend="fake")
        >>> env = InterveningAgent(env, ["tool_block.mass"])
        >>> _ = env.reset(seed=0)
        >>> still = np.zeros(9, np.float32)
        >>> do = {"action": still, "which": np.array([1]), "values": np.ones(1, np.float32)}
        >>> _, _, _, _, info = env.step(do)
        >>> float(env.unwrapped.world["tool_block.mass"]), info["refused"]
        (0.045, '')
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        what: str | Iterable[str],
        *,
        space: SpaceName | Subset | None = None,
        most: int | None = None,
        flat: bool = False,
    ) -> None:
        patterns = words("what", what)
        region = as_region("space", space)
        data = region.model_dump(mode="json") if isinstance(region, Subset) else region
        RecordConstructorArgs.__init__(self, what=patterns, space=data, most=most, flat=flat)
        super().__init__(env)
        self._inner = unwrapped_env(env, "InterveningAgent")
        if not isinstance(env.action_space, gymnasium.spaces.Box):
            allowed = ("one with actions in a box",)
            raise UnknownOption("environment for InterveningAgent", str(env), allowed)
        self._space: Any = region or self._inner.world.variables_space or "A"
        self._shape = env.action_space.shape
        self._most = None if most is None else whole_number("most", most, least=0)
        self._flat, self._left = flat, -1
        declaration = self._inner.world.compiled
        self._names = matching(declaration, patterns)
        self._variables = [declaration.model.declared(name) for name in self._names]
        for variable in self._variables:
            self._box(variable)
        self._sizes = [int(np.prod(variable.shape)) for variable in self._variables]
        self.action_space = self._actions(env.action_space)

    @property
    def targets(self) -> tuple[str, ...]:
        """The variables that may be set, in their order."""
        return self._names

    def _box(self, variable: Variable) -> Box | Integers:
        """Give the region of a variable.

        Raises:
            UnknownOption: It has none, or one without two ends.
        """
        space = self._space
        region = space.space_of(variable) if isinstance(space, Subset) else variable.space(space)
        if not isinstance(region, Box | Integers):
            allowed = (f"one in which {variable.name} lies between two ends",)
            raise UnknownOption("space", str(space), allowed)
        return region

    def _actions(self, inner: Any) -> gymnasium.Space[Any]:
        n, numbers = len(self._names), sum(self._sizes)
        ones = np.ones(numbers, np.float32)
        if not self._flat:
            return gymnasium.spaces.Dict(
                {
                    "action": inner,
                    "which": gymnasium.spaces.MultiBinary(n),
                    "values": gymnasium.spaces.Box(-ones, ones, dtype=np.float32),
                }
            )
        gates = np.ones(n, np.float32)
        low = np.concatenate([inner.low, -gates, -ones])
        return gymnasium.spaces.Box(low, np.concatenate([inner.high, gates, ones]))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode, in which all interventions are left."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._left = -1 if self._most is None else self._most
        return observation, {**info, "refused": "", "interventions_left": self._left}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Intervene, then advance one control step.

        Raises:
            ActionError: It is none of the space; nothing has happened.
        """
        inner, which, values = self._parts(action)
        refused = self._intervene(which, values) if which.any() else ""
        observation, reward, terminated, truncated, info = self.env.step(inner)
        told = {"refused": refused, "interventions_left": self._left}
        return observation, reward, terminated, truncated, {**info, **told}

    def _parts(self, action: Any) -> tuple[Any, NDArray[np.bool_], Floats]:
        n, numbers = len(self._names), sum(self._sizes)
        inner: Any = None
        try:
            if self._flat:
                given = np.asarray(action)
                inner, gates, values = np.split(given, [-n - numbers, -numbers])
                which = gates > 0.0
            else:
                inner = action["action"]
                which, values = np.asarray(action["which"]) > 0, action["values"]
            values = np.asarray(values, dtype=np.float64)
        except (TypeError, KeyError, ValueError, IndexError):
            which, values = np.zeros(0, bool), np.zeros(0)
        fits = np.shape(inner) == self._shape and which.shape == (n,)
        if not fits or values.shape != (numbers,) or not np.isfinite(values).all():
            raise ActionError(f"an action is one of {self.action_space}, got {action!r}", action)
        return inner, which, np.clip(values, -1.0, 1.0)

    def _intervene(self, which: NDArray[np.bool_], values: Floats) -> str:
        """Set what is to be set; give the reason if that is refused."""
        if self._left == 0:
            return f"all {self._most} interventions of this episode were made"
        present = self._inner.world.values()
        request: dict[str, Any] = {}
        ends = np.cumsum(self._sizes)
        for chosen, variable, end, size in zip(
            which, self._variables, ends, self._sizes, strict=True
        ):
            if chosen:
                share = (values[end - size : end].reshape(variable.shape) + 1.0) / 2.0
                request[variable.name] = self._value(variable, share, present)
        try:
            self._inner.do(request, space=self._space)
        except InterventionError as error:
            return str(error)
        self._left -= self._left > 0
        return ""

    def _value(self, variable: Variable, share: Floats, present: Values) -> Value:
        """Give what lies between the ends of a region, at a share of the way in each component."""
        region = self._box(variable)
        if isinstance(region, Integers):
            between = np.rint(region.low + (region.high - region.low) * share)
            return np.asarray(between, dtype=np.int64)
        low, high = region.bounds(variable.shape, present)
        return np.asarray(low + (high - low) * share)
