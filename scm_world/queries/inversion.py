"""Inference of the noise of a variable from its value and its causes.

``inverse_noise`` of the variable declares the inverse; that of ``Linear``, ``Table`` and discrete
noise is known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.errors import ModelError
from scm_world.variables import (
    Box,
    Categories,
    Continuous,
    Discrete,
    Integers,
    Linear,
    Normal,
    Table,
)

OUTER = 4.0 ** np.arange(13)
"""Range of the search around the median noise, in distances to the 0.1 % and 99.9 % quantiles."""

HALVINGS = 64
MANY = 4096  # largest number of values of discrete noise that are enumerated

Gives = Callable[[Value], Value]
"""Function from noise to values, shape (units, *shape); NaN where it is undefined."""


class Found(NamedTuple):
    """Noise that reproduces an observed value, if possible."""

    noise: Value  # shape (units, *shape)
    log_density: Floats  # of the observation given its causes, shape (units, …)
    drawn: bool = False  # whether the noise was drawn from several possible values


def noise_given(
    variable: Any,
    source: Any,
    value: Value,
    parents: list[Value],
    apply: Callable[..., Value],
    shares: Floats,
) -> Found | None:
    """Return the noise of a variable for a value and its causes; None if it must be drawn."""
    how, mechanism, own = variable.noise_inverse, variable.equation, variable.shape_of_noise
    function = mechanism.bind()

    def gives(noise: Value) -> Value:
        return apply(function, parents, {"noise": noise}, variable.shape)

    if how is None and isinstance(mechanism, Table):  # uniform, within the range of the category
        chances = mechanism.row(*parents)
        hit = np.asarray(mechanism.values or range(mechanism.shape[-1])) == value[..., None]
        width = (hit * chances).sum(axis=-1)
        start = (hit * (np.cumsum(chances, axis=-1) - chances)).sum(axis=-1)
        several = bool(((width > 0.0) & (width < 1.0)).any())
        return Found(start + shares * width, _log(width), several)
    density = density_of(source, own, {})
    if how == "additive" or (how is None and isinstance(mechanism, Linear)):
        noise = value - gives(np.zeros(np.shape(value)))
        return Found(noise, density.log_density(noise))
    if how not in (None, "monotone"):
        noise = apply(how.bind(), [value, *parents], {}, own)
        return Found(noise, density.log_density(noise) - density.log_slope(gives, noise))
    if how == "monotone" and density.support is None:
        return _monotone(density, value, gives, shares, whole=variable.dtype != "real")
    if density.support is None or own != variable.shape or len(density.support) > MANY:
        return None
    same = np.stack([gives(np.full(np.shape(value), each)) == value for each in density.support])
    mass = same * density.chances.reshape(-1, *(1,) * np.ndim(value))
    reached = np.cumsum(mass, axis=0) > shares * mass.sum(axis=0)
    noise = density.support[reached.argmax(axis=0)]
    return Found(noise, _log(mass.sum(axis=0)), bool(((mass > 0.0).sum(axis=0) > 1).any()))


def _monotone(
    density: Density, value: Value, gives: Gives, shares: Floats, *, whole: bool
) -> Found:
    """Find the range of noise that gives the value, by bisection.

    A single point is weighed by its density, divided by the slope; a range (integers, thresholds,
    ceilings) by its probability, and the noise is drawn from the range.
    """
    of = density.frozen
    centre, support = of.ppf(0.5), of.support()
    below, above = (of.ppf(share) - centre for share in (0.001, 0.999))
    ladder = [*(centre + below * OUTER[::-1]), centre, *(centre + above * OUTER)]
    points = np.stack([np.broadcast_to(np.clip(p, *support), np.shape(value)) for p in ladder])
    given = np.stack([gives(point) for point in points])
    first, last = (
        g[(~np.isnan(g)).argmax(axis=0), *np.indices(g.shape[1:])] for g in (given, given[::-1])
    )
    rising = np.where(first < last, 1.0, -1.0)

    def over(noise: Value, found: Value) -> Floats:
        """Return -1 for noise below the range, 0 within, and 1 above."""
        found = np.sign((np.rint(found) if whole else found) - value) * rising
        outside = np.where(noise < centre, -1.0, 1.0)  # undefined values lie outside
        return np.asarray(np.where(np.isnan(found), outside, found))

    signs = np.stack([over(point, found) for point, found in zip(points, given, strict=True)])
    ends: list[Value] = []
    for limit in (-0.5, 0.5):  # lower and upper end of the range
        at = (signs < limit).sum(axis=0)
        low, high = (
            points[np.clip(place, 0, len(points) - 1), *np.indices(place.shape)]
            for place in (at - 1, at)
        )
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            short = over(middle, gives(middle)) < limit
            low, high = np.where(short, middle, low), np.where(short, high, middle)
        ends.append(high if limit < 0.0 else low)
    low, high = ends
    root, wide = 0.5 * (low + high), high - low > 1e-9 * (above - below + np.abs(low))
    log: Floats = density.log_density(root) - density.log_slope(gives, root)
    if not wide.any():
        return Found(root, log)
    mass = np.maximum(of.cdf(high) - of.cdf(low), of.sf(low) - of.sf(high))  # exact in both tails
    left = of.ppf(of.cdf(low) + shares * (of.cdf(high) - of.cdf(low)))
    right = of.isf(of.sf(low) + shares * (of.sf(high) - of.sf(low)))
    within = np.clip(np.where(low > centre, right, left), low, high)
    return Found(np.where(wide, within, root), np.where(wide, _log(mass), log), drawn=True)


def proposed(source: object, shape: tuple[int, ...], shares: Floats) -> Found | None:
    """Return uniform draws of unobserved discrete noise, with weights; None if continuous.

    Uniform draws contain rare values: a disease of one in a million may be the actual cause.
    """
    if not isinstance(source, Discrete | Categories | Integers):
        return None
    density = density_of(source, shape, {})
    place = (shares * len(density.support)).astype(int)
    return Found(density.support[place], _log(density.chances[place] * len(density.support)))


def _log(share: Floats) -> Floats:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.log(share))


@final
@dataclass(frozen=True)
class Density:
    """A distribution with independent components: a continuous or a discrete one."""

    frozen: Any = None  # a continuous distribution of scipy
    support: Any = None  # the values of a discrete one
    chances: Any = None  # their probabilities

    def log_density(self, value: Value) -> Floats:
        """Return the logarithm of the density or probability."""
        if self.support is None:
            return np.asarray(self.frozen.logpdf(value), dtype=float)
        near = 1e-9 * (np.abs(self.support).max() or 1.0)
        hit = np.abs(np.asarray(value)[..., None] - self.support) <= near
        return _log((hit * self.chances).sum(axis=-1))

    def log_slope(self, gives: Gives, noise: Value) -> Any:
        """Return ln |d value / d noise|; 0 where it is unknown."""
        step = 1e-6 * (1.0 + np.abs(noise))
        rise = gives(noise + step) - gives(noise - step)
        if self.support is not None or np.shape(rise) != np.shape(noise):
            return 0.0
        log = _log(np.abs(rise) / (2.0 * step))
        return np.where(np.isfinite(log), log, 0.0)


def density_of(source: object, shape: tuple[int, ...], values: Values) -> Density:
    """Return the density of a distribution; refuse distributions of unknown density."""
    from scipy import stats

    match source:
        case Normal(mean=mean, std=std) if std > 0.0:
            return Density(stats.norm(mean, std))
        case Normal(mean=mean):
            return Density(None, np.array([mean]), np.ones(1))
        case Continuous():
            return Density(source.frozen)
        case Box():
            low, high = (np.asarray(end) for end in source.bounds(shape, values))
            if (high > low).all():
                return Density(stats.uniform(low, high - low))
        case Discrete():
            return Density(None, np.asarray(source.values, dtype=float), source.chances)
        case Categories(members=members):
            return density_of(Discrete(members), shape, values)
        case Integers(low=low, high=high):
            return density_of(Discrete(range(low, high + 1)), shape, values)
    raise ModelError([f"the density of {source!r} is not known, so it cannot be abducted"])
