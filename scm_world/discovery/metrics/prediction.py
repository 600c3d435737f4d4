"""Whether a found graph predicts what an intervention does."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from scm_world._types import Floats, Integers
from scm_world.discovery.data.dataset import Dataset
from scm_world.discovery.learners.found import Found
from scm_world.errors import ModelError, UnknownVariable
from scm_world.graph.equivalence import Bools, extension, topological_order

CONSTANT = 1e-12
"""A column that varies less than this, relative to its mean, is constant."""


@final
@dataclass(frozen=True)
class Prediction:
    """How far predicted means are from the means that came out, under held-out interventions.

    Attributes:
        rmse: Root of the mean square over regimes and columns that were not set, each difference
            divided by the standard deviation of the column where nothing is done. None if it
            cannot be computed.
        unmoved: The same for the prediction that nothing moves; a graph is worth something below.
        by_regime: ``rmse`` of each regime, by its targets.
        note: Why ``rmse`` is None.
    """

    rmse: float | None
    unmoved: float | None = None
    by_regime: dict[tuple[str, ...], float] = field(default_factory=dict)
    note: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Write it as plain data."""
        regimes = [
            {"targets": list(targets), "rmse": size} for targets, size in self.by_regime.items()
        ]
        return {
            "rmse": self.rmse,
            "unmoved": self.unmoved,
            "by_regime": regimes,
            "note": self.note,
        }


def hold_out(data: Dataset, targets: Iterable[Sequence[str]]) -> tuple[Dataset, Dataset]:
    """Split a table: the rest, and the rows in which exactly these variables were set.

    Args:
        data: Rows of several regimes.
        targets: For each held-out regime the variables that were set.

    Raises:
        ModelError: No row has these targets.

    Example:
        >>> table = Dataset.of([[0.0], [1.0]], ["x"], targets=[(), ("x",)])
        >>> [len(part) for part in hold_out(table, [("x",)])]
        [1, 1]
    """
    wanted = {tuple(sorted(target)) for target in targets}
    known = {regime.targets for regime in data.regimes}
    if not wanted <= known:
        missing = [", ".join(target) or "nothing" for target in sorted(wanted - known)]
        raise ModelError([f"no row has the targets: {what}" for what in missing])
    chosen = np.array([regime.targets in wanted for regime in data.regimes])[data.regime]
    return data.rows(~chosen), data.rows(chosen)


def effect_rmse(found: Found, train: Dataset, test: Dataset) -> Prediction:
    """Predict the mean of every column under interventions that were not learned from.

    The mechanism of each column is linear in its found parents, fitted by least squares on the
    rows of ``train`` where the column was not set. Under the interventions of ``test`` the means
    of what was set are given, and the others follow in causal order. Scaling a column changes
    nothing. Of edges without direction one extension is taken, the first of Dor and Tarsi: another
    member of the class may predict otherwise.

    Args:
        found: A graph over columns or variables of the tables; columns it does not know are left
            out. An edge between two vectors joins all their components.
        train: With rows in which nothing was done.
        test: With rows in which something was done.

    Raises:
        UnknownVariable: The graph is about something that is no column and no variable.
        ModelError: ``train`` has no row in which nothing was done, or ``test`` none in which
            something was.

    Source:
        Peters, Janzing and Schölkopf, *Elements of Causal Inference*, 2017, section 6.3, for the
        truncated factorization; of linear mechanisms only means are needed.

    Example:
        >>> x = np.array([0.0, 1.0, 2.0, 8.0])
        >>> table = Dataset.of(np.stack([x, 2 * x], 1), ["x", "y"], targets=[(), (), (), ("x",)])
        >>> train, test = hold_out(table, [("x",)])
        >>> round(effect_rmse(Found.of_edges(["x", "y"], [("x", "y", 0)]), train, test).rmse, 6)
        0.0
    """
    if not len(train.observational):
        raise ModelError(["train has no row in which nothing was done"])
    if not any(test.regimes[number].targets for number in np.unique(test.regime)):
        raise ModelError(["test has no row in which something was done"])
    if found.edges[1:].any():
        return Prediction(None, note="the graph has edges through time")
    dag = extension(found.edges[0])
    if dag is None:
        return Prediction(None, note="the graph has a cycle, or no extension")
    where, graph = _over_columns(found.names, dag, train)
    seen = train.observational.values[:, where]
    spread = seen.std(axis=0)
    spread[spread <= CONSTANT * (1.0 + np.abs(seen.mean(axis=0)))] = np.nan
    weight, offset = _fitted(train.values[:, where], train.targeted[:, where], graph)
    return _compared(graph, weight, offset, (seen.mean(axis=0), spread), test, where)


def _over_columns(names: Sequence[str], dag: Bools, data: Dataset) -> tuple[Integers, Bools]:
    """Write a graph over variables as one over the columns they have."""
    groups = []
    for name in names:
        if name in data.names:
            groups.append([data.names.index(name)])
        elif name in data.blocks:
            groups.append(data.blocks[name].tolist())
        else:
            raise UnknownVariable(name, (*data.names, *data.variables))
    owner = np.repeat(np.arange(len(names)), [len(group) for group in groups])
    where = np.array([i for group in groups for i in group], dtype=np.int64)
    return where, dag[np.ix_(owner, owner)]


def _fitted(values: Floats, targeted: Bools, graph: Bools) -> tuple[Floats, Floats]:
    """Fit each column on its parents: weights, shape (p, p), and offsets, shape (p,)."""
    weight, offset = np.zeros(graph.shape), np.zeros(len(graph))
    scale = np.maximum(values.std(axis=0), np.finfo(float).tiny)
    for node in range(len(graph)):
        rows, parents = ~targeted[:, node], graph[:, node]
        causes, effect = values[np.ix_(rows, parents)], values[rows, node]
        center, middle = causes.mean(axis=0), effect.mean()
        slope, *_ = np.linalg.lstsq((causes - center) / scale[parents], effect - middle, rcond=None)
        weight[parents, node] = slope / scale[parents]
        offset[node] = middle - center @ weight[parents, node]
    return weight, offset


def _compared(
    graph: Bools,
    weight: Floats,
    offset: Floats,
    normal: tuple[Floats, Floats],
    test: Dataset,
    where: Integers,
) -> Prediction:
    """Predict each regime of the test rows, and compare with what came out."""
    middle, spread = normal
    errors: dict[tuple[str, ...], list[Floats]] = {}
    moves: list[Floats] = []
    for number in np.unique(test.regime):
        rows = test.regime == number
        fixed = test.targeted[rows][0, where]
        came_out = test.values[rows][:, where].mean(axis=0)
        predicted = _predicted(graph, weight, offset, fixed, came_out)
        known = ~fixed & np.isfinite(spread)
        if fixed.any() and known.any():
            size = (predicted - came_out) / spread
            errors.setdefault(test.regimes[number].targets, []).append(size[known])
            moves.append(((middle - came_out) / spread)[known])
    if not moves:
        return Prediction(None, note="no column varies that was not set")
    by_regime = {targets: _rms(parts) for targets, parts in errors.items()}
    every = [part for parts in errors.values() for part in parts]
    return Prediction(_rms(every), _rms(moves), by_regime)


def _predicted(
    graph: Bools, weight: Floats, offset: Floats, fixed: Bools, came_out: Floats
) -> Floats:
    """Follow the means in causal order from those of what was set, shape (p,)."""
    mean = came_out.copy()
    for node in topological_order(graph):
        if not fixed[node]:
            mean[node] = offset[node] + mean @ weight[:, node]
    return mean


def _rms(parts: Sequence[Floats]) -> float:
    return float(np.sqrt((np.concatenate(parts) ** 2).mean()))


__all__ = ["Prediction", "effect_rmse", "hold_out"]
