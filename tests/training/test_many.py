"""PPO of rsl-rl: the same files, the same bits, interruptions, and what it is given."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy

from scm_world.env import ScmWorldEnv
from scm_world.errors import UnknownOption, UnreadableFile
from scm_world.evaluation import evaluate
from scm_world.policies import load_policy
from scm_world.training.loop import train
from scm_world.training.recipe import Recipe, recipe, usual_algorithm
from scm_world.training.worlds import make_envs

torch = pytest.importorskip("torch")
pytest.importorskip("rsl_rl")

from scm_world.training.many import ManyPpo  # noqa: E402 # needs the library

SMALL: dict[str, Any] = {
    "worlds": 4,
    "steps": 256,
    "n_steps": 8,
    "batch_size": 16,
    "episode_length": 10,
    "network": {"hidden": [8, 8]},
    "rate": {"schedule": "adaptive"},
    "scale_rewards": True,
    "trials": {"episodes": 1, "times": 2, "protocols": ["P0"], "backend": "fake"},
}
RECIPE = recipe("pushing", "rsl_ppo", **SMALL)
GIVEN: dict[str, Any] = {"backend": "fake", "threads": 1, "seed": 3}


def test_a_training_writes_what_others_write(tmp_path: Path) -> None:
    """A policy that the command evaluates, curves, checkpoints; the same bits again."""
    heard: list[dict[str, float]] = []
    found = train(RECIPE, out=tmp_path / "one", **GIVEN, callback=heard.append)
    assert found.steps == 256
    assert [row["time/total_timesteps"] for row in heard] == [*range(32, 257, 32)]
    assert {"rollout/ep_rew_mean", "evaluation/P0"} <= heard[-1].keys()
    assert {path.stem for path in tmp_path.glob("one/evaluations/*.json")} == {"128", "256"}
    assert found.score == max(
        json.loads(path.read_text())["mean"] for path in tmp_path.glob("one/evaluations/*.json")
    )
    lines = (tmp_path / "one/progress.csv").read_text().splitlines()
    assert "rollout/ep_rew_mean" in lines[0]
    assert "time/total_timesteps" in lines[0]
    assert len(lines) == 1 + 256 // 32
    policy = load_policy(found.best)
    assert policy.about.task == "pushing"
    assert policy.about.card["recipe"]["algo"] == "rsl_ppo"  # type: ignore[index, call-overload]
    assert set(policy.about.card["versions"]) > {"torch", "rsl-rl-lib"}  # type: ignore[arg-type]
    scores = evaluate(policy, "P0", task="pushing", n=2, backend="fake")
    assert len(scores.frame) == 2

    again = train(RECIPE, out=tmp_path / "two", **GIVEN)
    other = train(RECIPE, out=tmp_path / "three", **{**GIVEN, "seed": 4})
    weights = [safetensors.numpy.load_file(one.policy) for one in (found, again, other)]
    assert all(np.array_equal(weights[0][name], weights[1][name]) for name in weights[0])
    assert not np.array_equal(weights[0]["layers.0.weight"], weights[2]["layers.0.weight"])


def test_levels_have_their_gap(tmp_path: Path) -> None:
    """Trials have the scores on the levels and on new draws, as those of other algorithms do."""
    made = RECIPE.but(levels=3, curriculum="P5", steps=128)
    found = train(made, out=tmp_path, **GIVEN)
    trials = [json.loads(one.read_text()) for one in tmp_path.glob("evaluations/*.json")]
    assert found.steps == 128
    assert all(one["gap"] == one["training_levels"] - one["new_draws"] for one in trials)
    assert len(trials) == 2


def test_what_was_killed_goes_on_from_the_last_checkpoint(tmp_path: Path) -> None:
    """With its weights and its scale of rewards; another seed is refused."""
    program = f"""
import json, os
from scm_world.training.loop import train
from scm_world.training.recipe import Recipe
die = lambda done, _: done >= 160 and os.kill(os.getpid(), 9)
made = Recipe.from_dict(json.loads({RECIPE.to_json()!r}))
train(made, out={str(tmp_path / "run")!r}, backend="fake", threads=1, seed=3, progress=die)
"""
    done = subprocess.run([sys.executable, "-c", program], check=False)  # noqa: S603 # ours
    assert done.returncode == -9
    files = (tmp_path / "run/checkpoints").glob("run_*.zip")
    last = max(int(path.stem.split("_")[1]) for path in files)
    assert 0 < last <= 160
    said = list[str]()
    found = train(RECIPE, out=tmp_path / "run", tell=said.append, **GIVEN)
    assert f"goes on after {last:,} steps" in said
    assert found.steps == 256
    assert (tmp_path / f"run/progress-{last}.csv").exists()
    more = train(RECIPE.but(steps=320), out=tmp_path / "run", **GIVEN)
    assert more.steps == 320
    with pytest.raises(UnreadableFile, match="seed"):
        train(RECIPE, out=tmp_path / "run", **{**GIVEN, "seed": 4})

    model = ManyPpo(RECIPE, backend="fake", seed=3, device="cpu", threads=1)
    model.round()
    other = ManyPpo(RECIPE, backend="fake", seed=5, device="cpu", threads=1)
    other.restore(model.state(), model.num_timesteps)
    assert all(torch.equal(a, other.tensors()[name]) for name, a in model.tensors().items())
    assert np.array_equal(model._moments, other._moments)
    assert other.num_timesteps == 32


def test_the_policy_file_has_the_actions_of_the_network() -> None:
    """Fixed scales of the observations are in its weights."""
    model = ManyPpo(RECIPE, backend="fake", seed=0, device="cpu", threads=1)
    policy = model.policy({})
    seen = np.random.default_rng(0).uniform(-1.0, 1.0, (5, policy.n_observed)).astype(np.float32)
    with torch.no_grad():
        wanted = model._actor(model._seen(seen)).clamp(-1.0, 1.0).numpy()
        value = model._critic(model._seen(seen)).numpy()
    np.testing.assert_allclose(policy(seen), wanted, atol=1e-5)
    np.testing.assert_allclose(policy.values(seen), value, atol=1e-5)
    assert model.scale.max() > 1.0


def test_a_critic_can_observe_more_than_the_actor() -> None:
    """The causal parameters reach the value alone; they are not in the policy file."""
    changes = {"observations": "critic", "env.history": 1, "env.context": ["tool_*.mass"]}
    made = RECIPE.but(**changes)
    model = ManyPpo(made, backend="fake", seed=0, device="cpu", threads=1)
    envs = [ScmWorldEnv("pushing", backend="fake", **o) for o in (made.options, made.trained_in)]
    for env in envs:
        env.reset(seed=0)
        env.step(np.full(9, 0.3, np.float32))
    bare, whole = (env.observe()[None] for env in envs)
    assert (made.options["context"], envs[1].appended) == ("none", ("tool_block.mass",))
    envs[1].do({"tool_block.mass": 0.09})
    changed, policy = envs[1].observe()[None], model.policy({})
    with torch.no_grad():
        actions = [model._actor(model._seen(one)).clamp(-1, 1).numpy() for one in (whole, changed)]
        values = [model._critic(model._seen(one)).numpy() for one in (whole, changed)]
    np.testing.assert_allclose(policy(bare), actions[0], atol=1e-5)
    np.testing.assert_array_equal(*actions)
    assert values[0] != values[1]
    assert (policy.value, model.round()["value"] > 0.0) == ((), True)


def test_rewards_are_scaled_and_cut_episodes_have_the_value_of_their_last_observation() -> None:
    """Compared with the environments alone, and with the scale of Stable-Baselines3."""
    running = pytest.importorskip("stable_baselines3.common.running_mean_std")
    made = RECIPE.but(staggered=False)
    model = ManyPpo(made, backend="fake", seed=0, device="cpu", threads=1)
    envs, scale = make_envs(made, backend="fake", threads=1), running.RunningMeanStd(shape=())
    gamma, returns, cut = made.settings.gamma, np.zeros(4), 0
    envs.reset(seed=model._seed)
    model._begin()
    rng = np.random.default_rng(1)
    for _ in range(25):
        actions = rng.uniform(-1.5, 1.5, (4, 9)).astype(np.float32)
        with torch.no_grad():
            seen, earned, over = model._step(torch.as_tensor(actions))
        now, rewards, terminated, truncated, infos = envs.step(np.clip(actions, -1.0, 1.0))
        np.testing.assert_array_equal(seen["seen"].numpy(), now * model.scale)
        returns = returns * gamma + rewards
        scale.update(returns)
        wanted = np.clip(rewards / np.sqrt(scale.var + 1e-8), -10.0, 10.0)
        policy = model.policy({})
        for row in np.flatnonzero(truncated & ~terminated):
            wanted[row] += gamma * policy.values(infos["final_obs"][row])[0]
            cut += 1
        returns[terminated | truncated] = 0.0
        np.testing.assert_array_equal(over.numpy(), terminated | truncated)
        np.testing.assert_allclose(earned.numpy(), wanted, rtol=1e-4, atol=1e-5)
    assert cut == 8
    assert model.over == 8
    assert [one["length"] for one in model.ended] == [10] * 8


def test_a_training_begins_with_a_policy(tmp_path: Path) -> None:
    """Of the same form; another one is refused."""
    found = train(RECIPE, out=tmp_path / "one", **GIVEN)
    slow = RECIPE.but(steps=32, rate={"initial": 1e-12, "schedule": "constant"})
    train(slow, out=tmp_path / "two", start=found.policy, **GIVEN)
    files = (tmp_path / name / "policy.safetensors" for name in ("one", "two"))
    one, two = (load_policy(path).tensors() for path in files)
    assert all(np.allclose(one[name], two[name], atol=1e-6) for name in one)
    other = RECIPE.but(network={"hidden": [9]})
    with pytest.raises(UnreadableFile, match="begin with a policy of the same form"):
        train(other, out=tmp_path / "three", start=found.policy, **GIVEN)


@pytest.mark.parametrize(
    ("changes", "option"),
    [
        ({"critic_warmup": 10}, "critic_warmup with rsl_ppo"),
        ({"target_kl": 0.1}, "target_kl of PPO with rsl_ppo"),
        ({"clip_range_vf": 0.3}, "clip_range_vf with rsl_ppo"),
        ({"normalize_advantage": False}, "normalize_advantage with rsl_ppo"),
        ({"batch_size": 7}, "batch_size with rsl_ppo"),
        ({"hindsight": True}, "hindsight with PPO"),
    ],
)
def test_what_the_library_does_not_have_is_refused(changes: Any, option: str) -> None:
    """When the recipe is made."""
    with pytest.raises(UnknownOption) as refused:
        RECIPE.but(**changes)
    assert refused.value.option == option


def test_the_usual_algorithm_follows_from_the_engine() -> None:
    """Engines with threads have few worlds."""
    assert usual_algorithm(None) == usual_algorithm("mujoco") == usual_algorithm("fake") == "ppo"
    made = Recipe.from_dict(RECIPE.as_dict())
    assert made == RECIPE
    assert "RSL_PPO on pushing" in str(made)
