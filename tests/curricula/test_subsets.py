"""Parts of the parameter space: values that every intervention is held against."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest
from curriculum_envs import PUSHING, STILL, under, value
from gymnasium.envs.registration import EnvSpec
from hypothesis import given
from hypothesis import strategies as st

from scm_world import Draw
from scm_world.curricula import AB, A, B, Subset, at_step, everything, resample
from scm_world.errors import (
    InterventionError,
    OutOfBounds,
    UnknownOption,
    UnknownVariable,
)
from scm_world.variables import Box, Integers
from scm_world.variables.subsets import as_region

MASS, FRICTION = "tool_block.mass", "floor_friction"
NAMES = st.sampled_from(
    ["*", "*.mass", "tool_block.*", "goal_block.*", "floor_friction", "gravity"]
)
REGIONS = st.sampled_from(["A", "B", "A|B", Box(0.1, 0.2), Integers(1, 3), None])
SUBSETS = st.lists(st.tuples(NAMES, REGIONS), max_size=4).map(Subset)


@given(SUBSETS, SUBSETS, st.sampled_from(["tool_block.mass", "gravity", "goal_block.polar"]))
def test_in_a_product_the_second_part_counts(one: Subset, other: Subset, name: str) -> None:
    """Where both name a variable; and leaving out is the last word."""
    named = any(
        Subset([part]).region(name) == part[1] and _fits(part[0], name) for part in other.parts
    )
    assert (one * other).region(name) == (other if named else one).region(name)
    assert (one - name).region(name) is None


def _fits(pattern: str, name: str) -> bool:
    return Subset({pattern: "A"}).region(name) is not None


@given(SUBSETS)
def test_a_part_of_the_space_is_a_value(subset: Subset) -> None:
    """It survives JSON, pickle and copies, and can be told apart."""
    assert Subset.model_validate_json(subset.model_dump_json()) == subset
    assert pickle.loads(pickle.dumps(subset)) == copy.deepcopy(subset) == subset  # noqa: S301 # our own
    assert as_region("space", subset.model_dump(mode="json")) == subset
    assert str(subset).count("[") >= len(subset.parts)


def test_half_spaces_and_swaps_are_one_expression() -> None:
    """Products of regions of patterns, and single variables that lie elsewhere."""
    half = A["tool_block.*"] * B["goal_block.*"]
    assert [half.region(n) for n in (MASS, "goal_block.color", "gravity")] == ["A", "B", None]
    swapped = A.swap("*.mass", B).swap(FRICTION, Box(0.5, 0.6)).swap(("gravity", "x"), "A|B")
    assert [swapped.region(n) for n in (MASS, "gravity", "y")] == ["B", "A|B", "A"]
    assert swapped.region(FRICTION) == Box(0.5, 0.6)
    assert str(A["a", "b"] * B["c"] - "d") == "A[a] × A[b] × B[c] × ∅[d]"
    assert AB.region("anything") == "A|B"
    assert Subset([("*", "A"), ("*", "B")]) == A * B


WRONG: list[Any] = [
    lambda: Subset("C"),
    lambda: Subset({"*.mass": "C"}),
    lambda: (A["x"] * B["y"])["z"],
    lambda: as_region("space", "C"),
    lambda: as_region("space", 5),
    lambda: as_region("space", {"*.mass": 5}),
    lambda: as_region("space", [1, 2]),
    lambda: gymnasium.make(PUSHING, backend="fake", variables_space={"*.mass": "C"}),
]


@pytest.mark.parametrize("make", WRONG)
def test_what_is_no_part_of_the_space_is_refused(make: Any) -> None:
    """With what is allowed instead."""
    with pytest.raises(UnknownOption):
        make()


@pytest.mark.parametrize("spelled", [A["*.mass"] * B[FRICTION], {"*.mass": "A", FRICTION: "B"}])
def test_every_intervention_on_an_environment_is_held_against_it(spelled: Any) -> None:
    """At resets and within episodes; a refusal changes nothing and names the space."""
    env: Any = gymnasium.make(PUSHING, backend="fake", variables_space=spelled)
    env.reset(seed=0, options={"do": {MASS: 0.03, FRICTION: 0.7}})
    env.step(STILL)
    for request in (
        {MASS: 0.09},
        {FRICTION: 0.4},
        {"gravity": [0.0, 0.0, -9.0]},
        {MASS: Draw("B")},
    ):
        with pytest.raises(OutOfBounds):
            env.unwrapped.do(request)
    assert (value(env, MASS), value(env, FRICTION)) == (0.03, 0.7)
    env.unwrapped.do({FRICTION: 0.65})
    env.unwrapped.do({"gravity": [0.0, 0.0, -9.0]}, space=AB)  # asked for by name


def test_a_curriculum_in_a_world_with_a_space_stays_inside() -> None:
    """The training space of an environment holds for curricula; that of a reset counts more."""
    env = under(resample(MASS, "B"), variables_space={"*.mass": "A"})
    with pytest.raises(OutOfBounds):
        env.reset(seed=0)
    env.reset(seed=0, options={"space": B["*.mass"]})
    assert value(env, MASS) > 0.045


def test_draws_follow_the_regions_of_a_part_of_the_space() -> None:
    """Each variable from its own region; what has none is left as it is."""
    training = A["tool_block.*"] * B["*.mass"] * Subset({FRICTION: Box(0.5, 0.51)})
    part = everything(training, besides="joint_positions")
    env = under(part, variables_space=training)
    for seed in range(5):
        env.reset(seed=seed)
        assert "gravity" not in env.unwrapped.interventions[0][1]
        assert 0.045 <= value(env, MASS) <= 0.1
        assert 0.5 <= value(env, FRICTION) <= 0.51
    assert value(env, "gravity") == pytest.approx([0.0, 0.0, -9.81])


IMPOSSIBLE: list[tuple[Subset, type[InterventionError]]] = [
    (A["*.mas"], UnknownVariable),
    (A["tool_blok.mass"] * B[FRICTION], UnknownVariable),
    (Subset({MASS: Box(-1.0, 0.1)}), OutOfBounds),
    (Subset({"*_block.mass": Box(0.0, 1e9)}), InterventionError),
    (Subset({MASS: Box((0.1, 0.1), (0.2, 0.2))}), InterventionError),
    (A["tool_block.cartesian_position"], InterventionError),
]


@pytest.mark.parametrize(("space", "error"), IMPOSSIBLE)
def test_regions_that_cannot_be_are_refused_before_the_first_episode(
    space: Subset, error: type[InterventionError]
) -> None:
    """Unknown names and sets beyond the bounds, when an environment is made."""
    with pytest.raises(error):
        under(at_step(1, {MASS: 0.03}), variables_space=space)


def test_an_environment_with_a_space_can_be_written_down() -> None:
    """Names, or the plain data of a part of the space, go to JSON and back."""
    training = A["tool_block.*"] * Subset({FRICTION: Box(0.5, 0.6)})
    for plain in ({"*.mass": "A", FRICTION: "B"}, training.model_dump(mode="json"), "A|B"):
        env = gymnasium.make(PUSHING, backend="fake", variables_space=plain)
        assert env.spec is not None
        again: Any = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
        inner: Any = env.unwrapped
        assert again.unwrapped.world.variables_space == inner.world.variables_space
        np.testing.assert_array_equal(env.reset(seed=1)[0], again.reset(seed=1)[0])
