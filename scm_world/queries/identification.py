"""Effects that are identified from observational data."""

from __future__ import annotations

import warnings
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any, final

import networkx as nx
import numpy as np

from scm_world._arguments import load, one_of, real_number, true_or_false, typed
from scm_world._patterns import as_names
from scm_world.errors import ModelError, UnknownOption, blamed
from scm_world.graph import SCM, Edge, episode_outcome
from scm_world.graph.views import projection, to_dag
from scm_world.queries.plans import Plan, at_once
from scm_world.variables import Intervention
from scm_world.world import CausalSystem

if TYPE_CHECKING:
    import pandas


@final
@dataclass(frozen=True)
class Identification:
    """The sets of observed variables that identify an effect without an intervention.

    ``str(found)`` says in a sentence whether the effect is identified, and by what.

    Attributes:
        treatment: The cause.
        outcome: The effect.
        graph: The graph.
        verdict: ``"no effect"``: no directed path leads from the treatment to the outcome.
            ``"identified"``: the distribution of the outcome under any value of the treatment
            follows from that of the observed variables, by the sets below or by the ID algorithm.
            ``"not identified"``: two models with this graph agree on everything observed, and
            differ in the effect.
        backdoor: A smallest set of observed variables that blocks all back-door paths, or None.
        frontdoor: Smallest sets of observed mediators that meet the front-door criterion.
        instruments: Observed variables that are associated with the treatment, and with the outcome
            through it alone.
        conditional_frontdoor: Mediators that meet the front-door criterion given covariates, each
            with these; searched for where no front door is found.
        hedge: Why the effect is not identified: observed variables that hidden causes join, with
            the treatment among them.
        is_bow: Whether a hidden cause acts on the treatment and on an observed variable that it
            acts on, on the way to the outcome.
    """

    treatment: str
    outcome: str
    graph: nx.DiGraph
    verdict: str
    backdoor: tuple[str, ...] | None
    frontdoor: tuple[tuple[str, ...], ...] = ()
    instruments: tuple[str, ...] = ()
    conditional_frontdoor: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = ()
    hedge: tuple[str, ...] = ()
    is_bow: bool = False

    def __str__(self) -> str:
        def listed(nodes: Iterable[str]) -> str:
            return ", ".join(map(str, nodes)) or "nothing"

        if self.verdict == "no effect":
            return f"{self.treatment} has no effect on {self.outcome}: no directed path leads there"
        ways = [] if self.backdoor is None else [f"adjustment for {listed(self.backdoor)}"]
        ways += [f"the front door {listed(mediators)}" for mediators in self.frontdoor]
        ways += [
            f"the conditional front door {listed(mediators)} given {listed(covariates)}"
            for mediators, covariates in self.conditional_frontdoor
        ]
        ends = f"the effect of {self.treatment} on {self.outcome}"
        if self.verdict == "not identified":
            why = (
                f"hidden causes join {listed(self.hedge)} ({'a bow' if self.is_bow else 'a hedge'})"
            )
            linear = f"; a linear one is, by the instrument {listed(self.instruments)}"
            return f"{ends} is not identified: {why}{linear if self.instruments else ''}"
        found = " or ".join(ways) or "the ID algorithm alone, as in the napkin graph"
        return f"{ends} is identified by {found}"

    @property
    def variables(self) -> dict[str, tuple[str, ...]]:
        """Variables to observe in addition to the ends, by criterion, the weakest first.

        ``"backdoor"`` and ``"frontdoor"`` identify any effect, ``"iv"`` a linear one.
        """
        ways = {} if self.backdoor is None else {"backdoor": self.backdoor}
        if self.frontdoor:
            ways["frontdoor"] = self.frontdoor[0]
        return ways | ({"iv": self.instruments} if self.instruments else {})


def in_force(model: SCM, context: Mapping[str, Any]) -> tuple[SCM, list[Edge]]:
    """Return the model under the interventions of a context that hold for the whole episode.

    Return also the edges into targets of all other interventions: a state that is set at an
    instant has edges with the condition ``"set"``.
    """
    others = list[tuple[str, Any, bool]]()

    def lasts(name: str, act: Intervention) -> bool:
        if name not in model:
            return False
        start, window = (0, None) if act.time is None else (act.time.start, act.time.during)
        is_instant = window is None and model.declared(model.target(name)).role == "state"
        if start == 0 and not is_instant and window in (None, (0, None)):
            return True
        others.append((name, at_once(act), is_instant))
        return False

    first = model.do(Plan(context).only(lasts).composed(model))
    return first, [
        Edge(parent.name, target, parent.lag, "set" if is_instant else parent.when)
        for name, act, is_instant in others
        for target in model.targets(name)
        for parent in first.do({name: act})[target].all_parents
    ]


@typed
def nature_graph(
    model: SCM | CausalSystem,
    nature: Mapping[str, Any] | None,
    outcomes: Iterable[str],
    *,
    contact: bool = True,
    without: Container[tuple[str, str, int]] = (),
) -> nx.DiGraph:
    """Return the static graph of an episode with a context distribution at the beginning.

    Args:
        model: A world, with the interventions it was given, or a model.
        nature: The context distribution: interventions at the beginning. A ``Mechanism`` adds its
            edges, and so does a ``Draw`` from a space with parents.
        outcomes: Names of the variables at the end of the episode.
        contact: Whether bodies may touch; edges by contact are left out if not.
        without: Edges (cause, effect, lag) that do not act, either.

    Raises:
        ModelError: An intervention of ``nature`` is later than the beginning.
        UnknownOption: ``model`` is not a model, or ``outcomes`` are not names.
    """
    given = getattr(model, "plan", {})
    model = model.model if isinstance(model, CausalSystem) else model
    if not isinstance(model, SCM):
        raise UnknownOption("model", model, ("a world, or an SCM, such as world.model",))
    plan = Plan().over(given, "given").over(nature, "nature").named(model)
    layers = [parts.items() for _, parts in plan.layers()]
    late = sorted(
        {n for of in layers for n, a in of if len(a) > 1 or (a[0].time and a[0].time.start)}
    )
    acts = plan.composed(model)
    if late:
        text = "the intervention of nature on {!r} has to be at the beginning"
        raise ModelError([text.format(name) for name in late])
    moved = [name for name in acts if model.declared(model.target(name)).role == "state"]
    states = [target for name in moved for target in model.targets(name)]
    held = model.do({name: act for name, act in acts.items() if name not in moved})
    graph = episode_outcome(
        held, as_names(outcomes), starts=states, contact=contact, without=without
    )
    for name in moved:
        act = acts[name].root
        followed = {parent.name for parent in act.follows(model.declared(name))}
        causes = [n if n in graph else f"{n}@0" for n in sorted(followed)]
        graph.add_edges_from((n, f"{target}@0") for target in model.targets(name) for n in causes)
    return graph


def identify(
    graph: SCM | CausalSystem | nx.DiGraph,
    treatment: str,
    outcome: str,
    *,
    observed: Iterable[str] | None = None,
    frontdoor: bool = False,
) -> Identification:
    """Find the variables from which an effect can be estimated without an intervention.

    Args:
        graph: A directed acyclic graph; of a system with lagged edges its two time slices are used.
        treatment: A node.
        outcome: A node.
        observed: The observed nodes; if None all but those with the attribute ``observed="no"``.
        frontdoor: Whether to search for front-door sets of up to three mediators, too, and for
            those given up to two covariates.

    Raises:
        UnknownOption: A node does not exist, both are the same, or ``graph`` is not a graph.
        ModelError: The graph has a cycle, or no directions.

    Source:
        Pearl, *Causality*, 2nd edition, 3.3.1, 3.3.2 and 7.4.5. A smallest separator is a smallest
        cut of the moral graph of the ancestors (van der Zander, Liśkiewicz and Textor, Artificial
        Intelligence 270, 2019); of several, the one nearest to the outcome. Xu et al., *Causal
        inference with conditional front-door adjustment*, 2023. The verdict is that of Tian and
        Pearl, *A general identification condition for causal effects*, AAAI 2002, which is complete
        (Shpitser and Pearl, AAAI 2006; Huang and Valtorta, UAI 2006).

    Example:
        >>> graph = nx.DiGraph([("z", "x"), ("z", "y"), ("x", "y"), ("w", "y")])
        >>> identify(graph, "x", "y").backdoor
        ('z',)
        >>> identify(graph, "x", "y", observed=["x", "y", "w"]).backdoor is None
        True
    """
    graph, frontdoor = to_dag(_graph_of(graph)), true_or_false("frontdoor", frontdoor)
    hidden = {node for node, seen in graph.nodes(data="observed") if seen == "no"}
    seen = set(graph) - hidden if observed is None else set(as_names(observed))
    for node in (treatment, outcome, *seen):
        if node not in graph:
            raise UnknownOption("node", node, tuple(map(str, graph)))
    if treatment == outcome:
        raise UnknownOption("outcome", outcome, ("another node than the treatment",))
    watched = seen - {treatment, outcome}
    allowed = watched - nx.descendants(graph, treatment)
    behind = _without_edges_from(graph, [treatment])
    backdoor = _smallest_separator(behind, treatment, outcome, allowed)
    instruments = tuple(
        node
        for node in sorted(allowed, key=str)
        if nx.is_d_separator(behind, {node}, {outcome}, set())
        and not nx.is_d_separator(graph, {node}, {treatment}, set())
    )
    directed, shared = projection(graph, seen | {treatment, outcome})
    hedge = _hedge(directed, shared, treatment, outcome)
    sizes = range(3 if backdoor is None else 1) if frontdoor and not hedge else ()
    searched = (_front_doors(graph, treatment, outcome, watched, size) for size in sizes)
    doors = next(filter(None, map(tuple, searched)), ())
    on_the_way = {*shared[treatment]} & {*directed[treatment]} & {*hedge}
    verdict = "not identified" if hedge else "identified"
    return Identification(
        treatment,
        outcome,
        graph,
        verdict if nx.has_path(directed, treatment, outcome) else "no effect",
        backdoor,
        tuple(mediators for mediators, given in doors if not given),
        instruments,
        tuple(door for door in doors if door[1]),
        hedge,
        bool(on_the_way),
    )


@final
@dataclass(frozen=True)
class NoEffect:
    """An effect of exactly 0, without an estimation; ``str(effect)`` says why it is.

    Attributes:
        reason: Why it is 0.
        value: The effect, 0, as in a ``CausalEstimate`` of DoWhy.
    """

    reason: str
    value: float = 0.0

    def get_confidence_intervals(self, **_: object) -> tuple[float, float]:
        """Return an interval without width, as a ``CausalEstimate`` of DoWhy has one."""
        return self.value, self.value

    def __str__(self) -> str:
        return f"the effect is 0: {self.reason}"


_METHODS = {
    "backdoor": "backdoor.linear_regression",
    "frontdoor": "frontdoor.two_stage_regression",
    "iv": "iv.instrumental_variable",
}
_OF_GROUPS = ("propensity", "matching", "doubly_robust")  # in the names of methods
DETERMINED = 1e-9
"""The largest part of a treatment's range that may be rounding where other columns determine it."""


@typed
def estimate(
    found: Identification,
    table: pandas.DataFrame,
    *,
    do: object,
    versus: object,
    method: str | None = None,
    method_params: Mapping[str, Any] | None = None,
) -> Any:
    """Estimate an effect that ``identify`` found from observational data, with DoWhy.

    Args:
        found: The result of ``identify``.
        table: A data frame whose columns have the names of nodes.
        do: Value of the treatment, a number or a label.
        versus: Reference value of the treatment.
        method: A criterion of ``found.variables``, as ``"backdoor"``, with a method of DoWhy:
            ``"backdoor.linear_regression"``; with another criterion the linear one alone. If None
            the linear one for the first criterion. Methods that compare groups (propensity scores,
            matching, doubly robust), and all methods if the treatment has labels, use the rows with
            ``do`` and with ``versus`` alone.
        method_params: Parameters of the method, as in ``estimate_effect`` of DoWhy.

    Returns:
        The ``CausalEstimate`` of DoWhy: ``value``, ``get_confidence_intervals()``, … Its treatment
        is counted from ``versus`` in units of ``do - versus``. A ``NoEffect`` if no directed path
        leads to the outcome, or if ``do`` equals ``versus``.

    Raises:
        MissingExtra: DoWhy is not installed.
        ModelError: The effect is not identified, the front door has several mediators, the
            table has missing values or lacks rows, or the method failed (``FunctionFailure``).
        UnknownOption: The table lacks a column, or an argument has the wrong type.

    Example:
        >>> found = identify(nx.DiGraph([("z", "x"), ("z", "y"), ("x", "y")]), "x", "y")
        >>> estimate(found, table, do=1.0, versus=0.0).value  # doctest: +SKIP
        2.03
    """
    if not isinstance(found, Identification):
        raise UnknownOption("found", found, ("a result of identify",))
    if not hasattr(table, "isna"):
        raise UnknownOption("table", type(table), ("a data frame, as pandas.DataFrame(table)",))
    if found.verdict == "no effect":
        return NoEffect(str(found))
    if not found.variables:
        advice = "observe more variables, look for front doors, or intervene (effect)"
        raise ModelError([f"{found}; {advice}"])
    way = next(iter(found.variables)) if method is None else str(method).partition(".")[0]
    one_of("method", way, tuple(found.variables))
    method = _METHODS[way] if method is None else method
    treatment, outcome, *others = [found.treatment, found.outcome, *found.variables[way]]
    data, labels = _columns(table, [treatment, outcome, *others])
    if outcome in labels or (labels and way != "backdoor"):
        raise ModelError([f"{method} needs numbers as values of {', '.join(labels)}"])
    _check_values(data[treatment], treatment in labels, do=do, versus=versus)
    if do == versus:
        return NoEffect(f"do and versus are both {do!r}")
    # DoWhy multiplies by the difference, ignores it, or cuts off decimals: the treatment gets the
    # values 1 (do) and 0 (versus), and DoWhy is asked for these.
    if treatment in labels or any(part in method for part in _OF_GROUPS):
        data = data[data[treatment].isin([do, versus])]
        if data[treatment].nunique() != 2:
            raise ModelError([f"{method} needs rows with {do!r} and with {versus!r}"])
        data = data.assign(**{treatment: data[treatment] == do})
    else:
        _check_varies(data, treatment, [n for n in others if way != "iv" and n not in labels])
        high, low = (float(np.asarray(value)) for value in (do, versus))
        counted = data[treatment].astype(float) - low
        data = data.assign(**{treatment: counted / (high - low)})
    graph = nx.DiGraph([(treatment, outcome)])  # of the criterion: the table has no other nodes
    if way == "backdoor":
        graph.add_edges_from((name, end) for name in others for end in (treatment, outcome))
    else:
        one_of("method", method, (_METHODS[way],))
        if way == "frontdoor" and len(others) > 1:
            raise ModelError([f"DoWhy takes one mediator of a front door, not {others}"])
        data = data.astype(float)
        data = data - data.mean()  # DoWhy's regression on several instruments has no constant
        if way == "iv" and len(others) == 1:  # DoWhy compares 1 and 0 where there are two values
            data[others[0]] -= data[others[0]].min()
            data[others[0]] /= data[others[0]].max()
        hidden = "hidden cause of " + " and ".join(data)
        graph.add_edges_from([(hidden, treatment), (hidden, outcome)])
        if way == "frontdoor":
            graph.remove_edge(treatment, outcome)
            graph.add_edges_from([(treatment, others[0]), (others[0], outcome)])
        graph.add_edges_from((name, treatment) for name in others if way == "iv")
    dowhy = load("dowhy", "dowhy")
    with warnings.catch_warnings(), blamed(f"{method} of DoWhy"):
        warnings.simplefilter("ignore")  # the hidden cause is not in the table
        model = dowhy.CausalModel(data, treatment, outcome, graph=graph)
        return model.estimate_effect(
            model.identify_effect(proceed_when_unidentifiable=True),
            method_name=method,
            method_params=dict(method_params or {}),
        )


def _columns(table: pandas.DataFrame, names: Sequence[str]) -> tuple[Any, list[str]]:
    """Return columns of a data frame, and which of them have labels, or refuse the table."""
    for name in names:
        one_of("column of the table", name, tuple(map(str, table.columns)))
    data = table[names]
    if data.shape[1] > len(names):
        raise ModelError(["the table has several columns of the same name"])
    if data.isna().any(axis=None):
        raise ModelError(["the table has missing values; leave such rows out: table.dropna()"])
    return data, [name for name in names if data[name].dtype.kind not in "biuf"]


def _check_values(column: pandas.Series[Any], has_labels: bool, **values: object) -> None:
    """Refuse values of the treatment that are not labels of its column, or not numbers."""
    for option, value in values.items():
        if has_labels:
            one_of(option, value, tuple(column.unique()))
        elif not isinstance(value, bool | np.bool_):
            real_number(option, value)


def _check_varies(data: pandas.DataFrame, name: str, given: list[str]) -> None:
    """Refuse a column that has one value, or is a linear function of the given ones."""
    values, known = data[name].to_numpy(float), data[given].to_numpy(float)
    known = np.column_stack([known, np.ones(len(data))])
    rest = values - known @ np.linalg.lstsq(known, values)[0]
    if (same := data[name].nunique() < 2) or abs(rest).max() <= DETERMINED * np.ptp(values):
        why = "has one value" if same or not given else f"is determined by {', '.join(given)}"
        raise ModelError([f"{name} {why} in all rows: they do not show its effect"])


def _graph_of(system: object) -> Any:
    """Return the model of a world under the interventions in force; anything else unchanged."""
    if not isinstance(system, CausalSystem):
        return system
    return (
        system.graph if system.has_begun else in_force(system.model, getattr(system, "plan", {}))[0]
    )


def _without_edges_from(graph: nx.DiGraph, nodes: Iterable[str]) -> nx.DiGraph:
    found = graph.copy()
    found.remove_edges_from(list(graph.out_edges(nodes)))
    return found


def _smallest_separator(
    graph: nx.DiGraph, x: str, y: str, allowed: set[str]
) -> tuple[str, ...] | None:
    """Return a smallest set of allowed nodes that d-separates two nodes, or None."""
    moral = nx.moral_graph(graph.subgraph({x, y} | nx.ancestors(graph, x) | nx.ancestors(graph, y)))
    for node in {*moral} - allowed - {x, y}:  # paths through it cannot be cut there
        around = [*moral[node]]
        moral.remove_node(node)
        moral.add_edges_from(combinations(around, 2))
    if moral.has_edge(x, y):
        return None
    return tuple(sorted(nx.minimum_node_cut(moral, x, y), key=str))


def _front_doors(
    graph: nx.DiGraph, treatment: str, outcome: str, observed: set[str], n_covariates: int
) -> Iterator[tuple[tuple[str, ...], tuple[str, ...]]]:
    """Yield the smallest sets of mediators that meet the front-door criterion given covariates."""
    after_treatment = nx.descendants(graph, treatment)
    between = after_treatment & nx.ancestors(graph, outcome) & observed
    behind = _without_edges_from(graph, [treatment])
    before = sorted(observed - after_treatment, key=str)
    for size in (1, 2, 3):
        found = False
        for mediators in combinations(sorted(between, key=str), size):
            without, after = graph.copy(), _without_edges_from(graph, mediators)
            without.remove_nodes_from(mediators)
            if nx.has_path(without, treatment, outcome):
                continue
            for covariates in combinations(before, n_covariates):
                given = {*covariates}
                unconfounded = nx.is_d_separator(behind, {treatment}, {*mediators}, given)
                ends = {*mediators}, {outcome}, {treatment, *given}
                if unconfounded and nx.is_d_separator(after, *ends):
                    found = True
                    yield mediators, covariates
        if found:
            return


def _hedge(directed: nx.DiGraph, shared: nx.Graph, treatment: str, outcome: str) -> tuple[str, ...]:
    """Return nodes that show that an effect is not identified; an empty result if it is.

    The c-components of the outcome's ancestors without the treatment have to be identified, each
    from the c-component of the graph that it is in: one takes ancestors and c-components in turn,
    until nothing is left but the component, or until nothing changes.
    """

    def ancestors(nodes: set[str], inside: Iterable[str]) -> set[str]:
        part = directed.subgraph(inside)
        return nodes.union(*(nx.ancestors(part, node) for node in nodes))

    needed = ancestors({outcome}, {*directed} - {treatment})
    for component in nx.connected_components(shared.subgraph(needed)):
        first = next(iter(component))
        whole = nx.node_connected_component(shared, first)
        while (above := ancestors(component, whole)) != component:
            if above == whole:
                return tuple(sorted(whole, key=str))
            whole = nx.node_connected_component(shared.subgraph(above), first)
    return ()
