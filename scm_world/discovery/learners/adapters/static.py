"""What all learners of static graphs have in common."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scm_world.discovery.data.dataset import Dataset
from scm_world.discovery.learners.adapters.borrowed import borrowed
from scm_world.discovery.learners.adapters.gain import likelihood_gain
from scm_world.discovery.learners.adapters.settings import Settings, chosen
from scm_world.discovery.learners.adapters.table import prepare
from scm_world.discovery.learners.found import Found

Search = Callable[[Dataset, Mapping[str, Any]], tuple[NDArray[np.bool_], str]]
"""From usable data and settings to edges of shape (k, k) and a note, empty if there is none."""


def found_by(
    search: Search,
    learner: str,
    declared: Settings,
    data: Dataset,
    *,
    seed: int,
    settings: Mapping[str, Any],
    done: bool = False,
) -> Found:
    """Let a library find a graph.

    Args:
        search: What calls the library.
        learner: Its name, for messages.
        declared: Its settings.
        data: Rows under any regime.
        seed: Of what the library draws.
        settings: What was given of the settings.
        done: Whether it can use rows in which something is done.

    Raises:
        UnknownOption: There is no such setting, or its value is not allowed.
        ModelError: The data cannot be used.
    """
    used = chosen(learner, declared, settings)
    table = prepare(learner, data, done=done)
    edges, note = np.zeros((len(table.kept), len(table.kept)), bool), ""
    if len(edges) > 1:  # some libraries fail where there is nothing to find
        with borrowed(learner, seed):
            edges, note = search(table.data, used)
    return table.found(edges, likelihood_gain(table.data, edges), note, **used)
