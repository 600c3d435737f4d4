"""Which interval of a mean score holds where failures are rare: coverage and width of several.

::

    python -m benchmarks.intervals                    # 4,000 samples a cell, a few minutes
    python -m benchmarks.intervals --samples 200 --out FILE

Scores are 1, or about 0.95 or 0.98, and some episodes fail. The criterion was fixed before any
figure was seen: a method whose intervals of 95 % contain the truth in at least 0.93 of the samples
of every cell, and of those the one with the smallest mean width. Cells without failures, scores
that hardly vary, and all rates of 0/1 scores joined after the first table, before theirs. Writes
``intervals.json``; ``python -m benchmarks.figures`` draws it.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator, Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import as_json
from scm_world._types import Floats
from scm_world.evaluation.statistics.intervals import korn_graubard, student
from scm_world.queries.experiments.versions import versions
from scm_world.runs.files import write_whole

FILE = Path(__file__).parent / "intervals.json"
LEVEL, LEAST = 0.95, 0.93
SIZES, RATES = (20, 40, 200), (0.0, 0.01, 0.05, 0.1, 0.2, 0.5)
RESAMPLES = 2000
UNIT = np.zeros(1), np.ones(1)

Rng = np.random.Generator
Ends = tuple[Floats, Floats]
Sample = tuple[Floats, float]

SUCCESSES: Mapping[str, tuple[Callable[[Rng, Any], Floats], float]] = {
    "1": (lambda rng, shape: np.ones(shape), 1.0),
    "beta(95, 5)": (lambda rng, shape: rng.beta(95.0, 5.0, shape), 0.95),
    "beta(9800, 200)": (lambda rng, shape: rng.beta(9800.0, 200.0, shape), 0.98),
}
"""Scores of episodes that do not fail, and their means."""

FAILURES: Mapping[str, tuple[Callable[[Rng, Any], Floats], float]] = {
    "0": (lambda rng, shape: np.zeros(shape), 0.0),
    "uniform to 0.9": (lambda rng, shape: rng.uniform(0.0, 0.9, shape), 0.45),
}


# --- methods: scores of shape (n, samples) to both ends, shape (samples,) -------------------------


def gaffke(scores: Floats, rng: Rng, extra: float) -> Ends:
    """Weigh scores at random (Dirichlet), with an extra score at the bound of each end."""
    weights = rng.exponential(size=(RESAMPLES, len(scores)))
    more = rng.gamma(extra, size=(RESAMPLES, 1))
    mean, whole = weights @ scores, weights.sum(axis=1, keepdims=True) + more
    tail = 0.5 - 0.5 * LEVEL
    return (
        np.quantile(mean / whole, tail, axis=0),
        np.quantile((mean + more) / whole, 1.0 - tail, axis=0),
    )


def bayes(scores: Floats, rng: Rng) -> Ends:
    """Weigh scores and half a score at either bound at random: Jeffreys' interval of 0 and 1."""
    weights = rng.exponential(size=(RESAMPLES, len(scores)))
    low, high = rng.gamma(0.5, size=(2, RESAMPLES, 1))
    means = (weights @ scores + high) / (weights.sum(axis=1, keepdims=True) + low + high)
    ends = np.quantile(means, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL], axis=0)
    return ends[0], ends[1]


def bootstrap(scores: Floats, rng: Rng) -> Ends:
    """Take percentiles of resampled means."""
    n = len(scores)
    counts = rng.multinomial(n, np.full(n, 1.0 / n), RESAMPLES)
    ends = np.quantile(counts @ scores / n, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL], axis=0)
    return ends[0], ends[1]


def betting(scores: Floats, rng: Rng) -> Ends:
    """Bet against each mean of a grid of 200: hedged capital, Waudby-Smith and Ramdas 2024."""
    n, alpha, grid = len(scores), 1.0 - LEVEL, np.arange(0.5, 200.0)[:, None] / 200.0
    count = np.arange(1, n + 1)
    ends = []
    for one in scores.T:
        mean = (0.5 + np.cumsum(one)) / (count + 1)
        variance = (0.25 + np.cumsum(np.square(one - mean))) / (count + 1)
        bet = np.sqrt(2.0 * math.log(2.0 / alpha) / (n * np.append(0.25, variance[:-1])))
        up = np.log1p(np.minimum(bet, 0.5 / grid) * (one - grid)).cumsum(axis=1)
        down = np.log1p(-np.minimum(bet, 0.5 / (1.0 - grid)) * (one - grid)).cumsum(axis=1)
        held = grid[(np.maximum(up, down).max(axis=1) + math.log(0.5)) < -math.log(alpha)]
        near = held if held.size else np.array([one.mean()])
        ends.append((near.min() - 1.0 / 200.0, near.max() + 1.0 / 200.0))
    found = np.array(ends).T
    return found[0], found[1]


METHODS: Mapping[str, Callable[[Floats, Rng], Ends]] = {
    "Student's, with a score at either bound": lambda scores, rng: student(
        scores, (0.0, 1.0), LEVEL
    ),
    "Student's": lambda scores, rng: student(scores, None, LEVEL),
    "Korn and Graubard's": lambda scores, rng: korn_graubard(
        scores.mean(axis=0), scores, UNIT, LEVEL
    ),
    "bootstrap, percentiles": bootstrap,
    "Bayesian bootstrap, half a score at either bound": bayes,
    "Gaffke's, half a score": lambda scores, rng: gaffke(scores, rng, 0.5),
    "Gaffke's (Clopper and Pearson's of 0 and 1)": lambda scores, rng: gaffke(scores, rng, 1.0),
    "betting": betting,
}


# --- samples --------------------------------------------------------------------------------------


def cells() -> Iterator[tuple[int, str, str, float]]:
    """List how many episodes there are, what successes and failures score, and how many fail."""
    yield from product(SIZES, SUCCESSES, FAILURES, RATES)


def drawn(rng: Rng, samples: int, n: int, success: str, failure: str, rate: Any) -> Sample:
    """Draw samples of scores, shape ``(n, samples)``, and give their true mean."""
    (good, high), (bad, low) = SUCCESSES[success], FAILURES[failure]
    shape = (n, samples)
    fails = rng.random(shape) < rate
    truth = high + float(np.mean(rate)) * (low - high)
    return np.where(fails, bad(rng, shape), good(rng, shape)), truth


def covered(ends: Ends, truth: float) -> dict[str, float]:
    """Compute which share of intervals contains the truth, and their mean width."""
    low, high = ends  # nan contains nothing
    inside = (low <= truth + 1e-12) & (high >= truth - 1e-12)
    return {"covers": float(inside.mean()), "width": float(np.nan_to_num(high - low).mean())}


def least_of_rates(method: Callable[[Floats, Rng], Ends], rng: Rng) -> float:
    """Compute exactly how rarely intervals of 0 and 1 contain the truth at the worst rate."""
    from scipy.stats import binom

    near = np.geomspace(1e-4, 0.5, 2000)
    rates, worst = np.concatenate([near, 1.0 - near]), 1.0
    for n in SIZES:
        hits = np.arange(n + 1)
        scores = (np.arange(n)[:, None] < hits).astype(float)
        low, high = method(rng.permuted(scores, axis=0), rng)
        inside = (low <= rates[:, None] + 1e-12) & (high >= rates[:, None] - 1e-12)
        worst = min(worst, float((binom.pmf(hits, n, rates[:, None]) * inside).sum(axis=1).min()))
    return worst


def clustered(rng: Rng, samples: int, n: int, share: float) -> Sample:
    """Draw scores 1 and 0 of four seeds whose rates of failure differ by a share of the variance.

    The mean rate is 0.1.
    """
    if share == 0.0:
        return drawn(rng, samples, n, "1", "0", 0.1)
    weight = 1.0 / share - 1.0
    rates = rng.beta(0.1 * weight, 0.9 * weight, (4, samples)).repeat(n // 4, axis=0)
    return drawn(rng, samples, n, "1", "0", rates)[0], 0.9


def differences(rng: Rng, samples: int, n: int, success: str, rates: tuple[float, float]) -> Sample:
    """Draw differences of two agents; half of the episodes are hard for both or for neither."""
    (good, high), shape = SUCCESSES[success], (n, samples)
    luck = rng.random(shape)
    other = np.where(rng.random(shape) < 0.5, luck, rng.random(shape))
    one, two = (
        np.where(u < p, 0.0, good(rng, shape)) for u, p in zip((luck, other), rates, strict=True)
    )
    return one - two, high * (rates[1] - rates[0])


PAIRS = ((0.0, 0.0), (0.01, 0.01), (0.01, 0.05), (0.05, 0.2), (0.2, 0.5))
NUMBERS: Mapping[str, tuple[Callable[[Rng, Any], Floats], float]] = {
    "normal": (lambda rng, shape: rng.normal(size=shape), 0.0),
    "exponential": (lambda rng, shape: rng.exponential(size=shape), 1.0),
    "lognormal": (lambda rng, shape: rng.lognormal(size=shape), math.exp(0.5)),
    "normal, -10 in a tenth": (
        lambda rng, shape: np.where(rng.random(shape) < 0.1, -10.0, rng.normal(size=shape)), -1.0
    ),
}  # fmt: skip


# --- results --------------------------------------------------------------------------------------


def document(samples: int) -> dict[str, Any]:
    """Measure every method in every cell, and the chosen one on other kinds of scores.

    Args:
        samples: Samples of each cell. Betting gets a tenth of them.

    Returns:
        Tables of rows with the coverage and the mean width of intervals.
    """
    scores: list[dict[str, Any]] = []
    for number, cell in enumerate(cells()):
        rng = np.random.default_rng([7, number])
        drawn_scores, truth = drawn(rng, samples, *cell)
        for name, method in METHODS.items():
            some = drawn_scores[:, : samples // 10] if method is betting else drawn_scores
            row = dict(zip(("episodes", "success", "failure", "rate"), cell, strict=True))
            scores.append({"method": name, **row, **covered(method(some, rng), truth)})
    methods = []
    for name, method in METHODS.items():
        rows = [row for row in scores if row["method"] == name]
        methods.append(
            {
                "method": name,
                "least coverage": min(row["covers"] for row in rows),
                f"cells below {LEAST}": sum(row["covers"] < LEAST for row in rows),
                "least of 0/1": least_of_rates(method, np.random.default_rng(7)),
                "mean width": float(np.mean([row["width"] for row in rows])),
            }
        )
    rng = np.random.default_rng(8)

    def chosen(sample: Sample, bounds: Any = (0.0, 1.0)) -> dict[str, float]:
        return covered(student(sample[0], bounds, LEVEL), sample[1])

    paired = [
        {"episodes": n, "success": good, "rates": pair}
        | chosen(differences(rng, samples, n, good, pair), (-1.0, 1.0))
        for n, good, pair in product(SIZES, SUCCESSES, PAIRS)
    ]
    unbounded = [
        {"numbers": name, "episodes": n} | chosen((draw(rng, (n, samples)), truth), None)
        for (name, (draw, truth)), n in product(NUMBERS.items(), SIZES)
    ]
    seeds = [
        {"share": share, "episodes": n} | chosen(clustered(rng, samples, n, share))
        for share, n in product((0.0, 0.02, 0.1), SIZES)
    ]
    return {
        "samples": samples,
        "versions": versions(),
        "results": {
            "methods": methods,
            "scores": scores,
            "paired differences": paired,
            "numbers without bounds": unbounded,
            "seeds of draws": seeds,
        },
    }


def main() -> None:
    """Measure, and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--samples", type=int, default=4000, help="of each cell")
    parser.add_argument("--out", type=Path, default=FILE, help="file of the results")
    asked = parser.parse_args()
    write_whole(asked.out, (as_json(document(asked.samples)) + "\n").encode())
    print(f"written: {asked.out}")


if __name__ == "__main__":
    main()
