"""Environments that the engine steps together are, bit for bit, environments that take turns."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from env_executors import check_same

from scm_world.env import ScmWorldEnv
from scm_world.env.batched.loop import LoopExecutor
from scm_world.env.batched.native import NativeExecutor
from scm_world.errors import ActionError, EngineFailure, InterventionError, ModelError
from scm_world.tasks import Pushing
from scm_world.tasks.rewards import term

COUNT = 4
EVERYONE = np.ones(COUNT, dtype=np.bool_)

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
    {"keypoints": True},
    {"observation_mode": "pixel", "image_size": 12, "cameras": ["60"]},
    {"conventions": "causal_world"},
    {"normalize_actions": False, "normalize_observations": False},
    {"task": "stacking2"},
    {"task": "reaching"},
    {"task": "general", "task_options": {}},
    {"backend": "bullet"},
]


def executors(
    threads: int = 2, count: int = COUNT, **options: Any
) -> tuple[LoopExecutor, NativeExecutor]:
    """Make both kinds, at the beginning of the same episodes."""
    make = partial(ScmWorldEnv, **options)
    loop, native = LoopExecutor(make, count), NativeExecutor(make, count, threads=threads)
    first = {"do": {"floor_friction": 0.5}}
    for executor in (loop, native):
        given = [first, *[None] * (count - 1)]
        executor.reset(np.ones(count, dtype=np.bool_), range(3, 3 + count), given)
    return loop, native


def compare(loop: LoopExecutor, native: NativeExecutor, where: str) -> None:
    """Compare their sheets."""
    for field in (
        "observations",
        "rewards",
        "terminations",
        "truncations",
        "infos",
    ):
        check_same(
            getattr(loop.buffers, field), getattr(native.buffers, field), f"{where}: {field}"
        )


def actions(executor: Any, steps: int) -> Any:
    """Draw actions from the whole space, shape (steps, n, 9)."""
    space: Any = executor.form.action_space
    generator = np.random.default_rng(0)
    bounds = np.clip(space.low, -1e3, 1e3), np.clip(space.high, -1e3, 1e3)
    drawn = generator.uniform(*bounds, (steps, executor.num_envs, 9))
    return drawn.astype(np.float32).astype(np.float64)


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_every_kind_of_environment(options: dict[str, Any]) -> None:
    """Whatever is observed and however it is commanded, a native executor says the same."""
    loop, native = executors(**options)
    compare(loop, native, "reset")
    for step, asked in enumerate(actions(loop, 6)):
        which = EVERYONE.copy()
        which[1] = step != 4
        for executor in (loop, native):
            executor.step(which, asked)
        compare(loop, native, f"step {step}")
    loop.close()
    native.close()


def test_everything_that_can_be_done_to_one() -> None:
    """Interventions, resets and branches of single environments leave all others alone."""
    loop, native = executors(action_mode="delta_joint_positions", max_episode_length=9)
    joints = [0.0, 0.9, -1.7] * 3
    meddling = {
        2: lambda executor: executor.do(
            {0: {"gravity": [0, 0, -8.0]}, 2: {"joint_positions": joints}}
        ),
        4: lambda executor: executor.restore({1: executor.snapshot([0])[0]}),
        5: lambda executor: executor.reset(np.arange(COUNT) == 1, [None] * COUNT, [None] * COUNT),
        6: lambda executor: executor.do({0: {"sensor_noise": 0.05}, 1: {"actuator_noise": 0.1}}),
        8: lambda executor: executor.call([3], "do", {"tool_block.mass": 0.05}),
    }
    for step, asked in enumerate(actions(loop, 11)):
        for executor in (loop, native):
            executor.step(EVERYONE, asked)
            meddling.get(step, lambda _: None)(executor)
        compare(loop, native, f"step {step}")
    check_same(
        loop.call(range(COUNT), "interventions"),
        native.call(range(COUNT), "interventions"),
        "interventions",
    )


@pytest.mark.parametrize("threads", [1, 2, 4])
@pytest.mark.parametrize("count", [1, 2, 7, 64])
def test_numbers_of_environments_and_threads(count: int, threads: int) -> None:
    """What the first environment does depends on neither number."""
    alone, _ = executors(count=1)
    _, native = executors(count=count, threads=threads)
    for asked in actions(native, 4):
        alone.step(np.ones(1, dtype=np.bool_), asked)
        native.step(np.ones(count, dtype=np.bool_), asked)
        np.testing.assert_array_equal(native.buffers.observations[0], alone.buffers.observations[0])
        assert native.buffers.rewards[0] == alone.buffers.rewards[0]


def test_a_refused_intervention_changes_nothing() -> None:
    """If one of them refuses, all are as they were, in the buffers and in the world."""
    loop, native = executors()
    first, second, *_ = actions(loop, 3)
    for executor in (loop, native):
        executor.step(EVERYONE, first)
    with pytest.raises(InterventionError, match="environment 2"):
        native.do({0: {"floor_friction": 0.7}, 2: {"tool_block.mass": -1.0}})
    compare(loop, native, "after the refusal")
    for executor in (loop, native):
        executor.step(EVERYONE, second)
    compare(loop, native, "a step later")


def test_errors_name_the_environment() -> None:
    """An action that is no number is refused before anything moves, with the index."""
    loop, native = executors()
    asked = actions(loop, 1)[0]
    asked[2, 3] = np.nan
    with pytest.raises(ActionError, match="environment 2"):
        native.step(EVERYONE, asked)
    compare(loop, native, "after the refusal")


@pytest.mark.parametrize("kind", [LoopExecutor, NativeExecutor])
def test_where_an_action_is_refused_none_moves(kind: Any) -> None:
    """Nobody is a step further, not even those before the one with the wrong action."""
    executor = kind(partial(ScmWorldEnv), COUNT)
    executor.reset(EVERYONE, range(COUNT), [None] * COUNT)
    asked = actions(executor, 1)[0]
    asked[2, 3] = np.nan
    with pytest.raises(ActionError, match="environment 2"):
        executor.step(EVERYONE, asked)
    assert [env.world.index for env in executor.attribute(range(COUNT), "unwrapped")] == [0] * COUNT


@pytest.mark.parametrize("kind", [LoopExecutor, NativeExecutor])
def test_where_one_fails_all_others_are_a_step_further(
    kind: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A state that is lost, and a function that fails, stop no other environment."""
    monkeypatch.chdir(tmp_path)  # engines may write a log
    own = term("reward.own", _heavy, ("floor_friction", "control_index"), "Of mine.")
    task = Pushing(terms=[own], weights={"reward.own": 1.0})
    executor = kind(partial(ScmWorldEnv, task=task), COUNT)
    given: list[Any] = [None, {"do": {"floor_friction": 0.7}}, None, None]
    executor.reset(EVERYONE, range(COUNT), given)
    alone = ScmWorldEnv(task)
    asked = actions(executor, 2)
    with pytest.raises(ModelError, match=r"reward\.own"):
        executor.step(EVERYONE, asked[0])
    indices = [env.world.index for env in executor.attribute(range(COUNT), "unwrapped")]
    assert indices == [1] * COUNT
    executor.reset(EVERYONE, range(COUNT), [None] * COUNT)
    envs = executor.attribute(range(COUNT), "unwrapped")
    envs[1].world.backend.realization.data.qvel[:] = 1e200
    with pytest.raises(EngineFailure):
        executor.step(EVERYONE, asked[0])
    envs = executor.attribute(range(COUNT), "unwrapped")
    for index in (0, 2, 3):
        alone.reset(seed=index)
        shown = alone.step(asked[0][index])[0]
        assert envs[index].world.index == 1
        np.testing.assert_array_equal(executor.buffers.observation(index), shown)


def _heavy(friction: Any, index: Any) -> float:
    return float("nan") if float(friction) == 0.7 and int(index) else 0.0


def test_a_reward_that_is_no_number() -> None:
    """A term that fails in one environment says so as it does in a single one."""
    own = term("reward.own", _late, ("control_index",), "Of mine.")
    task = Pushing(terms=[own], weights={"reward.own": 1.0})
    _, native = executors(task=task)
    asked = actions(native, 3)
    native.step(EVERYONE, asked[0])
    with pytest.raises(ModelError, match=r"(?s)environment 0.*reward\.own"):
        native.step(EVERYONE, asked[1])


def _late(index: Any) -> float:
    return float("nan") if int(index) == 2 else 0.0
