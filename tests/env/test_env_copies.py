"""Facts about copies of environments and worlds."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
import pytest
from envs import BACKENDS, make, roll

from scm_world import World


def _pickled(thing: Any) -> Any:
    return pickle.loads(pickle.dumps(thing))  # noqa: S301


COPIES = [copy.copy, copy.deepcopy, _pickled]


@pytest.mark.parametrize("copied", COPIES)
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"action_mode": "delta_joint_positions", "start": {"tool_block.mass": "B"}},
        {"observation_mode": "pixel", "cameras": ["60"], "image_size": 16},
    ],
    ids=["vector", "relative", "pixel"],
)
def test_a_copy_goes_on_like_the_original(
    copied: Callable[[Any], Any], backend: str, options: dict[str, Any]
) -> None:
    """In the episode that it was taken in, and in the next one; neither moves the other."""
    env = make(backend=backend, **options).unwrapped
    env.reset(seed=3)
    roll(env, 5)
    env.do({"floor_friction": 0.4})
    other = copied(env)
    for mine, its in zip(roll(env, 8, seed=1), roll(other, 8, seed=1), strict=True):
        np.testing.assert_array_equal(mine[0], its[0])
        assert mine[1] == its[1]
    first, second = env.reset()[0], other.reset()[0]
    np.testing.assert_array_equal(first, second)
    assert env.world["tool_block.mass"] == other.world["tool_block.mass"]


@pytest.mark.parametrize("copied", COPIES)
def test_a_copy_before_the_first_episode_is_new(copied: Callable[[Any], Any]) -> None:
    """It has the options, and draws what the other one would."""
    env = make(normalize_actions=False).unwrapped
    other = copied(env)
    assert other.action_space == env.action_space
    np.testing.assert_array_equal(other.reset(seed=4)[0], env.reset(seed=4)[0])


@pytest.mark.parametrize("backend", BACKENDS)
def test_worlds_are_copied_with_their_structure(backend: str) -> None:
    """A tower that was made smaller is so in the copy."""
    world = World("towers", backend=backend)
    world.reset(seed=1)
    world.do({"number_of_blocks_in_tower": [1, 1, 2]})
    other = copy.deepcopy(world)
    for _ in range(3):
        world.step(np.zeros(9))
        other.step(np.zeros(9))
    assert list(world.model) == list(other.model)
    for name, value in world.values().items():
        np.testing.assert_array_equal(value, other[name])


@pytest.mark.parametrize("backend", ["fake", "mujoco"])
def test_the_world_of_an_environment_can_be_asked(backend: str) -> None:
    """It answers like a world that was never in one, and the environment goes on as it was."""
    env: Any = make(backend=backend)
    twin: Any = make(backend=backend)
    for one in (env, twin):
        one.reset(seed=3)
        one.step(np.full(9, 0.2, np.float32))
    question: dict[str, Any] = {"do": {"tool_block.mass": 0.09}, "n": 2, "steps": 5, "seed": 1}
    world = env.unwrapped.world
    with World("pushing", backend=backend) as other:
        mine, its = (each.effect("reward", **question) for each in (world, other))
    for bound in ("mean", "low", "high"):
        np.testing.assert_array_equal(getattr(mine, bound), getattr(its, bound))
    assert set(world.observation_space) <= set(world.values())
    assert world.action_space.low.tolist() == world.action_low.tolist()
    assert world.action_space.contains(world.action_space.sample())
    action = np.zeros(9, np.float32)
    for mine, its in zip(env.step(action)[:4], twin.step(action)[:4], strict=True):
        np.testing.assert_array_equal(mine, its)


def test_structures_end_with_their_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Models of goal families, and all that is computed on for them, are freed with it."""
    import gc

    from scm_world.tasks.trifinger import system

    monkeypatch.setattr("scm_world.world.structures._ALIVE", WeakValueDictionary())
    gc.collect()  # what earlier tests left must not vanish in between
    before = set(system._MADE)
    env: Any = make("scm_world/StackedBlocks-v0", backend="mujoco", random_goal="A|B")
    for seed in range(6):
        env.reset(seed=seed)
    made = set(system._MADE) - before
    assert made
    env.close()
    del env
    gc.collect()
    assert not made & set(system._MADE)
