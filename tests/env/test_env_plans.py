"""Facts about plans that act within the episodes of environments."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from envs import BACKENDS, make
from gymnasium.vector import SyncVectorEnv

from scm_world import Contact, Draw, Hard, Reaches, Shift, World
from scm_world.curricula import goals, timed
from scm_world.curricula.wrapper import CurriculumEnv
from scm_world.env import ScmWorldEnv, vector_env
from scm_world.errors import InterventionError

STEPS = 8
PLAN: dict[str, Any] = {
    "tool_block": {"mass": 0.05, "cartesian_position": Hard([0.05, 0.0, 0.0325], at=3)},
    "floor_friction": (Hard(0.2, at=2), Draw("B", at=6)),
    "joint_damping": Shift(0.02, during=(1, 4)),
    "gravity": Hard([0.0, 0.0, -5.0], when=Reaches("control_index", above=4.5)),
}


def reader(scale: float) -> Callable[[Any], Any]:
    """Make a policy that depends on the position of the block and on the friction."""

    def act(world: Any) -> Any:
        seen = np.ravel(world["tool_block.cartesian_position"]).sum() + world["floor_friction"]
        return np.clip(np.full(9, scale * seen), world.action_low, world.action_high)

    return act


@pytest.mark.parametrize("backend", BACKENDS)
def test_it_goes_as_a_rollout_with_the_same_plan(backend: str) -> None:
    """A policy that reads the world is asked after what is done at an instant, here and there."""
    names = ["floor_friction", "joint_damping", "gravity", "tool_block.cartesian_position"]
    policy, env = reader(0.5), make(backend=backend, normalize_actions=False)
    episode = World("pushing", backend=backend).rollout(
        policy, seed=4, steps=STEPS, do=PLAN, record=[*names, "reward"]
    )
    env.reset(seed=4, options={"do": PLAN})
    world = env.unwrapped.world
    for step in range(STEPS):
        for name in names:
            np.testing.assert_array_equal(world[name], episode[name][step], f"{name} at {step}")
        observation, *_ = env.step(policy(world))
        np.testing.assert_array_equal(observation, env.unwrapped.observe())
    done = {step for step, _ in env.unwrapped.interventions}
    assert done == {0, 1, 2, 3, 4, 5, 6}
    assert (
        world.effect("gravity", do={"gravity": [0.0, 0.0, -4.0]}, n=2, steps=2).n == 2
    )  # and can be asked


def test_it_earns_nothing() -> None:
    """The reward, and its terms, are those of the step before; the observation shows it."""
    far = {"tool_block.cartesian_position": Hard([0.1, 0.1, 0.0325], at=1)}
    plain, planned = make(), make()
    plain.reset(seed=0)
    planned.reset(seed=0, options={"do": far})
    action = np.zeros(9, np.float32)
    (_, reward, _, _, info), (seen, mine, _, _, terms) = (e.step(action) for e in (plain, planned))
    assert mine == reward
    assert terms["reward_terms"] == info["reward_terms"]
    place = planned.unwrapped.layout["tool_block.cartesian_position"]
    np.testing.assert_allclose(seen[place], [0.1, 0.1, 0.0325], atol=1e-6)


def test_starts_and_curricula_may_have_times() -> None:
    """So may what a caller adds to either."""
    env: Any = CurriculumEnv(make(start={"floor_friction": Hard(0.3, at=1)}), goals("A"))
    env.reset(seed=0, options={"do": {"tool_block.mass": Hard(0.05, at=2)}})
    for _ in range(2):
        env.step(env.action_space.sample())
    world = env.unwrapped.world
    assert (world["floor_friction"], world["tool_block.mass"]) == (0.3, 0.05)


def test_a_refused_plan_says_so() -> None:
    """In the step that leads to it; targets must lie in the space of the reset."""
    env = make()
    late = {"tool_block.mass": Hard(-1.0, at=2)}
    env.reset(seed=0, options={"do": late})
    env.step(env.action_space.sample())
    with pytest.raises(InterventionError, match=r"tool_block\.mass"):
        env.step(env.action_space.sample())
    env.reset(seed=0, options={"do": {"tool_block.mass": Hard(0.05, at=1)}, "space": "A"})
    with pytest.raises(InterventionError, match="space"):
        env.step(env.action_space.sample())
    env.reset(seed=0)
    env.step(env.action_space.sample())


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])  # noqa: S301
def test_copies_and_snapshots_have_the_plan(copied: Callable[[Any], Any]) -> None:
    """What was done at an instant is not done again there, and the rest of the plan follows."""
    env = make().unwrapped
    env.reset(seed=1, options={"do": PLAN})
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, 9)).astype(np.float32)
    for action in actions[:6]:  # a draw has just been made
        env.step(action)
    saved, other = env.snapshot(), copied(env)
    first = [env.step(action)[:2] for action in actions[6:]]
    env.restore(saved)
    for again in (env, other):
        for (seen, reward), action in zip(first, actions[6:], strict=True):
            observation, mine, *_ = again.step(action)
            np.testing.assert_array_equal(observation, seen)
            assert mine == reward


def with_curriculum(**given: Any) -> Any:
    """Make an environment with a curriculum that acts within the episode too."""
    return CurriculumEnv(ScmWorldEnv(**given), timed({"every": 3}, goals("A")))


@pytest.mark.parametrize(
    "options",
    [
        {"backend": "mujoco", "threads": 2},
        {"backend": "fake", "action_mode": "delta_joint_positions"},
        {"backend": "fake", "member": with_curriculum},
    ],
    ids=["native", "relative", "curriculum"],
)
def test_many_environments_say_the_same(options: dict[str, Any]) -> None:
    """Each has a plan of its own, as in Gymnasium's own vector environment."""
    count = 3
    touch = {"gravity": Hard([0.0, 0.0, -3.0], when=Contact("tool_block", "floor"))}
    asked = [PLAN, None, {"floor_friction": Hard(0.1, at=2), **touch}]
    ours = vector_env(count, task="pushing", **options)
    shared = {name: value for name, value in options.items() if name != "threads"}
    member = shared.pop("member", ScmWorldEnv)
    single = SyncVectorEnv([partial(member, task="pushing", **shared)] * count)
    for index, one in enumerate(asked):
        single.envs[index].reset(seed=7 + index, options={"do": one or {}})
    ours.reset(seed=7, options={"do": asked})
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, count, 9)).astype(np.float32)
    for step in range(STEPS):
        observations, rewards, *_ = ours.step(actions[step])
        for index, env in enumerate(single.envs):
            seen, reward, *_ = env.step(actions[step, index])
            np.testing.assert_array_equal(observations[index], seen, f"{index} at {step}")
            assert rewards[index] == reward
    for index, done in enumerate(ours.get_attr("interventions")):
        assert done == single.envs[index].unwrapped.interventions
    ours.close()
    single.close()
