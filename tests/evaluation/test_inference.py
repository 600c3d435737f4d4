"""Facts about what an agent infers: planted answers are found, and controls tell them apart."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world import Action, Box, Exogenous, Measured, StepTask
from scm_world.env import ScmWorldEnv
from scm_world.errors import UnknownOption, UnreadableFile
from scm_world.evaluation import Inferred, evaluate, inferred
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


HOW: dict[str, Any] = {"n": 40, "env": {"normalize_observations": False}}


def masses(episodes: Any) -> np.ndarray:
    """Return the masses that the protocol draws."""
    from scm_world.evaluation import Protocol
    from scm_world.evaluation.episodes import under

    env = ScmWorldEnv(Cart())
    acting, found = under(env, Protocol("drawn", ("mass", "color"))), []
    for episode in episodes:
        acting.reset(seed=0, options={"episode": episode})
        found.append(env.world["mass"].item())
    return np.array(found)


def test_what_the_hidden_state_has_by_construction_is_inferred() -> None:
    """The estimate of the mass is found at each step but the first, and nothing of the color."""
    found = inferred(Learner(), ("mass", "color"), task=Cart(), steps=(0, 5), **HOW)
    assert found.verdicts()["mass"] == "inferred"
    by_place = {(one.variable, one.step): one for one in found.probes}
    assert by_place["mass", 0].verdict != "inferred"
    assert by_place["mass", 5].verdict == by_place["mass", -1].verdict == "inferred"
    assert by_place["mass", 5].scores["hidden"]["kernel"].value > 0.9
    assert by_place["mass", 5].scores["observation"]["kernel"].value < 0.3
    assert all(one.verdict != "inferred" for one in found.probes if one.variable == "color")
    assert "untrained" not in by_place["mass", 5].scores
    assert "no method untrained" in found.left_out["untrained network"]


def test_changes_of_the_action_are_those_of_the_closed_form() -> None:
    """All by the memory: 0.1 / mass more or less; in the direction of who knows the mass."""
    told = WorldPolicy(learned)
    found = inferred(Learner(), ("mass", "color"), task=Cart(), privileged=told, **HOW)
    mass = {one.part: one for one in found.changes if one.variable == "mass"}
    other = 2**30 + np.arange(40)
    expected = 0.1 / masses(other) - 0.1 / masses(range(40))
    for part in ("own", "memory"):
        assert mass[part].size.value == pytest.approx(np.abs(expected).mean(), rel=1e-5)
        assert mass[part].effect.value == pytest.approx(np.abs(expected).mean(), rel=1e-5)
        assert (mass[part].verdict, mass[part].agrees) == ("change", True)
        assert mass[part].agreement is not None
        assert mass[part].agreement.value == pytest.approx(1.0)
    assert (mass["reaction"].size.value, mass["reaction"].verdict) == (0.0, "no change")
    assert mass["reaction"].agrees is None
    assert all(one.size.value == 0.0 for one in found.changes if one.variable == "color")
    found = inferred(Learner(), "mass", task=Cart(), privileged=WorldPolicy(opposite), **HOW)
    assert [one.agrees for one in found.changes] == [False, None, False]


def test_a_policy_of_the_world_reacts_without_memory() -> None:
    """Its action is a function of the mass: all of the change is a reaction; it shows no state."""
    found = inferred(WorldPolicy(learned), "mass", task=Cart(), at=3, after=2, **HOW)
    own, reaction, memory = found.changes
    assert own.size == reaction.size
    assert own.size.value > 0.01
    assert (memory.size.value, memory.verdict) == (0.0, "no change")
    assert (found.probes, found.verdicts()) == ((), {})
    assert "no hidden state" in str(found)
    assert found.about["twins"] == [3, 2]


def test_without_memory_nothing_is_inferred_and_what_is_seen_is_not() -> None:
    """The mass is not in the velocity; where a scale shows it, the observation is the reason."""
    found = inferred(Blind(), "mass", task=Cart(), twins=False, **HOW)
    assert found.verdicts()["mass"].startswith("no")
    assert found.changes == ()

    class Reader(Blind):
        def hidden(self, observation: Any) -> Any:
            return observation

    found = inferred(Reader(), "mass", task=Weighed(), twins=False, **HOW)
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
    found = inferred(policy, "mass", task=Weighed(), twins=False, n=40)
    scores = found.probes[-1].scores
    assert scores["untrained"]["kernel"].value > 0.9
    assert found.verdicts()["mass"].startswith("no")


def test_a_memory_is_part_of_the_hidden_state() -> None:
    """After an action the state is the last hidden layer, from the old memory, and the new one."""
    rng = np.random.default_rng(1)
    tensors = {
        "layers.0.weight": rng.normal(size=(4, 3)).astype(np.float32),
        "layers.0.bias": rng.normal(size=4).astype(np.float32),
        "layers.1.weight": rng.normal(size=(3, 4)).astype(np.float32),
        "layers.1.bias": rng.normal(size=3).astype(np.float32),
    }
    policy = MlpPolicy.of(tensors, {"task": "cart", "memory": 2})
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
        expected = np.concatenate([policy.hidden(observation, before), state])
        assert np.array_equal(agent.hidden(), expected)
        observation = env.step(action)[0]
    assert as_agent("still").hidden() is None


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
    """The table of causes has what the agent infers; the mass decides, and the blind agent lacks it."""
    found = evaluate(Blind(), "A", task=Cart(), n=60, env=HOW["env"])
    causes = found.causes("A", inferred=inferred(Blind(), "mass", task=Cart(), twins=False, **HOW))
    text = str(causes)
    assert "inferred by the agent" in text
    assert ("mass matters, and the agent does not infer it" in text) == (
        "mass" in [cause.variable for cause in causes.found()]
    )
    assert "not probed" in text
    assert "inferred by the agent" not in str(found.causes("A"))


def test_logarithmic_spaces_are_probed_on_their_scale() -> None:
    """A linear probe of the logarithm finds a cause over three decades."""

    class Told(Weighed):
        pass

    class Reader(Blind):
        def hidden(self, observation: Any) -> Any:
            return [np.log(observation[1])]

    wide = {"mass": Continuous("loguniform", a=0.01, b=10.0)}
    found = inferred(Reader(), wide, task=Told(), twins=False, **HOW)
    assert found.probes[-1].scores["hidden"]["linear"].value > 0.999


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"variables": "force"}, "force"),
        ({"variables": {}}, "variables"),
        ({"steps": (12,)}, "steps"),
        ({"at": 0}, "at"),
        ({"at": 6, "after": 6}, "at \\+ after"),
        ({"policy": [Blind(), Blind()]}, "several"),
        ({"backend": "step,fake"}, "."),
    ],
)
def test_what_cannot_be_is_refused(given: dict[str, Any], said: str) -> None:
    """Before the first episode."""
    with pytest.raises(Exception, match=said) as refused:
        inferred(**{"policy": Blind(), "variables": "mass", "task": Cart(), "n": 12, **given})
    assert isinstance(refused.value, UnknownOption | Exception)


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
