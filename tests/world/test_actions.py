"""Facts about actions, options and what a world can be asked."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from worlds import PARAMS, REST, actions, begin, play, same, shared

from scm_world.errors import (
    ActionError,
    InterventionError,
    MissingEngine,
    ModelError,
    UnknownOption,
    UnknownVariable,
    WrongValue,
)
from scm_world.tasks.trifinger.kinematics import forward
from scm_world.variables import Box, Draw, Hard, Scale, Shift
from scm_world.world import Simulation


@pytest.mark.parametrize(("backend", "task"), PARAMS)
def test_actions_outside_their_range_are_clipped(backend: str, task: str) -> None:
    """Asking for more than the range is asking for its end."""
    world = begin(backend, task)
    start = world.snapshot()
    world.step(np.full(9, 100.0))
    assert world["action"].tolist() == world.action_high.tolist()
    values = world.values()
    world.restore(start)
    world.step(world.action_high)
    assert same(world.values(), values)


@pytest.mark.parametrize(
    "action",
    [
        np.zeros(8),
        np.zeros((9, 1)),
        0.0,
        [np.nan] * 9,
        [0.0] * 8 + [np.inf],
        "left",
        ["a"] * 9,
        [[0.0], [1.0, 2.0]],
        None,
    ],
    ids=repr,
)
def test_what_is_no_action_is_refused(action: Any) -> None:
    """The error carries what was given, and the world is as it was."""
    world = begin("fake", "pushing")
    values, before = world.values(), world.previous()
    with pytest.raises(ActionError, match="9 finite numbers") as caught:
        world.step(action)
    assert caught.value.action is action
    assert same(world.values(), values)
    assert same(world.previous(), before)


def test_the_action_is_not_changed_nor_kept() -> None:
    """A step neither writes into the array it is given nor looks at it later."""
    world = begin("fake", "reaching")
    action = np.full(9, 0.3)
    world.step(action)
    assert action.tolist() == [0.3] * 9
    action[:] = 0.9
    assert world["action"].tolist() == [0.3] * 9


def test_torques_can_be_commanded() -> None:
    """In torque mode the joints accelerate with the torque; the range is that of the motors."""
    world = Simulation("reaching", backend="mujoco", action_mode="joint_torques")
    assert world.model["action"].unit == "N m"
    np.testing.assert_array_equal(world.action_high, 0.36)
    moved = []
    for torque in (0.1, -0.1):
        world.reset(seed=0)
        play(world, [np.tile([torque, 0.0, 0.0], 3)] * 3)
        moved.append(world["joint_velocities"][::3])
    assert (moved[0] > moved[1] + 0.1).all()
    world.close()


@pytest.mark.parametrize("backend", ["fake", "mujoco"])
def test_fingertips_can_be_commanded(backend: str) -> None:
    """In end-effector mode the tips go to the points that are asked for."""
    world = Simulation("reaching", backend=backend, action_mode="end_effector_positions")
    assert world.model["action"].unit == "m"
    world.reset(seed=0)
    wanted = forward(REST + np.tile([0.1, -0.1, -0.1], 3), float(world["robot_height"]))
    play(world, [wanted] * 40)
    tolerance = 1e-9 if backend == "fake" else 0.02  # gravity against the position gain
    np.testing.assert_allclose(world["end_effector_positions"], wanted, atol=tolerance)
    np.testing.assert_array_equal(world["action"], wanted)
    world.close()


@pytest.mark.parametrize("preset", ["fast", "precise"])
@pytest.mark.parametrize("frame_skip", [1, 10])
def test_a_control_step_takes_the_same_time_under_every_preset(
    preset: str, frame_skip: int
) -> None:
    """Frame skip counts units of 4 ms, so a block flies equally far."""
    world = Simulation("pushing", backend="fake", preset=preset, frame_skip=frame_skip)
    world.reset(seed=0)
    world.do({"tool_block.linear_velocity": [0.0, 0.0, 1.0]})
    world.step(REST)
    height = world["tool_block.cartesian_position"][2] - 0.0325
    assert (
        height == pytest.approx(world.options.control_period) == pytest.approx(0.004 * frame_skip)
    )


def test_episodes_have_the_published_lengths() -> None:
    """Ten seconds of pushing are 250 steps, five of reaching 125; a length can be given."""
    assert Simulation("pushing", backend="fake").max_episode_length == 250
    assert Simulation("reaching", backend="fake").max_episode_length == 125
    assert Simulation("pushing", backend="fake", frame_skip=5).max_episode_length == 500
    assert Simulation("pushing", backend="fake", max_episode_length=7).max_episode_length == 7


@pytest.mark.parametrize(
    ("options", "suggestion"),
    [
        ({"task": "pushin"}, "pushing"),
        ({"backend": "mojuco"}, "mujoco"),
        ({"preset": "fats"}, "fast"),
        ({"action_mode": "joint_position"}, "joint_positions"),
        ({"conventions": "causalworld"}, "causal_world"),
        ({"frame_skip": 0}, "frame_skip"),
        ({"frame_skip": 2.5}, "frame_skip"),
        ({"max_episode_length": 0}, "from 1 to"),
    ],
    ids=str,
)
def test_an_option_that_does_not_exist_is_refused(options: dict[str, Any], suggestion: str) -> None:
    """The error lists the choices and suggests the nearest."""
    with pytest.raises(UnknownOption, match=suggestion) as caught:
        Simulation(**{"backend": "fake", **options})
    assert caught.value.option in options
    assert caught.value.choices


def test_a_missing_engine_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error names the command."""
    import importlib

    def absent(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(MissingEngine, match="pip install") as caught:
        Simulation("pushing", backend="bullet")
    assert caught.value.engine == "bullet"


def test_values_are_copies() -> None:
    """Writing into what a world gives changes nothing in it."""
    world = begin("mujoco", "pushing")
    values = world.values()
    for array in (*world.values().values(), *world.previous().values()):
        array[...] = 77
    world["gravity"][...] = 77
    world.scene().state.vector[:] = 77
    assert same(world.values(), values)
    with pytest.raises(UnknownVariable, match="did you mean 'gravity'"):
        world["gravty"]


def test_the_given_values_are_copied() -> None:
    """Writing into what a do was given changes nothing afterwards."""
    world = begin("fake", "pushing")
    gravity, place = np.array([0.0, 0.0, -5.0]), np.array([0.0, 0.0, 0.1])
    audit = world.do({"gravity": gravity, "tool_block.cartesian_position": place})
    gravity[:] = place[:] = 0.3
    assert world["gravity"].tolist() == [0.0, 0.0, -5.0]
    assert world["tool_block.cartesian_position"].tolist() == [0.0, 0.0, 0.1]
    audit.targets["gravity"].applied[...] = 7.0
    assert world["gravity"].tolist() == [0.0, 0.0, -5.0]


def test_a_scene_describes_the_present() -> None:
    """Parameters, state and goals are those of the world."""
    world = begin("mujoco", "pushing")
    world.do({"block.size": [0.07] * 3, "floor_color": [0.1, 0.2, 0.3]})
    scene = world.scene()
    assert scene.parameters["floor", "color"].tolist() == [0.1, 0.2, 0.3]
    assert scene.parameters["tool_block", "size"].tolist() == [0.07] * 3
    np.testing.assert_array_equal(scene.state.positions[0], world["tool_block.cartesian_position"])
    assert scene.goals[0].name == "goal_block"
    np.testing.assert_array_equal(scene.goals[0].position, world["goal_block.cartesian_position"])


def test_a_step_of_one_world_is_seen_by_evaluate() -> None:
    """The quick way to values and the copying one agree."""
    world = shared("mujoco", "pushing")
    world.reset(seed=0)
    for command in actions(5):
        world.step(command)
        quick = dict(world.evaluate(("reward", "tool_block.cylindrical_position")))
        values = world.values()
        assert quick["reward"] == values["reward"]
        name = "tool_block.cylindrical_position"
        np.testing.assert_array_equal(quick[name], values[name])


def test_actions_that_are_changed_at_every_step_have_no_value_yet() -> None:
    """The audit says so, and no space can be asked for."""
    world = begin("fake", "pushing")
    audit = world.do({"action": Shift(0.1)})
    assert audit.targets["action"].applied is None
    assert "at every step" in str(audit)
    with pytest.raises(InterventionError, match="varies from step to step"):
        world.do({"action": Shift(0.1)}, space="A")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"backend": 123}, "backend cannot be 123"),
        ({"task": 5}, "a task or its class"),
        ({"task": None}, "source of a world cannot be None"),
    ],
    ids=repr,
)
def test_what_is_no_task_and_no_backend_is_refused(options: dict[str, Any], words: str) -> None:
    """With what there is."""
    with pytest.raises(UnknownOption, match=words):
        Simulation(**{"backend": "fake", **options})


@pytest.mark.parametrize(
    "make",
    [
        lambda: Draw("C"),
        lambda: Draw(3),
        lambda: Shift("a"),
        lambda: Scale([1.0, "b"]),
        lambda: Hard([[1.0], [1.0, 2.0]]),
    ],
)
def test_what_is_no_intervention_is_refused_at_once(make: Any) -> None:
    """With what it can be."""
    with pytest.raises((UnknownOption, ModelError), match="it can be"):
        make()


def test_a_space_is_drawn_from_by_name_and_a_box_has_to_fit() -> None:
    """The errors say how to draw, and that the numbers are too many."""
    world = begin("fake", "pushing")
    with pytest.raises(WrongValue, match='Draw\\("A"\\)'):
        world.do({"tool_block.mass": "A"})
    with pytest.raises(InterventionError, match="does not fit its shape"):
        world.do({"tool_block.mass": Draw(Box((0.0, 0.0), (1.0, 1.0)))})
