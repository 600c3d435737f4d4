"""Facts about solving and sampling structural causal models."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from graph_models import small

from scm_world.errors import ModelError, UnknownOption
from scm_world.graph import SCM
from scm_world.variables import (
    Derived,
    Draw,
    Exogenous,
    Linear,
    Measured,
    Noise,
    Normal,
    Parent,
    Shift,
)


def test_solve_without_a_moment_is_without_noise() -> None:
    """Defaults stand for draws, zeros for noise."""
    values = small().solve()
    assert float(values["drag"]) == pytest.approx(0.2 + 1.0)
    assert values["count"].dtype == np.int64


def test_solve_takes_batches() -> None:
    """Leading axes broadcast."""
    masses = np.linspace(0.0, 1.0, 12).reshape(4, 3)
    values = small().solve({"block.mass": masses})
    np.testing.assert_allclose(values["drag"], 10.0 * masses + 1.0)


def test_solve_needs_what_the_model_does_not_compute() -> None:
    """A state has no mechanism here, so its value has to be given."""
    model = SCM([Measured(name="pose", settable_state=True), Exogenous(name="size", default=1.0)])
    with pytest.raises(ModelError, match="give its value"):
        model.solve()
    assert model.solve({"pose": np.array(2.0)})["pose"] == 2.0


def test_a_draw_needs_a_moment() -> None:
    """Without one there is no noise to draw from."""
    with pytest.raises(ModelError, match="noise key"):
        small().do({"weight": Draw(Normal())}).solve()


@pytest.mark.parametrize(
    "act", [{}, {"weight": Draw("A")}, {"block.mass": Draw("A|B")}, {"drag": Shift(1.0)}], ids=repr
)
def test_a_row_of_a_sample_can_be_drawn_alone(act: dict[str, Any]) -> None:
    """sample(1, first=i) is row i: results do not depend on how many are drawn."""
    model = small().do(act)
    rows = model.draw(20, seed=9)
    for i in (0, 7, 19):
        alone = model.draw(1, seed=9, first=i)
        for name in model:
            np.testing.assert_array_equal(alone[name][0], rows[name][i])


def lagged() -> SCM:
    """Build a process with memory."""
    return SCM(
        [
            Exogenous(name="push", distribution=Normal(0.0, 1.0)),
            Derived(
                name="x",
                parents=(Parent("x", 1), "push"),
                mechanism=Linear(weights=(0.5, 1.0)),
                noise=Normal(0.0, 0.1),
                start=8.0,
            ),
            Derived(name="y", parents=(Parent("x", 1),), mechanism=Linear(weights=(2.0,))),
        ]
    )


def test_a_process_is_sampled_step_by_step() -> None:
    """Lagged parents are those of the step before, and the declared start before the first."""
    values = lagged().draw(50, seed=0, steps=6)
    assert values["x"].shape == (50, 6)
    np.testing.assert_array_equal(values["y"][:, 1:], 2.0 * values["x"][:, :-1])
    np.testing.assert_array_equal(values["y"][:, 0], 16.0)
    residual = values["x"][:, 1:] - 0.5 * values["x"][:, :-1] - values["push"][:, 1:]
    assert residual.std() == pytest.approx(0.1, abs=0.02)
    with pytest.raises(ModelError, match="how many steps"):
        lagged().draw(2, seed=0)


def test_longer_processes_begin_like_shorter_ones() -> None:
    """Neither the number of steps nor that of episodes shifts the noise."""
    short, long = lagged().draw(2, seed=0, steps=3), lagged().draw(5, seed=0, steps=9)
    for name in lagged():
        np.testing.assert_array_equal(short[name], long[name][:2, :3])


def test_do_on_a_process_does_not_shift_its_noise() -> None:
    """What does not follow the target keeps its value at every step."""
    before = lagged().draw(4, seed=0, steps=5)
    after = lagged().do({"x": 0.0}).draw(4, seed=0, steps=5)
    np.testing.assert_array_equal(before["push"], after["push"])
    np.testing.assert_array_equal(after["y"][:, 1:], np.zeros((4, 4)))


@pytest.mark.parametrize("seed", [1.0, True, None, "1", -1, float("nan"), np.array([1])], ids=repr)
def test_a_seed_is_a_whole_number(seed: Any) -> None:
    """Anything else would be another stream than that of the number that it looks like."""
    with pytest.raises(UnknownOption, match="seed cannot be"):
        small().draw(1, seed=seed)
    with pytest.raises(UnknownOption, match="seed"):
        Noise(seed)


def test_numbers_of_rows_and_steps_are_whole() -> None:
    """No rows cannot be drawn, nor half a row; rows and steps are counted from 0."""
    np.testing.assert_array_equal(
        small().draw(1, seed=np.int64(1))["drag"], small().draw(1, seed=1)["drag"]
    )
    for n in (0, -1, 1.5, None, True):
        with pytest.raises(UnknownOption, match="n cannot be"):
            small().draw(n, seed=0)  # type: ignore[arg-type] # that is the point
    with pytest.raises(UnknownOption, match="first"):
        small().draw(1, seed=0, first=-1)
    with pytest.raises(UnknownOption, match="steps"):
        lagged().draw(1, seed=0, steps=0)
