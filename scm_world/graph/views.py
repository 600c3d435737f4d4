"""Graphs of a model, with and without time, in and out by networkx.

``docs/graphs.md`` says how other libraries take them. Mechanisms stay here;
``scm_world.graph.to_json`` writes a whole model.
"""

from __future__ import annotations

from collections.abc import Collection, Container, Iterable, Iterator, Mapping
from itertools import combinations
from typing import Any

import networkx as nx
import numpy as np

from scm_world._arguments import real_number, refuse_other, typed, whole_number
from scm_world.errors import ModelError, UnknownOption
from scm_world.graph.ancestral import window
from scm_world.graph.scm import SCM
from scm_world.variables import Intervention, Variable


def to_digraph(
    source: SCM | nx.DiGraph,
    *,
    strength: Mapping[tuple[str, str, int], float] | None = None,
    at_least: float = 0.0,
) -> nx.MultiDiGraph:
    """Return a causal graph as a networkx graph in which the key of an edge is its lag.

    Nodes carry ``kind``, ``role``, ``unit``, ``per``, ``value_shape``, ``bounds``, ``a``, ``b`` and
    ``doc`` as text, as far as they have them; edges carry ``lag`` and the condition ``when``.
    ``per="episode"`` says that ``drawn_once`` has the variable. Interventions on a model cut edges.

    Args:
        source: A model, or any directed networkx graph: the attribute ``lag`` of an edge counts,
            also as text, as DOT has it; without, the lag is 0.
        strength: Strength of edges (cause, effect, lag), such as ``verify(world).strength``: an
            attribute of the edge.
        at_least: Edges that are weaker are left out; those without a strength stay.

    Raises:
        UnknownOption: The source is not a graph, or ``at_least`` is negative.
        ModelError: The edges have no direction, or a lag is not a whole number from 0.

    Example:
        >>> from scm_world.variables import Derived, Exogenous, Linear
        >>> model = SCM([
        ...     Exogenous(name="mass", unit="kg"),
        ...     Derived(name="weight", unit="N", parents=("mass",),
        ...             mechanism=Linear(weights=(9.81,))),
        ... ])
        >>> to_digraph(model).edges(keys=True)
        OutMultiEdgeView([('mass', 'weight', 0)])
        >>> to_digraph(model.do({"weight": 1.0})).edges
        OutMultiEdgeView([])
    """
    at_least = real_number("at_least", at_least, least=0.0)
    graph = _of_model(source) if isinstance(source, SCM) else _of_networkx(source)
    refuse_other("strength", strength, Mapping[tuple[str, str, int], float] | None)
    for edge, size in ({} if strength is None else strength).items():
        if graph.has_edge(*edge):
            graph.edges[edge]["strength"] = float(size)
    sizes = {edge: graph.edges[edge].get("strength", at_least) for edge in graph.edges}
    graph.remove_edges_from([edge for edge, size in sizes.items() if size < at_least])
    return graph


def _of_networkx(source: nx.DiGraph) -> nx.MultiDiGraph:
    if not isinstance(source, nx.Graph):
        raise UnknownOption("graph", source, ("a model (SCM)", "a directed graph of networkx"))
    if not source.is_directed():
        raise ModelError(["the edges of the graph have no direction"])
    graph = nx.MultiDiGraph()
    graph.add_nodes_from(source.nodes(data=True))
    for cause, effect, data in source.edges(data=True):
        lag = data.get("lag", 0)
        try:  # DOT has numbers as text, with or without quotes
            lag = int(lag.strip('"')) if isinstance(lag, str) else lag
            lag = whole_number("lag", lag, least=0)
        except ValueError:
            said = f"the lag {lag!r} of {cause!r} → {effect!r} is not a whole number from 0"
            raise ModelError([said]) from None
        graph.add_edge(cause, effect, lag, **{**data, "lag": lag})
    return graph


def _of_model(source: SCM) -> nx.MultiDiGraph:
    graph, lasting = nx.MultiDiGraph(), drawn_once(source)
    for variable in (source[name] for name in source):
        given: Any = variable
        spaces = {"bounds": variable.bounds, "a": variable.a, "b": variable.b}
        about = {
            "kind": given.kind,
            "role": variable.role,
            "unit": variable.unit,
            "per": "episode" if variable.name in lasting else "",
            "value_shape": "x".join(map(str, variable.shape)),
            **{key: "" if s is None else s.describe() for key, s in spaces.items()},
            "doc": " ".join(variable.doc.split()),
        }
        graph.add_node(variable.name, **{key: text for key, text in about.items() if text})
    for edge in sorted(source.edges, key=lambda edge: edge.key):
        when = {} if edge.when is None else {"when": edge.when}
        graph.add_edge(edge.cause, edge.effect, edge.lag, lag=edge.lag, **when)
    return graph


def drawn_once(model: SCM) -> frozenset[str]:
    """Return the variables whose value or noise is drawn once for an episode, not in every step.

    These are constants and exogenous variables ``per="episode"``. A model with a backend (some
    measured variables have no function) draws the roots and the noise of all its parameters once.
    """
    declared = [model.declared(name) for name in model]
    simulated = any(v.is_simulated for v in declared)

    def lasts(own: Variable, variable: Variable) -> bool:
        if not simulated:
            return variable.is_constant or variable.per_episode
        is_drawn = variable.own_noise is not None
        return own.role == "parameter" and (is_drawn or not variable.all_parents)

    return frozenset(own.name for own in declared if lasts(own, model[own.name]))


def applied(model: SCM, name: str) -> Iterator[tuple[Intervention, Variable]]:
    """Yield the interventions on a variable, and of what each was requested, the top one first."""
    act = model._act_on(name)
    while act is not None:
        yield act.intervention, act.requested
        act = act.below


def unseen(model: SCM) -> dict[str, list[str]]:
    """Return noise that no edge shows, by name: the variables that it acts on.

    These are draws that several variables share, by ``Shift(…, shared=True)`` or as parts of a
    bundle, and the noise that a variable with causes keeps for an episode.
    """
    found: dict[str, list[str]] = {}
    for name in model:
        for act, requested in applied(model, name):
            if (shared := act.shares(requested)) is not None:
                found.setdefault(f"draw of {shared}", []).append(name)
    lasting = {name for name in drawn_once(model) if model[name].all_parents}
    return found | {f"noise of {name}": [name] for name in sorted(lasting)}


def _through_time(source: SCM | nx.DiGraph) -> nx.MultiDiGraph:
    """Return the graph in which noise that no edge shows is a node, and what lasts acts on itself.

    Such an edge has lag 1 and ``persists=True``; such a node has ``observed="no"``.
    """
    graph = to_digraph(source)
    once = {name for name, per in graph.nodes(data="per") if per == "episode"}
    follow = sorted(name for name in once if graph.in_degree(name))
    known = {f"noise of {name}": [name] for name in follow}
    lasting = once.difference(follow)
    for noise, effects in (unseen(source) if isinstance(source, SCM) else known).items():
        lasting |= {noise} if once.issuperset(effects) else set()
        graph.add_node(noise, observed="no")
        graph.add_edges_from((noise, effect, 0, {"lag": 0}) for effect in effects)
    graph.add_edges_from((name, name, 1, {"lag": 1, "persists": True}) for name in lasting)
    return graph


def unrolled(source: SCM | nx.DiGraph, steps: int) -> nx.DiGraph:
    """Return the graph of some control steps, with nodes ``(name, -steps + 1)`` to ``(name, 0)``.

    A root that is drawn once for an episode keeps its value from one step to the next: an edge with
    ``persists=True``. Noise that ``unseen`` lists is a node with ``observed="no"``.

    Args:
        source: A model, or any directed networkx graph; the attribute ``lag`` of an edge counts,
            and ``per="episode"`` of a node: its value lasts for the episode.
        steps: The number of control steps, at least 1.
    """
    graph, made, steps = _through_time(source), nx.DiGraph(), whole_number("steps", steps, least=1)
    for slice_ in range(1 - steps, 1):
        made.add_nodes_from(
            ((name, slice_), {**data, "variable": name, "slice": slice_})
            for name, data in graph.nodes(data=True)
        )
        for cause, effect, lag, data in graph.edges(keys=True, data=True):
            if slice_ - lag > -steps:
                made.add_edge((cause, slice_ - lag), (effect, slice_), **data)
    return made


def to_dag(source: SCM | nx.DiGraph) -> nx.DiGraph:
    """Return the acyclic graph of a model that ``identify``, networkx and DoWhy take.

    ``networkx.is_d_separator(to_dag(model), {"x"}, {"y"}, {"z"})`` asks for d-separation.

    Without lags it has the names of the variables. With lags there are as many slices as the
    longest lag reaches: ``name`` is now, ``name@-1`` one step ago. A root that is drawn once for an
    episode keeps its value, so its past is called ``name@=-1`` and has an edge to ``name``. Causes
    before the first slice that several nodes have in common are nodes ``past_1@-2``, … with
    ``observed="no"``, DoWhy's mark of unobserved nodes: two nodes are d-separated exactly where
    they are in a graph unrolled without end, of which this is the latent projection. Noise that
    ``unseen`` lists has this mark, too.

    Args:
        source: A model, or any directed networkx graph; see ``unrolled``.

    Raises:
        ModelError: Edges of lag 0 form a cycle.
        UnknownOption: The source is not a graph.

    Source:
        Verma and Pearl, *Equivalence and synthesis of causal models*, UAI 1990, for projections;
        a clique of bidirected edges separates as one common cause does.
    """
    past = max((lag for *_, lag in to_digraph(source).edges(keys=True)), default=0)
    graph = _through_time(source)
    held = {cause for cause, _, lasts in graph.edges(data="persists") if lasts}
    nodes = [(name, slice_) for slice_ in range(-past, 1) for name in graph]
    named = {
        (name, slice_): f"{name}@{'=' * (name in held)}{slice_}" if slice_ else name
        for name, slice_ in nodes
    }
    made = nx.DiGraph()
    for name, slice_ in sorted(nodes, key=lambda node: -node[1]):  # the present first
        data = graph.nodes[name]
        made.add_node(named[name, slice_], **{k: v for k, v in data.items() if k == "observed"})
    place = {name: number for number, name in enumerate(graph)}
    edges = np.zeros((past + 1, len(place), len(place)), dtype=bool)  # lag, cause, effect
    for cause, effect, lag in graph.edges(keys=True):
        if lag <= past:  # nothing lasts where there is one instant
            edges[lag, place[cause], place[effect]] = True
    directed, shared = window(edges, np.zeros_like(edges), past)
    names = [named[node] for node in nodes]
    made.add_edges_from((names[i], names[j]) for i, j in np.argwhere(directed).tolist())
    if not nx.is_directed_acyclic_graph(made):
        cycle = [cause for cause, _ in nx.find_cycle(made)]
        path = " → ".join([*cycle, cycle[0]])
        raise ModelError([f"edges of lag 0 form a cycle: {path}; give edges their lag"])
    pairs = nx.Graph((nodes[i], nodes[j]) for i, j in np.argwhere(np.triu(shared)).tolist())
    for number, effects in enumerate(sorted(map(sorted, nx.find_cliques(pairs))), start=1):
        made.add_node(hidden := f"past_{number}@-{past + 1}", observed="no")
        made.add_edges_from((hidden, named[effect]) for effect in effects)
    return made


def projection(graph: nx.DiGraph, kept: Collection[str]) -> tuple[nx.DiGraph, nx.Graph]:
    """Return the latent projection of an acyclic graph on some of its nodes.

    Returns:
        The edges among them, through other nodes or not; and the pairs that another node acts on
        through others only: it confounds them.
    """

    def reached(node: str) -> set[str]:
        found, ahead, passed = set[str](), [node], {node}
        while ahead:
            new = {*graph.successors(ahead.pop())} - passed
            passed |= new
            found |= new & {*kept}
            ahead += new - {*kept}
        return found

    directed, shared = nx.DiGraph(), nx.Graph()
    for made in (directed, shared):
        made.add_nodes_from(node for node in graph if node in kept)
    for node in graph:
        if node in kept:
            directed.add_edges_from((node, effect) for effect in reached(node))
        else:
            shared.add_edges_from(combinations(reached(node), 2))
    return directed, shared


@typed
def episode_outcome(
    model: SCM,
    outcomes: Iterable[str],
    *,
    starts: Iterable[str] = (),
    contact: bool = True,
    without: Container[tuple[str, str, int]] = (),
) -> nx.DiGraph:
    """Return the static graph of one episode: parameters, starting states and outcomes.

    A parameter is a cause of an outcome where a path through time leads from one to the other that
    passes no further parameter. Of a model with lagged edges those count as parameters that keep
    their value for an episode.

    Args:
        model: With or without interventions.
        outcomes: States or readouts, at the end.
        starts: States that vary at the beginning; their nodes are named ``"<name>@0"``.
        contact: Whether bodies may touch; edges by contact are left out if not.
        without: Edges (cause, effect, lag) that do not act, either.

    Example:
        >>> from scm_world.variables import Exogenous, Measured, Parent
        >>> model = SCM([
        ...     Exogenous(name="mass"), Exogenous(name="color"),
        ...     Measured(name="speed", parents=("mass", Parent("speed", 1))),
        ... ])
        >>> sorted(episode_outcome(model, ["speed"], starts=["speed"]).edges)
        [('mass', 'speed'), ('speed@0', 'speed')]
    """
    still, once = set[str](), drawn_once(model)
    for name in model.structure.order:  # what nothing changes in the course of an episode
        variable = model[name]
        drawn = name not in once and variable.own_noise is not None
        moves = drawn or any(p.lag or p.name not in still for p in variable.all_parents)
        if model.declared(name).role == "parameter" and not (moves and model.is_temporal):
            still.add(name)
    edges = [e for e in model.edges if (contact or e.when != "contact") and e.key not in without]
    follow = nx.DiGraph((edge.cause, edge.effect) for edge in edges)
    follow.add_nodes_from(model)
    graph = nx.DiGraph()
    graph.add_nodes_from(name for name in model if name in still)
    graph.add_edges_from(
        (edge.cause, edge.effect)
        for edge in edges
        if edge.cause in graph and edge.effect in graph and edge.when != "set"
    )
    moving = follow.subgraph([name for name in follow if name not in still])
    for outcome in (outcomes,) if isinstance(outcomes, str) else outcomes:
        causes = {model.declared(outcome).name}
        causes |= nx.ancestors(moving, outcome) if outcome in moving else set()
        direct = {p for name in causes for p in follow.predecessors(name) if p in still}
        graph.add_edges_from((parameter, outcome) for parameter in sorted(direct))
        graph.add_edges_from((f"{name}@0", outcome) for name in starts if name in causes)
    return graph
