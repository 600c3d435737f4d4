"""Many environments are what Gymnasium would make of single ones."""

from __future__ import annotations

import pickle
from copy import deepcopy
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from many_envs import (
    KINDS,
    LENGTH,
    PUSHING,
    SIZE,
    actions,
    check_alike,
    check_same,
    engine,
    kept,
    make,
    sync,
)

from scm_world import curricula
from scm_world.env import ScmWorldVectorEnv
from scm_world.errors import ActionError, NotReset, SnapshotMismatch, UnknownOption

MODES = [mode.value for mode in AutoresetMode]
VIEWS: dict[str, dict[str, Any]] = {
    "vector": {},
    "goals": {"goal_env": True, "task_options": {"weights": "sparse"}},
    "context": {"context": "privileged", "start": {"sensor_noise": 0.01}},
    "pictures": {"observation_mode": "pixel", "image_size": 8, "cameras": ["60"]},
    "no terms": {"task_options": {"weights": "none"}, "normalize_actions": False},
    "relative": {"action_mode": "delta_joint_positions", "random_goal": "A"},
}


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("kind", KINDS)
def test_it_says_what_gymnasiums_own_kind_says(kind: str, view: str, mode: str) -> None:
    """Observations, rewards, flags and infos with their masks: value by value, in every mode."""
    options = {"autoreset_mode": mode, "max_episode_length": 3, **VIEWS[view]}
    mine = make(kind, **options)
    other = sync(backend=engine(kind), **options)
    assert mine.observation_space == other.observation_space
    assert mine.single_observation_space == other.single_observation_space
    assert mine.action_space == other.action_space
    assert mine.single_action_space == other.single_action_space
    assert mine.metadata == other.metadata
    check_same(mine.reset(seed=3), other.reset(seed=3), "reset")
    for t, action in enumerate(actions(8)):
        if mode == "Disabled" and t in (3, 6):
            ended = np.ones(SIZE, bool)
            both = [e.reset(options={"reset_mask": ended.copy()}) for e in (mine, other)]
            check_same(*both, "reset of those that are done")
        check_same(mine.step(action), other.step(action), f"step {t}")
    mine.close()
    other.close()


@pytest.mark.parametrize("kind", KINDS)
def test_some_of_them_are_reset(kind: str) -> None:
    """A reset mask resets those only; the options that are given are not changed."""
    mine, other = kept(kind), sync(backend=engine(kind), max_episode_length=LENGTH)
    mask = np.array([True, False, False, True])
    for seed in (2, [5, None, 6, 7]):
        for envs in (mine, other):
            envs.reset(seed=seed)
        check_alike(mine, other, 2)
        options = {"reset_mask": mask, "do": {"floor_friction": 0.4}}
        found = mine.reset(seed=9, options=options)
        check_same(found, other.reset(seed=9, options=dict(options)), "reset")
        assert options.keys() == {"reset_mask", "do"}
        check_alike(mine, other, 8)


@pytest.mark.parametrize("kind", KINDS)
def test_episodes_begin_as_each_one_is_told(kind: str) -> None:
    """Interventions and numbers of episodes are for all, in a list, or by index."""
    envs, other = kept(kind), sync(backend=engine(kind))
    wishes: list[Any] = [{"floor_friction": 0.3}, None, {"tool_block": {"mass": "A"}}, None]
    numbers = {0: 4, 3: 2}
    found = envs.reset(seed=1, options={"do": wishes, "episode": numbers})
    for i, env in enumerate(other.envs):
        options = {"do": wishes[i], "episode": numbers.get(i, 0)}
        observation, info = env.reset(seed=1 + i, options=options)
        np.testing.assert_array_equal(found[0][i], observation)
        np.testing.assert_array_equal(found[1]["desired_goal"][i], info["desired_goal"])
    asked = [tuple(entry for _, entry in one) for one in envs.get_attr("interventions")]
    assert [bool(one) for one in asked] == [True, False, True, False]


def test_observations_are_copies_unless_they_are_not() -> None:
    """What is given belongs to whom it is given; with ``copy=False`` it is overwritten."""
    for copy, options in ((True, {}), (False, {}), (True, {"goal_env": True})):
        envs = make(copy=copy, **options)
        first, _ = envs.reset(seed=0)
        kept = pickle.loads(pickle.dumps(first))  # noqa: S301 # written in the line itself
        second, *rest = envs.step(actions(1)[0])
        again = [one.copy() for one in rest[:3]]
        envs.step(actions(2)[1])
        check_same(rest[:3], again, "rewards and flags")
        if copy:
            check_same(first, kept, "observations")
        else:
            assert first is second
            assert not np.array_equal(first, kept)


@pytest.mark.parametrize("kind", KINDS)
def test_members_can_be_called(kind: str) -> None:
    """Methods, attributes, generators and pictures, as with Gymnasium's own kind."""
    envs, other = kept(kind), sync(backend=engine(kind), render_mode="rgb_array")
    envs.reset(seed=7)
    other.reset(seed=7)
    assert envs.np_random_seed == other.np_random_seed == (7, 8, 9, 10)
    assert [g.random() for g in envs.np_random] == [g.random() for g in other.np_random]
    assert envs.render_mode == other.render_mode == "rgb_array"
    check_same(envs.render(), other.render(), "pictures")
    assert envs.get_attr("reward_scale") == (1.0,) * SIZE
    command = np.zeros(9)
    check_same(envs.call("as_action", command), other.call("as_action", command), "as_action")
    envs.set_attr("remark", [1, 2, 3, 4])
    assert envs.get_attr("remark") == (1, 2, 3, 4)
    envs.set_attr("remark", "all")
    assert envs.call("remark") == ("all",) * SIZE
    with pytest.raises(ValueError, match="length equal to the number"):
        envs.set_attr("remark", [1])
    with pytest.raises(AttributeError, match="no_such_name"):
        envs.get_attr("no_such_name")


@pytest.mark.parametrize("n", [1, 2, 7])
@pytest.mark.parametrize("kind", KINDS)
def test_how_many_there_are_changes_nothing(kind: str, n: int) -> None:
    """The first environment does the same, whoever is beside it."""
    envs, alone = make(kind, n, max_episode_length=3), make(kind, 1, max_episode_length=3)
    first, one = envs.reset(seed=5), alone.reset(seed=5)
    np.testing.assert_array_equal(first[0][0], one[0][0])
    for action in actions(5, n):
        here, there = envs.step(action), alone.step(action[:1])
        for mine, other in zip(here[:4], there[:4], strict=True):
            np.testing.assert_array_equal(mine[0], other[0])
    for one in (envs, alone, alone):
        one.close()
        assert one.closed


def test_gymnasium_makes_it() -> None:
    """``make_vec`` gives this kind by default, Gymnasium's own when asked, and ``make`` one."""
    envs = gymnasium.make_vec(PUSHING, num_envs=2, backend="fake")
    assert isinstance(envs, ScmWorldVectorEnv)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert repr(envs) == f"ScmWorldVectorEnv({PUSHING}, num_envs=2)"
    assert isinstance(gymnasium.make_vec(envs.spec), ScmWorldVectorEnv)
    assert not isinstance(sync(), ScmWorldVectorEnv)
    assert gymnasium.make(PUSHING, backend="fake").reset(seed=0)[0].shape == (56,)


def test_what_cannot_be_made_is_refused() -> None:
    """Options that do not exist, or do not go together."""
    wrong: tuple[tuple[dict[str, Any], str], ...] = (
        ({"autoreset_mode": "Never"}, "NextStep"),
        ({"num_envs": 0}, "whole number from 1"),
        ({"threads": 2, "workers": 2}, "threads"),
        ({"threads": 0}, "threads"),
        ({"workers": 0}, "workers"),
    )
    for options, match in wrong:
        with pytest.raises(UnknownOption, match=match):
            gymnasium.make_vec(PUSHING, **{"num_envs": 2, "backend": "fake", **options})


def test_what_cannot_be_reset_is_refused() -> None:
    """Seeds, masks and options of another form; nothing is reset then."""
    envs, twin = make(), make()
    for one in (envs, twin):
        one.reset(seed=0)
    mask = np.zeros(SIZE, bool)
    for given, match in (
        ({"seed": [1, 2]}, "seed"),
        ({"seed": "three"}, "seed"),
        ({"options": {"reset_mask": mask}}, "reset_mask"),
        ({"options": {"reset_mask": [True] * SIZE}}, "reset_mask"),
        ({"options": {"reset_mask": mask[:2]}}, "reset_mask"),
        ({"options": {"goal": 1}}, "reset option"),
        ({"options": 3}, "a dictionary"),
        ({"options": {"do": [None]}}, "length 4"),
        ({"options": {"do": {9: {}}}}, "from 0 to 3"),
        ({"options": {"do": {1: {}}, "reset_mask": mask | [1, 0, 0, 0] > 0}}, "that are reset"),
    ):
        with pytest.raises(UnknownOption, match=match):
            envs.reset(**given)
    check_alike(envs, twin, 2)


def test_what_cannot_be_stepped_is_refused() -> None:
    """Before any environment has moved, and with the index of the one that is to blame."""
    envs, twin = make(max_episode_length=3), make(max_episode_length=3)
    with pytest.raises(NotReset, match="environment 0"):
        envs.step(actions(1)[0])
    for one in (envs, twin):
        one.reset(seed=0)
    for wrong in (np.zeros(9), np.zeros((SIZE, 8)), "push", np.zeros((SIZE, 9), complex)):
        with pytest.raises(ActionError):
            envs.step(wrong)
    bad = actions(1)[0]
    bad[2, 4] = np.nan
    with pytest.raises(ActionError, match="environment 2: an action is 9 finite numbers"):
        envs.step(bad)
    check_alike(envs, twin, 3)
    ended = np.full((SIZE, 9), np.nan)
    np.testing.assert_array_equal(
        envs.step(ended)[1], np.zeros(SIZE)
    )  # it begins: none is looked at


def test_what_is_done_takes_no_step_where_nothing_resets_it() -> None:
    """In the mode ``Disabled`` the error says which ones, and how to go on."""
    envs = make(autoreset_mode="Disabled", max_episode_length=2)
    envs.reset(seed=0)
    envs.step(actions(1)[0])
    envs.reset(options={"reset_mask": np.array([True, False, True, False])})
    *_, truncated, _ = envs.step(actions(1)[0])
    with pytest.raises(ActionError, match=r"take no step: 1, 3; reset them .*reset_mask"):
        envs.step(actions(1)[0])
    envs.reset(options={"reset_mask": truncated})
    envs.step(actions(1)[0])


def test_what_is_no_snapshot_is_refused() -> None:
    """Of many, or of one of them; all are as they were."""
    envs, twin = make(), make()
    for one in (envs, twin):
        one.reset(seed=0)
    for wrong in (3, [1, 2, 3, 4], {1: 3}):
        with pytest.raises(SnapshotMismatch, match="not a snapshot"):
            envs.restore(wrong)
    with pytest.raises(UnknownOption, match="length 4"):
        envs.restore([1, 2])
    check_alike(envs, twin, 2)


@pytest.mark.parametrize("curriculum", [None, {"tool_block.mass": "A"}])
def test_many_environments_can_be_copied(curriculum: Any) -> None:
    """A copy, and what comes out of a pickle, goes on bit for bit like the original."""
    how: dict[str, Any] = {"backend": "fake", "max_episode_length": 4, "random_goal": "A"}
    if curriculum is None:
        envs = gymnasium.make_vec(PUSHING, 3, **how)
    else:
        envs = curricula.make_vec(PUSHING, 3, curriculum, **how)
    fresh = pickle.loads(pickle.dumps(envs))  # noqa: S301
    check_same(envs.reset(seed=2), fresh.reset(seed=2), "before an episode")
    moves = actions(7, 3)
    for step, asked in enumerate(moves):
        check_same(envs.step(asked), fresh.step(asked), f"step {step}")
        if step == 2:
            fresh = pickle.loads(pickle.dumps(envs))  # noqa: S301
        if step == 4:
            fresh = deepcopy(envs)
    assert fresh.get_attr("world")[0] is not envs.get_attr("world")[0]


def test_pictures_are_the_channels_of_one() -> None:
    """Stacked, they are the pictures one after another, in single environments and in many."""
    how: dict[str, Any] = {"backend": "fake", "observation_mode": "pixel", "image_size": (8, 12)}
    apart = gymnasium.make(PUSHING, **how).reset(seed=0)[0]
    env = gymnasium.make(PUSHING, stack_images=True, **how)
    assert env.observation_space.shape == (18, 8, 12)
    np.testing.assert_array_equal(env.reset(seed=0)[0], apart.reshape(18, 8, 12))
    envs = gymnasium.make_vec(PUSHING, 2, stack_images=True, **how)
    assert envs.single_observation_space == env.observation_space
    np.testing.assert_array_equal(envs.reset(seed=0)[0][0], apart.reshape(18, 8, 12))
    published = {"conventions": "causal_world", "stack_images": True}
    last = gymnasium.make(PUSHING, **how, **published).reset(seed=0)[0]
    assert last.shape == (8, 12, 18)
    with pytest.raises(UnknownOption, match="stack_images"):
        gymnasium.make(PUSHING, backend="fake", stack_images=True)
