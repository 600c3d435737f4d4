"""The states in which experiments are made."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scm_world.queries.experiments.probes import probes
from scm_world.tasks import TASKS, make_task
from scm_world.world import Simulation

SMALL: dict[str, dict[str, Any]] = {
    "towers": {"number_of_blocks_in_tower": (1, 1, 2), "tower_dims": (0.035, 0.035, 0.07)},
    "stacked_blocks": {"num_of_levels": 2, "max_level_width": 0.04},
    "creative_stacked_blocks": {"num_of_levels": 2, "max_level_width": 0.04},
    "general": {"nums_objects": 2},
}
"""Two blocks, where there are more by default."""

NO_ROOM = {"pick_and_place": {"touch", "block_in_air"}}
"""What the obstacle in the middle leaves no room for."""


@pytest.mark.parametrize("task", TASKS)
def test_every_scenario_is_feasible(task: str) -> None:
    """Of each kind of probe that there is room for, one can be prepared in two rounds."""
    world = Simulation(make_task(task, **SMALL.get(task, {})), backend="fake")
    world.reset(seed=0)
    kinds = [prepare.__name__ for prepare, *_ in world.task.scenarios(world)]
    seen = {probe.kind for probe in probes(world, 2 * len(kinds), 0)}
    assert seen - {"start"} == {*kinds} - NO_ROOM.get(task, set())


def test_probe_states_do_not_depend_on_how_many() -> None:
    """Probe i of a seed is the same in a longer run."""
    world = Simulation("pushing", backend="fake")
    short = [p.action for p in probes(world, 3, 0)]
    long = [p.action for p in probes(world, 6, 0)][:3]
    assert all(np.array_equal(a, b) for a, b in zip(short, long, strict=True))
