"""How episodes of an environment begin."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from envs import PUSHING, REACHING, make

from scm_world import Draw, Hard
from scm_world.env.arguments import asked
from scm_world.errors import InterventionError, OutOfBounds, UnknownOption
from scm_world.models.scene import TOLERANCE
from scm_world.queries import Plan
from scm_world.tasks import Pushing
from scm_world.tasks.trifinger.entities.block_world import overlaps
from scm_world.world import Simulation


def test_start_is_applied_at_every_reset() -> None:
    """The start holds in every episode, with new draws in each."""
    env = make(start={"tool_block": {"mass": 0.05}, "floor_friction": Draw("B")})
    drawn = []
    for seed in (0, None, None):
        env.reset(seed=seed)
        world = env.unwrapped.world
        assert world["tool_block.mass"] == 0.05
        drawn.append(float(world["floor_friction"]))
    assert len(set(drawn)) == 3
    assert all(0.6 < value <= 0.8 for value in drawn)


def test_what_is_done_at_a_reset_counts_more_than_the_start() -> None:
    """An intervention in the options replaces that of the start, in other coordinates too."""
    env = make(start={"goal_block.polar": "A", "tool_block.mass": 0.05}, random_goal="B")
    env.reset(seed=0)
    assert env.unwrapped.world["goal_block.cylindrical_position"][0] <= 0.11
    env.reset(options={"do": {"tool_block.mass": 0.03}})
    assert env.unwrapped.world["tool_block.mass"] == 0.03
    place = [0.0, 0.1, 0.0325]
    env.reset(options={"do": {"goal_block.cartesian_position": place}})
    np.testing.assert_allclose(env.unwrapped.world["goal_block.cartesian_position"], place)


def test_names_of_one_quantity_replace_each_other() -> None:
    """Of two coordinates of one pose the later one counts."""
    model = Simulation("pushing", backend="fake").model
    polar, cartesian = "tool_block.cylindrical_position", "tool_block.cartesian_position"
    plan = Plan({cartesian: 2.0}).over({polar: "A", "gravity": 1.0, "unheard_of": 3}, "start")
    found = plan.composed(model)
    assert found == {"gravity": Hard(1.0), cartesian: Hard(2.0), "unheard_of": Hard(3)}
    assert asked({"tool_block": {"mass": "A|B"}}) == {"tool_block.mass": Draw("A|B")}


def test_an_environment_can_be_written_down() -> None:
    """A specification with interventions goes to JSON and back, and makes the same episodes."""
    options = {"start": {"goal_block.polar": "A"}, "task_options": {"weights": "sparse"}}
    env = make(**options)
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    np.testing.assert_array_equal(env.reset(seed=4)[0], again.reset(seed=4)[0])


def test_options_of_a_task_reach_it() -> None:
    """A task that is given by its name takes options; one that is made has had its own."""
    env = make(task_options={"tool_block_mass": 0.07})
    env.reset(seed=0)
    assert env.unwrapped.world["tool_block.mass"] == 0.07
    with pytest.raises(UnknownOption, match="options of a Pushing"):
        make(task=Pushing(), task_options={"tool_block_mass": 0.07})


def test_interventions_stay_in_the_space_that_is_asked_for() -> None:
    """With a space for variables, an intervention outside of it is refused."""
    env = make(variables_space="A")
    env.reset(seed=0, options={"do": {"tool_block.mass": 0.03}})
    with pytest.raises(OutOfBounds):
        env.unwrapped.do({"tool_block.mass": 0.09})


def test_draws_leave_bodies_apart() -> None:
    """Whatever is drawn, is drawn again until it is possible, and the same for the same seed."""
    env = make(start={"joint_positions": "A", "tool_block.cylindrical_position": "A|B"})
    first, _ = env.reset(seed=3)
    for seed in range(20):
        env.reset(seed=seed)
        assert overlaps(env.unwrapped.world.scene(), tolerance=TOLERANCE) == ()
    again, _ = env.reset(seed=3)
    np.testing.assert_array_equal(first, again)


def test_draws_have_short_names_in_mid_episode_too() -> None:
    """The name of a space stands for a draw from it whenever the environment intervenes."""
    env = make()
    env.reset(seed=0)
    env.unwrapped.do({"tool_block.mass": "B"})
    assert 0.045 < env.unwrapped.world["tool_block.mass"] <= 0.1


def test_a_start_that_is_impossible_is_refused_at_the_reset() -> None:
    """What is wrong with a start is said when it is tried."""
    env = make(REACHING, start={"number_of_obstacles": 99})
    with pytest.raises(InterventionError):
        env.reset(seed=0)
    assert make(PUSHING, start={}).reset(seed=0)[0].shape == (56,)
