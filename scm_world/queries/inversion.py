"""The noise of a variable, given its value and its causes.

Noise that is added is subtracted; a declared ``inverse_noise`` is used; a discrete noise is tried
value by value; all else is looked for between quantiles of the noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Protocol, final

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

_TAILS = np.array([1e-12, 1e-9, 1e-6])
SHARES = np.concatenate([_TAILS, np.linspace(1e-4, 1.0 - 1e-4, 257), 1.0 - _TAILS[::-1]])
"""Of the quantiles of the noise between which solutions are looked for."""

BEYOND = 12
"""How many points there are beyond the quantiles at each end, each four times as far out."""

JOINT = 4096
"""How many values a discrete noise may have in all."""

Found = tuple[Value, Floats, Value, bool]
"""Noise; log density of the observation given its causes, shape (units,), up to a summand that is
the same for all draws of a unit; for which units there is such noise; whether there are several."""


class Units(Protocol):
    """Observed units: how functions are called for all of them, and what counts as equal."""

    def apply(self, function: Any, parents: list[Value], noise: Mapping[str, Value]) -> Value:
        """Call a mechanism for all units."""

    def near(self, found: Value, wanted: Value, *, whole: bool = False) -> Value:
        """Tell which numbers are as observed; of all of a unit if ``whole``."""

    def uniforms(self, name: str, step: int, shape: tuple[int, ...]) -> Floats:
        """Give uniform numbers of each draw, shape (draws, *shape)."""


@final
class Inverse:
    """The noise of a variable, given its value and its causes.

    Args:
        units: That were observed.
        variable: One with noise.
        source: Distribution of its noise.
        parents: Values of its causes.
        step: Number of the instant.
        each: How many draws in a row have the same causes, so that they are inverted once.
    """

    def __init__(
        self,
        units: Units,
        variable: Any,
        source: Any,
        parents: list[Value],
        step: int,
        each: int,
    ) -> None:
        self._units, self._variable, self._each = units, variable, each
        self._parents = [parent[::each] for parent in parents]
        own = variable.noise_shape
        self._shape: tuple[int, ...] = variable.shape if own is None else own
        self._density = density_of(source, self._shape, {})
        self._function, self._step = variable.mechanism.bind(), step

    def _gives(self, noise: Value) -> Value:
        return self._units.apply(self._function, self._parents, {"noise": noise})

    def _tried(self, noise: Value) -> Value:
        """Call the function where it may not be defined; NaN where it is not."""
        try:
            with np.errstate(all="ignore"):
                return self._gives(noise)
        except (ArithmeticError, ValueError):  # ``math.log(0.0)``
            return np.full(np.shape(noise), np.nan)

    def _at(self, shape: tuple[int, ...], which: str = "abduction") -> Floats:
        return self._units.uniforms(f"{self._variable.name}|{which}", self._step, shape)

    def solve(self, value: Value, *, weigh: bool) -> Found:
        """Find the noise.

        Args:
            value: Of the variable, shape (units, *shape).
            weigh: Whether the density counts: some causes were drawn.

        Raises:
            ModelError: It cannot be inverted.
        """
        variable, alike = self._variable, self._shape == self._variable.shape
        value = value[:: self._each]
        if variable.inverse_noise is not None:
            inverse = variable.inverse_noise.bind()
            return self._unique(
                self._units.apply(inverse, [value, *self._parents], {}), value, weigh
            )
        if isinstance(variable.mechanism, Table):
            return self._in_table(value, variable.mechanism)
        if self._density.support is not None:
            return self._enumerated(value, alike=alike)
        if not alike:
            said = f"the noise of {variable.name!r} has shape {self._shape}, its value "
            said += f"{variable.shape}: give it inverse_noise, so that it follows from the value"
            raise ModelError([said])
        if variable.dtype == "real":
            still = np.asarray(self._tried(np.zeros(np.shape(value))), dtype=float)
            slope = 1.0 if isinstance(variable.mechanism, Linear) else self._slope(still)
            if np.all(slope):
                return self._unique(np.asarray((value - still) / slope), value, weigh)
        return self._ranges(value)

    def _slope(self, still: Value) -> Any:
        """Return by how much noise is multiplied before it is added; 0 where it is not.

        Args:
            still: The value without noise.
        """
        points = [np.broadcast_to(self._density.quantile(s), still.shape) for s in SHARES[::16]]
        with np.errstate(all="ignore"):
            moved = [self._gives(point) for point in points]
            if all(
                np.allclose(m, still + p, 1e-6, 1e-9) for m, p in zip(moved, points, strict=True)
            ):
                return 1.0
            slope = (moved[12] - moved[4]) / (points[12] - points[4])
            lines = (still + slope * point for point in points)
            affine = all(np.allclose(m, s, 1e-6, 1e-9) for m, s in zip(moved, lines, strict=True))
        return slope if affine else 0.0

    def _unique(self, noise: Value, value: Value, weigh: bool) -> Found:
        """Check a noise that is the only one that gives the value."""
        log = summed(self._density.log_density(noise))
        possible = np.isfinite(log) & self._units.near(self._gives(noise), value, whole=True)
        if not weigh:
            log = np.zeros(len(log))
        elif self._density.support is None:
            log = log - summed(self._log_slope(noise))
        log = np.where(possible, log, 0.0)
        return self._all(noise), self._all(log), self._all(possible), False

    def _all(self, values: Value) -> Value:
        """Repeat what is the same for several draws."""
        return np.repeat(values, self._each, axis=0)

    def _log_slope(self, noise: Value) -> Floats:
        """Differentiate by the noise, component by component; the logarithm of the size."""
        step = 1e-6 * (1.0 + np.abs(noise))
        with np.errstate(all="ignore"):
            rise = (self._gives(noise + step) - self._gives(noise - step)) / (2.0 * step)
            return np.asarray(np.log(np.abs(rise)))

    def _in_table(self, value: Value, table: Table) -> Found:
        """Draw the uniform noise within the range that gives the category."""
        chances = table.row(*self._parents)
        members = np.asarray(table.values or range(table.shape[-1]))
        hit = members == np.asarray(value)[..., None]
        width = (hit * chances).sum(axis=-1)
        start = (hit * (np.cumsum(chances, axis=-1) - chances)).sum(axis=-1)
        with np.errstate(divide="ignore"):
            log = summed(np.log(width))
        possible = np.isfinite(log)
        noise = self._all(start) + self._at(np.shape(value)[1:]) * self._all(width)
        several = not (width.reshape(len(width), -1)[possible] == 1.0).all()
        return noise, self._all(np.where(possible, log, 0.0)), self._all(possible), several

    def _enumerated(self, value: Value, *, alike: bool) -> Found:
        """Try every value of a discrete noise: of each component by itself, or of all together."""
        support, chances = self._density.support, self._density.chances
        count = 1 if alike else int(np.prod(self._shape))
        if len(support) ** count > JOINT:
            said = (
                f"the noise of {self._variable.name!r} has {len(support) ** count} values, of which"
            )
            raise ModelError([f"{said} {JOINT} can be tried; give it inverse_noise"])
        picks = np.array(list(product(range(len(support)), repeat=count)))
        shape = (len(value), *self._shape)
        mass = []
        for pick in picks:
            noise = np.broadcast_to(np.reshape(support[pick], () if alike else self._shape), shape)
            near = self._units.near(self._gives(noise), value, whole=not alike)
            mass.append(near * float(np.prod(chances[pick])))
        place, log, possible, several = self._chosen(np.stack(mass))
        noise = support[picks[place]]
        noise = noise[..., 0] if alike else noise.reshape(-1, *self._shape)
        return noise, log, possible, several

    def _chosen(self, mass: Floats) -> tuple[Value, Floats, Value, bool]:
        """Choose among solutions, shape (solutions, units, …), in proportion to their mass."""
        mass = np.repeat(mass, self._each, axis=1)
        total = mass.sum(axis=0)
        passed = np.cumsum(mass, axis=0) <= self._at(mass.shape[2:]) * total
        with np.errstate(divide="ignore"):
            log = summed(np.log(total))
        possible, several = np.isfinite(log), bool(((mass > 0.0).sum(axis=0) > 1).any())
        place = np.minimum(passed.sum(axis=0), len(mass) - 1)
        return place, np.where(possible, log, 0.0), possible, several

    def _ranges(self, value: Value) -> Found:
        """Look for all noise that gives the value, component by component.

        It is looked for between quantiles, and beyond them for units that have none there.
        """
        inner = [self._density.quantile(share) for share in SHARES]
        found = self._between(value, inner)
        if found[2].all():
            return found
        further = self._between(value, self._density.beyond(inner))
        noise, log, possible = (
            np.where(found[2].reshape(-1, *(1,) * (np.ndim(one) - 1)), one, other)
            for one, other in zip(found[:3], further[:3], strict=True)
        )
        return noise, log, possible, found[3] or further[3]

    def _between(self, value: Value, ends: Sequence[Floats]) -> Found:
        """Look for noise that gives the value between some points.

        Solutions are single numbers, of which the density counts; or ranges, where whole numbers,
        thresholds and ceilings give one value for many noises: then their probability counts.
        """
        density, shape = self._density, np.shape(value)
        points = np.stack([np.broadcast_to(end, shape[1:]) for end in ends])
        signs = np.stack([self._sign(np.broadcast_to(p, shape), value) for p in points])
        middle = len(points) // 2
        for at in range(1, middle + 1):  # a function may end before the noise does
            for outer, nearer in ((middle - at, middle - at + 1), (middle + at, middle + at - 1)):
                if outer < len(points):
                    lost = np.isnan(signs[outer])
                    signs[outer] = np.where(lost, signs[nearer], signs[outer])
        turns = signs[1:] != signs[:-1]
        number = np.cumsum(turns, axis=0)
        begin = np.broadcast_to(points[0], shape)
        starts, ends, there = [], [], []
        for turn in range(int(number[-1].max(initial=0))):
            here = turns & (number == turn + 1)
            at = here.argmax(axis=0)[None]
            before, after = (np.take_along_axis(s, at, 0)[0] for s in (signs[:-1], signs[1:]))
            low, high = (self._point(points, at[0] + by) for by in (0, 1))
            left = self._edge(low, high, value, before, leaves=True)
            right = self._edge(low, high, value, after, leaves=False)
            real = here.any(axis=0)
            starts.append(np.where(before == 0, begin, left))
            ends.append(right)
            there.append(real & (after != 0))
            begin = np.where(real & (after == 0), left, begin)
        starts.append(begin)
        ends.append(np.broadcast_to(points[-1], shape))
        there.append(signs[-1] == 0)
        low, high, real = (np.stack(each) for each in (starts, ends, there))
        wide = real & (high - low > 1e-9 * (1.0 + np.abs(low)))
        masses = np.where(wide, density.mass(low, high), 0.0)
        roots = 0.5 * (low + high)
        logs = []
        for root, single in zip(roots, real & ~wide, strict=True):
            log = density.log_density(root) - self._log_slope(root)
            found = single & self._units.near(self._gives(root), value) & np.isfinite(log)
            logs.append(np.where(found, log, -np.inf))
        top = np.max(logs, axis=0)
        scale = np.where(np.isfinite(top) & ~wide.any(axis=0), top, 0.0)
        chances = np.where(wide.any(axis=0), masses, np.exp(np.array(logs) - scale))
        place, log, possible, several = self._chosen(chances)
        one, start, end, ranges = (
            np.take_along_axis(np.repeat(each, self._each, axis=1), place[None], axis=0)[0]
            for each in (roots, low, high, wide)
        )
        if ranges.any():
            within = density.between(start, end, self._at(shape[1:], "within"))
            one = np.where(ranges, within, one)
        log = log + np.where(possible, self._all(summed(scale)), 0.0)
        return one, log, possible, several or bool(ranges.any())

    def _sign(self, noise: Value, value: Value) -> Value:
        """Tell whether noise gives too little (-1), the value (0) or too much (1)."""
        given = self._tried(noise)
        whole = self._variable.dtype != "real"
        return np.asarray(np.sign((np.rint(given) if whole else given) - value))

    def _point(self, points: Floats, at: Value) -> Floats:
        """Give the quantile of a number for each component, shape (units, *shape)."""
        flat = at.reshape(len(at), -1)
        return points.reshape(len(points), -1)[flat, np.arange(flat.shape[1])].reshape(at.shape)

    def _edge(self, low: Value, high: Value, value: Value, sign: Value, *, leaves: bool) -> Value:
        """Halve ranges: give where a sign is left, or the last point before it is reached."""
        for _ in range(60):
            middle = 0.5 * (low + high)
            before = (self._sign(middle, value) == sign) == leaves
            low, high = np.where(before, middle, low), np.where(before, high, middle)
        return high if leaves else low


def summed(log: Floats) -> Floats:
    """Add up the components of each unit, shape (units,)."""
    return np.asarray(log.reshape(len(log), -1).sum(axis=1))


@final
@dataclass(frozen=True)
class Density:
    """Density and quantiles of a distribution, component by component.

    Attributes:
        frozen: A distribution of scipy; None of a discrete one.
        support: The values of a discrete distribution; None of a continuous one.
        chances: The probability of each.
    """

    frozen: Any = None
    support: Any = None
    chances: Any = None

    def log_density(self, value: Value) -> Floats:
        """Give the logarithm of the density, or of the probability."""
        if self.support is None:
            return np.asarray(self.frozen.logpdf(value), dtype=float)
        hit = np.abs(np.asarray(value)[..., None] - self.support) <= 1e-9
        with np.errstate(divide="ignore"):
            return np.asarray(np.log((hit * self.chances).sum(axis=-1)))

    def quantile(self, share: Any) -> Floats:
        """Give a quantile of a continuous distribution."""
        return np.asarray(self.frozen.ppf(share))

    def beyond(self, inner: list[Floats]) -> list[Floats]:
        """Add points beyond quantiles of a continuous distribution, as far as it reaches."""
        (first, last), middle = self.frozen.support(), self.quantile(0.5)
        low, high = inner[0], inner[-1]
        far = 4.0 ** np.arange(1, BEYOND + 1)
        below = [np.maximum(middle + by * (low - middle), first) for by in far[::-1]]
        return [*below, *inner, *(np.minimum(middle + by * (high - middle), last) for by in far)]

    def mass(self, low: Floats, high: Floats) -> Floats:
        """Give the probability of a range of a continuous distribution, in both tails as well."""
        below = self.frozen.cdf(high) - self.frozen.cdf(low)
        return np.asarray(np.maximum(below, self.frozen.sf(low) - self.frozen.sf(high)))

    def between(self, low: Floats, high: Floats, share: Floats) -> Floats:
        """Give the quantile of a range of a continuous distribution."""
        cdf, sf = self.frozen.cdf, self.frozen.sf
        upper = low > self.quantile(0.5)
        left = self.frozen.ppf(cdf(low) + share * (cdf(high) - cdf(low)))
        right = self.frozen.isf(sf(low) + share * (sf(high) - sf(low)))
        return np.asarray(np.clip(np.where(upper, right, left), low, high))


def density_of(source: Any, shape: tuple[int, ...], values: Values) -> Density:
    """Give density and quantiles of a distribution.

    Raises:
        ModelError: They are not known.
    """
    from scipy import stats

    match source:
        case Normal(mean=mean, std=std) if std > 0.0:
            return Density(stats.norm(mean, std))
        case Continuous():
            return Density(source.frozen)
        case Box():
            low, high = (np.asarray(end) for end in source.bounds(shape, values))
            if (high > low).all():
                return Density(stats.uniform(low, high - low))
        case Normal(mean=mean):
            return Density(None, np.array([mean]), np.ones(1))
        case Discrete():
            return Density(None, np.asarray(source.values, dtype=float), source.chances)
        case Categories(members=members):
            return density_of(Discrete(members), shape, values)
        case Integers(low=low, high=high):
            return density_of(Discrete(range(low, high + 1)), shape, values)
    raise ModelError([f"the density of {source!r} is not known, so it cannot be abducted"])
