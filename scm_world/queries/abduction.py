"""Counterfactuals of units that were observed: abduction, action, prediction.

The noise of a unit is not known; it follows from what was observed of it. Variables are gone
through in causal order. Where a variable was observed, its noise is inverted; where it was not, the
noise is drawn. What is inverted below something that was drawn weighs the draw by the density of
the observation: importance sampling, which is exact where nothing had to be drawn. Then the model
is solved again under the intervention, with the same noise.

Source:
    Pearl, *Causality*, 2nd edition, 2009, theorem 7.1.7 (abduction, action, prediction).
    Doucet, de Freitas, Gordon, *Sequential Monte Carlo Methods in Practice*, 2001, section 1.3.
    Kitagawa, *Monte Carlo filter and smoother for non-Gaussian nonlinear state space models*,
    Journal of Computational and Graphical Statistics 1996, for paths and systematic resampling.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from scm_world._arguments import real_number, whole_number
from scm_world._types import Floats, Value, Values
from scm_world._types import Integers as Numbers
from scm_world.errors import ImpossibleObservation, InterventionError, ModelError, UnknownOption
from scm_world.graph import SCM, NoiseKey
from scm_world.graph.evaluate import earlier, first_value, noise_of
from scm_world.queries.equations import Layout
from scm_world.queries.inversion import Found, Inverse, density_of, summed
from scm_world.queries.observations import Observations, observations
from scm_world.queries.plans import Plan, at_once, numbered
from scm_world.variables import (
    Action,
    Box,
    Categories,
    Derived,
    Discrete,
    Draw,
    Exogenous,
    Integers,
    Measured,
    Mechanism,
    Noise,
    Scale,
    Shift,
    Table,
)
from scm_world.variables.checks import coerce

DRAWS = 1000
"""How many draws of its noise there are for each unit, where it does not follow exactly."""

MOST = 20_000_000
"""How many draws there can be of all units together."""


@final
@dataclass(frozen=True, eq=False)
class Counterfactuals(Mapping[str, Floats]):
    """What units that were observed would have been, under an intervention.

    As a mapping it gives the expected values: of one unit shape ``(*shape)``, of a table of units
    ``(rows, *shape)``; with lagged edges the control step comes before the shape. Categories have
    no order and no mean: they are given where all draws agree, else ask for a ``probability``.

    Attributes:
        factual: What the units may have been, by variable: one value for each draw of what was not
            observed, shape (rows, n, *shape) or (rows, n, steps, *shape).
        counterfactual: What they would have been, likewise.
        weights: Of the draws, shape (rows, n); each row sums to 1.
        exact: Whether everything followed from the observations, without draws: then n is 1.
        one: Whether a single unit was observed.
        ancestors: Of which of the first draws each comes, shape (rows, n), where draws were drawn
            again.
        model: That was asked.
    """

    factual: dict[str, Floats]
    counterfactual: dict[str, Floats]
    weights: Floats
    exact: bool
    one: bool
    ancestors: Numbers
    model: SCM

    def __getitem__(self, name: str) -> Floats:
        found = self.counterfactual[name]
        weights = self.weights.reshape(self.weights.shape + (1,) * (found.ndim - 2))
        first = np.take_along_axis(found, weights.argmax(axis=1, keepdims=True), axis=1)
        if ((found != first) & (weights > 0.0)).any():
            self._refuse_categories(name)
        return self._mean(found)

    def __iter__(self) -> Iterator[str]:
        return iter(self.counterfactual)

    def __len__(self) -> int:
        return len(self.counterfactual)

    @property
    def effective(self) -> Floats:
        """Effective number of draws of each unit, shape (rows,): 1 / Σ w² (Kish 1965).

        Draws that come from one of the first instant count as one.
        """
        mass = np.zeros_like(self.weights)
        np.add.at(mass, (np.arange(len(mass))[:, None], self.ancestors), self.weights)
        return np.asarray(1.0 / (mass**2).sum(axis=1))

    def difference(self, name: str) -> Floats:
        """Give the expected difference from what was: the effect on each unit.

        Raises:
            UnknownOption: The variable is categorical.
            UnknownVariable: There is no such variable.
        """
        self._refuse_categories(name)
        return self._mean(self.counterfactual[name] - self.factual[name])

    def interval(self, name: str, level: float = 0.95) -> tuple[Floats, Floats]:
        """Give weighted quantiles of a variable under the intervention, for each unit.

        They say what is not known of the unit, not how exact a mean is.

        Args:
            name: Of the variable.
            level: Between the two quantiles.

        Raises:
            UnknownOption: The variable is categorical, or the level is no number between 0 and 1.
            UnknownVariable: There is no such variable.
        """
        self._refuse_categories(name)
        if not 0.0 < real_number("level", level) < 1.0:
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

    def probability(self, name: str, value: Any) -> Floats:
        """Give the probability of a value or a label under the intervention, for each unit.

        Raises:
            UnknownOption: The variable has no such value or label.
            UnknownVariable: There is no such variable.
        """
        variable = self.model.declared(name)
        bounds = variable.bounds if isinstance(variable.bounds, Categories) else None
        try:
            number = coerce(variable, value)
        except InterventionError:
            number = None
        if number is None or (bounds is not None and not bounds.contains(number)):
            allowed = [f"a number of dtype {variable.dtype}, shape {variable.shape}"]
            if bounds is not None:
                allowed = list(map(repr, (*bounds.labels, *bounds.members)))
            raise UnknownOption(f"value of {name}", value, allowed)
        found = self.counterfactual[name] == number
        whole = tuple(range(found.ndim - number.ndim, found.ndim))
        return self._mean(found.all(axis=whole).astype(float))

    def _refuse_categories(self, name: str) -> None:
        if self.model.declared(name).dtype == "categorical":
            allowed = (f"a probability, as in probability({name!r}, value)",)
            raise UnknownOption("mean or quantile of categories", name, allowed)

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
    tolerance = real_number("tolerance", tolerance, least=0.0)
    seen = observations(model, observed)
    if n is None:
        sure = _Abduction(model, seen, 1, seed, tolerance, certain=True)
        answer = None if sure.sampled else sure.answer(do)
        if answer is not None and answer.exact:
            return answer
    count = DRAWS if n is None else whole_number("n", n, least=1)
    return _Abduction(model, seen, count, seed, tolerance).answer(do)


@final
class _Abduction:
    """The noise of observed units, in ``n`` draws each.

    Args:
        model: With the interventions under which was observed.
        seen: What was observed.
        n: How many draws of what was not observed.
        seed: Of the draws.
        tolerance: How far a value may lie from what follows, as a share of 1 and of its size.
        certain: Whether to stop at the first draw.
    """

    def __init__(
        self,
        model: SCM,
        seen: Observations,
        n: int,
        seed: int,
        tolerance: float,
        *,
        certain: bool = False,
    ) -> None:
        self.model, self.n, self._tolerance = model, n, tolerance
        own = np.random.SeedSequence((whole_number("seed", seed, least=0), 1))  # not that of data
        self._noise, self._certain = Noise(int(own.generate_state(1)[0])), certain
        self._together = Layout(model).is_vectorised
        self.one, self._rows, self.steps = seen.one, seen.rows, seen.steps
        self._size = self._rows * n
        if self._size * self.steps > MOST:
            said = f"{self._rows} units with {n} draws each of {self.steps} instants are too many"
            raise ModelError([f"{said}: give fewer rows at once, or a smaller n"])
        self._observed: dict[str, Value] = {}
        for name, values in seen.values.items():
            gap = np.isnan(values)
            if getattr(model.declared(name), "per", "step") == "step":
                gap[:] = False  # what is drawn once for an episode is known once it is seen
            first = np.take_along_axis(values, np.isfinite(values).argmax(axis=1)[:, None], 1)
            whole = np.where(gap, first, values)
            self._observed[name] = np.repeat(np.moveaxis(whole, 1, 0), n, axis=1)
        self.log_weights = np.zeros(self._size)
        self._ancestors = np.tile(np.arange(n), self._rows)
        self._tried = 1  # of how many combinations of hidden discrete noise each has its draws
        self.sampled = False
        self._unsure: set[str] = set()
        self.given: list[dict[str, Value]] = []
        self.values: list[dict[str, Value]] = []
        self._before: Values = {}
        if model.is_temporal:
            self._before = self._solved(model, {}, {}, 0, starts=True)
        for step in range(self.steps):
            if certain and self.sampled:
                return
            self._step = step
            self._abduct()
            self._before = model.remembered(self.values[-1], self._before)
            self._draw_again()

    # --- abduction ------------------------------------------------------------------------------

    def _abduct(self) -> None:
        """Find noise and values of one instant."""
        kept = self.given[0] if self._step else {}
        per = {name: getattr(self.model.declared(name), "per", "step") for name in kept}
        self.given.append({name: v for name, v in kept.items() if per[name] == "episode"})
        self.values.append({})
        for name in self.model.structure.order:
            if self._certain and self.sampled:
                return
            there, wanted = np.zeros(self._size, dtype=bool), None
            if name in self._observed:
                wanted = self._observed[name][self._step]
                there = ~np.isnan(wanted).reshape(self._size, -1).any(axis=1)
            self._find(self.model[name], wanted, there)

    def _draw_again(self) -> None:
        """Draw the draws of a unit again by their weights, where fewer than half count."""
        weights = self._weights()
        few = 1.0 / (weights**2).sum(axis=1) < 0.5 * self.n
        if self._step == self.steps - 1 or not few.any():
            return
        start = self._noise.uniforms("|again", n=1, step=self._step, count=self._rows)
        chosen = np.tile(np.arange(self.n), (self._rows, 1))
        for row in np.flatnonzero(few).tolist():
            points = (start[row] + np.arange(self.n)) / self.n
            chosen[row] = np.searchsorted(np.cumsum(weights[row]), points).clip(max=self.n - 1)
        self.log_weights.reshape(self._rows, self.n)[few] = 0.0
        self._tried = 0
        where = (chosen + self.n * np.arange(self._rows)[:, None]).ravel()
        self._ancestors = self._ancestors[where]
        self._before = {name: np.asarray(value)[where] for name, value in self._before.items()}
        for instant in (*self.given, *self.values):
            instant.update({name: np.asarray(value)[where] for name, value in instant.items()})

    def _weights(self) -> Floats:
        """Give the weights of the draws, shape (rows, n); each row sums to 1."""
        logs = self.log_weights.reshape(self._rows, self.n)
        weights = np.exp(logs - logs.max(axis=1, keepdims=True))
        return np.asarray(weights / weights.sum(axis=1, keepdims=True))

    def _find(self, variable: Any, wanted: Any, there: Value) -> None:
        """Find value and noise of a variable, from what was observed of it and of its causes.

        Args:
            variable: As it is in the model.
            wanted: Its observed values, shape (units, *shape), or None.
            there: Where it was observed, shape (units,).
        """
        values = self.values[-1]
        name, key, given = variable.name, self._key(self._step), self.given[-1]
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
            known = there
            if not there.all():
                drawn, known = self._from_below(variable, source, drawn, there)
            if not known.all():
                self.sampled = True
                self._unsure.add(name)
                drawn = self._each(variable, source, drawn, known)
            given[name] = drawn
            if there.any():
                natural = self._natural(name, wanted, there)
                weigh = unsure or not there.all()
                found, log, possible, several = self._noise_of(variable, source, natural, weigh)
                if several:
                    self.sampled = True
                    self._unsure.add(name)
                given[name] = self._where(there, found, drawn)
                self._weigh(name, there, possible, unsure=unsure)
                self.log_weights += np.where(there, log, 0.0)
        value = self._computed(self.model, name, values, self._before, self._step)
        if wanted is not None:
            self._weigh(name, there, self.near(value, wanted, whole=True), unsure=unsure)
            value = self._where(there, wanted, value)
        values[name] = value if variable.dtype == "real" else np.rint(value).astype(np.int64)

    def _from_below(
        self, variable: Any, source: Any, drawn: Value, there: Value
    ) -> tuple[Value, Value]:
        """Find hidden noise where something that follows from it without noise was observed.

        Returns:
            The noise, and for which units it is known.
        """
        name, own = variable.name, getattr(variable, "noise_shape", None)
        shape = variable.shape if own is None else own
        path = self._path_down(name, shape)
        if not path or isinstance(getattr(variable, "mechanism", None), Table):
            return drawn, there
        if isinstance(source, Discrete | Categories | Integers) or source.parents():
            return drawn, there
        end = self.model[path[-1]]
        wanted = self._observed[end.name][self._step]
        seen = ~there & ~np.isnan(wanted).reshape(self._size, -1).any(axis=1)
        form: Any = {"shape": end.shape, "dtype": end.dtype, "bounds": end.bounds}
        below = Derived(
            name=end.name, parents=(), mechanism=_Below(self, path), noise=source, **form
        )
        known = there | seen
        causes = {parent.name for each in path for parent in self.model[each].all_parents}
        unsure = not self._unsure.isdisjoint(causes)
        weigh = unsure or not known.all()
        value = self._where(seen, wanted, np.zeros_like(wanted))
        found, log, possible, several = Inverse(self, below, source, [], self._step, 1).solve(
            value, weigh=weigh
        )
        self.sampled |= several
        if several or unsure:
            self._unsure.add(name)
        self._weigh(end.name, seen, possible, unsure=unsure)
        self.log_weights += np.where(seen, log, 0.0)
        return self._where(seen, found, drawn), known

    def _path_down(self, name: str, shape: tuple[int, ...]) -> tuple[str, ...]:
        """List a hidden variable, and what follows from it without noise, to what was observed.

        Args:
            name: Of the variable.
            shape: Of its noise, which is that of the observation.
        """
        known, path = {*self.values[-1]}, [name]
        for other in self.model.structure.order:
            variable: Any = self.model[other]
            causes = {parent.name for parent in variable.all_parents if not parent.lag}
            if other in known or causes.isdisjoint(path) or not causes <= known | {*path}:
                continue
            if getattr(variable, "noise", None) is not None or _is_free(variable):
                continue
            observed = other in self._observed
            if observed and variable.shape == shape:
                return (*path, other)
            path += [other] * (not observed)
        return ()

    def along(self, path: tuple[str, ...], noise: Value) -> Value:
        """Compute the last of some variables from the noise of the first, for all units."""
        values, kept = dict(self.values[-1]), self.given[-1]
        self.given[-1] = {**kept, path[0]: noise}
        for name in path:
            values[name] = self._computed(self.model, name, values, self._before, self._step)
        self.given[-1] = kept
        return values[path[-1]]

    def _each(self, variable: Any, source: Any, drawn: Value, there: Value) -> Value:
        """Give every value of a hidden discrete noise, or category of a table, its share of draws.

        Their probabilities are the weights. Where there are too many, or draws were drawn again,
        noise stays as it was drawn.
        """
        own = getattr(variable, "noise_shape", None)
        shape = variable.shape if own is None else own
        table = getattr(variable, "mechanism", None)
        if isinstance(table, Table):
            members = np.asarray(table.values or range(table.shape[-1]))
        elif isinstance(source, Discrete | Categories | Integers) and not source.parents():
            members = np.asarray(density_of(source, shape, {}).support)
        else:
            return drawn
        count = len(members) ** int(np.prod(shape))
        if self._tried * count > self.n or self._tried == 0:
            return drawn
        number = np.arange(self.n) // self._tried % count
        self._tried *= count
        digits = np.stack([number // len(members) ** k for k in range(int(np.prod(shape)))], -1)
        given = members[digits % len(members)].reshape(self.n, *shape)
        given = np.tile(given, (self._rows, *(1,) * len(shape)))
        if isinstance(table, Table):
            given, log, possible, _ = self._inverse(variable, source, given, weigh=True)
            log = np.where(possible, log, -np.inf)
        else:
            log = summed(density_of(source, shape, {}).log_density(given))
        rest = np.tile(np.arange(self.n) >= self.n // self._tried * self._tried, self._rows)
        self.log_weights += np.where(there, 0.0, log)
        self.log_weights[rest] = -np.inf  # so that every combination has as many draws
        return given

    def _natural(self, name: str, wanted: Value, there: Value) -> Value:
        """Give what a variable would have been without a shift or scale, 0 where it is unknown."""
        value, act = self._where(there, wanted, np.zeros_like(wanted)), self.model.act_on(name)
        match None if act is None else act.intervention:
            case Shift(by=by):
                return np.asarray(value - np.asarray(by))
            case Scale(by=by):
                if not np.all(by):
                    said = f"{name!r} was observed under Scale(0), which tells nothing of it"
                    raise ModelError([f"{said}: leave it out, or give NaN"])
                return np.asarray(value / np.asarray(by))
        return value

    def _noise_of(self, variable: Any, source: Any, value: Value, weigh: bool) -> Found:
        """Give noise, log density, whether there is any, and whether there are several."""
        if isinstance(variable, Exogenous):
            bounded = bool(source.parents())
            try:
                log = density_of(source, variable.shape, self.values[-1]).log_density(value)
            except ModelError:
                if bounded:
                    raise
                log = np.zeros(len(value))  # of no account, but that it is possible
            log = summed(log)
            return value, np.where(np.isfinite(log), log, 0.0) * bounded, np.isfinite(log), False
        return self._inverse(variable, source, value, weigh=weigh)

    def _inverse(self, variable: Any, source: Any, value: Value, *, weigh: bool) -> Found:
        """Invert a mechanism, given the values of its causes."""
        parents: list[Value] = []
        for parent in variable.all_parents:
            found = self._before if parent.lag else self.values[-1]
            where = earlier(parent.name, parent.lag) if parent.lag else parent.name
            if where not in found:
                first = first_value(self.model.declared(parent.name))
                found = {where: np.broadcast_to(first, (self._size, *first.shape))}
            parents.append(found[where])
        each = 1 if weigh else self.n
        return Inverse(self, variable, source, parents, self._step, each).solve(value, weigh=weigh)

    def _weigh(self, name: str, there: Value, possible: Value, *, unsure: bool) -> None:
        """Leave out draws that contradict an observation; refuse what no draw gives.

        Raises:
            ImpossibleObservation: The model cannot give it.
            ModelError: It can, for all that is known, but no draw of what was not observed does.
        """
        wrong = there & ~possible
        self.log_weights[wrong] = -np.inf
        lost = np.isinf(self.log_weights.reshape(self._rows, self.n)).all(axis=1)
        if lost.any() and wrong.any():
            row = int(np.flatnonzero(lost)[0])
            said = f"in row {row}, " if self._rows > 1 else ""
            if name in self.given[-1]:
                said += "no value of its noise gives what was observed"
            else:
                said += "its causes give another value, and it has no noise"
            if unsure:
                said = (
                    f"{name!r}: {said}, in none of {self.n} draws of the causes that were not "
                    "observed; observe them, give it noise, or draw more (n)"
                )
                raise ModelError([said])  # the model may give it: it was not met
            raise ImpossibleObservation(name, said)

    # --- action and prediction ------------------------------------------------------------------

    def answer(self, do: Mapping[str, Any]) -> Counterfactuals:
        """Solve the model again under an intervention, with the same noise."""
        models = self._models(do)
        changes = [self._changed(model) for model in models]
        follow = set[str]().union(*changes)
        follow |= {n for m in models for name in follow for n in m.descendants(name)}
        before: Values = {}
        if self.model.is_temporal:
            before = self._solved(models[0], {}, {}, 0, starts=True)
        found: list[dict[str, Value]] = []
        for step, was in enumerate(self.values):
            model, targets, values = models[step], changes[step], dict[str, Value]()
            for name in model.structure.order:
                bounds = getattr(self.model[name], "distribution", None)
                moves = bounds is not None and bounds.parents()
                if name not in follow or (
                    name not in targets and _is_free(self.model[name]) and not moves
                ):
                    values[name] = was[name]
                    continue
                if name in targets:
                    self._renew(model, name, values, step)
                elif moves:
                    self._follow_bounds(name, was, values, step)
                values[name] = self._computed(model, name, values, before, step)
            found.append(values)
            before = model.remembered(values, before)
        return Counterfactuals(
            factual=self._stacked(self.values),
            counterfactual=self._stacked(found),
            weights=self._weights(),
            exact=not self.sampled,
            one=self.one,
            ancestors=self._ancestors.reshape(self._rows, self.n),
            model=self.model,
        )

    def _models(self, do: Mapping[str, Any]) -> list[SCM]:
        """Give the model under what is done, for each control step.

        Raises:
            InterventionError: An intervention was refused.
            UnknownOption: One is due after the last step, or waits for an event.
        """
        plan, found = Plan(numbered(self.model, do)), []
        for name, act in plan.timed():
            begin = act.time.start
            if begin is None or act.time.every is not None or begin >= self.steps:
                allowed = (f"at= and during= from control step 0 to {self.steps - 1}",)
                raise UnknownOption(f"time of an intervention on {name}", act, allowed)
        for step in range(self.steps):
            now = {name: act for name, acts in plan.items() for act in acts if act.time is None}
            for name, act in plan.timed():
                stop = act.time.during and act.time.during[1]
                if act.time.start <= step and (stop is None or step < stop):
                    now[name] = at_once(act)
            model = self.model.do(now)
            new = {  # it has nothing in common with what was abducted
                name: act.model_copy(update={"stream": "counterfactual"})
                for name, act in model.interventions.items()
                if isinstance(act, Draw) and not act.stream
                if self.model.interventions.get(name) != act
            }
            found.append(model.with_interventions(new) if new else model)
        return found

    def _changed(self, model: SCM) -> set[str]:
        """List the variables on which is done something else than when they were observed."""
        was, now = self.model.interventions, model.interventions
        other = {name for name in {**was, **now} if was.get(name) != now.get(name)}
        return {target for name in other for target in self.model.targets(name)}

    def _renew(self, model: SCM, name: str, values: Values, step: int) -> None:
        """Draw what an intervention draws anew: a value, another noise, or one that was cut off."""
        variable, act = model[name], model.act_on(name)
        done = None if act is None else act.intervention
        self.sampled |= isinstance(done, Draw)
        source = getattr(variable, "distribution", None) or getattr(variable, "noise", None)
        other = isinstance(done, Mechanism) and done.noise is not None
        if isinstance(done, Draw) or source is None or (name in self.given[step] and not other):
            return
        self.sampled = True
        once = getattr(variable, "per", "step") == "episode"
        shape = getattr(self.model.declared(name), "noise_shape", None)
        self.given[step][name] = self._key(0 if once else step).draw(
            source, name, variable.shape if shape is None else shape, values, "counterfactual"
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
        if starts:
            values = {
                name: np.zeros((self._size, *model.declared(name).shape))
                for name in model
                if _is_free(model[name]) and not isinstance(model[name], Exogenous)
            }
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
        if self._together or isinstance(function, _Below):
            return np.asarray(function(*parents, **noise))
        rows = range(len(next(iter([*noise.values(), *parents]))))
        return np.array([function(*(p[i] for p in parents), **_row(noise, i)) for i in rows])

    def uniforms(self, name: str, step: int, shape: tuple[int, ...]) -> Floats:
        """Give uniform numbers to choose among solutions with, shape (units, *shape)."""
        n = int(np.prod(shape))
        drawn = self._noise.uniforms(name, n=n, step=step, count=self._size)
        return drawn.reshape(self._size, *shape)


@final
@dataclass(frozen=True)
class _Below:
    """What follows from hidden noise without further noise, as a function of it.

    Attributes:
        units: That were observed.
        path: The variables, see ``_Abduction.along``.
    """

    units: _Abduction
    path: tuple[str, ...]

    def __call__(self, *, noise: Value) -> Value:
        """Compute it for all units."""
        return self.units.along(self.path, noise)


def _row(values: Values, row: int) -> dict[str, Value]:
    return {name: value[row] for name, value in values.items()}


def _is_free(variable: Any) -> bool:
    """Tell whether nothing but an observation says what a variable is."""
    return isinstance(variable, Exogenous | Action) or (
        isinstance(variable, Measured) and variable.mechanism is None
    )
