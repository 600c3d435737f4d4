"""Environments that the engine steps together are, bit for bit, environments that take turns."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv
from many_envs import KINDS, check_same, make

from scm_world.env import ScmWorldEnv, ScmWorldVectorEnv
from scm_world.errors import ActionError, EngineFailure, ModelError
from scm_world.tasks import Pushing
from scm_world.tasks.rewards import term

COUNT = 4

OPTIONS: list[dict[str, Any]] = [
    {},
    {"action_mode": "joint_torques"},
    {"action_mode": "end_effector_positions"},
    {"action_mode": "delta_joint_positions"},
    {"action_mode": "delta_joint_positions", "delta_scale": 0.1, "delta_origin": "measured"},
    {"action_mode": "delta_joint_torques"},
    {"action_mode": "delta_end_effector_positions"},
    {"goal_env": True},
    {"context": "privileged"},
    {"context": "observation"},
    {"observation_mode": "full"},
    {"keypoints": "view"},
    {"observation_mode": "pixel", "image_size": 12, "cameras": ["60"]},
    {"conventions": "causal_world"},
    {"normalize_actions": False, "normalize_observations": False},
    {"task": "stacking2"},
    {"task": "reaching"},
    {"task": "general", "task_options": {}},
    {"backend": "bullet"},
]


def pair(count: int = COUNT, threads: int = 2, **options: Any) -> tuple[Any, Any]:
    """Make Gymnasium's own kind and ours, at the beginning of the same episodes."""
    single = [partial(ScmWorldEnv, **options)] * count
    both = SyncVectorEnv(single), ScmWorldVectorEnv(count, threads=threads, **options)
    for envs in both:
        check_same(envs.reset(seed=3), both[0].reset(seed=3), "reset")
    return both


def actions(envs: Any, steps: int) -> Any:
    """Draw actions from the whole space, shape (steps, n, 9)."""
    space: Any = envs.single_action_space
    generator = np.random.default_rng(0)
    bounds = np.clip(space.low, -1e3, 1e3), np.clip(space.high, -1e3, 1e3)
    return generator.uniform(*bounds, (steps, envs.num_envs, 9)).astype(np.float32)


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_every_kind_of_environment(options: dict[str, Any]) -> None:
    """Whatever is observed and however it is commanded, single environments say the same."""
    single, native = pair(**options)
    begin = {"do": {"floor_friction": 0.5}, "reset_mask": np.arange(COUNT) == 1}
    for step, asked in enumerate(actions(native, 6)):
        check_same(native.step(asked), single.step(asked), f"step {step}")
        if step == 3:
            check_same(*(envs.reset(options=dict(begin)) for envs in (native, single)), "reset")
    single.close()
    native.close()


def test_everything_that_can_be_done_to_one() -> None:
    """Interventions, resets and branches of single environments leave all others alone."""
    single, native = pair(action_mode="delta_joint_positions", max_episode_length=9)
    joints = [0.0, 0.9, -1.7] * 3
    one, two, three, four = single.envs
    again = {"reset_mask": np.arange(COUNT) == 1}
    meddling: dict[int, tuple[Any, Any]] = {
        2: (
            lambda: native.do({0: {"gravity": [0, 0, -8.0]}, 2: {"joint_positions": joints}}),
            lambda: (one.do({"gravity": [0, 0, -8.0]}), three.do({"joint_positions": joints})),
        ),
        4: (lambda: native.branch(0, [1]), lambda: two.restore(one.snapshot())),
        5: (lambda: native.reset(options=dict(again)), lambda: single.reset(options=dict(again))),
        6: (
            lambda: native.do({0: {"sensor_noise": 0.05}, 1: {"actuator_noise": 0.1}}),
            lambda: (one.do({"sensor_noise": 0.05}), two.do({"actuator_noise": 0.1})),
        ),
        8: (
            lambda: native.envs[3].do({"tool_block.mass": 0.05}),
            lambda: four.do({"tool_block.mass": 0.05}),
        ),
    }
    for step, asked in enumerate(actions(native, 11)):
        check_same(native.step(asked), single.step(asked), f"step {step}")
        for act in meddling.get(step, ()):
            act()
        for index, env in enumerate(single.envs):
            np.testing.assert_array_equal(native.present()[0][index], env.present()[0])
    check_same(native.get_attr("interventions"), single.get_attr("interventions"))


@pytest.mark.parametrize(("count", "threads"), [(1, 1), (2, 2), (7, 1), (7, 4), (64, 2)])
def test_numbers_of_environments_and_threads(count: int, threads: int) -> None:
    """What the first environment does depends on neither number."""
    alone, native = ScmWorldEnv(), ScmWorldVectorEnv(count, threads=threads)
    alone.reset(seed=3)
    native.reset(seed=3)
    for asked in actions(native, 4):
        mine, other = native.step(asked), alone.step(asked[0])
        np.testing.assert_array_equal(mine[0][0], other[0])
        assert mine[1][0] == other[1]


@pytest.mark.parametrize("kind", KINDS)
def test_where_an_action_is_refused_none_moves(kind: str) -> None:
    """Nobody is a step further, not even those before the one with the wrong action."""
    envs = make(kind)
    envs.reset(seed=0)
    asked = actions(envs, 1)[0]
    asked[2, 3] = np.nan
    with pytest.raises(ActionError, match="environment 2"):
        envs.step(asked)
    assert [world.index for world in envs.get_attr("world")] == [0] * COUNT


def test_where_one_fails_all_others_are_a_step_further() -> None:
    """A function that fails stops no other environment."""
    own = term("reward.own", _heavy, ("floor_friction", "control_index"), "Of mine.")
    task = Pushing(terms=[own], weights={"reward.own": 1.0})
    envs, alone = ScmWorldVectorEnv(COUNT, task=task), ScmWorldEnv(task)
    envs.reset(seed=0, options={"do": {1: {"floor_friction": 0.7}}})
    asked = actions(envs, 2)
    with pytest.raises(ModelError, match=r"environment 1: (.|\n)*reward\.own"):
        envs.step(asked[0])
    assert [world.index for world in envs.get_attr("world")] == [1] * COUNT
    seen, _ = envs.present()
    for index in (0, 2, 3):
        alone.reset(seed=index)
        np.testing.assert_array_equal(seen[index], alone.step(asked[0][index])[0])
    envs.close()


def test_where_one_loses_its_state_all_others_are_a_step_further(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The others go on as if nothing had happened."""
    monkeypatch.chdir(tmp_path)  # engines may write a log
    envs, alone = ScmWorldVectorEnv(COUNT), ScmWorldEnv()
    envs.reset(seed=0)
    asked = actions(envs, 1)[0]
    envs.get_attr("world")[1].backend.realization.data.qvel[:] = 1e200
    with pytest.raises(EngineFailure):
        envs.step(asked)
    for index in (0, 2, 3):
        alone.reset(seed=index)
        shown = alone.step(asked[index])[0]
        assert envs.get_attr("world")[index].index == 1
        np.testing.assert_array_equal(envs.envs[index].unwrapped.present()[0], shown)
    with pytest.raises(EngineFailure, match="reset the world"):
        envs.step(asked)
    assert envs.get_attr("world")[0].index == 1
    envs.reset(seed=0)
    envs.step(asked)
    assert [world.index for world in envs.get_attr("world")] == [1] * COUNT


def _heavy(friction: Any, index: Any) -> float:
    return float("nan") if float(friction) == 0.7 and int(index) else 0.0


def test_a_reward_that_is_not_a_number() -> None:
    """A term that fails in one environment says so as it does in a single one."""
    own = term("reward.own", _late, ("control_index",), "Of mine.")
    task = Pushing(terms=[own], weights={"reward.own": 1.0})
    native = ScmWorldVectorEnv(COUNT, task=task)
    native.reset(seed=0)
    asked = actions(native, 3)
    native.step(asked[0])
    with pytest.raises(ModelError, match=r"(?s)environment 0.*reward\.own"):
        native.step(asked[1])


def _late(index: Any) -> float:
    return float("nan") if int(index) == 2 else 0.0
