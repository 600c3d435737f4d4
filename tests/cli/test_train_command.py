"""``scm-world train``: what is said before, in and after a training."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from scm_world.cli.app import app
from scm_world.training.recipe import Recipe, recipe

SMALL = (
    "--backend=fake",
    "--set=worlds=4",
    "--steps=64",
    "--set=n_steps=8",
    "--set=batch_size=16",
    "--set=env.max_episode_length=5",
    "--set=network.hidden=[8]",
    "--set=trials.episodes=1",
    "--set=trials.times=1",
)


def called(*arguments: str) -> Any:
    """Run the command."""
    return CliRunner().invoke(app, ["train", *arguments])


def test_the_recipe_is_shown() -> None:
    """As JSON, with everything that was changed."""
    found = called(
        "picking",
        "--algo=sac",
        "--curriculum=2",
        "--observations=privileged",
        "--set=hindsight=true",
        "--set=trials.protocols=[]",
        "--set=rate.initial=1e-4",
        "--set=gamma=0.9",
        "--show-recipe",
    )
    made = Recipe.from_dict(json.loads(found.output))
    wanted = recipe("picking", "sac", curriculum=2, observations="privileged", hindsight=True)
    changes = {"trials.protocols": [], "rate.initial": 1e-4, "gamma": 0.9}
    assert made == wanted.but(**changes)


def test_a_curriculum_is_a_change_like_others() -> None:
    """With an option of its own, or after --set."""
    found = called("pushing", "--set=curriculum=2", "--show-recipe")
    assert Recipe.from_dict(json.loads(found.output)) == recipe("pushing", curriculum=2)


def test_a_recipe_is_read_from_a_file(tmp_path: Path) -> None:
    """And may be changed."""
    path = tmp_path / "recipe.json"
    path.write_text(recipe("reaching", "td3").to_json())
    found = called(
        "reaching", f"--recipe={path}", "--set=worlds=2", "--curriculum=0", "--show-recipe"
    )
    made = Recipe.from_dict(json.loads(found.output))
    assert made == recipe("reaching", "td3", curriculum=0, worlds=2)
    for other in (("pushing",), ("reaching", "--algo=ppo")):
        assert called(*other, f"--recipe={path}", "--show-recipe").exit_code == 2


WRONG = [
    (("pulling",), "no task is named 'pulling'"),
    (("pushing", "--algo=dqn"), "dqn"),
    (("pushing", "--curriculum=7"), "curriculum"),
    (("pushing", "--curriculum=none.json"), "none.json"),
    (("pushing", "--set=hindsight=true"), "hindsight with PPO"),
    (("pushing", "--steps=0"), "steps"),
    (("pushing", "--steps=-1"), "steps"),
    (("pushing", "--steps=10"), "at least"),
    (("pushing", "--set=steps=many"), "many"),
    (("pushing", "--set=n_steps"), "name=value"),
    (("pushing", "--set=n_step=5"), "n_steps"),
    (("pushing", "--set=n_steps=8", "--set=n_steps=9"), "n_steps"),
    (("pushing", "--recipe=none.json"), "none.json"),
    (("pushing", "--set=curriculum=1", "--curriculum=2"), "--set curriculum"),
    (("pushing", "--set=steps=8192", "--steps=8192"), "--set steps"),
    (("pushing", "--set=task=picking"), "the task stands before"),
    (("pushing", "--set=algo=sac"), "give --algo"),
    (("pushing", "--seed=-1"), "seed"),
]
LATER = [
    (("pushing", "--backend=muyoco"), "mujoco"),
    (("pushing", "--device=cudo"), "cuda"),
    (("pushing", "--start=none.safetensors"), "none.safetensors"),
    (("pushing", "--set=env.action_mode=fast"), "action_mode"),
]
"""What is checked with the libraries of the extra ``train``."""


@pytest.mark.parametrize(("arguments", "said"), [*WRONG, *LATER])
def test_what_is_wrong_is_said(
    arguments: tuple[str, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In one line, before anything is written."""
    if (arguments, said) in LATER:
        pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(tmp_path)
    found = called(*arguments)
    assert found.exit_code == 2
    assert said in found.output.replace("\n", " ")
    assert "Training" not in found.output
    assert not [*tmp_path.iterdir()]


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the command that installs it; no folder is left."""
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    found = called("pushing", *SMALL, f"--out={tmp_path / 'run'}")
    assert found.exit_code == 2
    assert "pip install 'scm-world[train]'" in found.output
    assert not (tmp_path / "run").exists()


def test_an_agent_is_trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is done is said before and on the way; at the end, where the policy is."""
    pytest.importorskip("stable_baselines3")
    monkeypatch.setattr("scm_world.training.rounds.LINES", 0.0)
    folder = tmp_path / "run"
    short = (*SMALL, "--set=episode_length=5")
    found = called("pushing", *short, f"--out={folder}")
    assert found.exit_code == 0, found.output
    text = found.output.replace("\n", "")
    assert "Training PPO on pushing" in text
    assert text.count("32 of 64 steps:") == text.count("64 of 64 steps:") == 1
    assert re.search(r"64 of 64 steps: return \S+, success 0.00, \S+ steps per second", text)
    assert f"scm-world evaluate {folder / 'best.safetensors'} pushing" in text
    again = called("pushing", *short, f"--out={folder}", "--quiet")
    assert again.exit_code == 0
    assert "Training" not in again.output
    other = called("pushing", *SMALL, f"--out={folder}", "--seed=1")
    assert other.exit_code == 2
    assert "seed (0 there, 1 here)" in other.output.replace("\n", " ")


def test_trials_are_of_a_search() -> None:
    """Without one there would be a single training."""
    found = called("pushing", *SMALL, "--trials=3")
    assert found.exit_code == 2
    assert "--sweep" in found.output
