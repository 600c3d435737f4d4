"""Facts about trained policies in evaluations: each acts in the form in which it was trained."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from evaluation_samples import SHORT, played_again
from policy_samples import RELATIVE, policy, trained

from scm_world.errors import EvaluationError, ModelError, UnknownOption
from scm_world.evaluation import Evaluation, evaluate, why
from scm_world.evaluation.pipeline import ShardRunner
from scm_world.evaluation.preparation import prepare, shared_options, task_for
from scm_world.policies import Agent, PolicyAbout, WorldPolicy, agent_from, as_agent

OTHER = {**RELATIVE, "context": "privileged", "max_episode_length": 16}
INPUTS = ["context", "observation"]
CONTEXT = 130  # numbers of the parameters of picking


def small(policy: Any, protocols: Any = "P0,P6", **options: Any) -> Evaluation:
    """Evaluate a few short episodes without physics."""
    return evaluate(policy, protocols, **{"n": 3, "backend": "fake", "env": SHORT, **options})


@pytest.fixture
def agents(tmp_path: Path) -> dict[str, Any]:
    """Two policies of two forms, and two that bring none."""
    first = trained(tmp_path / "run" / "policy.safetensors", task="picking")
    second = trained(
        tmp_path / "b.safetensors", 56 + CONTEXT, task="picking", env=OTHER, inputs=INPUTS
    )
    return {"one": str(first.parent), "two": str(second), "feedback": "feedback", "still": "still"}


def test_agents_of_several_forms_meet_the_same_draws(agents: dict[str, Any]) -> None:
    """Task and options come from the files, and paired differences are those of one world."""
    found = small(agents)
    assert found.task == "picking"
    drawn = [column for name, column in found.frame.items() if name.startswith("drawn ")]
    assert drawn
    for name in ("two", "feedback", "still"):
        for protocol in ("P0", "P6"):
            mine, its = (found.only(agent=a, protocol=protocol).frame for a in ("one", name))
            for column in mine:
                if column.startswith("drawn "):
                    np.testing.assert_array_equal(mine[column], its[column])
    assert found.difference("one", "feedback", "P6").n == 3
    assert len(set(found.frame["hash"].tolist())) > 8


def test_an_agent_does_among_others_what_it_does_alone(agents: dict[str, Any]) -> None:
    """Bit for bit, in an environment that was made by hand, too."""
    found = small(agents)
    for name in ("one", "two", "still"):
        env = {"one": RELATIVE, "two": OTHER, "still": {}}[name]
        alone = small({name: agents[name]}, task="picking", env={**env, **SHORT})
        assert [*alone.frame["hash"]] == [*found.only(agent=name).frame["hash"]]


def test_results_say_how_each_agent_acted(agents: dict[str, Any], tmp_path: Path) -> None:
    """They can be played again, also from a file and in part."""
    found = small(agents)
    said = {one["agent"]: one.get("env") for one in found.about["agents"]}
    assert said == {
        "one": RELATIVE,
        "two": {**RELATIVE, "context": "privileged"},
        "feedback": None,
        "still": None,
    }
    assert found.about["env"] == SHORT
    found.save(tmp_path / "results")
    again = Evaluation.load(tmp_path / "results")
    assert not played_again(again)
    found = why(again.only(agent="two"), "P6", 1)
    assert found.others or found.left_out


def test_finished_episodes_are_used_again(agents: dict[str, Any], tmp_path: Path) -> None:
    """But not those of another policy in a file of the same name."""
    first = small(agents, out=tmp_path / "out")
    parts = {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "parts").iterdir()}
    assert small(agents, out=tmp_path / "out") == first
    assert parts == {p: p.stat().st_mtime_ns for p in (tmp_path / "out" / "parts").iterdir()}
    trained(Path(agents["one"]) / "policy.safetensors", seed=3, task="picking")
    assert small(agents, out=tmp_path / "out") != first


def test_a_file_that_a_training_replaces_is_read_once(tmp_path: Path) -> None:
    """What acts is what was read when the evaluation began, in other processes, too."""
    path = trained(tmp_path / "run" / "best.safetensors")
    how: Any = {"task": None, "n": 1, "seeds": 0, "backend": "fake", "env": SHORT, "trusted": None}
    setup = prepare(str(path.parent), "P0", **how)
    (shard,) = setup.shards()
    before = ShardRunner(setup)(shard)
    trained(path, seed=1)
    sent = pickle.loads(pickle.dumps(setup))  # noqa: S301 # ours
    assert ShardRunner(sent)(shard) == before
    other = prepare(str(path.parent), "P0", **how)
    assert ShardRunner(other)(shard) != before


# --- what counts ------------------------------------------------------------------------------


def test_what_is_given_has_to_fit_the_policy() -> None:
    """The error says who was trained with what; the length may be another one."""
    mine = {"mine": policy(env={**RELATIVE, "frame_skip": 5})}
    for wrong in ({"context": "privileged"}, {"delta_scale": 1.0}, {"frame_skip": 10}):
        with pytest.raises(UnknownOption, match=f"{next(iter(wrong))} for 'mine' cannot be"):
            small(mine, env=wrong)
    found = small(mine, env={**SHORT, **RELATIVE, "preset": "precise"})
    assert found.about["env"] == {**SHORT, "preset": "precise", "frame_skip": 5}
    assert set(found.frame["steps"].tolist()) == {16}


def test_options_are_for_agents_that_bring_none() -> None:
    """A policy in memory may act by torques beside one that was trained with relative joints."""
    seen = []

    def world_policy(world: Any) -> Any:
        seen.append(world.options.action_mode)
        return np.zeros(9)

    two = {"a": policy(env=RELATIVE), "b": WorldPolicy(world_policy)}
    found = small(two, env={**SHORT, "action_mode": "joint_torques"})
    assert set(seen) == {"joint_torques"}
    assert found.about["env"]["action_mode"] == "joint_torques"
    assert found.about["agents"][0]["env"] == RELATIVE
    with pytest.raises(UnknownOption, match="frame_skip for 'a'"):
        small(two, env={"frame_skip": 3})


Agents = dict[tuple[str, int], Agent]


def said(name: str, **card: Any) -> Agents:
    """Return an agent with what it was trained for; without it where nothing is said."""
    made_for = PolicyAbout(**{"task": "pushing", **card}) if card else None
    return {(name, 0): Agent({"name": name}, lambda env: np.sum, card=made_for)}


def test_what_is_shared_must_be_the_same() -> None:
    """Two policies that cannot be in one evaluation are named, with what differs."""
    two = said("a", env={"frame_skip": 3}) | said("b", task="pushing")
    with pytest.raises(UnknownOption, match="a with 3; b with 10: evaluate them apart"):
        shared_options(None, two)
    one = said("a", env={"max_episode_length": 100})
    two = one | said("b", task="pushing") | said("c")
    with pytest.raises(UnknownOption, match="give max_episode_length in env"):
        shared_options(None, two)
    assert shared_options({"max_episode_length": 50}, two) == {"max_episode_length": 50}
    assert shared_options(None, one | said("c")) == {"max_episode_length": 100}
    assert shared_options(None, said("c")) == {}


def test_the_task_is_that_of_the_policies() -> None:
    """Unless another one is given; several tasks have to be told apart."""
    picking, reaching = said("a", task="picking"), said("b", task="reaching")
    assert task_for(None, picking | said("c")) == "picking"
    with pytest.warns(UserWarning, match="trained for the task 'picking', and acts in 'general'"):
        assert task_for("general", picking) == "general"
    assert task_for(None, said("c")) == "pushing"
    with pytest.raises(UnknownOption, match="'picking', 'reaching'"):
        task_for(None, picking | reaching)


@pytest.mark.filterwarnings("ignore:.*was trained for the task")
def test_another_task_needs_as_many_numbers() -> None:
    """A policy can be tried in a task that it was not trained for, if it can see it."""
    assert small({"a": policy(env=RELATIVE)}, task="picking").task == "picking"
    with pytest.raises(EvaluationError, match=r"agent a, run 0: .*observes 56 numbers"):
        small({"a": policy(env=RELATIVE)}, task="stacking2")


def test_a_model_of_another_observation_is_refused_with_both_shapes() -> None:
    """One of Stable-Baselines3 says what it observes; it is asked before it acts."""

    class Model:
        observation_space = gymnasium.spaces.Box(-1.0, 1.0, (37,), np.float32)

        def predict(self, observation: Any, **_: Any) -> Any:
            return np.zeros(9), None

    form = {"action_mode": "joint_positions", "max_episode_length": 5}
    how: dict[str, Any] = {"n": 1, "backend": "fake", "env": form}
    with pytest.raises(EvaluationError, match=r"shape \(37,\), .* shows \(56,\); give the options"):
        evaluate(Model(), "P0", task="pushing", **how)
    found = evaluate(Model(), "P0", task="reaching", **how)
    assert len(found.frame["steps"]) == 1


def test_a_policy_in_memory_says_how_it_observes_and_acts(tmp_path: Path) -> None:
    """It does what the same network in a file does, whose form it has, bit for bit."""
    network = policy(173)  # with the parameters that it does not observe anyhow
    form = {**RELATIVE, "context": "observation"}

    def act(observation: Any) -> Any:
        return network(observation)

    made = as_agent(act, env=form)
    path = trained(tmp_path / "a.safetensors", 173, env=form)
    how: dict[str, Any] = {"task": "picking", "env": SHORT}
    with pytest.warns(UserWarning, match="was trained for the task"):
        found = small({"memory": made, "file": str(path), "still": "still"}, "P6", **how)
    hashes = [found.only(agent=name).frame["hash"].tolist() for name in ("memory", "file")]
    assert hashes[0] == hashes[1]
    assert found.about["agents"][0]["env"] == form
    assert why(found.only(agent="memory"), "P6", 1).others


def test_a_form_that_does_not_exist_or_contradicts_is_refused() -> None:
    """Also where the agent acts in an environment that was made by hand."""
    with pytest.raises(ModelError, match="'contxt' is not one of the options"):
        as_agent(abs, env={"contxt": "observation"})
    with pytest.raises(UnknownOption, match="context for 'scm_world"):
        as_agent(policy(env=RELATIVE), env={"context": "observation"})
    known = policy(env=RELATIVE)
    assert as_agent(known, env={"delta_scale": 0.1}).card == known.made_for
    env = gymnasium.make("scm_world/Pushing-v0", backend="fake").unwrapped
    env.reset(seed=0)
    with pytest.raises(UnknownOption, match="context for 'evaluation_samples:linear'"):
        as_agent("evaluation_samples:linear", env={"context": "observation"}).start(env)
    about = as_agent("evaluation_samples:linear").about
    made = agent_from(about, trusted=("evaluation_samples",), env={"delta_scale": 0.5})
    assert made.card is not None
    assert made.card.env == {"delta_scale": 0.5}


def test_an_object_with_start_and_act_is_an_agent() -> None:
    """It brings its form as its card, and remembers until it is told to forget."""

    class Mine:
        card = PolicyAbout(task="any", env=RELATIVE)
        episodes = 0

        def start(self, env: Any) -> None:
            self.episodes += 1

        def act(self, observation: Any) -> Any:
            return np.full(9, 0.1 * self.episodes)

        def forget(self) -> None:
            self.episodes = 0

    agent = as_agent(Mine())
    assert agent.keeps
    assert not as_agent("still").keeps
    found = small({"mine": agent, "class": Mine, "still": "still"}, "P0", task="pushing")
    assert found.about["agents"][0]["env"] == RELATIVE
    assert (
        found.only(agent="mine").frame["hash"].tolist()
        == found.only(agent="class").frame["hash"].tolist()
    )
    assert found.only(agent="mine").frame["hash"].nunique() == 1  # each is its first episode
