"""Commands whose results are where a URL says."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from scm_world.cli.app import app
from scm_world.discovery.data import load
from scm_world.evaluation import Evaluation
from scm_world.runs.files import located

pytest.importorskip("upath")

QUICK = ("--backend", "fake", "--env", "max_episode_length=3", "--workers", "1")


@pytest.fixture(autouse=True)
def _wide(monkeypatch: pytest.MonkeyPatch) -> None:
    """Print on a wide terminal."""
    monkeypatch.setenv("COLUMNS", "200")


def call(*arguments: str) -> Result:
    """Run a command in this process."""
    return CliRunner().invoke(app, [*arguments])


def test_an_evaluation_goes_to_a_store(tmp_path: Path) -> None:
    """It is written there, and only there; it is explained and checked from there."""
    url = "memory://cli/evaluation"
    done = call("evaluate", "still", "--protocols=P0,P8", "-n1", *QUICK, "--out", url)
    assert done.exit_code == 0, done.output
    assert f"{url}/results.json" in done.output
    assert len(Evaluation.load(url)) == 2
    assert call("explain", url).exit_code == 0
    assert list(tmp_path.iterdir()) == []


def test_other_results_go_to_a_store(tmp_path: Path) -> None:
    """A dataset, and the files of a question."""
    here = ("reaching", "--backend", "fake", "--steps", "2")
    done = call("collect", *here, "-n", "3", "--out", "memory://cli/data")
    assert done.exit_code == 0, done.output
    assert len(load("memory://cli/data")) == 3
    asked = ("effect", *here, "gravity[2]", "gravity=0,0,-5", "-n", "2")
    done = call(*asked, "--out", "memory://cli/effect")
    assert done.exit_code == 0, done.output
    assert json.loads(located("memory://cli/effect/effect.json").read_text())["n"] == 2
    assert list(tmp_path.iterdir()) == []


def test_urls_that_cannot_be_are_refused_at_once() -> None:
    """No such protocol; a file where a folder should be."""
    done = call("evaluate", "still", *QUICK, "--out", "s4://bucket/run")
    assert done.exit_code == 2
    assert "protocol of a URL cannot be 's4'" in done.output
    located("memory://cli/file").write_bytes(b"")
    done = call("evaluate", "still", *QUICK, "--out", "memory://cli/file")
    assert done.exit_code != 0
    assert "memory://cli/file" in done.output
