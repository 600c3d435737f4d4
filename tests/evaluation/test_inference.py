"""Facts about what an agent infers: planted answers are found, and controls tell them apart."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from scm_world import Action, Box, Exogenous, Measured, StepTask
from scm_world.cli.app import app
from scm_world.env import ScmWorldEnv
from scm_world.errors import ScmWorldError, UnknownOption, UnreadableFile
from scm_world.evaluation import Inferred, Protocol, evaluate, inferred
from scm_world.evaluation.statistics.probes import probe
from scm_world.policies import MlpPolicy, WorldPolicy, as_agent
from scm_world.variables import Continuous


def push(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """Push a cart without friction for a tenth of a second."""
    return {"velocity": state["velocity"] + 0.1 * action["force"] / parameters["mass"]}


class Cart(StepTask):
    """A cart of unknown mass, which begins with any velocity."""

    parameters = (
        Exogenous(name="mass", default=1.0, a=Box(0.5, 2.0), bounds=Box(0.01, 10.0)),
        Exogenous(name="color", default=0.5, a=Box(0.0, 1.0), bounds=Box(0.0, 1.0)),
    )
    states = (Measured(name="velocity", default=0.0, parents=("mass", "velocity")),)
    actions = (Action(name="force", bounds=Box(-1.0, 1.0)),)
    start, observe = {"velocity": Box(-3.0, 3.0)}, ("velocity",)
    reward = (np.negative, "velocity")
    seconds, control_dt, step = 1.2, 0.1, staticmethod(push)


class Weighed(Cart):
    """A scale shows its mass."""

    observe = ("velocity", "mass")


class Learner:
    """Estimates 0.1 / mass from the last velocities and the force between, and acts by that."""

    def reset(self) -> None:
        """Forget the episode."""
        self.last, self.estimate = None, 0.0

    def __call__(self, observation: Any) -> Any:
        """Push by how the cart gave way."""
        if self.last is not None:
            self.estimate = float(observation[0] - self.last[0]) / self.last[1]
        action = 0.5 + self.estimate
        self.last = observation[0], action
        return np.array([action])

    def hidden(self, observation: Any) -> Any:
        """Tell the estimate, and the velocity."""
        return [self.estimate, observation[0]]


class Blind:
    """Has no memory, and shows what it sees."""

    def __call__(self, observation: Any) -> Any:
        """Push."""
        return np.array([0.5])

    def hidden(self, observation: Any) -> Any:
        """Tell the observation and its square."""
        return [observation[0], observation[0] ** 2]


def learned(world: Any) -> Any:
    """Act as the learner does that knows the mass."""
    return np.array([0.5 + 0.1 / world["mass"].item()])


def opposite(world: Any) -> Any:
    """Push less where it would push more."""
    return 1.0 - learned(world)


FROM_REST = {"start": {"velocity": 0.0}}
HOW: dict[str, Any] = {"n": 24, "env": {"normalize_observations": False}}


@pytest.fixture(scope="module")
def learner() -> Inferred:
    """Ask about the learner once."""
    told = WorldPolicy(learned)
    return inferred(Learner(), ("mass", "color"), task=Cart(), steps=(0, 5), privileged=told, **HOW)


def masses(episodes: Any) -> np.ndarray:
    """Return the masses that the protocol draws."""
    from scm_world.evaluation.episodes import under

    env = ScmWorldEnv(Cart())
    acting, found = under(env, Protocol("drawn", ("mass", "color"))), []
    for episode in episodes:
        acting.reset(seed=0, options={"episode": episode})
        found.append(env.world["mass"].item())
    return np.array(found)


def test_what_the_hidden_state_has_by_construction_is_inferred(learner: Inferred) -> None:
    """The estimate of the mass is found at each step but the first, and nothing of the color."""
    assert learner.verdicts() == {"mass": "inferred", "color": "no"}
    by_place = {(one.variable, one.step): one for one in learner.probes}
    assert by_place["mass", 0].verdict == "no"
    assert by_place["mass", 5].verdict == by_place["mass", -1].verdict == "inferred"
    assert by_place["mass", 5].scores["hidden"]["kernel"].value > 0.9
    assert by_place["mass", 5].scores["observation"]["kernel"].value < 0.3
    assert "untrained" not in by_place["mass", 5].scores
    assert "no method untrained" in learner.left_out["untrained network"]


def test_changes_of_the_action_are_those_of_the_closed_form(learner: Inferred) -> None:
    """All by the memory: 0.1 / mass more or less; in the direction of who knows the mass."""
    mass = {one.part: one for one in learner.changes if one.variable == "mass"}
    expected = 0.1 / masses(2**30 + np.arange(24)) - 0.1 / masses(range(24))
    for part in ("own", "memory"):
        assert mass[part].size.value == pytest.approx(np.abs(expected).mean(), rel=1e-5)
        assert mass[part].effect.value == pytest.approx(np.abs(expected).mean(), rel=1e-5)
        assert (mass[part].verdict, mass[part].agrees) == ("change", True)
        assert mass[part].agreement is not None
        assert mass[part].agreement.value == pytest.approx(1.0)
    assert (mass["reaction"].size.value, mass["reaction"].verdict) == (0.0, "no change")
    assert mass["reaction"].agrees is None
    assert all(one.size.value == 0.0 for one in learner.changes if one.variable == "color")


def test_another_direction_is_no_agreement() -> None:
    """The privileged agent pushes less where the learner pushes more."""
    how = {**HOW, "n": 12, "privileged": WorldPolicy(opposite)}
    found = inferred(Learner(), "mass", task=Cart(), **how)
    assert [one.agrees for one in found.changes] == [False, None, False]


def test_a_policy_of_the_world_reacts_without_memory() -> None:
    """Its action is a function of the mass: all of the change is a reaction; it shows no state."""
    found = inferred(WorldPolicy(learned), "mass", task=Cart(), at=3, after=2, **{**HOW, "n": 12})
    own, reaction, memory = found.changes
    assert own.size == reaction.size
    assert own.size.value > 0.01
    assert (memory.size.value, memory.verdict) == (0.0, "no change")
    assert (found.probes, found.verdicts()) == ((), {})
    assert "no hidden state" in str(found)
    assert found.about["twins"] == [3, 5]


def test_a_cause_may_be_drawn_within_episodes() -> None:
    """Before, it has its default, about which there is nothing to infer."""
    late = Protocol("late", "mass", step=4)
    found = inferred(Learner(), late, task=Cart(), steps=(2,), at=0, **HOW)
    assert found.left_out["mass at step 2"] == "it was 1 in every episode"
    assert [(one.step, one.verdict) for one in found.probes] == [(-1, "inferred")]


def test_without_memory_nothing_is_inferred_and_what_is_seen_is_not() -> None:
    """The mass is not in the velocity; where a scale shows it, the observation is the reason."""
    found = inferred(Blind(), "mass", task=Cart(), at=0, **HOW)
    assert found.verdicts()["mass"].startswith("no")
    assert found.changes == ()

    class Reader(Blind):
        def hidden(self, observation: Any) -> Any:
            return observation

    found = inferred(Reader(), "mass", task=Weighed(), at=0, **HOW)
    assert found.probes[-1].scores["hidden"]["linear"].value > 0.99
    assert found.verdicts() == {"mass": "no: observation"}


def test_networks_have_an_untrained_control() -> None:
    """A network of what it sees: its random likeness shows as much."""
    rng = np.random.default_rng(0)
    tensors = {
        "layers.0.weight": rng.normal(size=(8, 2)).astype(np.float32),
        "layers.0.bias": np.zeros(8, np.float32),
        "layers.1.weight": rng.normal(size=(1, 8)).astype(np.float32),
        "layers.1.bias": np.zeros(1, np.float32),
    }
    policy = MlpPolicy.of(tensors)
    seen = rng.normal(size=(5, 2)).astype(np.float32)
    hidden = np.tanh(seen.astype(np.float64) @ tensors["layers.0.weight"].T.astype(np.float64))
    assert np.allclose(policy.hidden(seen), hidden, rtol=1e-12)
    other = policy.untrained(3)
    assert other.tensors().keys() == tensors.keys()
    assert not np.array_equal(other.hidden(seen), policy.hidden(seen))
    assert np.array_equal(other.hidden(seen), policy.untrained(3).hidden(seen))
    found = inferred(policy, "mass", task=Weighed(), at=0, n=24, env=FROM_REST)
    assert {one.variable for one in found.probes} == {"mass"}  # not what the environment sets
    scores = found.probes[-1].scores
    assert scores["untrained"]["kernel"].value > 0.9
    assert found.verdicts()["mass"].startswith("no")


@pytest.mark.parametrize("kind", ["signs", "lstm"])
def test_a_memory_is_part_of_the_hidden_state(kind: str) -> None:
    """After an action the state is the last hidden layer, from the old memory, and the new one."""
    rng = np.random.default_rng(1)
    shapes = {"layers.0": (4, 3), "layers.1": (3, 4)}
    if kind == "lstm":
        shapes = {"lstm.0": (8, 1), "lstm.1": (8, 2), "layers.0": (4, 2), "layers.1": (1, 4)}
    tensors = {}
    for name, shape in shapes.items():
        tensors[f"{name}.weight"] = rng.normal(size=shape).astype(np.float32)
        tensors[f"{name}.bias"] = rng.normal(size=shape[0]).astype(np.float32)
    policy = MlpPolicy.of(tensors, {"task": "cart", "memory": 2 * (kind == "signs")})
    assert policy.untrained().tensors().keys() == tensors.keys()
    env = ScmWorldEnv(Cart())
    agent = as_agent(policy)
    observation, _ = env.reset(seed=0)
    agent.start(env)
    assert agent.hidden() is None
    state = None
    for _ in range(3):
        before = state
        action, state = policy.predict(observation, state=before)
        assert np.array_equal(agent.act(observation), action)
        shown = np.append(observation, np.zeros(2) if before is None else before)
        shown = state[:2] if kind == "lstm" else shown  # the output of this step
        layer = np.tanh(tensors["layers.0.weight"] @ shown + tensors["layers.0.bias"])
        assert np.allclose(agent.hidden(), [*layer, *state], rtol=1e-6)
        observation = env.step(action)[0]
    assert as_agent("still").hidden() is None


def test_what_is_kept_from_other_episodes_does_not_count() -> None:
    """An agent that keeps its estimate forgets it before each episode, and for the reaction."""

    class Keeper(Learner):
        def __init__(self) -> None:
            self.forget()

        def forget(self) -> None:
            super().reset()

        def reset(self) -> None:
            self.last = None

    one, other = (
        inferred(agent, "mass", task=Cart(), steps=(3,), **{**HOW, "n": 12})
        for agent in (Keeper(), Learner())
    )
    assert (one.probes, one.changes) == (other.probes, other.changes)


def test_the_memory_of_a_model_is_its_hidden_state() -> None:
    """As recurrent models of Stable-Baselines3 have it: output and cell, each (layers, n, size)."""

    class Model:
        def predict(self, observation: Any, state: Any = None, **how: Any) -> Any:
            count = 0.0 if state is None else state[0].item()
            return np.zeros(1), (np.full((1, 1, 1), count + 1.0), np.full((1, 1, 2), -count))

    agent, env = as_agent(Model()), ScmWorldEnv(Cart())
    observation, _ = env.reset(seed=0)
    agent.start(env)
    for count in range(3):
        agent.act(observation)
        assert np.array_equal(agent.hidden(), [count + 1.0, -count, -count])


def test_results_do_not_depend_on_workers_and_are_kept(tmp_path: Path) -> None:
    """The same numbers from two processes, from finished shards, and from a file."""
    how: Any = {"task": Cart, "n": 30, "env": HOW["env"], "out": tmp_path / "out"}
    told: list[tuple[int, int]] = []
    one = inferred(Learner, "mass", progress=lambda *at: told.append(at), **how)
    assert told[-1] == (30, 30)
    assert len([*(tmp_path / "out" / "parts").iterdir()]) == 2
    again = inferred(Learner, "mass", **how)
    assert (again, str(again)) == (one, str(one))
    loaded = Inferred.load(one.save(tmp_path / "inferred.json"))
    assert json.dumps(loaded.as_dict()) == json.dumps(one.as_dict())
    assert str(loaded) == str(one)
    (tmp_path / "other.json").write_text('{"format": "other"}')
    with pytest.raises(UnreadableFile, match="scm-world infer"):
        Inferred.load(tmp_path / "other.json")


def test_causes_that_matter_and_are_not_inferred_are_marked() -> None:
    """The table of causes has what the agent infers, and names the cause that it lacks."""
    found = evaluate(Blind(), "A", task=Cart(), n=40, env={**HOW["env"], **FROM_REST})
    judged = inferred(Blind(), "mass", task=Cart(), at=0, **HOW)
    text = str(found.causes("A", inferred=judged))
    assert "mass matters, and the agent does not infer it (no)" in text
    assert "color" in text
    assert "not probed" in text
    assert "inferred" not in str(found.causes("A"))
    others = inferred(Learner(), "mass", task=Cart(), at=0, **{**HOW, "n": 12})
    with pytest.raises(UnknownOption, match="the policy of 'Blind'"):
        found.causes("A", inferred=others)


def test_the_command_writes_and_explain_reads(tmp_path: Path) -> None:
    """The table, its file, and the mark in explain: of causes and of one episode."""
    task, agent = f"{__file__}:Cart", "test_inference:Blind"
    call = partial(CliRunner(env={"COLUMNS": "200"}).invoke, app)
    given = ["infer", agent, task, "--variables=mass", "-n12", "--at=2", "--after=1", "--steps=3"]
    done = call([*given, "--workers=1", "--steps=five"])
    assert "expected control steps" in done.output, done.output
    done = call([*given, "--workers=1", f"--out={tmp_path}"])
    assert done.exit_code == 0, done.output
    assert "no change" in done.output
    found = Inferred.load(tmp_path)
    assert found.as_dict() == Inferred.load(tmp_path / "inferred.json").as_dict()
    assert (found.about["steps"], found.about["twins"]) == ([3, -1], [2, 3])
    evaluate(agent, "A", task=task, n=20, env=FROM_REST).save(tmp_path)
    given = ["explain", str(tmp_path), f"--inferred={tmp_path / 'inferred.json'}"]
    done = call(given)
    assert "mass matters, and the agent does not infer it" in done.output, done.output
    done = call(
        [*given, "--protocol=A", "--episode=0", "--versus=default", "--trust=test_inference"]
    )
    assert "mass matters, and the agent does not infer it" in done.output, done.output


def test_logarithmic_spaces_are_probed_on_their_scale() -> None:
    """A linear probe of the logarithm finds a cause over three decades."""

    class Told(Weighed):
        pass

    class Reader(Blind):
        def hidden(self, observation: Any) -> Any:
            return [np.log(observation[1])]

    wide = {"mass": Continuous("loguniform", a=0.01, b=10.0)}
    found = inferred(Reader(), wide, task=Told(), at=0, **HOW)
    assert found.probes[-1].scores["hidden"]["linear"].value > 0.999


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"variables": "force"}, "force"),
        ({"variables": {}}, "variables"),
        ({"steps": (12,)}, "steps"),
        ({"at": -1}, "at"),
        ({"at": 6, "after": 6}, "at \\+ after"),
        ({"policy": [Blind(), Blind()]}, "several"),
        ({"backend": "step,fake"}, "fake"),
    ],
)
def test_what_cannot_be_is_refused(given: dict[str, Any], said: str) -> None:
    """Before the first episode."""
    with pytest.raises(ScmWorldError, match=said):
        inferred(**{"policy": Blind(), "variables": "mass", "task": Cart(), "n": 12, **given})


def test_probes_are_those_of_a_direct_regression() -> None:
    """Of a linear law the linear probe finds the share of the noise; of a square the kernel one."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(400, 3))
    y = np.stack([x @ [1.0, -2.0, 0.5] + 0.5 * rng.normal(size=400), x[:, 0] ** 2], axis=1)
    (line, shuffled), (square, _) = probe(x, y)
    assert line["linear"].value == pytest.approx(5.25 / 5.5, abs=0.02)
    assert line["linear"].low < line["linear"].value < line["linear"].high
    assert square["linear"].value < 0.1
    assert square["kernel"].value > 0.9
    assert abs(shuffled["linear"].value) < 0.05
    assert shuffled["linear"].high < 0.1


def test_a_network_with_a_history_infers_what_its_weights_compute() -> None:
    """One unit is the last change of velocity under a constant force, 0.05 / mass."""
    tensors = {
        "layers.0.weight": np.array([[1.0, -1.0, 0.0]], np.float32),  # velocity, @-1, action@-1
        "layers.0.bias": np.zeros(1, np.float32),
        "layers.1.weight": np.zeros((1, 1), np.float32),
        "layers.1.bias": np.full(1, 0.5, np.float32),
    }
    form = {"history": 1, "normalize_observations": False}
    policy = MlpPolicy.of(tensors, {"task": "Cart", "env": form})
    found = inferred(policy, "mass", task=Cart(), steps=(0, 5), n=24)
    assert [one.verdict for one in found.probes] == ["no", "inferred", "inferred"]
    scores = found.probes[1].scores
    assert scores["observation"]["kernel"].high < 0.5 < 0.9 < scores["hidden"]["kernel"].value
    assert "untrained" in scores
    assert [one.size.value for one in found.changes] == [0.0, 0.0, 0.0]
    tensors["layers.0.weight"] = np.array([[0.0, 0.1, 0.0]], np.float32)
    tensors["layers.1.weight"] = np.ones((1, 1), np.float32)
    policy = MlpPolicy.of(tensors, {"task": "Cart", "env": form})
    own, reaction, memory = inferred(policy, "mass", task=Cart(), steps=(), n=12).changes
    assert own.size.value > 0.0 == reaction.size.value  # an emptied history has no last velocity
    assert memory.size == own.size
