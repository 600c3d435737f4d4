"""Scores of estimated graphs: counts, intervention distances, rankings and predictions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, final

import networkx as nx
import numpy as np

from scm_world._arguments import load, typed
from scm_world._types import ArrayLike, Floats
from scm_world.discovery.data.dataset import Dataset
from scm_world.discovery.data.truth import GroundTruth
from scm_world.discovery.learners.found import EstimatedGraph, edge_keys, matrices
from scm_world.errors import MissingExtra, ModelError
from scm_world.graph import SCM
from scm_world.graph.ancestral import HEAD, TAIL
from scm_world.graph.equivalence import (
    Bools,
    essential_graph,
    extension,
    is_acyclic,
    meek,
    meets,
    reaches,
)
from scm_world.queries.experiments.effects import EdgeKey
from scm_world.world import CausalSystem

RATES = ("precision", "recall", "f1")
MARKS = (
    *(f"{what}_{rate}" for what in ("adjacency", "head", "tail") for rate in RATES),
    "pag_distance",
)
"""The scores of edge marks."""


KINDS = ("sid", "parent_aid", "ancestor_aid", "oset_aid")
"""Names of intervention distances, as ``gadjid`` has them."""

ROWS = "from row to column"  # how gadjid reads a matrix


@final
@dataclass(frozen=True, kw_only=True)
class Scores:
    """The distance of an estimated graph from the true one; None for what does not apply.

    Edge marks (heads, tails) are compared with the ancestral graphs of the truth: with the maximal
    one (is the mark true?), and with the partial one (could it be found?). Marks at the later end
    of edges through time are heads by the order of time, and do not count.

    Attributes:
        shd: Structural Hamming distance, over all lags. An edge without direction counts 1 where
            it is wrong and 1 where it is right.
        shd_by_lag: The same for each lag, from 0 on.
        shd_classes: Between the two essential graphs. Only without lags.
        precision: Estimated edges with a direction that are true, as a fraction; 1 without
            such edges. The share of false discoveries is one minus this.
        recall: True edges that were estimated with their direction, as a fraction; 1 without
            true edges.
        f1: Harmonic mean of the two.
        auroc: Probability that a true edge has a larger edge score than a false one.
        auprc: Average precision in the order of edge_scores.
        sid: Structural intervention distance, where every edge has a direction. Only without lags.
        parent_aid: Effects that come out wrong if one adjusts for the estimated parents; by
            ``gadjid``. Only without lags.
        ancestor_aid: For the estimated ancestors.
        oset_aid: For the set that would be best in the estimated graph.
        edges: How many edges were estimated, those without direction counted once.
        declared: How many edges are true.
        pairs: How many ordered pairs count, over all lags.
        adjacency_precision: Pairs joined in the estimate that no set of variables separates, as a
            fraction; 1 if it joins none.
        adjacency_recall: Such pairs that the estimate joins; None without such pairs.
        adjacency_f1: Harmonic mean of the two; None if one of them is.
        head_precision: Estimated heads that are heads, as a fraction; 1 without heads.
        head_recall: Heads of the partial ancestral graph that were estimated; None if it has none.
        head_f1: Harmonic mean of the two; None if one of them is.
        tail_precision: As of heads.
        tail_recall: As of heads.
        tail_f1: As of heads.
        pag_distance: Pairs whose edge differs from the one in the partial ancestral graph: it is
            missing, false, or has another mark.
        undeclared: Estimated edges that are not true; those without direction in both directions.
        missed: True edges that were not estimated.
        notes: Why something is None.
    """

    shd: int
    shd_by_lag: tuple[int, ...]
    shd_classes: int | None = None
    precision: float
    recall: float
    f1: float
    auroc: float | None
    auprc: float | None
    sid: int | None = None
    parent_aid: int | None = None
    ancestor_aid: int | None = None
    oset_aid: int | None = None
    edges: int
    declared: int
    pairs: int
    adjacency_precision: float | None = None
    adjacency_recall: float | None = None
    adjacency_f1: float | None = None
    head_precision: float | None = None
    head_recall: float | None = None
    head_f1: float | None = None
    tail_precision: float | None = None
    tail_recall: float | None = None
    tail_f1: float | None = None
    pag_distance: int | None = None
    undeclared: tuple[EdgeKey, ...]
    missed: tuple[EdgeKey, ...]
    notes: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Write the scores as plain data."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}


@typed
def evaluate(
    found: EstimatedGraph | Iterable[EdgeKey] | nx.Graph,
    declared: Iterable[EdgeKey] | GroundTruth | SCM | CausalSystem | nx.DiGraph,
    *,
    names: Sequence[str] | None = None,
    pairs: ArrayLike | None = None,
    marks: bool = False,
) -> Scores:
    """Compare an estimated graph with the true one.

    Intervention distances and classes are about acyclic graphs of one instant. The two slices of a
    graph through time are not such a graph: the time before the first slice acts on all of it.
    So these scores are None as soon as one of the graphs has a lag.

    Args:
        found: The estimate of a learner, edges (cause, effect, lag), or a networkx graph. Its edges
            have no direction if there is one each way, or if the graph is undirected.
        declared: The true edges, or a ``GroundTruth``, an ``SCM`` or a world with them.
        names: The variables to compare on; those of the ``GroundTruth``, otherwise those of
            ``found`` if None. Variables that ``found`` does not have count as having no edge.
        pairs: Which pairs count, shape (p, p) or (lags + 1, p, p): not those that share a cause
            nobody observes. Those that the ``GroundTruth`` scores, otherwise all of them if None. A
            missing lag counts in full. Within an instant a pair counts if it does so in both
            orders, and nothing acts on itself.
        marks: Whether edge marks are compared even if the estimate has none: an edge without
            direction is o-o then, and others are -->. The time before the longest lag of an
            estimate through time is hidden.

    Raises:
        UnknownOption: An argument is of another kind.
        UnknownVariable: A true edge is about a variable that is not compared on;
            SeveralProblems if there are more of them.
        ModelError: ``pairs`` has another shape; or marks are compared, and the true graph has a
            cycle within the instant.

    Source:
        Of the rates: Tsamardinos, Brown and Aliferis, *The max-min hill-climbing Bayesian network
        structure learning algorithm*, Machine Learning 2006; false discoveries as in Benjamini and
        Hochberg, *Controlling the false discovery rate*, JRSS B 1995; of marks: Colombo, Maathuis,
        Kalisch and Richardson, *Learning high-dimensional directed acyclic graphs with latent and
        selection variables*, Annals of Statistics 2012, section 4. Of the others, see ``shd`` and
        ``aid``.

    Example:
        >>> found = EstimatedGraph.of_edges(["x", "y", "z"], [("x", "y", 0), ("z", "y", 0)])
        >>> scores = evaluate(found, [("x", "y", 0), ("y", "z", 0)])
        >>> scores.shd, scores.sid, scores.precision
        (1, 3, 0.5)
    """
    keys, truth = edge_keys(declared), declared if isinstance(declared, GroundTruth) else None
    if truth is not None and names is None:
        names, pairs = truth.names, truth.pairs if pairs is None else pairs
    if not isinstance(found, EstimatedGraph):
        if not isinstance(found, nx.Graph):
            found = nx.MultiDiGraph((c, e, {"lag": lag}) for c, e, lag in edge_keys(found))
        every = sorted({*map(str, found), *(name for key in keys for name in key[:2])})
        in_order = names is not None and {*found} == {*range(len(names))}
        found = EstimatedGraph.of(names if names and in_order else every, found)
    kept = found if names is None else found.restricted(tuple(names))
    true = matrices(keys, kept.names, len(kept.edges) - 1)
    counts = _counting(pairs, true.shape)
    edges, scores = np.zeros(true.shape, bool), np.zeros(true.shape)
    edges[: len(kept.edges)], scores[: len(kept.edges)] = kept.edges, kept.edge_scores
    edges, true = edges & counts, true & counts
    one_way, bare = edges.copy(), edges.copy()
    one_way[0] &= ~edges[0].T
    bare[0] = np.triu(edges[0] | edges[0].T)
    by_lag = shd(edges[0], true[0]), *(edges[1:] != true[1:]).sum(axis=(1, 2)).tolist()
    rates = _rates(one_way, true)
    if marks or found.marks is not None:
        truth = truth or GroundTruth(name="", names=kept.names, edges=tuple(keys))
        rates |= _of_marks(kept, truth)
    return Scores(
        shd=sum(by_lag),
        shd_by_lag=by_lag,
        auroc=auroc(scores[counts], true[counts]),
        auprc=auprc(scores[counts], true[counts]),
        edges=int(bare.sum()),
        declared=int(true.sum()),
        pairs=int(counts.sum()),
        undeclared=_keys(kept.names, edges & ~true),
        missed=_keys(kept.names, true & ~edges),
        **rates,
        **_within_an_instant(edges, true, counts),
    )


def _rates(said: Bools, true: Bools, learnable: Bools | None = None) -> dict[str, Any]:
    """Return precision, recall of the learnable marks or edges, and their harmonic mean."""
    wanted = true if learnable is None else learnable
    precision = float((said & true).sum() / said.sum()) if said.any() else 1.0
    recall = float((said & wanted).sum() / wanted.sum()) if wanted.any() else 1.0
    both = precision + recall
    f1 = 2 * precision * recall / both if both else 0.0
    return {"precision": precision, "recall": recall, "f1": f1}


def _of_marks(found: EstimatedGraph, truth: GroundTruth) -> dict[str, Any]:
    """Compare the edge marks of an estimate with the ancestral graphs of a truth."""
    made = found.restricted(truth.names).ancestral
    lags = len(made) - 1 or None
    real, known = truth.mag(lags), truth.pag(lags)
    made = np.concatenate([made, np.zeros_like(real)[len(made) :]])
    pairs = truth.pairs[: len(real)] if truth.unseen else np.broadcast_to(truth.pairs, real.shape)
    counts = _counting(pairs, real.shape)
    made, real, known = (np.where(counts, each, 0) for each in (made, real, known))
    once = np.ones(real.shape, dtype=bool)  # a pair within the instant counts once
    once[0] = np.triu(once[0])
    rates: dict[str, Any] = {}
    for name, said, true, learnable in (
        ("adjacency", (made != 0) & once, real != 0, (known != 0) & once),
        *((k, made == m, real == m, known == m) for k, m in (("head", HEAD), ("tail", TAIL))),
    ):
        for rate, value in _rates(said, true, learnable).items():
            rates[f"{name}_{rate}"] = value if rate == "precision" or learnable.any() else None
    other = made != known
    other[0] |= other[0].T
    return {**rates, "pag_distance": int((other & once).sum())}


def _counting(pairs: ArrayLike | None, shape: tuple[int, ...]) -> Bools:
    counts = np.ones(shape, dtype=bool)
    if pairs is not None:
        given = np.asarray(pairs, dtype=bool)
        given = given[None] if given.ndim == 2 else given
        if given.ndim != 3 or given.shape[1:] != shape[1:] or len(given) > len(counts):
            raise ModelError([f"pairs has shape {given.shape}; it can be up to {shape}"])
        counts[: len(given)] = given
    counts[0] &= counts[0].T
    np.fill_diagonal(counts[0], False)
    return counts


def _keys(names: tuple[str, ...], edges: Bools) -> tuple[EdgeKey, ...]:
    return tuple(sorted((names[i], names[j], lag) for lag, i, j in np.argwhere(edges).tolist()))


def _within_an_instant(edges: Bools, true: Bools, counts: Bools) -> dict[str, Any]:
    """Compute the scores that are defined for acyclic graphs of one instant only."""
    reason = "" if edges.size else "there are no variables"
    member = extension(edges[0])
    if edges[1:].any() or true[1:].any():
        reason = "there are edges through time"
    elif counts[0].sum() < counts[0].size - len(counts[0]):
        reason = "some pairs do not count"
    elif not is_acyclic(true[0]):
        reason = "the declared graph has a cycle"
    elif member is None:
        reason = "the found graph has a cycle, or cannot be directed without another v-structure"
    if reason or member is None:
        return {"notes": (f"no intervention distances: {reason}",)}
    classes = shd(essential_graph(member), essential_graph(true[0]))
    result: dict[str, Any] = {"shd_classes": classes}
    try:
        result |= {kind: aid(edges[0], true[0], kind) for kind in KINDS}
    except MissingExtra:
        result["notes"] = ("no SID, no adjustment distances: pip install 'scm-world[learn]'",)
    return result


def auroc(edge_scores: Floats, present: Bools) -> float | None:
    """Compute the area under the receiver operating characteristic.

    Args:
        edge_scores: Of each candidate, shape (n,); the larger, the surer.
        present: Whether it is there, shape (n,).

    Returns:
        Probability that something present ranks before something absent, a tie counting half.
        None if all are present, or none is.

    Source:
        Hanley and McNeil, *The meaning and use of the area under a receiver operating
        characteristic (ROC) curve*, Radiology 1982.

    Example:
        >>> auroc(np.array([0.9, 0.5, 0.5, 0.1]), np.array([True, True, False, False]))
        0.875
    """
    positives = int(present.sum())
    negatives = len(present) - positives
    if not positives or not negatives:
        return None
    from scipy.stats import rankdata  # takes a third of a second

    above = rankdata(edge_scores)[present].sum() - positives * (positives + 1) / 2.0
    return float(above / (positives * negatives))


def auprc(edge_scores: Floats, present: Bools) -> float | None:
    """Compute the average precision: precision at each recall, summed over the steps in recall.

    Candidates with the same edge_scores are accepted together; arguments are those of ``auroc``.

    Source:
        Davis and Goadrich, *The relationship between precision-recall and ROC curves*, ICML 2006,
        on why not to interpolate linearly.
    """
    positives = int(present.sum())
    if not positives or positives == len(present):
        return None
    levels, at = np.unique(-edge_scores, return_inverse=True)
    accepted = np.cumsum(np.bincount(at, minlength=len(levels)))
    hits = np.cumsum(np.bincount(at, weights=present, minlength=len(levels)))
    steps = np.diff(hits, prepend=0.0) / positives
    return float((steps * hits / accepted).sum())


# --- distances of matrices ------------------------------------------------------------------------


def shd(found: Bools, true: Bools) -> int:
    """Count the pairs of nodes that are joined differently: the structural Hamming distance.

    A missing, an additional and a turned edge count 1 each, and so does an edge without direction
    where the true one has a direction or does not exist. Shapes are (p, p).

    Source:
        Tsamardinos, Brown and Aliferis, *The max-min hill-climbing Bayesian network structure
        learning algorithm*, Machine Learning 2006.

    Example:
        >>> shd(np.array([[0, 1], [1, 0]], bool), np.array([[0, 1], [0, 0]], bool))
        1
    """
    differ = found != true
    return int(np.triu(differ | differ.T, 1).sum())


def aid(found: Bools, true: Bools, kind: str) -> int | None:
    """Count the effects that come out wrong under an adjustment strategy, by ``gadjid``.

    Args:
        found: Edges with and without direction, shape (p, p).
        true: Acyclic, shape (p, p).
        kind: One of ``KINDS``. The structural intervention distance, ``"sid"``, adjusts for the
            parents that a cause has in the found graph.

    Returns:
        None if the found graph has a cycle, is not an essential graph, or of ``"sid"`` has an edge
        without direction.

    Raises:
        MissingExtra: ``gadjid`` is not installed.

    Source:
        Peters and Bühlmann, *Structural intervention distance for evaluating causal graphs*, Neural
        Computation 2015; Henckel, Würtzen and Weichwald, *Adjustment identification distance: a
        gadjid for causal structure learning*, UAI 2024.
    """
    distance = getattr(load("gadjid", "gadjid", "learn"), kind)
    member = extension(found)
    if member is None or not is_acyclic(true) or (kind == "sid" and (found & found.T).any()):
        return None
    closed = meek(found)
    together = reaches(closed & closed.T)
    if (closed & ~closed.T & together).any():  # an essential graph is a chain graph
        return None
    # 1 for an edge with a direction, 2 for one without
    coded = [graph.astype(np.int8) + (graph & graph.T).astype(np.int8) for graph in (true, closed)]
    _, wrong = distance(*coded, edge_direction=ROWS)
    return int(wrong)


# --- sortability ----------------------------------------------------------------------------------

CONSTANT = 1e-12
"""A column that varies less than this, relative to its largest value, is constant."""
EQUAL = 1e-9
"""Variances, or R², that differ by less than this part are equal: those of two columns are."""


@typed
def sortability(data: Dataset, edges: Iterable[EdgeKey] | GroundTruth) -> dict[str, float]:
    """Return how well an order by variance, and one by R², agree with the true graph.

    Args:
        data: Rows in which nothing is done.
        edges: True ones, or a ``GroundTruth``; lags count for nothing.

    Returns:
        ``"variance"``, and ``"r2"`` of each column given all others: the share of directed paths,
        by ends and length, along which the number grows; 0.5 by chance, NaN without paths. Near 1
        or 0, an order that needs no causal reasoning tells directions. Constant columns have no R²:
        paths that begin or end there do not count for it. Of fewer than two rows both are NaN.

    Raises:
        UnknownVariable: A true edge is about another column.

    Source:
        Reisach, Seiler and Weichwald, *Beware of the simulated DAG!*, NeurIPS 2021; Reisach, Tami,
        Seiler, Chambaz and Weichwald, *A scale-invariant sorting criterion to find a causal order
        in additive noise models*, NeurIPS 2023.

    Example:
        >>> x = np.random.default_rng(0).normal(size=(1000, 2))
        >>> data = Dataset.of(np.stack([x[:, 0], x.sum(axis=1)], axis=1), ["x", "y"])
        >>> sortability(data, [("x", "y", 0)])["variance"]
        1.0
    """
    keys = edge_keys(edges)
    lags = max((lag for *_, lag in keys), default=0)
    step: Bools = np.asarray(matrices(keys, data.names, lags).any(axis=0))
    if len(data) < 2:
        return {"variance": float("nan"), "r2": float("nan")}
    sums = np.atleast_2d(np.cov(data.values, rowvar=False))
    variance = np.diag(sums)
    spread = np.sqrt(variance)
    varies = spread > CONSTANT * np.abs(data.values).max(axis=0)
    r2 = np.full(len(spread), np.nan)
    scaled = (sums / np.where(varies, spread, 1.0) / np.where(varies, spread, 1.0)[:, None])[varies]
    inverse = np.diag(np.linalg.pinv(scaled[:, varies]))
    r2[varies] = 1.0 - 1.0 / np.maximum(inverse, np.finfo(float).tiny)
    found = {}
    for name, order in (("variance", variance), ("r2", r2)):
        more = order[None, :] - order[:, None]
        tie = np.abs(more) <= EQUAL * np.maximum(np.abs(order), np.abs(order[:, None]))
        grows = 0.5 * (1.0 + np.sign(np.where(tie, 0.0, more)))
        known = np.isfinite(grows)
        paths, count, right = step, 0.0, 0.0
        for _ in range(len(step) - 1):
            if not paths.any():
                break
            count, right = count + (paths & known).sum(), right + grows[paths & known].sum()
            paths = meets(paths, step)
        found[name] = float(right / count) if count else float("nan")
    return found
