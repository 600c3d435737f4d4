"""DOT, and dagitty's dialect of it: two writers."""

from __future__ import annotations

from scm_world.errors import ModelError
from scm_world.graph.exchange.grammar import parse
from scm_world.graph.exchange.model import CausalGraph, Node, edge_attributes, from_parts

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


def to_dot(graph: CausalGraph, *, attributes: bool = True) -> str:
    """Write a graph in the DOT language; lagged edges are dashed.

    Args:
        graph: Any graph.
        attributes: Whether to write what the picture does not show, so that it can be read back.

    Example:
        >>> from scm_world.graph import Edge
        >>> from scm_world.graph.exchange import Node
        >>> print(to_dot(CausalGraph((Node("x"), Node("y")), (Edge("x", "y", 1),))))
        digraph scm {
          rankdir=LR;
          "x" [shape=ellipse, label="x"];
          "y" [shape=ellipse, label="y"];
          "x" -> "y" [style=dashed, lag="1"];
        }
    """
    lines = ["digraph scm {", "  rankdir=LR;"]
    for node in graph.nodes:
        more = node.attributes if attributes else {}
        about = _listed({"shape": _SHAPES.get(node.kind, "ellipse"), "label": _label(node)}, more)
        lines.append(f"  {_quoted(node.name)} [{about}];")
    for edge in graph.edges:
        look = {"style": "dashed" if edge.lag else "solid"}
        if edge.when:
            look["label"] = _quoted(edge.when)
        about = _listed(look, edge_attributes(edge) if attributes else {})
        lines.append(f"  {_quoted(edge.cause)} -> {_quoted(edge.effect)} [{about}];")
    return "\n".join([*lines, "}"])


def _label(node: Node) -> str:
    unit = f"\\n[{_quoted(node.unit)[1:-1]}]" if node.unit else ""
    return f'{_quoted(node.name)[:-1]}{unit}"'


def _listed(look: dict[str, str], more: dict[str, str] | dict[str, int | str]) -> str:
    pairs = [*look.items(), *((key, _quoted(str(value))) for key, value in more.items())]
    return ", ".join(f"{key}={value}" for key, value in pairs)


def from_dot(text: str) -> CausalGraph:
    """Read a directed graph in the DOT language.

    Raises:
        ValueError: It is none, or uses ports or HTML labels.
    """
    return from_parts(*parse(text, "digraph"))


def to_dagitty(graph: CausalGraph) -> str:
    """Write a graph for dagitty, www.dagitty.net and its R package.

    Raises:
        ModelError: There is a cycle, or a name has a quotation mark or a backslash.

    Example:
        >>> from scm_world.graph import Edge
        >>> from scm_world.graph.exchange import Node
        >>> print(to_dagitty(CausalGraph((Node("x"), Node("y.z")), (Edge("x", "y.z"),))))
        dag {
        "x"
        "y.z"
        "x" -> "y.z"
        }
    """
    graph.check_acyclic("dagitty")
    if odd := [name for name in graph.names if '"' in name or "\\" in name]:
        raise ModelError([f"dagitty cannot write the name {name!r}" for name in odd])
    nodes = [f'"{name}"' for name in graph.names]
    edges = [f'"{edge.cause}" -> "{edge.effect}"' for edge in graph.edges]
    return "\n".join(["dag {", *nodes, *edges, "}"])


def from_dagitty(text: str) -> CausalGraph:
    """Read what dagitty writes; positions, exposures and outcomes are left out.

    Raises:
        ValueError: It is no graph of directed edges.
    """
    return from_parts(*parse(text, "dag"))
