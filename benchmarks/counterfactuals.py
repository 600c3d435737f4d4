"""Coverage of the intervals of counterfactuals of observed units, by distance of the evidence.

A hidden cause x has one or two effects that are observed 0 to 6 standard deviations from their
means. Its exact posterior is known from a dense grid. Printed are the probability, under it, of
what ``interval`` calls 95 %, as the mean over the seeds and for the worst of them, and for how many
seeds this was below 90 % without a warning.

Run ``python benchmarks/counterfactuals.py --seeds 300``.
"""

from __future__ import annotations

import argparse
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from scm_world import SCM
from scm_world.variables import Box, Continuous, Derived, Exogenous, Linear, Normal

GRID = np.linspace(-30.0, 30.0, 2_000_001)
FAR = range(7)
LOW = 0.9
"""A mass of the interval that is too low for 95 %."""

normal = stats.norm.logpdf


class Case(NamedTuple):
    """A model of x and its effects, and what is known of its posterior.

    Attributes:
        root: Distribution of x.
        log_root: Its log density.
        effects: For each effect its function of x, its noise, and the log density of the noise.
        seen: The observed effects, so many standard deviations from their means.
    """

    root: Any
    log_root: Callable[[Any], Any]
    effects: Sequence[tuple[Callable[[Any], Any], Any, Callable[[Any], Any]]]
    seen: Callable[[int], list[float]]


def case(
    seen: Callable[[int], float], function: Any, noise: Any = None, log_noise: Any = normal
) -> Case:
    """Return a case of one effect of a normal cause."""
    effect = function, noise or Normal(), log_noise
    return Case(Normal(), normal, [effect], lambda far: [seen(far)])


def same(x: Any) -> Any:
    """Return x."""
    return x


def cubic(x: Any) -> Any:
    """Return a function whose slope grows."""
    return x + x**3 / 3.0


laplace, uniform = stats.laplace.logpdf, stats.uniform(-1.0, 2.0).logpdf
students = stats.t(3.0).logpdf
TWO = [
    (same, Normal(), normal),
    (lambda x: 2.0 * x, Normal(0.0, 0.5), lambda e: normal(e, 0.0, 0.5)),
]
CASES = {
    "x + e": case(lambda far: far * math.sqrt(2.0), same),
    "x + 0.1 e": case(
        lambda far: far * math.sqrt(1.01),
        same,
        Normal(0.0, 0.1),
        lambda e: normal(e, 0.0, 0.1),
    ),
    "x + e and 2 x + 0.5 e": Case(
        Normal(), normal, TWO, lambda far: [far * math.sqrt(2.0), far * math.sqrt(4.25)]
    ),
    "the same, with opposite signs": Case(
        Normal(), normal, TWO, lambda far: [far * math.sqrt(2.0), -far * math.sqrt(4.25)]
    ),
    "x + x³/3 + e": case(cubic, cubic),
    "exp x + e": case(math.exp, np.exp),
    "x² + e, two modes": case(lambda far: far**2, np.square),
    "x + e, x Laplace": Case(
        Continuous("laplace"),
        laplace,
        [(same, Normal(), normal)],
        lambda far: [far * math.sqrt(3.0)],
    ),
    "x + e, e Laplace": case(
        lambda far: far * math.sqrt(3.0), same, Continuous("laplace"), laplace
    ),
    "x + e, x Student, 3 degrees": Case(
        Continuous("t", df=3.0), students, [(same, Normal(), normal)], lambda far: [2.0 * far]
    ),
    "x + e, e uniform in ±1": case(
        lambda far: far * math.sqrt(4.0 / 3.0), same, Box(-1.0, 1.0), uniform
    ),
}


def model_of(chosen: Case) -> SCM:
    """Return the model of a case, with effects y0, y1 and so on."""
    effects = [
        Derived(
            name=f"y{place}",
            parents=("x",),
            mechanism=Linear(weights=(1.0,)) if function is same else _added(function),
            noise=noise,
            inverse_noise=None if function is same else "additive",
        )
        for place, (function, noise, _) in enumerate(chosen.effects)
    ]
    return SCM([Exogenous(name="x", distribution=chosen.root), *effects])


def _added(function: Callable[[Any], Any]) -> Callable[..., Any]:
    return lambda x, noise: function(x) + noise


def masses(chosen: Case, far: int, n: int, seeds: int) -> tuple[list[float], list[float], int, int]:
    """Return the mass of each interval, effective numbers, warnings, and low masses without."""
    model, seen = model_of(chosen), chosen.seen(far)
    with np.errstate(divide="ignore", over="ignore"):
        log = chosen.log_root(GRID)
        for value, (function, _, log_noise) in zip(seen, chosen.effects, strict=True):
            log = log + log_noise(value - function(GRID))
    below = np.cumsum(np.exp(log - log.max()))
    observed = {f"y{place}": value for place, value in enumerate(seen)}
    found, effective, warned, silent = list[float](), list[float](), 0, 0
    for seed in range(seeds):
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            answer = model.counterfactual(observed, do={}, n=n, seed=seed)
        low, high = np.interp(answer.interval("x"), GRID, below / below[-1])
        found.append(float(high - low))
        effective.append(float(answer.effective[0]))
        warned += bool(said)
        silent += found[-1] < LOW and not said
    return found, effective, warned, silent


def main() -> None:
    """Print a table in Markdown, a row for each model."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=300)
    parser.add_argument("--n", type=int, default=1000)
    parser.add_argument("--cases", nargs="*", default=list(CASES))
    given = parser.parse_args()
    print("| observed |", " | ".join(map(str, FAR)), "| warnings | below 90 %, no warning |")
    print("| --- |" + " --- |" * (len(FAR) + 2))
    for name in given.cases:
        cells, warned, silent = [], 0, 0
        for far in FAR:
            mass, _, more, low = masses(CASES[name], far, given.n, given.seeds)
            cells.append(f"{np.mean(mass):.3f} ({min(mass):.2f})")
            warned, silent = warned + more, silent + low
        print(f"| {name} |", " | ".join(cells), f"| {warned} | {silent} |", flush=True)


if __name__ == "__main__":
    main()
