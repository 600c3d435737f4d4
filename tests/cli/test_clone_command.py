"""The command that lets a network learn by imitation."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from scm_world.cli import app

QUICK = (
    *("--episodes", "1", "--rounds", "0", "--set", "keep=0", "--set", "updates=5"),
    *("--set", "env.max_episode_length=5", "--set", "network.hidden=[4]"),
    *("--set", "trials.protocols=[]"),
)


def call(*arguments: str) -> Result:
    """Run the command in this process."""
    return CliRunner().invoke(app, ["clone", *arguments])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("lifting",), "lifting"),
        (("picking", "--from", "nobody"), "'nobody'"),
        (("picking", "--set", "episode=3"), "'episode'"),
        (("picking", "--episodes", "0"), "episodes of a lesson"),
        (("picking", "--protocols", "P0,P77"), "'P77'"),
        (("picking", "--noise", "-1"), "noise of a lesson"),
        (("picking", "--noise", "0.1", "--set", "noise=0.2"), "noise"),
        (("picking", "--set", "noise"), "expected name=value"),
        (("picking", "--set", "trials.episode=3"), "trials.episode of a lesson"),
        (("picking", "--set", "episodes.more=3"), "episodes of a lesson"),
    ],
)
def test_what_is_impossible_is_one_line(
    arguments: tuple[str, ...], said: str, tmp_path: Path
) -> None:
    """A wrong argument ends with exit code 2, its name, and no folder."""
    done = call(*arguments, "--out", str(tmp_path / "run"))
    assert done.exit_code == 2
    assert said in done.output
    assert not (tmp_path / "run").exists()


def test_it_says_what_comes_next(tmp_path: Path) -> None:
    """A small clone names its file and the commands that take it; again, it is there already."""
    pytest.importorskip("torch")
    for _ in range(2):
        done = call("picking", *QUICK, "--out", str(tmp_path / "run"))
        assert done.exit_code == 0, done.output
        assert f"scm-world evaluate {tmp_path}/run/policy.safetensors picking" in done.output
        assert "scm-world train picking --start" in done.output
    about = json.loads((tmp_path / "run" / "clone.json").read_text())
    made = about["lesson"]
    assert (made["episodes"], made["network"]["hidden"], made["keep"]) == (1, [4], 0.0)
    assert made["network"]["activation"] == "relu"  # a dotted name leaves the other parts alone
