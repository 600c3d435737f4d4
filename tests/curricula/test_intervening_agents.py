"""Agents whose actions have interventions in them."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from curriculum_envs import ENGINES, PUSHING, STILL, TOWERS, under, value
from gymnasium.utils.env_checker import check_env

from scm_world.curricula import A, InterveningAgent, Subset, goals
from scm_world.errors import ActionError, UnknownOption, UnknownVariable
from scm_world.variables import Box, Integers

MASS, FRICTION = "tool_block.mass", "floor_friction"
WHAT = [MASS, "tool_block.cylindrical_position", FRICTION]


def agent(what: Any = WHAT, id_: str = PUSHING, backend: str = "fake", **options: Any) -> Any:
    """Make an environment in which an agent may intervene."""
    env = gymnasium.make(id_, backend=backend, disable_env_checker=True)
    return InterveningAgent(env, what, **options)


def act(which: Any, values: Any) -> dict[str, Any]:
    """Write an action in which the robot stands still."""
    return {
        "action": STILL,
        "which": np.array(which, np.int8),
        "values": np.array(values, np.float32),
    }


@pytest.mark.parametrize("backend", ["fake", *ENGINES])
def test_what_is_chosen_is_set(backend: str) -> None:
    """The ends of an action are the ends of a region; what is not chosen stays."""
    env = agent(backend=backend)
    env.reset(seed=0)
    friction = value(env, FRICTION)
    *_, info = env.step(act([1, 0, 0], [1, 0, 0, 0, 0]))
    assert (value(env, MASS), info["refused"]) == (0.045, "")
    env.step(act([1, 0, 0], [-1, 0, 0, 0, 0]))
    assert value(env, MASS) == 0.015
    assert value(env, FRICTION) == friction
    env.step(act([1, 0, 1], [0, 0, 0, 0, 0]))
    assert value(env, MASS) == pytest.approx(0.03)
    assert value(env, FRICTION) != friction


def test_both_kinds_of_action_mean_the_same() -> None:
    """A flat action has the action, a number for each variable, and the values."""
    one, other = agent(), agent(flat=True)
    numbers = np.random.default_rng(0)
    for env in (one, other):
        env.reset(seed=0)
    assert other.action_space.shape == (9 + 3 + 5,)
    for _ in range(10):
        which, values = numbers.integers(0, 2, 3), numbers.uniform(-1, 1, 5).astype(np.float32)
        gates = np.where(which, 0.5, -0.5)
        left = one.step(act(which, values))
        right = other.step(np.concatenate([STILL, gates, values]).astype(np.float32))
        np.testing.assert_array_equal(left[0], right[0])
        assert left[1] == right[1]


def test_a_refusal_is_told_and_changes_nothing() -> None:
    """Two names of one quantity cannot both be set: info says why, and the step is made."""
    polar, cartesian = "tool_block.cylindrical_position", "tool_block.cartesian_position"
    env = agent([polar, cartesian, MASS], space=A * Subset({cartesian: Box(-0.1, 0.1)}))
    env.reset(seed=0)
    before = env.unwrapped.world.values()
    nothing = np.zeros(sum(np.size(before[name]) for name in env.targets))
    *_, info = env.step(act([1, 1, 1], nothing))
    assert cartesian in info["refused"]
    assert value(env, MASS) == before[MASS]
    assert env.unwrapped.interventions == ()
    assert env.unwrapped.world.index == 1
    *_, info = env.step(act([0, 0, 1], nothing))
    assert info["refused"] == ""
    assert value(env, MASS) == pytest.approx(0.03)


def test_there_may_be_a_budget() -> None:
    """After so many interventions there are none left until the next episode."""
    env = agent([FRICTION], most=2)
    assert env.reset(seed=0)[1]["interventions_left"] == 2
    do = act([1], [1.0])
    left = [env.step(do)[4]["interventions_left"] for _ in range(2)]
    assert left == [1, 0]
    *_, info = env.step(act([1], [-1.0]))
    assert info["refused"] == "all 2 interventions of this episode were made"
    assert value(env, FRICTION) == 0.6
    assert env.step(act([0], [0.0]))[4]["refused"] == ""
    assert env.reset()[1]["interventions_left"] == 2
    assert agent(most=None).reset(seed=0)[1]["interventions_left"] == -1


def test_regions_are_those_of_the_environment() -> None:
    """Without a space of its own an agent stays in that of the environment."""
    env: Any = gymnasium.make(PUSHING, backend="fake", variables_space={"*.mass": "B"})
    inside = InterveningAgent(env, MASS)
    inside.reset(seed=0)
    assert inside.step(act([1], [1.0]))[4]["refused"] == ""
    assert value(inside, MASS) == 0.1
    with pytest.raises(UnknownOption, match=FRICTION):
        InterveningAgent(env, [MASS, FRICTION])


def test_whole_numbers_are_rounded() -> None:
    """An agent may decide how many blocks there are."""
    name = "number_of_blocks_in_tower"
    env = agent(name, TOWERS, space=Subset({name: Integers(1, 3)}))
    env.reset(seed=0)
    *_, info = env.step(act([1], [-1.0, -0.9, 0.3]))
    assert (info["refused"], value(env, name)) == ("", [1, 1, 2])


@pytest.mark.filterwarnings("ignore:.*different from the unwrapped version")
@pytest.mark.parametrize("flat", [False, True])
def test_gymnasium_accepts_it(flat: bool) -> None:
    """The checker of Gymnasium finds nothing, whatever is sampled."""
    env = agent(["@physics", "tool_block.color"], flat=flat)
    check_env(env, skip_render_check=True)
    env.action_space.seed(0)
    env.reset(seed=0)
    told = [env.step(env.action_space.sample())[4] for _ in range(30)]
    assert all(isinstance(info["refused"], str) for info in told)


def test_it_works_with_a_curriculum() -> None:
    """An agent may intervene in a world that a curriculum changes."""
    env = InterveningAgent(under(goals("A")), FRICTION, flat=True)
    env.reset(seed=0)
    full = np.concatenate([STILL, [1.0, 1.0]]).astype(np.float32)
    assert env.step(full)[4]["refused"] == ""
    assert [list(acts) for _, acts in env.unwrapped.interventions][1:] == [[FRICTION]]


WRONG: list[Any] = [
    {"action": STILL},
    act([1], [0.0]),
    act([1, 0, 0], [np.nan] * 5),
    act([1, 0, 0], [0.0] * 4),
    {**act([1, 0, 0], [0.0] * 5), "action": np.zeros(8, np.float32)},
    STILL,
    None,
]


@pytest.mark.parametrize("action", WRONG)
def test_what_is_no_action_is_refused_before_anything_happens(action: Any) -> None:
    """Missing parts, wrong lengths, numbers that are not finite."""
    env = agent()
    env.reset(seed=0)
    mass = value(env, MASS)
    with pytest.raises(ActionError):
        env.step(action)
    flat = agent(flat=True)
    flat.reset(seed=0)
    for given in (np.zeros(16), np.zeros((1, 17)), np.full(17, np.nan), "none", None):
        with pytest.raises(ActionError):
            flat.step(given)
    assert value(env, MASS) == mass
    assert env.unwrapped.world.index == flat.unwrapped.world.index == 0


def test_wrong_wrappings_are_refused() -> None:
    """Unknown names, regions without ends, actions that are no vector."""
    with pytest.raises(UnknownVariable):
        agent("*.mas")
    for options in ({"space": "C"}, {"most": -1}, {"most": 1.5}):
        with pytest.raises(UnknownOption):
            agent(**options)
    with pytest.raises(UnknownOption, match="two ends"):
        agent("tool_block.orientation")
    with pytest.raises(UnknownOption, match="box"):
        InterveningAgent(agent(), MASS)
    with pytest.raises(UnknownOption, match="ScmWorldEnv"):
        InterveningAgent(gymnasium.make("Pendulum-v1"), MASS)
