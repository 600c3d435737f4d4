"""All scores of a found graph in one call."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, final

import numpy as np

from scm_world.discovery.learners.found import Found
from scm_world.discovery.metrics.distances import (
    MEMBERS,
    Adjustment,
    aid,
    has_gadjid,
    shd,
    shd_of_classes,
    sid_bounds,
)
from scm_world.discovery.metrics.ranking import auprc, auroc
from scm_world.discovery.scores import score
from scm_world.errors import ModelError, UnknownVariable, raise_all
from scm_world.graph.equivalence import Bools, extension, is_acyclic
from scm_world.queries.experiments.effects import EdgeKey

FORMAT = "scm_world/scores/1"


@final
@dataclass(frozen=True)
class Scores:
    """How near a found graph comes to the declared one; None for what does not apply.

    Attributes:
        shd: Structural Hamming distance, over all lags. An edge without direction counts 1 where
            it is wrong and 1 where it is right.
        shd_by_lag: The same for each lag, from 0 on.
        shd_classes: Between the two essential graphs. Only without lags.
        precision: Found edges with a direction that are declared, as a fraction; 1 if there are
            none.
        recall: Declared edges that were found with their direction, as a fraction; 1 if none is
            declared.
        f1: Harmonic mean of the two.
        false_discoveries: Found edges with a direction that are not declared, as a fraction; 0 if
            there are none.
        skeleton_precision: As above, without regard to directions within an instant.
        skeleton_recall: As above.
        skeleton_f1: As above.
        auroc: Probability that a declared edge has a larger sureness than what is not declared.
        auprc: Average precision in the order of sureness.
        sid_lower: Pairs whose interventional distribution comes out wrong, for the best acyclic
            graph that the found one can become. Only without lags.
        sid_upper: For the worst; the same number if every edge has a direction.
        parent_aid: Effects that come out wrong if one adjusts for the found parents; by
            ``gadjid``. Only without lags.
        ancestor_aid: For the found ancestors.
        oset_aid: For the set that would be best in the found graph.
        edges: How many edges were found, those without direction counted once.
        declared: How many edges are declared.
        pairs: How many ordered pairs count, over all lags.
        notes: Why something is None.
    """

    shd: int
    shd_by_lag: tuple[int, ...]
    shd_classes: int | None
    precision: float
    recall: float
    f1: float
    false_discoveries: float
    skeleton_precision: float
    skeleton_recall: float
    skeleton_f1: float
    auroc: float | None
    auprc: float | None
    sid_lower: int | None
    sid_upper: int | None
    parent_aid: int | None
    ancestor_aid: int | None
    oset_aid: int | None
    edges: int
    declared: int
    pairs: int
    notes: tuple[str, ...] = ()

    @property
    def sid(self) -> int | None:
        """Structural intervention distance, where the found graph leaves no choice."""
        return self.sid_lower if self.sid_lower == self.sid_upper else None

    def as_dict(self) -> dict[str, Any]:
        """Write the scores as plain data."""
        plain = {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in asdict(self).items()
        }
        return {"format": FORMAT, **plain}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Scores:
        """Read what ``as_dict`` wrote.

        Raises:
            ModelError: It is something else.
        """
        names = [field.name for field in fields(cls)]
        if data.get("format") != FORMAT or set(data) != {"format", *names}:
            raise ModelError([f"not scores of a graph: expected the format {FORMAT!r}"])
        values = {name: data[name] for name in names}
        for name in ("shd_by_lag", "notes"):
            values[name] = tuple(values[name])
        return cls(**values)


def evaluate(
    found: Found,
    declared: Iterable[EdgeKey],
    *,
    names: Sequence[str] | None = None,
    pairs: Any = None,
) -> Scores:
    """Compare a found graph with the declared one.

    Intervention distances and classes are about acyclic graphs of one instant. The two slices of a
    graph through time are no such graph: what happened before the first slice acts on all of it.
    So these scores are None as soon as one of the graphs has a lag.

    Args:
        found: What a learner gave.
        declared: The true edges: cause, effect, lag.
        names: The variables to compare on; those of ``found`` if None. Variables that ``found``
            does not have count as having no edge.
        pairs: Which pairs count, shape (p, p) or (lags + 1, p, p): not those that share a cause
            nobody observes. All of them if None. A missing lag counts in full. Within an instant
            a pair counts if it does so in both orders, and nothing acts on itself.

    Raises:
        UnknownVariable: A declared edge is about a variable that is not compared on;
            SeveralProblems if there are more of them.
        ModelError: ``pairs`` has another shape.

    Source:
        Of the rates: Tsamardinos et al. 2006; false discoveries as in Benjamini and Hochberg,
        *Controlling the false discovery rate*, JRSS B 1995. Of the others, see ``distances`` and
        ``ranking``.

    Example:
        >>> found = Found.of_edges(["x", "y", "z"], [("x", "y", 0), ("z", "y", 0)])
        >>> scores = evaluate(found, [("x", "y", 0), ("y", "z", 0)])
        >>> scores.shd, scores.sid, scores.precision, scores.skeleton_f1
        (1, 3, 0.5, 1.0)
    """
    keys = list(declared)
    kept = found if names is None else found.restricted(tuple(names))
    lags = max([len(kept.edges) - 1, *(lag for *_, lag in keys)])
    true = matrices(keys, kept.names, lags)
    counts = _counting(pairs, true.shape)
    kept = kept.told(
        edges=_padded(kept.edges, lags) & counts, sureness=_padded(kept.sureness, lags)
    )
    true = true & counts
    declared_keys = _keys(kept.names, true)
    directed = score(kept.directed, declared_keys)
    either = score(_keys(kept.names, _bare(kept.edges)), _keys(kept.names, _bare(true)))
    by_lag = (
        shd(kept.edges[0], true[0]),
        *(int((kept.edges[lag] != true[lag]).sum()) for lag in range(1, lags + 1)),
    )
    return Scores(
        shd=sum(by_lag),
        shd_by_lag=by_lag,
        precision=directed.precision,
        recall=directed.recall,
        f1=directed.f1,
        false_discoveries=1.0 - directed.precision,
        skeleton_precision=either.precision,
        skeleton_recall=either.recall,
        skeleton_f1=either.f1,
        auroc=auroc(kept.sureness[counts], true[counts]),
        auprc=auprc(kept.sureness[counts], true[counts]),
        edges=len(kept.directed) + len(kept.undirected),
        declared=len(declared_keys),
        pairs=int(counts.sum()),
        **_within_an_instant(kept.edges, true, counts),
    )


def matrices(edges: Iterable[EdgeKey], names: tuple[str, ...], lags: int) -> Bools:
    """Write lagged edges as matrices, shape (lags + 1, p, p).

    Raises:
        UnknownVariable: An edge is about another variable.

    Example:
        >>> matrices([("x", "y", 1)], ("x", "y"), 1).astype(int).tolist()
        [[[0, 0], [0, 0]], [[0, 1], [0, 0]]]
    """
    at = {name: i for i, name in enumerate(names)}
    result = np.zeros((lags + 1, len(names), len(names)), dtype=bool)
    keys = list(edges)
    unknown = dict.fromkeys(name for key in keys for name in key[:2] if name not in at)
    raise_all([UnknownVariable(name, names) for name in unknown])
    for cause, effect, lag in keys:
        result[lag, at[cause], at[effect]] = True
    return result


def _counting(pairs: Any, shape: tuple[int, ...]) -> Bools:
    """Give the pairs that count, for all lags."""
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


def _padded(values: Any, lags: int) -> Any:
    more = lags + 1 - len(values)
    return np.concatenate([values, np.zeros((more, *values.shape[1:]), dtype=values.dtype)])


def _bare(edges: Bools) -> Bools:
    """Forget directions within the instant; the lower number comes first."""
    bare = edges.copy()
    bare[0] = np.triu(edges[0] | edges[0].T)
    return bare


def _keys(names: tuple[str, ...], edges: Bools) -> list[EdgeKey]:
    return [(names[i], names[j], lag) for lag, i, j in np.argwhere(edges).tolist()]


def _within_an_instant(edges: Bools, true: Bools, counts: Bools) -> dict[str, Any]:
    """Compute what is defined for acyclic graphs of one instant only."""
    kinds: tuple[Adjustment, ...] = ("parent", "ancestor", "oset")
    result: dict[str, Any] = dict.fromkeys(
        ("shd_classes", "sid_lower", "sid_upper", *(f"{kind}_aid" for kind in kinds))
    )
    reason = _not_comparable(edges, true, counts)
    if reason:
        return {**result, "notes": (f"no intervention distances: {reason}",)}
    notes = []
    result["shd_classes"] = shd_of_classes(edges[0], true[0])
    bounds = sid_bounds(edges[0], true[0])
    if bounds is None:
        notes.append(f"no SID: there are more than {MEMBERS} ways to direct the found graph")
    else:
        result["sid_lower"], result["sid_upper"] = bounds
    if has_gadjid():
        result |= {f"{kind}_aid": aid(edges[0], true[0], kind) for kind in kinds}
    else:
        notes.append("no adjustment distances: pip install 'scm-world[discovery]'")
    return {**result, "notes": tuple(notes)}


def _not_comparable(edges: Bools, true: Bools, counts: Bools) -> str:
    if len(true) > 1 and (edges[1:].any() or true[1:].any()):
        return "there are edges through time"
    if counts[0].sum() < counts[0].size - len(counts[0]):
        return "some pairs do not count"
    if not is_acyclic(true[0]):
        return "the declared graph has a cycle"
    if extension(edges[0]) is None:
        return "the found graph has a cycle, or cannot be directed without another v-structure"
    return ""


__all__ = ["FORMAT", "Scores", "evaluate", "matrices"]
