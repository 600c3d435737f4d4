"""One door for all formats that are text."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import final

import networkx as nx

from scm_world.errors import DAMAGED, UnknownOption, UnreadableFile
from scm_world.graph.exchange import dot, html, networks, table
from scm_world.graph.exchange.model import CausalGraph, causal_graph
from scm_world.graph.exchange.slices import VIEWS, View, read_as, seen_as
from scm_world.graph.scm import SCM
from scm_world.output.reading import read_text

_WRONG = (
    *DAMAGED,
    SyntaxError,  # what the standard library raises for XML
    nx.NetworkXException,
    csv.Error,
)


@final
@dataclass(frozen=True)
class Format:
    """How one format is written and read.

    Attributes:
        write: Makes text.
        read: Makes a graph, or None where text is for people only.
        view: What is written if nothing else is asked for.
        views: What it can hold.
    """

    write: Callable[[CausalGraph], str]
    read: Callable[[str], CausalGraph] | None
    view: View = "lagged"
    views: tuple[View, ...] = VIEWS


_TIMELESS: tuple[View, tuple[View, ...]] = ("two_slice", ("summary", "two_slice"))

FORMATS = {
    "dot": Format(dot.to_dot, dot.from_dot),
    "gml": Format(networks.to_gml, networks.from_gml),
    "graphml": Format(networks.to_graphml, networks.from_graphml),
    "node-link": Format(networks.to_node_link, networks.from_node_link),
    "dagitty": Format(dot.to_dagitty, dot.from_dagitty, *_TIMELESS),
    "csv": Format(table.to_csv, table.from_csv, *_TIMELESS),
    "html": Format(html.to_html, None),
}


def _format(name: str, *, readable: bool = False) -> Format:
    choices = [key for key, known in FORMATS.items() if known.read or not readable]
    if name not in choices:
        raise UnknownOption("format to read" if readable else "format", name, choices)
    return FORMATS[name]


def _view(known: Format, view: View | None) -> View:
    if view is not None and view not in known.views:
        raise UnknownOption("view", view, known.views)
    return view or known.view


@contextmanager
def reading(source: str, what: str) -> Iterator[None]:
    """Turn whatever goes wrong while something is read into one error.

    Raises:
        UnreadableFile: Something went wrong.
    """
    try:
        yield
    except UnknownOption:
        raise
    except _WRONG as error:
        said = f"there is no {error}" if isinstance(error, KeyError) else str(error)
        reason = f"it is no {what}: {said}".rstrip(": ")
        raise UnreadableFile(source, reason, "docs/graphs.md says what is read") from error


def write_graph(
    source: CausalGraph | SCM,
    path: Path | str | None = None,
    *,
    format: str,  # noqa: A002 # the word that everybody looks for
    view: View | None = None,
) -> str:
    """Write a graph as text.

    Args:
        source: A graph or a model.
        path: Of a file to write, or None.
        format: ``"dot"``, ``"gml"``, ``"graphml"``, ``"node-link"``, ``"dagitty"``, ``"csv"`` or
            ``"html"``.
        view: ``"lagged"``, ``"summary"`` or ``"two_slice"``, see ``seen_as``. By default what
            loses no edge: ``"lagged"`` where the format has attributes, else ``"two_slice"``.

    Returns:
        The text.

    Raises:
        UnknownOption: There is no such format, or it cannot hold the view.
        ModelError: The format cannot hold the graph: a cycle, or a name.

    Example:
        >>> from scm_world.graph import Edge
        >>> from scm_world.graph.exchange import Node
        >>> graph = CausalGraph((Node("x"), Node("y")), (Edge("x", "y", lag=1),))
        >>> print(write_graph(graph, format="csv"))
        cause,x,y,x@-1,y@-1
        x,0,0,0,0
        y,0,0,0,0
        x@-1,0,1,0,0
        y@-1,0,0,0,0
        >>> read_graph(write_graph(graph, format="csv"), format="csv") == graph
        True
    """
    known = _format(format)
    text = known.write(seen_as(causal_graph(source), _view(known, view)))
    if path is not None:
        Path(path).write_text(text + "\n", encoding="utf-8")
    return text


def read_graph(
    source: Path | str,
    *,
    format: str,  # noqa: A002 # as above
    view: View | None = None,
) -> CausalGraph:
    """Read a graph.

    Args:
        source: The path of a file as a ``Path``, or the text itself as a ``str``.
        format: As in ``write_graph``; HTML is not read.
        view: The one that was written.

    Raises:
        UnreadableFile: It is no directed graph in this format.
        UnknownOption: There is no such format or view.

    Example:
        >>> read_graph("dag { mass -> weight }", format="dagitty").edges
        (Edge(cause='mass', effect='weight', lag=0, when=None),)
        >>> read_graph("dag { mass -- weight }", format="dagitty")
        Traceback (most recent call last):
            ...
        scm_world.errors.UnreadableFile: 'the text' cannot be read: it is no dagitty graph: ...
    """
    known = _format(format, readable=True)
    chosen = _view(known, view)
    with reading(str(source) if isinstance(source, Path) else "the text", f"{format} graph"):
        text = read_text(source) if isinstance(source, Path) else source
        if known.read is None:
            raise TypeError
        return read_as(known.read(text), chosen)
