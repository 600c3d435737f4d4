"""An error lists every problem of a request, whatever kinds of mistakes come together."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import pytest
from worlds import begin

from scm_world.errors import (
    ClosesCycle,
    ConflictingTargets,
    Infeasible,
    InterventionError,
    ModelError,
    NotIntervenable,
    OutOfBounds,
    SeveralProblems,
    UnknownVariable,
    WrongValue,
)
from scm_world.graph import SCM
from scm_world.variables import Derived, Draw, Exogenous, Linear, Mechanism, Null, Scale, Shift

NAN = float("nan")


def three(*parents: Any) -> list[float]:
    """Give three numbers."""
    return [0.1, 0.2, 0.3]


def first(parent: Any) -> float:
    """Give the first number."""
    return float(np.ravel(parent)[0])


def text(parent: Any) -> str:
    """Give no number."""
    return "red"


Mistake = tuple[dict[str, Any], type[InterventionError], str]

MISTAKES: dict[str, Mistake] = {
    "unknown": ({"tool_blok.mass": 1.0}, UnknownVariable, "tool_blok.mass"),
    "type": ({"gravity": "down"}, WrongValue, "gravity"),
    "shape": ({"block.size": 0.1}, WrongValue, "block.size"),
    "nan": ({"floor_friction": NAN}, WrongValue, "floor_friction"),
    "nan of a scale": ({"stage_friction": Scale(NAN)}, WrongValue, "stage_friction"),
    "bounds": ({"tool_block.mass": 50.0}, OutOfBounds, "tool_block.mass"),
    "bounds of a shift": ({"finger_friction": Shift(7.0)}, OutOfBounds, "finger_friction"),
    "bounds of a state": ({"joint_velocities": Shift(1e3)}, OutOfBounds, "joint_velocities"),
    "readout": ({"success": 1}, NotIntervenable, "success"),
    "constant": ({"tool_block.type": 2}, NotIntervenable, "tool_block.type"),
    "no space": (
        {"camera_60.orientation": Draw("A")},
        InterventionError,
        "camera_60.orientation",
    ),
    "coordinates": (
        {"goal_block": {"orientation": [0, 0, 0, 1], "euler_orientation": [0, 0, 1]}},
        ConflictingTargets,
        "goal_block.orientation",
    ),
    "twice": (
        {"tool_block": {"color": [0.1] * 3}, "tool_block.color": [0.2] * 3},
        ConflictingTargets,
        "tool_block.color",
    ),
    "nothing to remove": ({"tool_blck": Null()}, UnknownVariable, "tool_blck"),
    "removed variable": ({"spinning_friction": Null()}, InterventionError, "spinning_friction"),
    "removed robot": ({"robot": Null()}, InterventionError, "robot"),
    "moving": (
        {"light_ambient": Mechanism(first, ["joint_positions"])},
        InterventionError,
        "light_ambient",
    ),
    "function of wrong shape": (
        {"robot_height": Mechanism(three, ["robot_finger_60_link_1.mass"])},
        WrongValue,
        "robot_height",
    ),
    "function of one number": (
        {"goal_block.color": Mechanism(first, ["stage_friction"])},
        WrongValue,
        "goal_block.color",
    ),
    "function of a text": (
        {"floor_color": Mechanism(text, ["stage_friction"])},
        WrongValue,
        "floor_color",
    ),
    "state of wrong shape": (
        {"tool_block.angular_velocity": Mechanism(first, ["robot_finger_60_link_1.mass"])},
        WrongValue,
        "tool_block.angular_velocity",
    ),
    "cycle": (
        {
            "robot_finger_60_link_2.mass": Mechanism(first, ["robot_finger_60_link_3.mass"]),
            "robot_finger_60_link_3.mass": Mechanism(first, ["robot_finger_60_link_2.mass"]),
        },
        ClosesCycle,
        "robot_finger_60_link_2.mass",
    ),
    "space": ({"restitution": 0.79}, OutOfBounds, "restitution"),
}


def problems_of(error: InterventionError) -> tuple[InterventionError, ...]:
    """List the problems of an error."""
    return error.problems if isinstance(error, SeveralProblems) else (error,)


def joined(*requests: dict[str, Any]) -> dict[str, Any]:
    """Put requests together; what is nested in both stays."""
    found: dict[str, Any] = {}
    for request in requests:
        for name, value in request.items():
            both = isinstance(value, dict) and isinstance(found.get(name), dict)
            found[name] = {**found[name], **value} if both else value
    return found


@pytest.mark.parametrize(
    ("one", "other"), [(n, n) for n in MISTAKES] + list(combinations(MISTAKES, 2))
)
def test_each_pair_of_mistakes_names_both(one: str, other: str) -> None:
    """Whatever two kinds of mistakes come together, in either order: each is listed once."""
    world = begin("fake", "pushing")
    # What lies out of space A is a mistake by what is asked, so the others are held against it too.
    space = "A" if "space" in (one, other) else None
    for kinds in {(one, other), (other, one)}:
        with pytest.raises(InterventionError) as caught:
            world.do(joined(*(MISTAKES[kind][0] for kind in kinds)), space=space)
        found = [(type(problem), problem.variable) for problem in problems_of(caught.value)]
        assert len(found) == len(set(found))
        for kind in kinds:
            _, error, name = MISTAKES[kind]
            assert any(issubclass(e, error) and n.startswith(name) for e, n in found), (kind, found)


@pytest.mark.parametrize("kind", MISTAKES)
def test_bodies_are_compared_only_where_every_value_is_known(kind: str) -> None:
    """Where bodies would be is not known before each value is: the mistake alone is named."""
    world = begin("fake", "pushing")
    below = {"tool_block": {"cartesian_position": [0.0, 0.0, 0.01]}}
    with pytest.raises(Infeasible):
        world.do(below)
    request, error, name = MISTAKES[kind]
    with pytest.raises(InterventionError) as caught:
        world.do(joined(request, below), space="A" if kind == "space" else None)
    found = problems_of(caught.value)
    assert any(isinstance(p, error) and p.variable.startswith(name) for p in found)
    assert not any(isinstance(p, Infeasible) for p in found)


def test_a_reset_lists_every_problem_of_its_intervention() -> None:
    """What ``do`` lists, ``reset`` lists."""
    world = begin("fake", "pushing")
    request = joined(*(wrong for kind, (wrong, *_) in MISTAKES.items() if kind != "space"))
    with pytest.raises(SeveralProblems) as done:
        world.do(request)
    with pytest.raises(SeveralProblems) as reset:
        world.reset(seed=0, do=request)
    assert list(map(str, reset.value.problems)) == list(map(str, done.value.problems))
    assert {p.variable for p in done.value.problems} >= {
        name for kind, (_, _, name) in MISTAKES.items() if kind != "space"
    }


MODEL = SCM(
    [
        *(Exogenous(name=f"{name}.{part}", unit="1") for name in "abc" for part in ("x", "y")),
        Derived(name="total", unit="1", parents=("a.x",), mechanism=Linear(weights=(1.0,))),
    ]
)
IN_MODEL: dict[str, Mistake] = {
    "unknown": ({"a.z": 1.0}, UnknownVariable, "a.z"),
    "type": ({"a.x": "one"}, WrongValue, "a.x"),
    "nan": ({"a.y": NAN}, WrongValue, "a.y"),
    "twice": ({"b": {"x": 1.0}, "b.x": 2.0}, ConflictingTargets, "b.x"),
    "removed variable": ({"b.y": Null()}, InterventionError, "b.y"),
    "cycle": (
        {"c.x": Mechanism(first, ["c.y"]), "c.y": Mechanism(first, ["c.x"])},
        ClosesCycle,
        "c.x",
    ),
}


@pytest.mark.parametrize(("one", "other"), [*combinations(IN_MODEL, 2)])
def test_each_pair_of_mistakes_in_a_model_names_both(one: str, other: str) -> None:
    """A model without a world lists as much."""
    for kinds in ((one, other), (other, one)):
        with pytest.raises(SeveralProblems) as caught:
            MODEL.do(joined(*(IN_MODEL[kind][0] for kind in kinds)))
        for kind in kinds:
            _, error, name = IN_MODEL[kind]
            assert any(isinstance(p, error) and p.variable == name for p in caught.value.problems)


def test_a_cycle_is_a_refused_intervention_and_a_wrong_model() -> None:
    """The error has the cycle, and can be caught as either."""
    with pytest.raises(ClosesCycle, match=r"c\.\w → c\.\w → c\.\w$") as caught:
        MODEL.do(IN_MODEL["cycle"][0])
    assert isinstance(caught.value, ModelError)
    assert set(caught.value.cycle) == {"c.x", "c.y"}


def test_what_decides_which_bodies_there_are_follows_nothing_else() -> None:
    """A mechanism on the number of obstacles that follows a friction is refused by name."""
    world = begin("fake", "reaching")
    with pytest.raises(SeveralProblems) as caught:
        world.do(
            {
                "number_of_obstacles": Mechanism(first, ["floor_friction"]),
                "tool_blck": Null(),
                "joint_velocities": Shift(1e3),
            }
        )
    found = {problem.variable for problem in caught.value.problems}
    assert found == {"number_of_obstacles", "tool_blck", "joint_velocities"}
