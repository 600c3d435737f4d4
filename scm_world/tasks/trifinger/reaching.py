"""Reaching: bring each fingertip to a point."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Unpack, final

import numpy as np

from scm_world._types import ArrayLike, Floats, Value, Values
from scm_world.geometry.numbers import njit, scalar
from scm_world.tasks.base import Goal, Observed, checked
from scm_world.tasks.composition import Entity
from scm_world.tasks.rewards import FRACTION, SUCCESS, UNIT, Common, reward, weighted
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger import hardware, kernels
from scm_world.tasks.trifinger.base import ROWS, TriFingerTask, observe
from scm_world.tasks.trifinger.entities.bodies import (
    COUNT,
    body,
    obstacle_names,
    orientation,
    position,
    scattered,
    scattering,
)
from scm_world.tasks.trifinger.kernels import PLACES, SMOOTHNESS, TIPS, TIPS_WAS
from scm_world.tasks.trifinger.kinematics import inverse
from scm_world.variables import Box, Cylinder, Draw, Function, Integers, Measured, Variable
from scm_world.variables.kinds import SpaceName

REACHED = 0.01  # [m] mean error of a coordinate that counts as success
FAR = 0.03  # [m] mean error at which the fractional success is zero

GOALS = tuple(f"goal_{finger}" for finger in hardware.FINGERS)
_SIZES = numbers.Range(
    *(Box(0.005, 0.2), None, None, "m", (3,)),
    doc="Diameter, three times; only pictures and the lowest height of A and B use it.",
)
_TINTS = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@njit(cache=True)
def nearness(error: Value, reached: Value, far: Value) -> float:
    """Compute the fractional success: 1 at ``reached`` or nearer, 0 at ``far`` or farther."""
    near, end = scalar(reached), scalar(far)
    return 1.0 - (min(max(scalar(error), near), end) - near) / (end - near)


@njit(cache=True)
def within(error: Value, reached: Value) -> int:
    """Return whether the error is small enough, as 0 or 1."""
    return int(scalar(error) < scalar(reached))


@final
class Reaching(TriFingerTask):
    """Three points in the air, one for each fingertip.

    Args:
        default_goal_60: Default goal of the first finger [m].
        default_goal_120: Default goal of the second finger [m].
        default_goal_300: Default goal of the third finger [m].
        number_of_obstacles: How many small boxes are in the way.
        common: Options of every task; see ``Common``.
    """

    name = "reaching"
    default_weights, dense_terms = weighted(
        (100_000.0, "tips_to_goals", kernels.reach_progress, (TIPS, TIPS_WAS, *PLACES)),
        (0.0, "distance", kernels.minus_reach_distance, (TIPS, *PLACES)),
        (0.0, "torque", kernels.minus_length, ("joint_torques",)),
        (0.0, *SMOOTHNESS),
        fraction=1.0,
    )
    paper_weights = {FRACTION: 0.0}  # noqa: RUF012 # a constant
    ready_terms = kernels.REACHING
    seconds = 5.0
    decided_by = (COUNT,)
    goal_causes = tuple(f"{name}.cylindrical_position" for name in GOALS)

    def __init__(
        self,
        *,
        default_goal_60: tuple[float, float, float] = (0.0, 0.0, 0.10),
        default_goal_120: tuple[float, float, float] = (0.0, 0.0, 0.13),
        default_goal_300: tuple[float, float, float] = (0.0, 0.0, 0.16),
        number_of_obstacles: int = 0,
        **common: Unpack[Common],
    ) -> None:
        super().__init__(**common)
        given = {"60": default_goal_60, "120": default_goal_120, "300": default_goal_300}
        self._places = tuple(
            checked(f"default_goal_{finger}", place, numbers.POSITION_BOUNDS, shape=(3,))
            for finger, place in given.items()
        )
        self.roots = (*scattering(number_of_obstacles),)

    def arrange(self, values: Values) -> int:
        """Count the obstacles."""
        return int(values[COUNT])

    def entities(self) -> Iterable[Entity]:
        """Three balls of 3 cm that the fingertips should reach, and obstacles."""
        for name, place, tint in zip(GOALS, self._places, _TINTS, strict=True):
            size = _SIZES.root(f"{name}.size", (0.03,) * 3)
            pose = position(name, default=place), orientation(name)
            spaces = numbers.places(numbers.half_height(size.name), airborne=True)
            yield body("sphere", name, size, *pose, color=tint, spaces=spaces)
        yield from scattered(self.arranged)

    def readouts(self) -> Iterable[Variable]:
        """Declare reward terms and success."""
        yield from self.dense_terms
        yield Measured(
            name="reach_error",
            unit="m",
            parents=(TIPS, *PLACES),
            mechanism=Function(kernels.reach_error),
            doc="Mean absolute error of the nine tip coordinates.",
        )
        yield Measured(
            name=FRACTION,
            bounds=UNIT,
            parents=("reach_error",),
            mechanism=Function(nearness, constants={"reached": REACHED, "far": FAR}),
            doc="1 within a centimeter of the goals, 0 beyond three.",
        )
        yield Measured(
            name=SUCCESS,
            dtype="integer",
            bounds=Integers(0, 1),
            parents=("reach_error",),
            mechanism=Function(within, constants={"reached": REACHED}),
            doc="1 where the mean error is below a centimeter.",
        )
        yield from self.terms
        weights = dict(self.weights)
        if self.conventions.published:
            weights["reach_error"] = weights.pop(FRACTION)
        yield reward(weights)

    def observed(self) -> Iterable[Observed]:
        """Observe the three goals and the obstacles."""
        yield from (Observed(place, *ROWS["cartesian_position"]) for place in PLACES)
        for name in obstacle_names(self.arranged):
            yield from observe(name, 10)

    @property
    def goal(self) -> Goal:
        """The tips should be at their goals, nine numbers each [m]."""
        return Goal(
            achieved=(TIPS,),
            desired=PLACES,
            causes=self.goal_causes,
            measures={
                "reach_error": error_of,
                FRACTION: fraction_of,
                SUCCESS: lambda tips, goals: fraction_of(tips, goals) >= 1.0,
            },
        )

    def solution(self, values: Values) -> dict[str, Value]:
        """Put the joints where the tips are at their goals, as far as they reach."""
        desired = self.goal.vectors(values)[1]
        height = float(values["robot_height"])
        found = inverse(desired, height, np.asarray(values["joint_positions"]))
        return {"joint_positions": found.joint_positions}

    def sample_goal(self, space: SpaceName = "A") -> dict[str, Any]:
        """Draw each goal uniformly by volume."""
        if space == "A|B":
            return super().sample_goal(space)
        radii = numbers.RADIUS_A if space == "A" else numbers.RADIUS_B
        height = numbers.HEIGHT_A if space == "A" else numbers.HEIGHT_B
        return {
            f"{name}.cylindrical_position": Draw(
                Cylinder(numbers.cylindrical(radii, numbers.half_height(f"{name}.size"), height))
            )
            for name in GOALS
        }


def error_of(tips: ArrayLike, goals: ArrayLike) -> Floats:
    """Compute the mean absolute error of coordinates, shape (...) [m]."""
    return np.asarray(np.abs(np.asarray(tips) - np.asarray(goals)).mean(axis=-1))


def fraction_of(tips: ArrayLike, goals: ArrayLike) -> Floats:
    """Compute how near tips are to their goals, in [0, 1], shape (...)."""
    return np.asarray(np.vectorize(nearness)(error_of(tips, goals), REACHED, FAR))
