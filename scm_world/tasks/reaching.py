"""Reaching: bring each fingertip to a point."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.entities import Entity, GoalSphere
from scm_world.scene import trifinger
from scm_world.scene.kinematics import inverse
from scm_world.tasks import kernels
from scm_world.tasks.base import (
    UNIT,
    Conventions,
    Observed,
    Task,
    observe_position,
    reward,
    term,
)
from scm_world.variables import Function, Integers, Measured, Parent, Variable

REACHED = 0.01  # [m] mean error of a coordinate that counts as success
FAR = 0.03  # [m] mean error at which the fractional success is zero

WEIGHTS = {
    "reward.tips_to_goals": 100_000.0,
    "reward.distance": 0.0,
    "reward.torque": 0.0,
    "reward.smoothness": 0.0,
    "fractional_success": 1.0,
}

GOALS = tuple(f"goal_{finger}" for finger in trifinger.FINGERS)
_TINTS = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def nearness(error: float, *, reached: float, far: float) -> float:
    """Compute the fractional success: 1 at ``reached`` or nearer, 0 at ``far`` or farther."""
    return 1.0 - (min(max(error, reached), far) - reached) / (far - reached)


def within(error: float, *, reached: float) -> int:
    """Tell whether the error is small enough, as 0 or 1."""
    return int(error < reached)


def minus_norm(vector: Floats) -> float:
    """Compute the negative Euclidean norm."""
    return -float(np.linalg.norm(vector))


def minus_distance(tips: Floats, *goals: Floats) -> float:
    """Compute the negative distance of the tips from their goals [m]."""
    return -float(kernels.reach_distance(tips, *goals))


def minus_change(now: Floats, before: Floats) -> float:
    """Compute the negative norm of a difference."""
    return -float(kernels.distance(now, before))


@final
class Reaching(Task):
    """Three points in the air, one for each fingertip.

    Reward terms:
        reward.tips_to_goals: How much nearer the tips came to their goals [m].
        reward.distance: Minus the distance of the tips from their goals [m].
        reward.torque: Minus the norm of the joint torques [N m].
        reward.smoothness: Minus the change of the joint velocities [rad/s].
        fractional_success: 1 within a centimeter, 0 beyond three.

    Args:
        default_goal_60: Default goal of the first finger [m].
        default_goal_120: Of the second.
        default_goal_300: Of the third.
        weights: Weights of reward terms that differ from the published ones.
    """

    name = "reaching"
    seconds = 5.0

    def __init__(
        self,
        *,
        default_goal_60: tuple[float, float, float] = (0.0, 0.0, 0.10),
        default_goal_120: tuple[float, float, float] = (0.0, 0.0, 0.13),
        default_goal_300: tuple[float, float, float] = (0.0, 0.0, 0.16),
        weights: Mapping[str, float] | None = None,
    ) -> None:
        self.weights = {**WEIGHTS, **(weights or {})}
        places = (default_goal_60, default_goal_120, default_goal_300)
        self._goals = tuple(
            GoalSphere(name, position=place, radius=0.015, tint=tint)
            for name, place, tint in zip(GOALS, places, _TINTS, strict=True)
        )

    def entities(self) -> Iterable[Entity]:
        """Three goals."""
        return self._goals

    def readouts(self, conventions: Conventions) -> Iterable[Variable]:
        """Declare reward terms and success."""
        yield from self._terms()
        yield Measured(
            name="reach_error",
            unit="m",
            parents=("end_effector_positions", *_positions()),
            mechanism=Function(kernels.reach_error),
            doc="Mean absolute error of the nine tip coordinates.",
        )
        yield Measured(
            name="fractional_success",
            bounds=UNIT,
            parents=("reach_error",),
            mechanism=Function(nearness, constants={"reached": REACHED, "far": FAR}),
            doc="1 within a centimeter of the goals, 0 beyond three.",
        )
        yield Measured(
            name="success",
            dtype="integer",
            bounds=Integers(0, 1),
            parents=("reach_error",),
            mechanism=Function(within, constants={"reached": REACHED}),
            doc="1 where the mean error is below a centimeter.",
        )
        weights = dict(self.weights)
        if conventions.distance_as_reward:
            weights["reach_error"] = weights.pop("fractional_success")
        yield reward(weights)

    def _terms(self) -> Iterable[Variable]:
        tips, goals, speeds = "end_effector_positions", _positions(), "joint_velocities"
        yield term(
            "reward.tips_to_goals",
            kernels.reach_progress,
            (tips, Parent(tips, 1), *goals),
            "How much nearer the tips came to their goals [m].",
        )
        far = "Minus the distance of the tips from their goals [m]."
        yield term("reward.distance", minus_distance, (tips, *goals), far)
        torque = "Minus the norm of the joint torques [N m]."
        yield term("reward.torque", minus_norm, ("joint_torques",), torque)
        change = "Minus the change of the joint velocities [rad/s]."
        yield term("reward.smoothness", minus_change, (speeds, Parent(speeds, 1)), change)

    def observed(self) -> Iterable[Observed]:
        """Observe the three goals."""
        for name in GOALS:
            yield from observe_position(name)

    def goals(self, values: Values) -> tuple[Floats, Floats]:
        """Give the tips and their goals, shape (9,) each [m]."""
        desired = np.concatenate([values[name] for name in _positions()])
        return np.array(values["end_effector_positions"]), desired

    def solution(self, values: Values) -> dict[str, Value]:
        """Put the joints where the tips are at their goals, as far as they reach."""
        desired = self.goals(values)[1]
        height = float(values["robot_height"])
        found = inverse(desired, height, np.asarray(values["joint_positions"]))
        return {"joint_positions": found.joint_positions}


def _positions() -> tuple[str, ...]:
    return tuple(f"{name}.cartesian_position" for name in GOALS)
