"""Facts about the reward terms that are there for the asking."""

from __future__ import annotations

import json
from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

import scm_world  # noqa: F401 # registers the environments
from scm_world.errors import UnknownOption
from scm_world.geometry.rotations import from_rotation_vector, rotation_matrix
from scm_world.tasks import TASKS
from scm_world.tasks.trifinger import kernels

SIZE = np.array([0.065, 0.05, 0.08])
GOAL = np.array([0.05, -0.02, 0.0325])
PUSHING = "scm_world/Pushing-v0"
TERMS: dict[str, Any] = {
    "terms": ["reward.goal_kernel", "reward.corners_to_goal", "reward.speed"],
    "weights": {"reward.goal_kernel": 2.0, "reward.corners_to_goal": 30.0, "reward.speed": 0.1},
}


def corners(position: NDArray[Any], turn: NDArray[Any]) -> NDArray[Any]:
    """List the corners of a box, by the matrix of its rotation."""
    signs = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(8, 3)
    return np.asarray((signs * SIZE) @ rotation_matrix(turn).T + position)


def pose(seed: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Draw where a box is, and how it is turned."""
    random = np.random.default_rng(seed)
    return random.uniform(-0.1, 0.1, 3), from_rotation_vector(random.uniform(-2.0, 2.0, 3))


@pytest.mark.parametrize("seed", range(3))
def test_the_kernel_of_the_corners_is_the_published_one(seed: int) -> None:
    """4 / (e^(s d) + 2 + e^(-s d)) of the mean distance of eight corners."""
    (here, turn), (there, goal_turn) = pose(seed), pose(seed + 10)
    far = np.linalg.norm(corners(here, turn) - corners(there, goal_turn), axis=-1).mean()
    found = kernels.goal_kernel(SIZE, here, turn, SIZE, there, goal_turn, sharpness=30.0)
    assert found == pytest.approx(4.0 / (np.exp(30.0 * far) + 2.0 + np.exp(-30.0 * far)))


def test_a_kernel_ends_at_one_and_at_zero() -> None:
    """Where block and goal are one, and where they are far apart."""
    here, turn = pose(0)
    found = kernels.goal_kernel(SIZE, here, turn, SIZE, here, -turn, sharpness=30.0)
    assert found == pytest.approx(1.0)
    assert kernels.logistic(100.0, kernels.FINE) == pytest.approx(0.0, abs=1e-300)
    assert kernels.logistic(np.log(3 + np.sqrt(8)) / kernels.COARSE, kernels.COARSE) == (
        pytest.approx(0.5)
    )


def test_corners_come_nearer() -> None:
    """By what the block moves, if it does not turn; turning it back counts as well."""
    still, turned = np.array([0.0, 0.0, 0.0, 1.0]), from_rotation_vector(np.array([0, 0, 0.5]))
    want = (SIZE, np.zeros(3), still)
    moved = kernels.corners_progress(SIZE, GOAL / 2, still, GOAL, still, *want)
    assert moved == pytest.approx(np.linalg.norm(GOAL) / 2)
    assert kernels.corners_progress(SIZE, np.zeros(3), still, np.zeros(3), turned, *want) > 0.01


def test_a_block_is_pushed_from_behind() -> None:
    """Five centimeters behind it, seen from the goal; the nearest fingertip counts."""
    block, goal = np.array([0.0, -0.08, 0.03]), np.array([0.0, 0.02, 0.03])
    behind = np.array([0.0, -0.13, 0.03])
    tips = np.concatenate([behind, behind + 1.0, behind - 1.0])
    assert kernels.pushing_distance(tips, block, goal) == pytest.approx(0.0, abs=1e-12)
    away = tips + np.tile([0.03, 0.0, 0.04], 3)
    assert kernels.pushing_progress(tips, away, block, block, goal) == pytest.approx(0.05)
    there = np.concatenate([goal, goal, goal])
    assert kernels.pushing_distance(there, goal, goal) == 0.0


def test_the_fingertips_have_a_kernel_each() -> None:
    """Its mean over the three; speed is a norm."""
    tips, goals = np.arange(9) / 100, np.zeros((3, 3))
    far = np.linalg.norm(tips.reshape(3, 3), axis=1)
    expected = np.mean(4.0 / (np.exp(30.0 * far) + 2.0 + np.exp(-30.0 * far)))
    assert kernels.reach_kernel(tips, *goals, sharpness=30.0) == pytest.approx(expected)
    assert kernels.minus_length(np.array([3.0, 0.0, 4.0])) == -5.0


@pytest.mark.parametrize("name", TASKS)
def test_each_task_has_terms_by_name(name: str) -> None:
    """They are asked for by name, and stand in its reward with their weights."""
    for ready in TASKS[name].ready_terms:
        chosen: Any = {"terms": [ready.name], "weights": {ready.name: 1.0}}
        env: Any = gymnasium.make(f"scm_world/{_id(name)}-v0", backend="fake", task_options=chosen)
        env.reset(seed=0)
        *_, info = env.step(np.zeros(9, np.float32))
        assert np.isfinite(info["reward_terms"][ready.name])


def _id(name: str) -> str:
    return "".join(word.capitalize() for word in name.split("_"))


def test_weights_are_no_terms() -> None:
    """Weights beside the names would be lost; there is an option for them."""
    with pytest.raises(UnknownOption, match="terms cannot be"):
        TASKS["pushing"](terms={"reward.speed": 1.0})  # type: ignore[call-arg] # every task has it


@pytest.mark.parametrize("terms", [["reward.goal_kernl"], ["reward.reach_kernel"]], ids=repr)
def test_an_unknown_name_is_answered_with_those_of_the_task(terms: list[str]) -> None:
    """And so is a name that only another task has."""
    with pytest.raises(UnknownOption, match=terms[0]) as refused:
        TASKS["pushing"](terms=terms)  # type: ignore[call-arg] # every task has the option
    assert {term.name for term in TASKS["pushing"].ready_terms} <= {*refused.value.choices}


def test_names_are_plain_data() -> None:
    """An environment with such terms is written to JSON and made again."""
    env = gymnasium.make(PUSHING, backend="fake", task_options=TERMS)
    assert env.spec is not None
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert json.loads(env.spec.to_json())["kwargs"]["task_options"] == TERMS
    action = np.full(9, 0.3, np.float32)
    rewards = []
    for made in (env, again):
        made.reset(seed=1)
        rewards.append([made.step(action)[1] for _ in range(3)])
    assert rewards[0] == rewards[1]
    assert len({*rewards[0]}) > 1


def test_many_worlds_give_the_rewards_of_single_ones() -> None:
    """Bit for bit, in compiled loops."""
    options: dict[str, Any] = {"backend": "mujoco", "task_options": TERMS}
    envs = gymnasium.make_vec(PUSHING, 2, **options)
    envs.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 2, 9)).astype(np.float32)
    together = np.array([envs.step(action)[1] for action in actions])
    for index in range(2):
        env = gymnasium.make(PUSHING, **options)
        env.reset(seed=index)
        assert [env.step(action[index])[1] for action in actions] == together[:, index].tolist()
        env.close()
    envs.close()
