"""Curricula in environments of models and of step functions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv

import scm_world  # noqa: F401 # registers the environments
from scm_world.curricula import (
    CurriculumEnv,
    CurriculumState,
    at_step,
    everything,
    goals,
    make_vec,
    physics,
    resample,
    stages,
    together,
)
from scm_world.env import MODEL_ID
from scm_world.errors import InterventionError, UnknownOption
from scm_world.tasks.sources import load_named

FILE = Path(__file__).parents[1] / "env" / "model_tasks.py"
NAMES = "Balance", "Falling", "Decay"
Balance, Falling, Decay = (load_named(f"{FILE}:{name}", "task") for name in NAMES)
ZERO = np.zeros(1, np.float32)


def under(curriculum: Any, task: Any = None, **options: Any) -> Any:
    """Make an environment under a curriculum."""
    model = task or Balance()
    env = gymnasium.make(MODEL_ID, model=model, disable_env_checker=True, **options)
    return CurriculumEnv(env, curriculum)


def test_spaces_are_drawn_from() -> None:
    """Everything, physics alone, one variable; actions and what has no space are left alone."""
    for curriculum in (everything("A"), physics("A"), resample(["pole.mass", "motor.gear"])):
        env = under(curriculum)
        drawn = []
        for _ in range(5):
            env.reset(seed=0 if not drawn else None)
            world = env.unwrapped.world
            drawn.append((float(world["pole.mass"]), float(world["motor.gear"])))
        assert len(set(drawn)) == 5
        assert all(0.05 <= mass <= 0.2 and 8.0 <= gear <= 12.0 for mass, gear in drawn)
    env = under(everything("B"), Decay(), backend="step")
    env.reset(seed=0)
    assert 0.5 <= env.unwrapped.world["rate"] <= 0.9


def test_interventions_within_episodes_of_many_are_those_of_one() -> None:
    """At a reset and after ten steps; of ours and of Gymnasium's own kind, bit for bit."""
    curriculum = together(everything("A"), at_step(10, resample("pole.mass", "B")))
    single = SyncVectorEnv([lambda: under(curriculum, Falling())] * 2)
    single.set_attr("state", [CurriculumState(episode=index, every=2) for index in range(2)])
    seen = []
    for envs in (make_vec(MODEL_ID, 2, curriculum, model=Falling()), single):
        observations = [envs.reset(seed=4)[0]]
        observations += [envs.step(np.full((2, 1), 0.2))[0] for _ in range(15)]
        seen.append(np.array(observations))
        envs.close()
    assert np.array_equal(*seen)


def test_stages_need_a_task_that_knows_success() -> None:
    """They go up where it does, and are refused where it does not."""
    ladder = stages({}, {"pole.mass": 0.3}, up=1.0, window=1)
    env = under(ladder, max_episode_length=2)
    for number in range(2):
        env.reset(seed=0 if number == 0 else None)
        for _ in range(2):
            env.step(ZERO)
    env.reset()
    assert env.unwrapped.world["pole.mass"] == 0.3
    with pytest.raises(UnknownOption, match="success"):
        under(ladder, Falling()).reset(seed=0)


def test_names_that_are_not_there_are_refused() -> None:
    """Also the words that stand for what only the robot has."""
    for what in ("pole.mas", "tool_block.mass", "@joints"):
        with pytest.raises(InterventionError):
            under(resample(what)).reset(seed=0)


def test_what_a_task_does_not_have_is_refused() -> None:
    """Goals of a task without goals do nothing."""
    env = gymnasium.make("scm_world/Model-v0", model=Balance())
    with pytest.raises(UnknownOption, match="a task with goals"):
        CurriculumEnv(env, goals("A"))
