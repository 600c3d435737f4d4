"""Worlds from which something was taken."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

import scm_world  # noqa: F401 # registers the environments
from scm_world.errors import InterventionError, UnknownOption, UnknownVariable
from scm_world.queries import Plan, World, compare, do, load_episode, save_episode
from scm_world.variables import Null

ENGINES = ["mujoco", "bullet"]
GONE = "tool_block_2"


@pytest.mark.parametrize("backend", ENGINES)
def test_a_block_is_not_there(backend: str) -> None:
    """Neither in the graph, nor for the engine, nor for the reward; the rest goes on."""
    world = World("stacking2", backend=backend)
    world.reset(seed=0)
    world.step(world["joint_positions"])
    before, place = len(world.graph), world["tool_block_1.cartesian_position"]
    audit = world.do({GONE: Null(), "floor_friction": 0.3})
    assert audit.went == (GONE,)
    assert world.structure.blocks == ("tool_block_1",)
    assert not [name for name in world.graph if GONE in name]
    assert len(world.graph) < before
    terms = set(world.graph.parents("reward"))
    assert terms == {"reward.block_to_goal", "reward.smoothness"}
    np.testing.assert_array_equal(world["tool_block_1.cartesian_position"], place)
    assert world["floor_friction"] == 0.3
    world.step(world["joint_positions"])
    assert np.isfinite(float(world["reward"]))
    world.reset(seed=0)
    assert world.structure.blocks == ("tool_block_1", GONE)


@pytest.mark.parametrize("backend", ENGINES)
def test_snapshots_know_what_is_not_there(backend: str) -> None:
    """Going back and on is exact, before and after; a second one can go as well."""
    world = World("stacking2", backend=backend)
    world.reset(seed=0)
    start = world.snapshot()
    world.do({GONE: Null()})
    without = world.snapshot()
    ends = []
    for _ in range(2):
        world.restore(without)
        world.step(world["joint_positions"] + 0.05)
        ends.append(world.values())
    assert all(np.array_equal(ends[0][name], ends[1][name]) for name in ends[0])
    world.restore(start)
    assert GONE in world.structure.blocks
    world.do({GONE: Null()})
    world.do({"tool_block_1": Null()})
    assert world.structure.blocks == ()


@pytest.mark.parametrize("backend", ENGINES)
def test_an_episode_without_it_is_exact(backend: str) -> None:
    """Counterfactuals, branches and files hold; a block nobody touched was no cause."""
    world = World("stacking2", backend=backend)
    episode = world.rollout(steps=12)
    other = episode.counterfactual({GONE: Null()}, at=5)
    assert other.counterfactual({}, at=3) == other
    assert other.counterfactual({}, at=9) == other
    assert len(other[f"{GONE}.cartesian_position"]) == 5
    apart = compare(episode, other, ["tool_block_1.cartesian_position"])
    largest = apart.variables.largest.max() if len(apart.variables) else 0.0
    assert largest < {"mujoco": 1e-12, "bullet": 1e-4}[backend]
    contacts = [tuple(contact) for contact in apart.contacts.itertuples(index=False)]
    assert (6, ("floor", GONE), "a") in contacts
    late = world.rollout(steps=12, do={GONE: Null(at=5)})
    np.testing.assert_array_equal(late.vectors[-1], other.vectors[-1])


def test_walls_and_goals_go_too_and_what_follows_from_them() -> None:
    """The wall is no obstacle any more; a pile with a block less has no places."""
    world = World("pick_and_place", backend="fake")
    world.reset(seed=0, do={"obstacle": Null()})
    assert world.structure.obstacles == ()
    world = World("pushing", backend="fake")
    world.reset(seed=0, do={"goal_block": Null()})
    assert "fractional_success" not in world.graph
    assert world.scene().goals == ()
    world = World("general", backend="fake")
    world.reset(seed=0, do={"tool_1": Null()})
    assert world.scene().goals == ()
    world.do({"nums_objects": 3})
    assert world.structure.blocks == ("tool_0", "tool_2")


def test_absence_is_a_value(tmp_path) -> None:  # type: ignore[no-untyped-def] # a fixture
    """It goes to JSON, and episodes to files."""
    plan = do({GONE: Null()})
    assert Plan.from_json(plan.to_json()) == plan
    episode = World("stacking2").rollout(steps=3, do=plan)
    assert load_episode(save_episode(episode, tmp_path / "episode")) == episode


@pytest.mark.parametrize(
    ("request_", "error"),
    [
        ({"robot": Null()}, InterventionError),
        ({"nobody": Null()}, UnknownVariable),
        ({"tool_block.mass": Null()}, InterventionError),
    ],
    ids=repr,
)
def test_what_cannot_go_stays(request_: dict[str, Null], error: type[Exception]) -> None:
    """The world is as it was."""
    world = World("pushing", backend="fake")
    world.reset(seed=0)
    before = world.values()
    with pytest.raises(error):
        world.do(request_)
    assert all(np.array_equal(before[name], value) for name, value in world.values().items())
    with pytest.raises(InterventionError, match="a body of a world can"):
        world.model.do({"tool_block.mass": Null()})
    with pytest.raises(UnknownOption, match="intervention of a window"):
        Null(during=(0, None))


def test_environments_keep_what_they_observe() -> None:
    """They say so."""
    env = gymnasium.make("scm_world/Pushing-v0", backend="fake")
    with pytest.raises(InterventionError, match="take something away"):
        env.reset(seed=0, options={"do": {"tool_block": Null()}})
