"""The Gymnasium face of a world."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats, Value, Values
from scm_world.errors import ActionError, UnknownOption
from scm_world.tasks import HEAD, TIME, Observed, Task
from scm_world.tasks.kernels import affine_into, scale_into
from scm_world.variables.kinds import SpaceName
from scm_world.world import Audit, World

Observation = NDArray[np.float32]


class ScmWorldEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """An environment whose every variable is a node of a causal graph.

    Made by ``gymnasium.make("scm_world/Pushing-v0")`` or ``"scm_world/Reaching-v0"``.

    The observation is the published layout: time left, joint positions (9), joint velocities
    (9), fingertips (9), then the blocks and goals of the task. Bounds are physical; a number
    beyond them (a joint faster than 50 rad/s) saturates, like a sensor. An episode is truncated
    at its length and never terminated.

    Args:
        task: Name of a registered task, or a task.
        backend: ``"mujoco"``, ``"bullet"`` or ``"fake"``.
        preset: ``"fast"`` or ``"precise"``.
        frame_skip: Length of a control step in units of 4 ms.
        action_mode: ``"joint_positions"``, ``"joint_torques"`` or ``"end_effector_positions"``.
        normalize_actions: Take actions in [-1, 1] instead of SI units.
        normalize_observations: Give observations in [-1, 1] instead of SI units.
        max_episode_length: In control steps; the task's own if None.
        conventions: ``"scm_world"`` or ``"causal_world"``.
        render_mode: None or ``"rgb_array"``.

    Example:
        >>> env = gymnasium.make("scm_world/Pushing-v0", backend="fake")
        >>> observation, info = env.reset(seed=0, options={"do": {"tool_block.mass": 0.04}})
        >>> observation.shape, info["is_success"]
        ((56,), False)
        >>> print(env.unwrapped.do({"floor_friction": 0.4}))
        floor_friction = 0.4, engine reports 0.4
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 # declared by Gymnasium as an instance variable
        "render_modes": ["rgb_array"],
        "render_fps": 25,
    }

    def __init__(
        self,
        task: Task | str = "pushing",
        *,
        backend: str = "mujoco",
        preset: str = "fast",
        frame_skip: int = 10,
        action_mode: str = "joint_positions",
        normalize_actions: bool = True,
        normalize_observations: bool = True,
        max_episode_length: int | None = None,
        conventions: str = "scm_world",
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise UnknownOption("render_mode", render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        self.world = World(
            task,
            backend=backend,
            preset=preset,
            action_mode=action_mode,
            frame_skip=frame_skip,
            max_episode_length=max_episode_length,
            conventions=conventions,
        )
        self.metadata = {**type(self).metadata, "render_fps": round(1 / self.world.control_period)}
        extra = int(self.world.conventions.extra_step)
        self._limit = self.world.max_episode_length + extra
        self._terms = tuple(self.world.task.weights)
        self._layout = _Layout(self.world, normalize=normalize_observations)
        self._needed = (*self._layout.names, *self._terms, "success", "reward")
        self.observation_space = self._layout.space()
        low, high = self.world.action_low, self.world.action_high
        self._middle, self._half = (low + high) / 2.0, (high - low) / 2.0
        if not normalize_actions:
            self._middle, self._half = np.zeros(9), np.ones(9)
        bounds = (-np.ones(9), np.ones(9)) if normalize_actions else (low, high)
        self.action_space = _box(*bounds)
        self._scale = self.world.control_period if self.world.conventions.reward_times_dt else 1.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: Of the noise.
            options: ``{"do": {…}}``: an intervention that holds for the whole episode.

        Raises:
            UnknownOption: Another key than ``"do"``.
            InterventionError: The intervention was refused.
        """
        super().reset(seed=seed)
        unknown = set(options or {}) - {"do"}
        if unknown:
            raise UnknownOption("reset option", min(unknown), ("do",))
        self.world.reset(seed=seed, do=(options or {}).get("do"))
        now = self.world.evaluate(self._needed)
        return self._layout.observe(now), self._info(now)

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advance one control step.

        Raises:
            ActionError: Wrong shape, or a number that is not finite.
        """
        given = np.array(action, dtype=np.float64)
        if given.shape != (9,):
            raise ActionError(f"an action has shape (9,), got {given.shape}", action)
        affine_into(given, self._middle, self._half, given)
        self.world.step(given)
        now = self.world.evaluate(self._needed)
        reward = self._scale * float(now["reward"])
        truncated = self.world.index >= self._limit
        return self._layout.observe(now), reward, False, truncated, self._info(now)

    def do(self, request: Mapping[str, Any], *, space: SpaceName | None = None) -> Audit:
        """Intervene now; see ``World.do``. ``observe`` gives the observation afterwards."""
        return self.world.do(request, space=space)

    def observe(self) -> Observation:
        """Give the observation of the present."""
        return self._layout.observe(self.world.evaluate(self._needed))

    def _info(self, now: Values) -> dict[str, Any]:
        achieved, desired = self.world.task.goals(now)
        success = bool(now["success"])
        return {
            "is_success": success,
            "success": success,
            "fractional_success": float(now["fractional_success"]),
            "achieved_goal": achieved,
            "desired_goal": desired,
            "reward_terms": {name: float(now[name]) for name in self._terms},
        }

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the scene, shape (480, 640, 3); None without ``render_mode="rgb_array"``."""
        if self.render_mode is None:
            return None
        from scm_world.backends.renderer import render
        from scm_world.scene.camera import OVERVIEW

        return render(self.world.scene(), OVERVIEW).rgb

    def close(self) -> None:
        """Free the engine."""
        self.world.close()


def _box(low: Floats, high: Floats) -> gymnasium.Space[NDArray[np.float32]]:
    bounds: Any = (low.astype(np.float32), high.astype(np.float32))
    return gymnasium.spaces.Box(*bounds, dtype=np.float32)


class _Layout:
    """Where each variable stands in the observation, and how it is scaled."""

    def __init__(self, world: World, *, normalize: bool) -> None:
        self._published = world.conventions.published_observation
        parts = [Observed(TIME, (0.0, 1.0)), *HEAD, *world.task.observed()]
        self.names = tuple(part.variable for part in parts)
        shapes = [world.model.declared(name).shape for name in self.names]
        ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
        self._slices = [
            slice(int(e - np.prod(s)), int(e)) for e, s in zip(ends, shapes, strict=True)
        ]
        self._world = world
        self._version = -1
        self._still = [f for f in self._fields() if f[0] in world.static_names]
        self._moving = [f for f in self._fields() if f[0] not in world.static_names]
        self._blocks = _merge([(w, world.slices[n]) for n, w in self._moving if n in world.slices])
        self._computed = [f for f in self._moving if f[0] not in world.slices]
        bounds = [self._bounds(world, part) for part in parts]
        self._low, self._high = (np.concatenate(side) for side in zip(*bounds, strict=True))
        self._raw = np.empty(int(ends[-1]))
        self._normalize = normalize
        everything = np.full(self._raw.size, np.inf)
        self._limits = (-everything, everything) if self._published else (self._low, self._high)
        width = self._high - self._low
        scaled = normalize & (width > 0)
        self._gain = np.where(scaled, 2.0 / np.where(scaled, width, 1.0), 1.0)
        self._offset = np.where(scaled, -self._low * self._gain - 1.0, 0.0)
        self._time_shift = 0.0
        if self._published and world.given_length is not None:
            # The predecessor subtracts seconds from a number of steps.
            self._time_shift = world.given_length * (1.0 - world.control_period)

    def _fields(self) -> list[tuple[str, slice]]:
        return list(zip(self.names, self._slices, strict=True))

    def _bounds(self, world: World, part: Observed) -> tuple[Floats, Floats]:
        variable: Any = world.model.declared(part.variable)
        size = int(np.prod(variable.shape))
        if self._published:
            low, high = part.published
            if part.variable == TIME:
                length = world.max_episode_length * world.control_period
                high = length if world.given_length is None else float(world.given_length)
        elif part.low is not None:
            low, high = part.low, part.high
        else:
            low, high = variable.bounds.bounds(variable.shape, {})
        return (
            np.broadcast_to(np.asarray(low, float).ravel(), (size,)),
            np.broadcast_to(np.asarray(high, float).ravel(), (size,)),
        )

    def space(self) -> gymnasium.Space[Observation]:
        """Give the observation space; without bounds where the published ones do not hold."""
        if self._published:
            low, high = np.full(self._raw.size, -np.inf), np.full(self._raw.size, np.inf)
        elif self._normalize:
            low, high = -np.ones(self._raw.size), np.ones(self._raw.size)
        else:
            low, high = self._low, self._high
        return _box(low, high)

    def observe(self, now: Mapping[str, Value]) -> Observation:
        """Write the observation, shape (n,)."""
        raw = self._raw
        if self._version != self._world.version:
            self._version = self._world.version
            for name, where in self._still:
                raw[where] = now[name]
        for name, where in self._computed:
            raw[where] = now[name]
        vector = self._world.current()[1].vector
        for where, source in self._blocks:
            raw[where] = vector[source]
        raw[0] += self._time_shift
        observation = np.empty(raw.size, dtype=np.float32)
        scale_into(raw, *self._limits, self._gain, self._offset, observation)
        return observation


def _merge(pairs: list[tuple[slice, slice]]) -> list[tuple[slice, slice]]:
    """Join copies whose source and target both lie side by side."""
    merged: list[tuple[slice, slice]] = []
    for target, source in pairs:
        if merged and (merged[-1][0].stop, merged[-1][1].stop) == (target.start, source.start):
            before = merged.pop()
            joined = slice(before[0].start, target.stop), slice(before[1].start, source.stop)
            merged.append(joined)
        else:
            merged.append((target, source))
    return merged


IDS = {"scm_world/Pushing-v0": "pushing", "scm_world/Reaching-v0": "reaching"}
"""The registered environments."""
