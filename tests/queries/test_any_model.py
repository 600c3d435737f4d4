"""All questions can be asked of a world of any model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world.errors import ActionError, SnapshotMismatch, UnknownOption
from scm_world.policies.planning import CrossEntropy
from scm_world.queries import (
    Laboratory,
    Outcome,
    Random,
    World,
    but_for,
    compare,
    load_episode,
    save_episode,
)
from scm_world.variables import Box, Contact, Hard, Reaches

CART_POLE = """
<mujoco model="tiny cart-pole">
  <option timestep="0.01"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" pos="0 0 -.4"/>
    <body name="cart">
      <joint name="slider" type="slide" axis="1 0 0" range="-1 1" limited="true" damping=".1"/>
      <geom type="box" size=".1 .05 .05" mass="1" contype="0" conaffinity="0"/>
      <body name="pole">
        <joint name="hinge" type="hinge" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 .5" size=".02" mass=".1"/>
        <site name="tip" pos="0 0 .5"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="push" joint="slider" gear="10" ctrlrange="-1 1" ctrllimited="true"/>
    <motor name="twist" joint="hinge" gear="1" ctrlrange=".1 1" ctrllimited="true"/>
  </actuator>
</mujoco>
"""


def upright(angle: Any) -> Any:
    """Say how upright the pole is."""
    return np.cos(angle)


@pytest.fixture(scope="module")
def world() -> World:
    """Make a cart-pole with two motors, a reward and random beginnings."""
    return World(
        CART_POLE,
        reward=(upright, "hinge.position"),
        outcomes=["tip.position"],
        spaces={"pole.mass": {"a": (0.05, 0.1), "b": (0.1, 0.3)}},
        start={"hinge.position": Box(-0.2, 0.2)},
        seconds=0.8,
    )


def test_nothing_done_is_the_same_episode(world: World) -> None:
    """From the beginning and from any instant, bit for bit; another mass is another episode."""
    episode = world.rollout("random", seed=1)
    assert episode.steps == 40
    assert episode.actions.shape == (40, 2)
    assert episode["tip.position"].shape == (41, 3)
    assert episode.counterfactual({}) == episode
    assert episode.counterfactual({}, at=17) == episode
    other = episode.counterfactual({"pole.mass": 0.3}, at=17)
    assert np.array_equal(other["hinge.position"][:18], episode["hinge.position"][:18])
    assert other["hinge.position"][18] != episode["hinge.position"][18]


def test_differences_have_causes(world: World) -> None:
    """Two episodes are compared, and it is told whether the mass mattered."""
    light = world.rollout("random", seed=1, steps=12)
    heavy = light.counterfactual({"pole.mass": 0.3}, at=4)
    found = compare(light, heavy)
    assert found.first == 4
    assert found.variables.loc["hinge.velocity", "first"] == 5
    causes = but_for(heavy, "hinge.position", {"pole.mass": 0.1})
    assert causes.mattered.tolist() == [True]


def test_idle_is_zero_or_next_to_it(world: World) -> None:
    """Without a policy each motor gets what in its range is nearest to zero."""
    assert world.rollout(None, steps=2).actions.tolist() == [[0.0, 0.1], [0.0, 0.1]]


def test_policies_have_the_size_of_the_action(world: World) -> None:
    """Given actions have to fit; policies of the robot's fingers are refused by name."""
    assert world.rollout([0.5, 0.2], steps=2).actions.tolist() == [[0.5, 0.2]] * 2
    with pytest.raises(ActionError, match=r"shape \(2,\) or \(steps, 2\), got \(1, 1\)"):
        world.rollout([0.5], steps=2)
    for name in ("feedback", "sweep"):
        with pytest.raises(ActionError, match=r"one of \['random', 'mpc'\]"):
            world.rollout(name, steps=2)


def test_random_actions_need_no_range() -> None:
    """An actuator without a range is driven within [-1, 1]."""
    free = World(CART_POLE.replace("ctrllimited", "user").replace('user="true"', ""))
    actions = free.rollout("random", steps=50).actions
    assert np.abs(actions).max() <= 1.0
    assert np.ptp(actions[:, 0]) > 1.0


def test_plans_happen_in_time(world: World) -> None:
    """At a step, over a window, on an event, and on a touch."""
    late = world.rollout("random", steps=8, do={"pole.mass": Hard(0.3, at=5)})
    assert late["pole.mass"].tolist() == [0.1] * 5 + [0.3] * 4
    held = world.rollout("random", steps=8, do={"hinge.position": Hard(0.1, during=(2, 5))})
    assert (held["hinge.position"] == 0.1).tolist() == [i in (2, 3, 4) for i in range(9)]
    forced = world.rollout("random", steps=8, do={"push.control": Hard(0.5, during=(2, 5))})
    assert forced["push.control"][2:5].tolist() == [0.5] * 3
    fallen = {"pole.mass": Hard(0.3, when=Reaches("hinge.position", above=1.0))}
    assert world.rollout([0.0, 1.0], steps=40, do=fallen).events["pole.mass"] > 1
    touched = {"pole.mass": Hard(0.3, when=Contact("pole", "world"))}
    assert world.rollout([0.0, 1.0], steps=40, do=touched).events["pole.mass"] > 1


def test_samples_have_what_counts(world: World) -> None:
    """Unless told otherwise, everything that is computed from the states is read off."""
    found = world.sample(5, {"pole.mass": 0.2}, steps=4)
    assert {name: found[name].shape for name in found} == {"tip.position": (5, 3), "reward": (5,)}
    bare = World(CART_POLE)
    with pytest.raises(UnknownOption, match=r"outcomes cannot be None.*slider\.position"):
        bare.see(2, steps=2)
    assert bare.see(2, steps=2, outcomes=["hinge.position"])["hinge.position"].shape == (2,)


def test_many_together_are_as_many_alone(world: World) -> None:
    """A batch of 16 on two threads gives the bits of 16 episodes by themselves."""
    alone = Random()
    sets = [
        world.sample(16, {"pole.mass": 0.2}, steps=60, workers=workers, policy=policy)
        for workers, policy in ((2, "random"), (None, alone.__call__))
    ]
    for name in sets[0]:
        assert np.array_equal(sets[0][name], sets[1][name])


def test_effects_are_estimated(world: World) -> None:
    """Paired, over values, and among units that differ."""
    given: dict[str, Any] = {"n": 12, "steps": 10}
    effect = world.effect("reward", do={"pole.mass": 0.3}, **given)
    assert effect.excludes_zero
    assert len(world.effect_over("reward", name="pole.mass", values=[0.05, 0.1, 0.3], **given)) == 2
    by = Outcome("hinge.position", "first")
    groups = world.effect_by("reward", do={"pole.mass": 0.3}, by=by, bins=2, **given)
    assert groups[0][0][1] <= groups[1][0][0]


def test_a_laboratory_keeps_books(world: World) -> None:
    """Experiments cost episodes, and units can be imagined otherwise."""
    lab = Laboratory(world, settable=["*.mass"], visible=["hinge.*", "reward"], budget=5, steps=4)
    seen = lab.do({"pole.mass": 0.2}, n=2)
    other = lab.counterfactual(0, {"pole.mass": 0.3})
    assert lab.remaining == 2
    assert other["reward"] != seen["reward"][0]


def test_a_planner_takes_the_reward(world: World) -> None:
    """Without goals the reward is what a plan is worth; without one it has to be said."""
    search: dict[str, Any] = {"samples": 4, "elites": 2, "horizon": 2, "iterations": 1}
    assert world.rollout(CrossEntropy(**search), steps=2).actions.shape == (2, 2)
    bare = World(CART_POLE)
    with pytest.raises(UnknownOption, match="without goals and reward"):
        bare.rollout(CrossEntropy(**search), steps=2)
    aim = CrossEntropy(objective={"slider.position": 1.0}, **search)
    assert bare.rollout(aim, steps=2).actions.shape == (2, 2)


def test_a_model_without_actuators_moves() -> None:
    """There is nothing to decide, and everything else can be asked."""
    ball = World(
        "<mujoco><worldbody><body name='ball'><freejoint/><geom size='.1'/></body></worldbody>"
        "</mujoco>"
    )
    episode = ball.rollout("random", steps=3)
    assert episode.actions.shape == (3, 0)
    assert episode.counterfactual({}) == episode
    assert episode["ball.cartesian_position"][3, 2] < 0.0


def test_local_graphs_are_those_of_any_model(world: World) -> None:
    """All edges but those by contacts that are not there."""
    world.reset(seed=0)
    graph = world.local_graph()
    declared = {(e.cause, e.effect, e.lag) for e in world.model.edges if e.when is None}
    assert {(a, b, lag) for a, b, lag in graph.edges(data="lag")} >= declared


# --- files ----------------------------------------------------------------------------------------


def test_an_episode_of_a_file_lives_again(tmp_path: Path) -> None:
    """The model is read anew from its file, and has to be the same."""
    file = tmp_path / "cartpole.xml"
    file.write_text(CART_POLE)
    episode = World(str(file)).rollout("random", seed=3, steps=12, do={"pole.mass": 0.2})
    saved = save_episode(episode, tmp_path / "episode")
    assert load_episode(saved) == episode
    file.write_text(CART_POLE.replace('gear="10"', 'gear="11"'))
    with pytest.raises(SnapshotMismatch, match=r"another system.*physics"):
        load_episode(saved)


def test_an_episode_with_functions_needs_its_world(world: World, tmp_path: Path) -> None:
    """What cannot be written down is given again."""
    episode = world.rollout("random", seed=3, steps=12)
    saved = save_episode(episode, tmp_path / "episode.npz")
    assert load_episode(saved, world=world) == episode
    with pytest.raises(UnknownOption, match="world="):
        load_episode(saved)
    other = World(CART_POLE.replace('mass="1"', 'mass="2"'))
    with pytest.raises(SnapshotMismatch, match=r"another system.*physics"):
        load_episode(saved, world=other)
