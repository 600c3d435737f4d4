"""No intervention takes a variable of equations beyond its fixed bounds, as in a world."""

from __future__ import annotations

from typing import Any

import pytest

import scm_world as sw
from scm_world.errors import OutOfBounds
from scm_world.variables import (
    Categories,
    Derived,
    Exogenous,
    Integers,
    Linear,
    Mechanism,
    Parent,
    Scale,
    Shift,
    Time,
)

COUNT = Exogenous(
    name="k", dtype="integer", bounds=Integers(0, 9), default=5, distribution=Integers(4, 6)
)
KIND = Exogenous(name="c", dtype="categorical", bounds=Categories((0, 1, 2)), default=1)
SHARE = Exogenous(name="r", default=0.5)
PAIR = Exogenous(name="p", dtype="integer", shape=(2,), bounds=Integers(0, 9), default=(1, 7))
TOTAL = Derived(name="y", parents=("k",), mechanism=Linear(weights=(1.0,)))
MODEL = sw.SCM([COUNT, KIND, SHARE, PAIR, TOTAL])


def twelve(share: Any) -> Any:
    """Return a count that is none of 0 to 9."""
    return 12 + 0 * share


BEYOND: list[tuple[str, Any]] = [
    ("k", Shift(7)),
    ("k", Scale(3)),
    ("k", Shift(by=sw.Draw(7, 8))),
    ("k", sw.Draw(Integers(10, 15))),
    ("k", Mechanism(twelve, parents=("r",))),
    ("c", sw.Draw(Integers(3, 5))),
    ("p", Shift((0, 3))),
]


@pytest.mark.parametrize(("name", "act"), BEYOND)
def test_what_would_leave_fixed_bounds_is_refused(name: str, act: Any) -> None:
    """Questions, draws, contexts and worlds refuse it alike, and say what is allowed."""
    do, outcome = {name: act}, {"outcomes": [name]}
    asked = [
        lambda: MODEL.do(do).draw(3, seed=0),
        lambda: MODEL.sample(3, do, **outcome),
        lambda: MODEL.given(do).sample(3, **outcome),
        lambda: MODEL.sample(3, nature=do, **outcome),
        lambda: MODEL.effect("y", do=do, n=3),
        lambda: MODEL.rollout(do=do),
        lambda: MODEL.rollout(seed=1).counterfactual(do)[name],
        lambda: MODEL.counterfactual({"k": 5, "c": 1, "r": 0.5, "p": (1, 7)}, do=do),
        lambda: sw.World(MODEL).given(do).sample(3, **outcome),
    ]
    for ask in asked:
        with pytest.raises(OutOfBounds, match="is outside") as error:
            ask()
        assert error.value.variable == name
    world = sw.World(MODEL)
    world.reset(seed=0)
    before = {one: world[one].tolist() for one in MODEL}
    with pytest.raises(OutOfBounds):
        world.do(do)
    assert {one: world[one].tolist() for one in MODEL} == before


def test_what_stays_within_bounds_is_done() -> None:
    """The ends belong to the bounds: 4 to 6 and 3 more is at most 9."""
    assert MODEL.do({"k": Shift(3)}).draw(50, seed=0)["k"].max() == 9
    drawn = MODEL.do({"p": Shift(by=sw.Draw(0.0, 2.0), shared=True)}).draw(50, seed=0)["p"]
    assert {*drawn[:, 0].tolist()} == {1, 2, 3}
    assert (drawn[:, 1] - drawn[:, 0] == 6).all()


def test_one_unit_beyond_is_named() -> None:
    """Of many units the first one that would leave its bounds is in the message."""
    with pytest.raises(OutOfBounds, match="10 is outside") as error:
        MODEL.do({"k": Shift(4)}).draw(50, seed=0)
    assert (error.value.value, error.value.nearest) == (10, 9)


def test_a_shift_counts_in_each_step() -> None:
    """In a model with lags it is refused in the step in which it acts, and not before."""
    series = sw.SCM(
        [
            Exogenous(name="k", dtype="integer", bounds=Integers(0, 9), default=1),
            Derived(
                name="v", parents=(Parent(name="v", lag=1), "k"), mechanism=Linear(weights=(1, 1))
            ),
        ]
    )
    window = {"k": Shift(9, time=Time(during=(2, 4)))}
    with pytest.raises(OutOfBounds, match="10 is outside"):
        series.rollout(do=window, steps=6)
    assert series.rollout(do=window, steps=2)["k"].max() == 1
    assert series.rollout(do={"k": Shift(8, time=Time(during=(2, 4)))}, steps=6)["k"].max() == 9
