"""A custom learner: a function that turns a table into a matrix.

Run it with ``python examples/own_learner.py``.
"""

from __future__ import annotations

import numpy as np

from scm_world import SCM, Derived, Exogenous, Linear
from scm_world.discovery.data import Dataset
from scm_world.discovery.learners import Learner, learn, register
from scm_world.variables import Normal

NOISE = Normal()
MODEL = SCM(
    [
        Exogenous(name="a", distribution=NOISE),
        Derived(name="b", parents=("a",), mechanism=Linear(weights=(1.0,)), noise=NOISE),
        Derived(name="c", parents=("a", "b"), mechanism=Linear(weights=(1.0, -2.0)), noise=NOISE),
    ]
)


def contrast(data: Dataset, *, seed: int = 0, least: float = 5.0) -> np.ndarray:
    """Find what moves when a variable is set, then which of it is direct."""
    seen, p = data.observational.values, len(data.names)
    spread = seen.std(axis=0) / np.sqrt(len(seen))
    moves = np.zeros((p, p), bool)  # [i, j]: j is elsewhere where i is set
    for i, name in enumerate(data.names):
        there = data.values[[data.regimes[k].targets == (name,) for k in data.regime]]
        if len(there):
            moves[i] = np.abs(there.mean(axis=0) - seen.mean(axis=0)) > 2 * least * spread
    np.fill_diagonal(moves, False)
    surely = np.zeros((p, p))
    for j in range(p):  # of all causes of j, the direct ones are left in a regression
        free, causes = ~data.targeted[:, j], np.flatnonzero(moves[:, j])
        x = np.column_stack([data.values[free][:, causes], np.ones(free.sum())])
        inverse = np.linalg.pinv(x.T @ x)
        weight = inverse @ x.T @ data.values[free, j]
        noise = np.std(data.values[free, j] - x @ weight)
        surely[causes, j] = (np.abs(weight) / (noise * np.sqrt(np.diag(inverse))))[:-1]
    return np.where(surely > least, surely, 0.0)


def main(rows: int = 1000) -> None:
    """Draw rows with and without interventions, and let the learner find the graph."""
    tables, targets = [], []
    for number, done in enumerate(({}, {"a": 3.0}, {"b": 3.0}, {"c": 3.0})):
        drawn = MODEL.do(done).sample(rows, seed=number)
        tables.append(np.stack([drawn[name] for name in "abc"], axis=1))
        targets += [tuple(done)] * rows
    register(Learner("contrast", contrast, doc="what moves, then regression"))
    found = learn("contrast", Dataset.of(np.concatenate(tables), list("abc"), targets=targets))
    print(*(f"{cause} -> {effect}" for cause, effect, _ in found.directed), sep="\n")


if __name__ == "__main__":
    main()
