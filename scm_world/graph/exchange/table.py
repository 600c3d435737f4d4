"""An adjacency matrix as comma-separated values."""

from __future__ import annotations

import csv
import io

from scm_world.graph.exchange.model import CausalGraph, Node
from scm_world.graph.structure import Edge


def to_csv(graph: CausalGraph) -> str:
    """Write a matrix with a row per cause, a column per effect, and 1 where there is an edge.

    Example:
        >>> print(to_csv(CausalGraph((Node("x"), Node("y")), (Edge("x", "y"),))))
        cause,x,y
        x,0,1
        y,0,0
    """
    page = io.StringIO()
    writer = csv.writer(page, lineterminator="\n")
    writer.writerow(["cause", *graph.names])
    pairs = {(edge.cause, edge.effect) for edge in graph.edges}
    for cause in graph.names:
        writer.writerow([cause, *(int((cause, effect) in pairs) for effect in graph.names)])
    return page.getvalue().rstrip("\n")


def from_csv(text: str) -> CausalGraph:
    """Read what ``to_csv`` or ``pandas.DataFrame.to_csv`` wrote.

    Raises:
        ValueError: Rows and columns do not have the same names, or a cell is not 0 or 1.
    """
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
