"""Effects with confidence: paired on common noise, or of different units."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any, final

import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import Floats
from scm_world.errors import UnknownOption
from scm_world.queries.equations import Equations, System
from scm_world.queries.outcomes import as_outcome, label
from scm_world.queries.plans import Plan
from scm_world.queries.progress import Progress, part
from scm_world.queries.samples import Samples, Setting, sample
from scm_world.queries.twins import AnyTwins

CONFIDENCE = 0.95


def t_quantile(probability: float, degrees: int) -> float:
    """Give a quantile of Student's t distribution, to 1 % at 3 degrees and 0.5 % above.

    Args:
        probability: Between 0 and 1.
        degrees: Of freedom.

    Source:
        Abramowitz and Stegun, *Handbook of mathematical functions*, 26.7.5.

    Example:
        >>> round(t_quantile(0.975, 10), 2), round(t_quantile(0.975, 1000), 2)
        (2.23, 1.96)
    """
    if degrees == 1:
        return math.tan(math.pi * (probability - 0.5))
    if degrees == 2:
        return (2.0 * probability - 1.0) / math.sqrt(2.0 * probability * (1.0 - probability))
    z = NormalDist().inv_cdf(probability)
    terms = (
        (z**3 + z) / 4.0,
        (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / 96.0,
        (3.0 * z**7 + 19.0 * z**5 + 17.0 * z**3 - 15.0 * z) / 384.0,
        (79.0 * z**9 + 776.0 * z**7 + 1482.0 * z**5 - 1920.0 * z**3 - 945.0 * z) / 92160.0,
    )
    return float(z + sum(term / degrees ** (k + 1) for k, term in enumerate(terms)))


@final
@dataclass(frozen=True)
class Effect:
    """How much an outcome differs between two interventions.

    Attributes:
        outcome: What was asked for.
        mean: Of the difference, shape of the outcome.
        low: Lower end of the confidence interval.
        high: Upper end.
        n: How many units; paired, each of them lived through both.
        paired: Whether both interventions met the same noise.
        variance_ratio: Variance of an unpaired difference over that of a paired one: so many
            times fewer units give an interval of the same length.
        treated: Mean under ``do``.
        control: Mean under ``versus``.
        rollouts: Episodes that were simulated.
        seed: Of the noise.
        engine: Name and version.
        do: What was done.
        versus: What it is held against.
    """

    outcome: str
    mean: Floats
    low: Floats
    high: Floats
    n: int
    paired: bool
    variance_ratio: Floats
    treated: Floats
    control: Floats
    rollouts: int
    seed: int
    engine: str
    do: Plan
    versus: Plan

    @property
    def excludes_zero(self) -> bool:
        """Whether an effect is beyond doubt, in some component."""
        return bool(np.any((self.low > 0.0) | (self.high < 0.0)))

    def as_dict(self) -> dict[str, Any]:
        """Write the result as plain data; functions in plans are an error, see ``Plan``."""
        numbers = ("mean", "low", "high", "variance_ratio", "treated", "control")
        found = {name: np.asarray(getattr(self, name)).tolist() for name in numbers}
        found["variance_ratio"] = _finite(found["variance_ratio"])
        return {
            "format": "scm_world/effect/1",
            "outcome": self.outcome,
            **found,
            "confidence": CONFIDENCE,
            "n": self.n,
            "paired": self.paired,
            "rollouts": self.rollouts,
            "seed": self.seed,
            "engine": self.engine,
            "do": self.do.as_dict(),
            "versus": self.versus.as_dict(),
        }

    def to_json(self) -> str:
        """Write the result as JSON."""
        return json.dumps(self.as_dict(), indent=1, allow_nan=False)

    def __str__(self) -> str:
        how = "paired" if self.paired else "unpaired"
        ratio = _show(self.variance_ratio)
        return (
            f"{self.outcome}: {_show(self.mean)} [{_show(self.low)}, {_show(self.high)}], "
            f"n = {self.n} {how}, variance unpaired : paired {ratio}"
        )


def _finite(value: Any) -> Any:
    if isinstance(value, list):
        return [_finite(part) for part in value]
    return value if math.isfinite(value) else None


def _show(value: Floats) -> str:
    return np.array2string(np.asarray(value), precision=4, separator=", ")


def difference(
    treated: Floats, control: Floats, *, paired: bool
) -> tuple[Floats, Floats, Floats, Floats]:
    """Estimate the mean difference of two samples, with its interval.

    Args:
        treated: Shape (n, ...).
        control: Shape (n, ...); row i is the same unit where they are paired.
        paired: Whether they are.

    Returns:
        Mean, lower and upper end, and the ratio of the variances unpaired : paired.
    """
    n = len(treated)
    apart = treated.var(axis=0, ddof=1) + control.var(axis=0, ddof=1)
    together = (treated - control).var(axis=0, ddof=1)
    mean = treated.mean(axis=0) - control.mean(axis=0)
    spread = together if paired else apart
    degrees = n - 1 if paired else 2 * n - 2
    reach = t_quantile(0.5 + 0.5 * CONFIDENCE, degrees) * np.sqrt(spread / n)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(together > 0.0, apart / together, np.where(apart > 0.0, np.inf, 1.0))
    return mean, mean - reach, mean + reach, ratio


def effect(
    twins: AnyTwins,
    world: System,
    outcome: Any,
    *,
    do: Mapping[str, Any],
    versus: Mapping[str, Any] | None,
    n: int,
    paired: bool,
    setting: Setting,
    progress: Progress | None = None,
) -> Effect:
    """Estimate an effect; see ``World.effect``."""
    treated, control = _both(twins, world, (outcome,), do, versus, n, paired, setting, progress)
    one, other = (next(iter(samples.values())) for samples in (treated, control))
    return _effect(world, as_outcome(outcome), one, other, do, versus, paired, setting)


def _both(
    twins: AnyTwins,
    world: System,
    outcomes: Sequence[Any],
    do: Mapping[str, Any],
    versus: Mapping[str, Any] | None,
    n: int,
    paired: bool,
    setting: Setting,
    progress: Progress | None,
) -> tuple[Samples, Samples]:
    count = whole_number("n", n, least=2)

    treated = sample(
        twins,
        world,
        do,
        count,
        outcomes=outcomes,
        setting=setting,
        progress=part(progress, 0, 2 * count),
    )
    control = sample(
        twins,
        world,
        versus,
        count,
        outcomes=outcomes,
        setting=setting,
        first=0 if paired else count,
        progress=part(progress, count, 2 * count),
    )
    return treated, control


def _effect(
    world: System,
    outcome: Any,
    treated: Floats,
    control: Floats,
    do: Mapping[str, Any],
    versus: Mapping[str, Any] | None,
    paired: bool,
    setting: Setting,
) -> Effect:
    mean, low, high, ratio = difference(treated, control, paired=paired)
    return Effect(
        outcome=label(outcome),
        mean=mean,
        low=low,
        high=high,
        n=len(treated),
        paired=paired,
        variance_ratio=ratio if paired else np.ones_like(np.asarray(mean)),
        treated=treated.mean(axis=0),
        control=control.mean(axis=0),
        rollouts=2 * len(treated),
        seed=setting.seed,
        engine="equations" if isinstance(world, Equations) else world.backend.name,
        do=Plan(do),
        versus=Plan(versus),
    )


def effect_over(
    twins: AnyTwins,
    world: System,
    outcome: Any,
    *,
    plans: Sequence[Plan],
    n: int,
    setting: Setting,
    progress: Progress | None = None,
) -> tuple[Effect, ...]:
    """Estimate the paired effects of each plan against the first one."""
    count, wanted = whole_number("n", n, least=2), as_outcome(outcome)
    columns = []
    for index, plan in enumerate(plans):
        told = part(progress, index * count, len(plans) * count)
        found = sample(
            twins, world, plan, count, outcomes=(wanted,), setting=setting, progress=told
        )
        columns.append(next(iter(found.values())))
    return tuple(
        _effect(world, wanted, values, columns[0], plan, plans[0], True, setting)
        for plan, values in zip(plans[1:], columns[1:], strict=True)
    )


def effect_by(
    twins: AnyTwins,
    world: System,
    outcome: Any,
    *,
    do: Mapping[str, Any],
    versus: Mapping[str, Any] | None,
    by: Any,
    bins: int,
    n: int,
    setting: Setting,
    progress: Progress | None = None,
) -> tuple[tuple[tuple[float, float], Effect], ...]:
    """Estimate paired effects among units of equal size by a covariate.

    The covariate is read off the world without the treatment, so that the treatment cannot
    change who is compared.

    Returns:
        For each bin its ends and the effect within it.
    """
    count = whole_number("n", n, least=2 * whole_number("bins", bins, least=1))
    wanted, covariate = as_outcome(outcome), as_outcome(by)
    both = (wanted, covariate)
    treated, control = _both(twins, world, both, do, versus, count, True, setting, progress)
    (one, _), (other, place) = (list(samples.values()) for samples in (treated, control))
    if place.ndim != 1:
        raise UnknownOption(
            "by", by, ("one number for each unit, such as Outcome(name, 'first', 0)",)
        )
    order = np.argsort(place, kind="stable")
    found = []
    for group in np.array_split(order, bins):
        ends = float(place[group].min()), float(place[group].max())
        found.append(
            (ends, _effect(world, wanted, one[group], other[group], do, versus, True, setting))
        )
    return tuple(found)


__all__ = ["Effect", "difference", "effect", "effect_by", "effect_over", "t_quantile"]
