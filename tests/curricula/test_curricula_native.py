"""A curriculum for environments that are stepped in one call."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from curriculum_envs import PUSHING
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from scm_world.curricula import (
    CurriculumEnv,
    CurriculumState,
    at_step,
    during,
    follow,
    goals,
    make_vec,
    physics,
    resample,
    stages,
    timed,
    together,
)
from scm_world.env import ScmWorldVectorEnv
from scm_world.errors import InterventionError, UnknownOption

FRICTION, MASS = "floor_friction", "tool_block.mass"
GOAL, TOOL = "goal_block.cartesian_position", "tool_block.cartesian_position"
CENTER = [0.0, 0.0, 0.0325]
CURRICULA: dict[str, Any] = {
    "at resets": together(goals("A"), physics("B"), resample(MASS, "B")),
    "within episodes": together(
        follow(lambda situation: {FRICTION: situation.episode / 100}),
        timed({"every": 2, "at": 1}, resample(MASS, "B")),
        at_step(3, resample("@goals")),
    ),
    "with stages": together(
        stages({MASS: 0.02}, {MASS: 0.03}, up=1.0, window=3),
        during(range(3), together(at_step(1, {GOAL: CENTER}), at_step(1, {TOOL: CENTER}))),
    ),
}
OPTIONS: dict[str, dict[str, Any]] = {
    "plain": {},
    "delta": {"action_mode": "delta_joint_positions"},
    "goals": {"goal_env": True, "start": {"sensor_noise": 0.1}},
}


def single(part: Any, options: dict[str, Any]) -> CurriculumEnv:
    """Make one environment under a curriculum."""
    return CurriculumEnv(gymnasium.make(PUSHING, **options), part)


def made(kind: str | None, part: Any, mode: AutoresetMode, n: int = 3, **options: Any) -> Any:
    """Make environments whose episodes are short; ``"sync"`` are single ones of Gymnasium."""
    options = {"max_episode_length": 4, **options}
    if kind == "sync":
        one = partial(single, part, options)
        envs = SyncVectorEnv([one] * n, autoreset_mode=mode)
        envs.set_attr("state", [CurriculumState(episode=i, every=n) for i in range(n)])
        return envs
    how = {"workers": 2} if kind == "processes" else {}
    return make_vec(PUSHING, n, part, autoreset_mode=mode, **how, **options)


def same(mine: Any, other: Any, where: str = "") -> None:
    """Assert that two things are equal, bit for bit, all the way down."""
    if isinstance(other, dict):
        assert mine.keys() == other.keys(), where
        for name in other:
            same(mine[name], other[name], f"{where}.{name}")
    elif isinstance(other, tuple | list):
        assert len(mine) == len(other), where
        for place, (one, two) in enumerate(zip(mine, other, strict=True)):
            same(one, two, f"{where}[{place}]")
    elif isinstance(other, np.ndarray) and other.dtype == object:
        same(list(mine), list(other), where)
    else:
        assert type(mine) is type(other), where
        np.testing.assert_array_equal(mine, other, where, strict=True)


def roll(envs: Any, others: Any, steps: int, mode: AutoresetMode) -> None:
    """Assert that two vectors say the same from here on."""
    rng = np.random.default_rng(7)
    for t in range(steps):
        actions = rng.uniform(-1, 1, (envs.num_envs, 9)).astype(np.float32)
        mine, other = envs.step(actions), others.step(actions)
        same(mine, other, f"step {t}")
        ended = other[2] | other[3]
        if mode is AutoresetMode.DISABLED and (ended.any() or t == 1):
            which = ended if ended.any() else np.arange(envs.num_envs) == 1
            again = {"reset_mask": which}
            same(envs.reset(options=dict(again)), others.reset(options=dict(again)), f"reset {t}")
    assert envs.get_attr("state") == others.get_attr("state")


@pytest.mark.parametrize("mode", list(AutoresetMode))
@pytest.mark.parametrize("name", CURRICULA)
def test_native_is_sync_value_by_value(name: str, mode: AutoresetMode) -> None:
    """Observations, rewards, flags, infos, numbers, stages and states."""
    pair = [made(kind, CURRICULA[name], mode) for kind in ("native", "sync")]
    same(*(envs.reset(seed=3) for envs in pair))
    roll(*pair, steps=11, mode=mode)
    for envs in pair:
        envs.close()


@pytest.mark.parametrize(
    ("name", "kind"), [*((name, "turns") for name in CURRICULA), ("within episodes", "processes")]
)
def test_other_kinds_are_sync_value_by_value(name: str, kind: str) -> None:
    """One after another in this process, or each in its process."""
    mode = AutoresetMode.SAME_STEP
    pair = [made(one, CURRICULA[name], mode, backend="fake") for one in (kind, "sync")]
    same(*(envs.reset(seed=3) for envs in pair))
    roll(*pair, steps=11, mode=mode)
    for envs in pair:
        envs.close()


@pytest.mark.parametrize("options", OPTIONS)
def test_whatever_is_observed(options: str) -> None:
    """Relative actions, goals, noise of the sensors, and what is said in words."""
    mode = AutoresetMode.SAME_STEP
    part = CURRICULA["within episodes"]
    pair = [made(kind, part, mode, **OPTIONS[options]) for kind in ("native", "sync")]
    same(*(envs.reset(seed=[5, 1, 2], options={"do": {FRICTION: 0.3}}) for envs in pair))
    roll(*pair, steps=6, mode=mode)


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_a_state_goes_on_in_the_other_kind(mode: AutoresetMode) -> None:
    """What sync gave native resumes, and the other way round; draws and numbers are the same."""
    part = CURRICULA["within episodes"]
    native, sync = (made(kind, part, mode) for kind in ("native", "sync"))
    for envs in (native, sync):
        envs.reset(seed=0)
        for _ in range(3):
            envs.step(np.zeros((3, 9), np.float32))
    state = sync.get_attr("state")
    assert native.get_attr("state") == state
    later = [made(kind, part, mode) for kind in ("native", "sync")]
    for envs in later:
        envs.set_attr("state", state)
    same(*(envs.reset() for envs in later))
    roll(*later, steps=6, mode=mode)


def test_it_is_what_is_made_where_the_engine_has_it() -> None:
    """MuJoCo steps many in one call; others take turns; there may be a time limit."""
    part = goals("A")
    processes = make_vec(PUSHING, 2, part, backend="fake", workers=2)
    assert isinstance(processes, AsyncVectorEnv)
    processes.close()
    native = make_vec(PUSHING, 2, part, disable_env_checker=True, threads=2)
    assert isinstance(native, ScmWorldVectorEnv)
    assert [*native.get_attr("curriculum")] == [part] * 2
    assert [state.noise for state in native.get_attr("state")] == [None, None]
    limited = make_vec(PUSHING, 2, part, backend="fake", max_episode_steps=2)
    limited.reset(seed=0)
    assert [limited.step(np.zeros((2, 9), np.float32))[3].all() for _ in range(2)] == [False, True]
    with pytest.raises(UnknownOption, match="did you mean 'frame_skip'"):
        make_vec(PUSHING, 2, part, frameskip=3)


def test_what_is_refused_happens_in_none_of_them() -> None:
    """A curriculum refused in one: all are as they were, and the next reset has their numbers."""
    inside = during(range(4, 5), at_step(0, {TOOL: [0.2, 0.2, 0.0325]}))
    part = together(follow(lambda situation: {FRICTION: situation.episode / 100}), inside)
    envs = made("native", part, AutoresetMode.DISABLED)
    envs.reset(seed=0)
    before, state = envs.present(), envs.get_attr("state")
    with pytest.raises(InterventionError, match="environment 1"):
        envs.reset()
    same(envs.present(), before)
    assert envs.get_attr("state") == state
    with pytest.raises(InterventionError, match="environment 1"):
        envs.reset()
    assert envs.get_attr("state") == state
    with pytest.raises(InterventionError, match=r"nowhere"):
        made("native", {"nowhere": 1.0}, AutoresetMode.DISABLED)


def test_a_snapshot_goes_back_to_what_is_due() -> None:
    """After a snapshot what is due at a step is due again."""
    envs = made("native", timed({"every": 2}, resample(MASS, "B")), AutoresetMode.DISABLED)
    envs.reset(seed=0)
    action = np.zeros((3, 9), np.float32)
    envs.step(action)
    snapshot = envs.snapshot()
    first = [envs.step(action) for _ in range(2)]
    envs.restore(snapshot)
    same([envs.step(action) for _ in range(2)], first)
