"""Gymnasium's wrappers of many environments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from gymnasium.wrappers import vector
from many_envs import actions, check_same, make, sync

LOW, HIGH = np.zeros(56, np.float32), np.ones(56, np.float32)
WRAPPERS: dict[str, Callable[[Any], Any]] = {
    "statistics": vector.RecordEpisodeStatistics,
    "observations": vector.NormalizeObservation,
    "rewards": vector.NormalizeReward,
    "clipped rewards": lambda envs: vector.ClipReward(envs, -1.0, 1.0),
    "clipped actions": vector.ClipAction,
    "flat": vector.FlattenObservation,
    "scaled": lambda envs: vector.RescaleObservation(envs, LOW, HIGH),
    "lists of infos": vector.DictInfoToList,
    "several": lambda envs: vector.NormalizeReward(
        vector.NormalizeObservation(vector.RecordEpisodeStatistics(envs))
    ),
}


def timeless(step: Any) -> Any:
    """Take away what a clock says."""
    infos = step[-1]
    for info in infos if isinstance(infos, list) else [infos]:
        info.get("episode", {}).pop("t", None)
    return step


@pytest.mark.parametrize("name", WRAPPERS)
def test_wrappers_do_what_they_do_to_gymnasiums_own_kind(name: str) -> None:
    """Value by value, over the ends of episodes."""
    options: dict[str, Any] = {"max_episode_length": 3, "backend": "fake"}
    both = [WRAPPERS[name](kind(**options)) for kind in (make, sync)]
    check_same(*(envs.reset(seed=0) for envs in both), "reset")
    for action in actions(8):
        check_same(*(timeless(envs.step(action)) for envs in both), name)
