"""The suite of backends with a busy scene of the robot, on Warp's CPU device."""

from __future__ import annotations

import pytest

pytest.importorskip("mujoco_warp")

from test_robot_conformance import RobotConformance

from scm_world.backends import Backend, make_backend
from scm_world.tasks.trifinger.hardware import FAST
from scm_world.testing.backend import BackendConformance


@pytest.mark.slow
class TestWarp(BackendConformance):
    """What every engine promises; facts about the robot have 64 bits, and this one has 32."""

    preset = FAST
    substeps = RobotConformance.substeps
    busy, commands = RobotConformance.busy, RobotConformance.commands
    other_value = RobotConformance.other_value
    changed_states = RobotConformance.changed_states
    other_structures = RobotConformance.other_structures
    test_a_body_that_touches_nothing_does_nothing = (
        RobotConformance.test_a_body_that_touches_nothing_does_nothing
    )

    def make(self) -> Backend:
        """Create a backend on the CPU device."""
        return make_backend("warp:cpu")
