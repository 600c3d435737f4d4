"""Tables made fit for learners that assume columns which vary freely."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats, Integers
from scm_world.discovery.data.dataset import Dataset
from scm_world.discovery.learners.found import Found
from scm_world.errors import ModelError

DEPENDENT = 1e-7
"""A column with this part of its spread left after regression on the earlier ones adds nothing."""

SHOWN = 10
"""So many columns are named in a note."""


@final
@dataclass(frozen=True)
class Table:
    """What a learner is given, and how to speak of all columns again.

    Attributes:
        data: Rows and columns that can be used, standardised.
        names: Of all p columns.
        kept: Numbers of the k columns that are used, shape (k,).
        notes: What was left out, and why.
    """

    data: Dataset
    names: tuple[str, ...]
    kept: Integers
    notes: tuple[str, ...]

    def found(
        self, edges: NDArray[np.bool_], sureness: Floats, *notes: str, **settings: Any
    ) -> Found:
        """Say what was found; columns that were left out have no edges.

        Args:
            edges: Shape (k, k) or (lags + 1, k, k).
            sureness: Same shape.
            notes: Further ones; empty ones are left out.
            settings: Of the learner.
        """
        rows, columns = self.kept[:, None], self.kept[None, :]
        p = len(self.names)
        wide = np.zeros((*edges.shape[:-2], p, p))
        heavy = wide.copy()
        wide[..., rows, columns], heavy[..., rows, columns] = edges, sureness
        told = (*self.notes, *filter(None, notes))
        return Found.of(self.names, wide, sureness=heavy, notes=told, settings=settings)


def prepare(learner: str, data: Dataset, *, done: bool = False) -> Table:
    """Leave out what a learner cannot use, and say so.

    Where columns are linear functions of one another, earlier control steps are kept rather than
    later ones, then columns on the left. Without a result its causes are still seen together;
    without a cause its results would seem to be tied.

    Args:
        learner: Its name, for messages.
        data: Rows under any regime.
        done: Whether it can use rows in which something is done; they are left out otherwise.

    Raises:
        ModelError: No row is left, or not more rows than columns.
    """
    rows = data if done else data.observational
    if len(rows) == 0:
        raise ModelError(
            [f"{learner!r} uses only rows in which nothing is done, and there are none; add some"]
        )
    values = rows.standardised().values
    varying = np.flatnonzero(values.any(axis=0))
    if len(rows) <= len(varying):
        given = f"{len(rows)} rows and {len(varying)} columns that vary"
        raise ModelError([f"{learner!r} needs more rows than columns; there are {given}"])
    lags = np.array([rows.columns[i].lag for i in varying], dtype=np.int64)
    order = varying[np.argsort(-lags, kind="stable")]
    kept = np.sort(order[independent(values[:, order])])
    usable = rows.select([rows.names[i] for i in kept]).standardised()
    return Table(usable, data.names, kept, tuple(_told(data, rows, varying, kept)))


def _told(data: Dataset, rows: Dataset, varying: Integers, kept: Integers) -> Iterator[str]:
    left, names = len(data) - len(rows), np.array(data.names, dtype=object)
    if left:
        yield f"{left} of {len(data)} rows were left out: something is done in them"
    for what, which in (
        ("taken for real numbers", [i for i in kept if data.columns[i].dtype != "real"]),
        (
            "without edges, since they do not vary",
            np.delete(np.arange(len(names)), varying).tolist(),
        ),
        (
            "without edges, since other columns determine them",
            np.setdiff1d(varying, kept).tolist(),
        ),
    ):
        if which:
            more = f" and {len(which) - SHOWN} more" if len(which) > SHOWN else ""
            yield f"{what}: {', '.join(names[which[:SHOWN]])}{more}"


def independent(values: Floats) -> Integers:
    """List the columns that are not linear functions of those before them.

    Args:
        values: Shape (n, p), of mean 0 and variance 1.

    Returns:
        Their numbers, sorted.

    Example:
        >>> x = np.array([[1.0, -1.0, 1.0, -1.0], [1.0, 1.0, -1.0, -1.0]])
        >>> independent(np.stack([x[0], -x[0], x[1]], axis=1)).tolist()
        [0, 2]
    """
    n, p = values.shape
    basis = np.zeros((n, p))
    kept: list[int] = []
    for column in range(p):
        q = basis[:, : len(kept)]
        rest = values[:, column]
        for _ in range(2):  # once is not exact enough: Parlett, The Symmetric Eigenvalue Problem
            rest = rest - q @ (q.T @ rest)
        length = float(np.linalg.norm(rest))
        if length > DEPENDENT * float(np.linalg.norm(values[:, column])):
            basis[:, len(kept)] = rest / length
            kept.append(column)
    return np.array(kept, dtype=np.int64)
