"""Ctrl-C during a fit gives the best values so far, and determines none of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from pendulum import PENDULUM
from typer.testing import CliRunner

import scm_world as sw
from scm_world.cli.app import app
from scm_world.fit.shooting import Shooting

NAMES = ["hinge.damping", "pole.mass"]


def recorded() -> tuple[sw.World, dict[str, Any]]:
    """Record a pendulum with twice the damping."""
    world = sw.World(PENDULUM)
    robot = world.rollout("random", seed=1, steps=60, do={"hinge.damping": 0.02})
    noise = 0.001 * np.random.default_rng(0).normal(size=61)
    recording = {"time": 0.02 * np.arange(61), "motor.control": robot.actions[:, 0]}
    return world, recording | {"hinge.position": robot["hinge.position"] + noise}


def interrupt(monkeypatch: pytest.MonkeyPatch, at: int) -> None:
    """Plant a Ctrl-C in the simulation of a number; it comes once."""
    plain, calls = Shooting.simulate, iter(range(1_000_000))

    def simulate(self: Shooting, tasks: Any) -> Any:
        if next(calls) == at:
            raise KeyboardInterrupt
        return plain(self, tasks)

    monkeypatch.setattr(Shooting, "simulate", simulate)


def calls_of(monkeypatch: pytest.MonkeyPatch) -> int:
    """Return how many simulations a whole fit takes, and check that progress ends."""
    world, recording = recorded()
    plain, count, told = Shooting.simulate, [0], list[tuple[int, int]]()

    def simulate(self: Shooting, tasks: Any) -> Any:
        count[0] += 1
        return plain(self, tasks)

    with monkeypatch.context() as patch:
        patch.setattr(Shooting, "simulate", simulate)
        fit = world.fit(recording, NAMES, progress=lambda *each: told.append(each))
    assert fit.table.determined.all()
    assert not fit.interrupted
    done, planned = zip(*told, strict=True)
    assert len(told) > 5
    assert done[-1] == planned[-1]
    assert all(one < most for one, most in told[:-1])
    return count[0]


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_an_interrupted_fit_has_the_best_so_far(
    share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the first search, later on, and while it looks for intervals."""
    at = int(share * calls_of(monkeypatch))
    world, recording = recorded()
    interrupt(monkeypatch, at)
    fit = world.fit(recording, NAMES)
    assert fit.interrupted
    assert not fit.table.determined.any()
    assert any("interrupted" in said for said in fit.remarks)
    assert np.isfinite(fit.table[["value", "low", "high"]].to_numpy(float)).all()
    if share == 0.9:  # the minimum was found already
        assert fit.values["hinge.damping"] == pytest.approx(0.02, rel=0.05)
    assert world.fit(recording, NAMES).table.determined.all()  # the world is as it was


def test_nothing_so_far_is_an_interrupt(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the first values there is no fit."""
    world, recording = recorded()
    interrupt(monkeypatch, 0)
    with pytest.raises(KeyboardInterrupt):
        world.fit(recording, NAMES)


def test_the_command_writes_what_there_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Exit code 130, with the files of a fit."""
    at = int(0.6 * calls_of(monkeypatch))
    _, recording = recorded()
    model, run = tmp_path / "pendulum.xml", tmp_path / "run.csv"
    model.write_text(PENDULUM)
    columns = {name: np.ravel(values) for name, values in recording.items()}
    columns["motor.control"] = np.append(columns["motor.control"], np.nan)
    pd.DataFrame(columns).to_csv(run, index=False)
    interrupt(monkeypatch, at)
    parts = ["fit", str(model), str(run), "--out", str(tmp_path / "out"), "--suggest", "1"]
    for name in NAMES:
        parts += ["--parameters", name]
    result = CliRunner().invoke(app, parts)
    assert result.exit_code == 130, result.output
    assert "interrupted" in result.output
    assert (tmp_path / "out" / "result.json").exists()
    assert not [*(tmp_path / "out").glob("experiment*")]
