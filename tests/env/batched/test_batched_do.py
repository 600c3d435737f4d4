"""Interventions, snapshots and branches of many environments."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from many_envs import KINDS, LENGTH, REACHING, SIZE, actions, check_alike, check_same, kept, make

from scm_world.errors import (
    InterventionError,
    NotReset,
    OutOfBounds,
    SnapshotMismatch,
    UnknownOption,
)


@pytest.fixture(params=KINDS)
def pair(request: pytest.FixtureRequest) -> tuple[Any, Any]:
    """Give two batches in the same state."""
    options = {"max_episode_length": LENGTH, "render_mode": "rgb_array"}
    both = kept(request.param), make(request.param, **options)
    for envs in both:
        envs.reset(seed=0)
        envs.step(actions(1, seed=9)[0])
    return both


def test_an_intervention_is_one_for_all_or_one_for_each(pair: tuple[Any, Any]) -> None:
    """Whichever way it is asked, each world does what it would do alone."""
    envs, other = pair
    audits = envs.do({"tool_block.mass": 0.04})
    assert list(audits) == [0, 1, 2, 3]
    other.do([{"tool_block.mass": 0.04}] * 4)
    check_alike(envs, other, 2)
    some = envs.do({2: {"floor_friction": 0.4}, 0: {"tool_block": {"color": "B"}}})
    assert list(some) == [2, 0]
    assert "floor_friction" in str(some[2])
    other.do([{"tool_block.color": "B"}, None, {"floor_friction": 0.4}, None])
    check_same(envs.present(), other.present(), "present")
    check_alike(envs, other, 2)
    assert [len(done) for done in envs.get_attr("interventions")] == [2, 1, 2, 1]


def test_what_was_done_is_seen_at_once(pair: tuple[Any, Any]) -> None:
    """``present`` shows observation and info after an intervention, of that world only."""
    envs, other = pair
    before, _ = other.present()
    envs.do({1: {"goal_block.cartesian_position": [0.05, 0.0, 0.0325]}})
    after, infos = envs.present()
    np.testing.assert_array_equal(np.flatnonzero((after != before).any(axis=1)), [1])
    assert {0.05, 0.0325} <= {*infos["desired_goal"][1]}


def test_all_worlds_are_intervened_on_or_none(pair: tuple[Any, Any]) -> None:
    """A world that refuses is named, and those before it are as they were, bit for bit."""
    envs, untouched = pair
    fine: dict[str, Any] = {"tool_block.cartesian_position": [0.05, 0.05, 0.0325]}
    for index in range(SIZE):
        requests = [fine] * SIZE
        requests[index] = {"tool_block.mass": -1.0}
        with pytest.raises(OutOfBounds, match=f"environment {index}: .*mass") as caught:
            envs.do(requests)
        assert caught.value.variable == "tool_block.mass"
    with pytest.raises(OutOfBounds, match="environment 0"):
        envs.do({0: {"tool_block.mass": 0.09}}, space="A")
    assert envs.get_attr("interventions") == ((),) * SIZE
    check_same(envs.present(), untouched.present(), "present")
    check_alike(envs, untouched, 3)


def test_all_episodes_begin_without_what_one_refuses(pair: tuple[Any, Any]) -> None:
    """After a reset that one world refuses, all are in the episodes of a plain reset."""
    envs, untouched = pair
    wishes = [{}, {}, {"tool_block.mass": -1.0}, {}]
    with pytest.raises(OutOfBounds, match="environment 2"):
        envs.reset(seed=8, options={"do": wishes})
    untouched.reset(seed=8)
    check_same(envs.present(), untouched.present(), "present")
    check_alike(envs, untouched, 3)


@pytest.mark.parametrize("kind", KINDS)
def test_worlds_of_a_batch_are_observed_alike(kind: str) -> None:
    """What changes which bodies there are in one of them is refused; it is as it was."""
    start = {"number_of_obstacles": 1}
    envs, untouched = (make(kind, id_=REACHING, start=start) for _ in range(2))
    for one in (envs, untouched):
        one.reset(seed=0)
    other = {"number_of_obstacles": 2}
    text = r"environment 3: .*number_of_obstacles.*\(48,\).*\(59,\).*start="
    with pytest.raises(InterventionError, match=text):
        envs.do({0: {"floor_friction": 0.4}, 3: other})
    with pytest.raises(InterventionError, match=text):
        envs.reset(options={"do": {3: other}})
    check_same(envs.present(), untouched.present(), "present")
    check_alike(envs, untouched, 2)
    single: Any = make(kind, 1, REACHING, start=other)
    single.reset(seed=0)
    with pytest.raises((InterventionError, SnapshotMismatch), match="environment 1: the snapshot"):
        envs.restore({1: single.snapshot()[0]})
    check_alike(envs, untouched, 2)


def test_it_goes_back_to_a_snapshot(pair: tuple[Any, Any]) -> None:
    """All worlds, or some; after a pickle too; in another batch too."""
    envs, other = pair
    saved = pickle.loads(pickle.dumps(envs.snapshot()))  # noqa: S301 # written in the line itself
    first = [envs.step(action) for action in actions(3)]
    envs.do({"floor_friction": 0.3})
    envs.restore(saved)
    check_same([envs.step(action) for action in actions(3)], first, "again")
    other.reset(seed=77)
    other.restore(saved)
    check_same([other.step(action) for action in actions(3)], first, "elsewhere")
    present = envs.snapshot()
    envs.restore({2: saved[2]})
    shown, _ = envs.present()
    np.testing.assert_array_equal((shown != other.present()[0]).any(axis=1), [0, 0, 1, 0])
    envs.restore({2: present[2]})
    check_alike(envs, other, 2)


def test_what_is_done_is_still_done_after_a_snapshot() -> None:
    """A snapshot knows which worlds begin anew with the next step."""
    envs = make(max_episode_length=2)
    envs.reset(seed=0)
    envs.step(actions(1)[0])
    envs.reset(seed=5, options={"reset_mask": np.array([False, True, True, False])})
    envs.step(actions(1)[0])
    saved = envs.snapshot()
    assert [one.ended for one in saved] == [True, False, False, True]
    first = [envs.step(action) for action in actions(4)]
    envs.restore(saved)
    check_same([envs.step(action) for action in actions(4)], first, "again")
    for nothing in (envs.do, envs.restore):
        with pytest.raises(UnknownOption, match="one for all"):
            nothing(None)
    with pytest.raises(UnknownOption, match="length 2"):
        make(n=2).restore(saved)


def test_branches_go_on_from_one_world(pair: tuple[Any, Any]) -> None:
    """They differ by nothing but what is done to them."""
    envs, _ = pair
    envs.branch(2)
    first, _ = envs.present()
    assert (first == first[2]).all()
    envs.do(
        {0: {"floor_friction": 0.2}, 1: {"tool_block.cartesian_position": [0.05, 0.05, 0.0325]}}
    )
    for action in actions(4, 1):
        shown, rewards, *_ = envs.step(np.repeat(action, SIZE, axis=0))
    np.testing.assert_array_equal(shown[2], shown[3])
    assert rewards[2] == rewards[3]
    assert not np.array_equal(shown[1], shown[2])


def test_some_become_branches() -> None:
    """Those that are named; the others stay."""
    envs, other = make(), make()
    for one in (envs, other):
        one.reset(seed=0)
    envs.branch(0, [1])
    other.branch(0, np.array([1]))
    check_same(envs.present(), other.present(), "present")
    shown, _ = envs.present()
    assert np.array_equal(shown[0], shown[1])
    check_alike(envs, other, 2)
    for into in ([7], [-1], [True]):
        with pytest.raises(UnknownOption, match=r"environment|mask"):
            envs.branch(0, into)


def test_a_world_without_episode_has_nothing_to_save() -> None:
    """The error says which one it is."""
    envs = make()
    envs.reset(options={"reset_mask": np.array([True, False, False, False])})
    for ask in (envs.snapshot, lambda: envs.branch(1), lambda: envs.do({1: {}})):
        with pytest.raises(NotReset, match="environment 1"):
            ask()
    envs.branch(0)
    envs.step(actions(1)[0])
