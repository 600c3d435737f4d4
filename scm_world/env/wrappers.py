"""Wrappers: other actions for the same environment."""

from __future__ import annotations

from collections import deque
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from scm_world._arguments import one_of, whole_number
from scm_world.env.delta import PREFIX, TIPS
from scm_world.env.environment import ScmWorldEnv
from scm_world.env.vector import box
from scm_world.errors import ActionError, InterventionError, UnknownOption
from scm_world.graph import flatten
from scm_world.variables import Shift

Actions = NDArray[Any]

MOVE = 0.002  # [m] Source: CausalWorld 1.2, ``wrappers/planning_wrappers.py``
TURN = 0.1  # [rad]
_AXES = (2, 0, 1)  # of a move: z, x, y
_TURNS = (2, 1, 0)  # of a turn: the components of the rotation vector
_MODES = ("structured", "full")
_STEPS = 7  # nothing, or one of three axes to one of two sides


def unwrapped_env(env: gymnasium.Env[Any, Any], wrapper: str) -> ScmWorldEnv:
    """Return the environment of this package inside of wrappers.

    Args:
        env: In any wrappers.
        wrapper: Who asks, for the error.

    Raises:
        UnknownOption: There is another one.
    """
    inner = env.unwrapped
    if not isinstance(inner, ScmWorldEnv):
        raise UnknownOption(f"environment for {wrapper}", type(inner).__name__, ("ScmWorldEnv",))
    return inner


@final
class DeltaAction(gymnasium.ActionWrapper[Any, Actions, Actions], RecordConstructorArgs):
    """Makes actions relative; the same as the option ``action_mode="delta_…"``.

    An action is added to the last target of the joints (their present positions at the start of
    an episode and after an intervention on them), to the last torques, or to the present
    fingertips. The sum is clipped to the range of actions.

    Args:
        env: With absolute actions.

    Raises:
        UnknownOption: It is no environment of this package, or its actions are relative.

    Example:
        >>> env = DeltaAction(gymnasium.make("scm_world/Pushing-v0", backend="fake"))
        >>> _ = env.reset(seed=0)
        >>> _ = env.step(np.zeros(9, np.float32))
        >>> env.unwrapped.world["action"].round(3)[:3]
        array([ 0.   ,  0.785, -0.785])
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        super().__init__(env)
        inner = unwrapped_env(env, "DeltaAction")
        if inner.action_mode.startswith(PREFIX):
            raise UnknownOption("action_mode", inner.action_mode, inner.world.task.action_modes)
        self._delta = inner.relative()
        self.action_space = self._delta.space()

    def action(self, action: Actions) -> Actions:
        """Give the absolute action, shape (9,)."""
        return self._delta.absolute(np.asarray(action, dtype=np.float64))


@final
class MovingAverageAction(gymnasium.ActionWrapper[Any, Actions, Actions], RecordConstructorArgs):
    """Averages the last actions; at the start of an episode, those that there are.

    Args:
        env: With actions in a box.
        window: How many actions count.

    Raises:
        UnknownOption: ``window`` is no positive whole number.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], window: int = 8) -> None:
        window = whole_number("window", window, least=1)
        RecordConstructorArgs.__init__(self, window=window)
        super().__init__(env)
        self._last: deque[Actions] = deque(maxlen=window)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; earlier actions are forgotten."""
        self._last.clear()
        return super().reset(seed=seed, options=options)

    def action(self, action: Actions) -> Actions:
        """Give the mean of the last actions."""
        self._last.append(np.array(action))
        mean: Any = np.mean(self._last, axis=0, dtype=np.float64)
        kind = self._last[-1].dtype
        averaged: Actions = mean.astype(kind) if np.issubdtype(kind, np.floating) else mean
        return averaged


@final
class ObjectSelector(
    gymnasium.Wrapper[Any, NDArray[np.int64], Any, Actions], RecordConstructorArgs
):
    """Plans with blocks instead of fingers: an action moves one block by an intervention.

    An action is (block, move, turn). A move is 0 for none, 1 and 2 for ±z, 3 and 4 for ±x, 5 and
    6 for ±y by 2 mm; a turn is 0 for none and 1 to 6 for ± the third, second and first component
    of the rotation vector by 0.1 rad. A block that is moved stops. The robot is raised and held,
    and one control step passes; make the environment with ``frame_skip=1`` to keep that short. A
    move that is not possible is not made, and ``info["refused"]`` says why, which is else empty.

    The observation is the vector of the environment without the numbers of the robot.

    Args:
        env: With the action mode ``"joint_positions"`` and a structured or full observation.

    Raises:
        UnknownOption: The environment has no blocks, or other actions or observations.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        super().__init__(env)
        self._inner = inner = unwrapped_env(env, "ObjectSelector")
        if inner.action_mode != "joint_positions":
            raise UnknownOption("action_mode", inner.action_mode, ("joint_positions",))
        one_of("observation_mode", inner.observation_mode, _MODES)
        if not isinstance(inner.observation_space, gymnasium.spaces.Box):
            allowed = ("a vector: without goal_env and context='privileged'",)
            raise UnknownOption("observation for ObjectSelector", "a dictionary", allowed)
        self._held: Any = inner.as_action(np.array(inner.world.task.raised))
        self._first = inner.layout[TIPS].stop
        self._spaces: dict[int, gymnasium.spaces.MultiDiscrete] = {}
        self._blocks()

    def _blocks(self) -> tuple[str, ...]:
        blocks = self._inner.world.composition.blocks
        if not blocks:
            raise UnknownOption("task", self._inner.world.task.name, ("one with blocks",))
        return blocks

    @property  # type: ignore[misc]
    def action_space(self) -> gymnasium.spaces.MultiDiscrete:  # type: ignore[override]
        """Which block, which move, which turn; as many blocks as there are."""
        n = len(self._blocks())
        if n not in self._spaces:
            self._spaces[n] = gymnasium.spaces.MultiDiscrete([n, _STEPS, _STEPS])
        return self._spaces[n]

    @property  # type: ignore[misc]
    def observation_space(self) -> gymnasium.Space[Any]:  # type: ignore[override]
        """The space of the environment without the numbers of the robot."""
        whole: Any = self.env.observation_space
        return box(whole.low[self._first :], whole.high[self._first :])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode with the robot raised."""
        asked = dict(options or {})
        raised = {"joint_positions": self._inner.world.task.raised}
        asked["do"] = raised | flatten(asked.get("do") or {})
        observation, info = self.env.reset(seed=seed, options=asked)
        return observation[self._first :], {**info, "refused": ""}

    def step(self, action: NDArray[np.int64]) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Move a block, then let a control step pass.

        Raises:
            ActionError: It is none of the space.
        """
        chosen = np.asarray(action, dtype=np.int64)
        if not self.action_space.contains(chosen):
            raise ActionError(f"an action is one of {self.action_space}, got {action!r}", action)
        refused = self._move(*chosen.tolist())
        observation, reward, terminated, truncated, info = self.env.step(self._held)
        found = observation[self._first :]
        return found, reward, terminated, truncated, {**info, "refused": refused}

    def _move(self, block: int, move: int, turn: int) -> str:
        """Move a block; give the reason if that is refused."""
        if not (move or turn):
            return ""
        name = self._blocks()[block]
        request: dict[str, Any] = {}
        if move:
            request[f"{name}.cartesian_position"] = Shift(_along(move, _AXES, MOVE))
        if turn:
            request[f"{name}.euler_orientation"] = Shift(_along(turn, _TURNS, TURN))
        request |= dict.fromkeys(
            (f"{name}.linear_velocity", f"{name}.angular_velocity"), (0.0, 0.0, 0.0)
        )
        try:
            self._inner.do(request)
        except InterventionError as error:
            return str(error)
        return ""


def _along(number: int, axes: tuple[int, ...], length: float) -> tuple[float, ...]:
    """Give the step that a number from 1 to 6 stands for, shape (3,)."""
    axis, side = divmod(number - 1, 2)
    step = np.zeros(3)
    step[axes[axis]] = -length if side else length
    return tuple(step.tolist())
