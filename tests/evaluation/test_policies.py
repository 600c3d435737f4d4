"""Facts about policies: what evaluation accepts, and what it refuses."""

from __future__ import annotations

import importlib.util
import json
import pickle
import sys
import zipfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from scm_world.errors import ActionError, ModelError, UnknownOption, UnreadableFile
from scm_world.evaluation import in_world
from scm_world.policies import Layer, MlpPolicy
from scm_world.policies.agents import NAMES, WorldPolicy, agent_from, as_agent, checked
from scm_world.queries import Random, World

STEPS = 6


def make(task: str = "Pushing", **options: Any) -> Any:
    """Make a short environment, without Gymnasium's own checker."""
    options = {"backend": "fake", "max_episode_length": STEPS, **options}
    return gymnasium.make(f"scm_world/{task}-v0", disable_env_checker=True, **options)


def played(policy: Any, env: Any, seed: int = 0, episode: int = 0) -> Any:
    """Let a policy act for an episode; the actions, shape (steps, 9)."""
    player = as_agent(policy)
    observation, _ = env.reset(seed=seed, options={"episode": episode})
    player.start(env.unwrapped)
    actions = []
    for _ in range(STEPS):
        actions.append(player.act(observation))
        observation = env.step(actions[-1])[0]
    return np.array(actions)


def module(folder: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> str:
    """Write a module that can be imported under the name that is given back."""
    (folder / "agents_for_a_test.py").write_text("import numpy as np\n" + text)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delitem(sys.modules, "agents_for_a_test", raising=False)
    return "agents_for_a_test"


def mlp(n: int, hidden: int = 4) -> MlpPolicy:
    """Give a small network."""
    draw = np.random.default_rng(0).normal(size=(n + 9, hidden)).astype(np.float32)
    first = Layer(draw[:n] / n, np.zeros(hidden, np.float32))
    last = Layer(np.ascontiguousarray(draw[n:].T), np.zeros(9, np.float32))
    return MlpPolicy((first, last), np.zeros(9, np.float32))


# --- functions and models ---------------------------------------------------------------------


def test_a_function_of_the_observation_acts() -> None:
    """It is called with what the environment shows, and its actions are left as they are."""
    actions = played(lambda seen: np.tanh(seen[:9]), make())
    assert actions.shape == (STEPS, 9)
    assert actions.dtype == np.float32


def test_a_function_of_several_arrays_acts() -> None:
    """Observations with parts reach it as a dictionary."""
    env = make(goal_env=True)
    found = played(lambda seen: np.full(9, seen["desired_goal"][0]), env)
    assert found.shape == (STEPS, 9)


def test_a_policy_with_a_memory_is_reset() -> None:
    """Its method ``reset`` is called at the beginning of every episode."""

    class Counting:
        steps = 0

        def reset(self) -> None:
            self.steps = 0

        def __call__(self, observation: Any) -> Any:
            self.steps += 1
            return np.full(9, self.steps / 10)

    player, env = as_agent(Counting()), make()
    first, second = played(player, env), played(player, env)
    np.testing.assert_array_equal(first, second)
    assert first[0, 0] == 0.1


class Recurrent:
    """What Stable-Baselines3 calls a recurrent model."""

    def __init__(self) -> None:
        self.starts: list[bool] = []

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, **how: Any
    ) -> Any:
        """Count the steps since the start."""
        assert how == {"deterministic": True}
        self.starts.append(bool(episode_start[0]))
        state = 1 if episode_start[0] else state + 1
        return np.full(9, state / 10, dtype=np.float32), state


def test_a_model_remembers_until_the_reset() -> None:
    """The state of a recurrent model is given back to it, and forgotten with the episode."""
    model, env = Recurrent(), make()
    player = as_agent(model)
    first, second = played(player, env), played(player, env)
    np.testing.assert_allclose(first[:, 0], np.arange(1, STEPS + 1) / 10)
    np.testing.assert_array_equal(first, second)
    assert model.starts == [True] + [False] * (STEPS - 1) + [True] + [False] * (STEPS - 1)


def test_a_recurrent_model_acts_in_no_branch_of_an_episode() -> None:
    """Its memory is that of another branch, or of no steps at all."""
    world = World("pushing", backend="fake")
    acts = in_world(Recurrent(), world)
    world.reset(seed=0)
    for _ in range(2):
        world.step(acts(world))
    saved = world.snapshot()
    world.step(acts(world))
    world.restore(saved)
    for policy in (acts, in_world(Recurrent(), world)):
        with pytest.raises(ActionError, match="a memory"):
            policy(world)


def test_an_object_in_memory_cannot_be_made_again() -> None:
    """The error says that it can be given."""
    about = as_agent(Recurrent()).about
    assert json.loads(json.dumps(about)) == about
    with pytest.raises(UnknownOption, match="policy="):
        agent_from(about)


@pytest.mark.parametrize(
    "given", [np.zeros(8), np.full(9, np.nan), "none", None, 1.0, np.zeros((1, 9)), [object()] * 9]
)
def test_what_is_no_action_is_refused(given: Any) -> None:
    """The message names the policy, what it gave, and what is allowed."""
    with pytest.raises(ActionError, match=r"the policy 'odd' gave .*\(9,\) with finite numbers"):
        checked(given, make(), "odd")


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int64])
def test_checking_changes_nothing(kind: Any) -> None:
    """Numbers beyond the range are left to the environment, and floats are not copied."""
    action = np.arange(9, dtype=kind)
    found = checked(action, None, "any")
    np.testing.assert_array_equal(found, action)
    assert (found is action) == (kind is not np.int64)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_infinities_are_found_everywhere(bad: float, kind: Any) -> None:
    """In any of the nine numbers; huge but finite ones pass."""
    for place in range(9):
        action = np.full(9, np.finfo(kind).max, dtype=kind)
        checked(action, None, "huge")
        action[place] = bad
        with pytest.raises(ActionError):
            checked(action, None, "bad")


def test_a_policy_that_breaks_is_named() -> None:
    """Whoever acts is named in the error."""
    with pytest.raises(ActionError, match="broken"):
        played(_broken, make())


def _broken(observation: Any) -> Any:
    return np.full(9, np.nan)


# --- policies of the world --------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["joint_positions", "end_effector_positions"])
@pytest.mark.parametrize("name", ["still", "random", "sweep", "across"])
def test_named_policies_act(name: str, mode: str) -> None:
    """Each of them, and their actions are in the units of the environment."""
    env = make(action_mode=mode)
    actions = played(name, env)
    assert actions.shape == (STEPS, 9)
    assert np.abs(actions).max() < 1.0 + 1e-9


@pytest.mark.parametrize("name", [*NAMES])
def test_named_policies_are_made_again(name: str) -> None:
    """Each of them, from what a results file says."""
    about = as_agent(name).about
    assert agent_from(json.loads(json.dumps(about))).about == about


def test_random_actions_are_noise_of_the_episode() -> None:
    """The same for the same seed and episode, whatever happens; others for other ones."""
    env, other = make(), make("Picking", normalize_actions=False)
    first = played("random", env, seed=3, episode=2)
    np.testing.assert_array_equal(first, played("random", env, seed=3, episode=2))
    assert not np.array_equal(first, played("random", env, seed=3, episode=1))
    low, high = other.unwrapped.world.action_low, other.unwrapped.world.action_high
    raw = played("random", other, seed=3, episode=2)
    np.testing.assert_allclose((raw - low) / (high - low) * 2 - 1, first, atol=1e-12)


def test_commands_become_actions() -> None:
    """What a policy of the world asks for is what the robot is told."""
    env = make()
    played(WorldPolicy(lambda world: world.action_high - 0.1), env)
    world = env.unwrapped.world
    np.testing.assert_allclose(world["action"], world.action_high - 0.1, atol=1e-12)
    assert played(Random(share=0.5), env).shape == (STEPS, 9)


@pytest.mark.parametrize("origin", ["command", "measured"])
@pytest.mark.parametrize("normalized", [True, False])
def test_relative_actions_lead_to_commands(origin: str, normalized: bool) -> None:
    """What a policy of the world asks for is approached in steps, and then held."""
    relative = {"delta_scale": 0.1, "delta_origin": origin, "normalize_actions": normalized}
    env = make(action_mode="delta_joint_positions", **relative)
    goal = np.array([0.3, 0.9, -0.9] * 3)
    actions = played(WorldPolicy(lambda world: goal), env)
    np.testing.assert_allclose(env.unwrapped.world["action"], goal, atol=1e-9)
    assert np.all(np.abs(actions) <= env.action_space.high + 1e-6)
    assert np.any(np.isclose(actions[0], env.action_space.high))  # the first one is cut short


def test_functions_are_found_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A user may name any; a results file only those of trusted packages."""
    name = module(
        tmp_path,
        monkeypatch,
        "from scm_world.policies import WorldPolicy\n"
        "def up(seen): return np.full(9, 0.5)\n"
        "@WorldPolicy\n"
        "def high(world): return world.action_high\n"
        "class Memory:\n"
        "    def __call__(self, seen): return np.full(9, 0.25)\n",
    )
    env = make()
    for function, value in (("up", 0.5), ("high", 1.0), ("Memory", 0.25)):
        player = as_agent(f"{name}:{function}")
        np.testing.assert_allclose(played(player, env), value)
        with pytest.raises(ModelError, match="trusted"):
            agent_from(player.about)
        again = agent_from(player.about, trusted=(name,))
        np.testing.assert_allclose(played(again, env), value)
    with pytest.raises(ModelError, match="no function"):
        as_agent(f"{name}:missing")


def test_a_function_that_was_given_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One at the top of a module can be made again, also if it sees the world."""
    name = module(tmp_path, monkeypatch, "def high(world): return world.action_high\n")
    function = importlib.import_module(name).high
    about = as_agent(WorldPolicy(function)).about
    assert about["kind"] == "function"
    again = agent_from(about, trusted=(name,))
    np.testing.assert_allclose(played(again, make()), 1.0)
    assert as_agent(lambda seen: seen).about["kind"] == "object"


@pytest.mark.parametrize("given", ["randm", 3, None])
def test_what_is_no_policy_is_refused(given: Any) -> None:
    """The error lists what is one."""
    with pytest.raises(UnknownOption, match="a function of the observation"):
        as_agent(given)


def test_players_can_be_pickled(tmp_path: Path) -> None:
    """So that other processes can play."""
    env = make()
    policy = mlp(env.observation_space.shape[0])
    given = ["still", "random", "sweep", Random(), policy, np.zeros(9), WorldPolicy(_high)]
    for one in given:
        player = as_agent(one)
        other = pickle.loads(pickle.dumps(player))  # noqa: S301 # our own
        np.testing.assert_array_equal(played(other, env), played(player, env))
        assert other.about == player.about


def _high(world: Any) -> Any:
    return world.action_high


# --- actions that are given -------------------------------------------------------------------


def test_given_actions_are_played_and_the_last_one_is_held() -> None:
    """One for each step, or one for all."""
    given = np.linspace(-1, 1, 27).reshape(3, 9).astype(np.float32)
    found = played(given, make())
    np.testing.assert_array_equal(found[:3], given)
    np.testing.assert_array_equal(found[3:], given[[2, 2, 2]])
    np.testing.assert_array_equal(played([0.5] * 9, make()), np.full((STEPS, 9), 0.5))
    with pytest.raises(ActionError, match=r"shape \(9,\)"):
        played(np.zeros((2, 8)), make())


# --- files ------------------------------------------------------------------------------------


def archive(path: Path, member: str) -> Path:
    """Write a zip archive."""
    with zipfile.ZipFile(path, "w") as file:
        file.writestr(member, "2.0")
    return path


def test_archives_that_hold_pickles_are_refused(tmp_path: Path) -> None:
    """The error says how to give the model instead."""
    path = archive(tmp_path / "ppo.zip", "_stable_baselines3_version")
    with pytest.raises(UnreadableFile, match=r"as_agent\(PPO.load\(path\)\)"):
        as_agent(path)
    with pytest.raises(UnreadableFile, match="no item named"):
        as_agent(archive(tmp_path / "other.zip", "readme"))
    with pytest.raises(UnreadableFile, match="No such file"):
        as_agent(tmp_path / "missing.zip")


def published(path: Path, n: int) -> MlpPolicy:
    """Write an archive as Stable-Baselines 2 does, and give the policy in it."""
    policy = mlp(n)
    tensors = {
        "model/shared_fc0/w:0": policy.layers[0].weight,
        "model/shared_fc0/b:0": policy.layers[0].bias,
        "model/pi/w:0": policy.layers[1].weight,
        "model/pi/b:0": policy.layers[1].bias,
        "model/pi/logstd:0": policy.log_std,
    }
    inside = path.with_suffix(".npz")
    np.savez(inside, **tensors)  # type: ignore[arg-type]
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("parameters", inside.read_bytes())
    return policy


def test_published_archives_act(tmp_path: Path) -> None:
    """And a file that was changed since is not taken for the one that acted."""
    env, path = make(), tmp_path / "published.zip"
    policy = published(path, env.observation_space.shape[0])
    found = played(path, env)
    np.testing.assert_array_equal(found, played(policy, env))
    about = as_agent(path).about
    np.testing.assert_array_equal(played(agent_from(about), env), found)
    path.write_bytes(path.read_bytes() + b" ")
    with pytest.raises(UnreadableFile, match="another file"):
        agent_from(about)
