"""Effects that are identified from observational data."""

from __future__ import annotations

import warnings
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any, final

import networkx as nx

from scm_world._arguments import load, one_of
from scm_world._patterns import as_names
from scm_world.errors import ModelError, UnknownOption
from scm_world.graph import SCM, episode_outcome
from scm_world.graph.views import to_dag
from scm_world.queries.equations import System
from scm_world.queries.plans import Plan
from scm_world.variables import Draw, Mechanism


@final
@dataclass(frozen=True)
class Identification:
    """The sets of observed variables that identify an effect without an intervention.

    Attributes:
        treatment: The cause.
        outcome: The effect.
        graph: The graph.
        backdoor: A smallest set of observed variables that blocks all back-door paths, or None.
        frontdoor: Smallest sets of observed mediators that meet the front-door criterion.
        instruments: Observed variables that are associated with the treatment, and with the outcome
            through it alone.
    """

    treatment: str
    outcome: str
    graph: nx.DiGraph
    backdoor: tuple[str, ...] | None
    frontdoor: tuple[tuple[str, ...], ...] = ()
    instruments: tuple[str, ...] = ()

    @property
    def variables(self) -> dict[str, tuple[str, ...]]:
        """Variables to observe in addition to the ends, by criterion, the weakest first.

        ``"backdoor"`` and ``"frontdoor"`` identify any effect, ``"iv"`` a linear one.
        """
        ways = {} if self.backdoor is None else {"backdoor": self.backdoor}
        if self.frontdoor:
            ways["frontdoor"] = self.frontdoor[0]
        return ways | ({"iv": self.instruments} if self.instruments else {})


def nature_graph(
    model: SCM | System,
    nature: Mapping[str, Any] | None,
    outcomes: Iterable[str],
    *,
    contact: bool = True,
    without: Container[tuple[str, str, int]] = (),
) -> nx.DiGraph:
    """Return the static graph of an episode with a context distribution at the beginning.

    Args:
        model: A world, or its model.
        nature: The context distribution: interventions at the beginning. A ``Mechanism`` adds its
            edges, and so does a ``Draw`` from a space with parents.
        outcomes: Names of the variables at the end of the episode.
        contact: Whether bodies may touch; edges by contact are left out if not.
        without: Edges (cause, effect, lag) that do not act, either.

    Raises:
        ModelError: An intervention of ``nature`` is later than the beginning.
        UnknownOption: ``model`` is not a model, or ``outcomes`` are not names.
    """
    model = _graph_of(model)
    if not isinstance(model, SCM):
        raise UnknownOption("model", model, ("a world, or an SCM, such as world.model",))
    plan = Plan(nature).named(model)
    acts = plan.at_start()
    late = sorted(name for name in plan if name not in acts or len(plan[name]) > 1)
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
        act: Any = acts[name].root
        followed = frozenset[str]()
        if isinstance(act, Mechanism):
            followed = frozenset(parent.name for parent in act.parents)
        elif isinstance(act, Draw):
            followed = act.drawn_from(model.declared(name)).parents()
        causes = [n if n in graph else f"{n}@0" for n in sorted(followed)]
        graph.add_edges_from((n, f"{target}@0") for target in model.targets(name) for n in causes)
    return graph


def identify(
    graph: SCM | System | nx.DiGraph,
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
        frontdoor: Whether to search for front-door sets of up to three mediators, too.

    Raises:
        UnknownOption: A node does not exist, both are the same, or ``graph`` is not a graph.
        ModelError: The graph has a cycle, or no directions.

    Source:
        Pearl, *Causality*, 2nd edition, 3.3.1, 3.3.2 and 7.4.5. A smallest separator is a smallest
        cut of the moral graph of the ancestors (van der Zander, Liśkiewicz and Textor, Artificial
        Intelligence 270, 2019); of several, the one nearest to the outcome.

    Example:
        >>> graph = nx.DiGraph([("z", "x"), ("z", "y"), ("x", "y"), ("w", "y")])
        >>> identify(graph, "x", "y").backdoor
        ('z',)
        >>> identify(graph, "x", "y", observed=["x", "y", "w"]).backdoor is None
        True
    """
    graph = to_dag(_graph_of(graph))
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
    doors = tuple(_front_doors(graph, treatment, outcome, watched)) if frontdoor else ()
    instruments = tuple(
        node
        for node in sorted(allowed, key=str)
        if nx.is_d_separator(behind, {node}, {outcome}, set())
        and not nx.is_d_separator(graph, {node}, {treatment}, set())
    )
    return Identification(treatment, outcome, graph, backdoor, doors, instruments)


_METHODS = {
    "backdoor": "backdoor.linear_regression",
    "frontdoor": "frontdoor.two_stage_regression",
    "iv": "iv.instrumental_variable",
}


def estimate(
    found: Identification, table: Any, *, do: Any, versus: Any, method: str | None = None
) -> Any:
    """Estimate an effect that ``identify`` found from observational data, with DoWhy.

    Args:
        found: The result of ``identify``.
        table: A data frame whose columns have the names of nodes.
        do: Value of the treatment.
        versus: Reference value of the treatment.
        method: A method of DoWhy; if None a linear one for the first criterion of
            ``found.variables``.

    Returns:
        The ``CausalEstimate`` of DoWhy: ``value``, ``get_confidence_intervals()``, …

    Raises:
        MissingExtra: DoWhy is not installed.
        ModelError: The effect is not identified.
        UnknownOption: The table lacks a column, or an argument has the wrong type.

    Example:
        >>> found = identify(nx.DiGraph([("z", "x"), ("z", "y"), ("x", "y")]), "x", "y")
        >>> estimate(found, table, do=1.0, versus=0.0).value  # doctest: +SKIP
        2.03
    """
    if not isinstance(found, Identification):
        raise UnknownOption("found", found, ("a result of identify",))
    if not hasattr(table, "columns"):
        raise UnknownOption("table", type(table), ("a data frame, as pandas.DataFrame(table)",))
    if not found.variables:
        ends = f"{found.treatment!r} on {found.outcome!r}"
        advice = "observe more variables, look for front doors, or intervene (effect)"
        raise ModelError([f"the effect of {ends} is not identified: {advice}"])
    way = next(iter(found.variables)) if method is None else str(method).partition(".")[0]
    one_of("method", way, tuple(found.variables))
    columns = [found.treatment, found.outcome, *found.variables[way]]
    for name in columns:
        one_of("column of the table", name, tuple(map(str, table.columns)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # other nodes of the graph are not in the table
        dowhy = load("dowhy", "dowhy")
        model = dowhy.CausalModel(table[columns], found.treatment, found.outcome, graph=found.graph)
        return model.estimate_effect(
            model.identify_effect(proceed_when_unidentifiable=True),
            method_name=_METHODS[way] if method is None else method,
            control_value=versus,
            treatment_value=do,
        )


def _graph_of(system: Any) -> Any:
    return system.model if isinstance(system, System) else system


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
    graph: nx.DiGraph, treatment: str, outcome: str, observed: set[str]
) -> Iterator[tuple[str, ...]]:
    """Yield the smallest sets of mediators that meet Pearl's front-door criterion."""
    between = nx.descendants(graph, treatment) & nx.ancestors(graph, outcome) & observed
    behind = _without_edges_from(graph, [treatment])
    for size in (1, 2, 3):
        found = False
        for mediators in combinations(sorted(between, key=str), size):
            without, after = graph.copy(), _without_edges_from(graph, mediators)
            without.remove_nodes_from(mediators)
            intercepts = not nx.has_path(without, treatment, outcome)
            unconfounded = nx.is_d_separator(behind, {treatment}, set(mediators), set())
            blocked = nx.is_d_separator(after, set(mediators), {outcome}, {treatment})
            if intercepts and unconfounded and blocked:
                found = True
                yield mediators
        if found:
            return
