"""Questions on Warp's CPU device, which is exact: twins, and rows that depend on no batch."""

from __future__ import annotations

import pytest

pytest.importorskip("mujoco_warp")

from scm_world import World
from scm_world.discovery.data import Design, collect

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
