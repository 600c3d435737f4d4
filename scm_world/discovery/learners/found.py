"""The graph that a learner estimates, with a score of each edge."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, final

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import typed, whole_number
from scm_world._types import Floats
from scm_world.errors import ModelError, UnknownOption, UnknownVariable, raise_all
from scm_world.graph.ancestral import CIRCLE, HEAD, TAIL, Marks, edge_words
from scm_world.graph.views import to_digraph
from scm_world.queries.equations import as_given
from scm_world.queries.experiments.effects import EdgeKey

FORMAT = "scm_world/found/3"
Bools = NDArray[np.bool_]


@final
@typed
@dataclass(frozen=True, eq=False)
class EstimatedGraph:
    """An estimated graph over variables, possibly with earlier instants and undirected edges.

    Attributes:
        names: Names of the p variables.
        edges: Shape (lags + 1, p, p): ``edges[lag, i, j]`` says that i acts on j that many control
            steps later. Both ``edges[0, i, j]`` and ``edges[0, j, i]``: the edge has no direction.
        edge_scores: Score of each edge, same shape: only the order of the numbers means something.
        learner: Name of the learner.
        settings: Settings of the learner.
        experiments: How many episodes or control steps it used: rows of data, or experiments.
        bound: Fewest experiments that can do in theory, if one is known; see ``design``.
        seconds: How long it took.
        versions: Versions of the libraries that it uses.
        notes: Remarks on the result.
        marks: Shape (lags + 1, p, p), of a learner that allows for hidden causes: at [lag, i, j]
            the mark at i of the edge from so many control steps before j; see
            ``scm_world.graph.ancestral``. Then ``edges`` says where i may act on j: no head at i.
        targets: Targets found by a learner that does not know them: for each regime of the table
            the variables that were, as it estimates; empty otherwise.
    """

    names: tuple[str, ...]
    edges: Bools
    edge_scores: Floats
    learner: str = ""
    settings: dict[str, Any] = field(default_factory=dict)
    experiments: int = 0
    bound: int | None = None
    seconds: float = 0.0
    versions: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    marks: Marks | None = None
    targets: tuple[tuple[str, ...], ...] = ()

    def __post_init__(self) -> None:
        """Check the names, the shapes and the numbers."""
        p = len(self.names)
        if len({*self.names}) < p:
            raise ModelError([f"two variables have the same name: {', '.join(self.names)}"])
        if self.edges.shape != self.edge_scores.shape or self.edges.shape[1:] != (p, p):
            shapes = f"{self.edges.shape} and {self.edge_scores.shape}"
            raise ModelError([f"edges and edge_scores have shapes {shapes}, of {p} variables"])
        if self.marks is not None and self.marks.shape != self.edges.shape:
            shapes = f"{self.edges.shape} and {self.marks.shape}"
            raise ModelError([f"edges and marks have shapes {shapes}; they must have one"])
        if self.marks is not None and not np.isin(self.marks, (0, HEAD, TAIL, CIRCLE)).all():
            raise ModelError([f"marks are {HEAD}, {TAIL}, {CIRCLE}, and 0 without an edge"])
        if not np.isfinite(self.edge_scores).all():
            raise ModelError(["a graph has numbers that are not finite; give 0 without an edge"])

    @classmethod
    @typed
    def of(
        cls, names: Sequence[str], matrix: object, *, edge_scores: object = None, **others: object
    ) -> EstimatedGraph:
        """Make one from matrices.

        Args:
            names: Names of the p variables.
            matrix: Shape (p, p) for lag 0, or (lags + 1, p, p); not zero at [i, j] where i acts on
                j. An edge in both directions within an instant has none. Data frames, one or one
                for each lag, and networkx graphs with their attributes ``lag`` and ``weight`` are
                read by their labels.
            edge_scores: Same shape, not negative; the absolute values of the matrix if None.
            others: Further attributes.

        Raises:
            ModelError: The shapes do not fit together, a number is not finite, or negative, or a
                node of a networkx graph is not a variable.

        Example:
            >>> found = EstimatedGraph.of(["x", "y", "z"], [[0, 1, 0], [0, 0, 1], [0, 1, 0]])
            >>> found.directed, found.undirected
            ((('x', 'y', 0),), (('y', 'z'),))
        """
        if isinstance(matrix, nx.Graph):
            matrix = _weights(matrix, names)
        given = _matrix("matrix", matrix, names)
        weight = np.abs(given)
        if edge_scores is not None:
            weight = _matrix("edge_scores", edge_scores, names)
            if weight.shape != given.shape:
                shapes = f"{given.shape} and {weight.shape}"
                raise ModelError([f"matrix and edge_scores have shapes {shapes}"])
        if (weight < 0).any():
            raise ModelError(
                ["an edge score is negative; of a log-probability give the negative one"]
            )
        edges = given != 0
        np.fill_diagonal(edges[0], False)
        more: dict[str, Any] = {**others}
        return cls(tuple(names), edges, weight.astype(np.float64), **more)

    @classmethod
    @typed
    def of_edges(
        cls, names: Sequence[str], edges: Iterable[EdgeKey], **others: object
    ) -> EstimatedGraph:
        """Make one from directed edges: cause, effect and lag.

        Raises:
            UnknownOption: An edge is something else.
            UnknownVariable: An edge is about another variable.
        """
        return cls.of(names, matrices(edges, names), **others)

    @classmethod
    @typed
    def of_marks(cls, names: Sequence[str], marks: object, **others: object) -> EstimatedGraph:
        """Make one from edge marks, shape (p, p) or (lags + 1, p, p).

        Raises:
            ModelError: A number is not a mark, or an edge has a mark at one end only.

        Example:
            >>> found = EstimatedGraph.of_marks(["x", "y", "z"], [[0, 2, 0], [1, 0, 1], [0, 1, 0]])
            >>> found.words, found.directed
            (('x o-> y', 'y <-> z'), (('x', 'y', 0),))
        """
        given = _matrix("marks", marks, names)
        if not np.isin(given, (0, HEAD, TAIL, CIRCLE)).all():
            raise ModelError([f"marks are {HEAD}, {TAIL}, {CIRCLE}, and 0 without an edge"])
        given = given.astype(np.int8)
        if ((given[0] == 0) != (given[0].T == 0)).any() or given[0].diagonal().any():
            raise ModelError(["an edge within an instant has a mark at both ends, and no loops"])
        others.setdefault("edge_scores", (given != 0).astype(np.float64))
        scores = others.pop("edge_scores")
        found = cls.of(names, (given != 0) & (given != HEAD), edge_scores=scores, **others)
        return replace(found, marks=given)

    @property
    def ancestral(self) -> Marks:
        """Its edge marks; without, an edge without direction is o-o, and others are -->."""
        if self.marks is not None:
            return self.marks
        marks = np.where(self.edges, TAIL, 0).astype(np.int8)
        marks[0][self.edges[0].T & ~self.edges[0]] = HEAD
        marks[0][self.edges[0].T & self.edges[0]] = CIRCLE
        return marks

    @property
    def words(self) -> tuple[str, ...]:
        """Its edges with their marks, such as ``"x o-> y"`` or ``"x@-1 <-> y"``."""
        return edge_words(self.names, self.ancestral)

    @property
    def directed(self) -> tuple[EdgeKey, ...]:
        """Edges that have a direction: cause, effect, lag."""
        one_way = self.edges.copy()
        one_way[0] &= ~self.edges[0].T
        return tuple(
            (self.names[i], self.names[j], lag) for lag, i, j in np.argwhere(one_way).tolist()
        )

    @property
    def undirected(self) -> tuple[tuple[str, str], ...]:
        """Edges within the instant that have none."""
        both = np.triu(self.edges[0] & self.edges[0].T)
        return tuple((self.names[i], self.names[j]) for i, j in np.argwhere(both).tolist())

    @typed
    def restricted(self, names: Sequence[str]) -> EstimatedGraph:
        """Return the part on some variables; those that it lacks have no edges."""
        at = {name: i for i, name in enumerate(self.names)}
        kept = [name for name in names if name in at]
        new = [i for i, name in enumerate(names) if name in at]
        old = [at[name] for name in kept]
        shape = (len(self.edges), len(names), len(names))

        def part(matrix: NDArray[Any]) -> Any:
            made = np.zeros(shape, matrix.dtype)
            made[:, np.array(new, int)[:, None], new] = matrix[:, np.array(old, int)[:, None], old]
            return made

        return replace(
            self,
            names=tuple(names),
            edges=part(self.edges),
            edge_scores=part(self.edge_scores),
            marks=None if self.marks is None else part(self.marks),
        )

    # --- files --------------------------------------------------------------------------------

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain data: edges and scores above 0 by lag, cause and effect."""
        scores = self.edge_scores
        return {
            "format": FORMAT,
            **{f.name: getattr(self, f.name) for f in fields(self)},
            "names": list(self.names),
            "lags": len(self.edges) - 1,
            "edges": np.argwhere(self.edges).tolist(),
            "edge_scores": [[*at, float(scores[*at])] for at in np.argwhere(scores > 0.0).tolist()],
            "notes": list(self.notes),
            "marks": None if self.marks is None else self.marks.tolist(),
            "targets": [list(names) for names in self.targets],
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> EstimatedGraph:
        """Read what ``as_dict`` wrote.

        Raises:
            ModelError: It is not such a graph.
        """
        try:
            plain = dict(data)
            if plain.pop("format") != FORMAT:
                raise ValueError(f"expected the format {FORMAT!r}, got {data['format']!r}")
            names = tuple(map(str, plain.pop("names")))
            lags = whole_number("lags", plain.pop("lags"), least=0)
            edges = np.zeros((lags + 1, len(names), len(names)), bool)
            scores = np.zeros(edges.shape)
            for matrix, filled in (
                (edges, [(*place, True) for place in plain.pop("edges")]),
                (scores, plain.pop("edge_scores")),
            ):
                for *place, value in filled:
                    lag, i, j = (whole_number("number of an edge", n, least=0) for n in place)
                    matrix[lag, i, j] = value
            plain["marks"] = None if plain["marks"] is None else np.array(plain["marks"], np.int8)
            plain["notes"] = tuple(plain["notes"])
            plain["targets"] = tuple(tuple(map(str, each)) for each in plain["targets"])
            return cls(names, edges, scores, **plain)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise ModelError([f"not a graph that a learner found: {error!r}"]) from None


def edge_keys(edges: object) -> list[EdgeKey]:
    """Return edges as (cause, effect, lag).

    Args:
        edges: Such triples, a ``GroundTruth``, an ``SCM``, a world, or a directed networkx graph.

    Raises:
        UnknownOption: They are something else, or a lag is not a whole number from 0.
        ModelError: The edges of a networkx graph have no direction, or a lag is not a number.
    """
    given: Any = to_digraph(edges) if isinstance(edges, nx.Graph) else as_given(edges)
    try:
        given = getattr(given, "model", given)
        keys = [getattr(edge, "key", edge) for edge in getattr(given, "edges", given)]
        found = [(str(cause), str(effect), lag) for cause, effect, lag in keys]
    except (TypeError, ValueError):
        allowed = ("a list of (cause, effect, lag)", "a GroundTruth", "an SCM", "a networkx graph")
        raise UnknownOption("edges", edges, allowed) from None
    return [(c, e, whole_number(f"lag of {c} → {e}", lag, least=0)) for c, e, lag in found]


def matrices(edges: object, names: Sequence[str], lags: int = 0) -> Bools:
    """Write edges as matrices, shape (lags + 1, p, p), with as many lags as they have at least.

    Raises:
        UnknownOption: They are not edges.
        UnknownVariable: An edge is about another variable.
    """
    keys = edge_keys(edges)
    at = {name: i for i, name in enumerate(names)}
    unknown = dict.fromkeys(name for key in keys for name in key[:2] if name not in at)
    raise_all([UnknownVariable(name, names) for name in unknown])
    found = np.zeros((1 + max([lags, *(lag for *_, lag in keys)]), len(at), len(at)), dtype=bool)
    for cause, effect, lag in keys:
        found[lag, at[cause], at[effect]] = True
    return found


def _weights(graph: nx.Graph, names: Sequence[str]) -> Floats:
    """Read a networkx graph as matrices of weights, by default 1, shape (lags + 1, p, p).

    Nodes 0, 1, … are the variables in their order. Without directions an edge acts both ways.
    """
    if {*graph} == {*range(len(names))} and not {*map(str, graph)} <= {*names}:
        graph = nx.relabel_nodes(graph, dict(enumerate(names)))
    edges = to_digraph(graph if graph.is_directed() else graph.to_directed())
    at = {name: i for i, name in enumerate(names)}
    if unknown := [str(node) for node in edges if str(node) not in at]:
        labels = f"the nodes {', '.join(unknown)}; the variables are {', '.join(names)}"
        raise ModelError([f"the graph has {labels}"])
    found = matrices(edges, names).astype(np.float64)
    for cause, effect, lag, weight in edges.edges(keys=True, data="weight", default=1.0):
        try:  # DOT has numbers as text, with or without quotes
            found[lag, at[str(cause)], at[str(effect)]] = float(str(weight).strip('"'))
        except ValueError:
            text = f"the weight {weight!r} of {cause!r} → {effect!r} is not a number"
            raise ModelError([text]) from None
    return found


def _matrix(what: str, given: object, names: Sequence[str]) -> NDArray[Any]:
    """Read matrices of numbers over p variables, shape (lags + 1, p, p)."""
    p = len(names)
    if isinstance(given, list | tuple):
        given = [_in_order(what, each, names) for each in given]
    given = _in_order(what, given, names)
    try:
        found = np.array(given)
    except ValueError:  # rows of several lengths
        found = np.array(given, dtype=object)
    found = found[None] if found.ndim == 2 else found
    if found.dtype.kind not in "biuf" or found.ndim != 3 or found.shape[1:] != (p, p):
        kind = f"shape {found.shape}, dtype {found.dtype}"
        raise ModelError([f"{what} of {p} variables has {kind}; give real numbers, ({p}, {p})"])
    return found


def _in_order(what: str, given: Any, names: Sequence[str]) -> Any:
    """Return a data frame with rows and columns in the order of the names; others as they are.

    An axis with the labels 0, 1, … has the order of the other axis; if both have, of the names.
    """
    if not hasattr(given, "set_axis"):
        return given
    axes = [[*given.index], [*given.columns]]
    own = [[*map(str, axis)] for axis in axes if axis != [*range(len(axis))]]
    labelled = own or [[*names]]
    for axis in labelled:
        if sorted(axis) != sorted(names):
            labels = f"the labels {', '.join(axis)}; give {', '.join(names)}, each once"
            raise ModelError([f"{what} is a frame with {labels}"])
    if given.shape != (len(names), len(names)):
        return given  # its shape is refused with those of arrays
    given = given.set_axis(labelled[0], axis=0).set_axis(labelled[-1], axis=1)
    return given.loc[[*names], [*names]].to_numpy()
