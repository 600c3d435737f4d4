"""Facts about laboratories: permissions and budgets."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scm_world.errors import (
    Forbidden,
    InterventionError,
    UnknownOption,
)
from scm_world.queries import SCM, Laboratory, Outcome, World
from scm_world.variables import Derived, Exogenous, Hard, Linear, Mechanism, Normal, Reaches

OUTCOMES = ("tool_block.mass", "floor_friction", Outcome("reward", "sum"))


def lab(**options: Any) -> Laboratory:
    """Open a small laboratory on an engine without physics."""
    given: dict[str, Any] = {"outcomes": OUTCOMES, "steps": 3, "nature": {"tool_block.mass": "A"}}
    return Laboratory(World("pushing", backend="fake"), **{**given, **options})


def test_experiments_are_of_new_units() -> None:
    """Each episode is another one, and all are in the books."""
    mine = lab(budget=10)
    seen, done = mine.see(3), mine.do({"floor_friction": 0.3}, n=4)
    assert (seen.numbers, done.numbers) == ((0, 1, 2), (3, 4, 5, 6))
    assert (mine.spent, mine.remaining) == (7, 3)
    assert done["floor_friction"].tolist() == [0.3] * 4


def test_the_budget_is_never_exceeded() -> None:
    """What costs more than is left is refused before it begins."""
    mine = lab(budget=5)
    mine.see(3)
    with pytest.raises(Forbidden, match="run 3 more episodes; allowed: 2 episodes"):
        mine.do({"floor_friction": 0.3}, n=3)
    assert mine.spent == 3
    mine.counterfactual(1, {"floor_friction": 0.3})
    mine.do({"floor_friction": 0.3})
    with pytest.raises(Forbidden):
        mine.counterfactual(1, {})


@pytest.mark.parametrize(
    "request_",
    [
        {"gravity": [0.0, 0.0, -5.0]},
        {"floor_friction": Mechanism(np.sum, "gravity")},
        {"floor_friction": Hard(0.2, when=Reaches("joint_positions", above=1.0))},
    ],
    ids=repr,
)
def test_what_is_not_allowed_is_refused(request_: dict[str, Any]) -> None:
    """Setting, following and waiting need permission; a refusal costs nothing."""
    mine = lab(settable=["*friction"], visible=["tool_block.*", "floor_friction", "reward"])
    with pytest.raises(Forbidden, match="does not let you"):
        mine.do(request_)
    assert mine.spent == 0
    mine.do({"floor_friction": Hard(0.2, during=(1, 2))})


def test_questions_need_permission_too() -> None:
    """As does seeing; the graph is not there at all."""
    mine = lab(allow=["see"])
    for ask in (lambda: mine.do({"floor_friction": 0.3}), lambda: mine.counterfactual(0, {})):
        with pytest.raises(Forbidden):
            ask()
    with pytest.raises(Forbidden, match="see reward"):
        lab(visible=["tool_block.*"], outcomes=["reward"])
    with pytest.raises(UnknownOption, match="question"):
        lab(allow=["look"])
    with pytest.raises(UnknownOption, match="visible"):
        lab(visible=["nobody.*"])
    assert not [name for name in dir(mine) if "graph" in name or "model" in name]


def test_units_that_were_seen_can_be_imagined_otherwise() -> None:
    """The same unit, exactly, under another intervention; strangers cannot be."""
    mine = lab()
    done = mine.do({"floor_friction": 0.3}, n=2)
    same = mine.counterfactual(1, {})
    assert all(same[name] == done[name][1] for name in done)
    assert mine.counterfactual(1, {"floor_friction": 0.4})["floor_friction"] == 0.4
    with pytest.raises(Forbidden, match="never seen"):
        mine.counterfactual(2, {})


def test_a_refused_intervention_costs_nothing() -> None:
    """The books are as they were."""
    mine = lab(budget=3)
    with pytest.raises(InterventionError):
        mine.do({"floor_friction": -1.0}, n=2)
    assert mine.spent == 0


def test_what_cannot_be_is_seen_beforehand() -> None:
    """A time after the end, and arguments of another kind, cost nothing."""
    mine = lab(budget=5)
    mine.see(2)
    for ask in (
        lambda: mine.do({"floor_friction": Hard(0.3, at=3)}),
        lambda: mine.counterfactual(1, {}, at=3),
        lambda: mine.counterfactual([1], {}),  # type: ignore[arg-type] # that is the point
    ):
        with pytest.raises(UnknownOption):
            ask()
    assert mine.spent == 2
    for options in ({"visible": 3}, {"allow": 3}, {"step": 3}, {"outcomes": [np.sum]}):
        with pytest.raises(UnknownOption):
            lab(**options)


def test_equations_have_laboratories_too() -> None:
    """A model without time has units, permissions and counterfactuals like a world."""
    cause = Exogenous(name="x", distribution=Normal())
    effect = Derived(name="y", parents=("x",), mechanism=Linear(weights=(2.0,)))
    mine = Laboratory(SCM([cause, effect]), settable=["x"], budget=4)
    assert mine.do({"x": 3.0}, n=2)["y"].tolist() == [6.0, 6.0]
    assert mine.counterfactual(1, {"x": 1.0})["y"] == 2.0
    assert mine.remaining == 1
