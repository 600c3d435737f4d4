"""Facts about structural causal models: built and mutilated."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from graph_models import small
from hypothesis import given, settings
from hypothesis import strategies as st

from scm_world.errors import (
    ConflictingTargets,
    InterventionError,
    ModelError,
    NotIntervenable,
    OutOfBounds,
    SeveralProblems,
    UnknownVariable,
    WrongValue,
)
from scm_world.graph import SCM, Edge, NoiseKey, flatten
from scm_world.variables import (
    Affine,
    Box,
    Derived,
    Draw,
    Exogenous,
    Fixed,
    Hard,
    Linear,
    Noise,
    Normal,
    Parent,
    Scale,
    Shift,
)

# --- building ------------------------------------------------------------------------------------


def test_all_faults_of_a_model_are_reported_together() -> None:
    """Duplicates, unknown parents and every cycle come in one error, with the nearest names."""
    copy = Linear(weights=(1.0,))
    with pytest.raises(ModelError) as caught:
        SCM(
            [
                Exogenous(name="mass"),
                Exogenous(name="mass"),
                Derived(name="weight", parents=("maas",), mechanism=copy),
                Derived(name="p", parents=("q",), mechanism=copy),
                Derived(name="q", parents=("p",), mechanism=copy),
                Derived(name="self", parents=("self",), mechanism=copy),
                Derived(name="dup", parents=("p", "p"), mechanism=Linear(weights=(1.0, 2.0))),
                Exogenous(name="place", a=Box(0.0, Affine(parent="siez"))),
                Derived(
                    name="noisy",
                    parents=("mass",),
                    mechanism=copy,
                    noise=Box(0.0, Affine(parent="mass")),
                ),
            ]
        )
    text = "\n".join(caught.value.problems)
    assert len(caught.value.problems) == 7
    for fault in (
        "'mass' is declared twice",
        "unknown parent 'maas'; did you mean 'mass'?",
        "p → q → p",
        "self → self",
        "names the parent 'p' twice with lag 0",
        "space A of 'place' depends on the unknown variable 'siez'",
        "the noise of 'noisy' depends on a variable",
    ):
        assert fault in text or fault.replace("p → q → p", "q → p → q") in text


def test_a_cycle_through_time_is_no_cycle() -> None:
    """Lagged edges may lead back."""
    copy = Linear(weights=(0.5,))
    model = SCM(
        [
            Derived(name="x", parents=(Parent("y", 1),), mechanism=copy),
            Derived(name="y", parents=("x",), mechanism=copy),
        ]
    )
    assert model.descendants("x") == {"x", "y"}


def test_the_structure_can_be_asked_for() -> None:
    """Parents, children, ancestors and descendants are those of the declarations."""
    model = small()
    assert model.parents("drag") == ("weight", "friction")
    assert model.children("friction") == ("drag", "friction_plus")
    assert model.ancestors("readout") == {"drag", "weight", "friction", "block.mass"}
    assert model.descendants("block.mass") == {"weight", "drag", "readout"}
    assert Edge("block.mass", "weight") in model.edges
    with pytest.raises(UnknownVariable, match="did you mean 'friction'"):
        model.parents("fricton")


def test_a_model_behaves_like_a_mapping_of_names() -> None:
    """Length, membership, iteration, items and the text."""
    model = small()
    assert len(model) == 8
    assert "drag" in model
    assert "nothing" not in model
    assert next(iter(model)) == "block.mass"
    assert model["drag"] == model.declared("drag")
    assert repr(model.do({"friction": 0.1})) == "SCM(8 variables, do(friction))"
    assert model != "a model"


# --- do ------------------------------------------------------------------------------------------


def test_do_is_pure() -> None:
    """The first model is as it was, edges, values and all."""
    model = small()
    before, values = model.edges, model.solve()
    other = model.do({"weight": 3.0})
    assert other is not model
    assert model == small()
    assert model.edges == before
    assert model.solve() == values
    assert other != model


def test_a_hard_intervention_cuts_the_edges_into_its_target() -> None:
    """The node becomes a constant; its effects stay, its causes are gone."""
    model = small().do({"weight": 3.0})
    assert model.parents("weight") == ()
    assert model.children("weight") == ("drag",)
    weight = model["weight"]
    assert isinstance(weight, Fixed)
    assert (weight.value, weight.unit) == (3.0, "N")
    assert model.do({"block.mass": 1.0}).solve()["drag"] == 3.0 + 2.0 * 0.5


def test_a_draw_cuts_the_edges_into_its_target() -> None:
    """The node becomes a root with a distribution."""
    model = small().do({"weight": Draw(Normal(1.0, 0.1))})
    assert model.parents("weight") == ()
    assert isinstance(model["weight"], Exogenous)
    values = model.draw(4_000, seed=0)
    assert values["weight"].mean() == pytest.approx(1.0, abs=0.01)
    assert abs(np.corrcoef(values["weight"], values["block.mass"])[0, 1]) < 0.05


@pytest.mark.parametrize(("act", "expected"), [(Shift(1.0), 1.2), (Scale(3.0), 0.6)], ids=repr)
def test_shift_and_scale_keep_the_edges(act: Any, expected: float) -> None:
    """The parents go on mattering."""
    model = small().do({"weight": act})
    assert model.parents("weight") == ("block.mass",)
    assert model.solve()["weight"] == pytest.approx(expected)
    heavier = model.do({"block.mass": 0.04}).solve()["weight"]
    assert heavier == pytest.approx(expected + (0.2 if isinstance(act, Shift) else 0.6))


def test_a_draw_from_a_space_that_follows_a_variable_adds_the_edge() -> None:
    """What bounds the draw is a parent of what is drawn, and is computed first."""
    model = small().do({"weight": Draw("A")})
    assert model.parents("weight") == ("friction",)
    values = model.draw(500, seed=1)
    assert (values["weight"] <= values["friction"]).all()
    fixed = model.do({"friction": 0.001}).draw(100, seed=1)
    assert (fixed["weight"] <= 0.001).all()


def test_a_draw_that_would_depend_on_itself_is_refused_at_once() -> None:
    """Bounds that follow an effect of the target close a cycle."""
    with pytest.raises(ModelError, match="cycle"):
        small().do({"block.mass": Draw(Box(0.0, Affine(parent="weight")))})
    with pytest.raises(UnknownVariable):
        small().do({"block.mass": Draw(Box(0.0, Affine(parent="wieght")))})


def test_coordinates_set_the_quantity_itself() -> None:
    """An intervention on coordinates is one on their parent, through the inverse."""
    model = small().do({"friction_plus": 1.3})
    assert model.target("friction_plus") == "friction"
    assert model.interventions == {"friction_plus": Hard(1.3)}
    values = model.solve()
    assert values["friction"] == pytest.approx(0.3)
    assert values["friction_plus"] == pytest.approx(1.3)
    assert model.parents("friction_plus") == ("friction",)
    assert isinstance(model["friction"], Fixed)


@pytest.mark.parametrize(
    ("act", "expected"), [(Shift(0.1), 0.6), (Scale(2.0), 2.0), (Draw("A"), None)], ids=repr
)
def test_soft_interventions_in_coordinates_happen_there(act: Any, expected: float | None) -> None:
    """Twice 1.5 is 3, which is 2 in the other coordinates."""
    model = small().do({"friction_plus": act})
    value = model.solve(key=NoiseKey(Noise(0)), known={"friction": np.asarray(0.5)})["friction"]
    if expected is None:
        assert 0.2 <= value <= 0.4
    else:
        assert value == pytest.approx(expected)


def test_a_later_do_in_other_coordinates_takes_the_place_of_an_earlier_one() -> None:
    """One quantity has one intervention, whatever it is called."""
    model = small().do({"friction_plus": 1.3}).do({"friction": 0.9})
    assert model == small().do({"friction": 0.9})
    assert model.do({"friction_plus": 1.1}).solve()["friction"] == pytest.approx(0.1)


def test_two_names_of_one_quantity_conflict() -> None:
    """A quantity cannot be set twice in one do, in two coordinates or in two spellings."""
    with pytest.raises(ConflictingTargets) as caught:
        small().do({"friction": 0.1, "friction_plus": 1.3})
    assert caught.value.names == ("friction", "friction_plus")
    with pytest.raises(ConflictingTargets):
        small().do({"block": {"mass": 0.1}, "block.mass": 0.2})


def test_nested_requests_are_dotted_ones() -> None:
    """A dictionary of dictionaries means the same."""
    nested, dotted = {"block": {"mass": 0.1}}, {"block.mass": 0.1}
    assert flatten(nested) == dotted
    assert small().do(nested) == small().do(dotted)


@pytest.mark.parametrize(
    ("request_", "error"),
    [
        ({"wieght": 1.0}, UnknownVariable),
        ({5: 1.0}, UnknownVariable),
        ({"block.mass": "x"}, WrongValue),
        ({"block.mass": [1.0]}, WrongValue),
        ({"block.mass": Shift([1.0])}, WrongValue),
        ({"block.mass": float("nan")}, WrongValue),
        ({"block.mass": Scale(float("inf"))}, WrongValue),
        ({"block.mass": 3.0}, OutOfBounds),
        ({"count": 0.5}, WrongValue),
        ({"readout": 1.0}, NotIntervenable),
        ({"kind": 1.0}, NotIntervenable),
        ({"friction": Draw("A")}, InterventionError),
    ],
    ids=repr,
)
def test_what_cannot_be_done_is_refused(request_: Any, error: type[Exception]) -> None:
    """Each fault has its own error."""
    with pytest.raises(error):
        small().do(request_)


def test_all_faults_of_a_do_are_reported_together() -> None:
    """The order is that of the request."""
    with pytest.raises(SeveralProblems) as caught:
        small().do({"wieght": 1.0, "readout": 2.0, "block.mass": -1.0, "friction": 0.1})
    kinds = [type(problem) for problem in caught.value.problems]
    assert kinds == [UnknownVariable, NotIntervenable, OutOfBounds]


def test_the_causes_of_a_readout_are_those_that_can_be_set() -> None:
    """The error about a readout leads to the nearest settable causes."""
    with pytest.raises(NotIntervenable) as caught:
        small().do({"readout": 1.0})
    assert caught.value.causes == ("drag",)


def test_a_readout_can_be_held_in_the_model() -> None:
    """No experiment can do it; in the model it isolates a direct effect."""
    assert small().do({"readout": 1.0}, any_variable=True).solve()["readout"] == 1.0


def test_matrices_can_be_set() -> None:
    """A variable of two axes takes a matrix, in a do and from another model."""
    model = SCM([Exogenous(name="m", shape=(2, 2), default=(0.0,) * 4)])
    held = model.do({"m": [[1.0, 2.0], [3.0, 4.0]]})
    assert held.solve()["m"].tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert model.do(held.interventions) == held


def test_a_time_is_refused_though_the_draw_was_accepted_before() -> None:
    """What was checked once is not checked again, but for its time."""
    model = SCM([Exogenous(name="x", a=Box(0.0, 1.0))])
    model.do({"x": Draw("A")})
    with pytest.raises(InterventionError, match="in the plan of an episode"):
        model.do({"x": Draw("A", at=3)})


ACTS = st.one_of(
    st.floats(0.0, 2.0),
    st.floats(-0.1, 0.1).map(Shift),
    st.floats(0.5, 2.0).map(Scale),
    st.sampled_from([Draw(Normal(0.1, 0.01)), Draw(Box(0.0, 1.0)), Hard(0.2)]),
)
REQUESTS = st.dictionaries(st.sampled_from(["block.mass", "friction", "weight", "drag"]), ACTS)


@settings(max_examples=60, deadline=None)
@given(a=REQUESTS, b=REQUESTS)
def test_two_dos_are_one(a: dict[str, Any], b: dict[str, Any]) -> None:
    """do(a).do(b) is do of both with b on top: the model, its edges and its samples."""
    split, joint = small().do(a).do(b), small().do({**a, **b})
    assert split == joint
    assert set(split.edges) == set(joint.edges)
    one, other = split.draw(3, seed=0), joint.draw(3, seed=0)
    assert all(np.array_equal(one[name], other[name]) for name in small())


@settings(max_examples=40, deadline=None)
@given(a=REQUESTS)
def test_do_moves_descendants_only(a: dict[str, Any]) -> None:
    """With the same noise everything else keeps its value, bit for bit."""
    model = small()
    moved = {d for name in a for d in model.descendants(name)} | set(a)
    before, after = model.draw(5, seed=3), model.do(a).draw(5, seed=3)
    for name in set(model) - moved:
        np.testing.assert_array_equal(before[name], after[name])
