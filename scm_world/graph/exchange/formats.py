"""Formats that are text: DOT, dagitty, GML, GraphML, node-link JSON, CSV and HTML."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import networkx as nx

from scm_world.errors import DAMAGED, ModelError, UnknownOption, UnreadableFile
from scm_world.graph.exchange.html import to_html
from scm_world.graph.exchange.model import (
    VIEWS,
    CausalGraph,
    Node,
    View,
    causal_graph,
    edge_attributes,
    from_parts,
    read_as,
    seen_as,
)
from scm_world.graph.scm import SCM
from scm_world.graph.structure import Edge
from scm_world.output.reading import read_text

_SHAPES = {
    "exogenous": "ellipse",
    "derived": "box",
    "measured": "octagon",
    "action": "diamond",
    "fixed": "plaintext",
}


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def to_dot(graph: CausalGraph) -> str:
    """Write a graph in the DOT language; lagged edges are dashed."""
    lines = ["digraph scm {", "  rankdir=LR;"]
    for node in graph.nodes:
        about = _listed(
            {"shape": _SHAPES.get(node.kind, "ellipse"), "label": _label(node)}, node.attributes
        )
        lines.append(f"  {_quoted(node.name)} [{about}];")
    for edge in graph.edges:
        look = {"style": "dashed" if edge.lag else "solid"}
        if edge.when:
            look["label"] = _quoted(edge.when)
        about = _listed(look, edge_attributes(edge))
        lines.append(f"  {_quoted(edge.cause)} -> {_quoted(edge.effect)} [{about}];")
    return "\n".join([*lines, "}"])


def _label(node: Node) -> str:
    unit = f"\\n[{_quoted(node.unit)[1:-1]}]" if node.unit else ""
    return f'{_quoted(node.name)[:-1]}{unit}"'


def _listed(look: dict[str, str], more: dict[str, str] | dict[str, int | str]) -> str:
    pairs = [*look.items(), *((key, _quoted(str(value))) for key, value in more.items())]
    return ", ".join(f"{key}={value}" for key, value in pairs)


def to_dagitty(graph: CausalGraph) -> str:
    """Write a graph for dagitty, www.dagitty.net and its R package.

    Raises:
        ModelError: There is a cycle, or a name has a quotation mark or a backslash.
    """
    graph.check_acyclic("dagitty")
    if odd := [name for name in graph.names if '"' in name or "\\" in name]:
        raise ModelError([f"dagitty cannot write the name {name!r}" for name in odd])
    nodes = [f'"{name}"' for name in graph.names]
    edges = [f'"{edge.cause}" -> "{edge.effect}"' for edge in graph.edges]
    return "\n".join(["dag {", *nodes, *edges, "}"])


def to_digraph(graph: CausalGraph) -> nx.DiGraph:
    """Write a graph as a networkx graph whose nodes and edges carry their attributes.

    It is a ``MultiDiGraph`` with the lag as key if a pair has edges of several lags.
    """
    pairs = {(edge.cause, edge.effect) for edge in graph.edges}
    several = len(pairs) < len(graph.edges)
    made = nx.MultiDiGraph() if several else nx.DiGraph()
    made.add_nodes_from((node.name, node.attributes) for node in graph.nodes)
    for edge in graph.edges:
        key = {"key": edge.lag} if several else {}
        made.add_edge(edge.cause, edge.effect, **key, **edge_attributes(edge))
    return made


def from_digraph(graph: nx.DiGraph) -> CausalGraph:
    """Read any directed networkx graph; edges without a lag have lag 0."""
    if not graph.is_directed():
        raise ValueError("its edges are not directed")
    return from_parts(graph.nodes(data=True), graph.edges(data=True))


def to_node_link(graph: CausalGraph) -> str:
    """Write a graph as the JSON that ``networkx.node_link_graph(…, edges="edges")`` reads."""
    return json.dumps(
        nx.node_link_data(to_digraph(graph), edges="edges"), indent=1, ensure_ascii=False
    )


def from_node_link(text: str) -> CausalGraph:
    """Read node-link JSON of any version of networkx, with ``edges`` or ``links``."""
    data: Any = json.loads(text)
    if not isinstance(data, dict) or not data.get("directed", False):
        raise ValueError("expected an object with 'directed': true")
    edges = data["links"] if "links" in data else data["edges"]
    return from_parts(
        ((node["id"], node) for node in data["nodes"]),
        ((edge["source"], edge["target"], edge) for edge in edges),
    )


def to_csv(graph: CausalGraph) -> str:
    """Write a matrix with a row per cause, a column per effect, and 1 where there is an edge."""
    page = io.StringIO()
    writer = csv.writer(page, lineterminator="\n")
    writer.writerow(["cause", *graph.names])
    pairs = {(edge.cause, edge.effect) for edge in graph.edges}
    for cause in graph.names:
        writer.writerow([cause, *(int((cause, effect) in pairs) for effect in graph.names)])
    return page.getvalue().rstrip("\n")


def from_csv(text: str) -> CausalGraph:
    """Read what ``to_csv`` or ``pandas.DataFrame.to_csv`` wrote."""
    rows = [row for row in csv.reader(io.StringIO(text), strict=True) if row]
    if not rows:
        raise ValueError("it is empty")
    names = rows[0][1:]
    if [row[0] for row in rows[1:]] != names:
        raise ValueError(f"rows and columns must have the same names, here {', '.join(names)}")
    edges = []
    for cause, *cells in rows[1:]:
        if len(cells) != len(names):
            raise ValueError(f"the row {cause!r} has {len(cells)} cells, not {len(names)}")
        for effect, cell in zip(names, cells, strict=True):
            if cell.strip() not in ("0", "1"):
                raise ValueError(f"row {cause!r}, column {effect!r}: {cell!r} is not 0 or 1")
            if cell.strip() == "1":
                edges.append(Edge(cause, effect))
    return CausalGraph(tuple(map(Node, names)), tuple(edges))


_WRONG = (
    *DAMAGED,
    SyntaxError,  # what the standard library raises for XML
    nx.NetworkXException,
    csv.Error,
)


@final
@dataclass(frozen=True)
class TextFormat:
    """How one format is written and read.

    Attributes:
        write: Makes text.
        read: Makes a graph, or None where text is for people only.
        view: The default.
        views: What it can hold.
    """

    write: Callable[[CausalGraph], str]
    read: Callable[[str], CausalGraph] | None
    view: View = "lagged"
    views: tuple[View, ...] = VIEWS


_TIMELESS: tuple[View, tuple[View, ...]] = ("two_slice", ("summary", "two_slice"))

FORMATS = {
    "dot": TextFormat(to_dot, None),
    "gml": TextFormat(
        lambda graph: "\n".join(nx.generate_gml(to_digraph(graph))),
        lambda text: from_digraph(nx.parse_gml(text)),
    ),
    "graphml": TextFormat(
        lambda graph: "\n".join(nx.generate_graphml(to_digraph(graph))),
        lambda text: from_digraph(nx.parse_graphml(text)),
    ),
    "node-link": TextFormat(to_node_link, from_node_link),
    "dagitty": TextFormat(to_dagitty, None, *_TIMELESS),
    "csv": TextFormat(to_csv, from_csv, *_TIMELESS),
    "html": TextFormat(to_html, None),
}


def _known(name: str, view: View | None, *, to_read: bool = False) -> tuple[TextFormat, View]:
    choices = [key for key, known in FORMATS.items() if known.read or not to_read]
    if name not in choices:
        raise UnknownOption("format to read" if to_read else "format", name, choices)
    known = FORMATS[name]
    if view is not None and view not in known.views:
        raise UnknownOption("view", view, known.views)
    return known, view or known.view


def write_graph(
    source: CausalGraph | SCM,
    path: Path | str | None = None,
    *,
    format: str,  # noqa: A002 # the word that everybody looks for
    view: View | None = None,
) -> str:
    """Write a graph as text, and to a file if a path is given.

    Args:
        source: A graph or a model.
        path: Of a file to write, or None.
        format: ``"dot"``, ``"gml"``, ``"graphml"``, ``"node-link"``, ``"dagitty"``, ``"csv"`` or
            ``"html"``.
        view: ``"lagged"``, ``"summary"`` or ``"two_slice"``, see ``seen_as``. By default what
            loses no edge: ``"lagged"`` where the format has attributes, else ``"two_slice"``.

    Raises:
        UnknownOption: There is no such format, or it cannot hold the view.
        ModelError: The format cannot hold the graph: a cycle, or a name.

    Example:
        >>> from scm_world.graph import Edge
        >>> from scm_world.graph.exchange import Node
        >>> graph = CausalGraph((Node("x"), Node("y")), (Edge("x", "y", lag=1),))
        >>> read_graph(write_graph(graph, format="csv"), format="csv") == graph
        True
    """
    known, chosen = _known(format, view)
    text = known.write(seen_as(causal_graph(source), chosen))
    if path is not None:
        Path(path).write_text(text + "\n", encoding="utf-8")
    return text


def read_graph(
    source: Path | str,
    *,
    format: str,  # noqa: A002 # as above
    view: View | None = None,
) -> CausalGraph:
    r"""Read a graph from a file (a ``Path``) or from text (a ``str``).

    Format and view are those of ``write_graph``; DOT, dagitty and HTML are not read.

    Raises:
        UnreadableFile: It is no directed graph in this format.
        UnknownOption: There is no such format or view.

    Example:
        >>> read_graph("cause,mass,weight\nmass,0,1\nweight,0,0", format="csv").edges
        (Edge(cause='mass', effect='weight', lag=0, when=None),)
    """
    known, chosen = _known(format, view, to_read=True)
    reader: Any = known.read
    name = str(source) if isinstance(source, Path) else "the text"
    try:
        text = read_text(source) if isinstance(source, Path) else source
        return read_as(reader(text), chosen)
    except UnknownOption:
        raise
    except _WRONG as error:
        said = f"there is no {error}" if isinstance(error, KeyError) else str(error)
        reason = f"it is no {format} graph: {said}".rstrip(": ")
        raise UnreadableFile(name, reason, "docs/graphs.md says what is read") from error
