"""How often intervals contain the truth: every kind of interval that the package gives.

::

    python -m benchmarks.coverage                      # 1,000 samples a row, a quarter of an hour
    python -m benchmarks.coverage --samples 100 --out DIR
    python -m benchmarks.coverage --parts "Over episodes"

Intervals of 95 % are computed for samples whose truth is known. The criterion was fixed before any
figure of this table was seen: an interval holds if it contains the truth in at least 93 % of the
samples, or, where a sample can show that it does not, if at most 5 % of the samples miss the truth
without a word of caution. Rows that fail stay: they are where an interval should not be trusted.
Writes ``coverage.json``; ``python -m benchmarks.figures`` draws it.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

from benchmarks import as_json
from scm_world._types import Floats
from scm_world.evaluation.statistics import (
    METRICS,
    aggregate,
    difference_interval,
    find_causes,
    mean_interval,
    performance_profile,
    unpaired_interval,
)
from scm_world.evaluation.statistics.intervals import metrics_of
from scm_world.queries.experiments.versions import versions
from scm_world.queries.samples import caution, difference
from scm_world.runs.files import write_whole

HERE = Path(__file__).parent
LEAST, MOST_UNSEEN = 0.93, 0.05
PROTOCOLS = 12
LARGE = 200_000  # units from which a truth without a formula is computed

Rng = np.random.Generator
Row = tuple[str, str, int, Callable[[Rng], tuple[bool, bool]]]
"""What is estimated, from what, how many units, and a sample: whether it is hit, and cautioned."""


def sigmoid(x: Any) -> Any:
    """Squash numbers into (0, 1)."""
    return 1.0 / (1.0 + np.exp(-x))


def hit(interval: Any, truth: float) -> tuple[bool, bool]:
    """Whether an ``Interval`` contains the truth, and whether its ends are unknown."""
    return interval.low <= truth <= interval.high, math.isnan(interval.low)


# --- scores of training runs that play the same protocols -----------------------------------------

EASE = np.linspace(1.5, -2.5, PROTOCOLS)


def ordinary(rng: Rng, runs: int) -> Floats:
    """Returns: runs and protocols add up, with noise."""
    run, rest = rng.normal(size=(runs, 1)), rng.normal(size=(runs, PROTOCOLS))
    return 5.0 + run + 0.5 * rest + EASE


def rates(rng: Rng, runs: int) -> Floats:
    """Success rates of 200 episodes; protocols from easy to hard."""
    logit = 0.5 * rng.normal(size=(runs, 1)) + 0.3 * rng.normal(size=(runs, PROTOCOLS)) + EASE
    found: Floats = rng.binomial(200, sigmoid(logit)) / 200.0
    return found


def near_one(rng: Rng, runs: int) -> Floats:
    """Success rates of 50 episodes, most of them near 1."""
    logit = 3.0 + 0.7 * rng.normal(size=(runs, 1)) + 0.3 * rng.normal(size=(runs, PROTOCOLS))
    found: Floats = rng.binomial(50, sigmoid(logit)) / 50.0
    return found


def learns_or_fails(rng: Rng, runs: int) -> Floats:
    """Four of five runs reach 0.9, the others 0.2, in all protocols."""
    level = np.where(rng.random((runs, 1)) < 0.8, 0.9, 0.2)
    return np.clip(level + 0.02 * rng.normal(size=(runs, PROTOCOLS)), 0.0, 1.0)


def heavy(rng: Rng, runs: int) -> Floats:
    """Returns with a lognormal effect of the run."""
    return np.exp(0.8 * rng.normal(size=(runs, 1)) + 0.2 * rng.normal(size=(runs, PROTOCOLS)))


def over_runs() -> Iterator[Row]:
    """Aggregates and profiles over 3, 10 and 20 runs."""
    rng = np.random.default_rng(1)
    for scores in (ordinary, rates, near_one, learns_or_fails, heavy):
        pooled = metrics_of(scores(rng, LARGE).T[:, None])
        truth = dict(zip(METRICS, pooled.tolist(), strict=True))
        for runs in (3, 10, 20):
            for metric in METRICS:

                def one(
                    rng: Rng, scores: Any = scores, runs: int = runs, name: str = metric,
                    truth: float = truth[metric],
                ) -> tuple[bool, bool]:  # fmt: skip
                    return hit(aggregate(scores(rng, runs))[name], truth)

                yield f"`aggregate`, {metric.replace('_', ' ')}", scores.__doc__ or "", runs, one
    high = float((rates(rng, LARGE) > 0.5).mean())
    for runs in (3, 10, 20):

        def band(rng: Rng, runs: int = runs) -> tuple[bool, bool]:
            profile = performance_profile(rates(rng, runs), [0.5])
            return bool(profile.low[0] <= high <= profile.high[0]), False

        yield "`performance_profile` at 0.5", rates.__doc__ or "", runs, band


# --- scores of episodes ---------------------------------------------------------------------------


def over_episodes() -> Iterator[Row]:
    """Means and differences over episodes."""
    kinds: dict[str, tuple[Callable[[Rng, int], Any], float]] = {
        "Fractions, beta(4, 1).": (lambda rng, n: rng.beta(4.0, 1.0, n), 0.8),
        "Fractions, beta(0.3, 0.1).": (lambda rng, n: rng.beta(0.3, 0.1, n), 0.75),
        "Successes, 0.95.": (lambda rng, n: (rng.random(n) < 0.95).astype(float), 0.95),
        "Returns, normal.": (lambda rng, n: rng.normal(3.0, 2.0, n), 3.0),
        "Returns, exponential.": (lambda rng, n: 2.0 + rng.exponential(1.0, n), 3.0),
    }
    for text, (draw, truth) in kinds.items():
        for n in (10, 25, 200):

            def mean(
                rng: Rng, draw: Any = draw, n: int = n, truth: float = truth
            ) -> tuple[bool, bool]:
                return hit(mean_interval(draw(rng, n)), truth)

            def paired(rng: Rng, draw: Any = draw, n: int = n) -> tuple[bool, bool]:
                luck = draw(rng, n)
                other = np.where(rng.random(n) < 0.5, luck, draw(rng, n))
                return hit(difference_interval(luck, other), 0.0)

            def apart(rng: Rng, draw: Any = draw, n: int = n) -> tuple[bool, bool]:
                return hit(unpaired_interval(draw(rng, n), draw(rng, n)), 0.0)

            yield "`mean_interval`", text, n, mean
            yield "`difference_interval`, half of the episodes alike", text, n, paired
            yield "`unpaired_interval`", text, n, apart
    for n in (50, 200):

        def share(rng: Rng, n: int = n) -> tuple[bool, bool]:
            x, other = rng.random((2, n))
            score = x + math.sqrt(1.0 / 12.0) * rng.normal(size=n)  # half of the variance
            found = find_causes({"x": x, "other": other}, score, permutations=1).causes[0]
            return hit(found.share, 0.5)

        yield "share of `find_causes`", "A linear cause of half of the variance.", n, share


def over_rare_failures() -> Iterator[Row]:
    """Aggregates over the episodes of one run, and unpaired differences."""
    rates = np.linspace(0.0, 0.2, PROTOCOLS)[:, None]

    def played(rng: Rng, n: int) -> Floats:
        shape = (PROTOCOLS, n)
        return np.where(rng.random(shape) < rates, 0.0, rng.beta(95.0, 5.0, shape))

    text = "Fractions, beta(95, 5), or 0 in none to a fifth of the episodes of a protocol."
    pooled = metrics_of(played(np.random.default_rng(2), LARGE)[:, None])
    for n in (20, 40, 200):
        for metric, truth in zip(METRICS, pooled.tolist(), strict=True):

            def one(
                rng: Rng, n: int = n, name: str = metric, truth: float = truth
            ) -> tuple[bool, bool]:
                return hit(aggregate(played(rng, n)[None], over="episodes")[name], truth)

            yield f"`aggregate` over episodes, {metric.replace('_', ' ')}", text, n, one
        for number in (0, 3, 11):

            def apart(rng: Rng, n: int = n, number: int = number) -> tuple[bool, bool]:
                scores = [played(rng, n)[number] for _ in range(2)]
                return hit(unpaired_interval(*scores), 0.0)

            kind = f"Fractions, beta(95, 5), or 0 in {float(rates[number, 0]):.2f} of the episodes."
            yield "`unpaired_interval`", kind, n, apart


# --- effects --------------------------------------------------------------------------------------


def effects() -> Iterator[Row]:
    """Average treatment effects, paired and unpaired."""
    kinds: dict[str, tuple[Callable[[Rng, int], Any], float]] = {
        "Normal effects.": (lambda rng, n: rng.normal(1.0, 1.0, n), 1.0),
        "Exponential effects.": (lambda rng, n: rng.exponential(1.0, n), 1.0),
        "Lognormal effects.": (lambda rng, n: rng.lognormal(0.0, 1.0, n), math.exp(0.5)),
        "One unit in 5 responds.": (lambda rng, n: (rng.random(n) < 0.2) * 1.0, 0.2),
        "One unit in 20 responds.": (lambda rng, n: (rng.random(n) < 0.05) * 1.0, 0.05),
    }
    for text, (draw, truth) in kinds.items():
        for n in (10, 30, 100, 500):
            for paired in (True, False):

                def one(
                    rng: Rng, draw: Any = draw, n: int = n, truth: float = truth,
                    paired: bool = paired,
                ) -> tuple[bool, bool]:  # fmt: skip
                    control = rng.normal(size=n)
                    treated = (control if paired else rng.normal(size=n)) + draw(rng, n)
                    _, low, high, _ = difference(treated, control, paired=paired)
                    said = caution(treated, control, paired=paired)
                    return bool(low <= truth <= high), bool(said)

                yield f"`effect`, {'paired' if paired else 'unpaired'}", text, n, one


PARTS: Mapping[str, tuple[int, Callable[[], Iterable[Row]]]] = {
    "Over training runs": (0, over_runs),
    "Over episodes": (72, over_episodes),
    "Effects of interventions": (119, effects),
    "Over episodes that may fail": (159, over_rare_failures),
}
"""The rows of each part, and the number of the seed of its first row."""


def measure(samples: int, parts: Sequence[str]) -> dict[str, list[dict[str, Any]]]:
    """Draw the samples of all rows of some parts, each row from a seed of its own."""
    found: dict[str, list[dict[str, Any]]] = {part: [] for part in PARTS if part in parts}
    asked = []
    for part in found:
        first, made = PARTS[part]
        asked += [(seed, part, row) for seed, row in enumerate(made(), first)]
    for seed, part, (what, of, n, one) in track(asked, "coverage"):
        rng = np.random.default_rng([7, seed])
        hits = np.array([one(rng) for _ in range(samples)])
        unseen = float((~hits[:, 0] & ~hits[:, 1]).mean())
        covered, said = hits.mean(axis=0).tolist()
        found[part].append(
            {
                "interval": what, "of": of.rstrip("."), "units": n, "samples": samples,
                "covers": covered, "cautioned": said, "missed unseen": unseen,
                "holds": covered >= LEAST or (said > 0.0 and unseen <= MOST_UNSEEN),
            }
        )  # fmt: skip
    return found


def main() -> None:
    """Measure, and write."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.coverage",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--samples", type=int, default=1000, help="samples of each row")
    parser.add_argument("--out", type=Path, help="folder of the results; the repository by default")
    parser.add_argument(
        "--parts", nargs="+", choices=PARTS, default=PARTS, help="measured again; others are kept"
    )
    asked = parser.parse_args()
    found, about = {}, {"samples": asked.samples, "versions": versions()}
    results = HERE / "coverage.json"
    if {*asked.parts} != {*PARTS}:
        found = json.loads(results.read_text())["results"]
    new = measure(asked.samples, asked.parts)
    found = {part: new.get(part, found.get(part, [])) for part in PARTS}
    if asked.out is not None:
        asked.out.mkdir(parents=True, exist_ok=True)
        results = asked.out / "coverage.json"
    write_whole(results, (as_json({**about, "results": found}) + "\n").encode())


if __name__ == "__main__":
    main()
