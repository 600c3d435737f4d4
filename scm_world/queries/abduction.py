"""Counterfactuals of observed units: abduction, action, prediction.

The noise of a unit is inferred from its observations, in causal order of the variables. The noise
of an observed variable is inverted as the variable declares; that of an unobserved variable, or of
one that declares nothing, is drawn. Observed descendants weigh a draw by the density of the
observation: importance sampling, which is exact if nothing is drawn. Then the model is solved again
under the intervention, with the same noise.

Source:
    Pearl, *Causality*, 2nd edition, 2009, theorem 7.1.7 (abduction, action, prediction).
    Doucet, de Freitas, Gordon, *Sequential Monte Carlo Methods in Practice*, 2001, section 1.3.
    Kitagawa, *Monte Carlo filter and smoother for non-Gaussian nonlinear state space models*,
    Journal of Computational and Graphical Statistics 1996, for paths and systematic resampling.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, final

import numpy as np

from scm_world._arguments import real_number, whole_number
from scm_world._types import Floats, Value, Values
from scm_world._types import Integers as Numbers
from scm_world.errors import (
    ImpossibleObservation,
    InterventionError,
    ModelError,
    UnknownOption,
    blamed,
)
from scm_world.graph import SCM, NoiseKey
from scm_world.queries.inversion import Found, density_of, noise_given, proposed
from scm_world.queries.observations import Observations, observations
from scm_world.queries.plans import Memory, Plan, numbered
from scm_world.queries.proposals import ENOUGH, LARGE, MANY, nearer, noise_of, scores_of, weights_of
from scm_world.variables import (
    Box,
    Categories,
    Continuous,
    Draw,
    Noise,
    Normal,
    Soft,
    Variable,
)
from scm_world.variables.checks import coerce
from scm_world.variables.moments import earlier
from scm_world.world import CompiledModel

DRAWS = 1000
"""Number of noise draws for each unit whose noise does not follow exactly."""

ROUNDS = 8
"""Number of times that draws of units that are far from the evidence are drawn again."""

FEW = 100
"""Effective number of draws below which counterfactuals are given with a warning."""

MOST = 20_000_000
"""Maximal number of draws of all units together."""


@final
@dataclass(frozen=True, eq=False)
class Counterfactuals(Mapping[str, Floats]):
    """Counterfactual values of observed units under an intervention.

    As a mapping it returns expected values: shape ``(*shape)`` for one unit, ``(rows, *shape)`` for
    a table of units; with lagged edges the control step comes before the shape. Categories have no
    mean: their value is returned if all draws agree; otherwise use ``probability``.

    Attributes:
        factual: Factual values by variable, one for each draw of unobserved quantities, shape
            (rows, n, *shape) or (rows, n, steps, *shape).
        counterfactual: Counterfactual values, of the same shapes.
        weights: Weights of the draws, shape (rows, n); each row sums to 1.
        exact: Whether all noise followed from the observations, without draws: then n is 1.
        one: Whether a single unit was observed.
        ancestors: Index of the initial draw from which each draw was resampled, shape (rows, n).
        model: The model.
    """

    factual: dict[str, Floats]
    counterfactual: dict[str, Floats]
    weights: Floats
    exact: bool
    one: bool
    ancestors: Numbers
    model: SCM

    def __getitem__(self, name: str) -> Floats:
        self.model.declared(name)
        found, weights = self.counterfactual[name], self._spread(self.counterfactual[name])
        first = np.take_along_axis(found, weights.argmax(axis=1, keepdims=True), axis=1)
        if ((found != first) & (weights > 0.0)).any():
            self._refuse_categories(name)
        return self._mean(found)

    def __contains__(self, name: object) -> bool:
        return name in self.counterfactual

    def __iter__(self) -> Iterator[str]:
        return iter(self.counterfactual)

    def __len__(self) -> int:
        return len(self.counterfactual)

    @property
    def effective(self) -> Floats:
        """Effective number of draws of each unit, shape (rows,): 1 / Σ w² (Kish 1965).

        Draws with a common ancestor count as one.
        """
        return _effective(self.weights, self.ancestors)

    def difference(self, name: str) -> Floats:
        """Return the expected difference from the factual values: the effect on each unit.

        Raises:
            UnknownOption: The variable is categorical.
            UnknownVariable: No variable has this name.
        """
        self._refuse_categories(name)
        return self._mean(self.counterfactual[name] - self.factual[name])

    def interval(self, name: str, level: float = 0.95) -> tuple[Floats, Floats]:
        """Return weighted quantiles of a variable under the intervention, for each unit.

        The interval describes the uncertainty about the unit, not that of a mean.

        Args:
            name: Name of the variable.
            level: Probability mass between the two quantiles.

        Raises:
            UnknownOption: The variable is categorical, or the level is not between 0 and 1.
            UnknownVariable: No variable has this name.
        """
        self._refuse_categories(name)
        if not 0.0 < real_number("level", level) < 1.0:
            raise UnknownOption("level", level, ("a number between 0 and 1",))
        found = self.counterfactual[name]
        weights, shares = np.broadcast_to(self._spread(found), found.shape), np.array([-0.5, 0.5])
        how: dict[str, Any] = {"method": "inverted_cdf", "weights": weights}
        low, high = np.quantile(found, 0.5 + level * shares, axis=1, **how)
        return (low[0], high[0]) if self.one else (low, high)

    def probability(self, name: str, value: object) -> Floats:
        """Return the probability of a value or a label under the intervention, for each unit.

        Raises:
            UnknownOption: The variable has no such value or label.
            UnknownVariable: No variable has this name.
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

    def _spread(self, values: Floats) -> Floats:
        return self.weights.reshape(self.weights.shape + (1,) * (values.ndim - 2))

    def _mean(self, values: Floats) -> Floats:
        mean = np.asarray((self._spread(values) * values).sum(axis=1))
        return mean[0] if self.one else mean

    def __str__(self) -> str:
        rows, n = self.weights.shape
        how = "exact" if self.exact else f"{n} draws, effective {self.effective.min():.0f} or more"
        return f"counterfactuals of {rows} observed unit{'s' * (rows > 1)} ({how})"


class _DrawsNeeded(Exception):
    pass


class _Drawn(NamedTuple):
    """Hidden noise that was not drawn from its distribution."""

    scores: dict[tuple[str, int], Floats]  # by variable and step, NaN where it follows
    log_ratio: Floats  # of its density to that of the draws, shape (units,)


def counterfactuals(
    model: SCM, observed: object, do: Mapping[str, Any], n: int | None, seed: int, tolerance: float
) -> Counterfactuals:
    """Return counterfactuals of observed units; see ``SCM.counterfactual``."""
    tolerance, seen = real_number("tolerance", tolerance, least=0.0), observations(model, observed)
    try:
        last = _Abduction(model, seen, n, seed, tolerance)
        found = last.answer(do)
    except _DrawsNeeded:
        last = _Abduction(model, seen, DRAWS, seed, tolerance)
        found = last.answer(do)
    rows, unmet = np.arange(seen.rows), last.unmet
    for number in range(ROUNDS):
        far, drawn = last.nearer(number)
        if not far.size:
            break
        rows, seen = rows[far], seen.some(far)
        last = _Abduction(model, seen, last.n, seed, tolerance, drawn)
        better = last.effective > found.effective[rows]
        if better.any():
            _replace(found, rows[better], last.answer(do), better)
    row, fewest = found.effective.argmin(), found.effective.min()
    if fewest == 0.0:  # the observation is possible, but no draw agrees with it
        where = f"in row {row}, " * (len(found.weights) > 1)
        text = f"{unmet!r}: {where}none of {last.n} draws gives the observed value"
        advice = "observe its causes, declare inverse_noise, draw more (n) or allow a tolerance"
        raise ModelError([f"{text}: {advice}"])
    if fewest < min(FEW, 0.5 * found.weights.shape[1]) and not found.exact:
        where = f" of row {row}" * (len(found.weights) > 1)
        text = f"few draws fit the observations{where}: their effective number is {fewest:.1f}"
        advice = "means are off and intervals too narrow; draw more (n), or observe the causes"
        warnings.warn(f"{text}, below {FEW}, so {advice}", stacklevel=3)
    return found


@final
class _Abduction:
    """The noise of observed units, with ``n`` draws for each; None forbids draws."""

    def __init__(
        self,
        model: SCM,
        seen: Observations,
        n: int | None,
        seed: int,
        tolerance: float,
        drawn: _Drawn | None = None,
    ) -> None:
        self._exact, self.n = n is None, 1 if n is None else whole_number("n", n, least=1)
        self.model, self._tolerance = model, tolerance
        own = np.random.SeedSequence((whole_number("seed", seed, least=0), 1))  # not that of data
        self._noise = Noise(int(own.generate_state(1)[0]))
        self._together = CompiledModel(model).is_vectorised
        self._seen, self._rows, self._size = seen, seen.rows, seen.rows * self.n
        if self._size * seen.steps > MOST:
            text = f"{seen.rows} units of {seen.steps} instants with {self.n} draws are too many"
            raise ModelError([f"{text}: give fewer rows at once, or a smaller n"])
        self._is_nearer, self._drawn = drawn is not None, drawn or _Drawn({}, np.zeros(self._size))
        watched = [name for name, v in seen.values.items() if np.isfinite(v).any()]
        self._told = {*watched}.union(*map(model.ancestors, watched))  # what evidence tells about
        self._hidden: dict[tuple[str, int], tuple[Any, Value]] = {}
        self._log_weights = self._drawn.log_ratio.copy()
        self.unmet = ""  # the first observation that no draw of some unit gives
        self._spent = np.zeros(self._size)  # log weights by which draws were resampled
        self._ancestors = np.tile(np.arange(self.n), self._rows)
        self.sampled = False
        self._given: list[dict[str, Value]] = []  # noise, and roots without intervention, by step
        self._values: list[dict[str, Value]] = []
        self._first: dict[str, Value] = {}  # the instant before the first step
        self._before: Values = {}
        order = model.structure.order
        for step in range(seen.steps):
            self._given.append(self._constants() if step else {})
            self._values.append({})
            if model.is_temporal and not step:  # the instant before has the constants, too
                for name in order:
                    if model[name].per_episode and not model[name].all_parents:
                        self._find(model[name], 0)
                self._first = self._before = self._start(model, {}, model)
            for name in order:
                if name not in self._values[-1]:
                    self._find(model[name], step)
            self._before = model._remembered(self._values[-1], self._before)
            if step < seen.steps - 1 and not self._is_nearer:
                self._draw_again(step)
        self._noises = {(name, step): self._given[step][name] for name, step in self._hidden}

    def is_set_at_once(self, name: str) -> bool:
        """Return False for every variable; see ``CausalSystem``."""
        return False

    def _sample(self, draws: object) -> None:
        """Record whether there are draws; refuse them if they are forbidden."""
        if draws and self._exact:
            raise _DrawsNeeded
        self.sampled |= bool(draws)

    def _constants(self) -> dict[str, Value]:
        """Return the noise that is drawn once per episode."""
        known = self._given[0].items()
        return {name: value for name, value in known if self.model[name].per_episode}

    # --- abduction ------------------------------------------------------------------------------

    def _find(self, variable: Variable, step: int) -> None:
        """Infer the value and noise of a variable from its observation and its causes."""
        name, given = variable.name, self._given[-1]
        wanted = np.repeat(self._seen.values[name][:, step], self.n, axis=0)
        there = ~np.isnan(wanted).reshape(self._size, -1).any(axis=1)
        wanted = np.nan_to_num(wanted)
        natural = self._without_intervention(name, wanted) if there.any() else wanted
        source = variable.own_noise
        unsure = self.sampled and bool(variable.all_parents)
        if source is None and _is_free(variable):
            given[name] = _either(there, natural, variable.first)
        elif source is not None and name not in given:
            found = self._inverted(variable, source, natural, step) if there.any() else None
            hidden = there & (found is None) | ~there
            self._sample(hidden.any() or (found is not None and found.drawn))
            given[name] = self._noise_of(variable, source, step, hidden)
            unsure |= found is None
            if found is not None:
                log = _summed(found)
                possible = there & np.isfinite(log)
                self._weigh(name, there & ~possible, unsure=unsure)
                self._log_weights[possible] += log[possible]
                given[name] = _either(possible, found.noise, given[name])
        value = self._computed(self.model, name, self._values[-1], self._before, step)
        apart = np.abs(np.asarray(value, dtype=float) - wanted).reshape(self._size, -1)
        most = self._tolerance * (1.0 + np.abs(wanted)).reshape(self._size, -1)
        self._weigh(name, there & ~(apart <= most).all(axis=1), unsure=unsure)
        value = _either(there, wanted, value)
        whole = variable.dtype != "real"
        self._values[-1][name] = np.rint(value).astype(np.int64) if whole else value

    def _without_intervention(self, name: str, value: Value) -> Value:
        """Return the value that an observed variable would have without its shift or scale."""
        act = self.model._act_on(name)
        if act is None or not isinstance(done := act.intervention, Soft):
            return value
        asked: Any = act.requested

        def natural(_: NoiseKey, known: Values) -> Value:
            there = known[name] if asked.name == name else asked.equation.bind()(known[name])
            there = done.undone(there, name)
            return np.asarray(there if asked.name == name else asked.inverse.bind()(there))

        return self._each(natural, 0, {}, {name: value})

    def _noise_of(self, variable: Variable, source: Any, step: int, hidden: Value) -> Value:
        """Draw the noise of a variable, and weigh it where it is hidden."""
        name, shape = variable.name, variable.shape_of_noise
        found = proposed(source, shape, self._shares(f"{name}|hidden", shape, step))
        if found is not None:
            self._log_weights += np.where(hidden, _summed(found), 0.0)
            return found.noise
        key = NoiseKey(self._noise, 0, step, self._size)
        noise = key.natural(source, name, shape, self._values[-1])
        continuous = isinstance(source, Box | Continuous | Normal) and not source.parents()
        if continuous and name in self._told and hidden.any():
            self._hidden[name, step] = source, hidden
            if self._is_nearer:
                scores = self._drawn.scores[name, step]
                return np.where(np.isnan(scores), noise, noise_of(source, scores))
        return noise

    def _shares(self, name: str, shape: tuple[int, ...], step: int) -> Floats:
        size = int(np.prod(shape))
        found = self._noise.uniforms(name, n=size, step=step, count=self._size)
        return found.reshape(self._size, *shape)

    def _inverted(self, variable: Variable, source: Any, value: Value, step: int) -> Found | None:
        """Infer the noise of a variable from an observed value; None if only draws are possible."""
        name, shape, values = variable.name, variable.shape, self._values[-1]
        if variable.is_root:
            try:
                log = density_of(source, shape, values).log_density(value)
            except ModelError:
                if source.parents():
                    raise
                inside = getattr(source, "contains", lambda _: True)
                log = np.array([0.0 if inside(each) else -np.inf for each in value])
            # without causes the density is the same for all draws
            return Found(value, log if source.parents() else np.where(np.isfinite(log), 0.0, log))
        parents: list[Value] = []
        for parent in variable.all_parents:
            known = self._before if parent.lag else values
            where = earlier(parent.name, parent.lag) if parent.lag else parent.name
            first = self.model.declared(parent.name).first
            parents.append(known.get(where, np.broadcast_to(first, (self._size, *first.shape))))

        def apply(
            function: Any, parents: list[Value], noise: Values, shape: tuple[int, ...]
        ) -> Value:
            def called(key: NoiseKey, parents: Mapping[Any, Value], noise: Values) -> Value:
                whole = shape if key.count is None else (key.count, *shape)
                with blamed(f"a function of {name!r}"), np.errstate(all="ignore"):
                    try:
                        found = np.asarray(function(*parents.values(), **noise), dtype=float)
                    except (ArithmeticError, ValueError):  # undefined, such as the logarithm of 0
                        found = np.array(np.nan)
                    return np.broadcast_to(found, whole)

            return self._each(called, step, {}, dict(enumerate(parents)), noise)

        shares = self._shares(f"{name}|abduction", shape, step)
        return noise_given(variable, source, value, parents, apply, shares)

    def _weigh(self, name: str, wrong: Value, *, unsure: bool) -> None:
        """Discard draws that contradict an observation; raise if nothing could agree with it."""
        logs = self._log_weights.reshape(self._rows, self.n)
        before = np.isinf(logs).all(axis=1)
        self._log_weights[wrong] = -np.inf
        lost = np.isinf(logs).all(axis=1) & ~before
        if not lost.any() or self._is_nearer:
            return
        if unsure:  # the observation is possible, but no draw agrees with it
            self.unmet = self.unmet or name
            return
        row = f"in row {lost.argmax()}, " if self._rows > 1 else ""
        variable = self.model[name]
        if variable.own_noise is None:
            why = "its causes give another value, and it has no noise"
        else:
            why = "no value of its noise gives the observed value"
            how = variable.noise_inverse
            why += f", by its inverse_noise ({how})" if isinstance(how, str) else ""
        raise ImpossibleObservation(name, row + why)

    def _weights(self) -> Floats:
        return weights_of(self._log_weights.reshape(self._rows, self.n))

    @property
    def effective(self) -> Floats:
        """Effective number of draws of each unit; 0 where no draw is possible."""
        return _effective(self._weights(), self._ancestors.reshape(self._rows, self.n))

    def nearer(self, number: int) -> tuple[Numbers, _Drawn]:
        """Draw the hidden noise again for units whose draws are far from the evidence.

        Returns:
            The rows of these units, and the draws. Units are left out if they have no continuous
            hidden noise, or so much of it that the draws do not show its covariance.
        """
        n, effective = self.n, self.effective
        far = np.flatnonzero(effective < ENOUGH * min(n, MANY))
        if not far.size or not self._hidden:
            return far[:0], self._drawn
        units = (far[:, None] * n + np.arange(n)).ravel()
        each = {}
        for key, (source, hidden) in self._hidden.items():
            scores = scores_of(source, self._noises[key][units])
            each[key] = _either(hidden[units], scores, np.array(np.nan))
        flat = [scores.reshape(len(units), -1) for scores in each.values()]
        old = np.hstack(flat).reshape(len(far), n, -1)
        size = np.isfinite(old[:, 0]).sum(axis=1)
        able = (size > 0) & (size <= ENOUGH * n) & ((size <= LARGE) | (number < 3))
        far, old = far[able], old[able]
        logs = self._log_weights.reshape(self._rows, n)[far]
        evidence = logs + (self._spent - self._drawn.log_ratio).reshape(self._rows, n)[far]
        new, ratio = np.full(old.shape, np.nan), np.zeros(logs.shape)
        numbers = {"step": number, "count": logs.size}
        normal = self._noise.draw(Normal(), "|nearer", old.shape[2:], {}, **numbers)
        for unit, own in enumerate(np.isfinite(old[:, 0])):
            scores, drawn = old[unit][:, own], normal.reshape(old.shape)[unit][:, own]
            new[unit][:, own], ratio[unit] = nearer(scores, evidence[unit], logs[unit], drawn)
        ends = np.cumsum([part.shape[1] for part in flat])
        parts = zip(each.items(), np.split(new, ends[:-1], axis=2), strict=True)
        found = {key: part.reshape(-1, *was.shape[1:]) for (key, was), part in parts}
        return far, _Drawn(found, ratio.ravel())

    def _draw_again(self, step: int) -> None:
        """Resample the draws of units whose effective number is below half."""
        weights = self._weights()
        few = (weights**2).sum(axis=1) > 2.0 / self.n
        if not few.any():
            return
        start = self._noise.uniforms("|again", n=1, step=step, count=self._rows)
        chosen = np.tile(np.arange(self.n), (self._rows, 1))
        for row in np.flatnonzero(few).tolist():
            points = (start[row] + np.arange(self.n)) / self.n
            chosen[row] = np.searchsorted(np.cumsum(weights[row]), points).clip(max=self.n - 1)
        logs = self._log_weights.reshape(self._rows, self.n)
        self._spent.reshape(logs.shape)[few] += logs[few]
        logs[few] = 0.0
        where = (chosen + self.n * np.arange(self._rows)[:, None]).ravel()
        self._ancestors, self._spent = self._ancestors[where], self._spent[where]
        self._before = {name: np.asarray(value)[where] for name, value in self._before.items()}
        for instant in (self._first, *self._given, *self._values):
            instant.update({name: np.asarray(value)[where] for name, value in instant.items()})

    # --- action and prediction ------------------------------------------------------------------

    def answer(self, do: Mapping[str, Any]) -> Counterfactuals:
        models = self._models(do)
        was = self.model._act_on
        changes = [{name for name in model if model._act_on(name) != was(name)} for model in models]
        follow = set[str]().union(*changes)
        follow |= {n for m in models for name in follow for n in m.descendants(name)}
        kept = {name: value for name, value in self._first.items() if name not in follow}
        before, found = self._start(models[0], kept, changes[0]), list[dict[str, Value]]()
        for step, factual in enumerate(self._values):
            model, targets, values = models[step], changes[step], dict[str, Value]()
            for name in model.structure.order:
                variable: Variable = self.model[name]
                moves = variable.is_root and variable.all_parents
                if name not in follow or (name not in targets and _is_free(variable) and not moves):
                    values[name] = factual[name]
                    continue
                if name in targets:
                    self._renew(model, name, values, step)
                elif moves:
                    self._given[step][name] = _moved(variable, factual, values)
                values[name] = self._computed(model, name, values, before, step)
            found.append(values)
            before = model._remembered(values, before)
        return Counterfactuals(
            factual=self._stacked(self._values),
            counterfactual=self._stacked(found),
            weights=self._weights(),
            exact=not self.sampled,
            one=self._seen.one,
            ancestors=self._ancestors.reshape(self._rows, self.n),
            model=self.model,
        )

    def _models(self, do: Mapping[str, Any]) -> list[SCM]:
        """Return the model under the interventions of each control step."""
        plan, found, model = Plan(numbered(self.model, do)), [], self.model
        for name, act in plan.timed():
            begin = act.time.start
            if begin is None or act.time.every is not None or begin >= self._seen.steps:
                allowed = (f"at= and during= from control step 0 to {self._seen.steps - 1}",)
                raise UnknownOption(f"time of an intervention on {name}", act, allowed)
        there: Any = self  # it has a model, and no events are awaited
        memory = Memory()
        for step in range(self._seen.steps):
            model = model.do(plan._due(there, step, memory))
            new = {  # its draws are independent of the abducted noise
                name: act.model_copy(update={"stream": "counterfactual"})
                for name, act in model.interventions.items()
                if isinstance(act, Draw) and not act.stream
                if self.model.interventions.get(name) != act
            }
            model = model._with_interventions(new) if new else model
            found.append(model)
        return found

    def _renew(self, model: SCM, name: str, values: Values, step: int) -> None:
        """Draw noise that an intervention needs: of a draw, of a mechanism, or unabducted noise."""
        variable, act = model[name], model._act_on(name)
        done = None if act is None else act.intervention
        draws = done is not None and done.draws
        self._sample(draws)
        source, held = variable.own_noise, self._given[step]
        other = done is not None and done.has_new_noise
        if draws or source is None or (name in held and not other):
            return
        self._sample(True)
        key = NoiseKey(self._noise, 0, 0 if variable.per_episode else step, self._size)
        shape = self.model.declared(name).shape_of_noise
        held[name] = key.draw(source, name, shape, values, "counterfactual")

    def _stacked(self, instants: list[dict[str, Value]]) -> dict[str, Floats]:
        """Return all values by variable, shape (rows, n, *shape) or (rows, n, steps, *shape)."""
        found = {}
        for name in self.model:
            values = np.stack([np.asarray(each[name]) for each in instants], axis=1)
            shaped = values.reshape(self._rows, self.n, *values.shape[1:])
            found[name] = shaped if self.model.is_temporal else shaped[:, :, 0]
        return found

    # --- evaluation -----------------------------------------------------------------------------

    def _computed(self, model: SCM, name: str, values: Values, before: Values, step: int) -> Value:
        given = self._given[step]
        known = {**values, name: given[name]} if name in given else values

        def solved(key: NoiseKey, known: Values, before: Values) -> Value:
            return model.solve(known, previous=before, key=key, only=(name,))[name]

        return self._each(solved, step, given, known, before)

    def _start(self, model: SCM, kept: Values, changed: Iterable[str]) -> dict[str, Value]:
        """Compute the values before the first step; ``changed`` are targets that may draw there."""
        values, given = dict[str, Value](), self._constants()
        back = {edge.cause for edge in model.edges if edge.lag}
        for name in changed:
            act, declared = model._act_on(name), model.declared(name)
            done = None if act is None else act.intervention
            draws = done is not None and done.draws and not declared.per_episode
            if done is not None and done.computes:
                draws = not done.keeps_function(declared) and model[name].own_noise is not None
            self._sample(draws and back & {name, *model.descendants(name)})
        for name in model.structure.order if model.is_temporal else ():
            variable = model[name]
            if name in kept:
                values[name] = kept[name]
                continue
            if name in given:
                values[name] = given[name]
            elif _is_free(variable) and not variable.is_root:
                values[name] = np.zeros((self._size, *variable.shape))

            def begun(key: NoiseKey, known: Values, name: str = name) -> Value:
                return model.solve(known, key=key, only=(name,), begins=True)[name]

            values[name] = self._each(begun, 0, given, values)
        return values

    def _each(
        self, function: Callable[..., Value], step: int, given: Values, *known: Mapping[Any, Value]
    ) -> Value:
        """Call a function of values for all units together, or unit by unit."""
        if self._together:
            key = NoiseKey(self._noise, 0, step, self._size, given=given)
            return np.asarray(function(key, *known))
        rows = []
        for row in range(self._size):
            noise, *values = ({n: v[row] for n, v in each.items()} for each in (given, *known))
            rows.append(function(NoiseKey(self._noise, row, step, given=noise), *values))
        return np.array(rows)


def _moved(variable: Any, was: Values, values: Values) -> Value:
    """Move a draw with the bounds of its box."""
    source, shape = variable.distribution, variable.shape
    if not isinstance(source, Box):
        text = f"{variable.name!r} depends on the intervention through {source!r}"
        raise ModelError([f"{text}; only a Box may depend on it"])
    (low, high), (lower, higher) = source.bounds(shape, was), source.bounds(shape, values)
    share = (was[variable.name] - low) / np.where(high > low, high - low, 1.0)
    return lower + share * (higher - lower)


def _summed(found: Found) -> Floats:
    """Return the log weight of each draw, shape (units,)."""
    return np.asarray(found.log_density.reshape(len(found.log_density), -1).sum(axis=1))


def _either(there: Value, one: Value, other: Value) -> Value:
    """Return ``one`` for units where ``there`` is true, and ``other`` elsewhere."""
    return np.where(there.reshape(-1, *(1,) * (np.ndim(one) - 1)), one, other)


def _effective(weights: Floats, ancestors: Numbers) -> Floats:
    """Return the effective number of draws of each row; draws of one ancestor count as one."""
    mass = np.zeros_like(weights)
    np.add.at(mass, (np.arange(len(mass))[:, None], ancestors), weights)
    total = (mass**2).sum(axis=1)
    return np.where(total > 0.0, 1.0 / np.maximum(total, 1e-300), 0.0)


def _replace(found: Counterfactuals, rows: Numbers, other: Counterfactuals, where: Value) -> None:
    """Put the units of others that are marked into some rows."""
    pairs = [(found.weights, other.weights), (found.ancestors, other.ancestors)]
    for name in found:
        pairs.append((found.factual[name], other.factual[name]))
        pairs.append((found.counterfactual[name], other.counterfactual[name]))
    for one, another in pairs:
        one[rows] = another[where]


def _is_free(variable: Variable) -> bool:
    """Return whether a variable has neither a mechanism nor a fixed value."""
    return not variable.is_constant and variable.equation is None
