"""Commands on models: patterns and draws, hidden attributes, and the picture of a sweep."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from scm_world.cli.app import app
from scm_world.discovery.data import sweep
from scm_world.discovery.data.sweeps import PICTURE
from scm_world.queries import World
from scm_world.runs.canvas import png

ARM = """
<mujoco model="arm">
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.5"/>
      <geom name="shape" type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>
      <body name="lower" pos="0.3 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.2"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def arm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Write a model, and work beside it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.xml").write_text(ARM)
    return "arm.xml"


def call(*words: str) -> Any:
    """Run a command."""
    done = CliRunner().invoke(app, [*words], catch_exceptions=False, env={"COLUMNS": "200"})
    assert done.exit_code == 0, done.output
    return done


def test_a_do_takes_patterns_and_draws(arm: str, tmp_path: Path) -> None:
    """The result has a number for each variable."""
    acts = ("*.damping=scale:draw:0.5,2", "*.mass=scale:shared:0.8,1.2")
    call("do", arm, *acts, "--steps", "2", "--out", "done")
    did = json.loads((tmp_path / "done" / "result.json").read_text())
    text = json.dumps(did)
    assert all(name in text for name in ("shoulder.damping", "elbow.damping", "upper.mass"))
    assert "*.damping" not in did.get("targets", {})


def test_hidden_attributes_are_listed_with_what_exposes_them(arm: str) -> None:
    """Those that can be set have a pattern, the others a reason; the pattern exposes them."""
    shown = call("variables", arm, "--all").stdout
    assert "*.center_of_mass" in shown
    assert "is not in force: it has no limits" in shown
    assert "attributes that are no variables" not in call("variables", arm).stdout
    with World(arm) as world:
        hidden = {row["attribute"]: row for row in world.task.system.hidden()}
    assert hidden["scale"]["elements"] == ["upper", "lower"]
    assert hidden["impratio"]["expose"] == "impratio"
    patterns = [row["expose"] for row in hidden.values() if row["expose"]]
    with World(arm, expose=["*", *patterns]) as world:
        assert {"upper.scale", "upper.center_of_mass", "impratio"} <= {*world.model}
        assert not any(row["expose"] for row in world.task.system.hidden())
    assert "no attributes but these" in call("variables", "pushing", "--all").stdout


@pytest.mark.usefixtures("drawn")
def test_a_sweep_draws_its_picture(arm: str, tmp_path: Path) -> None:
    """It lies beside the table, unless it is left out; the same table gives the same bytes."""
    options = ("--outcome", "elbow.position", "-n", "3", "--steps", "3", "--out", "swept")
    over = ("--over", "upper.mass=0.5:1.5:3")
    said = call("sweep", arm, *over, "--do", "*.position=shift:draw:-1,1", *options)
    assert PICTURE in said.output
    drawn = (tmp_path / "swept" / PICTURE).read_bytes()
    assert drawn.startswith(b"\x89PNG")
    call("sweep", arm, *over, *options[:-1], "other", "--no-picture")
    assert not (tmp_path / "other" / PICTURE).exists()
    with World(arm) as world:
        grid = {"upper.mass": [0.5, 1.0], "lower.mass": [0.5, 1.0, 2.0], "gravity": [[0, 0, -9]]}
        found = sweep(world, grid, ["elbow.position", "elbow.velocity"], n=2, steps=2)
    figure = found.picture()
    assert [ax.get_title() for ax in figure.axes] == ["elbow.position", "elbow.velocity"]
    assert [ax.get_xlabel() for ax in figure.axes] == ["lower.mass"] * 2
    assert [len(ax.get_lines()) for ax in figure.axes] == [2, 2]
    assert png(figure) == png(found.picture())
