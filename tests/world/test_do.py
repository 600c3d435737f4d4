"""Facts about do: one transaction, wholly or not at all, at one instant."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from worlds import (
    PARAMS,
    PUSHING,
    actions,
    begin,
    other,
    play,
    same,
    settable,
    shared,
)

from scm_world.errors import (
    ConflictingTargets,
    Infeasible,
    InterventionError,
    NotIntervenable,
    OutOfBounds,
    SeveralProblems,
    UnknownVariable,
    WrongValue,
)
from scm_world.models import Difference
from scm_world.variables import Draw, Normal, Null, Scale, Shift
from scm_world.world.interventions import feasible
from scm_world.world.snapshot import Base

NAN = float("nan")
HUGE = 1e308

REFUSED: list[tuple[dict[Any, Any], type[Exception]]] = [
    ({"gravty": [0.0, 0.0, -9.0]}, UnknownVariable),
    ({5: 1.0}, UnknownVariable),
    ({"gravity": {"z": -9.0}}, UnknownVariable),
    ({"gravity": "down"}, WrongValue),
    ({"control_index": 0.5}, WrongValue),
    ({"gravity": -9.81}, WrongValue),
    ({"joint_positions": [0.0] * 8}, WrongValue),
    ({"gravity": [0.0, 0.0, NAN]}, WrongValue),
    ({"floor_friction": Scale(NAN)}, WrongValue),
    ({"joint_velocities": Scale(HUGE), "joint_positions": Shift(0.05)}, InterventionError),
    ({"floor_friction": -0.1}, OutOfBounds),
    ({"floor_friction": Shift(5.0)}, OutOfBounds),
    ({"floor_friction": Draw(Normal(50.0, 0.1))}, OutOfBounds),
    ({"joint_positions": Shift(9.0)}, OutOfBounds),
    ({"end_effector_positions": [0.0] * 9}, NotIntervenable),
    ({"reward": 1.0}, NotIntervenable),
    ({"joint_torques": [0.0] * 9}, NotIntervenable),
    ({"end_effector_positions": Draw("A")}, NotIntervenable),
    ({"joint_velocities": Draw("A")}, InterventionError),
    ({"floor_friction": 0.4, "stage": {"friction": 1}, "gravity": 1.0}, SeveralProblems),
    ({"joint_positions": np.tile([0.0, 0.0, 0.0], 3), "robot_height": 0.2}, Infeasible),
]
REFUSED_BY_PUSHING: list[tuple[dict[str, Any], type[Exception]]] = [
    ({"tool_block.type": 2}, NotIntervenable),
    ({"tool_block.orientation": [0.0, 0.0, 1.0, 1.0]}, OutOfBounds),
    (
        {"tool_block": {"cartesian_position": [0, 0, 0.1], "cylindrical_position": [0, 0, 0.1]}},
        ConflictingTargets,
    ),
    ({"tool_block": {"mass": 0.1}, "tool_block.mass": 0.1}, ConflictingTargets),
    ({"tool_block.cylindrical_position": [HUGE, 1.0, 0.1]}, OutOfBounds),
    ({"tool_block.euler_orientation": [HUGE, HUGE, 0.0]}, WrongValue),
    ({"tool_block.cartesian_position": [0.0, 0.0, 0.01]}, Infeasible),
    ({"tool_block.cartesian_position": [0.23, 0.0, 0.1]}, Infeasible),
    ({"tool_block.size": Shift(0.2)}, OutOfBounds),
    ({"floor_friction": 0.3, "tool_block": {"mass": 0.1, "size": [9.0] * 3}}, OutOfBounds),
]


@pytest.mark.parametrize(("backend", "task"), PARAMS)
def test_a_refused_do_changes_nothing(backend: str, task: str) -> None:
    """After each kind of error all values and the future are bit-identical."""
    world = begin(backend, task)
    world.do({"gravity": [0.1, 0.0, -9.0], "joint_velocities": Shift(0.1)})
    start, values, before = world.snapshot(), world.values(), world.previous()
    graph = world.graph
    future = play(world, actions(50, seed=3))
    cases = REFUSED + (REFUSED_BY_PUSHING if task == "pushing" else [])
    for request, error in cases:
        world.restore(start)
        with pytest.raises(error):
            world.do(request)
        assert same(world.values(), values), request
        assert same(world.previous(), before), request
        assert world.graph == graph, request
        assert world.index == 3
        np.testing.assert_array_equal(play(world, actions(4, seed=3)), future[:4])
    world.restore(start)
    for request, error in cases:
        with pytest.raises(error):
            world.do(request)
    np.testing.assert_array_equal(play(world, actions(50, seed=3)), future)


def test_all_problems_come_together() -> None:
    """Names, types, shapes, bounds: one error lists them all."""
    with pytest.raises(SeveralProblems) as caught:
        begin("fake", "pushing").do(
            {
                "tool_blok.mass": 1.0,
                "gravity": "down",
                "block.size": 0.1,
                "floor_friction": NAN,
                "tool_block.mass": 50.0,
                "stage_friction": Shift(7.0),
                "joint_velocities": Shift(1e3),
                "success": 1,
            }
        )
    kinds = {type(problem) for problem in caught.value.problems}
    assert len(caught.value.problems) == 8
    assert kinds == {
        UnknownVariable,
        WrongValue,
        WrongValue,
        WrongValue,
        OutOfBounds,
        NotIntervenable,
    }


def test_a_value_that_is_too_much_names_the_nearest_that_is_not() -> None:
    """What an error offers is accepted."""
    world = begin("fake", "pushing")
    for request in (
        {"tool_block.mass": 7.0},
        {"gravity": [50.0, 0.0, 0.0]},
        {"tool_block.orientation": [0.0, 0.0, 3.0, 4.0]},
        {"tool_block.cartesian_position": [0.0, 0.01, 0.0]},
        {"tool_block.cartesian_position": [0.0, 0.23, 0.06]},
    ):
        with pytest.raises((OutOfBounds, Infeasible)) as caught:
            world.do(request)
        world.do({caught.value.variable: caught.value.nearest})


def test_the_error_names_the_target_that_is_in_the_way() -> None:
    """Of several targets, the one that moved a body into another is blamed."""
    world = begin("fake", "pushing")
    with pytest.raises(Infeasible) as caught:
        world.do(
            {
                "floor_friction": 0.4,
                "gravity": [0, 0, -9],
                "tool_block.cartesian_position": [0, 0, 0.01],
            }
        )
    assert caught.value.variable == "tool_block.cartesian_position"
    assert caught.value.value == [0, 0, 0.01]
    assert "'tool_block' lies" in caught.value.problems[0]


# --- what a do reports ---------------------------------------------------------------------------


@pytest.mark.parametrize(("backend", "task"), PARAMS)
def test_every_settable_variable_is_applied_and_read_back(backend: str, task: str) -> None:
    """The model, the engine and the audit agree on every variable."""
    for name in settable(shared(backend, task)):
        world = begin(backend, task)
        wanted = other(world, name)
        audit = world.do({name: wanted})
        entry = audit.targets[name]
        np.testing.assert_allclose(entry.applied, wanted, atol=1e-12)
        np.testing.assert_allclose(world[name], wanted, atol=1e-12)
        np.testing.assert_array_equal(entry.requested, wanted)
        target = world.model.target(name)
        known = target in world.compiled.parameter_keys or target in world.compiled.slices
        assert (entry.read_back is not None) == (known or name == "control_index")
        if entry.read_back is not None:
            np.testing.assert_allclose(entry.read_back, wanted, atol=1e-6)
        assert name in str(audit)


@pytest.mark.parametrize(("backend", "task"), PUSHING)
def test_an_audit_says_what_followed(backend: str, task: str) -> None:
    """Sizes, heights and inertia follow the shared size; masses move the inertia only."""
    world = begin(backend, task)
    before = world.values()
    audit = world.do({"block.size": [0.08, 0.07, 0.09]})
    assert audit.followed.keys() == {
        "tool_block.size",
        "goal_block.size",
        "goal_block.cartesian_position",
        "tool_block.cartesian_position",
    }
    for name, (old, new) in audit.followed.items():
        np.testing.assert_array_equal(old, before[name])
        np.testing.assert_array_equal(new, world[name])
    assert audit.targets["block.size"].read_back is None  # the engine knows the blocks only
    mass, squares = 0.02, np.array([0.08, 0.07, 0.09]) ** 2
    expected = np.sort(mass / 12.0 * (squares.sum() - squares))
    np.testing.assert_allclose(np.sort(audit.engine["tool_block.inertia"][1]), expected, rtol=1e-6)
    audit = world.do({"tool_block.mass": 0.04})
    assert not audit.followed
    old, new = audit.engine["tool_block.inertia"]
    np.testing.assert_allclose(new, 2.0 * old, rtol=1e-6)
    assert "tool_block.inertia" in str(audit)


def test_an_audit_in_other_coordinates_speaks_them() -> None:
    """Cylindrical in, cylindrical out; the Cartesian position is what followed."""
    world = begin("fake", "pushing")
    audit = world.do({"tool_block.cylindrical_position": [0.02, 1.0, 0.1]})
    entry = audit.targets["tool_block.cylindrical_position"]
    np.testing.assert_allclose(entry.applied, [0.02, 1.0, 0.1])
    np.testing.assert_allclose(entry.read_back, [0.02, 1.0, 0.1])
    assert audit.followed.keys() == {"tool_block.cartesian_position"}


@pytest.mark.parametrize(("backend", "task"), PARAMS)
def test_an_engine_is_told_the_difference_of_the_scenes(backend: str, task: str) -> None:
    """What a do gives to the engine is the difference of the scenes before and after it."""
    for name in settable(shared(backend, task)):
        world = begin(backend, task)
        request = {name: other(world, name)}
        key = world.noise_key(world.index)
        base = Base(world.graph, world.row.copy(), world.structure)
        done = feasible(world.structures, base, base, request, None, key)
        then = done.compiled.scene(done.row)
        now = world.scene()
        if now.structure != then.structure:
            expected = dict(then.parameters)
        else:
            pairs = then.parameters.items()
            expected = {k: v for k, v in pairs if not np.array_equal(v, now.parameters[k])}
        told = done.change or Difference()
        assert told.parameters.keys() == expected.keys()
        assert all(np.array_equal(told.parameters[k], v) for k, v in expected.items())
        stays = now.structure == then.structure and np.array_equal(
            now.state.settable(), then.state.settable()
        )
        assert told.state == (None if stays else then.state)


def test_names_near_an_unknown_one_are_told() -> None:
    """Of an entity or a quantity alone: what can be set that has it as a part."""
    world = begin("fake", "pushing")
    with pytest.raises(UnknownVariable, match=r"near it are: .*tool_block\.mass") as caught:
        world.do({"tool_block": 0.03})
    assert "tool_block.type" not in caught.value.near  # a constant
    with pytest.raises(UnknownVariable, match=r"near it are: tool_block\.mass, .* more"):
        world.do({"mass": 0.03})


@pytest.mark.parametrize("name", ["floor_friction", "tool_block.mass"])
def test_a_variable_cannot_be_removed(name: str) -> None:
    """The error says that it is one, and that bodies can be."""
    said = "a variable cannot be taken away; a body of a world can"
    with pytest.raises(InterventionError, match=said):
        begin("fake", "pushing").do({name: Null()})


@pytest.mark.parametrize("request_", [{"no_such": {}}, {"tool_block": {}}])
def test_empty_requests_within_requests_are_refused(request_: dict[str, Any]) -> None:
    """An empty dictionary under a name sets nothing, whatever the name."""
    with pytest.raises(InterventionError, match="an empty dictionary sets nothing"):
        begin("fake", "pushing").do(request_)
