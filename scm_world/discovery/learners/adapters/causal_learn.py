"""PC, GES, BOSS and GRaSP of causal-learn, for rows in which nothing is done.

Sources:
    Zheng et al., *Causal-learn: causal discovery in Python*, JMLR 2024, for the library. Spirtes,
    Glymour and Scheines, *Causation, Prediction, and Search*, 2000, for PC. Chickering, *Optimal
    structure identification with greedy search*, JMLR 2002, for GES. Andrews et al., *Fast scalable
    and accurate discovery of DAGs using the best order score search and grow-shrink trees*, NeurIPS
    2023, for BOSS. Lam, Andrews and Ramsey, *Greedy relaxations of the sparsest permutation
    algorithm*, UAI 2022, for GRaSP.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scm_world.discovery.data.dataset import Dataset
from scm_world.discovery.learners.adapters.settings import Settings, count, level, switch, weight
from scm_world.discovery.learners.adapters.static import found_by
from scm_world.discovery.learners.found import Found

PC: Settings = {"alpha": level(0.01), "stable": switch(True), "depth": count(None)}
GES: Settings = {"penalty": weight(0.5), "max_parents": count(None, least=1)}
BOSS: Settings = {"penalty": weight(2.0)}
GRASP: Settings = {"penalty": weight(2.0), "depth": count(3, least=1)}

SCORE = "local_score_BIC_from_cov"
ARROW = 1

Bools = NDArray[np.bool_]


def pc(data: Dataset, *, seed: int = 0, **settings: Any) -> Found:
    """Find a graph by tests of partial correlation.

    Args:
        data: Rows; those in which something is done are left out.
        seed: Of nothing: it draws nothing.
        settings: ``alpha``, level of the tests; ``stable``, whether the result does not depend on
            the order of the columns while edges are removed; ``depth``, most columns that a test
            conditions on.
    """
    return found_by(_pc, "pc", PC, data, seed=seed, settings=settings)


def _pc(data: Dataset, used: Mapping[str, Any]) -> tuple[Bools, str]:
    library = import_module("causallearn.search.ConstraintBased.PC")
    result = library.pc(
        data.values,
        used["alpha"],
        "fisherz",
        used["stable"],
        background_knowledge=_earlier(data),
        show_progress=False,
        max_k=used["depth"],
    )
    marks = np.array(result.G.graph)
    contrary = int(np.sum((marks == ARROW) & (marks.T == ARROW))) // 2
    note = f"{contrary} edges have no direction, since tests contradict each other"
    return edges_of(marks), note if contrary else ""


def ges(data: Dataset, *, seed: int = 0, **settings: Any) -> Found:
    """Find a graph by greedy search over equivalence classes.

    Args:
        data: Rows; those in which something is done are left out.
        seed: Of nothing: it draws nothing.
        settings: ``penalty``, times log(n) for each edge: 0.5 is the Bayesian information
            criterion; ``max_parents``, most causes of a column.
    """
    return found_by(_ges, "ges", GES, data, seed=seed, settings=settings)


def _ges(data: Dataset, used: Mapping[str, Any]) -> tuple[Bools, str]:
    library = import_module("causallearn.search.ScoreBased.GES")
    result = library.ges(data.values, SCORE, used["max_parents"], {"lambda_value": used["penalty"]})
    return edges_of(result["G"].graph), ""


def boss(data: Dataset, *, seed: int = 0, **settings: Any) -> Found:
    """Find a graph by search over orders, moving one column at a time.

    Args:
        data: Rows; those in which something is done are left out.
        seed: Of the order in which columns are moved.
        settings: ``penalty``, times log(n) for each edge.
    """
    return found_by(_boss, "boss", BOSS, data, seed=seed, settings=settings)


def _boss(data: Dataset, used: Mapping[str, Any]) -> tuple[Bools, str]:
    library = import_module("causallearn.search.PermutationBased.BOSS")
    graph = library.boss(data.values, SCORE, {"lambda_value": used["penalty"]}, verbose=False)
    return edges_of(graph.graph), ""


def grasp(data: Dataset, *, seed: int = 0, **settings: Any) -> Found:
    """Find a graph by search over orders, by tucks.

    Args:
        data: Rows; those in which something is done are left out.
        seed: Of the first order.
        settings: ``penalty``, times log(n) for each edge; ``depth``, of the search.
    """
    return found_by(_grasp, "grasp", GRASP, data, seed=seed, settings=settings)


def _grasp(data: Dataset, used: Mapping[str, Any]) -> tuple[Bools, str]:
    library = import_module("causallearn.search.PermutationBased.GRaSP")
    parameters = {"lambda_value": used["penalty"]}
    graph = library.grasp(data.values, SCORE, used["depth"], parameters, verbose=False)
    return edges_of(graph.graph), ""


def edges_of(marks: Any) -> Bools:
    """Read the end marks of causal-learn.

    Args:
        marks: Shape (p, p): at [i, j] the mark at i of the edge between i and j; 1 is an arrow
            head, -1 a tail, 2 a circle, 0 no edge.

    Returns:
        Shape (p, p): where i may act on j. Two heads, which PC puts where its tests contradict each
        other, and two circles are an edge without direction.

    Example:
        >>> edges_of([[0, -1], [1, 0]]).tolist()
        [[False, True], [False, False]]
    """
    at = np.array(marks)
    edges: Bools = (at != 0) & ((at != ARROW) | (at.T == ARROW))
    return edges


def _earlier(data: Dataset) -> Any:
    """Tell PC that later columns do not act on earlier ones; None if all are of one instant."""
    lags = [column.lag for column in data.columns]
    if len(set(lags)) < 2:
        return None
    knowledge = import_module("causallearn.utils.PCUtils.BackgroundKnowledge").BackgroundKnowledge()
    node = import_module("causallearn.graph.GraphNode").GraphNode
    for i, lag in enumerate(lags):
        knowledge.add_node_to_tier(node(f"X{i + 1}"), max(lags) - lag)  # the names PC gives
    return knowledge
