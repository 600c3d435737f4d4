"""Which body acts on which: from what touches, and from worlds in which one is not there."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Any

import networkx as nx
import numpy as np
import pytest

from scm_world.discovery.learners.bodies import (
    bodies_of,
    episodes_of,
    learn_local,
    learn_null,
    local_edges,
    local_steps,
    null_edges,
    null_effects,
    reached_over,
    without,
)
from scm_world.discovery.learners.found import EstimatedGraph
from scm_world.errors import ModelError, UnknownOption
from scm_world.queries import At, Episode, World
from scm_world.queries.local import LocalEpisode, LocalGraph
from scm_world.tasks.trifinger.hardware import FINGERS as NAMES

FINGERS = tuple(f"robot_finger_{name}" for name in NAMES)
NEEDS_BULLET = pytest.mark.skipif(
    importlib.util.find_spec("pybullet") is None, reason="needs pybullet"
)
ENGINES = ["mujoco", pytest.param("bullet", marks=NEEDS_BULLET)]
ONE, TWO = "tool_block_1", "tool_block_2"
DRAWN = {f"{block}.cylindrical_position": "A" for block in (ONE, TWO)}
STACKED = {
    f"{ONE}.cartesian_position": [0.0, 0.0, 0.0325],
    f"{TWO}.cartesian_position": [0.0, 0.0, 0.0975],
}
APART = {
    f"{ONE}.cartesian_position": [0.0, 0.0, 0.0325],
    f"{TWO}.cartesian_position": [0.0, -0.12, 0.0325],
}

_WORLDS: dict[tuple[str, str], World] = {}


def world_of(engine: str, task: str = "stacking2") -> World:
    """Give a world that is made once; questions leave it as it is."""
    if (engine, task) not in _WORLDS:
        mode = "end_effector_positions"
        _WORLDS[engine, task] = World(task, backend=engine, action_mode=mode)
    return _WORLDS[engine, task]


def sweep(seed: int) -> Callable[[Any], Any]:
    """Close the fingertips around a place near the middle, again and again."""
    dice = np.random.default_rng(seed)
    turn, height, center = dice.uniform(0, 6), dice.uniform(0.015, 0.06), dice.uniform(-0.06, 0.06)

    def policy(world: Any) -> Any:
        angles = np.array([0.5, -1.6, 2.6]) + turn + 0.3 * np.sin(world.index / 7)
        radius = 0.14 - 0.13 * (world.index % 25) / 25
        points = (center + radius * np.cos(angles), radius * np.sin(angles), np.full(3, height))
        return np.stack(points, axis=-1).ravel()

    return policy


def swept(engine: str, seed: int, *, task: str = "stacking2", steps: int = 40) -> Episode:
    """Let the fingers sweep through blocks that lie somewhere."""
    do = DRAWN if task == "stacking2" else {}
    return world_of(engine, task).rollout(sweep(seed), seed=seed, steps=steps, do=do)


def local(*steps: list[tuple[str, str]]) -> LocalEpisode:
    """Write local graphs down."""
    return LocalEpisode(tuple(LocalGraph(t, tuple("abc"), tuple(e)) for t, e in enumerate(steps)))


def pairs(found: EstimatedGraph) -> set[tuple[str, str]]:
    """Give the edges without their lag."""
    assert not found.undirected
    return {(cause, effect) for cause, effect, _ in found.directed}


# --- what touches -------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ENGINES)
def test_blocks_on_one_another_act_on_each_other_in_every_step(engine: str) -> None:
    """Contacts and paired experiments say the same, and nothing of the fingers."""
    episode = world_of(engine).rollout(None, steps=5, do=STACKED)
    found = local_edges(episode)
    assert pairs(found) == {(ONE, TWO), (TWO, ONE)}
    assert found.edge_scores.max() == 1.0
    assert found.experiments == 5
    assert found.names == (*FINGERS, ONE, TWO)
    assert pairs(local_edges(episode, truth=True)) == pairs(found)


def test_a_body_reaches_others_in_the_order_of_time() -> None:
    """What acts on b after b has acted on c does not reach c; what does before reaches it."""
    one = reached_over(local([("a", "b")], [("b", "c")]))
    assert one == {("a", "b"): 1, ("b", "c"): 2, ("a", "c"): 2}
    other = reached_over(local([("b", "c")], [("a", "b")]))
    assert other == {("b", "c"): 1, ("a", "b"): 2}
    both = reached_over(local([("a", "b")], []), local([], [("b", "c")]))
    assert both == one


def test_the_local_graphs_of_an_episode_are_exact() -> None:
    """Later interventions happen again, and what a whole step brought together is found."""
    late = {name: At(2, value) for name, value in STACKED.items()}
    graphs = local_steps(world_of("mujoco").rollout(None, steps=4, do=late)).graphs
    assert [graph.index for graph in graphs] == [0, 1, 2, 3]
    assert [bool(graph.edges) for graph in graphs] == [False, False, True, True]
    shares = local_edges(world_of("mujoco").rollout(None, steps=4, do=late))
    assert shares.edge_scores.max() == 0.5


def test_chained_edges_are_the_paths_through_time() -> None:
    """They hold the direct ones, and are those of the unrolled graph."""
    episode = swept("mujoco", 1)
    direct, chained = local_edges(episode), local_edges(episode, chained=True)
    assert pairs(direct) <= pairs(chained)
    assert pairs(direct)
    unrolled = local_steps(episode).unrolled()
    for body in (*FINGERS, ONE, TWO):
        later = {name for name, t in nx.descendants(unrolled, (body, 0)) if name != body}
        assert later <= {effect for cause, effect in pairs(chained) if cause == body}


# --- what is missed -----------------------------------------------------------------------------


def test_who_never_touches_is_not_missed() -> None:
    """Without a block far away, all others are where they were, bit for bit."""
    episode = world_of("mujoco").rollout(None, steps=20, do=APART)
    report = null_effects(episode)
    assert report.causes == (ONE, TWO)
    assert report.effects == ()
    assert set(report.changes.values()) == {0.0}
    assert report.floor == 0.0


@pytest.mark.parametrize("engine", ENGINES)
def test_who_holds_another_one_up_is_missed(engine: str) -> None:
    """Without the lower block the upper one falls, at once and about as far as its height."""
    report = null_effects(world_of(engine).rollout(None, steps=30, do=STACKED))
    effects = {(one.cause, one.effect): one for one in report.effects}
    fall = effects[ONE, TWO]
    assert fall.first == 1
    assert fall.size == pytest.approx(0.07, abs=0.01)
    assert not [pair for pair in effects if pair[1] in FINGERS]
    found = null_edges(world_of(engine), policy=None, steps=30, do=STACKED)
    assert pairs(found) == set(effects)
    at = found.names.index
    wanted = np.log10(1.0 + report.changes[ONE, TWO] / report.threshold)
    assert found.edge_scores[1, at(ONE), at(TWO)] == wanted


@pytest.mark.parametrize("seed", range(4))
def test_only_who_was_reached_is_affected_and_not_before(seed: int) -> None:
    """What differs between two worlds is where chains of contacts in one of them lead."""
    episode = swept("mujoco", seed)
    report = null_effects(episode)
    seen = local_steps(episode, rule="listed")
    assert report.effects
    for cause in report.causes:
        other = local_steps(without(episode, cause), rule="listed")
        reached = reached_over(seen, other)
        for effect in (one for one in report.effects if one.cause == cause):
            assert effect.first >= reached[cause, effect.effect]


def test_a_wall_is_missed_by_who_runs_into_it() -> None:
    """Obstacles are causes, and never effects; fingers the other way round."""
    do = {
        "tool_block.cartesian_position": [0.0, -0.08, 0.0325],
        "tool_block.linear_velocity": [0.0, 0.8, 0.0],
    }
    episode = world_of("mujoco", "pick_and_place").rollout(None, steps=25, do=do)
    report = null_effects(episode)
    assert report.causes == ("tool_block", "obstacle")
    assert {(one.cause, one.effect) for one in report.effects} == {("obstacle", "tool_block")}
    assert ("obstacle", "tool_block") in pairs(local_edges(episode))


@pytest.mark.parametrize("seed", [3, 10])
def test_draws_for_others_stay(seed: int) -> None:
    """They keep their values bit for bit, though a first draw that met the body was refused."""
    drawn = {**DRAWN, f"{TWO}.euler_orientation": "A", f"{TWO}.mass": "B"}
    episode = world_of("mujoco").rollout(None, seed=seed, steps=2, do=drawn)
    other = without(episode, ONE)
    for name in ("cartesian_position", "orientation", "mass"):
        values = (one[f"{TWO}.{name}"][0] for one in (other, episode))
        np.testing.assert_array_equal(*values)
    assert bodies_of(other) == (*FINGERS, TWO)


# --- as learners --------------------------------------------------------------------------------


def test_a_budget_is_of_control_steps() -> None:
    """It is kept to, but for the first episode; the world is left alone."""
    world = world_of("mujoco")
    world.reset(seed=0)
    before = world.values()
    assert learn_local(world, budget=25, steps=10, do=STACKED).experiments == 20
    assert learn_null(world, budget=85, steps=10, do=STACKED).experiments == 80
    assert learn_null(world, budget=1, steps=3, policy=None).experiments == 12
    assert all(np.array_equal(before[name], value) for name, value in world.values().items())


def test_results_are_those_of_the_seed_and_survive_being_written() -> None:
    """Several episodes are taken together."""
    world, given = world_of("mujoco"), {"steps": 10, "budget": 80, "do": DRAWN}
    one, other = (learn_null(world, seed=2, **given) for _ in range(2))
    np.testing.assert_array_equal(one.edge_scores, other.edge_scores)
    again = EstimatedGraph.from_dict(one.as_dict())
    np.testing.assert_array_equal(again.edges, one.edges)
    episodes = episodes_of(world, seed=2, episodes=2, steps=10, do=DRAWN)
    np.testing.assert_array_equal(null_edges(episodes).edge_scores, one.edge_scores)


def test_what_has_no_bodies_is_refused() -> None:
    """The errors say what there would have to be."""
    with pytest.raises(ModelError, match="nothing to take away"):
        null_edges(World("reaching", backend="fake"), steps=2)
    for wrong in ("pushing", [], [1]):
        with pytest.raises(ModelError, match="World or of episodes"):
            local_edges(wrong)  # type: ignore[arg-type] # on purpose
    with pytest.raises(ModelError, match="policy: for a World"):
        local_edges(world_of("mujoco").rollout(None, steps=1), policy=None)
    with pytest.raises(UnknownOption, match="steps"):
        learn_local(world_of("mujoco"), steps=0)
    with pytest.raises(UnknownOption, match="rule"):
        local_edges(world_of("mujoco"), steps=1, rule="touching")
