"""Training with Stable-Baselines3: policies, interruptions, the same bits."""

from __future__ import annotations

import errno
import json
import shutil
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import safetensors.numpy

from scm_world.errors import Diverged, ScmWorldError, UnreadableFile, UnwritableFolder
from scm_world.evaluation.policies.weights import load_policy, save_policy
from scm_world.training import checkpoints as on_disk
from scm_world.training.checkpoints import checkpoints, read_checkpoint
from scm_world.training.curves import read_curve
from scm_world.training.learners import LearningRate
from scm_world.training.loop import train
from scm_world.training.recipe import Recipe, recipe
from scm_world.training.settings import Rate
from scm_world.training.watching import Watching

sb3 = pytest.importorskip("stable_baselines3")

SMALL: dict[str, Any] = {
    "worlds": 4,
    "env": {"max_episode_length": 10, "delta_scale": 0.1},
    "network": {"hidden": [8, 8], "log_std_end": None},
    "trials": {"episodes": 1, "times": 2, "protocols": ["P0"]},
}
OFF: dict[str, Any] = {
    **SMALL,
    "steps": 240,
    "batch_size": 16,
    "learning_starts": 60,
    "buffer_size": 120,
    "gradient_steps": 1,
}
RECIPES: dict[str, Recipe] = {
    "ppo": recipe(
        "pushing",
        **SMALL,
        steps=256,
        n_steps=8,
        batch_size=16,
        rate={"schedule": "adaptive"},
        scale_rewards=True,
        critic_warmup=64,
    ),
    "sac": recipe("pushing", "sac", **OFF),
    "td3": recipe("pushing", "td3", **OFF),
    "hindsight": recipe("pushing", "sac", **OFF, hindsight=True),
}


class Killed(BaseException):
    """The power is gone."""


def run(name: str, out: Path, **options: Any) -> Any:
    """Train a little."""
    given = {"out": out, "backend": "fake", "threads": 1, "seed": 3, **options}
    return train(RECIPES[name], **given)


def final(folder: Path) -> Any:
    """Read the last checkpoint."""
    return read_checkpoint(checkpoints(folder / "checkpoints")[-1])


def killed(monkeypatch: pytest.MonkeyPatch, after: int) -> None:
    """Let the power go after so many checkpoints."""
    keep, count = Watching.keep, iter(range(1, 10_000))

    def kept(self: Watching, model: Any) -> Any:
        found = keep(self, model)
        if next(count) == after:
            raise Killed
        return found

    monkeypatch.setattr(Watching, "keep", kept)


@pytest.mark.parametrize("name", RECIPES)
def test_an_interruption_leaves_no_trace(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is learned in pieces is, bit for bit, what is learned at once."""
    whole, pieces = tmp_path / "whole", tmp_path / "pieces"
    run(name, whole)
    for after in (2, 2, 1):
        killed(monkeypatch, after)
        with pytest.raises(Killed):
            run(name, pieces, every=0.0)
        monkeypatch.undo()
    run(name, pieces)
    one, other = final(whole), final(pieces)
    assert one.tensors.keys() == other.tensors.keys()
    for key, array in one.tensors.items():
        np.testing.assert_array_equal(array, other.tensors[key], err_msg=key)
    timed = ("watching",)
    assert {k: v for k, v in one.state.items() if k not in timed} == {
        k: v for k, v in other.state.items() if k not in timed
    }
    for file in ("policy.safetensors", "best.safetensors"):
        first, second = (safetensors.numpy.load_file(p / file) for p in (whole, pieces))
        for key, array in first.items():
            np.testing.assert_array_equal(array, second[key])
    rows, others = (read_curve(p / "progress.csv") for p in (whole, pieces))
    drop = ("wall_s", "cpu_s")
    assert len(rows) > 3
    np.testing.assert_equal(
        [{k: v for k, v in row.items() if k not in drop} for row in rows],
        [{k: v for k, v in row.items() if k not in drop} for row in others],
    )


@pytest.mark.parametrize("name", RECIPES)
def test_the_policy_file_acts_as_the_model(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On observations of every size."""
    models: list[Any] = []
    keep = Watching.keep
    monkeypatch.setattr(Watching, "keep", lambda s, m: (models.append(m), keep(s, m))[1])
    found = run(name, tmp_path / "run")
    model, policy = models[-1], load_policy(found.policy)
    rng, space = np.random.default_rng(0), model.observation_space

    def draw(part: Any) -> Any:
        return rng.normal(0, 0.5, (32, *part.shape)).astype(part.dtype)

    is_dict = isinstance(space, gymnasium.spaces.Dict)
    seen = {key: draw(part) for key, part in space.items()} if is_dict else draw(space)
    wanted = model.predict(seen, deterministic=True)[0]
    np.testing.assert_allclose(policy(seen), wanted, atol=1e-6)
    assert np.ptp(wanted) > 0.01
    assert policy.about.task == "pushing"
    assert policy.about.card["steps"] == found.steps == model.num_timesteps
    assert (policy.about.inputs is not None) == is_dict


def test_a_run_is_whole(tmp_path: Path) -> None:
    """Everything is in its place; the same call again does nothing."""
    said: list[str] = []
    told: list[tuple[int, int]] = []
    folder = tmp_path / "run"
    found = run("ppo", folder, tell=said.append, progress=lambda *given: told.append(given))
    assert {path.name for path in folder.iterdir()} == {
        "best.safetensors",
        "checkpoints",
        "evaluations",
        "policy.safetensors",
        "progress.csv",
        "run.json",
        "tensorboard",
    }
    assert json.loads((folder / "run.json").read_text())["versions"]["stable-baselines3"]
    assert Recipe.from_dict(json.loads((folder / "run.json").read_text())["recipe"])
    assert [path.name for path in sorted((folder / "evaluations").iterdir())] == [
        "128.json",
        "256.json",
    ]
    assert told[-1][1] == 256
    assert said[-1].startswith("256 steps: P0")
    before = found.policy.read_bytes()
    again = run("ppo", folder)
    assert (again, again.policy.read_bytes()) == (found, before)


def test_one_training_is_not_another(tmp_path: Path) -> None:
    """Another seed learns something else, and has no place in the same folder."""
    run("ppo", tmp_path / "one"), run("ppo", tmp_path / "two", seed=4)
    one, two = (load_policy(tmp_path / name / "policy.safetensors") for name in ("one", "two"))
    assert not np.array_equal(one.layers[0].weight, two.layers[0].weight)
    with pytest.raises(UnreadableFile, match="seed is 3 there, and 4"):
        run("ppo", tmp_path / "one", seed=4)


def test_a_training_becomes_longer(tmp_path: Path) -> None:
    """It is, bit for bit, the long one; not where the learning rate knows the length."""
    run("ppo", tmp_path / "once"), run("ppo", tmp_path / "longer", steps=128)
    found = run("ppo", tmp_path / "longer")
    one, other = (
        load_policy(tmp_path / name / "policy.safetensors") for name in ("once", "longer")
    )
    assert found.steps == 256
    for mine, yours in zip(one.layers, other.layers, strict=True):
        np.testing.assert_array_equal(mine.weight, yours.weight)
    with pytest.raises(UnreadableFile, match="steps is 256 there, and 128"):
        run("ppo", tmp_path / "longer", steps=128)
    for name, value in {"rate.schedule": "linear", "network.log_std_end": -3.0}.items():
        line = RECIPES["ppo"].but(**{name: value, "steps": 64})
        options: dict[str, Any] = {"out": tmp_path / name, "backend": "fake"}
        train(line, **options)
        with pytest.raises(UnreadableFile, match="steps is 64 there, and 128"):
            train(line, steps=128, **options)


def test_weights_that_are_no_numbers_end_a_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was kept before is still there."""
    look = Watching.round

    def poisoned(self: Watching, model: Any) -> None:
        if model.num_timesteps == 64:
            model.policy.action_net.bias.data[0] = float("nan")
        look(self, model)

    monkeypatch.setattr(Watching, "round", poisoned)
    with pytest.raises(Diverged, match="after 64 steps"):
        run("ppo", tmp_path / "run", every=0.0)
    assert final(tmp_path / "run").steps == 32


def test_other_versions_are_told(tmp_path: Path) -> None:
    """They may have other last bits."""
    run("ppo", tmp_path / "run")
    about = tmp_path / "run" / "run.json"
    data = json.loads(about.read_text())
    data["versions"]["numpy"] = "1.0"
    about.write_text(json.dumps(data))
    said: list[str] = []
    run("ppo", tmp_path / "run", tell=said.append)
    assert said[0].startswith("numpy was 1.0 and is")


def test_the_value_is_learned_alone_at_first(tmp_path: Path) -> None:
    """During the warm-up of the critic the policy stays as it is."""
    made = RECIPES["ppo"].but(critic_warmup=1_000, steps=64)
    given: dict[str, Any] = {"backend": "fake", "threads": 1}
    one = load_policy(train(made, out=tmp_path / "one", **given).policy)
    two = load_policy(train(made, out=tmp_path / "two", steps=256, **given).policy)
    np.testing.assert_array_equal(one.layers[0].weight, two.layers[0].weight)
    np.testing.assert_array_equal(one.log_std, two.log_std)
    assert not np.array_equal(one.value[0].weight, two.value[0].weight)


@pytest.mark.parametrize("name", ["ppo", "sac", "td3"])
def test_training_begins_with_a_policy(name: str, tmp_path: Path) -> None:
    """Its weights are those of the first round; it is part of what the run is."""
    given = run(name, tmp_path / "first").policy
    made = RECIPES[name].but(**{"rate.initial": 1e-12, "rate.schedule": "constant"})
    options: dict[str, Any] = {"backend": "fake", "threads": 1, "start": given}
    found = load_policy(train(made, out=tmp_path / "second", **options).policy)
    wanted = load_policy(given)
    for mine, yours in zip(found.layers, wanted.layers, strict=True):
        np.testing.assert_allclose(mine.weight, yours.weight, atol=1e-6)
    with pytest.raises(UnreadableFile, match="start is"):
        train(made, out=tmp_path / "second", **{**options, "start": None})


def test_beginnings_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    """Other networks, other observations, no policy; nothing is left in the folder."""
    given = run("ppo", tmp_path / "first").policy
    options: dict[str, Any] = {"out": tmp_path / "second", "backend": "fake", "start": given}
    for made, said in (
        (RECIPES["ppo"].but(**{"network.hidden": [9, 8]}), "shape of layers.0"),
        (RECIPES["ppo"].but(**{"env.delta_scale": 0.2}), "delta_scale is 0.1 there and 0.2"),
        (RECIPES["sac"], "output"),
    ):
        with pytest.raises(UnreadableFile, match=said):
            train(made, **options)
        assert not (tmp_path / "second").exists()
    for start in (tmp_path / "nothing", tmp_path / "first" / "run.json"):
        with pytest.raises(UnreadableFile, match=start.name):
            train(RECIPES["ppo"], **{**options, "start": start})
        assert not (tmp_path / "second").exists()


def test_damaged_checkpoints_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cut file, and tensors of another network; without it the one before is taken."""
    folder = tmp_path / "run"
    killed(monkeypatch, 3)
    with pytest.raises(Killed):
        run("ppo", folder, every=0.0)
    monkeypatch.undo()
    last = checkpoints(folder / "checkpoints")[-1]
    whole = read_checkpoint(last)
    tensors = {**whole.tensors, "network/log_std": np.zeros(4, np.float32)}
    for wrong in (tensors, {k: v for k, v in tensors.items() if k != "network/log_std"}):
        on_disk.write_checkpoint(last.parent, on_disk.Checkpoint(whole.steps, wrong, whole.state))
        with pytest.raises(UnreadableFile, match="another training"):
            run("ppo", folder)
    (last / "tensors.safetensors").write_bytes(b"short")
    with pytest.raises(UnreadableFile, match="remove this folder"):
        run("ppo", folder)
    shutil.rmtree(last)
    assert run("ppo", folder).steps == 256


def test_a_missing_part_of_the_memory_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A training cannot go on without what it remembers."""
    folder = tmp_path / "run"
    killed(monkeypatch, 20)
    with pytest.raises(Killed):
        run("sac", folder, every=0.0)
    monkeypatch.undo()
    parts = sorted((folder / "replay").iterdir(), key=lambda p: int(p.stem.split("-")[0]))
    kept = parts[10].read_bytes()
    parts[10].write_bytes(kept[:-9])
    with pytest.raises(UnreadableFile, match="damaged"):
        run("sac", folder)
    parts[10].unlink()
    with pytest.raises(UnreadableFile, match="are missing"):
        run("sac", folder)


def test_a_full_disk_ends_the_training_with_the_last_checkpoint_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error says what to do, and the same call goes on."""
    folder = tmp_path / "run"
    killed(monkeypatch, 2)
    with pytest.raises(Killed):
        run("ppo", folder, every=0.0)
    monkeypatch.undo()

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("scm_world.output.durable.os.fsync", full)
    with pytest.raises(UnwritableFolder, match="No space left"):
        run("ppo", folder, every=0.0)
    monkeypatch.undo()
    assert run("ppo", folder).steps == 256


def test_ctrl_c_writes_a_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The present round is finished first; the same call goes on."""
    import signal

    look = Watching.round

    def interrupted(self: Watching, model: Any) -> None:
        if model.num_timesteps == 96:
            signal.raise_signal(signal.SIGINT)
        look(self, model)

    monkeypatch.setattr(Watching, "round", interrupted)
    said: list[str] = []
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        run("ppo", tmp_path / "run", tell=said.append)
    monkeypatch.undo()
    assert signal.getsignal(signal.SIGINT) is before
    assert "Ctrl-C again stops at once" in said[0]
    assert final(tmp_path / "run").steps == 96
    run("ppo", tmp_path / "run", tell=said.append)
    assert "goes on after 96 steps" in said


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"steps": 0}, "steps"),
    ({"steps": 10}, "at least 32"),
    ({"steps": "many"}, "many"),
    ({"seed": -1}, "seed"),
    ({"threads": 0}, "threads"),
    ({"backend": "fakes"}, "fake"),
    ({"device": "tpu"}, "tpu"),
]


@pytest.mark.parametrize(("given", "said"), WRONG)
def test_what_cannot_be_trained_is_refused(
    given: dict[str, Any], said: str, tmp_path: Path
) -> None:
    """Before anything is written."""
    with pytest.raises(ScmWorldError, match=said):
        run("ppo", tmp_path / "run", **given)
    assert not (tmp_path / "run").exists()


def test_learning_rates() -> None:
    """Constant, falling in a line, and following the divergence between bounds."""
    assert LearningRate(Rate(initial=0.5))(0.1) == 0.5
    line = LearningRate(Rate(initial=1.0, schedule="linear", final=0.5))
    assert [line(left) for left in (1.0, 0.5, 0.0, -0.1)] == [1.0, 0.75, 0.5, 0.5]
    kept = Rate(initial=0.1, schedule="adaptive", target_kl=0.01, lowest=0.05, highest=0.12)
    rate = LearningRate(kept)
    found = []
    for divergence in (0.01, 0.001, 0.03, 0.03, 0.03):
        rate.adapt(divergence)
        found.append(round(rate(0.5), 4))
    assert found == [0.1, 0.12, 0.08, 0.0533, 0.05]


def test_training_begins_with_a_bare_policy(tmp_path: Path) -> None:
    """A policy file without values or deviations is a beginning, too."""
    policy = load_policy(run("ppo", tmp_path / "first").policy)
    bare = {k: v for k, v in policy.tensors().items() if k.startswith("layers")}
    start = save_policy(tmp_path / "bare.safetensors", bare, policy.about)
    made = RECIPES["ppo"].but(**{"network.log_std": -1.5, "rate.initial": 1e-12})
    options: dict[str, Any] = {"backend": "fake", "threads": 1, "start": start}
    found = load_policy(train(made, out=tmp_path / "second", **options).policy)
    np.testing.assert_allclose(found.log_std, -1.5, atol=1e-5)
    np.testing.assert_allclose(found.layers[0].weight, policy.layers[0].weight, atol=1e-6)
