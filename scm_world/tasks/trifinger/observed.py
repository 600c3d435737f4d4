"""The published layout of the structured observation."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from scm_world.tasks.observed import Observed
from scm_world.tasks.trifinger import hardware

HEAD = (
    Observed("joint_positions", (hardware.JOINT_LOW, hardware.JOINT_HIGH), low=-3.3, high=3.3),
    Observed("joint_velocities", (-50.0, 50.0)),
    Observed(
        "end_effector_positions", ((-0.5, -0.5, 0.0) * 3, (0.5, 0.5, 0.5) * 3), low=-1.0, high=1.0
    ),
)
"""What every observation begins with, after the time that is left."""

_CARTESIAN = ((-0.5, -0.5, 0.0), (0.5, 0.5, 0.5))
_SPACE = {"low": -1.0, "high": 1.0}
_SIZE = (0.03, 0.1)


def _shape_and_pose(name: str, kind: int) -> Iterable[Observed]:
    yield Observed(f"{name}.type", (kind, kind), low=0.0, high=30.0)
    yield Observed(f"{name}.size", _SIZE, low=0.0, high=0.6)
    yield Observed(f"{name}.cartesian_position", _CARTESIAN, **_SPACE)
    yield Observed(f"{name}.orientation", (-10.0, 10.0), **_SPACE)


def observe_tool(name: str, kind: int = 1) -> Iterable[Observed]:
    """List the 17 numbers of a movable block."""
    yield from _shape_and_pose(name, kind)
    yield Observed(f"{name}.linear_velocity", (-0.5, 0.5))
    yield Observed(f"{name}.angular_velocity", (-np.pi, np.pi))


def observe_goal(name: str, kind: int = 20) -> Iterable[Observed]:
    """List the 11 numbers of a goal block."""
    return _shape_and_pose(name, kind)


def observe_obstacle(name: str) -> Iterable[Observed]:
    """List the 11 numbers of an obstacle."""
    return _shape_and_pose(name, 10)


def observe_position(name: str) -> Iterable[Observed]:
    """List the three numbers of a goal that is a point."""
    yield Observed(f"{name}.cartesian_position", _CARTESIAN, **_SPACE)
