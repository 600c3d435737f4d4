"""What a context draws does not depend on what is asked: what does not fit with it is refused."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from scm_world import Draw, Hard, Natural, Shift, World
from scm_world.curricula import make_vec, resample
from scm_world.errors import Infeasible, InterventionError
from scm_world.queries import Plan

FIRST, SECOND = (f"tool_block_{number}.cylindrical_position" for number in (1, 2))
POSES = {FIRST: "A|B", SECOND: "A|B"}
LARGE = {"tool_block_2.size": Hard([0.09, 0.09, 0.065])}
NEAR = {FIRST: Shift([0.0, 0.01, 0.0])}
EPISODES = 15


@pytest.fixture(scope="module")
def blocks() -> Iterator[World]:
    """Two blocks that are drawn into each other in about one of fifteen units."""
    with World("stacking2", backend="fake") as world:
        yield world


def begun(world: World, do: Any, nature: Any, number: int) -> dict[str, Any]:
    """Return the values in which an episode begins."""
    world.reset(seed=0, episode=number, do=Plan(do).over(nature, "nature"))
    return world.values()


def differing(one: dict[str, Any], other: dict[str, Any], names: Any) -> list[str]:
    """Return the names of variables that differ between two beginnings; poses without a height."""
    there = [name for name in names if name in one and name in other]
    flat = {n: slice(2) if n in POSES else slice(None) for n in there}
    return [
        n for n in there if not np.array_equal(*(np.ravel(o[n])[flat[n]] for o in (one, other)))
    ]


@pytest.mark.parametrize(
    ("do", "free"),
    [(LARGE, [FIRST]), (NEAR, [SECOND]), ({SECOND: Hard([0.1, 1.0, 0.0325])}, [FIRST])],
)
def test_nature_draws_the_same_whatever_is_done(blocks: World, do: Any, free: Any) -> None:
    """In each unit the other block lies where it lies without the act, or the act is refused."""
    refused = list[Infeasible]()
    for number in range(EPISODES):
        own, same = begun(blocks, {}, POSES, number), free
        try:
            begun(blocks, do, POSES, number)
        except Infeasible as error:  # the episode has begun in its context
            refused.append(error)
            same = [FIRST, SECOND]
        assert not differing(own, blocks.values(), same)
    assert 0 < len(refused) < EPISODES
    assert {error.variable for error in refused} == do.keys()
    how: Any = {"nature": POSES, "policy": None, "steps": 1}
    with pytest.raises(Infeasible, match="with the draws of episode"):
        blocks.effect(free[0], do=do, n=EPISODES, **how)


def test_a_counterfactual_is_the_same_unit(blocks: World) -> None:
    """Also in a replay, and in a branch of a live episode."""
    world, refused = blocks.given(POSES), 0
    for number in range(EPISODES):
        unit: Any = {"seed": 0, "episode": number}
        episode = world.rollout(None, steps=2, **unit)
        assert episode.counterfactual({}) == episode
        try:
            other = episode.counterfactual(LARGE)
        except Infeasible:
            refused += 1
            continue
        assert other.replay() == other
        for name in (FIRST, SECOND):
            assert other[name][0][:2].tobytes() == episode[name][0][:2].tobytes()
        live = world.live(None, **unit)
        branch = live.split(LARGE)
        branch.step()
        branch.step()
        assert branch.episode() == other
        live.close()
        branch.close()
    assert 0 < refused < EPISODES


def test_draws_that_are_asked_are_repeated(blocks: World) -> None:
    """They come from the feasible part of their space, in the unit that the context has drawn."""
    for number in range(EPISODES):
        own = begun(blocks, {}, {FIRST: "A|B"}, number)
        now = begun(blocks, {SECOND: Draw("A|B"), **LARGE}, {FIRST: "A|B"}, number)
        assert now[FIRST].tobytes() == own[FIRST].tobytes()
        both, same = (begun(blocks, do, POSES, number) for do in ({}, {SECOND: Draw("A|B")}))
        assert not differing(both, same, POSES)  # an equal draw gives the same


def test_a_counterfactual_uncovers_what_the_context_drew(blocks: World) -> None:
    """Also where the episode had another draw of the same block in its place."""
    given, own = blocks.given(POSES), {FIRST: Draw("A|B", stream="own")}
    for number in range(EPISODES):
        begun(given, {}, {}, number)
        wanted = given.values()
        episode = given.rollout(None, steps=1, seed=0, episode=number, do=own)
        with suppress(Infeasible):
            other = episode.counterfactual({FIRST: Natural()})
            assert other.replay() == other
            assert not differing(wanted, {name: other[name][0] for name in POSES}, POSES)


def test_what_exists_is_drawn_once() -> None:
    """Also how many bodies there are, each number of them with several draws of the rest."""
    world = World("reaching", backend="fake")
    drawn = {
        v.name: Draw("A")
        for v in world.model.variables
        if v.settable and v.role in ("parameter", "state") and v.a is not None
    }
    acts: tuple[dict[str, Any], ...] = (
        {"floor_friction": 0.5},
        {"joint_positions": Hard([0.0, 0.9, -1.7] * 3)},
        {"number_of_obstacles": Shift(1)},
    )
    done = 0
    for seed in range(6):
        world.reset(seed=seed, do=Plan({}).over(drawn, "nature"))
        own = world.values()
        for do in acts:
            try:
                world.reset(seed=seed, do=Plan(do).over(drawn, "nature"))
            except InterventionError:
                continue
            done += 1
            assert not differing(own, world.values(), drawn.keys() - do.keys())
    assert done > 12


def test_a_window_ends_in_what_the_context_drew(blocks: World) -> None:
    """The size of each block afterwards is that of the unit, whatever its poses had to be."""
    size = "tool_block_2.size"
    nature = {**POSES, size: Draw([0.05] * 3, [0.09] * 3)}
    window = {size: Hard([0.05] * 3, during=(0, 1))}
    for number in range(10):
        own = begun(blocks, {}, nature, number)[size]
        blocks.reset(seed=0, episode=number, do=Plan(window).over(nature, "nature"))
        blocks.step(blocks["joint_positions"])
        blocks.act()
        np.testing.assert_array_equal(blocks[size], own)


def test_vectors_draw_what_single_environments_draw() -> None:
    """A curriculum draws the same pose in each world, whatever is asked of the reset."""
    envs: Any = make_vec("scm_world/Stacking2-v0", 3, resample(FIRST, "A|B"), backend="fake")
    for seed in range(5):
        envs.reset(seed=seed)
        own = [one[FIRST][:2].tolist() for one in envs.get_attr("world")]
        try:
            envs.reset(seed=seed, options={"do": LARGE})
        except Infeasible:
            continue
        assert [one[FIRST][:2].tolist() for one in envs.get_attr("world")] == own
    envs.close()
