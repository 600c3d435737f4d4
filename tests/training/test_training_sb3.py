"""Many worlds for Stable-Baselines3."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from typer.testing import CliRunner

import scm_world  # noqa: F401 # registers the environments
from scm_world.cli.app import app
from scm_world.errors import ModelError, UnknownOption, UnreadableFile
from scm_world.evaluation import evaluate
from scm_world.policies import load_policy, save_policy

sb3 = pytest.importorskip("stable_baselines3")
torch = pytest.importorskip("torch")

from scm_world.training.export import export_sb3  # noqa: E402 # needs the library
from scm_world.training.sb3 import Sb3VecEnv, make_sb3  # noqa: E402 # needs the library

PUSHING = "scm_world/Pushing-v0"
GOALS: dict[str, Any] = {"goal_env": True, "task_options": {"weights": "sparse"}}


def both(n: int = 4, **options: Any) -> tuple[Any, Any]:
    """Make many worlds, and Stable-Baselines3's own kind of as many."""
    workers = options.pop("workers", 1)
    options = {"backend": "fake", "max_episode_length": 5, **options}
    mine = make_sb3(PUSHING, n, infos=None, workers=workers, **options)
    make = [lambda: gymnasium.make(PUSHING, **options)] * n
    return mine, sb3.common.vec_env.DummyVecEnv(make)


def check_equal(mine: Any, other: Any) -> None:
    """Assert that two things are equal, all the way down."""
    if isinstance(mine, dict):
        assert mine.keys() == other.keys()
        for name in mine:
            check_equal(mine[name], other[name])
    elif isinstance(mine, list | tuple):
        for one, two in zip(mine, other, strict=True):
            check_equal(one, two)
    else:
        np.testing.assert_array_equal(mine, other)
        assert np.asarray(mine).dtype == np.asarray(other).dtype


@pytest.mark.parametrize(
    ("options", "workers"), [({}, 1), (GOALS, 1), (GOALS, 2)], ids=["vector", "goals", "processes"]
)
def test_it_says_what_its_own_kind_says(options: dict[str, Any], workers: int) -> None:
    """Observations, rewards, flags and infos, over the ends of episodes, value by value."""
    mine, other = both(workers=workers, **options)
    assert isinstance(mine, sb3.common.vec_env.VecEnv)
    assert mine.observation_space == other.observation_space
    assert mine.action_space == other.action_space
    assert mine.seed(3) == other.seed(3)
    wishes: list[Any] = [{"do": {"floor_friction": 0.4}}, {}, {"episode": 3}, {}]
    for envs in (mine, other):
        envs.set_options(wishes)
    for _ in range(2):
        check_equal(mine.reset(), other.reset())
        check_equal(mine.reset_infos, other.reset_infos)
        for action in np.random.default_rng(0).uniform(-1, 1, (12, 4, 9)).astype(np.float32):
            check_equal(mine.step(action), other.step(action))
            check_equal(mine.reset_infos, other.reset_infos)
        for envs in (mine, other):
            envs.seed(8)
    mine.close()


def test_worlds_can_be_asked_one_by_one() -> None:
    """Attributes and methods of some of them."""
    mine, other = both(**GOALS)
    mine.seed(0)
    shown = mine.reset()
    assert mine.get_attr("limit", 1) == other.get_attr("limit", 1)
    assert mine.has_attr("compute_reward")
    assert not mine.has_attr("no_such_name")
    goals = shown["achieved_goal"], shown["desired_goal"]
    found = mine.env_method("compute_reward", *goals, [{}] * 4, indices=[0])
    check_equal(found, other.env_method("compute_reward", *goals, [{}] * 4, indices=[0]))
    mine.set_attr("remark", "some", indices=[1, 3])
    assert mine.get_attr("remark", [3, -3]) == ["some", "some"]
    assert mine.env_is_wrapped(gymnasium.Wrapper) == [False] * 4
    mine.worlds.do({2: {"floor_friction": 0.3}})
    assert [len(done) for done in mine.get_attr("interventions")] == [0, 0, 1, 0]


def test_worlds_in_processes_do_the_same() -> None:
    """What changes a world is called in all of them; what is read is read of some."""
    envs, _ = both(2, workers=2, **GOALS)
    envs.seed(0)
    shown = envs.reset()
    assert envs.get_attr("reward_scale", 1) == [1.0]
    goals = shown["achieved_goal"], shown["desired_goal"]
    assert envs.env_method("compute_reward", *goals, [{}] * 2, indices=[0])[0].shape == (2,)
    with pytest.raises(UnknownOption, match="workers=1"):
        envs.env_method("do", {"floor_friction": 0.3}, indices=[0])
    envs.env_method("do", {"floor_friction": 0.3})
    assert [len(done) for done in envs.get_attr("interventions")] == [1, 1]
    envs.close()


def test_pictures_are_put_side_by_side() -> None:
    """``render`` tiles them, as with its own kind."""
    mine, other = both(2, render_mode="rgb_array")
    for envs in (mine, other):
        envs.seed(0)
        envs.reset()
    check_equal(mine.render(), other.render())


def test_infos_are_as_short_as_they_may_be() -> None:
    """Only what is asked for is told at every step; what ends an episode always is."""
    envs = make_sb3(PUSHING, 2, backend="fake", max_episode_length=2)
    envs.reset()
    still = np.zeros((2, 9), np.float32)
    *_, told = envs.step(still)
    assert told == [{"is_success": False, "TimeLimit.truncated": False}] * 2
    *_, told = envs.step(still)
    assert told[0].keys() == {"is_success", "TimeLimit.truncated", "terminal_observation"}
    more = Sb3VecEnv(envs.worlds, infos=("fractional_success", "reward_terms"))
    more.reset()
    *_, told = more.step(still)
    assert told[0].keys() == {"fractional_success", "reward_terms", "TimeLimit.truncated"}


def test_what_it_cannot_adapt_is_refused() -> None:
    """Another autoreset mode, worlds of another kind, and infos that nobody tells."""
    with pytest.raises(UnknownOption, match="SameStep"):
        Sb3VecEnv(gymnasium.make_vec(PUSHING, 2, backend="fake"))
    how: dict[str, Any] = {"vectorization_mode": "sync"}
    how["vector_kwargs"] = {"autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP}
    others = gymnasium.make_vec("CartPole-v1", 2, **how)
    with pytest.raises(UnknownOption, match="make_vec"):
        Sb3VecEnv(others)
    with pytest.raises(UnknownOption, match="is_success"):
        make_sb3(PUSHING, 2, infos=["success_rate"], backend="fake")


def test_it_learns_and_counts_episodes() -> None:
    """PPO with its own statistics, and SAC with hindsight."""
    options: dict[str, Any] = {"backend": "fake", "max_episode_length": 8}
    envs = sb3.common.vec_env.VecMonitor(make_sb3(PUSHING, 4, **options))
    model = sb3.PPO("MlpPolicy", envs, n_steps=16, batch_size=32, n_epochs=1, seed=0)
    model.learn(128)
    assert len(model.ep_info_buffer) == len(model.ep_success_buffer) == 16
    assert {info["l"] for info in model.ep_info_buffer} == {8}
    envs = make_sb3(PUSHING, 4, **options, **GOALS)
    replay = sb3.HerReplayBuffer
    sac = sb3.SAC("MultiInputPolicy", envs, replay_buffer_class=replay, learning_starts=40, seed=0)
    sac.learn(56)
    assert sac.replay_buffer.size() == 14


# --- what others can use ----------------------------------------------------------------------

RELATIVE: dict[str, Any] = {
    "backend": "fake",
    "action_mode": "delta_joint_positions",
    "delta_scale": 0.1,
    "max_episode_length": 4,
}


def small(**network: Any) -> dict[str, Any]:
    """Give arguments of a small model, which algorithms change."""
    return {"policy_kwargs": {"net_arch": [8], **network}, "device": "cpu", "seed": 0}


@pytest.mark.parametrize("algo", ["PPO", "A2C", "SAC", "TD3", "RecurrentPPO"])
def test_models_become_policy_files(algo: str, tmp_path: Path) -> None:
    """They act as the models, in the environment of the training, wherever they are named."""
    env = gymnasium.make("scm_world/Pushing-v0", **RELATIVE)
    if algo == "RecurrentPPO":
        contrib = pytest.importorskip("sb3_contrib")
        model = contrib.RecurrentPPO("MlpLstmPolicy", env, **small(lstm_hidden_size=4))
    else:
        model = getattr(sb3, algo)("MlpPolicy", env, **small())
    path = export_sb3(model, env, tmp_path / "mine.safetensors", note="random")
    policy = load_policy(path)
    assert policy.about.option("action_mode") == "delta_joint_positions"
    assert (policy.about.task, policy.about.card["note"]) == ("pushing", "random")
    seen = np.stack([env.observation_space.sample() for _ in range(5)])
    wanted = model.predict(seen, deterministic=True)[0]
    np.testing.assert_allclose(policy.predict(seen)[0], wanted, atol=1e-5)
    scores = [
        evaluate(one, "P5", n=2, backend="fake", env={"max_episode_length": 4}).frame["return"]
        for one in (model, path)
    ]
    np.testing.assert_allclose(*scores, rtol=1e-3)


def test_models_that_are_no_policy_file_are_refused(tmp_path: Path) -> None:
    """With what to do; nothing is written."""
    env = gymnasium.make("scm_world/Pushing-v0", **RELATIVE)
    model = sb3.PPO("MlpPolicy", env, **small())
    other = gymnasium.make("scm_world/Pushing-v0", backend="fake", keypoints="view")
    with pytest.raises(UnknownOption, match="as the model observes"):
        export_sb3(model, other, tmp_path / "mine.safetensors")
    with pytest.raises(UnknownOption, match="environment of a policy"):
        export_sb3(model, gymnasium.make("CartPole-v1"), tmp_path / "mine.safetensors")
    for wrong in (3, env, model.policy):
        with pytest.raises(UnknownOption, match="a model of Stable-Baselines3"):
            export_sb3(wrong, env, tmp_path / "mine.safetensors")
    odd = sb3.PPO("MlpPolicy", env, **small(activation_fn=torch.nn.ELU))
    with pytest.raises(ModelError, match="Tanh or ReLU"):
        export_sb3(odd, env, tmp_path / "mine.safetensors")
    vector = sb3.common.vec_env.DummyVecEnv([lambda: env])
    scaled = sb3.common.vec_env.VecNormalize(vector, clip_obs=0.5)
    with pytest.raises(ModelError, match=r"wrapper VecNormalize cuts numbers off at 0\.5"):
        export_sb3(sb3.PPO("MlpPolicy", scaled, **small()), scaled, tmp_path / "mine.safetensors")
    assert not [*tmp_path.iterdir()]


class Shaped(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Changes the reward only, and counts its steps."""

    steps = 0

    def step(self, action: Any) -> Any:
        """Double the reward."""
        self.steps += 1
        seen, reward, *rest = self.env.step(action)
        return seen, 2.0 * reward, *rest


def normalized(env: Any) -> Any:
    """Normalise by running means, which this file then knows."""
    return gymnasium.wrappers.NormalizeObservation(env)


def linear(env: Any) -> Any:
    """Show ten numbers, some of them mixed."""
    space = gymnasium.spaces.Box(-9.0, 9.0, (10,), np.float32)
    return gymnasium.wrappers.TransformObservation(env, mixed, space)


def mixed(seen: Any) -> Any:
    """Return what ``linear`` shows."""
    return (2.0 * seen[..., :10] - seen[..., 20:30] + 0.5).astype(np.float32)


def bent(env: Any) -> Any:
    """Show numbers that are no linear map."""
    return gymnasium.wrappers.TransformObservation(env, np.tanh, env.observation_space)


def direct(env: Any, raw: Any) -> Any:
    """Compute what wrappers show, by their formulas."""
    if isinstance(env, sb3.common.vec_env.VecEnv):
        means = env.obs_rms
        return ((raw - means.mean) / np.sqrt(means.var + env.epsilon)).astype(np.float32)
    if isinstance(env, gymnasium.wrappers.NormalizeObservation):
        means = env.obs_rms
        inner = direct(env.env, raw)
        return ((inner - means.mean) / np.sqrt(means.var + env.epsilon)).astype(np.float32)
    return mixed(raw) if isinstance(env, gymnasium.wrappers.TransformObservation) else raw


KEPT: dict[str, Any] = {
    "running means": normalized,
    "a linear map": linear,
    "both": lambda env: normalized(linear(env)),
    "of many": lambda env: sb3.common.vec_env.VecNormalize(
        sb3.common.vec_env.DummyVecEnv([lambda: env]), clip_obs=np.inf
    ),
    "nothing": lambda env: Shaped(gymnasium.wrappers.RescaleAction(env, *np.float32([-1.0, 1.0]))),
}


@pytest.mark.parametrize("kind", KEPT)
def test_running_means_and_linear_maps_are_kept(kind: str, tmp_path: Path) -> None:
    """A file, and the model in an evaluation, act on raw observations as the model did on these."""
    raw = gymnasium.make(PUSHING, **RELATIVE)
    env = KEPT[kind](raw)
    model = sb3.PPO("MlpPolicy", env, n_steps=16, batch_size=16, **small()).learn(64)
    before = raw.unwrapped.world.index, getattr(env, "steps", 0)  # type: ignore[attr-defined]
    policy = load_policy(export_sb3(model, env, tmp_path / "mine.safetensors"))
    assert before == (raw.unwrapped.world.index, getattr(env, "steps", 0))  # type: ignore[attr-defined]
    seen = np.stack([raw.observation_space.sample() for _ in range(20)])
    wanted = model.predict(direct(env, seen), deterministic=True)[0]
    np.testing.assert_allclose(policy(seen), wanted, atol=2e-4)
    how: Any = {"n": 1, "backend": "fake", "env": {"max_episode_length": 4}}
    scores = [evaluate(one, "P5", **how).frame["return"] for one in (model, policy)]
    np.testing.assert_allclose(*scores, rtol=1e-3)


REFUSED: dict[str, Any] = {
    "TransformObservation changes observations, and not linearly": bent,
    "FrameStackObservation changes observations": lambda env: gymnasium.wrappers.FlattenObservation(
        gymnasium.wrappers.FrameStackObservation(env, 2)
    ),
    "DelayObservation changes observations": lambda env: gymnasium.wrappers.DelayObservation(
        env, delay=2
    ),
    "TransformAction changes actions": lambda env: gymnasium.wrappers.TransformAction(
        env, np.negative, env.action_space
    ),
    "VecFrameStack is not known": lambda env: sb3.common.vec_env.VecFrameStack(
        sb3.common.vec_env.DummyVecEnv([lambda: env]), 2
    ),
}


@pytest.mark.parametrize("why", REFUSED)
def test_other_wrappers_are_refused_by_name(why: str, tmp_path: Path) -> None:
    """Neither a file nor an evaluation acts on observations that the model has never seen."""
    env = REFUSED[why](gymnasium.make(PUSHING, **RELATIVE))
    model = sb3.PPO("MlpPolicy", env, **small())
    with pytest.raises(ModelError, match=why):
        export_sb3(model, env, tmp_path / "mine.safetensors")
    with pytest.raises(ModelError, match=why):
        evaluate(model, "P5", n=1, backend="fake")


def test_wrappers_of_many_environments_are_seen(tmp_path: Path) -> None:
    """Those of Gymnasium are tried with rows; in other processes their names decide."""
    from gymnasium.wrappers import vector

    from scm_world.policies.wrappers import seen_through

    envs = gymnasium.make_vec(PUSHING, num_envs=3, backend="fake")
    running = vector.NormalizeObservation(vector.RecordEpisodeStatistics(envs))
    running.reset(seed=0)
    found = seen_through(running)
    assert found is not None
    gain = 1.0 / np.sqrt(running.obs_rms.var + running.epsilon)
    np.testing.assert_allclose(np.diag(found.weight), gain, rtol=1e-4)
    np.testing.assert_allclose(found.bias, -running.obs_rms.mean * gain, rtol=1e-3, atol=1e-3)
    assert seen_through(make_sb3(PUSHING, 2, backend="fake", workers=2)) is None
    make = [lambda: normalized(gymnasium.make(PUSHING, backend="fake"))] * 2
    apart = sb3.common.vec_env.SubprocVecEnv(make, start_method="fork")
    with pytest.raises(ModelError, match="NormalizeObservation is in another process"):
        seen_through(apart)
    apart.close()


@pytest.mark.parametrize("algo", ["PPO", "SAC"])
def test_archives_are_loaded_where_that_is_trusted(algo: str, tmp_path: Path) -> None:
    """By name alone; they do not say how they act, which is told unless the user says it."""
    env = gymnasium.make("scm_world/Pushing-v0", **RELATIVE)
    model = getattr(sb3, algo)("MlpPolicy", env, **small())
    model.save(tmp_path / "model.zip")
    path = str(tmp_path / "model.zip")
    with pytest.raises(UnreadableFile, match="--trust stable_baselines3"):
        evaluate(path, "P0", n=1, backend="fake")
    given: dict[str, Any] = {"n": 1, "trusted": ("stable_baselines3",)}
    form = {name: value for name, value in RELATIVE.items() if name != "backend"}
    found = evaluate(path, "P0", backend="fake", env=form, **given)
    whole = evaluate(model, "P0", n=1, backend="fake", env={"max_episode_length": 4})
    assert [*found.frame["return"]] == [*whole.frame["return"]]
    with pytest.warns(UserWarning, match="does not say how it observes and acts"):
        evaluate(path, "P0", backend="fake", env={"max_episode_length": 4}, **given)
    done = CliRunner().invoke(
        app,
        [
            *("evaluate", path, "pushing", "--protocols=P0", "-n1", "--backend=fake"),
            *("--env=max_episode_length=2", "--trust=stable_baselines3", "--workers=1"),
            *("--env=action_mode=delta_joint_positions", f"--out={tmp_path / 'out'}"),
        ],
    )
    assert done.exit_code == 0, done.output


def test_policies_of_the_zoo_are_loaded_by_name(tmp_path: Path) -> None:
    """As in every other place where a policy is named; also a folder."""
    policy = load_policy("zoo:reaching")
    assert policy.about.task == "reaching"
    save_policy(tmp_path / "best.safetensors", policy)
    assert load_policy(tmp_path).sha256 == policy.sha256
    with pytest.raises(UnknownOption, match="zoo:reaching"):
        load_policy("zoo:reeching")


def test_a_network_of_convolutions_takes_stacked_channels() -> None:
    """The checker of Stable-Baselines3 has nothing to say, and its network learns."""
    from stable_baselines3.common.env_checker import check_env

    options: dict[str, Any] = {"observation_mode": "pixel", "image_size": 36}
    options |= {"stack_images": True, "backend": "fake", "max_episode_length": 4}
    check_env(gymnasium.make(PUSHING, **options), skip_render_check=True)
    envs = make_sb3(PUSHING, 2, **options)
    sb3.PPO("CnnPolicy", envs, n_steps=4, batch_size=4, device="cpu").learn(8)
