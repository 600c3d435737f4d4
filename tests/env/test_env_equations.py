"""Environments of causal models without an engine."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import SyncVectorEnv

import scm_world as sw
from scm_world.curricula import CurriculumEnv, resample
from scm_world.env import MODEL_ID
from scm_world.errors import ActionError, ModelError, UnknownOption
from scm_world.evaluation import evaluate
from scm_world.tasks import EquationTask
from scm_world.variables import Box, Derived, Exogenous, Integers, Linear, Normal, Parent


def plant() -> sw.SCM:
    """Return a linear plant with noise in each step: a lagged action, and a cost within it."""
    return sw.SCM(
        [
            Exogenous(name="k", default=0.5, bounds=Box(0.0, 2.0), a=Box(0.2, 0.8), b=Box(0.8, 1)),
            sw.Action(name="a", bounds=Box(-1.0, 1.0)),
            Derived(
                name="s",
                parents=(Parent("s", 1), Parent("a", 1), "k"),
                mechanism=_noisy,
                noise=Normal(std=0.1),
            ),
            Derived(name="cost", parents=("s", "a"), mechanism=Linear(weights=(-1.0, -0.1))),
        ]
    )


def _noisy(s: Any, a: Any, k: Any, noise: Any) -> Any:
    return 0.9 * s + a + k + noise


def bandit() -> sw.SCM:
    """Return a bandit: u decides which of two arms nature takes, and what both earn."""
    return sw.SCM(
        [
            Exogenous(name="u", distribution=Normal()),
            Derived(name="arm", parents=("u",), mechanism=_arm, dtype="integer"),
            Derived(name="y", parents=("arm", "u"), mechanism=Linear(weights=(1.0, -3.0))),
        ]
    )


def _arm(u: Any) -> Any:
    return np.asarray(np.asarray(u) > 0.0).astype(int)


PLANT: dict[str, Any] = {"model": plant(), "reward": "cost", "observe": ["s", "k"]}
BANDIT: dict[str, Any] = {"model": bandit(), "actions": {"arm": Integers(0, 1)}, "reward": "y"}


def test_rewards_and_observations_are_those_of_the_equations() -> None:
    """Before each action s is seen; the action acts on the cost at once, and later on s."""
    with closing(gymnasium.make(MODEL_ID, **PLANT, max_episode_length=9)) as env:
        observation, _ = env.reset(seed=4, options={"do": {"k": 0.7}})
        key = env.unwrapped.world.noise_key
        s, rng = 0.0, np.random.default_rng(0)
        assert observation[0] == np.float32(s)
        for step in range(9):
            if step == 5:
                env.unwrapped.do({"s": 3.0})
                assert env.unwrapped.observe()[0] == 3.0
                s = 3.0
            a = rng.uniform(-1.5, 1.5)
            observation, reward, terminated, truncated, info = env.step(np.array([a]))
            a = min(max(a, -1.0), 1.0)
            assert reward == pytest.approx(-s - 0.1 * a, abs=1e-12)
            assert info["reward_terms"] == {"reward": reward}
            noise = float(key(step).draw(Normal(std=0.1), "s", (), {}))
            s = 3.0 if step >= 5 else 0.9 * s + a + 0.7 + noise
            assert observation[0] == np.float32(s)
            assert (terminated, truncated) == (False, step == 8)


def test_a_model_without_lags_is_a_bandit() -> None:
    """An action is do: u is what it was; an episode is one step, and it terminates."""
    with closing(
        gymnasium.make(MODEL_ID, **BANDIT, observe=["arm"], normalize_observations=False)
    ) as env:
        assert env.action_space == gymnasium.spaces.Discrete(2)
        seen, _ = env.reset(seed=3)
        for episode in range(5):
            u = float(env.unwrapped.world["u"])
            assert seen.tolist() == [0.0]  # nothing of what nature would have taken
            arm = episode % 2
            seen, reward, terminated, truncated, _ = env.step(arm)
            assert (terminated, truncated) == (True, False)
            assert (seen.tolist(), reward) == ([arm], arm - 3.0 * u)
            seen, _ = env.reset()
            assert float(env.unwrapped.world["u"]) != u
        for wrong in (2, -1, 0.5, "left", [0, 1]):
            with pytest.raises(ActionError, match=r"Discrete|shape"):
                env.step(wrong)


@pytest.mark.parametrize("given", [PLANT, BANDIT, {**PLANT, "start": {"k": "A"}}])
def test_checker_and_copies(given: dict[str, Any]) -> None:
    """Gymnasium's checker passes, and a copy continues alike."""
    with closing(gymnasium.make(MODEL_ID, **given)) as env:
        check_env(env.unwrapped)
        env.reset(seed=1)
        others = [copy.deepcopy(env.unwrapped), pickle.loads(pickle.dumps(env.unwrapped))]  # noqa: S301 # its own
        action = env.action_space.sample()
        wanted = env.step(action)
        for other in others:
            assert _equal(other.step(action)[:4], wanted[:4])


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"start": {"k": "A"}},
        {"start": {"k": 0.9, "s": sw.Shift(0.2)}},
        {"context": "privileged"},
        {"action_mode": "delta_values"},
        {"observation_mode": "full", "observe": ()},
    ],
)
def test_a_batch_is_single_environments(more: dict[str, Any]) -> None:
    """Bit for bit, over random actions, interventions in some, branches and ends of episodes."""
    n, given = 7, {**PLANT, "max_episode_length": 5, **more}
    if not given["observe"]:
        del given["observe"]
    alone = [gymnasium.make(MODEL_ID, **given) for _ in range(n)]
    with closing(gymnasium.make_vec(MODEL_ID, n, **given)) as envs:
        singles = SyncVectorEnv([lambda env=env: env for env in alone])
        assert _equal(envs.reset(seed=3), singles.reset(seed=3))
        rng = np.random.default_rng(0)
        for step in range(17):
            if step in (3, 9, 10):
                for row in rng.choice(n, 2, replace=False).tolist():
                    values = {"s": rng.normal(), "a": rng.uniform(), "k": rng.uniform()}
                    name = str(rng.choice([*values]))
                    act: dict[str, Any] = {name: float(values[name])}
                    act = {"s": sw.Shift(0.5)} if rng.uniform() < 0.3 else act
                    envs.do({row: act})
                    alone[row].unwrapped.do(act)
            if step == 12:
                kept = envs.snapshot()
            if step == 14:  # two steps back, in some of them
                envs.restore({row: kept[row] for row in (1, 2)})
                for row in (1, 2):
                    alone[row].unwrapped.restore(kept[row])
            if step == 8:  # one is stepped by itself
                action = np.array([0.25])
                assert _equal(
                    envs.envs[4].unwrapped.step(action)[:4], alone[4].unwrapped.step(action)[:4]
                )
            actions = rng.uniform(-1.2, 1.2, (n, 1)).astype(np.float32)
            found, wanted = envs.step(actions), singles.step(actions)
            assert _equal(found[:4], wanted[:4])
            row = int(rng.integers(n))
            assert _equal(
                envs.envs[row].unwrapped.world.values(), alone[row].unwrapped.world.values()
            )
        singles.close()


def test_a_batch_of_bandits_is_single_ones() -> None:
    """Discrete actions have shape (n,)."""
    with closing(gymnasium.make_vec(MODEL_ID, 5, **BANDIT)) as envs:
        assert envs.action_space == gymnasium.spaces.MultiDiscrete([2] * 5)
        seen, _ = envs.reset(seed=0)
        _, rewards, ended, _, _ = envs.step(np.array([0, 1, 0, 1, 1]))
        wanted = np.array([0, 1, 0, 1, 1]) - 3.0 * seen[:, 0].astype(float)
        assert rewards == pytest.approx(wanted, abs=1e-6)  # u is seen with 32 bits
        assert ended.all()
        with pytest.raises(ActionError, match="Discrete"):
            envs.step(np.array([0, 1, 0, 1, 2]))


def test_an_evaluation_and_a_curriculum_take_equations() -> None:
    """Protocols follow from the spaces; a curriculum draws what it says."""
    task = EquationTask(plant(), reward="cost")
    found = evaluate("random", ["P0", "A"], task=task, n=2)
    assert found.about["engines"] == ["equations"]
    assert {*found.frame["protocol"]} == {"P0", "A"}
    env = CurriculumEnv(gymnasium.make(MODEL_ID, model=task), resample("k", "B"))
    with closing(env):
        for seed in range(3):
            env.reset(seed=seed)
            assert 0.8 <= float(env.unwrapped.world["k"]) <= 1.0


def _choices() -> EquationTask:
    return EquationTask(bandit(), actions={"arm": Integers(0, 1)}, reward="y")


def test_a_training_refuses_choices_before_it_begins(tmp_path: Path) -> None:
    """Policy files hold normal distributions of numbers."""
    pytest.importorskip("stable_baselines3")
    from scm_world.training.loop import train
    from scm_world.training.recipe import Recipe

    settings: dict[str, Any] = {"n_steps": 8, "batch_size": 8}
    how: dict[str, Any] = {"settings": settings, "trials": {"protocols": []}}
    made = Recipe(task=f"{__file__}:_choices", worlds=2, steps=16, **how)
    with pytest.raises(UnknownOption, match="make_sb3"):
        train(made, out=tmp_path, backend="equations")


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, Mapping):
        return one.keys() == other.keys() and all(_equal(one[name], other[name]) for name in one)
    if isinstance(one, tuple):
        return all(map(_equal, one, other))
    return np.array_equal(one, other)


@pytest.mark.parametrize(
    ("options", "error", "told"),
    [
        ({"model": bandit(), "reward": "y"}, ModelError, "nothing acts"),
        ({**PLANT, "reward": None}, ModelError, "no reward"),
        ({**PLANT, "reward": "s2"}, ModelError, "s2"),
        ({"model": bandit(), "actions": "u", "reward": "y"}, UnknownOption, r"actions\['u'\]"),
        ({"model": bandit(), "actions": "v", "reward": "y"}, sw.errors.UnknownVariable, "v"),
        ({**BANDIT, "terminated": "y"}, UnknownOption, "one control step"),
        ({**PLANT, "backend": "mujoco"}, UnknownOption, "equations"),
        ({**PLANT, "render_mode": "rgb_array"}, UnknownOption, "render_mode"),
        ({**PLANT, "observation_mode": "pixel", "observe": None}, ModelError, "no bodies"),
        ({**PLANT, "conventions": "causal_world"}, UnknownOption, "scm_world"),
        ({**PLANT, "nonsense": 1}, UnknownOption, "nonsense"),
        ({**PLANT, "start": {"nonsense": 1}}, sw.errors.UnknownVariable, "nonsense"),
        ({**PLANT, "goal_env": True}, UnknownOption, "no goals"),
    ],
)
def test_what_does_not_fit_is_refused(
    options: dict[str, Any], error: type[Exception], told: str
) -> None:
    """The error names what was given, or what to give."""
    with pytest.raises(error, match=told):
        gymnasium.make(MODEL_ID, **options)


def test_an_action_within_its_instant_on_what_has_lags_is_refused() -> None:
    """It would begin at its start value, whatever the first action is."""
    model = sw.SCM(
        [
            sw.Action(name="a", bounds=Box(-1.0, 1.0)),
            Derived(name="s", parents=(Parent("s", 1), "a"), mechanism=Linear(weights=(0.9, 1.0))),
        ]
    )
    with pytest.raises(ModelError, match="within its instant on s"):
        EquationTask(model, reward="s")


def test_the_reward_of_a_model_may_be_the_name_of_a_variable() -> None:
    """It is its value, also with an engine."""
    pole = (
        "<mujoco><worldbody><body name='pole'><joint name='hinge' axis='0 1 0'/>"
        "<geom type='capsule' size='0.02' fromto='0 0 0 0 0 1'/></body></worldbody></mujoco>"
    )
    start = {"hinge.position": 0.3}
    with closing(gymnasium.make(MODEL_ID, model=pole, reward="hinge.position", start=start)) as env:
        env.reset(seed=0)
        for _ in range(3):
            _, reward, *_ = env.step(env.action_space.sample())
            assert reward == float(env.unwrapped.world["hinge.position"]) != 0.0


@pytest.mark.parametrize("is_alone", [True, False])
def test_a_function_that_fails_leaves_all_environments_as_they_were(is_alone: bool) -> None:
    """The error names the environment, and the others go on."""
    model = sw.SCM(
        [
            sw.Action(name="a", bounds=Box(-1.0, 1.0)),
            Derived(name="s", parents=(Parent("s", 1), Parent("a", 1)), mechanism=_falls),
        ]
    )
    options: dict[str, Any] = {"model": model, "reward": "s", "observe": ["s"]}
    with closing(gymnasium.make_vec(MODEL_ID, 1 if is_alone else 3, **options)) as envs:
        envs.reset(seed=0)
        actions = np.array([[1.0]] if is_alone else [[0.0], [1.0], [0.5]])
        for _ in range(2):
            envs.step(actions)
        number = 0 if is_alone else 1
        with pytest.raises(sw.errors.FunctionFailure, match=f"environment {number}: .*too far"):
            envs.step(actions)
        assert [env.unwrapped.world.index for env in envs.envs] == [2] * envs.num_envs
        assert envs.present()[0][number] == 2.0
        single = envs.envs[number].unwrapped
        with pytest.raises(sw.errors.FunctionFailure, match="too far"):
            single.step(np.array([1.0]))
        assert single.observe() == 2.0
        assert envs.step(0.0 * actions)[0][number] == 2.0


def _falls(s: Any, a: Any) -> Any:
    if np.any(np.asarray(s) + np.asarray(a) > 2.5):
        raise ValueError("too far")
    return s + a
