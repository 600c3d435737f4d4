"""Facts about what do means: what follows, what stays, and what goes on."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from worlds import (
    PARAMS,
    PUSHING,
    REST,
    actions,
    begin,
    differing,
    other,
    play,
    same,
    settable,
    shared,
)

from scm_world.errors import (
    Infeasible,
    OutOfBounds,
)
from scm_world.geometry.coordinates import from_cylindrical
from scm_world.geometry.rotations import from_rotation_vector
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.entities.bodies import lowest_point
from scm_world.variables import Affine, Box, Draw, Scale, Shift
from scm_world.world import Simulation

# --- what is moved, and what is not --------------------------------------------------------------


@pytest.mark.parametrize(("backend", "task"), PUSHING)
def test_one_size_moves_tool_and_goal(backend: str, task: str) -> None:
    """Both blocks, and the heights of both, follow their shared cause; nothing else does."""
    world = begin(backend, task)
    before = world.values()
    world.do({"block.size": [0.06, 0.07, 0.08]})
    after = world.values()
    assert after["tool_block.size"].tolist() == after["goal_block.size"].tolist()
    assert after["goal_block.cartesian_position"][2] == 0.04
    allowed = ("tool_block.", "goal_block.", "block.", "reward", "fractional", "success")
    assert all(name.startswith(allowed) for name in differing(before, after))
    np.testing.assert_array_equal(
        before["tool_block.cartesian_position"][:2], after["tool_block.cartesian_position"][:2]
    )


@pytest.mark.parametrize(("backend", "task"), PUSHING)
def test_an_intervention_on_one_block_leaves_the_other(backend: str, task: str) -> None:
    """A tool of its own size is cut from the shared cause, and stays so."""
    world = begin(backend, task)
    world.do({"tool_block.size": [0.05, 0.05, 0.05]})
    assert world["goal_block.size"].tolist() == [0.065] * 3
    play(world, actions(2))
    world.do({"block.size": [0.08] * 3})
    assert world["tool_block.size"].tolist() == [0.05] * 3
    assert world["goal_block.size"].tolist() == [0.08] * 3
    assert world.graph.parents("tool_block.size") == ()


@pytest.mark.parametrize(
    "turn", [[0.0, 0.0, 0.0], [0.0, 0.0, 0.7], [0.5, 0.3, 0.2], [np.pi / 4, 0.0, 0.0]], ids=str
)
@pytest.mark.parametrize(("backend", "task"), PUSHING)
def test_a_block_that_grows_does_not_sink(backend: str, task: str, turn: list[float]) -> None:
    """Its lowest point stays where it was, however it is turned."""
    world = begin(backend, task)
    place = [0.0, 0.0, 0.08]
    world.do({"tool_block": {"cartesian_position": place, "euler_orientation": turn}})
    play(world, [REST])

    def lowest() -> float:
        orientation, size = world["tool_block.orientation"], world["tool_block.size"]
        height = world["tool_block.cartesian_position"][2]
        return float(height - lowest_point(size, orientation))

    before = lowest()
    for size in ([0.07, 0.08, 0.075], [0.055, 0.06, 0.07]):
        world.do({"tool_block.size": size})
        assert lowest() == pytest.approx(before, abs=1e-15)


def test_a_shift_starts_from_where_the_block_was_carried_to() -> None:
    """Growing and moving sideways in one do keeps the block on the floor."""
    world = begin("fake", "pushing")
    bottom = world["tool_block.cartesian_position"][2] - world["tool_block.size"][2] / 2.0
    world.do({"tool_block.cartesian_position": Shift([0.01, 0.02, 0.0]), "block.size": [0.09] * 3})
    x, y, z = world["tool_block.cartesian_position"]
    assert (x, y) == pytest.approx((0.01, -0.06))
    assert z - 0.045 == pytest.approx(bottom)


@pytest.mark.parametrize("entity", ["tool_block", "goal_block"])
@pytest.mark.parametrize(("backend", "task"), PUSHING)
def test_a_pose_can_be_given_in_other_coordinates(backend: str, task: str, entity: str) -> None:
    """Cylindrical positions and rotation vectors set the same pose."""
    world = begin(backend, task)
    cylinder, turn = [0.03, 2.0, 0.15], [0.1, -0.2, 0.3]
    world.do({entity: {"cylindrical_position": cylinder, "euler_orientation": turn}})
    position, orientation = f"{entity}.cartesian_position", f"{entity}.orientation"
    np.testing.assert_allclose(world[position], from_cylindrical(cylinder), atol=1e-15)
    np.testing.assert_allclose(world[orientation], from_rotation_vector(turn), atol=1e-15)
    np.testing.assert_allclose(world[f"{entity}.cylindrical_position"], cylinder, atol=1e-15)
    np.testing.assert_allclose(world[f"{entity}.euler_orientation"], turn, atol=1e-15)


@pytest.mark.parametrize(("backend", "task"), PARAMS)
def test_appearances_and_goals_have_no_effect(backend: str, task: str) -> None:
    """Colors, goals and the masses of the finger bases move nothing that moves."""
    world = begin(backend, task)
    start = world.snapshot()
    n_states = world.vector.size
    commands = actions(50, seed=3, spread=0.8)
    future = play(world, commands)[:, :n_states]
    still = [
        name
        for name in settable(world)
        if name.endswith(("color", "link_0.mass")) or name.startswith("goal")
    ]
    assert len(still) > 12
    for name in still:
        world.restore(start)
        world.do({name: other(world, name)})
        moved = play(world, commands)[:, :n_states]
        np.testing.assert_array_equal(moved, future, err_msg=name)


# --- interventions as values ---------------------------------------------------------------------


@pytest.mark.parametrize(("backend", "task"), PUSHING)
def test_shift_and_scale_change_parameters_and_states(backend: str, task: str) -> None:
    """A parameter is moved from what it would have been, a state from where it is."""
    world = begin(backend, task)
    velocity, place = world["joint_velocities"], world["tool_block.cartesian_position"]
    world.do(
        {
            "tool_block.mass": Scale(2.0),
            "floor_friction": Shift(-0.1),
            "joint_velocities": Scale(0.5),
            "tool_block.cartesian_position": Shift([0.0, 0.0, 0.1]),
        }
    )
    assert world["tool_block.mass"] == pytest.approx(0.04)
    assert world["floor_friction"] == pytest.approx(0.4)
    np.testing.assert_allclose(world["joint_velocities"], 0.5 * velocity)
    np.testing.assert_allclose(
        world["tool_block.cartesian_position"], place + np.array([0.0, 0.0, 0.1])
    )


def test_a_shift_goes_on_following_its_parent() -> None:
    """Mutilation by a shift keeps the edge: a later change of the parent comes through."""
    world = begin("fake", "pushing")
    world.do({"tool_block.size": Shift(0.01)})
    play(world, [REST])
    world.do({"block.size": [0.06] * 3})
    np.testing.assert_allclose(world["tool_block.size"], 0.07)
    with pytest.raises(OutOfBounds) as caught:  # what follows has bounds too
        world.do({"block.size": [0.195] * 3})
    assert caught.value.variable == "tool_block.size"


@pytest.mark.parametrize("space", ["A", "B", "A|B"])
def test_a_draw_lies_in_its_space(space: Any) -> None:
    """What is drawn from a space passes the check of that space."""
    world = begin("fake", "pushing")
    names = [n for n in settable(world) if world.model[n].space(space) is not None]
    names = [n for n in names if not n.startswith(("joint", "tool_block.c", "tool_block.e"))]
    assert len(names) > 20
    for name in names:
        world.reset(seed=1)
        if world.model.target(name) in world.static_names:
            world.do({name: Draw(space)}, space=space)
    world.reset(seed=1)
    for episode in range(20):
        world.reset(seed=episode)
        world.do({"joint_positions": hardware.RAISED})
        try:
            world.do({"tool_block.cylindrical_position": Draw(space)}, space=space)
        except Infeasible:  # a finger is in the way
            continue
        z = world["tool_block.cartesian_position"][2]
        assert z == pytest.approx(0.0325)


def test_spaces_follow_the_size_that_is_set_with_them() -> None:
    """The height of a drawn block is half of its new size, not of the old one."""
    world = begin("fake", "pushing")
    world.do({"goal_block.cylindrical_position": Draw("A"), "block.size": [0.09] * 3})
    assert world["goal_block.cartesian_position"][2] == pytest.approx(0.045)
    world.do({"goal_block.cylindrical_position": Draw("B"), "goal_block.size": [0.07] * 3})
    assert world["goal_block.cartesian_position"][2] == pytest.approx(0.035)
    assert "goal_block.size" in world.model.do(
        {"goal_block.cylindrical_position": Draw("A")}
    ).parents("goal_block.cartesian_position")


@pytest.mark.parametrize("parent", ["floor_friction", "tool_block.friction", "robot_height"])
def test_a_draw_may_follow_any_parameter_of_the_same_do(parent: str) -> None:
    """Whatever the order of declaration, bounds see the new values."""
    world = begin("fake", "pushing")
    source = Draw(Box(Affine(parent=parent), Affine(parent=parent, offset=1e-3)))
    for name in ("stage_friction", "tool_block.mass"):
        world.do({name: source, parent: 0.35})
        assert 0.35 <= world[name] <= 0.351


def test_a_draw_may_follow_a_state() -> None:
    """Bounds of a parameter see where the block is."""
    world = begin("fake", "pushing")
    world.do(
        {
            "tool_block.mass": Draw(
                Box(0.01, Affine(parent="tool_block.cartesian_position", index=2))
            )
        }
    )
    assert 0.01 <= world["tool_block.mass"] <= world["tool_block.cartesian_position"][2]


def test_the_asked_space_is_checked() -> None:
    """A value outside is refused with the nearest one inside, which is accepted."""
    world = begin("fake", "pushing")
    world.do({"tool_block.mass": 0.045}, space="A")
    for name, value, space in (
        ("tool_block.mass", 0.045, "B"),
        ("tool_block.mass", 0.03, "B"),
        ("tool_block.mass", 0.05, "A"),
        ("tool_block.mass", 0.2, "A|B"),
        ("goal_block.cylindrical_position", [0.05, 0.0, 0.0325], "B"),
        ("goal_block.cylindrical_position", [0.05, 0.0, 0.2], "A"),
        ("block.size", [0.06, 0.06, 0.08], "B"),
    ):
        with pytest.raises(OutOfBounds) as caught:
            world.do({name: value}, space=space)
        assert caught.value.space == space
        world.do({name: caught.value.nearest}, space=space)
    for name in ("joint_velocities", "action"):
        value = np.zeros(9)
        with pytest.raises(OutOfBounds, match="none is declared"):
            world.do({name: value}, space="A")


# --- time ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("backend", "task"), PARAMS)
def test_a_parameter_holds_and_a_state_moves_on(backend: str, task: str) -> None:
    """Steps leave parameters where do has put them; physics takes over states."""
    world = begin(backend, task)
    world.do({"gravity": [0.0, 0.0, -5.0], "joint_velocities": np.full(9, 0.5)})
    play(world, actions(5))
    assert world["gravity"].tolist() == [0.0, 0.0, -5.0]
    assert world.graph["gravity"].kind == "fixed"
    if backend != "fake":
        assert not np.array_equal(world["joint_velocities"], np.full(9, 0.5))


def test_do_leaves_alone_what_physics_moved() -> None:
    """Making a block heavier in mid-air does not put it back where it began."""
    world = shared("mujoco", "pushing")
    world.reset(seed=0)
    world.do({"tool_block.cartesian_position": [0.0, 0.0, 0.2]})
    play(world, [REST])
    before = world["tool_block.cartesian_position"]
    world.do({"tool_block.mass": 0.09})
    np.testing.assert_array_equal(world["tool_block.cartesian_position"], before)


@pytest.mark.parametrize(("backend", "task"), PUSHING)
def test_a_teleport_is_no_reward(backend: str, task: str) -> None:
    """The step after a do is rewarded for what it moved, not for what do moved."""
    world = begin(backend, task)
    world.do({"tool_block.cartesian_position": Shift([0.0, 0.02, 0.1])})
    now = world.values()
    world.step(REST)
    after = world.values()
    goal = after["goal_block.cartesian_position"]
    nearer = [np.linalg.norm(v["tool_block.cartesian_position"] - goal) for v in (now, after)]
    assert after["reward.block_to_goal"] == pytest.approx(nearer[0] - nearer[1], abs=1e-12)
    assert abs(after["reward.block_to_goal"]) < 0.02


def test_the_clock_can_be_set() -> None:
    """The counter is a state: set once, it goes on from there, and time left follows."""
    world = begin("fake", "pushing")
    world.do({"control_index": 240})
    assert world.index == 240
    assert world["time_left_for_task"] == pytest.approx(10 * 0.04)
    play(world, actions(2))
    assert world["control_index"] == 242
    world.do({"control_index": 0})
    assert world["time_left_for_task"] == pytest.approx(10.0)


# --- actions -------------------------------------------------------------------------------------


def test_an_intervention_on_the_action_replaces_the_policy() -> None:
    """A held action is taken whatever the policy says, a draw anew at every step."""
    world = begin("fake", "reaching")
    audit = world.do({"action": np.full(9, 0.2)})
    assert audit.targets["action"].applied.tolist() == [0.2] * 9
    world.step(REST)
    assert world["action"].tolist() == [0.2] * 9
    assert world["joint_positions"].tolist() == [0.2] * 9
    world.do({"action": Shift(-0.1)})
    world.step(np.full(9, 0.5))
    np.testing.assert_allclose(world["action"], 0.4)
    world.do({"action": Draw(Box(-0.1, 0.1))})
    drawn = []
    for _ in range(3):
        world.step(REST)
        drawn.append(world["action"].tolist())
    assert np.abs(drawn).max() <= 0.1
    assert drawn[0] != drawn[1] != drawn[2]
    world.reset(seed=0)
    world.step(REST)
    np.testing.assert_array_equal(world["action"], REST)


def test_an_empty_do_does_nothing() -> None:
    """There is nothing to report and nothing has changed."""
    world = begin("fake", "pushing")
    values = world.values()
    audit = world.do({})
    assert (audit.targets, audit.followed, audit.engine) == ({}, {}, {})
    assert same(world.values(), values)


def test_worlds_of_other_sizes_are_other_worlds() -> None:
    """A task can be made with its own defaults."""
    from scm_world.tasks import make_task

    world = Simulation(make_task("pushing", tool_block_mass=0.05), backend="fake")
    world.reset(seed=0)
    assert world["tool_block.mass"] == 0.05
