"""Facts about files of trained policies: what they compute, and what is refused."""

from __future__ import annotations

import inspect
import json
import pickle
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import safetensors.numpy
from policy_samples import RELATIVE, policy, tensors, trained

import scm_world
from scm_world.env import ScmWorldEnv
from scm_world.errors import (
    ActionError,
    ModelError,
    UnknownOption,
    UnreadableFile,
    UnwritableFolder,
)
from scm_world.evaluation import in_world
from scm_world.policies import MlpPolicy, PolicyAbout, load_policy, save_policy
from scm_world.policies.agents import agent_from, as_agent
from scm_world.policies.cards import KEY, OPTIONS, USUAL, option_form
from scm_world.queries import World

SEEN = np.random.default_rng(1).uniform(-1, 1, (5, 4, 56)).astype(np.float32)


def by_formula(tensors: dict[str, Any], x: Any, activation: str, output: str) -> Any:
    """Compute what a network gives, in 64-bit floats and without the module."""
    last = max(int(name.split(".")[1]) for name in tensors)
    for number in range(last + 1):
        weight, bias = (tensors[f"layers.{number}.{part}"] for part in ("weight", "bias"))
        x = np.asarray(x, np.float64) @ weight.T.astype(np.float64) + bias
        if number < last:
            x = np.tanh(x) if activation == "tanh" else np.maximum(x, 0.0)
    return np.tanh(x) if output == "tanh" else np.clip(x, -1.0, 1.0)


@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("output", ["clip", "tanh"])
def test_a_network_computes_what_its_formula_says(activation: str, output: str) -> None:
    """For both activations and both ways to bound the actions."""
    given = tensors(56, 32, 16, 9)
    found = MlpPolicy.of(given, PolicyAbout(task="pushing", activation=activation, output=output))
    expected = by_formula(given, SEEN, activation, output)
    np.testing.assert_allclose(found(SEEN), expected, atol=1e-7)
    assert found(SEEN).dtype == np.float32
    assert found(SEEN).shape == (5, 4, 9)
    assert expected.std() > 0.1


def test_an_observation_among_others_gets_the_action_that_it_gets_alone() -> None:
    """Bit for bit, whatever the batch."""
    found = policy()
    together = found(SEEN)
    for place in np.ndindex(SEEN.shape[:2]):
        np.testing.assert_array_equal(found(SEEN[place]), together[place])
    np.testing.assert_array_equal(found.predict(SEEN[0])[0], together[0])


def test_a_memory_is_given_back_by_its_signs(tmp_path: Path) -> None:
    """The network has it behind the observation and the action; it is empty in a first step."""
    made = MlpPolicy.of(tensors(56 + 2, 16, 9 + 2), {"task": "pushing", "memory": 2})
    assert (made.n_observed, made.n_actions) == (56, 9)
    random = np.random.default_rng(0)
    seen, kept = random.normal(size=(3, 56)), random.choice([-1.0, 1.0], (3, 2))
    plain = MlpPolicy.of(tensors(56 + 2, 16, 9 + 2))
    wanted = plain.mean(np.concatenate([seen, kept], axis=1))
    action, state = made.predict(seen, kept)
    np.testing.assert_array_equal(action, np.clip(wanted[:, :9], -1.0, 1.0).astype(np.float32))
    np.testing.assert_array_equal(state, np.where(wanted[:, 9:] > 0.0, 1.0, -1.0))
    first = [True, False, True]
    np.testing.assert_array_equal(made.predict(seen, kept, True)[0], made.predict(seen)[0])
    emptied, _ = made.predict(seen, kept, first)
    np.testing.assert_array_equal(emptied[1], action[1])
    np.testing.assert_array_equal(emptied[[0, 2]], made.predict(seen[[0, 2]])[0])
    again = load_policy(save_policy(tmp_path / "p.safetensors", made))
    assert again.about.memory == 2
    assert again.sha256 == made.sha256


def test_a_memory_that_would_be_lost_is_refused() -> None:
    """A call alone has none, and the networks of PPO have none."""
    made = MlpPolicy.of(tensors(56 + 2, 16, 9 + 2), {"task": "pushing", "memory": 2})
    with pytest.raises(ActionError, match=r"memory.*predict"):
        made(np.zeros(56))
    with pytest.raises(ActionError, match=r"memory has shape \(2,\)"):
        made.predict(np.zeros(56), np.zeros(3))
    with pytest.raises(ActionError, match="values -1, 0 and 1"):
        made.predict(np.zeros(56), np.full(2, np.nan))
    with pytest.raises(ActionError, match="no memory of shape"):
        made.predict(np.zeros((3, 56)), episode_start=[True, False])
    with pytest.raises(ModelError, match="neither log_std"):
        MlpPolicy.of({**made.tensors(), "log_std": np.zeros(9, np.float32)}, made.about)
    with pytest.raises(ModelError, match="too narrow"):
        MlpPolicy.of(tensors(3, 2), {"task": "any", "memory": 2})


def test_a_memory_lasts_for_an_episode_of_an_evaluation() -> None:
    """It is empty again in the next one."""
    made = MlpPolicy.of(
        tensors(56 + 2, 16, 9 + 2), {"task": "pushing", "env": RELATIVE, "memory": 2}
    )
    env = ScmWorldEnv("pushing", max_episode_length=4, **RELATIVE)
    player, kept = as_agent(made), []
    for _ in range(2):
        observation, _ = env.reset(seed=0)
        player.start(env)
        state = None
        for _ in range(4):
            action, state = made.predict(observation, state)
            np.testing.assert_array_equal(player.act(observation), action)
            observation, *_ = env.step(action)
            kept.append(action)
    np.testing.assert_array_equal(kept[:4], kept[4:])
    env.close()


def test_a_memory_is_not_taken_into_a_branch_of_an_episode() -> None:
    """It would be that of the end of the other branch."""
    about = {"task": "pushing", "env": RELATIVE, "memory": 2}
    made = MlpPolicy.of(tensors(56 + 2, 16, 9 + 2), about)
    world = World("pushing", backend="fake")
    acts = in_world(made, world)
    once, again = (world.rollout(acts, steps=4) for _ in range(2))
    np.testing.assert_array_equal(once.actions, again.actions)
    with pytest.raises(ActionError, match=r"memory.*from the first control step"):
        once.counterfactual({"tool_block.mass": 0.03}, at=2, actions=acts)


def test_parts_of_an_observation_are_joined_in_their_order() -> None:
    """The file says which ones and in which order, not the dictionary."""
    found = policy(inputs=("context", "observation"))
    parts = {"observation": SEEN[..., 6:], "context": SEEN[..., :6], "achieved_goal": SEEN}
    np.testing.assert_array_equal(found(parts), policy()(SEEN))


def test_observations_that_do_not_fit_are_refused() -> None:
    """Other numbers of components, other parts, one array instead of parts."""
    with pytest.raises(ActionError, match=r"observes 56 numbers, got the shape \(55,\)"):
        policy()(np.zeros(55))
    with pytest.raises(ActionError, match="observes one array, got the parts"):
        policy()({"observation": np.zeros(56)})
    two = policy(inputs=("observation", "context"))
    with pytest.raises(ActionError, match=r"the parts \['observation', 'context'\], got"):
        two({"observation": np.zeros(56)})
    with pytest.raises(ActionError, match="by name"):
        two(np.zeros(56))
    with pytest.raises(UnknownOption, match="deterministic"):
        policy().predict(np.zeros(56), deterministic=False)


def test_a_file_has_everything(tmp_path: Path) -> None:
    """Weights, deviations, value, and what is said come back bit for bit."""
    given = {
        **tensors(56, 16, 9),
        **tensors(56, 8, 1, prefix="value.layers"),
        "log_std": np.linspace(-1, 0, 9, dtype=np.float32),
    }
    about = PolicyAbout(
        task="picking", env=RELATIVE, activation="relu", output="tanh", card={"seed": 3}
    )
    path = save_policy(tmp_path / "a.safetensors", given, about)
    found = load_policy(tmp_path / "a.safetensors")
    assert path == tmp_path / "a.safetensors"
    assert found.about == about
    assert found.tensors().keys() == given.keys()
    for name, array in given.items():
        np.testing.assert_array_equal(found.tensors()[name], array)
    again = save_policy(tmp_path / "b.safetensors", found)
    assert again.read_bytes() == path.read_bytes()
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(found))(SEEN), found(SEEN))  # noqa: S301


def test_other_programs_can_read_it(tmp_path: Path) -> None:
    """It is a safetensors file with plain names, and JSON in its metadata."""
    path = trained(tmp_path / "a.safetensors")
    found = safetensors.numpy.load_file(path)
    assert found["layers.0.weight"].shape == (16, 56)
    with safetensors.safe_open(path, framework="np") as file:
        about = json.loads(file.metadata()[KEY])
    assert about["format"] == "scm_world.policy"
    assert about["env"] == RELATIVE


def damaged(path: Path, how: str) -> None:
    """Damage a file."""
    content = path.read_bytes()
    match how:
        case "cut short":
            path.write_bytes(content[:-100])
        case "empty":
            path.write_bytes(b"")
        case "text":
            path.write_text("no policy" * 100)
        case "header":
            path.write_bytes(content[:8] + b"x" * 40 + content[48:])
        case "foreign":
            path.write_bytes(safetensors.numpy.save(tensors(56, 9)))
        case "format":
            said = json.dumps({"format": "other", "version": 1, "task": "pushing"})
            path.write_bytes(safetensors.numpy.save(tensors(56, 9), {KEY: said}))
        case "version":
            said = policy().about.text().replace('"version": 1', '"version": 2')
            path.write_bytes(safetensors.numpy.save(tensors(56, 9), {KEY: said}))
        case "gone":
            path.unlink()


@pytest.mark.parametrize(
    ("how", "match"),
    [
        ("cut short", "SafetensorError"),
        ("empty", "SafetensorError"),
        ("text", "SafetensorError"),
        ("header", "SafetensorError"),
        ("foreign", "has no 'scm_world'"),
        ("format", "format: Input should be 'scm_world.policy'"),
        ("version", "version: Input should be 1"),
        ("gone", "No such file"),
    ],
)
def test_damaged_and_foreign_files_are_refused(tmp_path: Path, how: str, match: str) -> None:
    """The error names the file, what is wrong with it, and what to give."""
    path = trained(tmp_path / "a.safetensors")
    damaged(path, how)
    with pytest.raises(UnreadableFile, match=match) as caught:
        as_agent(path)
    assert "a.safetensors" in str(caught.value)
    assert "give " in str(caught.value)


FULL = tensors(56, 16, 9)
NAN = np.full(9, np.nan, np.float32)


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({}, "the tensor 'layers.0.weight' is missing"),
        (tensors(56, 16, 8), "has to give 9 numbers, not 8"),
        ({**FULL, "layers.1.weight": FULL["layers.1.weight"][:, :-1]}, "and gets 16"),
        ({**FULL, "layers.1.bias": NAN}, r"layers\.1: .*finite"),
        ({**FULL, "layers.1.bias": FULL["layers.1.bias"][:-1]}, r"got \(9, 16\) and \(8,\)"),
        ({**FULL, "log_std": NAN}, "log_std: expected"),
        ({**FULL, "other": NAN}, "'other' is not a tensor of a policy"),
        (
            {k: v for k, v in FULL.items() if k != "layers.0.bias"},
            "'layers.0.bias' is missing",
        ),
        ({**FULL, "log_std": np.zeros(9)}, "log_std: expected an array of float32, got float64"),
        ({**FULL, **tensors(55, 1, prefix="value.layers")}, "it takes 55 numbers, and gets 56"),
        ({**FULL, **tensors(56, 2, prefix="value.layers")}, "give 1 numbers, not 2"),
        (
            {
                **FULL,
                "layers.0.weight": np.array(1.0, np.float32),
                **tensors(56, 1, prefix="value.layers"),
            },
            r"layers\.0: .*got \(\)",
        ),
    ],
)
def test_tensors_that_do_not_fit_are_refused(given: dict[str, Any], match: str) -> None:
    """Before anything is written, and after anything was read."""
    with pytest.raises(ModelError, match=match):
        save_policy("never.safetensors", given, {"task": "pushing"})


@pytest.mark.parametrize(
    ("about", "match"),
    [
        ({}, "task: Field required"),
        ({"task": "pushing", "env": {"start": {}}}, "'start' is not one of the options"),
        ({"task": "pushing", "activation": "gelu"}, "activation: "),
        ({"task": "pushing", "inputs": ("a", "a")}, "each once"),
        ({"task": "pushing", "card": {"x": object()}}, "card"),
        ({"task": "pushing", "card": {"scores": [float("nan")]}}, "card.*finite"),
        ('{"task": "pushing", "card": {"score": NaN}}', "card.*finite"),
        ({"task": "pushing", "env": {"delta_scale": float("inf")}}, "env.*finite"),
        ({"task": "pushing", "colour": 1}, "colour: "),
    ],
)
def test_what_is_said_of_a_policy_is_checked(about: Any, match: str) -> None:
    """Every field has to be what the format says, as data and as text."""
    with pytest.raises(ModelError, match=match):
        save_policy("never.safetensors", FULL, about)


def test_files_are_written_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that is full leaves what was there, and says so; another ending is refused."""
    path = trained(tmp_path / "a.safetensors")
    before = path.read_bytes()

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("scm_world.runs.files.os.fsync", full)
    with pytest.raises(UnwritableFolder, match="No space left"):
        save_policy(path, policy(seed=5))
    assert path.read_bytes() == before
    assert [one.name for one in tmp_path.iterdir()] == [path.name]
    with pytest.raises(UnknownOption, match=r"\.safetensors"):
        save_policy(tmp_path / "a.pt", policy())


def test_options_of_the_environment_exist() -> None:
    """The format knows the options of the environment by their names, and what is usual."""
    of_env = inspect.signature(ScmWorldEnv).parameters
    assert {name: option_form(name, of_env[name].default) for name in OPTIONS} == USUAL
    about = PolicyAbout(task="pushing", env={"include": ("joint_torques",), "frame_skip": 10})
    assert about.option("include") == ["joint_torques"]
    assert about.option("context") == "none"
    assert about.unusual(OPTIONS) == {"include": ["joint_torques"]}
    assert PolicyAbout.of(about.text()) == about
    assert about.with_card(seed=1).card == {"seed": 1}


# --- as players -------------------------------------------------------------------------------


def make(task: str = "Pushing", **options: Any) -> Any:
    """Make a short environment, as a policy was trained in."""
    made = {"backend": "fake", "max_episode_length": 6, **RELATIVE, **options}
    return gymnasium.make(f"scm_world/{task}-v0", disable_env_checker=True, **made)


def first_action(player: Any, env: Any) -> Any:
    """Let a player begin an episode."""
    observation, _ = env.reset(seed=0)
    player.start(env.unwrapped)
    return player.act(observation)


def test_a_file_a_folder_and_a_policy_in_memory_act_alike(tmp_path: Path) -> None:
    """The folder of a run stands for its best policy, or its last one if there is no other."""
    env = make()
    path = trained(tmp_path / "run" / "policy.safetensors")
    found = first_action(as_agent(path), env)
    np.testing.assert_array_equal(first_action(as_agent(tmp_path / "run"), env), found)
    np.testing.assert_array_equal(first_action(as_agent(load_policy(path)), env), found)
    assert as_agent(tmp_path / "run").about["name"] == "run"
    trained(tmp_path / "run" / "best.safetensors", seed=7)
    best = first_action(as_agent(tmp_path / "run"), env)
    assert not np.array_equal(best, found)
    with pytest.raises(UnreadableFile, match=r"neither best\.safetensors nor policy"):
        as_agent(tmp_path)


def test_a_policy_is_made_again_from_what_results_say(tmp_path: Path) -> None:
    """Unless its file is another one by now."""
    path = trained(tmp_path / "run" / "policy.safetensors")
    for given in (path, path.parent):
        about = as_agent(given).about
        assert agent_from(about).about["sha256"] == about["sha256"]
    trained(path, seed=1)
    with pytest.raises(UnreadableFile, match="another file"):
        agent_from(about)


@pytest.mark.parametrize(
    ("option", "value"),
    [("delta_scale", 0.2), ("frame_skip", 3), ("include", ["joint_torques"])],
)
def test_other_environments_are_refused(option: str, value: Any) -> None:
    """The error says which option is another one, and what it was in the training."""
    with pytest.raises(UnknownOption, match=f"{option} .* as in its training"):
        first_action(as_agent(policy(env=RELATIVE)), make(**{option: value}))


def test_other_tasks_are_refused_by_what_they_show() -> None:
    """As many numbers as it observes there must be."""
    with pytest.raises(ActionError, match="observes 56 numbers"):
        first_action(as_agent(policy(env=RELATIVE)), make("Stacking2"))


def test_the_names_are_public() -> None:
    """What users write and read files with is where its documentation says."""
    assert scm_world.policies.load_policy is load_policy
    assert scm_world.policies.save_policy is save_policy
