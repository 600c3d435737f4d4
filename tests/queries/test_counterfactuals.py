"""Axioms of counterfactuals, on every task and engine, bit for bit."""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
import pytest

from scm_world.errors import InterventionError
from scm_world.queries import Episode, World, do
from scm_world.tasks import TASKS, make_task
from scm_world.variables import Box, Derived, Draw, Hard

ENGINES = ["mujoco"] + (["bullet"] if importlib.util.find_spec("pybullet") else [])
SMALL: dict[str, dict[str, Any]] = {
    "towers": {"number_of_blocks_in_tower": (1, 1, 2), "tower_dims": (0.035, 0.035, 0.07)},
    "stacked_blocks": {"num_of_levels": 2, "max_level_width": 0.04},
    "creative_stacked_blocks": {"num_of_levels": 2, "max_level_width": 0.04},
    "general": {"nums_objects": 2},
}
STEPS = 12


def quantities(world: World) -> list[str]:
    """Name what can be set and is no other coordinate of something, and no clock."""
    model = world.model
    return [
        name
        for name in model
        if model.declared(name).settable
        and not (isinstance(model.declared(name), Derived) and model.target(name) != name)
        and name not in ("action", "control_index")
    ]


def other_value(world: World, episode: Episode, name: str, at: int, random: Any) -> Any:
    """Give a value near the present one that bounds allow."""
    variable = world.model.declared(name)
    value = np.asarray(episode[name][at])
    if variable.dtype != "real":
        return value.tolist()
    wanted = value + random.uniform(-0.02, 0.02, value.shape) * (1.0 + np.abs(value))
    bounds = variable.bounds
    near = wanted if bounds is None or bounds.parents() else bounds.nearest(wanted)
    return near.tolist()


def check_axioms(world: World, case: int) -> int:
    """Check one random episode; count the interventions that were possible."""
    random = np.random.default_rng(case)
    episode = world.rollout("random", seed=case, steps=STEPS)
    names, possible = quantities(world), 0
    at = int(random.integers(STEPS))
    assert episode.counterfactual({}, at=at) == episode
    for name in random.choice(names, size=3, replace=False).tolist():
        same = episode.counterfactual({name: np.asarray(episode[name][at]).tolist()}, at=at)
        assert same == episode, (name, at)
        value = other_value(world, episode, name, at, random)
        try:
            other = episode.counterfactual({name: value}, at=at)
        except InterventionError:
            continue
        possible += 1
        reached = other[name][at]
        if np.shape(value) != (4,):  # quaternions are made unit ones
            np.testing.assert_array_equal(reached, np.reshape(value, np.shape(reached)))
        also = random.choice([n for n in names if n != name])
        held = np.asarray(other[also][at]).tolist()
        try:
            both = episode.counterfactual({name: value, also: held}, at=at)
        except InterventionError:
            continue
        assert both == other, (name, also, at)
    return possible


@pytest.mark.parametrize("backend", ENGINES)
@pytest.mark.parametrize("task", TASKS)
def test_counterfactuals_obey_their_axioms(task: str, backend: str) -> None:
    """Consistency, effectiveness and composition, exactly."""
    world = World(make_task(task, **SMALL.get(task, {})), backend=backend)
    assert sum(check_axioms(world, case) for case in range(2)) > 2


@pytest.mark.slow
@pytest.mark.parametrize("backend", ENGINES)
@pytest.mark.parametrize("task", TASKS)
def test_a_thousand_counterfactuals_obey_their_axioms(task: str, backend: str) -> None:
    """Over all tasks and engines, more than a thousand random cases."""
    world = World(make_task(task, **SMALL.get(task, {})), backend=backend)
    for case in range(60):
        check_axioms(world, case)


@pytest.mark.parametrize("backend", ENGINES)
def test_a_counterfactual_can_begin_anywhere(backend: str) -> None:
    """What was before stays, and branches of branches are exact too."""
    world = World("pushing", backend=backend)
    plan = do({"tool_block.mass": Draw("A"), "floor_friction": Hard(0.3, at=12)})
    episode = world.rollout(
        "random", seed=3, steps=25, do=plan.do({"action": Hard([0.1] * 9, during=(5, 9))})
    )
    for at in (0, 7, 10, 12, 24):
        place = [0.1, 0.1, 0.0325]
        other = episode.counterfactual({"tool_block.cartesian_position": place}, at=at)
        for name in ("joint_positions", "tool_block.orientation", "floor_friction"):
            np.testing.assert_array_equal(other[name][:at], episode[name][:at])
        np.testing.assert_array_equal(other["tool_block.cartesian_position"][at], place)
        assert other != episode
        assert other.counterfactual({}, at=at) == other
        again = other.counterfactual({"gravity": [0.0, 0.0, -5.0]}, at=24)
        np.testing.assert_array_equal(again["reward"][:24], other["reward"][:24])


def test_parallel_worlds_do_not_depend_on_workers() -> None:
    """Threads are for speed alone."""
    episode = World("pushing").rollout("random", seed=1, steps=10)
    dos = [{"tool_block.mass": mass} for mass in (0.02, 0.05, 0.1, 0.2)]
    assert episode.worlds(dos, workers=1) == episode.worlds(dos, workers=4)


def test_asking_leaves_the_world_as_it_is() -> None:
    """A world in mid-episode goes on as if nobody had asked."""
    worlds = [World("pushing"), World("pushing")]
    for world in worlds:
        world.reset(seed=5)
        world.step(world["joint_positions"])
    worlds[0].rollout("random", seed=1, steps=5).counterfactual({"floor_friction": 0.1}, at=2)
    worlds[0].effect("reward", do={"floor_friction": 0.1}, n=2, steps=3)
    with worlds[0].given({"tool_block.mass": 0.2}) as other:
        other.step(other["joint_positions"])
    for world in worlds:
        world.step(world["joint_positions"])
    one, two = (world.values() for world in worlds)
    assert all(np.array_equal(one[name], two[name]) for name in one)


def test_policies_choose_anew_where_asked() -> None:
    """Replayed actions stay, a policy sees the other world."""
    world = World("pushing", backend="fake")
    episode = world.rollout(lambda w: w["joint_positions"] + 0.01, seed=0, steps=6)
    moved = {"joint_positions": (np.asarray(episode["joint_positions"][2]) + 0.05).tolist()}
    kept = episode.counterfactual(moved, at=2)
    np.testing.assert_array_equal(kept.actions, episode.actions)
    chosen = episode.counterfactual(moved, at=2, actions=lambda w: w["joint_positions"] + 0.01)
    assert not np.array_equal(chosen.actions[2:], episode.actions[2:])
    np.testing.assert_array_equal(chosen.actions[:2], episode.actions[:2])


def test_a_box_is_drawn_from_in_both_worlds_alike() -> None:
    """The noise of a draw belongs to the variable: other interventions do not shift it."""
    world = World("pushing", backend="fake")
    nature = {"tool_block.mass": Draw(Box(0.02, 0.2))}
    one = world.rollout(seed=4, steps=2, do=nature)
    two = world.rollout(seed=4, steps=2, do={**nature, "floor_friction": Draw("B")})
    np.testing.assert_array_equal(one["tool_block.mass"], two["tool_block.mass"])
