"""The command that lets a network learn by imitation."""

from __future__ import annotations

import json
from pathlib import Path

import gymnasium
import pytest
from typer.testing import CliRunner, Result

from scm_world.cli.app import app
from scm_world.evaluation.recording import record
from scm_world.policies import load_policy
from scm_world.training import imitation
from scm_world.training.recipe import recipe

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
        done = call("pick_and_place", *QUICK, "--out", str(tmp_path / "run"))
        assert done.exit_code == 0, done.output
        assert f"scm-world evaluate {tmp_path}/run/policy.safetensors pick_and_place" in done.output
    made = json.loads((tmp_path / "run" / "study.json").read_text())["settings"]
    assert (made["episodes"], made["network"]["hidden"], made["keep"]) == (1, [4], 0.0)
    assert made["network"]["activation"] == "relu"  # a dotted name leaves the other parts alone


def test_a_recording_of_gymnasium_is_learned_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recording names all options of its environment; a failed trial costs no policy."""
    pytest.importorskip("torch")
    options = {**recipe("pick_and_place").env, "task_options": None, "max_episode_length": 5}
    env = gymnasium.make("scm_world/PickAndPlace-v0", **options)
    record("still", env, 1, out=tmp_path / "shown.parquet")
    env.close()
    given = (
        "pick_and_place",
        "--from",
        str(tmp_path / "shown.parquet"),
        "--out",
        str(tmp_path / "run"),
    )
    small = ("--set", "trials.episodes=1", "--set", 'trials.protocols=["P0"]')
    arguments = (*given, *QUICK[4:8], "--set", "network.hidden=[4]", *small)

    def broken(*_: object) -> None:
        raise RuntimeError("no more room")

    monkeypatch.setattr(imitation, "scored", broken)
    assert isinstance(call(*arguments).exception, RuntimeError)
    first = load_policy(tmp_path / "run" / "policy.safetensors")
    assert "trials" not in first.about.card
    monkeypatch.undo()

    monkeypatch.setattr(imitation, "fitted", broken)  # what was learned is not learned again
    done = call(*arguments)
    assert done.exit_code == 0, done.output
    second = load_policy(tmp_path / "run" / "best.safetensors")
    assert second.about.card["trials"] == {"P0": 0.0}
    assert (second.layers[0].weight == first.layers[0].weight).all()
