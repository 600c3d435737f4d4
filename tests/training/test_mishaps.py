"""Training with Stable-Baselines3: crashes at bad moments, and settings that lead nowhere."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world.errors import Diverged, UnknownOption
from scm_world.evaluation.policies.weights import load_policy
from scm_world.training import export, watching
from scm_world.training.checkpoints import checkpoints
from scm_world.training.curves import read_curve
from scm_world.training.loop import named, train
from scm_world.training.recipe import Recipe, recipe

sb3 = pytest.importorskip("stable_baselines3")

SMALL: dict[str, Any] = {
    "worlds": 4,
    "steps": 128,
    "env": {"max_episode_length": 10},
    "network": {"hidden": [8], "log_std_end": None},
    "trials": {"protocols": []},
}
PPO = recipe("pushing", **SMALL, n_steps=8, batch_size=16)
OFF: dict[str, Any] = {
    **SMALL,
    "batch_size": 16,
    "learning_starts": 40,
    "buffer_size": 120,
    "gradient_steps": 1,
}
TRIALS = {"trials.protocols": ["P0"], "trials.episodes": 1, "trials.times": 2}


class Killed(BaseException):
    """The power is gone."""


def run(made: Recipe, out: Path, **options: Any) -> Any:
    """Train a little."""
    return train(made, **{"out": out, "backend": "fake", "threads": 1, "seed": 3, **options})


def test_a_crash_after_the_last_checkpoint_loses_no_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The policy in the folder is the one at the end, also if nothing is left to do."""
    write = watching.write_checkpoint

    def fatal(*given: Any) -> None:
        write(*given)
        raise Killed

    monkeypatch.setattr(watching, "write_checkpoint", fatal)
    with pytest.raises(Killed):
        run(PPO, tmp_path / "run")
    monkeypatch.undo()
    assert run(PPO, tmp_path / "run").steps == 128


def test_a_longer_training_is_evaluated_as_often_as_one_that_was_long_at_once(
    tmp_path: Path,
) -> None:
    """What was evaluated in the shorter one does not count."""
    made = PPO.but(**TRIALS)
    run(made, tmp_path / "run", steps=64)
    run(made, tmp_path / "run")
    found = {path.stem for path in (tmp_path / "run" / "evaluations").iterdir()}
    assert found == {"32", "64", "128"}


def test_the_learning_rate_waits_for_the_policy(tmp_path: Path) -> None:
    """While only the value is learned the policy does not diverge, and that says nothing."""
    rate = {"schedule": "adaptive", "initial": 1e-3, "target_kl": 10.0}
    made = PPO.but(critic_warmup=96, rate=rate)
    run(made, tmp_path / "run")
    rows = read_curve(tmp_path / "run" / "progress.csv")
    assert [row["learning_rate"] for row in rows[:3]] == [1e-3] * 3
    assert rows[-1]["learning_rate"] == pytest.approx(1.5e-3)


@pytest.mark.parametrize("change", [{"network.log_std": 1_000.0}, {"rate.initial": 1e12}])
def test_divergence_within_a_round_is_told(change: dict[str, float], tmp_path: Path) -> None:
    """Deviations that are infinite, and steps that are far too long."""
    with pytest.raises(Diverged, match="lower learning rate"):
        run(PPO.but(**change), tmp_path / "run")


def test_other_errors_are_not_taken_for_divergence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They say themselves what they are."""

    def wrong(*_: Any) -> None:
        raise ValueError("something else")

    monkeypatch.setattr(watching.Watching, "round", wrong)
    with pytest.raises(ValueError, match="something else"):
        run(PPO, tmp_path / "run")


def test_seeds_are_those_of_the_library(tmp_path: Path) -> None:
    """Larger ones are refused before a folder is made."""
    with pytest.raises(UnknownOption, match="from 0 to 4294967295"):
        run(PPO, tmp_path / "run", seed=2**32)
    assert not (tmp_path / "run").exists()


def test_what_is_never_learned_is_told(tmp_path: Path) -> None:
    """More random steps than there are steps."""
    said: list[str] = []
    made = recipe("pushing", "sac", **{**OFF, "learning_starts": 5_000})
    run(made, tmp_path / "run", tell=said.append)
    assert said == ["nothing will be learned: learning starts after 5,000 steps"]


def test_an_old_memory_is_forgotten_with_its_checkpoints(tmp_path: Path) -> None:
    """Who removes all checkpoints begins anew, with nothing of before in the buffer."""
    made, folder = recipe("pushing", "sac", **OFF), tmp_path / "run"
    run(made, folder)
    shutil.rmtree(folder / "checkpoints")
    (stale,) = (folder / "replay").iterdir()
    stale.write_bytes(b"old")
    run(made, folder, every=0.0)
    assert all(path.read_bytes() != b"old" for path in (folder / "replay").iterdir())
    assert checkpoints(folder / "checkpoints")[-1].name == "128"
    run(made, folder, steps=160)


def test_targets_begin_with_the_policy_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """TD3 asks another actor what would be done next: it is the same in the beginning."""
    made = recipe("pushing", "td3", **OFF)
    given = run(made, tmp_path / "first").policy
    models: list[Any] = []
    begin = export.begin_with
    monkeypatch.setattr(
        "scm_world.training.loop.begin_with",
        lambda model, *rest: (begin(model, *rest), models.append(model), _compare(model)),
    )
    run(made, tmp_path / "second", start=given)
    assert models


def _compare(model: Any) -> None:
    wanted = model.actor.state_dict()
    for name, tensor in model.actor_target.state_dict().items():
        np.testing.assert_array_equal(tensor.numpy(), wanted[name].numpy())


def test_a_beginning_that_does_not_fit_spoils_no_folder(tmp_path: Path) -> None:
    """The right one has its place there afterwards."""
    given = run(PPO, tmp_path / "first")
    other = run(PPO.but(**{"network.hidden": [9]}), tmp_path / "other").policy
    with pytest.raises(ValueError, match="shape"):
        run(PPO, tmp_path / "second", start=other)
    run(PPO, tmp_path / "second", start=given.folder)
    card = load_policy(tmp_path / "second" / "policy.safetensors").about.card
    assert card["start"] == json.loads((tmp_path / "second" / "run.json").read_text())["start"]


def test_beginnings_have_names(tmp_path: Path) -> None:
    """A file, a folder of a run, or one of the zoo."""
    assert named(tmp_path / "one.safetensors") == tmp_path / "one.safetensors"
    (tmp_path / "best.safetensors").write_bytes(b"")
    assert named(tmp_path) == tmp_path / "best.safetensors"
    with pytest.raises(UnknownOption, match="policy of the zoo"):
        named("zoo:nothing-of-this-name")
