"""``scm-world plan``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from matplotlib.image import imread
from typer.testing import CliRunner

from scm_world.cli.app import app
from scm_world.queries import load_episode

SMALL = ("--backend", "fake", "--samples", "4", "--horizon", "2", "--steps", "2")


def test_an_episode_is_planned_and_kept() -> None:
    """The numbers are printed; the episode, pictures of it and what was asked are on the disk."""
    believed = ("--do", "tool_block.mass=0.02", "--given", "tool_block.mass=0.04")
    done = CliRunner().invoke(app, ["plan", "pushing", *SMALL, *believed, "--out", "here"])
    assert done.exit_code == 0, done.output
    assert "time per action, mean [ms]" in done.output
    episode = load_episode("here/episode.npz")
    assert (len(episode), float(episode.final("tool_block.mass"))) == (2, 0.04)
    height, width, _ = imread("here/scenes.png").shape
    assert width > 1.5 * height
    result = json.loads(Path("here/result.json").read_text())
    assert result["believed"] == {"tool_block.mass": "0.02"}
    assert result["search"]["samples"] == 4
    assert result["found"]["control steps"] == 2


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--do", "tool_block.mas=1"), "tool_block.mas"),
        (("--objective", "rewards"), "rewards"),
        (("--model", "ode"), "ode"),
        (("--every", "3"), "every"),
        (("--do", "heavy"), "name=value"),
    ],
)
def test_wrong_options_are_told(more: tuple[str, ...], said: str) -> None:
    """The exit code is 2, the message names what was given, and nothing is written."""
    done = CliRunner().invoke(app, ["plan", "reaching", *SMALL, *more])
    assert done.exit_code == 2
    assert said in done.output
    assert not [*Path().iterdir()]
