"""Bundles: variables that are put together from others, and what it means to intervene on them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scm_world.errors import ConflictingTargets, InterventionError, ModelError, OutOfBounds
from scm_world.graph import SCM, from_json, to_json
from scm_world.variables import (
    Action,
    Box,
    Derived,
    Draw,
    Exogenous,
    Linear,
    Measured,
    Mechanism,
    Natural,
    Parent,
    Scale,
    Shift,
    bundle,
)

LEFT = Exogenous(name="left", unit="kg", shape=(2,), default=(1.0, 2.0), bounds=Box(0.0, 9.0))
RIGHT = Exogenous(name="right", unit="kg", default=3.0, bounds=Box(0.0, 5.0))


def both(**fields: Any) -> Derived:
    """Put the two together."""
    made = bundle("both", [LEFT, RIGHT], **fields)
    assert isinstance(made, Derived)
    return made


def model(**fields: Any) -> SCM:
    """Give a model with a bundle, and an effect of it."""
    last = Derived(name="sum", parents=("right",), mechanism=Linear(weights=(2.0,)))
    return SCM([LEFT, RIGHT, both(**fields), last])


def test_a_bundle_is_computed_from_its_parts() -> None:
    """Its numbers are theirs, one after another, also for many episodes at once."""
    assert model().solve()["both"].tolist() == [1.0, 2.0, 3.0]
    drawn = model().do({"left": Draw(Box(0.0, 1.0))}).draw(4, seed=0)
    np.testing.assert_array_equal(drawn["both"][:, :2], drawn["left"])
    np.testing.assert_array_equal(drawn["both"][:, 2], 3.0)


def test_its_fields_follow_from_the_parts() -> None:
    """Unit and bounds are what the parts have; roles that differ cannot be put together."""
    assert both().unit == "kg"
    assert both().bounds == Box((0.0, 0.0, 0.0), (9.0, 9.0, 5.0))
    with pytest.raises(ValueError, match="one role"):
        bundle("mixed", [LEFT, Action(name="push")])


def test_to_set_a_bundle_is_to_set_its_parts() -> None:
    """A value, a shift and a scale are divided among the parts, and their effects follow."""
    solved = model().do({"both": [4.0, 5.0, 1.5]}).solve()
    assert (solved["left"].tolist(), float(solved["sum"])) == ([4.0, 5.0], 3.0)
    assert model().do({"both": Shift(1.0)}).solve()["both"].tolist() == [2.0, 3.0, 4.0]
    assert model().do({"both": Scale([1, 1, 2])}).solve()["both"].tolist() == [1.0, 2.0, 6.0]
    assert model().do({"both": [1.0, 2.0, 3.0]}).interventions.keys() == {"left", "right"}


def test_a_draw_is_one_of_the_whole_bundle() -> None:
    """It has the numbers that a variable of the bundle's name and shape would have had."""
    vector = Exogenous(name="both", shape=(3,), default=(0.0,) * 3, a=Box(0.0, 1.0))
    for act in (Draw("A"), Draw(Box(1.0, 2.0)), Draw("A", stream="mine")):
        finer = model(a=Box(0.0, 1.0)).do({"both": act}).draw(5, seed=7)
        whole = SCM([vector]).do({"both": act}).draw(5, seed=7)
        np.testing.assert_array_equal(finer["both"], whole["both"])


def test_a_mechanism_gives_the_whole_bundle() -> None:
    """The function is called as if the bundle were one variable; each part gets its numbers."""
    roots = [Exogenous(name="root", default=2.0)]
    held = SCM([*roots, *model().variables]).do(
        {"both": Mechanism(lambda root: root * np.arange(3.0), ["root"])}
    )
    assert held.solve()["left"].tolist() == [0.0, 2.0]
    assert "right" in held.children("root")
    with pytest.raises(InterventionError, match="cannot follow itself"):
        model().do({"both": Mechanism(lambda left: left, ["left"])})


def test_parts_can_be_set_after_the_bundle() -> None:
    """A later intervention on a part, or its release, leaves the other parts as they are held."""
    held = model(a=Box(0.0, 1.0)).do({"both": Draw("A")})
    drawn = held.draw(3, seed=1)["both"]
    again = held.do({"right": 4.0}).draw(3, seed=1)["both"]
    np.testing.assert_array_equal(again[:, :2], drawn[:, :2])
    np.testing.assert_array_equal(again[:, 2], 4.0)
    assert held.do({"left": Natural()}).interventions.keys() == {"right"}
    assert not held.do({"both": Natural()}).interventions


def test_a_bundle_and_a_part_of_it_exclude_each_other() -> None:
    """Within one do they would say two things of one quantity."""
    with pytest.raises(ConflictingTargets) as caught:
        model().do({"right": 1.0, "both": [1.0, 1.0, 1.0]})
    assert caught.value.names == ("right", "both")


def test_what_is_wrong_with_a_bundle_is_said_of_it() -> None:
    """Shape and bounds are those of the bundle."""
    with pytest.raises(OutOfBounds) as caught:
        model().do({"both": [1.0, 1.0, 7.0]})
    assert caught.value.variable == "both"
    assert caught.value.nearest == [1.0, 1.0, 5.0]
    with pytest.raises(InterventionError, match=r"expected shape \(3,\)"):
        model().do({"both": [1.0, 2.0]})


def test_a_draw_of_a_bundle_belongs_to_its_parts_only() -> None:
    """Another variable has no part in it."""
    with pytest.raises(InterventionError, match="not a part of the bundle"):
        model().do({"sum": Draw(Box(0.0, 1.0), of="both")})


def test_what_a_bundle_was_given_survives_json() -> None:
    """A model with a bundle, and one that is drawn, are the same after they were written."""
    held = model(a=Box(0.0, 1.0)).do({"both": Draw("A")})
    read = from_json(to_json(held))
    assert read == held
    np.testing.assert_array_equal(read.draw(2, seed=0)["both"], held.draw(2, seed=0)["both"])


def test_what_is_no_bundle_is_written_as_before() -> None:
    """The field that only parts of bundles have appears in no other file."""
    assert "of" not in Draw("A").model_dump()
    assert "of" not in Mechanism(np.mean, ["left"]).model_dump()
    assert Draw("A").divided(LEFT) == {"left": Draw("A")}


def test_bundles_are_checked_when_they_are_declared() -> None:
    """Numbers of parts and shapes fit, and parts are quantities of the present."""
    good = both().model_dump()
    for wrong in (
        {"shape": (4,)},
        {"parents": ("left",)},
        {"parents": ("left", Parent("right", 1))},
    ):
        with pytest.raises(ValueError, match="bundle"):
            Derived(**{**good, **wrong})
    with pytest.raises(ModelError, match="has 'right' as"):
        SCM([LEFT, RIGHT.model_copy(update={"shape": (1,), "default": (3.0,)}), both()])
    with pytest.raises(ModelError, match="not a quantity of its own"):
        SCM([LEFT, RIGHT, both(), bundle("all", [both(), LEFT])])


def test_bundles_of_states_are_states() -> None:
    """They can be set if their parts can; a bundle of readouts, or of actions, is a readout."""
    state = Measured(name="x", settable_state=True, default=0.0)
    readout = Measured(name="y", parents=("x",))
    assert bundle("states", [state]).role == "state"
    assert bundle("readouts", [readout]).role == "readout"
    assert bundle("action", [Action(name="push")]).role == "readout"
    assert not bundle("readouts", [readout]).settable
