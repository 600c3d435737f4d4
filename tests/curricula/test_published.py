"""The predecessor's actors."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest
from curriculum_envs import STILL, under, value

from scm_world.curricula import (
    at_step,
    during,
    goals,
    joints,
    resample,
    together,
)
from scm_world.curricula.curriculum import as_curriculum
from scm_world.env import IDS
from scm_world.models.scene import TOLERANCE
from scm_world.tasks.trifinger.entities.block_world import overlaps
from scm_world.variables.checks import check_space
from scm_world.world import Simulation

CONVENTIONS = ["scm_world", "causal_world"]
MASS = "tool_block.mass"
LINKS = tuple(
    f"robot_finger_{finger}_link_{link}" for finger in (60, 120, 300) for link in range(4)
)
COLORS = {
    *(f"{link}.color" for link in LINKS),
    "floor_color",
    "stage_color",
    "tool_block.color",
    "goal_block.color",
}
POSES = {"tool_block.cylindrical_position", "tool_block.euler_orientation"}
GOAL = {"goal_block.polar", "goal_block.euler_orientation"}
ALL = {
    *COLORS,
    *POSES,
    *(f"{link}.mass" for link in LINKS),
    "block.size",
    "floor_friction",
    "goal_block.cylindrical_position",
    "goal_block.euler_orientation",
    "stage_friction",
    MASS,
}
PLACE, TURN = "tool_*.cylindrical_position", "tool_*.euler_orientation"
RANDOM: Any = partial(resample, "@published", exclusive=True)
MOVES: list[tuple[Any, set[str]]] = [
    (goals, GOAL),
    (joints, {"joint_positions"}),
    (partial(resample, "tool_*.mass"), {MASS}),
    (partial(resample, "floor_friction"), {"floor_friction"}),
    (partial(resample, "stage_friction"), {"stage_friction"}),
    (partial(resample, "robot_finger_*.mass"), {f"{link}.mass" for link in LINKS}),
    (partial(resample, [PLACE, TURN]), POSES),
    (partial(resample, PLACE), {"tool_block.cylindrical_position"}),
    (partial(resample, TURN), {"tool_block.euler_orientation"}),
    (partial(resample, "*color"), COLORS),
]
"""What stands for each actor of the predecessor in ``docs/curricula.md``, and what it moves."""


@pytest.mark.parametrize("conventions", CONVENTIONS)
@pytest.mark.parametrize("space", ["A", "B", "A|B"])
@pytest.mark.parametrize(("actor", "targets"), MOVES)
def test_each_actor_moves_its_variables_inside_the_space(
    actor: Any, targets: set[str], space: Any, conventions: str
) -> None:
    """What it sets are these variables and no others, and their values lie in the space."""
    env = under(actor(space), conventions=conventions)
    env.reset(seed=0)
    world = env.unwrapped.world
    done = {target for _, acts in env.unwrapped.interventions for target in acts}
    assert done == targets
    values = world.values()
    for target in done:
        check_space(world.model.declared(target), values[target], space, values)


@pytest.mark.parametrize("conventions", CONVENTIONS)
def test_the_random_actor_leaves_sizes_or_positions_to_a_coin(conventions: str) -> None:
    """Everything is drawn but the joints; of sizes and positions one kind, half of the time."""
    env = under(RANDOM("A"), conventions=conventions)
    sizes = 0
    for number in range(60):
        env.reset(seed=0 if number == 0 else None)
        ((_, acts),) = env.unwrapped.interventions
        has_sizes = "block.size" in acts
        sizes += has_sizes
        positions = {name for name in ALL if name.endswith(".cylindrical_position")}
        assert set(acts) == ALL - (positions if has_sizes else {"block.size"})
    assert 15 < sizes < 45


@pytest.mark.parametrize("id_", IDS)
@pytest.mark.parametrize("actor", [RANDOM, goals, partial(resample, "*color")])
def test_actors_act_on_every_task(actor: Any, id_: str) -> None:
    """Numbers of blocks are whole (D25)."""
    env = under(actor("A"), id_, conventions="causal_world")
    observation, _ = env.reset(seed=1)
    assert observation.shape == env.observation_space.shape


def test_d26_the_pose_actor_takes_no_size_for_a_block() -> None:
    """On the general task the size of the blocks begins like a block, and is left alone."""
    env = under(resample([PLACE, TURN]), "scm_world/General-v0")
    env.reset(seed=0)
    ((_, targets),) = env.unwrapped.interventions
    assert "tool_block_size" in env.unwrapped.world.model
    assert len(targets) == 2 * len(env.unwrapped.world.composition.blocks)
    assert {name.partition(".")[2] for name in targets} == {
        "cylindrical_position",
        "euler_orientation",
    }


def test_d51_the_joints_actor_draws_from_the_space() -> None:
    """Every draw is in the space and leaves the fingers apart; none is refused."""
    env = under(joints("A"))
    for seed in range(10):
        env.reset(seed=seed)
        world = env.unwrapped.world
        values = world.values()
        check_space(world.model.declared("joint_positions"), values["joint_positions"], "A", values)
        assert overlaps(world.scene(), tolerance=TOLERANCE) == ()


def test_d10_an_actor_within_the_episode_acts_in_every_episode() -> None:
    """With a control step that is not 0, it acts at that step of each episode."""
    env = under(at_step(3, resample("tool_*.mass", "B")))
    for _ in range(3):
        env.reset()
        light = value(env, MASS)
        masses = []
        for _ in range(4):
            env.step(STILL)
            masses.append(value(env, MASS))
        assert masses[:2] == [light] * 2
        assert masses[2] == masses[3] > 0.045 >= light


def test_d43_every_actor_of_a_kind_is_written_down() -> None:
    """Two actors of one kind, with their times, come back from a file."""
    tool, floor = (resample(what, "A|B") for what in ("tool_*.mass", "floor_friction"))
    part = together(at_step(0, during(range(6), tool)), at_step(4, during(range(6, 10, 2), floor)))
    again: Any = as_curriculum(part.as_dict())
    assert again == part
    assert [p.part.part.what for p in again.of] == [("tool_*.mass",), ("floor_friction",)]


def test_every_name_of_an_actor_is_one() -> None:
    """All of them fit a task."""
    world = Simulation("pushing", backend="fake", conventions="causal_world")
    for actor, _ in [*MOVES, (RANDOM, set())]:
        actor("A|B").check(world)
