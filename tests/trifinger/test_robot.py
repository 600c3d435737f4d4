"""The robot as variables, at every resolution."""

from __future__ import annotations

import numpy as np
import pytest

from scm_world.tasks.composition import Entity
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.entities.robot import ACTIONS, RESOLUTIONS, robot
from scm_world.tasks.trifinger.system import trifinger
from scm_world.variables import Action, Box, Measured
from scm_world.world import Simulation

FINER = RESOLUTIONS[1:]


def states(entity: Entity) -> dict[str, Measured]:
    """Return what physics moves, by name."""
    variables = (v for v in entity.variables if isinstance(v, Measured) and v.mechanism is None)
    return {variable.name: variable for variable in variables}


@pytest.mark.parametrize("resolution", RESOLUTIONS)
def test_the_states_fill_the_state_vector(resolution: str) -> None:
    """Every one of the 27 numbers belongs to one declared state, whose shape is that of its row."""
    rows = {row.name: row for row in trifinger(resolution=resolution).states}
    assert sum(int(np.prod(row.shape)) for row in rows.values()) == 27
    found = states(robot("joint_positions", resolution=resolution))
    assert {name: (state.shape, state.unit) for name, state in found.items()} == {
        name: (row.shape, row.unit) for name, row in rows.items()
    }
    assert {name for name, state in found.items() if not state.settable} == {
        name for name, row in rows.items() if row.reported
    }


@pytest.mark.parametrize("mode", ACTIONS)
@pytest.mark.parametrize("resolution", FINER)
def test_parts_share_what_the_whole_has(mode: str, resolution: str) -> None:
    """Bounds, spaces and starts of the parts are together those of the whole robot."""
    whole = states(robot(mode))
    places = trifinger(resolution=resolution).layout.slices
    parts = states(robot(mode, resolution=resolution))
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
    bundles = {v.name: v.parts for v in robot(mode, resolution="finger").variables if v.parts}
    assert bundles == {
        "action": tuple(f"finger_{f}.action" for f in hardware.FINGERS),
        "joint_positions": tuple(f"finger_{f}.joint_positions" for f in hardware.FINGERS),
        "joint_velocities": tuple(f"finger_{f}.joint_velocities" for f in hardware.FINGERS),
        "joint_torques": tuple(f"finger_{f}.joint_torques" for f in hardware.FINGERS),
        "end_effector_positions": tuple(
            f"finger_{f}.end_effector_position" for f in hardware.FINGERS
        ),
    }
    assert not [v for v in robot(mode).variables if v.parts]


def test_a_tip_is_commanded_as_a_whole() -> None:
    """Where fingertips are commanded, an action is a point, even of a robot of nine joints."""
    entity = robot("end_effector_positions", resolution="joint")
    actions = [v for v in entity.variables if isinstance(v, Action)]
    assert [action.shape for action in actions] == [(3,)] * 3
    assert isinstance(actions[0].bounds, Box)
    assert actions[0].bounds.low == (-0.5, -0.5, 0.0)


@pytest.mark.parametrize("resolution", FINER)
def test_fingers_act_on_one_another_by_contact_only(resolution: str) -> None:
    """What is of one finger acts always on this finger, and on no other one."""
    model = Simulation("reaching", resolution=resolution, backend="fake").model
    of_fingers = {n for n in model if "finger_" in n and n != "finger_friction"}
    for state in (n for n in of_fingers if model.declared(n).role == "state"):
        finger = state.split("_")[1].partition(".")[0]
        causes = {e.cause: e.when for e in model.edges if e.effect == state and e.lag == 1}
        always = {cause for cause, when in causes.items() if when is None}
        assert all(f"finger_{finger}" in cause for cause in always & of_fingers)
        assert {"gravity", "position_gains", "actuator_noise"} <= always
        assert not {"robot_height", "finger_friction"} & always


def test_the_height_acts_always_where_tips_are_commanded() -> None:
    """The joints that bring a tip to its place depend on the height of the robot."""
    model = Simulation("reaching", action_mode="end_effector_positions", backend="fake").model
    edges = {e.effect: e.when for e in model.edges if e.cause == "robot_height" and e.lag == 1}
    assert edges == dict.fromkeys(("joint_positions", "joint_velocities", "joint_torques"))
