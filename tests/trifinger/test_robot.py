"""The robot as variables, at every resolution."""

from __future__ import annotations

import numpy as np
import pytest

from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.entities.robot import ACTIONS, RESOLUTIONS, Robot
from scm_world.variables import Action, Box

FINER = RESOLUTIONS[1:]


@pytest.mark.parametrize("resolution", RESOLUTIONS)
def test_the_states_fill_the_state_vector(resolution: str) -> None:
    """Every one of the 27 numbers belongs to one state, whose shape is that of its place."""
    robot = Robot("joint_positions", resolution=resolution)
    places = robot.slices(-1)
    numbers = sorted(n for where in places.values() for n in range(where.start, where.stop))
    assert numbers == list(range(27))
    for state in robot.states():
        where = places[state.name]
        assert int(np.prod(state.shape)) == where.stop - where.start


@pytest.mark.parametrize("mode", ACTIONS)
@pytest.mark.parametrize("resolution", FINER)
def test_parts_share_what_the_whole_has(mode: str, resolution: str) -> None:
    """Bounds, spaces and starts of the parts are together those of the whole robot."""
    whole = {state.name: state for state in Robot(mode).states()}
    finer = Robot(mode, resolution=resolution)
    places, parts = finer.slices(-1), {state.name: state for state in finer.states()}
    for number, state in enumerate(whole.values()):
        mine = {n: w for n, w in places.items() if w.start // 9 == number}
        for what in ("bounds", "a", "b"):
            box = getattr(state, what)
            for name, where in mine.items():
                own = getattr(parts[name], what)
                if box is None:
                    assert own is None
                    continue
                for end, other in zip(
                    box.bounds((9,), {}), own.bounds(parts[name].shape, {}), strict=True
                ):
                    first = where.start - 9 * number
                    np.testing.assert_array_equal(end[first : first + other.size], other.ravel())
        start = np.concatenate(
            [np.ravel(parts[name].default) for name in sorted(mine, key=lambda n: mine[n].start)]
        )
        np.testing.assert_array_equal(start, state.default)


@pytest.mark.parametrize("mode", ACTIONS)
def test_the_names_of_the_whole_robot_are_bundles(mode: str) -> None:
    """Actions, what moves and the tips are put together under the names that they have."""
    robot = Robot(mode, resolution="finger")
    bundles = {v.name: v.parts for v in robot.variables() if v.parts}
    assert bundles == {
        "action": tuple(f"finger_{f}.action" for f in hardware.FINGERS),
        "joint_positions": tuple(f"finger_{f}.joint_positions" for f in hardware.FINGERS),
        "joint_velocities": tuple(f"finger_{f}.joint_velocities" for f in hardware.FINGERS),
        "joint_torques": tuple(f"finger_{f}.joint_torques" for f in hardware.FINGERS),
        "end_effector_positions": tuple(
            f"finger_{f}.end_effector_position" for f in hardware.FINGERS
        ),
    }
    assert not [v for v in Robot(mode).variables() if v.parts]


def test_a_tip_is_commanded_as_a_whole() -> None:
    """Where fingertips are commanded, an action is a point, even of a robot of nine joints."""
    robot = Robot("end_effector_positions", resolution="joint")
    actions = [v for v in robot.variables() if isinstance(v, Action)]
    assert [action.shape for action in actions] == [(3,)] * 3
    assert isinstance(actions[0].bounds, Box)
    assert actions[0].bounds.low == (-0.5, -0.5, 0.0)


@pytest.mark.parametrize("resolution", FINER)
def test_fingers_act_on_one_another_by_contact_only(resolution: str) -> None:
    """What is of one finger acts always on this finger, and on no other one."""
    robot = Robot("joint_positions", resolution=resolution)
    for state in robot.states():
        finger = state.name.split("_")[1].partition(".")[0]
        own = {name for name in state.always if "finger_" in name}
        assert own == {n for n in robot.inputs() if f"finger_{finger}" in n}
        assert {"gravity", "position_gains", "actuator_noise"} <= set(state.always)
        assert not {"robot_height", "finger_friction"} & set(state.always)


def test_the_height_acts_always_where_tips_are_commanded() -> None:
    """The joints that bring a tip to its place depend on the height of the robot."""
    states = Robot("end_effector_positions").states()
    assert all("robot_height" in state.always for state in states)
