"""Rows at high rates are thinned as far as the motion needs, and commands act as recorded."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pendulum import PENDULUM

import scm_world as sw
from scm_world.fit.fitting import arguments_of
from scm_world.fit.problem import windows_of
from scm_world.fit.shooting import Shooting
from scm_world.fit.thinning import ENOUGH, thinned

NAMES = ["hinge.damping", "pole.mass"]


def recorded(rows: int, noise: float = 1e-3) -> tuple[sw.World, dict[str, Any]]:
    """Record 2 ms steps of a pendulum with twice the damping, whose commands change in each."""
    world, rng = sw.World(PENDULUM, control_dt=0.002), np.random.default_rng(0)
    time = 0.002 * np.arange(rows)
    sent = 0.4 * np.sin(6.0 * time[:-1]) + 0.3 * rng.uniform(-1.0, 1.0, rows - 1)
    run = world.rollout(sent[:, None], steps=rows - 1, do={"hinge.damping": 0.02})
    measured = run["hinge.position"] + noise * rng.normal(size=rows)
    return world, {"time": time, "motor.control": sent, "hinge.position": measured}


def test_a_fit_says_that_it_thins_and_covers() -> None:
    """Rows of 2 ms are more than a pendulum needs; ``thin=1`` uses all of them."""
    world, recording = recorded(800)
    fit = world.fit(recording, NAMES)
    every = fit.measured.every
    assert every > 1
    assert any(f"1 of {every} rows is used" in said for said in fit.remarks)
    assert len(fit.measured.values) >= ENOUGH
    rows = fit.table.set_index("parameter")
    for name, true in zip(NAMES, (0.02, 0.2), strict=True):
        assert rows.low[name] <= true <= rows.high[name]
    measured, _ = arguments_of(world, recording, NAMES, None, thin=1)
    assert (measured.every, len(measured.values)) == (1, 800)


def test_commands_between_used_rows_act_as_recorded() -> None:
    """Simulated measurements of used rows are, to the last bit, those without thinning."""
    world, recording = recorded(200)
    measured, targets = arguments_of(world, recording, NAMES, None)
    assert measured.every == 1  # short recordings are used whole
    made = []
    for every in (1, 7):
        part = thinned(measured, every)
        with Shooting(world, part, targets) as shooting:
            (window,) = windows_of(part.runs, None)
            (start,) = shooting.guess([window])
            ((values, _),) = shooting.simulate([(window, np.array([0.3, -0.1]), start)])
        made.append((part.runs[0].instants, values, start))
    (every_row, full, begin), (used, less, _) = made
    assert np.array_equal(used, every_row[::7])
    with Shooting(world, thinned(measured, 7), targets) as shooting:
        ((values, _),) = shooting.simulate([(window, np.array([0.3, -0.1]), begin)])
    assert np.array_equal(values, full[::7])
    assert less.shape == values.shape


def test_fast_motion_and_seldom_measured_columns_keep_their_rows() -> None:
    """A vibration within few rows needs all of them, and a slow sensor keeps what it has."""
    world, recording = recorded(1500)
    shaken = recording["hinge.position"] + 0.1 * np.sin(300.0 * recording["time"])
    measured, _ = arguments_of(world, {**recording, "hinge.position": shaken}, NAMES, None)
    assert measured.every == 1
    seldom = np.full(1500, np.nan)
    seldom[::100] = 0.0
    measured, _ = arguments_of(world, {**recording, "hinge.velocity": seldom}, NAMES, None)
    assert measured.every > 1
    assert np.isfinite(measured.values[:, 1]).sum() == 15


def test_every_which_row_is_a_whole_number() -> None:
    """Other numbers are refused."""
    world, recording = recorded(50)
    with pytest.raises(sw.errors.UnknownOption, match="thin"):
        world.fit(recording, NAMES, thin=0)
