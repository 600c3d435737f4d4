"""Facts about engines that fail in the middle of a do."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from worlds import actions, play, same

from scm_world._types import Floats
from scm_world.backends.fake import FakeBackend
from scm_world.errors import EngineError, EngineFailure
from scm_world.models import Difference, ParameterKey, Parameters
from scm_world.tasks.trifinger.system import PhysicalState
from scm_world.world import Simulation


class Faulty(FakeBackend):  # type: ignore[misc] # final for users; a double of it is a test
    """A fake that fails on command.

    Attributes:
        fault: What goes wrong next; empty while all is well.
    """

    fault = ""

    def apply(self, difference: Difference) -> None:
        """Apply, perhaps half of it, and perhaps fail."""
        fault, self.fault = self.fault, "" if self.fault.startswith("apply") else self.fault
        if fault == "apply refuses":
            raise EngineFailure("apply refuses", self.name)
        if fault == "apply breaks off":
            half = dict(list(difference.parameters.items())[:1])
            super().apply(Difference(parameters=half, state=difference.state))
            raise EngineFailure("apply breaks off", self.name)
        if fault == "apply is interrupted":
            super().apply(difference)
            raise KeyboardInterrupt
        super().apply(difference)
        self.applied = fault

    def parameters(self, keys: Iterable[ParameterKey]) -> Parameters:
        """Read back, perhaps wrongly."""
        keys = tuple(keys)
        found: dict[ParameterKey, Floats] = dict(super().parameters(keys))
        if keys and all(what == "inertia" for _, what in keys):
            if self.once("inertia"):
                raise EngineFailure("inertia", self.name)
            return found
        fault = self.once("parameters")
        if fault == "parameters raises":
            raise EngineFailure(fault, self.name)
        if fault:
            found = {key: value + 0.5 for key, value in found.items()}
        if fault == "parameters are nan":
            found = {key: value * np.nan for key, value in found.items()}
        return found

    def read(self, into: PhysicalState) -> None:
        """Read the state, perhaps wrongly."""
        super().read(into)
        fault = self.once("read")
        if fault == "read raises":
            raise EngineFailure(fault, self.name)
        if fault:
            into.positions[:] += 0.01

    def step(self, command: Floats, substeps: int) -> None:
        """Step, perhaps losing the state."""
        super().step(command, substeps)
        if self.once("step"):
            self._state.positions[:] = np.nan
            raise EngineFailure("step", self.name)

    def once(self, method: str) -> str:
        """Give the fault of a method, and forget it."""
        if not self.fault.startswith(method):
            return ""
        fault, self.fault = self.fault, ""
        return fault


REQUEST: dict[str, Any] = {
    "block.size": [0.07, 0.07, 0.07],
    "tool_block": {"mass": 0.05, "cartesian_position": [0.0, 0.0, 0.1]},
    "joint_velocities": np.full(9, 0.1),
    "floor_friction": 0.3,
    "control_index": 9,
}


@pytest.mark.parametrize("at_start", [True, False])
@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ("apply refuses", EngineError),
        ("apply breaks off", EngineError),
        ("apply is interrupted", KeyboardInterrupt),
        ("parameters lie", EngineFailure),
        ("parameters are nan", EngineFailure),
        ("parameters raises", EngineFailure),
        ("read lies", EngineFailure),
        ("read raises", EngineFailure),
        ("inertia raises", EngineFailure),
    ],
)
def test_a_do_that_the_engine_fails_is_rolled_back(
    fault: str, error: type[BaseException], at_start: bool
) -> None:
    """Wherever the engine fails, everything is bit-identical to before, and can be done again."""
    backend = Faulty()
    world = Simulation("pushing", backend=backend)
    world.reset(seed=0, do={"tool_block.linear_velocity": [0.01, 0.0, 0.0]})
    if not at_start:
        play(world, actions(3))
    world.do({"stage_friction": 0.4, "goal_block.polar": [0.1, 0.2]})
    start, values, before = world.snapshot(), world.values(), world.previous()
    future = play(world, actions(50, seed=1))
    world.restore(start)
    world.do(REQUEST)
    done, done_future = world.values(), play(world, actions(50, seed=1))

    world.restore(start)
    backend.fault = fault
    with pytest.raises(error):
        world.do(REQUEST)
    assert backend.fault == ""
    assert same(world.values(), values)
    assert same(world.previous(), before)
    assert set(world.graph.interventions) == {"stage_friction", "goal_block.polar"}
    again = world.snapshot()
    np.testing.assert_array_equal(play(world, actions(50, seed=1)), future)

    world.restore(again)
    world.do(REQUEST)
    assert same(world.values(), done)
    np.testing.assert_array_equal(play(world, actions(50, seed=1)), done_future)


def test_the_error_says_what_was_not_taken_over() -> None:
    """Parameters by name, and the state."""
    backend = Faulty()
    world = Simulation("pushing", backend=backend)
    world.reset(seed=0)
    backend.fault = "parameters lie"
    with pytest.raises(EngineFailure, match=r"did not take over tool_block\.mass"):
        world.do({"tool_block.mass": 0.05})
    backend.fault = "read lies"
    with pytest.raises(EngineFailure, match="the state"):
        world.do({"tool_block.cartesian_position": [0.0, 0.0, 0.1]})


def test_a_world_survives_a_step_that_fails() -> None:
    """After a reset it is as good as new."""
    backend = Faulty()
    world = Simulation("pushing", backend=backend)
    world.reset(seed=0)
    fresh, future = world.values(), play(world, actions(5))
    backend.fault = "step loses it"
    with pytest.raises(EngineFailure):
        world.step(np.zeros(9))
    world.reset(seed=0)
    assert same(world.values(), fresh)
    np.testing.assert_array_equal(play(world, actions(5)), future)
