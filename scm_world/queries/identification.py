"""Effects identified from observational data, and compared with simulated interventions."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any, final

import networkx as nx
import numpy as np

from scm_world._types import ArrayLike, Floats, Integers
from scm_world.errors import ModelError, UnknownOption
from scm_world.graph import SCM, episode_outcome
from scm_world.graph.evaluate import AppliedIntervention, source_of
from scm_world.queries.estimates import CONFIDENCE, Effect
from scm_world.queries.outcomes import Outcome, as_outcome
from scm_world.queries.plans import Plan
from scm_world.variables import Draw, Mechanism


@final
@dataclass(frozen=True)
class Identification:
    """The sets of observed variables from which an effect follows without an intervention.

    Attributes:
        treatment: The cause.
        outcome: The effect.
        graph: Of one episode, with what nature does.
        backdoor: A smallest set of observed variables that blocks every back door; None if there
            is none.
        frontdoor: Smallest sets of observed mediators that meet the front-door criterion.
    """

    treatment: str
    outcome: str
    graph: nx.DiGraph
    backdoor: tuple[str, ...] | None
    frontdoor: tuple[tuple[str, ...], ...] = ()


def nature_graph(
    model: SCM,
    nature: Mapping[str, Any] | None,
    outcomes: Iterable[str],
    *,
    contact: bool = True,
) -> nx.DiGraph:
    """Give the static graph of an episode in which nature does something at the beginning.

    Args:
        model: Of the world.
        nature: What varies by itself; a ``Mechanism`` adds its edges, and so does a ``Draw`` from
            a space that follows other variables.
        outcomes: What the episode ends with.
        contact: Whether bodies may touch; edges by contact are left out if not.

    Raises:
        ModelError: Nature does something later than at the beginning.
    """
    plan = Plan(nature)
    acts = plan.at_first()
    late = sorted(
        {name for name in plan if name not in acts} | {n for n in plan if len(plan[n]) > 1}
    )
    if late:
        raise ModelError(
            [f"what nature does to {name!r} has to happen at the beginning" for name in late]
        )
    moved = [name for name in acts if model.declared(model.target(name)).role == "state"]
    states = [target for name in moved for target in model.targets(name)]
    held = model.do({name: act for name, act in acts.items() if name not in moved})
    graph = episode_outcome(held, outcomes, starts=states, contact=contact)
    for name in moved:
        followed = sorted(_followed(model, name, acts[name]))
        causes = [n if n in graph else f"{n}@0" for n in followed]
        for target in model.targets(name):
            graph.add_edges_from((cause, f"{target}@0") for cause in causes)
    return graph


def _followed(model: SCM, name: str, act: Any) -> frozenset[str]:
    """Name what a state follows at the beginning: parents of a mechanism or of a space."""
    if isinstance(act, Mechanism):
        return frozenset(parent.name for parent in act.parents)
    if isinstance(act, Draw):
        return source_of(AppliedIntervention(act, model.declared(name))).parents()
    return frozenset()


def identify(
    graph: nx.DiGraph,
    treatment: str,
    outcome: str,
    *,
    observed: Iterable[str] | None = None,
    frontdoor: bool = False,
) -> Identification:
    """Find the variables from which an effect can be estimated without an intervention.

    Args:
        graph: Directed and acyclic.
        treatment: A node.
        outcome: A node.
        observed: The observed nodes; all if None.
        frontdoor: Whether to look for front doors of up to three mediators, too.

    Raises:
        UnknownOption: There is no such node, or both are one.
        ModelError: The graph has a cycle, or no directions.

    Source:
        Pearl, *Causality*, 2nd edition, 3.3.1 and 3.3.2; the smallest separator is that of networkx
        (van der Zander, Liśkiewicz and Textor, 2019).

    Example:
        >>> graph = nx.DiGraph([("z", "x"), ("z", "y"), ("x", "y"), ("w", "y")])
        >>> identify(graph, "x", "y").backdoor
        ('z',)
        >>> identify(graph, "x", "y", observed=["x", "y", "w"]).backdoor is None
        True
    """
    if not (graph.is_directed() and nx.is_directed_acyclic_graph(graph)):
        raise ModelError(["the graph has to be directed and acyclic"])
    seen = tuple(graph) if observed is None else tuple(observed)
    for node in (treatment, outcome, *seen):
        if node not in graph:
            raise UnknownOption("node", node, tuple(map(str, graph)))
    if treatment == outcome:
        raise UnknownOption("outcome", outcome, ("another node than the treatment",))
    watched = set(seen) - {treatment, outcome}
    allowed = watched - nx.descendants(graph, treatment)
    behind = graph.copy()
    behind.remove_edges_from(list(graph.out_edges(treatment)))
    found = nx.find_minimal_d_separator(behind, {treatment}, {outcome}, restricted=allowed)
    backdoor = None if found is None else tuple(sorted(found))
    doors = tuple(_front_doors(graph, treatment, outcome, watched)) if frontdoor else ()
    return Identification(treatment, outcome, graph, backdoor, doors)


def _front_doors(
    graph: nx.DiGraph, treatment: str, outcome: str, observed: set[str]
) -> Iterator[tuple[str, ...]]:
    """List the smallest sets of mediators that meet Pearl's front-door criterion."""
    between = nx.descendants(graph, treatment) & nx.ancestors(graph, outcome) & observed
    behind = graph.copy()
    behind.remove_edges_from(list(graph.out_edges(treatment)))
    for size in (1, 2, 3):
        found = False
        for mediators in combinations(sorted(between), size):
            without, after = graph.copy(), graph.copy()
            without.remove_nodes_from(mediators)
            after.remove_edges_from(list(graph.out_edges(mediators)))
            intercepts = not nx.has_path(without, treatment, outcome)
            unconfounded = nx.is_d_separator(behind, {treatment}, set(mediators), set())
            blocked = nx.is_d_separator(after, set(mediators), {outcome}, {treatment})
            if intercepts and unconfounded and blocked:
                found = True
                yield mediators
        if found:
            return


@final
@dataclass(frozen=True)
class ObservationalEffect:
    """An effect of a treatment on an outcome, estimated without an intervention.

    Attributes:
        mean: Of the outcome at the second value of the treatment minus that at the first.
        low: Lower end of the 95 % interval.
        high: Upper end.
        outside: Share of the units in which one of the two values lies beyond the central 98 % of
            what the treatment was in like units. There the estimate is an extrapolation.
        n: How many units.
    """

    mean: float
    low: float
    high: float
    outside: float
    n: int

    def __str__(self) -> str:
        text = f"{self.mean:.4g} [{self.low:.4g}, {self.high:.4g}]"
        return text + (f" ({self.outside:.0%} extrapolated)" if self.outside > OUTSIDE else "")


OUTSIDE = 0.1
"""An estimate with a larger share of extrapolated units says so."""


def adjusted_effect(
    treatment: ArrayLike, covariates: ArrayLike, outcome: ArrayLike, values: tuple[float, float]
) -> ObservationalEffect:
    """Estimate an effect by adjustment for covariates that block every back door.

    A regression of the outcome is averaged over the units with the treatment at both values. It is
    a sum of cubic splines of the treatment and of each covariate, and of the products of two. What
    three of them do together, and products of curved functions, it cannot follow.

    Args:
        treatment: Shape (n,).
        covariates: Shape (n, k); k may be 0.
        outcome: Shape (n,).
        values: Of the treatment.

    Raises:
        ModelError: The treatment does not vary, or there are too few units.

    Source:
        Hernán and Robins, *Causal inference: what if*, 13; the variance is HC3 of MacKinnon and
        White, Journal of Econometrics 29, 1985.
    """
    from scipy.special import stdtrit

    causes = np.column_stack([treatment, np.reshape(covariates, (len(np.ravel(treatment)), -1))])
    effect, basis = np.asarray(outcome, dtype=np.float64), _Basis(causes)
    table = basis(causes)
    n, terms = table.shape
    if n < 2 * terms:
        raise ModelError([f"{n} units are too few for {terms} coefficients; {2 * terms} will do"])
    if not causes[:, 0].std() > 0.0:
        raise ModelError(["the treatment does not vary: let nature draw it, or give it a cause"])
    inverse = np.linalg.pinv(table.T @ table)
    slopes = inverse @ table.T @ effect
    leverage = np.minimum(np.einsum("ij,jk,ik->i", table, inverse, table), 1.0 - 1e-9)
    residuals = (effect - table @ slopes) / (1.0 - leverage)
    each = _contrast(basis, causes, values)
    influence = table @ inverse @ each.mean(axis=0) * residuals
    variance = float(influence @ influence) + float((each @ slopes).var(ddof=1)) / n
    degrees = n - int(np.linalg.matrix_rank(table))
    half = float(stdtrit(degrees, 0.5 + 0.5 * CONFIDENCE)) * math.sqrt(variance)
    mean = float(each.mean(axis=0) @ slopes)
    return ObservationalEffect(mean, mean - half, mean + half, _outside(causes, values), n)


def frontdoor_effect(
    treatment: ArrayLike,
    mediators: ArrayLike,
    outcome: ArrayLike,
    values: tuple[float, float],
    *,
    seed: int = 0,
) -> ObservationalEffect:
    """Estimate an effect by the front-door formula.

    Each mediator is a spline of the treatment plus the residual of a unit, and the outcome is the
    regression of ``adjusted_effect`` on mediators and treatment, averaged over both.

    Args:
        treatment: Shape (n,).
        mediators: Shape (n, k): a set that meets the front-door criterion.
        outcome: Shape (n,).
        values: Of the treatment.
        seed: Of the bootstrap over units, of 400 resamples, that gives the interval.

    Raises:
        ModelError: The treatment does not vary, or there are too few units.

    Source:
        Pearl, *Causality*, 2nd edition, 3.3.2.
    """
    from scipy.special import stdtrit

    given = np.asarray(treatment, dtype=np.float64).reshape(-1, 1)
    between = np.asarray(mediators, dtype=np.float64).reshape(len(given), -1)
    effect, n = np.asarray(outcome, dtype=np.float64), len(given)
    if not given.std() > 0.0:
        raise ModelError(["the treatment does not vary: let nature draw it, or give it a cause"])
    first, second = _Basis(given), _Basis(np.hstack([between, given]))
    terms = second(np.hstack([between, given])).shape[1]
    if n < 2 * terms:
        raise ModelError([f"{n} units are too few for {terms} coefficients; {2 * terms} will do"])
    rng = np.random.default_rng(seed)

    def estimate(rows: Integers) -> float:
        x, m, y = given[rows], between[rows], effect[rows]
        moved, *_ = np.linalg.lstsq(first(x), m, rcond=None)
        slopes, *_ = np.linalg.lstsq(second(np.hstack([m, x])), y, rcond=None)
        rest = (m - first(x) @ moved)[rng.permutation(n)]  # independent of the treatment
        sides = []
        for value in values:
            there = first(np.full((1, 1), float(value))) @ moved + rest
            sides.append(second(np.hstack([there, x])) @ slopes)
        return float((sides[1] - sides[0]).mean())

    mean = estimate(np.arange(n))
    drawn = [estimate(rng.integers(n, size=n)) for _ in range(400)]
    half = float(stdtrit(n - terms, 0.5 + 0.5 * CONFIDENCE)) * float(np.std(drawn, ddof=1))
    return ObservationalEffect(mean, mean - half, mean + half, _outside(given, values), n)


class _Basis:
    """Functions of which a regression is a sum, fixed by the units that it is made from.

    Args:
        causes: Shape (n, k).
    """

    def __init__(self, causes: Floats) -> None:
        n, k = causes.shape
        self._middle, self._scale = causes.mean(axis=0), causes.std(axis=0) + 1e-300
        pieces = int(np.clip(n // (15 * k), 1, 8))
        self._knots: list[Floats | None] = []
        for column in ((causes - self._middle) / self._scale).T:
            if len(np.unique(column)) <= 4:  # a few values: a line, and the products
                self._knots.append(None)
                continue
            inner = np.unique(np.quantile(column, np.linspace(0.0, 1.0, pieces + 1)))
            self._knots.append(np.r_[[inner[0]] * 3, inner, [inner[-1]] * 3])

    def __call__(self, causes: Floats) -> Floats:
        """Give the functions at some units, shape (m, terms); beyond the data they go on."""
        from scipy.interpolate import BSpline

        z = (causes - self._middle) / self._scale
        columns = [np.ones((len(z), 1)), z]
        for column, knots in zip(z.T, self._knots, strict=True):
            if knots is not None:
                made = BSpline.design_matrix(column, knots, 3, extrapolate=True).toarray()
                columns.append(made[:, 1:-1])  # constants and lines are there already
        k = z.shape[1]
        columns += [z[:, [i]] * z[:, [j]] for i in range(k) for j in range(i)]
        return np.hstack(columns)


def _contrast(basis: Callable[[Floats], Floats], causes: Floats, values: Any) -> Floats:
    """Give the difference of the functions of each unit between both values of the treatment."""
    sides = []
    for value in values:
        side = causes.copy()
        side[:, 0] = value
        sides.append(basis(side))
    return sides[1] - sides[0]


def _outside(causes: Floats, values: tuple[float, float]) -> float:
    """Give the share of units in which a value is beyond what the treatment was in like units."""
    treatment, others = causes[:, 0], causes[:, 1:]
    expected = np.full(len(causes), treatment.mean())
    if others.shape[1]:
        table = _Basis(others)(others)
        slopes, *_ = np.linalg.lstsq(table, treatment, rcond=None)
        expected = table @ slopes
    low, high = np.quantile(treatment - expected, [0.01, 0.99])
    apart = np.array(values)[:, None] - expected
    return float(np.any((apart < low) | (apart > high), axis=0).mean())


@final
@dataclass(frozen=True)
class AdjustmentCheck:
    """An effect estimated from observational data, beside that of simulated interventions.

    Attributes:
        identification: What was adjusted for.
        adjusted: The estimate with adjustment.
        naive: The estimate without.
        simulated: The effect of interventions.
        margin: Differences up to here count as none.
    """

    identification: Identification
    adjusted: ObservationalEffect
    naive: ObservationalEffect
    simulated: Effect
    margin: float

    def difference(self, estimate: ObservationalEffect) -> tuple[float, float, float]:
        """Give estimate minus simulated effect, with the ends of its 95 % interval.

        Source:
            Zou and Donner, *Construction of confidence limits about effect measures*, Statistics
            in Medicine 27, 2008.
        """
        truth = float(self.simulated.mean)
        reach = np.nan_to_num(float(self.simulated.high) - truth)  # nothing varies: no error
        mean = estimate.mean - truth
        below = math.hypot(estimate.mean - estimate.low, reach)
        return mean, mean - below, mean + math.hypot(estimate.high - estimate.mean, reach)

    @property
    def agrees(self) -> bool:
        """Whether both effects are equivalent: their difference is within the margin for sure."""
        _, low, high = self.difference(self.adjusted)
        return -self.margin <= low and high <= self.margin

    @property
    def is_confounded(self) -> bool:
        """Whether the estimate without adjustment differs from the simulated effect for sure."""
        _, low, high = self.difference(self.naive)
        return low > 0.0 or high < 0.0

    def __str__(self) -> str:
        acted = (float(x) for x in (self.simulated.mean, self.simulated.low, self.simulated.high))
        found = self.identification
        mean, low, high = self.difference(self.adjusted)
        return (
            f"{found.treatment} → {found.outcome}: observational {self.adjusted} adjusted for "
            f"{', '.join(found.backdoor or ()) or 'nothing'}; {self.naive} unadjusted; "
            "interventional {:.4g} [{:.4g}, {:.4g}]; ".format(*acted)
            + f"difference {mean:.4g} [{low:.4g}, {high:.4g}], margin {self.margin:.4g}"
        )


def check_backdoor(
    world: Any,
    treatment: str,
    outcome: Any,
    *,
    values: tuple[float, float],
    nature: Mapping[str, Any],
    observed: Iterable[str] | None = None,
    n: int = 200,
    units: int = 50,
    margin: float | None = None,
    **setting: Any,
) -> AdjustmentCheck:
    """Estimate an effect from observational episodes, and compare it with interventions.

    Args:
        world: A ``scm_world.queries.World``.
        treatment: A parameter that nature varies.
        outcome: The name of a variable or an ``Outcome``, one number.
        values: Of the treatment: the effect is that of the second against the first.
        nature: What varies by itself.
        observed: The observed variables; all if None.
        n: How many episodes are observed.
        units: In how many units the effect is simulated.
        margin: Differences up to here count as none; a fifth of the simulated effect if None.
        setting: See ``World.sample``.

    Raises:
        ModelError: The effect is not identified, or there are too few episodes.
        UnknownOption: The outcome is no variable.
    """
    wanted = as_outcome(outcome)
    if world.model.declared(treatment).shape or np.shape(values) != (2,):
        raise UnknownOption("treatment", (treatment, values), ("one number, with two values",))
    if not isinstance(wanted, Outcome):
        raise UnknownOption("outcome", outcome, ("the name of a variable", "Outcome(name, how)"))
    graph = nature_graph(world.model, world.plan.do(nature), [wanted.name])
    found = identify(graph, treatment, wanted.name, observed=observed)
    if found.backdoor is None:
        raise ModelError(
            [f"the effect of {treatment!r} is not identified from {sorted(observed or graph)}"]
        )
    names = (treatment, *(name.removesuffix("@0") for name in found.backdoor))
    read = [Outcome(name, "first") for name in names]
    seen = world.see(n, outcomes=[*read, wanted], nature=nature, **setting)
    cause, *rest, effect = (np.asarray(column, float).reshape(n, -1) for column in seen.values())
    if effect.shape[1] != 1:
        raise UnknownOption("outcome", outcome, ("one number: Outcome(name, how, component)",))
    simulated = world.effect(
        wanted,
        do={treatment: values[1]},
        versus={treatment: values[0]},
        n=units,
        nature={name: act for name, act in nature.items() if name != treatment},
        **setting,
    )
    covariates = np.hstack(rest) if rest else np.empty((n, 0))
    adjusted = adjusted_effect(cause[:, 0], covariates, effect[:, 0], values)
    naive = adjusted_effect(cause[:, 0], np.empty((n, 0)), effect[:, 0], values)
    within = 0.2 * abs(float(simulated.mean)) if margin is None else float(margin)
    return AdjustmentCheck(found, adjusted, naive, simulated, within)
