"""GIES of the package gies, for rows under several interventions with known targets.

Sources:
    Hauser and Bühlmann, *Characterization and greedy learning of interventional Markov equivalence
    classes of directed acyclic graphs*, JMLR 2012. Gamella, Taeb, Heinze-Deml and Bühlmann,
    *Characterization and greedy learning of Gaussian structural causal models under unknown
    interventions*, 2022, for the package.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.discovery.data.dataset import Dataset
from scm_world.discovery.learners.adapters.settings import Settings, some_of, switch, weight
from scm_world.discovery.learners.adapters.static import found_by
from scm_world.discovery.learners.found import Found
from scm_world.errors import ModelError

GIES: Settings = {
    "penalty": weight(0.5),
    "phases": some_of("forward", "backward", "turning"),
    "iterate": switch(True),
}

RIDGE = 1e-9
"""Added to the variances of standardised columns. Some vary only where they are set, and on a
variance of zero the search goes on for ever."""


def gies(data: Dataset, *, seed: int = 0, **settings: Any) -> Found:
    """Find a graph by greedy search over interventional equivalence classes.

    Args:
        data: Rows under any regime.
        seed: Of nothing: it draws nothing.
        settings: ``penalty``, times log(n) for each edge: 0.5 is the Bayesian information
            criterion; ``phases`` of the search, in their order; ``iterate``, whether they are
            gone through until nothing improves.

    Raises:
        ModelError: A column is set in every row.
    """
    return found_by(_gies, "gies", GIES, data, seed=seed, settings=settings, done=True)


def _gies(data: Dataset, used: Mapping[str, Any]) -> tuple[NDArray[np.bool_], str]:
    library = import_module("gies")
    scores = import_module("gies.scores.gauss_int_l0_pen")
    penalty = used["penalty"] * float(np.log(len(data)))
    measure = scores.GaussIntL0Pen(*environments(data), lmbda=penalty)
    measure.part_sample_cov += RIDGE * np.eye(len(data.names))
    graph, _ = library.fit(measure, phases=list(used["phases"]), iterate=used["iterate"])
    return np.array(graph) != 0, ""


def environments(data: Dataset) -> tuple[list[Floats], list[list[int]]]:
    """Sort rows by the columns that were set in them.

    Returns:
        For each set of columns the rows, shape (n, p), and the numbers of the columns.

    Raises:
        ModelError: A column is set in every row.
    """
    always = [
        f"{data.names[i]!r} is set in every row; 'gies' needs rows in which it is left alone"
        for i in np.flatnonzero(data.targeted.all(axis=0))
    ]
    if always:
        raise ModelError(always)
    kinds, number = np.unique(data.targeted, axis=0, return_inverse=True)
    parts = [data.values[number.reshape(-1) == kind] for kind in range(len(kinds))]
    return parts, [np.flatnonzero(kind).tolist() for kind in kinds]
