"""The paper's study as one command: it resumes, and a part of the budget is called one."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2]))

pd = pytest.importorskip("pandas")

from benchmarks.reproduction import __main__ as command  # noqa: E402 # from there
from scm_world.policies import save_policy  # noqa: E402
from scm_world.training.recipe import Recipe  # noqa: E402

COMMON = ["--algos", "ppo", "--curricula", "1", "--scale", "0.01", "--backend", "fake"]
COMMON += ["--protocols", "P0,P5", "--episodes", "2"]


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Replace the trainer: it writes a small network; seed 9 fails."""
    asked: list[str] = []

    def train(made: Recipe, *, out: Path, seed: int, **_: Any) -> None:
        asked.append(out.name)
        if seed == 9:
            raise RuntimeError("the engine\nblew up")
        draw = np.random.default_rng(seed).normal(size=(9, 56)).astype(np.float32)
        tensors = {"layers.0.weight": draw, "layers.0.bias": np.zeros(9, np.float32)}
        names = ("action_mode", "frame_skip", "conventions")
        env = {name: made.env[name] for name in names} | {"max_episode_length": 3}
        out.mkdir(parents=True, exist_ok=True)
        save_policy(out / "policy.safetensors", tensors, {"task": made.task, "env": env})

    monkeypatch.setattr(command, "train", train)
    return asked


def test_a_study_is_run_resumed_and_told(trained: list[str], tmp_path: Path) -> None:
    """A failed training does not stop the others; the table says what the budget lacks."""
    words = [*COMMON, "--out", str(tmp_path)]
    assert command.main([*words, "--seeds", "0,9,1"]) == 1
    table = pd.read_csv(tmp_path / "table.csv")
    row = table[(table["curriculum"] == 1) & (table["protocol"] == "P5")].iloc[0]
    means = []
    for seed in (0, 1):
        data = json.loads(
            (tmp_path / f"evaluations/pushing-ppo-c1-{seed}/results.json").read_text()
        )
        (score,) = [s for s in data["scores"] if s["protocol"] == "P5"]
        means.append(score["last_fractional_success"]["value"])
    assert row["mean"] == pytest.approx(np.mean(means))
    assert (row["published"], row["seeds"]) == (0.99, "0 1")
    for said in ("1,080,000 of 100,000,000", "2 of 5 seeds", "2 of 200 episodes", "2 of 12 prot"):
        assert said in row["status"]
    assert set(table[table["algo"] == "sac"]["status"]) == {"not run"}
    assert (tmp_path / "pushing-ppo.png").stat().st_size > 1_000
    assert "not run" in (tmp_path / "table.md").read_text()
    before = (tmp_path / "table.csv").read_bytes()
    assert command.main([*words, "--seeds", "0,1"]) == 0
    assert (tmp_path / "table.csv").read_bytes() == before
    with pytest.raises(SystemExit, match="other options"):
        command.main([*words, "--seeds", "0", "--scale", "0.02"])


def test_a_study_stops_in_time(
    trained: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is left is said."""
    assert command.main([*COMMON, "--seeds", "0,1", "--hours", "0", "--out", str(tmp_path)]) == 0
    assert trained == []
    assert "2 trainings are left" in capsys.readouterr().out


def test_actors_are_the_published_ones(tmp_path: Path) -> None:
    """Another archive is refused before anything is trained."""
    (tmp_path / "pushing_ppo_curr1.zip").write_bytes(b"no archive")
    words = [*COMMON, "--out", str(tmp_path / "study"), "--actors", str(tmp_path)]
    with pytest.raises(SystemExit, match="not the published archive"):
        command.main(words)


def test_the_whole_study_has_the_published_settings(capsys: pytest.CaptureFixture[str]) -> None:
    """180 trainings at full length, 83 Hz, absolute joint positions; a recipe is JSON."""
    asked = command.read(["--table", "all"])
    assert len(set(command.cells(asked))) == 4 * 3 * 3 * 5
    for cell in command.cells(asked)[:36]:
        assert command.recipe_of(asked, cell).steps >= command.KNOWN["budget"]["steps"][cell.algo]
    assert command.main(["--recipe", "pushing-ppo-c2"]) == 0
    made: Any = Recipe.from_dict(json.loads(capsys.readouterr().out))
    assert made.round == 120_000
    assert made.settings.batch_size * 40 == made.round
    assert (made.env["action_mode"], made.env["frame_skip"]) == ("joint_positions", 3)
    assert command.main(["--plan"]) == 0
    assert "45 trainings, 1,3" in capsys.readouterr().out
