"""Questions on Warp's CPU device, which is exact: twins, and rows that depend on no batch."""

from __future__ import annotations

import pytest

pytest.importorskip("mujoco_warp")

from scm_world import Draw, World, check
from scm_world.discovery.data import Design, collect
from scm_world.errors import InexactEngine
from scm_world.evaluation import evaluate
from scm_world.evaluation.explanation import why
from scm_world.queries.differences import but_for, consequences

MASS = {"tool_block.mass": 0.06}


def test_an_effect_has_no_floor_and_a_unit_has_a_twin() -> None:
    """Equal runs are equal there."""
    with World("pushing", backend="warp:cpu") as world:
        effect = world.effect("tool_block.mass", do=MASS, n=4, steps=1)
        assert not effect.floor.any()
        assert "equal runs" not in str(effect)
        episode = world.rollout("random", seed=1, steps=2)
        assert episode.counterfactual({}) == episode
        assert float(episode.counterfactual(MASS)["tool_block.mass"][-1]) == 0.06


def test_rows_do_not_depend_on_the_batch() -> None:
    """Ten episodes in one batch, in two, and one after another."""
    design = Design("single", ("tool_block.mass", "floor_friction"), "A", 0.3)
    with World("pushing", backend="warp:cpu") as world:
        found = [
            collect(world, design, 10, steps=3, seed=2, shard=size).values.tobytes()
            for size in (10, 5, 1)
        ]
    assert found[0] == found[1] == found[2]


def test_what_follows_from_what_is_refused() -> None:
    """Bodies that do not touch change one another: an exact engine is named."""
    refused = "leave one another alone.*mujoco"
    with World("pushing", backend="warp:cpu") as world:
        with pytest.raises(InexactEngine, match=refused):
            consequences(world, MASS, steps=2)
        episode = world.rollout("random", seed=1, steps=4, do=MASS)
        with pytest.raises(InexactEngine, match=refused):
            but_for(episode, "tool_block.cartesian_position")
        with pytest.raises(InexactEngine, match=refused):
            world.explain(episode, ["tool_block.mass"])


def test_an_evaluated_episode_is_not_explained() -> None:
    """Its explanation compares episodes in which one draw differs."""
    found = evaluate(
        "random", "P1", task="pushing", n=1, backend="warp:cpu", env={"max_episode_length": 2}
    )
    with pytest.raises(InexactEngine, match=r"leave one another alone.*mujoco"):
        why(found, "P1", 0)


def test_what_bodies_that_do_not_touch_change_is_no_response() -> None:
    """Only the first control step counts there, and numbers beyond rounding."""
    with World("pushing", backend="warp:cpu", num_worlds=3) as worlds:
        found = check(worlds, {"tool_block.mass": (0.02, 0.04), "gravity": Draw("A")}, steps=2)
    assert not found.faults, str(found)
    assert found.floor == 0.0
    assert found.ranges[1].answers["responds"].status == "passed"


def test_a_smaller_response_than_rounding_is_not_seen() -> None:
    """It is not asked, and the answer says why; MuJoCo sees it."""
    ranges = {"gravity": ((0.0, 0.0, -9.81), (0.0, 0.0, -9.8099))}
    found = {}
    for backend in ("warp:cpu", "mujoco"):
        with World("pushing", backend=backend, num_worlds=2) as worlds:
            found[backend] = check(worlds, ranges, steps=2).ranges[0].answers["responds"]
    assert found["mujoco"].status == "passed"
    assert found["warp:cpu"].status == "not asked"
    assert "bodies that do not touch" in found["warp:cpu"].said
