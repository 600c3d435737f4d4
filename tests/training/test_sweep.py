"""Searches for settings: proposals, interruptions, and what is impossible."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from scm_world.cli.app import app
from scm_world.errors import UnknownOption
from scm_world.training.recipe import Recipe, recipe

pytest.importorskip("stable_baselines3")
optuna = pytest.importorskip("optuna")

from scm_world.training import sweep as module  # noqa: E402 # needs the library
from scm_world.training.loop import Trained  # noqa: E402 # needs the library
from scm_world.training.sweep import sweep  # noqa: E402 # needs the library

MADE = recipe(
    "pushing",
    worlds=2,
    steps=32,
    n_steps=8,
    batch_size=8,
    env={"max_episode_length": 4},
    network={"hidden": [4], "log_std_end": None},
    rate={"schedule": "constant"},
    trials={"episodes": 1, "times": 1, "protocols": ["P0"], "metric": "return"},
)
SPACE: dict[str, Any] = {"rate.initial": (1e-5, 1e-2, "log"), "n_steps": [4, 8]}
GIVEN: dict[str, Any] = {"backend": "fake", "threads": 1, "seed": 3}


def test_what_was_killed_goes_on(tmp_path: Path) -> None:
    """The trial under way from its checkpoint, with its values; what was over is not repeated."""
    whole = sweep(MADE, SPACE, trials=3, out=tmp_path / "whole", **GIVEN)
    program = f"""
import json, os
from scm_world.training.recipe import Recipe
from scm_world.training.sweep import sweep
said = []
def die(text):
    said.append(text)
    if sum(one.startswith("32 steps: P0") for one in said) == 2:  # in the second training
        os.kill(os.getpid(), 9)
made = Recipe.from_dict(json.loads({MADE.to_json()!r}))
sweep(made, {SPACE!r}, trials=3, out={str(tmp_path / "parts")!r}, tell=die, **{GIVEN!r})
"""
    done = subprocess.run([sys.executable, "-c", program], check=False)  # noqa: S603 # ours
    assert done.returncode == -9
    assert [path.name for path in (tmp_path / "parts" / "results").iterdir()] == ["000.json"]
    parts = sweep(MADE, SPACE, trials=3, out=tmp_path / "parts", **GIVEN)
    assert parts.rows[0] == whole.rows[0]
    assert parts.rows[1]["values"] == whole.rows[1]["values"]
    again = sweep(MADE, SPACE, trials=3, out=tmp_path / "again", **GIVEN)
    assert again.rows == whole.rows
    assert whole.score == max(row["score"] for row in whole.rows)
    best = Recipe.load(tmp_path / "whole" / "best.json")
    assert best == whole.best
    assert len({row["values"]["rate.initial"] for row in whole.rows}) == 3
    assert all(1e-5 <= row["values"]["rate.initial"] <= 1e-2 for row in whole.rows)
    with (tmp_path / "whole" / "sweep.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [float(row["score"]) for row in table] == [row["score"] for row in whole.rows]


def test_proposals_follow_scores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bowl is searched at its bottom; proposals follow from the trials before, resumed or not."""
    seen: list[Any] = []

    def trained(made: Recipe, *, out: Path, **_: Any) -> Trained:
        seen.append(made)
        score = -abs(made.settings.gamma - 0.7)
        return Trained(out, made, 0, 1, out, out, score)

    monkeypatch.setattr(module, "train", trained)
    found = sweep(MADE, {"gamma": (0.0, 1.0)}, trials=30, out=tmp_path / "one", seed=1)
    late = [row["score"] for row in found.rows[20:]]
    assert found.score == max(row["score"] for row in found.rows)
    assert sum(late) / 10 > sum(row["score"] for row in found.rows[:10]) / 10
    for n in (7, 30):
        again = sweep(MADE, {"gamma": (0.0, 1.0)}, trials=n, out=tmp_path / "two", seed=1)
    assert again.rows == found.rows
    assert len(seen) == 60


def test_trials_that_cannot_be_have_no_score(tmp_path: Path) -> None:
    """Values that do not go together; what is wrong in itself is refused at once."""
    space = {"steps": [16, 32], "n_steps": [8, 16]}
    found = sweep(MADE, space, trials=4, out=tmp_path / "run", **GIVEN)
    for row in found.rows:
        values = row["values"]
        is_bad = 2 * values["n_steps"] > values["steps"]
        assert (row["score"] is None, row["error"] is not None) == (is_bad, is_bad)
    for wrong, said in (
        ({"nothing": [1]}, "field of a recipe"),
        ({"gamma": (1.0, 0.5)}, "range of gamma"),
        ({"gamma": 0.5}, "range of gamma"),
        ({}, "space of a sweep"),
    ):
        with pytest.raises(UnknownOption, match=said):
            sweep(MADE, wrong, out=tmp_path / "wrong", **GIVEN)
    with pytest.raises(UnknownOption, match=r"trials\.protocols of a sweep"):
        sweep(MADE.but(**{"trials.protocols": []}), space, out=tmp_path / "wrong", **GIVEN)


def test_the_command_searches(tmp_path: Path) -> None:
    """It prints the trials and writes the best recipe."""
    (tmp_path / "made.json").write_text(MADE.to_json())
    given = ["train", "pushing", "--backend=fake", f"--out={tmp_path / 'out'}", "--trials=2"]
    given += [f"--recipe={tmp_path / 'made.json'}", "--sweep=rate.initial=1e-5:1e-2:log"]
    done = CliRunner().invoke(app, [*given, "--sweep=n_steps=[4,8]"])
    assert done.exit_code == 0, done.output
    about = json.loads((tmp_path / "out" / "sweep.json").read_text())
    assert about["space"] == {"rate.initial": [1e-5, 1e-2, "log"], "n_steps": [4, 8]}
    best = Recipe.load(tmp_path / "out" / "best.json")
    assert best.rate.initial == about["trials"][about["best"]]["values"]["rate.initial"]
