"""Graphs in and out: networkx, text, and the graphs of other causal libraries.

``docs/graphs.md`` says what each format holds. Mechanisms stay here; ``scm_world.graph.to_json``
writes a whole model.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import load, one_of
from scm_world.errors import ModelError, UnknownOption
from scm_world.graph.scm import SCM
from scm_world.variables import Affine, Box, Either, Space, Switch
from scm_world.variables.spaces import Bound, Bounds

View = Literal["lagged", "summary", "two_slice"]
VIEWS: tuple[View, ...] = get_args(View)
DIGITS = 6  # of a number in the text of a space

# --- networkx -------------------------------------------------------------------------------------


def to_digraph(source: SCM | nx.DiGraph, view: View = "lagged") -> nx.MultiDiGraph:
    """Return a causal graph as a networkx graph in which the key of an edge is its lag.

    Nodes carry ``kind``, ``role``, ``unit``, ``value_shape``, ``bounds``, ``a``, ``b`` and ``doc``
    as text, as far as they have them; edges carry ``lag`` and the condition ``when``. Interventions
    on a model cut edges.

    Args:
        source: A model, or any directed networkx graph; its edges without a lag have lag 0.
        view: ``"lagged"``: as it is. ``"summary"``: one edge per pair, without lags; of several
            conditions ``"contact or set"`` is left, or none if an edge always holds.
            ``"two_slice"``: each variable now and, if there are lags, at earlier steps; ``name`` is
            now, ``name@-1`` one step ago. A parameter keeps its value, so its past is called
            ``name@=-1`` and has an edge to ``name``. Edges within the past are copies of those
            that end now. Causes before the first slice that several nodes have in common are
            unobserved nodes ``past_1@-2``, … with ``observed="no"``, as DoWhy marks them.

    Raises:
        UnknownOption: There is no such view, or the source is no graph.
        ModelError: The edges have no direction, or a lag is no whole number from 0.

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
    one_of("view", view, VIEWS)
    graph = _of_model(source) if isinstance(source, SCM) else _of_networkx(source)
    if view == "summary":
        return _summary(graph)
    return _sliced(graph) if view == "two_slice" else graph


def _of_model(model: SCM) -> nx.MultiDiGraph:
    graph = nx.MultiDiGraph()
    for variable in (model[name] for name in model):
        given: Any = variable
        spaces = {"bounds": variable.bounds, "a": variable.a, "b": variable.b}
        about = {
            "kind": given.kind,
            "role": variable.role,
            "unit": variable.unit,
            "per": "step" if getattr(given, "per", "") == "step" else "",
            "value_shape": "x".join(map(str, variable.shape)),
            **{key: ", ".join(space_lines(s, digits=DIGITS)) for key, s in spaces.items()},
            "doc": " ".join(variable.doc.split()),
        }
        graph.add_node(variable.name, **{key: text for key, text in about.items() if text})
    for edge in sorted(model.edges, key=lambda edge: edge.key):
        when = {} if edge.when is None else {"when": edge.when}
        graph.add_edge(edge.cause, edge.effect, edge.lag, lag=edge.lag, **when)
    return graph


def _of_networkx(source: nx.DiGraph) -> nx.MultiDiGraph:
    if not isinstance(source, nx.Graph):
        allowed = ("a model (SCM)", "a directed graph of networkx")
        raise UnknownOption("graph", source, allowed)
    if not source.is_directed():
        raise ModelError(["the edges of the graph have no direction"])
    graph = nx.MultiDiGraph()
    graph.add_nodes_from(source.nodes(data=True))
    for cause, effect, data in source.edges(data=True):
        lag = data.get("lag", 0)
        if not isinstance(lag, int) or lag < 0:
            raise ModelError([f"the lag {lag!r} of {cause!r} → {effect!r} is no whole number"])
        graph.add_edge(cause, effect, lag, **{**data, "lag": lag})
    return graph


def _past_of(graph: nx.MultiDiGraph) -> int:
    """Return the longest lag [control steps]."""
    return max((lag for *_, lag in graph.edges(keys=True)), default=0)


def _summary(graph: nx.MultiDiGraph) -> nx.MultiDiGraph:
    pairs: dict[tuple[str, str], set[str | None]] = {}
    for cause, effect, when in graph.edges(data="when"):
        pairs.setdefault((cause, effect), set()).add(when)
    made = nx.MultiDiGraph()
    made.add_nodes_from(graph.nodes(data=True))
    for (cause, effect), conditions in pairs.items():
        known = sorted(when for when in conditions if when is not None)
        when = {"when": " or ".join(known)} if len(known) == len(conditions) else {}
        made.add_edge(cause, effect, 0, lag=0, **when)
    return made


def slices_of(graph: nx.MultiDiGraph, steps: int) -> nx.DiGraph:
    """Unroll a graph of ``to_digraph``; nodes are ``(name, -steps + 1)`` to ``(name, 0)``."""
    made = nx.DiGraph()
    for slice_ in range(1 - steps, 1):
        made.add_nodes_from(
            ((name, slice_), {**data, "variable": name, "slice": slice_})
            for name, data in graph.nodes(data=True)
        )
        for cause, effect, lag, data in graph.edges(keys=True, data=True):
            if slice_ - lag > -steps:
                made.add_edge((cause, slice_ - lag), (effect, slice_), **data)
        for name in _held(graph) if slice_ > 1 - steps else ():
            made.add_edge((name, slice_ - 1), (name, slice_), lag=1, persists=True)
    return made


def _held(graph: nx.MultiDiGraph) -> list[str]:
    """List the parameters without causes: they keep their value from one step to the next."""
    return [
        name
        for name, data in graph.nodes(data=True)
        if data.get("role") == "parameter"
        and data.get("per") != "step"
        and not graph.in_degree(name)
    ]


def window_of(graph: nx.MultiDiGraph) -> nx.DiGraph:
    """Return the present and as many slices before it as the longest lag, with their common past.

    Two nodes are d-separated exactly where they are in a graph unrolled without end: this is its
    latent projection. Nodes are those of ``slices_of``; ``("past", 1)``, … are unobserved.

    Source:
        Verma and Pearl, *Equivalence and synthesis of causal models*, UAI 1990, for projections;
        a clique of bidirected edges separates as one common cause does.
    """
    past = _past_of(graph)
    made = slices_of(graph, past + 1)
    for number, effects in enumerate(_with_common_past(graph, past), start=1):
        made.add_node(("past", number), observed="no")
        made.add_edges_from((("past", number), effect) for effect in effects)
    return made


def _with_common_past(graph: nx.MultiDiGraph, past: int) -> list[list[tuple[str, int]]]:
    """List the largest sets of nodes of which each two have a cause before slice ``-past``."""
    place = {name: number for number, name in enumerate(graph)}
    edges = np.zeros((past + 1, len(place), len(place)), dtype=np.float32)  # lag, cause, effect
    for cause, effect, lag in graph.edges(keys=True):
        edges[lag, place[cause], place[effect]] = 1.0
    for name in _held(graph) if past else ():
        edges[1, place[name], place[name]] = 1.0
    # common[d][x, y]: x and the y of d steps before have an ancestor in common, or are in line
    common = np.zeros_like(edges)
    common[0] = np.eye(len(place))

    def shared(apart: int) -> Any:
        return common[apart] if apart >= 0 else common[-apart].T

    known = -1.0
    while known != (known := float(common.sum(dtype=np.float64))):
        for apart, lag in product(range(past + 1), repeat=2):  # the later of the two steps back
            common[apart][edges[lag].T @ shared(apart - lag) > 0.0] = 1.0
        common[0] = np.maximum(common[0], common[0].T)
    nodes = [(name, slice_) for slice_ in range(-past, 1) for name in graph]
    before = np.zeros((past, len(nodes), len(place)), dtype=np.float32)  # steps, effect, cause
    for row, (name, slice_) in enumerate(nodes):
        for steps in range(1, -slice_ + 1):
            before[steps - 1, row] = edges[past + slice_ + steps, :, place[name]]
    joined = np.zeros((len(nodes), len(nodes)), dtype=bool)
    for first, second in product(range(past), repeat=2):
        joined |= before[first] @ shared(second - first) @ before[second].T > 0.0
    pairs = nx.Graph((nodes[i], nodes[j]) for i, j in np.argwhere(np.triu(joined, 1)).tolist())
    return sorted(sorted(clique) for clique in nx.find_cliques(pairs))


def _sliced(graph: nx.MultiDiGraph) -> nx.MultiDiGraph:
    held, past = _held(graph), _past_of(graph)

    def named(node: tuple[str, int]) -> str:
        name, slice_ = node
        if slice_ > 0:
            return f"past_{slice_}@-{past + 1}"
        return f"{name}@{'=' if name in held else ''}{slice_}" if slice_ else name

    window, made = window_of(graph), nx.MultiDiGraph()
    for node in sorted(window, key=lambda node: (node[1] > 0, abs(node[1]))):  # the present first
        made.add_node(named(node), **(graph.nodes[node[0]] if node[1] <= 0 else window.nodes[node]))
    for cause, effect, data in window.edges(data=True):
        when = {"when": data["when"]} if "when" in data else {}
        made.add_edge(named(cause), named(effect), 0, lag=0, **when)
    return made


def _bare(graph: nx.MultiDiGraph) -> nx.DiGraph:
    """Return names, pairs and what is unobserved alone; refuse a cycle."""
    made = nx.DiGraph()
    made.add_nodes_from(graph)
    made.add_nodes_from(_latents(graph), observed="no")
    made.add_edges_from(graph.edges())
    if not nx.is_directed_acyclic_graph(made):
        cycle = [cause for cause, _ in nx.find_cycle(made)]
        path = " → ".join([*cycle, cycle[0]])
        what = f"only acyclic graphs can be written so, and there is {path}"
        raise ModelError([f"{what}; try view='two_slice'"])
    return made


def _latents(graph: nx.DiGraph) -> list[str]:
    """List the unobserved nodes."""
    return [name for name, observed in graph.nodes(data="observed") if observed == "no"]


# --- spaces in words ------------------------------------------------------------------------------


def space_lines(space: Space | None, *, digits: int = 4) -> list[str]:
    """Return a space in words, with the names of the variables that it follows.

    There is one line, or one per component where they differ; numbers have so many digits.
    """
    match space:
        case None:
            return []
        case Box(low=low, high=high):
            return _box_lines(_ends(low, digits), _ends(high, digits))
        case Either(first=first, second=second):
            parts = (", ".join(space_lines(part, digits=digits)) for part in (first, second))
            return [" or ".join(parts)]
    return [space.describe((), {})]


def _box_lines(lows: list[str], highs: list[str]) -> list[str]:
    size = max(len(lows), len(highs))
    lows, highs = (ends * size if len(ends) == 1 else ends for ends in (lows, highs))
    ends = zip(lows, highs, strict=True)
    pairs = [low if low == high else f"{low} to {high}" for low, high in ends]
    if len(set(pairs)) == 1:
        return pairs[:1]
    finger = pairs[:3]
    return finger if pairs == finger * (size // 3) else pairs


def _ends(end: Bounds, digits: int) -> list[str]:
    parts = end if isinstance(end, tuple) else (end,)
    return [_end(part, digits) for part in parts]


def _end(end: Bound, digits: int) -> str:
    match end:
        case Affine(parent=parent, index=index, scale=scale, offset=offset):
            which = "" if index is None else f"[{index}]"
            factor = "" if scale == 1.0 else f"{scale:g} "
            summand = "" if offset == 0.0 else f"{offset:g} + "
            return f"{summand}{factor}{parent}{which}"
        case Switch(parent=parent, below=below, above=above, at=at):
            return f"({below:g} if {parent} < {at:g} else {above:g})"
    return f"{float(end):.{digits}g}"


# --- text -----------------------------------------------------------------------------------------

_SHAPES = {
    "exogenous": "ellipse",
    "derived": "box",
    "measured": "octagon",
    "action": "diamond",
    "fixed": "plaintext",
}


def _quoted(text: object) -> str:
    escaped = str(text).replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def _dot(graph: nx.MultiDiGraph) -> str:
    """Write a graph in the DOT language; lagged edges are dashed."""
    lines = ["digraph scm {", "  rankdir=LR;"]
    for name, data in graph.nodes(data=True):
        unit = f"\\n[{_quoted(data['unit'])[1:-1]}]" if data.get("unit") else ""
        look = {"shape": _SHAPES.get(data.get("kind", ""), "ellipse")}
        look["label"] = f'{_quoted(name)[:-1]}{unit}"'
        lines.append(f"  {_quoted(name)} [{_listed(look, data)}];")
    for cause, effect, data in graph.edges(data=True):
        look = {"style": "dashed" if data["lag"] else "solid"}
        if "when" in data:
            look["label"] = _quoted(data["when"])
        lines.append(f"  {_quoted(cause)} -> {_quoted(effect)} [{_listed(look, data)}];")
    return "\n".join([*lines, "}"])


def _listed(look: dict[str, str], more: dict[str, Any]) -> str:
    pairs = [*look.items(), *((key, _quoted(value)) for key, value in more.items())]
    return ", ".join(f"{key}={value}" for key, value in pairs)


def _dagitty(graph: nx.MultiDiGraph) -> str:
    """Write a graph for dagitty, www.dagitty.net and its R package."""
    bare = _bare(graph)
    if odd := [name for name in bare if '"' in name or "\\" in name]:
        raise ModelError([f"dagitty cannot write the name {name!r}" for name in odd])
    latents = _latents(bare)
    nodes = [f'"{name}"' + " [latent]" * (name in latents) for name in bare]
    edges = [f'"{cause}" -> "{effect}"' for cause, effect in bare.edges]
    return "\n".join(["dag {", *nodes, *edges, "}"])


def _csv(graph: nx.MultiDiGraph) -> str:
    """Write a matrix with a row per cause, a column per effect, and 1 where there is an edge."""
    page = io.StringIO()
    writer = csv.writer(page, lineterminator="\n")
    writer.writerow(["cause", *graph])
    for cause in graph:
        writer.writerow([cause, *(int(graph.has_edge(cause, effect)) for effect in graph)])
    return page.getvalue().rstrip("\n")


def _node_link(graph: nx.MultiDiGraph) -> str:
    return json.dumps(nx.node_link_data(graph, edges="edges"), indent=1, ensure_ascii=False)


FORMATS: dict[str, tuple[Callable[[nx.MultiDiGraph], str], tuple[View, ...]]] = {
    "dot": (_dot, VIEWS),
    "gml": (lambda graph: "\n".join(nx.generate_gml(graph)), VIEWS),
    "graphml": (lambda graph: "\n".join(nx.generate_graphml(graph)), VIEWS),
    "node-link": (_node_link, VIEWS),
    "dagitty": (_dagitty, ("two_slice", "summary")),
    "csv": (_csv, ("two_slice", "summary")),
}
"""What writes each format, and the views that it can hold, the default first."""


def write_graph(
    source: SCM | nx.DiGraph,
    path: Path | str | None = None,
    *,
    format: str,  # noqa: A002 # the word that everybody looks for
    view: View | None = None,
) -> str:
    r"""Write a graph as text, and to a file if a path is given.

    Args:
        source: A model, or a networkx graph as ``to_digraph`` takes it.
        path: Of a file to write, or None.
        format: ``"dot"``, ``"gml"``, ``"graphml"``, ``"node-link"``, ``"dagitty"`` or ``"csv"``.
        view: See ``to_digraph``. By default what loses no edge: ``"lagged"`` where the format has
            attributes, else ``"two_slice"``.

    Raises:
        UnknownOption: There is no such format, or it cannot hold the view.
        ModelError: The format cannot hold the graph: a cycle, or a name.

    Example:
        >>> write_graph(nx.DiGraph([("mass", "weight")]), format="csv")
        'cause,mass,weight\nmass,0,1\nweight,0,0'
    """
    one_of("format", format, tuple(FORMATS))
    write, views = FORMATS[format]
    one_of("view", view, (None, *views))
    text = write(to_digraph(source, view or views[0]))
    if path is not None:
        Path(path).write_text(text + "\n", encoding="utf-8")
    return text


# --- other libraries ------------------------------------------------------------------------------


def to_dowhy(source: SCM | nx.DiGraph, *, view: View = "two_slice") -> nx.DiGraph:
    """Return the graph that ``dowhy.CausalModel(graph=…)`` and ``dowhy.gcm`` take.

    Unobserved nodes have ``observed="no"``: in two slices, the common causes of the earlier past.
    ``dowhy.gcm`` knows none, so it takes graphs of one instant.

    Raises:
        ModelError: The view has a cycle.
        UnknownOption: There is no such view.
    """
    one_of("view", view, ("summary", "two_slice"))
    return _bare(to_digraph(source, view))


def to_pgmpy(source: SCM | nx.DiGraph, *, view: View = "two_slice") -> Any:
    """Write a graph as a ``pgmpy.base.DAG``, with its ``latents``.

    Its ``edges()`` make any Bayesian network of pgmpy.

    Raises:
        MissingExtra: pgmpy is not installed.
        ModelError: The view has a cycle.
        UnknownOption: There is no such view.
    """
    graph, dag = to_dowhy(source, view=view), load("pgmpy.base", "pgmpy").DAG
    made = dag(list(graph.edges), latents=set(_latents(graph)))
    made.add_nodes_from(set(graph) - set(made))
    return made


def to_causal_learn(source: SCM | nx.DiGraph, *, view: View = "two_slice") -> Any:
    """Write a graph as a ``causallearn.graph.GeneralGraph``; unobserved nodes are ``LATENT``.

    Raises:
        MissingExtra: causal-learn is not installed.
        ModelError: The view has a cycle.
        UnknownOption: There is no such view.
    """
    graph = to_dowhy(source, view=view)
    general = load("causallearn.graph.GeneralGraph", "causal-learn").GeneralGraph
    node = load("causallearn.graph.GraphNode", "causal-learn").GraphNode
    latent = load("causallearn.graph.NodeType", "causal-learn").NodeType.LATENT
    nodes = {name: node(name) for name in graph}
    for name in _latents(graph):
        nodes[name].set_node_type(latent)
    made = general(list(nodes.values()))
    for cause, effect in graph.edges:
        made.add_directed_edge(nodes[cause], nodes[effect])
    return made


class TigramiteGraph(NamedTuple):
    """What tigramite's functions take as ``graph`` and ``var_names``.

    Attributes:
        graph: Shape (n, n, max lag + 1), dtype ``<U3``. ``graph[i, j, lag]`` is ``"-->"`` if i acts
            on j; ``graph[j, i, 0]`` is then ``"<--"`` for lag 0. Elsewhere it is empty.
        var_names: The names, in order.
    """

    graph: NDArray[np.str_]
    var_names: tuple[str, ...]


def to_tigramite(source: SCM | nx.DiGraph) -> TigramiteGraph:
    """Write a graph as tigramite does; nothing needs to be installed.

    Raises:
        ModelError: Edges of lag 0 form a cycle, as in a summary graph.

    Example:
        >>> found = to_tigramite(nx.DiGraph([("x", "y", {"lag": 1})]))
        >>> found.graph.shape, str(found.graph[0, 1, 1])
        ((2, 2, 2), '-->')
    """
    graph = to_digraph(source)
    _bare(nx.MultiDiGraph((c, e) for c, e, lag in graph.edges(keys=True) if not lag))
    at = {name: i for i, name in enumerate(graph)}
    array = np.full((len(at), len(at), _past_of(graph) + 1), "", dtype="<U3")
    for cause, effect, lag in graph.edges(keys=True):
        array[at[cause], at[effect], lag] = "-->"
        if lag == 0:
            array[at[effect], at[cause], 0] = "<--"
    return TigramiteGraph(array, tuple(graph))
