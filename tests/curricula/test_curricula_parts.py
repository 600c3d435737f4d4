"""What parts of curricula do, when, and which of them."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from curriculum_envs import STILL, along, follow_mass, series, under, value

from scm_world import Shift
from scm_world.curricula import (
    A,
    B,
    at_step,
    during,
    follow,
    goals,
    joints,
    looks,
    physics,
    poses,
    resample,
    stages,
    timed,
    together,
)
from scm_world.curricula.curriculum import as_curriculum
from scm_world.curricula.targets import grouped, regions
from scm_world.errors import (
    InterventionError,
    ModelError,
    OutOfBounds,
    ScmWorldError,
    UnknownOption,
    UnknownVariable,
    WrongValue,
)
from scm_world.tasks import TASKS
from scm_world.variables import Box, Categories, Cylinder, Integers, Normal
from scm_world.world import Simulation

MASS, FRICTION = "tool_block.mass", "floor_friction"
SOLVED = {
    "goal_block.cartesian_position": [0.0, 0.0, 0.0325],
    "tool_block.cartesian_position": [0.0, 0.0, 0.0325],
}


def test_do_does_the_same_in_every_episode() -> None:
    """Values, nested names, draws and shifts are done at every reset."""
    env = under({"tool_block": {"mass": 0.05}, FRICTION: "B", "gravity": Shift([0.0, 0.0, 1.0])})
    frictions = []
    for _ in range(3):
        env.reset()
        assert value(env, MASS) == 0.05
        assert value(env, "gravity")[2] == pytest.approx(-8.81)
        frictions.append(value(env, FRICTION))
    assert len(set(frictions)) == 3
    assert all(0.6 < friction <= 0.8 for friction in frictions)


def test_resample_draws_from_the_space_that_is_named() -> None:
    """Draws lie in A, in B, in a set of one's own or in the region of a part of the space."""
    regions = [("A", 0.015, 0.045), ("B", 0.045, 0.1), (Box(0.2, 0.3), 0.2, 0.3)]
    regions += [(A["*"] * B["*.mass"], 0.045, 0.1), (Cylinder(Box((0.05,), (0.06,))), 0.05, 0.06)]
    for space, low, high in regions[:4]:
        drawn = series(under(resample(MASS, space)), MASS, 20)
        assert len(set(drawn)) == 20
        assert low <= min(drawn) < max(drawn) <= high
    drawn = series(under(resample(MASS, Normal(0.05, 0.001))), MASS, 20)
    assert np.mean(drawn) == pytest.approx(0.05, abs=0.001)


def test_resample_knows_patterns_groups_and_exceptions() -> None:
    """Patterns and groups name variables; ``besides`` takes some out."""
    world = Simulation("pushing", backend="fake")
    found = regions(world.compiled, ["*.mass", FRICTION], besides=["robot_*"])
    assert found == {MASS: "A", FRICTION: "A"}
    assert drawn_by(resample(["*.mass", FRICTION], besides="robot_*")) == {MASS, FRICTION}
    assert MASS in drawn_by(physics())
    assert drawn_by(joints()) == {"joint_positions"}
    assert drawn_by(poses()) == {
        "tool_block.cylindrical_position",
        "tool_block.euler_orientation",
    }
    assert "tool_block.color" in drawn_by(looks())


def drawn_by(part: Any) -> set[str]:
    """Return the variables that a part sets at a reset."""
    env = under(part)
    env.reset(seed=0)
    return {name for _, acts in env.unwrapped.interventions for name in acts}


@pytest.mark.parametrize("task", TASKS)
def test_groups_fit_every_task(task: str) -> None:
    """No group is refused anywhere; what is a look is no physics, and everything has all."""
    world = Simulation(task, backend="fake")
    found = {group: set(names) for group, names in grouped(world.compiled).items()}
    assert not found["looks"] & found["physics"]
    assert not (found["looks"] | found["poses"]) - found["everything"]
    for group in found:
        resample(f"@{group}").check(world)
    goals("A|B").check(world)


def test_goal_draws_what_the_task_draws() -> None:
    """A new goal leaves everything else as it is; causes that are left out stay."""
    env = under(goals("A"))
    env.reset(seed=0)
    names = env.unwrapped.world.model
    first = {name: value(env, name) for name in names}
    env.reset()
    moved = {name for name in names if value(env, name) != first[name]}
    assert moved
    assert all("goal" in n or n in ("reward", "fractional_success") for n in moved), moved
    kept = under(goals("A", besides="goal_block.euler_orientation"))
    turns = series(kept, "goal_block.euler_orientation", 3)
    assert turns[0] == turns[1] == turns[2]


def test_follow_asks_a_function() -> None:
    """What the function gives is done; None is nothing."""
    env = under(follow(follow_mass))
    default = value_of_default(MASS)
    np.testing.assert_allclose(series(env, MASS, 4), [0.02, 0.03, default, 0.05])
    noisy = under(follow(lambda s: {MASS: s.generator("mass").uniform(0.02, 0.03)}))
    drawn = series(noisy, MASS, 5)
    assert drawn == series(noisy, MASS, 5)
    assert len(set(drawn)) == 5
    wrong: Any = under(follow(lambda _: 5))
    with pytest.raises(UnknownOption, match="intervention of a function"):
        wrong.reset(seed=0)


def value_of_default(name: str) -> Any:
    """Give what a variable is without intervention."""
    world = Simulation("pushing", backend="fake")
    world.reset(seed=0)
    return world[name].tolist()


def test_parts_act_at_their_steps_in_every_episode() -> None:
    """A part within an episode acts in each of them (D10), and then only."""
    env = under(together({MASS: 0.02}, at_step(2, {MASS: 0.05}), at_step(4, {MASS: 0.06})))
    for _ in range(3):
        env.reset()
        assert value(env, MASS) == 0.02
        assert along(env, MASS, 5) == [0.02, 0.05, 0.05, 0.06, 0.06]


def test_every_acts_again_and_again() -> None:
    """Beginning at its first step; at the reset, too, if that is 0."""
    env = under(timed({"every": 2}, resample(FRICTION)))
    env.reset(seed=0)
    found = [value(env, FRICTION), *along(env, FRICTION, 5)]
    assert [a == b for a, b in pairwise(found)] == [True, False, True, False, True]
    late = under(timed({"every": 2, "at": 1}, resample(FRICTION)))
    late.reset(seed=0)
    assert value(late, FRICTION) == value_of_default(FRICTION)
    found = along(late, FRICTION, 4)
    assert [a == b for a, b in pairwise(found)] == [True, False, True]


def test_during_acts_in_a_range_of_episodes() -> None:
    """First, stop and period are those of the range; a part at a step may be within."""
    env = under(during(range(1, 6, 2), {MASS: 0.05}))
    assert [mass == 0.05 for mass in series(env, MASS, 8)] == [False, True] * 3 + [False] * 2
    inner = under(during(range(1, 2), at_step(1, {MASS: 0.05})))
    for episode in range(3):
        inner.reset(seed=0)
        assert (along(inner, MASS, 1) == [0.05]) is (episode == 1)


def test_the_inner_time_counts() -> None:
    """A part with a time of its own keeps it."""
    env = under(at_step(3, at_step(0, {MASS: 0.05})))
    env.reset(seed=0)
    assert value(env, MASS) == 0.05


def test_together_the_later_part_counts() -> None:
    """Of two names of one quantity the later one is done, in whatever coordinates."""
    polar, cartesian = "tool_block.cylindrical_position", "tool_block.cartesian_position"
    env = under(together(poses("A"), {cartesian: [0.05, 0.0, 0.0325]}))
    env.reset(seed=0)
    np.testing.assert_allclose(value(env, cartesian), [0.05, 0.0, 0.0325])
    env = under(together({cartesian: [0.05, 0.0, 0.0325]}, {polar: [0.1, 0.0, 0.0325]}))
    env.reset(seed=0)
    np.testing.assert_allclose(value(env, cartesian), [0.1, 0.0, 0.0325])


def test_stages_go_up_and_down_with_success() -> None:
    """A window of successes leads up, one of failures down; then a new window begins."""
    part = stages({MASS: 0.02}, {MASS: 0.03}, {MASS: 0.04}, up=0.5, down=0.25, window=2)
    env = under(part, max_episode_length=1)
    found = []
    for success in (1, 1, 0, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0):
        env.reset(options={"do": SOLVED} if success else None)
        found.append(value(env, MASS))
        assert env.step(STILL)[4]["is_success"] is bool(success)
    expected = [2, 2, 3, 3, 4, 4, 4, 4, 4, 3, 3, 2, 2]
    np.testing.assert_allclose(found, [mass / 100 for mass in expected])


def test_stages_count_the_episodes_in_which_they_act() -> None:
    """Successes of other episodes are not theirs; a part that is there twice counts once."""
    part = stages({MASS: 0.02}, {MASS: 0.03}, up=1.0, window=2)
    env = under(together(during(range(2, 9), part), during(range(2, 9), part)))
    for _ in range(3):
        env.reset(options={"do": SOLVED})
        assert env.step(STILL)[4]["is_success"]
    env.reset()
    (progress,) = env.state.stages.values()
    assert progress == (0, (True,))


def test_stages_of_a_function_count_when_they_act() -> None:
    """Of two ladders of which one is drawn, the other one stays where it is."""
    ladders = [stages({MASS: 0.02 + i}, {MASS: 0.03 + i}, up=1.0, window=50) for i in (0.0, 0.01)]
    env = under(lambda situation: ladders[situation.uniform("ladder") < 0.5].plan(situation))
    drawn = []
    for _ in range(20):
        env.reset()
        drawn.append(value(env, MASS))
        env.step(STILL)
    env.reset()
    counts = [len(env.state.stages[ladder.key].recent) for ladder in ladders]
    assert counts == [drawn.count(0.02), drawn.count(0.03)]
    assert min(counts) > 0


WRONG: list[Any] = [
    lambda: at_step(-1, {}),
    lambda: at_step(1.5, {}),  # type: ignore[arg-type]
    lambda: timed({"every": 0}, {}),
    lambda: during(range(5, 0, -1), {}),
    lambda: during((1, 2), {}),  # type: ignore[arg-type]
    together,
    lambda: together(5),
    lambda: timed({"often": 3}, {}),
    lambda: stages({}, up=0.0),
    lambda: stages({}, up=0.5, down=0.5),
    lambda: stages({}, window=0),
    lambda: resample("*.mass", "C"),
    lambda: resample(5),
    lambda: goals("D"),  # type: ignore[arg-type]
    lambda: follow(5),
    lambda: follow({"kind": "linear", "weights": [1.0]}),
    lambda: as_curriculum({MASS: "C"}),
    lambda: as_curriculum({"kind": "do", "request": 5}),
]


@pytest.mark.parametrize("make", WRONG)
def test_nonsense_is_refused_with_what_is_allowed(make: Any) -> None:
    """Every wrong number, name or part is refused when it is written."""
    with pytest.raises((UnknownOption, ModelError)):
        make()


IMPOSSIBLE: list[tuple[Any, type[ScmWorldError]]] = [
    ({"tool_blok.mass": 0.05}, UnknownVariable),
    ({MASS: -1.0}, OutOfBounds),
    ({MASS: [0.1, 0.2]}, WrongValue),
    (resample("*.mas"), UnknownVariable),
    (resample("@weights"), UnknownVariable),
    (resample("*.mass", besides="*.mas"), UnknownVariable),
    (resample(MASS, Box(-0.1, 0.1)), OutOfBounds),
    (resample(MASS, Box((0.1, 0.2), (0.2, 0.3))), InterventionError),
    (resample("*.cartesian_position", "A"), InterventionError),
    (resample("solver_preset", Normal(0.0, 1.0)), InterventionError),
    (goals("A", besides=["gravity"]), UnknownVariable),
    (during(range(9, 10), at_step(3, resample("nothing"))), UnknownVariable),
]


@pytest.mark.parametrize(("part", "error"), IMPOSSIBLE)
def test_what_cannot_be_is_refused_before_the_first_episode(
    part: Any, error: type[ScmWorldError]
) -> None:
    """Unknown names and impossible regions are found when an environment is wrapped."""
    with pytest.raises(error):
        under(part)


def test_whole_numbers_are_drawn_from_whole_numbers() -> None:
    """A box of fractions is no region of a number of blocks; a set of integers is."""
    name = "number_of_blocks_in_tower"
    with pytest.raises(InterventionError, match="whole number"):
        under(resample(name, Box(1.0, 3.0)), "scm_world/Towers-v0").reset(seed=0)
    for space in (Integers(1, 2), Categories((1, 2))):
        env = under(resample(name, space), "scm_world/Towers-v0")
        assert {n for ns in series(env, name, 6) for n in ns} == {1, 2}


@pytest.mark.parametrize(
    ("part", "words"),
    [
        (lambda: resample([]), "at least 1 item"),
        (lambda: during(range(5, 5), goals()), "episodes cannot be"),
        (
            lambda: as_curriculum({"kind": "during", "episodes": [5, 5], "part": {}}),
            "episodes cannot be",
        ),
    ],
)
def test_what_would_never_do_anything_is_refused(part: Any, words: str) -> None:
    """No name at all, and a window without an episode."""
    with pytest.raises((UnknownOption, ModelError), match=words):
        part()


@pytest.mark.parametrize(
    ("pattern", "words"),
    [("*.weight", r"there are: .*\*\.mass"), ("*.mas", r"did you mean '\*\.mass'")],
)
def test_a_pattern_that_fits_nothing_suggests_patterns(pattern: str, words: str) -> None:
    """And no variable that happens to have a similar name."""
    with pytest.raises(UnknownVariable, match=words) as refused:
        under(resample(pattern))
    assert "robot_height" not in str(refused.value)
