"""Episodes that are run by hand."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from scm_world.errors import ActionError, InterventionError, UnknownOption
from scm_world.queries import SCM, Episode, Plan, World
from scm_world.variables import (
    Derived,
    Draw,
    Exogenous,
    Hard,
    Linear,
    Natural,
    Normal,
    Parent,
    Reaches,
    Shift,
)

MASS, FRICTION, PLACE = "tool_block.mass", "floor_friction", "tool_block.cartesian_position"


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    """One world for all tests; none of them changes it."""
    with World("pushing") as made:
        yield made


def walked(live: Episode, steps: int) -> None:
    """Take some control steps with the policy."""
    for _ in range(steps):
        live.step()


def test_it_is_the_episode_of_its_plan(world: World) -> None:
    """What was done by hand is a rollout with a plan, bit for bit; the world stays as it was."""
    live = world.live("random", seed=3)
    walked(live, 5)
    live.do({MASS: 0.05})
    walked(live, 4)
    live.do({FRICTION: Hard(0.2, during=(9, 12))})
    assert [*live.held] == [MASS, FRICTION]
    walked(live, 6)
    assert [*live.held] == [MASS]
    live.do({MASS: Natural()})
    assert not live.held
    episode = live.episode()
    assert episode.steps == 15
    plan = {MASS: [Hard(0.05, during=(5, None))], FRICTION: Hard(0.2, during=(9, 12))}
    assert world.rollout("random", seed=3, do=plan, steps=15) == episode
    assert world.rollout(live.actions, seed=3, do=live.plan, steps=15) == episode
    assert episode.counterfactual({}, at=10) == episode
    assert not world.has_begun


def test_split_is_the_counterfactual(world: World) -> None:
    """Stepped with the same actions it is the counterfactual, wherever it was split."""
    live = world.live("random", seed=1)
    walked(live, 12)
    live.do({MASS: Draw("B")})
    live.do({MASS: Draw("B")})
    walked(live, 5)
    for at in (0, 7, 12, 17):
        twin = live.split({FRICTION: 0.3}, at=at)
        for action in live.actions[at:]:
            twin.step(action)
        walked(twin, 1)
        there = live.split()
        walked(there, 1)
        assert twin.episode() == there.episode().counterfactual({FRICTION: 0.3}, at=at)
        assert there.episode() == there.episode().counterfactual({}, at=at)
        twin.close()
        there.close()
    with pytest.raises(UnknownOption, match="a control step from 0 to 17"):
        live.split(at=18)


def test_the_plan_says_what_was_done(world: World) -> None:
    """Windows that were cut, releases and repeated values are in one plan."""
    live = world.live("random", seed=5, do={MASS: 0.03})
    live.do({FRICTION: Hard(0.2, during=(2, 30))})
    walked(live, 6)
    live.do({MASS: 0.06, FRICTION: 0.5})
    walked(live, 3)
    live.do({MASS: Natural()})
    live.do({FRICTION: Hard(0.4, during=(9, 11))})
    walked(live, 6)
    plan = Plan.from_json(live.plan.to_json())
    assert world.rollout("random", seed=5, do=plan, steps=15) == live.episode()


def test_draws_at_one_instant_differ_and_repeat(world: World) -> None:
    """Each draw is another one, and the episode draws the last of them again."""
    live = world.live(seed=0)
    found = []
    for _ in range(3):
        live.do({MASS: Draw("A")})
        found.append(float(live.world[MASS]))
    walked(live, 2)
    assert len({*found}) == 3
    assert live.episode()[MASS].tolist() == [found[-1]] * 3
    assert live.episode().counterfactual({}) == live.episode()


def test_what_is_refused_changes_nothing(world: World) -> None:
    """Neither an intervention nor an action."""
    live = world.live("random", seed=2)
    with pytest.raises(UnknownOption, match="1 or more"):
        live.episode()
    walked(live, 3)
    before = live.episode()
    with pytest.raises(InterventionError, match="nearest"):
        live.do({MASS: -1.0})
    with pytest.raises(ActionError):
        live.step([1.0])
    assert live.steps == 3
    assert live.episode() == before
    assert not live.held
    live.do({MASS: Shift(0.01)})
    walked(live, 8)
    assert live.episode().counterfactual({}, at=4) == live.episode()


def test_what_was_due_is_released_when_it_is_refused(world: World) -> None:
    """The step is taken, the error says why, and the episode can be repeated."""
    live = world.live("random", seed=0)
    live.do({PLACE: Hard(live.world[PLACE].tolist(), during=(0, 40))})
    live.do({"tool_block.size": Hard([0.08, 0.08, 0.08], at=3)})
    walked(live, 2)
    with pytest.raises(InterventionError, match="lies"):
        live.step()
    assert live.steps == 3
    assert not live.held
    walked(live, 10)
    assert live.episode().counterfactual({}, at=2) == live.episode()
    assert live.episode().counterfactual({}, at=11) == live.episode()


def test_equations_are_run_by_hand_too() -> None:
    """A model without a backend has the same method."""
    model = SCM(
        [
            Exogenous(name="push", distribution=Normal(), per="step"),
            Derived(
                name="speed",
                parents=(Parent("speed", 1), Parent("push")),
                mechanism=Linear(weights=(0.9, 1.0)),
            ),
        ]
    )
    live = model.live(seed=4)
    walked(live, 6)
    twin = live.split({"push": 1.0}, at=2)
    for action in live.actions[2:]:
        twin.step(action)
    assert live.episode() == model.rollout(seed=4, steps=6)
    assert twin.episode() == live.episode().counterfactual({"push": 1.0}, at=2)


def some_request(rng: np.random.Generator, now: int) -> dict[str, Hard | Shift | Draw]:
    """Return an intervention at random, with a time from now on."""
    times: list[dict[str, Any]] = [
        {},
        {"at": now + int(rng.integers(4))},
        {"during": (now + int(rng.integers(3)), now + int(rng.integers(3, 7)))},
        {"during": (now, None)},
        {"at": int(rng.integers(5)), "every": int(rng.integers(1, 4))},
        {"when": Reaches("joint_velocities", above=0.2, component=int(rng.integers(9)))},
    ]
    time, value = times[rng.integers(len(times))], float(rng.uniform(0.02, 0.06))
    if rng.integers(8) == 0:
        return {PLACE: Hard([0.0, -value, 0.0325], **time)}
    name = (MASS, "joint_damping")[rng.integers(2)]
    return {name: (Hard(value, **time), Shift(0.001, **time), Draw("A", **time))[rng.integers(3)]}


@pytest.mark.parametrize("seed", range(8))
def test_whatever_is_done_by_hand_is_in_the_plan(seed: int) -> None:
    """Cut windows, events, repetitions and draws happen again, in rollouts, branches and splits."""
    rng, world = np.random.default_rng(seed), World("pushing", backend="fake")
    live = world.live("random", seed=seed)
    for _ in range(12):
        for _ in range(rng.integers(3)):
            with suppress(InterventionError):
                live.do(some_request(rng, live.steps))
        with suppress(InterventionError):
            live.step()
    episode, at = live.episode(), int(rng.integers(live.steps))
    plan = Plan.from_json(episode.plan.to_json())
    assert world.rollout(live.actions, seed=seed, do=plan, steps=episode.steps) == episode
    assert episode.counterfactual({}, at=at) == episode
    other = episode.counterfactual({MASS: Hard(0.07, at=at)}, at=at)
    assert other.counterfactual({}, at=int(rng.integers(at + 1))) == other
    twin = live.split({MASS: 0.07}, at=at)
    for action in live.actions[at:]:
        with suppress(InterventionError):
            twin.step(action)
    assert twin.episode() == other
