"""Counterfactuals of units that were observed: abduction, action, prediction.

The noise of a unit is not known; it follows from what was observed of it. Variables are gone
through in causal order. Where a variable was observed, its noise is inverted; where it was not, the
noise is drawn. What is inverted below something that was drawn weighs the draw by the density of
the observation: importance sampling, which is exact where nothing had to be drawn. Then the model
is solved again under the intervention, with the same noise.

Source:
    Pearl, *Causality*, 2nd edition, 2009, theorem 7.1.7 (abduction, action, prediction).
    Doucet, de Freitas, Gordon, *Sequential Monte Carlo Methods in Practice*, 2001, section 1.3.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any, final

import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import Floats, Value, Values
from scm_world.errors import ImpossibleObservation, ModelError, UnknownOption, UnknownVariable
from scm_world.graph import SCM, NoiseKey
from scm_world.graph.evaluate import earlier, noise_of
from scm_world.queries.equations import Layout
from scm_world.variables import (
    Action,
    Box,
    Categories,
    Continuous,
    Discrete,
    Draw,
    Exogenous,
    Integers,
    Linear,
    Measured,
    Noise,
    Normal,
    Scale,
    Shift,
    Table,
)

DRAWS = 1000
"""How many draws of its noise there are for each unit, where it does not follow exactly."""

QUANTILES = 257
"""Between how many quantiles of the noise solutions are looked for."""

JOINT = 4096
"""How many values a discrete noise may have in all."""


@final
@dataclass(frozen=True, eq=False)
class Counterfactuals(Mapping[str, Floats]):
    """What units that were observed would have been, under an intervention.

    As a mapping it gives the expected values: of one unit shape ``(*shape)``, of a table of units
    ``(rows, *shape)``; with lagged edges the control step comes before the shape.

    Attributes:
        factual: What the units may have been, by variable: one value for each draw of what was not
            observed, shape (rows, n, *shape) or (rows, n, steps, *shape).
        counterfactual: What they would have been, likewise.
        weights: Of the draws, shape (rows, n); each row sums to 1.
        exact: Whether everything followed from the observations, without draws: then n is 1.
        one: Whether a single unit was observed.
    """

    factual: dict[str, Floats]
    counterfactual: dict[str, Floats]
    weights: Floats
    exact: bool
    one: bool

    def __getitem__(self, name: str) -> Floats:
        return self._mean(self.counterfactual[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self.counterfactual)

    def __len__(self) -> int:
        return len(self.counterfactual)

    @property
    def effective(self) -> Floats:
        """Effective number of draws of each unit, shape (rows,): 1 / Σ w² (Kish 1965)."""
        return np.asarray(1.0 / (self.weights**2).sum(axis=1))

    def difference(self, name: str) -> Floats:
        """Give the expected difference from what was: the effect on each unit."""
        return self._mean(self.counterfactual[name] - self.factual[name])

    def interval(self, name: str, level: float = 0.95) -> tuple[Floats, Floats]:
        """Give weighted quantiles of a variable under the intervention, for each unit.

        They say what is not known of the unit, not how exact a mean is.

        Args:
            name: Of the variable.
            level: Between the two quantiles.
        """
        if not 0.0 < level < 1.0:
            raise UnknownOption("level", level, ("a number between 0 and 1",))
        found = self.counterfactual[name]
        order = np.argsort(found, axis=1)
        ordered = np.take_along_axis(found, order, axis=1)
        spread = self.weights.reshape(self.weights.shape + (1,) * (found.ndim - 2))
        total = np.cumsum(np.take_along_axis(np.broadcast_to(spread, found.shape), order, 1), 1)
        ends = []
        for share in (0.5 - 0.5 * level, 0.5 + 0.5 * level):
            place = np.minimum((total < share - 1e-12).sum(axis=1), found.shape[1] - 1)
            ends.append(np.take_along_axis(ordered, place[:, None], axis=1)[:, 0])
        low, high = (end[0] if self.one else end for end in ends)
        return low, high

    def _mean(self, values: Floats) -> Floats:
        weights = self.weights.reshape(self.weights.shape + (1,) * (values.ndim - 2))
        mean = np.asarray((weights * values).sum(axis=1))
        return mean[0] if self.one else mean

    def __str__(self) -> str:
        rows, n = self.weights.shape
        how = "exact" if self.exact else f"{n} draws, effective {self.effective.min():.0f} or more"
        return f"counterfactuals of {rows} observed unit{'s' * (rows > 1)} ({how})"


def counterfactuals(
    model: SCM,
    observed: Any,
    do: Mapping[str, Any],
    *,
    n: int | None = None,
    seed: int = 0,
    tolerance: float = 1e-6,
) -> Counterfactuals:
    """Say what observed units would have been under an intervention; see ``SCM.counterfactual``."""
    columns = _columns(observed)
    if n is not None:
        return _Abduction(model, columns, whole_number("n", n, least=1), seed, tolerance).answer(do)
    found = _Abduction(model, columns, 1, seed, tolerance, certain=True)
    if not found.sampled:
        return found.answer(do)
    return _Abduction(model, columns, DRAWS, seed, tolerance).answer(do)


def _columns(observed: Any) -> dict[str, Any]:
    """Read a row or a table: a mapping, or a data frame with a column for each component."""
    if not isinstance(observed, Mapping) and not hasattr(observed, "columns"):
        raise UnknownOption("observed", observed, ("values by name", "a table by name"))
    names = observed if isinstance(observed, Mapping) else observed.columns
    found: dict[str, Any] = {}
    parts: dict[str, list[Floats]] = {}
    for name in names:
        values = np.asarray(observed[name], dtype=float)
        if str(name).endswith("]"):
            parts.setdefault(str(name).rpartition("[")[0], []).append(values)
        else:
            found[str(name)] = values
    return found | {name: np.stack(each, axis=-1) for name, each in parts.items()}


@final
class _Abduction:
    """The noise of observed units, in ``n`` draws each.

    Args:
        model: With the interventions under which was observed.
        columns: Observed values, by name; NaN where something was not observed.
        n: How many draws of what was not observed.
        seed: Of the draws.
        tolerance: How far a value may lie from what follows, as a share of 1 and of its size.
        certain: Whether to stop at the first draw.
    """

    def __init__(
        self,
        model: SCM,
        columns: Mapping[str, Any],
        n: int,
        seed: int,
        tolerance: float,
        *,
        certain: bool = False,
    ) -> None:
        self.model, self.n, self._tolerance = model, n, tolerance
        self._noise, self._certain = Noise(whole_number("seed", seed, least=0)), certain
        self._together = Layout(model).is_vectorised
        self.steps = 1
        self._observed = self._read(columns)
        self._size = self._rows * n
        self.log_weights = np.zeros(self._size)
        self.sampled = False
        self._unsure: set[str] = set()
        self.given: list[dict[str, Value]] = []
        self.values: list[dict[str, Value]] = []
        before = self._solved(model, {}, {}, 0, starts=True) if model.is_temporal else {}
        for step in range(self.steps):
            if certain and self.sampled:
                return
            before = model.remembered(self._abduct(step, before), before)

    # --- what was observed ----------------------------------------------------------------------

    def _read(self, columns: Mapping[str, Any]) -> dict[str, Value]:
        """Check what was observed, and repeat it for the draws; shape (steps, rows * n, *shape)."""
        temporal = self.model.is_temporal
        found, rows, steps = {}, set[int](), set[int]()
        for name, values in columns.items():
            if name not in self.model:
                raise UnknownVariable(name, self.model)
            shape = self.model.declared(name).shape
            lead = values.shape[: values.ndim - len(shape)]
            if values.shape[len(lead) :] != shape or len(lead) not in (temporal, temporal + 1):
                allowed = "(steps,) or (rows, steps)" if temporal else "() or (rows,)"
                said = f"{name!r} was observed with shape {values.shape}: give {allowed}"
                raise ModelError([said + f" and then {shape}" * bool(shape)])
            if temporal:
                steps.add(lead[-1])
            rows.add(lead[0] if len(lead) > temporal else 0)
            found[name] = values
        if len(rows) > 1 or len(steps) > 1 or not found or 0 in steps:
            said = "observe at least one variable, and all of the same rows and control steps"
            raise ModelError([said])
        self.one = rows == {0}
        self._rows = 1 if self.one else rows.pop()
        self.steps = steps.pop() if temporal else 1
        return {name: self._repeated(name, values) for name, values in found.items()}

    def _repeated(self, name: str, values: Value) -> Value:
        shape = self.model.declared(name).shape
        table = np.reshape(values, (self._rows, self.steps, *shape))
        if np.isinf(table).any():
            raise ImpossibleObservation(
                name, "an observation is finite, or NaN where there is none"
            )
        return np.repeat(np.moveaxis(table, 1, 0), self.n, axis=1)

    # --- abduction ------------------------------------------------------------------------------

    def _abduct(self, step: int, before: Values) -> dict[str, Value]:
        """Find the noise of one instant; return the values of all variables."""
        model, values = self.model, dict[str, Value]()
        self.given.append({} if not step else dict(self._kept()))
        self.values.append(values)
        for name in model.structure.order:
            variable: Any = model[name]
            there = np.zeros(self._size, dtype=bool)
            wanted: Any = None
            if name in self._observed:
                wanted = self._observed[name][step]
                there = ~np.isnan(wanted).reshape(self._size, -1).any(axis=1)
            self._find(variable, wanted, there, values, before, step)
            if self._certain and self.sampled:
                break
        return values

    def _kept(self) -> Iterator[tuple[str, Value]]:
        """Give what was drawn once for the episode."""
        for name, value in self.given[0].items():
            if getattr(self.model.declared(name), "per", "step") == "episode":
                yield name, value

    def _find(
        self,
        variable: Any,
        wanted: Value,
        there: Value,
        values: dict[str, Value],
        before: Values,
        step: int,
    ) -> None:
        """Find value and noise of a variable, from what was observed of it and of its causes.

        Args:
            variable: As it is in the model.
            wanted: Its observed values, shape (units, *shape), or None.
            there: Where it was observed, shape (units,).
            values: Those of this instant so far; the value is added.
            before: Those of the instant before.
            step: Number of the instant.
        """
        name, key, given = variable.name, self._key(step), self.given[-1]
        source = getattr(variable, "distribution", None) or getattr(variable, "noise", None)
        unsure = name in self._unsure or not self._unsure.isdisjoint(
            parent.name for parent in variable.all_parents
        )
        if source is None and _is_free(variable):
            default = np.zeros(variable.shape)
            if isinstance(variable, Exogenous):
                default = variable.array(variable.default)
            default = np.broadcast_to(default, (self._size, *variable.shape))
            values[name] = default if wanted is None else self._where(there, wanted, default)
            return
        if source is not None and name not in given:
            if isinstance(variable, Exogenous):
                drawn = key.natural(source, name, variable.shape, values)
            else:
                drawn = noise_of(variable, variable, key, values)["noise"]
            if not there.all():
                self.sampled = True
                self._unsure.add(name)
            given[name] = drawn
            if there.any():
                found, log, possible, several = self._noise_of(
                    variable,
                    source,
                    self._natural(name, wanted, there),
                    values,
                    before,
                    step,
                    weigh=unsure or not there.all(),
                )
                if several:
                    self.sampled = True
                    self._unsure.add(name)
                given[name] = self._where(there, found, drawn)
                self._weigh(name, there, possible, unsure=unsure)
                self.log_weights += np.where(there, log, 0.0)
        value = self._computed(self.model, name, values, before, step)
        if wanted is not None:
            self._weigh(name, there, self.near(value, wanted, whole=True), unsure=unsure)
            value = self._where(there, wanted, value)
        values[name] = value if variable.dtype == "real" else np.rint(value).astype(np.int64)

    def _natural(self, name: str, wanted: Value, there: Value) -> Value:
        """Give what a variable would have been without a shift or scale, 0 where it is unknown."""
        value, act = self._where(there, wanted, np.zeros_like(wanted)), self.model.act_on(name)
        match None if act is None else act.intervention:
            case Shift(by=by):
                return np.asarray(value - np.asarray(by))
            case Scale(by=by):
                return np.asarray(value / np.asarray(by))
        return value

    def _noise_of(
        self,
        variable: Any,
        source: Any,
        value: Value,
        values: Values,
        before: Values,
        step: int,
        *,
        weigh: bool,
    ) -> tuple[Value, Floats, Value, bool]:
        """Give noise, log density, whether there is any, and whether there are several."""
        if isinstance(variable, Exogenous):
            bounded = bool(source.parents())
            try:
                log = _law(source, variable.shape, values).log_density(value)
            except ModelError:
                if bounded:
                    raise
                log = np.zeros(len(value))  # of no account, but that it is possible
            return value, np.where(np.isfinite(log), log, 0.0) * bounded, np.isfinite(log), False
        start = self.model.begin()
        parents = [
            before.get(earlier(p.name, p.lag), np.broadcast_to(start[p.name], (self._size,)))
            if p.lag
            else values[p.name]
            for p in variable.all_parents
        ]
        each = 1 if weigh else self.n
        return _Inverse(self, variable, source, parents, step, each).solve(value, weigh=weigh)

    def _weigh(self, name: str, there: Value, possible: Value, *, unsure: bool) -> None:
        """Leave out draws that contradict an observation; refuse what no draw gives."""
        wrong = there & ~possible
        self.log_weights[wrong] = -np.inf
        lost = np.isinf(self.log_weights.reshape(self._rows, self.n)).all(axis=1)
        if lost.any() and wrong.any():
            row = int(np.flatnonzero(lost)[0])
            said = f"in row {row}, " if self._rows > 1 else ""
            said += "no value of its noise gives what was observed"
            if unsure:
                said = (
                    f"{said}, in none of {self.n} draws of the causes that were not observed; "
                    "observe them, give it noise, or draw more (n)"
                )
            raise ImpossibleObservation(name, said)

    # --- action and prediction ------------------------------------------------------------------

    def answer(self, do: Mapping[str, Any]) -> Counterfactuals:
        """Solve the model again under an intervention, with the same noise."""
        before_it, after_it = self.model.interventions, self.model.do(do).interventions
        own = {
            name: act.model_copy(update={"stream": "counterfactual"})
            if isinstance(act, Draw) and act.stream is None  # nothing of what was abducted
            else act
            for name, act in after_it.items()
            if before_it.get(name) != act
        }
        model = self.model.with_interventions(own)
        targets = {target for name in own for target in self.model.targets(name)}
        follow = targets.union(*(model.descendants(target) for target in targets))
        before: Values = {}
        if model.is_temporal:
            before = self._solved(model, {}, {}, 0, starts=True)
        found: list[dict[str, Value]] = []
        for step, was in enumerate(self.values):
            values: dict[str, Value] = {}
            for name in model.structure.order:
                if name not in follow:
                    values[name] = was[name]
                    continue
                if name not in targets and isinstance(self.model[name], Exogenous):
                    self._follow_bounds(name, was, values, step)
                values[name] = self._computed(model, name, values, before, step)
            found.append(values)
            before = model.remembered(values, before)
        logs = self.log_weights.reshape(self._rows, self.n)
        weights = np.exp(logs - logs.max(axis=1, keepdims=True))
        return Counterfactuals(
            factual=self._stacked(self.values),
            counterfactual=self._stacked(found),
            weights=weights / weights.sum(axis=1, keepdims=True),
            exact=not self.sampled,
            one=self.one,
        )

    def _follow_bounds(self, name: str, was: Values, values: Values, step: int) -> None:
        """Move a draw with the ends of the space that it was drawn from."""
        variable: Any = self.model[name]
        source, shape = variable.distribution, variable.shape
        if not isinstance(source, Box):
            said = f"{name!r} follows what is done through {source!r}; only a Box can be followed"
            raise ModelError([said])
        (low, high), (lower, higher) = source.bounds(shape, was), source.bounds(shape, values)
        share = (was[name] - low) / np.where(high > low, high - low, 1.0)
        self.given[step][name] = lower + share * (higher - lower)

    def _stacked(self, instants: list[dict[str, Value]]) -> dict[str, Floats]:
        """Give all values by variable, shape (rows, n, *shape), or with steps in between."""
        found = {}
        for name in self.model:
            values = np.stack([np.asarray(each[name]) for each in instants], axis=1)
            shaped = values.reshape(self._rows, self.n, *values.shape[1:])
            found[name] = shaped if self.model.is_temporal else shaped[:, :, 0]
        return found

    # --- evaluation -----------------------------------------------------------------------------

    def _key(self, step: int, given: Values | None = None) -> NoiseKey:
        return NoiseKey(self._noise, 0, step, self._size, given=given)

    def _where(self, there: Value, one: Value, other: Value) -> Value:
        return np.where(there.reshape(-1, *(1,) * (np.ndim(one) - 1)), one, other)

    def near(self, found: Value, wanted: Value, *, whole: bool = False) -> Value:
        """Tell which numbers are as observed; of all of a unit, shape (units,), if ``whole``."""
        with np.errstate(invalid="ignore"):
            apart = np.abs(np.asarray(found, dtype=float) - wanted)
            close = apart <= self._tolerance * (1.0 + np.abs(wanted))
        return np.asarray(close.reshape(len(close), -1).all(axis=1) if whole else close)

    def _computed(self, model: SCM, name: str, values: Values, before: Values, step: int) -> Value:
        """Compute one variable with the noise that was found."""
        return self._solved(model, values, before, step, only=(name,))[name]

    def _solved(
        self,
        model: SCM,
        values: Values,
        before: Values,
        step: int,
        *,
        only: tuple[str, ...] | None = None,
        starts: bool = False,
    ) -> dict[str, Value]:
        """Solve all units together, or one after another where functions take one only."""
        given: Values = self.given[step] if step < len(self.given) else {}
        solve: Any = model.begin if starts else model.solve
        more: Any = {} if starts else {"previous": before}
        if self._together:
            return dict(solve(values, key=self._key(step, given), only=only, **more))
        rows = []
        for row in range(self._size):
            key = NoiseKey(self._noise, row, step, given=_row(given, row))
            more = {} if starts else {"previous": _row(before, row)}
            rows.append(solve(_row(values, row), key=key, only=only, **more))
        names = model if only is None else only
        return {name: np.array([row[name] for row in rows]) for name in names}

    def apply(self, function: Any, parents: list[Value], noise: Mapping[str, Value]) -> Value:
        """Call a mechanism for all units."""
        if self._together:
            return np.asarray(function(*parents, **noise))
        rows = range(len(next(iter([*noise.values(), *parents]))))
        return np.array([function(*(p[i] for p in parents), **_row(noise, i)) for i in rows])

    def uniforms(self, name: str, step: int, shape: tuple[int, ...]) -> Floats:
        """Give uniform numbers to choose among solutions with, shape (units, *shape)."""
        n = int(np.prod(shape))
        drawn = self._noise.uniforms(f"{name}|abduction", n=n, step=step, count=self._size)
        return drawn.reshape(self._size, *shape)


def _row(values: Values, row: int) -> dict[str, Value]:
    return {name: value[row] for name, value in values.items()}


def _is_free(variable: Any) -> bool:
    """Tell whether nothing but an observation says what a variable is."""
    return isinstance(variable, Exogenous | Action) or (
        isinstance(variable, Measured) and variable.mechanism is None
    )


# --- inverting a mechanism ------------------------------------------------------------------------

Found = tuple[Value, Floats, Value, bool]
"""Noise; log density of the observation given its causes, shape (units,), up to a summand that is
the same for all draws of a unit; for which units there is such noise; whether there are several."""


@final
class _Inverse:
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
        units: _Abduction,
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
        self._law = _law(source, self._shape, {})
        self._function, self._step = variable.mechanism.bind(), step

    def _gives(self, noise: Value) -> Value:
        return self._units.apply(self._function, self._parents, {"noise": noise})

    def _at(self, shape: tuple[int, ...]) -> Floats:
        return self._units.uniforms(self._variable.name, self._step, shape)

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
        if self._law.support is not None:
            return self._enumerated(value, alike=alike)
        if not alike:
            said = f"the noise of {variable.name!r} has shape {self._shape}, its value "
            said += f"{variable.shape}: give it inverse_noise, so that it follows from the value"
            raise ModelError([said])
        if variable.dtype != "real":
            return self._in_plateaus(value)
        noise = np.asarray(value - self._gives(np.zeros(np.shape(value))), dtype=float)
        if isinstance(variable.mechanism, Linear) or self._is_added(noise, value):
            return self._unique(noise, value, weigh)
        return self._roots(value)

    def _is_added(self, noise: Value, value: Value) -> bool:
        """Tell whether other noise moves the value by as much."""
        scale = self._law.quantile(0.75) - self._law.quantile(0.25)
        with np.errstate(all="ignore"):
            return all(
                np.allclose(self._gives(noise + by) - value, by, rtol=1e-6, atol=1e-9)
                for by in (scale, -0.4 * scale)
            )

    def _unique(self, noise: Value, value: Value, weigh: bool) -> Found:
        """Check a noise that is the only one that gives the value."""
        log = _summed(self._law.log_density(noise))
        possible = np.isfinite(log) & self._units.near(self._gives(noise), value, whole=True)
        if not weigh:
            log = np.zeros(len(log))
        elif self._law.support is None:
            log = log - _summed(self._log_slope(noise))
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
            log = _summed(np.log(width))
        possible = np.isfinite(log)
        noise = self._all(start) + self._at(np.shape(value)[1:]) * self._all(width)
        several = not (width.reshape(len(width), -1)[possible] == 1.0).all()
        return noise, self._all(np.where(possible, log, 0.0)), self._all(possible), several

    def _enumerated(self, value: Value, *, alike: bool) -> Found:
        """Try every value of a discrete noise: of each component by itself, or of all together."""
        support, chances = self._law.support, self._law.chances
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
            log = _summed(np.log(total))
        possible, several = np.isfinite(log), bool(((mass > 0.0).sum(axis=0) > 1).any())
        place = np.minimum(passed.sum(axis=0), len(mass) - 1)
        return place, np.where(possible, log, 0.0), possible, several

    def _roots(self, value: Value) -> Found:
        """Look for every solution between quantiles of the noise, component by component."""
        tails = np.array([1e-12, 1e-9, 1e-6])
        shares = np.concatenate(
            [tails, np.linspace(1e-4, 1.0 - 1e-4, QUANTILES), 1.0 - tails[::-1]]
        )
        points = np.array([np.broadcast_to(self._law.quantile(s), np.shape(value)) for s in shares])
        signs = np.array([np.sign(self._gives(point) - value) for point in points])
        crossing = (signs[:-1] * signs[1:] < 0) | (signs[:-1] == 0)
        roots, densities = [], []
        for turn in range(int(crossing.sum(axis=0).max(initial=0))):
            here = crossing & (np.cumsum(crossing, axis=0) == turn + 1)
            first = here.argmax(axis=0)[None]
            low, high = (np.take_along_axis(p, first, 0)[0] for p in (points[:-1], points[1:]))
            start = np.take_along_axis(signs, first, axis=0)[0]
            high = np.where(start == 0, low, high)
            for _ in range(80):
                middle = 0.5 * (low + high)
                same = np.sign(self._gives(middle) - value) == start
                low, high = np.where(same, middle, low), np.where(same, high, middle)
            root = 0.5 * (low + high)
            log = self._law.log_density(root) - self._log_slope(root)
            real = here.any(axis=0) & self._units.near(self._gives(root), value) & np.isfinite(log)
            roots.append(root)
            densities.append(np.where(real, log, -np.inf))
        if not roots:
            nothing = self._all(np.zeros(np.shape(value)))
            return nothing, _summed(nothing), np.zeros(len(nothing), dtype=bool), False
        top = np.max(densities, axis=0)
        scale = np.where(np.isfinite(top), top, 0.0)
        place, log, possible, several = self._chosen(np.exp(np.array(densities) - scale))
        solutions = np.repeat(roots, self._each, axis=1)
        noise = np.take_along_axis(solutions, place[None], axis=0)[0]
        log = log + np.where(possible, self._all(_summed(scale)), 0.0)
        return noise, log, possible, several

    def _in_plateaus(self, value: Value) -> Found:
        """Draw among noises that give a whole number, of a continuous noise."""
        many = 4 * QUANTILES
        shares = (np.arange(many) + 0.5) / many
        points = np.array([np.broadcast_to(self._law.quantile(s), np.shape(value)) for s in shares])
        hits = np.array([self._gives(point) == value for point in points]) / many
        place, log, possible, _ = self._chosen(hits)
        solutions = np.repeat(points, self._each, axis=1)
        return np.take_along_axis(solutions, place[None], axis=0)[0], log, possible, True


def _summed(log: Floats) -> Floats:
    """Add up the components of each unit, shape (units,)."""
    return np.asarray(log.reshape(len(log), -1).sum(axis=1))


@final
@dataclass(frozen=True)
class _Law:
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

    def quantile(self, share: float) -> Floats:
        """Give a quantile of a continuous distribution."""
        return np.asarray(self.frozen.ppf(share))


def _law(source: Any, shape: tuple[int, ...], values: Values) -> _Law:
    """Give density and quantiles of a distribution.

    Raises:
        ModelError: They are not known.
    """
    from scipy import stats

    match source:
        case Normal(mean=mean, std=std) if std > 0.0:
            return _Law(stats.norm(mean, std))
        case Continuous():
            return _Law(source.frozen)
        case Box():
            low, high = (np.asarray(end) for end in source.bounds(shape, values))
            if (high > low).all():
                return _Law(stats.uniform(low, high - low))
        case Normal(mean=mean):
            return _Law(None, np.array([mean]), np.ones(1))
        case Discrete():
            return _Law(None, np.asarray(source.values, dtype=float), source.chances)
        case Categories(members=members):
            return _law(Discrete(members), shape, values)
        case Integers(low=low, high=high):
            return _law(Discrete(range(low, high + 1)), shape, values)
    raise ModelError([f"the density of {source!r} is not known, so it cannot be abducted"])
