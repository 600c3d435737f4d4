"""The true graph of a table, over exactly its columns."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, final

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import whole_number
from scm_world.discovery.data.recorded import first_name, is_state
from scm_world.graph import SCM
from scm_world.graph.ancestral import Marks, last_slice, mag, pag, window
from scm_world.graph.ancestral import edge_words as edge_words
from scm_world.queries.experiments.effects import EdgeKey
from scm_world.queries.identification import nature_graph
from scm_world.queries.outcomes import Outcome
from scm_world.variables import Derived, Exogenous, Linear

LONGEST = 3
"""Effects through hidden variables are listed up to this lag [control steps]."""

Pair = tuple[str, str, int]
"""Two variables with a hidden common cause; the first is so many control steps earlier."""


@final
@dataclass(frozen=True, kw_only=True)
class GroundTruth:
    """A true graph: directed edges, and pairs that hidden variables confound (an ADMG).

    Attributes:
        name: Of the problem.
        names: Of its variables, in order.
        edges: Cause, effect and lag [control steps].
        confounded: Pairs with a hidden common cause.
        weights: Of the edges of linear mechanisms.
        unscored: Pairs that are not scored, in either direction and with any lag.
        about: What else a reader of the results should know.
    """

    name: str
    names: tuple[str, ...]
    edges: tuple[EdgeKey, ...]
    confounded: tuple[Pair, ...] = ()
    weights: Mapping[EdgeKey, float] = field(default_factory=dict)
    unscored: tuple[tuple[str, str], ...] = ()
    about: dict[str, Any] = field(default_factory=dict)

    @property
    def pairs(self) -> NDArray[np.bool_]:
        """Which pairs are scored, shape (p, p)."""
        at = {name: i for i, name in enumerate(self.names)}
        mask = np.ones((len(at), len(at)), dtype=bool)
        for one, other in self.unscored:
            mask[at[one], at[other]] = mask[at[other], at[one]] = False
        return mask

    def adjacency(self, lag: int = 0) -> NDArray[np.bool_]:
        """Give the edges of a lag, shape (p, p): row causes column."""
        at = {name: i for i, name in enumerate(self.names)}
        found = np.zeros((len(at), len(at)), dtype=bool)
        for cause, effect, steps in self.edges:
            if steps == lag:
                found[at[cause], at[effect]] = True
        return found

    def mag(self, lags: int | None = None) -> Marks:
        """Give the maximal ancestral graph: edge marks, without circles.

        Args:
            lags: How many control steps before the present are observed; the longest lag of the
                graph if None. All that was before is hidden.

        Returns:
            Shape (lags + 1, p, p): at [lag, i, j] the mark at i, so many steps before j; see
            ``scm_world.graph.ancestral``.

        Raises:
            ModelError: There is a cycle within the instant.
        """
        return last_slice(*self._window(lags))

    def pag(self, lags: int | None = None) -> Marks:
        """Give the partial ancestral graph: the marks that can be learned without interventions.

        The order of control steps is taken for known. Arguments and result are those of ``mag``.

        Example:
            >>> truth = GroundTruth(name="m", names=("x", "y"), edges=(("x", "y", 0),))
            >>> edge_words(truth.names, truth.mag()), edge_words(truth.names, truth.pag())
            (('x --> y',), ('x o-o y',))
        """
        marks, lags = self._window(lags)
        tiers = np.repeat(np.arange(lags + 1), len(self.names)).tolist()
        return last_slice(pag(marks, tiers), lags)

    def _window(self, lags: int | None) -> tuple[Marks, int]:
        """Return the maximal ancestral graph of a window through time, and its lags."""
        at = {name: i for i, name in enumerate(self.names)}
        most = max((lag for *_, lag in (*self.edges, *self.confounded)), default=0)
        edges = np.zeros((most + 1, len(at), len(at)), dtype=bool)
        shared = np.zeros_like(edges)
        for matrix, pairs in ((edges, self.edges), (shared, self.confounded)):
            for one, other, lag in pairs:
                matrix[lag, at[one], at[other]] = True
        shared[0] |= shared[0].T
        lags = most if lags is None else whole_number("lags", lags, least=0)
        return mag(*window(edges, shared, lags)), lags


def truth_of_model(model: SCM) -> dict[str, Any]:
    """Write the graph of a model as plain data: edges with weights, and what has noise."""
    edges = []
    for variable in model.variables:
        mechanism = variable.mechanism if isinstance(variable, Derived) else None
        weights: Sequence[float | None] = [None] * len(variable.all_parents)
        if isinstance(mechanism, Linear):
            weights = mechanism.weights
        edges += [
            [parent.name, variable.name, parent.lag, weight]
            for parent, weight in zip(variable.all_parents, weights, strict=True)
        ]
    noisy = [
        v.name
        for v in model.variables
        if (isinstance(v, Derived) and v.noise is not None)
        or (isinstance(v, Exogenous) and v.distribution is not None)
    ]
    held = [
        v.name
        for v in model.variables
        if model.is_temporal and isinstance(v, Exogenous) and v.per == "episode"
    ]
    return {"edges": edges, "noisy": noisy, "held": held}


def truth_of_steps(model: SCM, names: Iterable[str], bundles: Mapping[str, Any]) -> dict[str, Any]:
    """Write the graph of one control step of a world, over some of its variables.

    Args:
        model: Of the world.
        names: What is in a row.
        bundles: The parts of each bundle.
    """
    known = set(names)
    whole = {part: n for n, parts in bundles.items() if n in known for part in parts}
    found = (edge.key for edge in model.edges)
    named = ((whole.get(c, c), whole.get(e, e), lag) for c, e, lag in found)
    edges = dict.fromkeys((c, e, lag) for c, e, lag in named if {c, e} <= known and (lag or c != e))
    held = [v.name for v in model.variables if v.name in known and v.role == "parameter"]
    written = [[*edge, None] for edge in edges]
    return {"edges": written, "noisy": sorted(known), "held": held}


def truth_of_episodes(
    model: SCM,
    nature: Mapping[str, Any],
    causes: Sequence[str],
    outcomes: Sequence[Outcome],
    labels: Mapping[Outcome, str],
) -> dict[str, Any]:
    """Write the graph of whole episodes: what they begin with, and what they end with.

    Outcomes are effects of what episodes begin with. Among one another they are not scored.

    Args:
        model: Of the world.
        nature: What varies at the beginning.
        causes: What is in a row of the beginning.
        outcomes: What is in a row besides.
        labels: Name of each outcome in the table.

    Raises:
        ModelError: Nature does something later than at the beginning.
    """
    graph = nature_graph(model, nature, [outcome.name for outcome in outcomes])
    named = {name: first_name(model, name) for name in causes}
    node = {f"{model.target(n)}@0" if is_state(model, n) else n: f for n, f in named.items()}
    kept = {**node, **{outcome.name: outcome.name for outcome in outcomes}}
    ends: dict[str, list[str]] = {}
    for outcome in outcomes:
        ends.setdefault(outcome.name, []).append(labels[outcome])
    final = {outcome.name: labels[outcome] for outcome in outcomes if outcome.how == "final"}
    source = {**final, **node}
    edges = [
        [source[cause], label, 0, None]
        for cause, effect in projected(graph, kept)
        if cause in source
        for label in ([node[effect]] if effect in node else ends[effect])
    ]
    shown = [label for each in ends.values() for label in each]
    pairs = [[a, b] for i, a in enumerate(shown) for b in shown[i + 1 :]]
    return {"edges": edges, "noisy": [*node.values()], "unscored": pairs}


def projected(graph: nx.DiGraph, kept: Collection[str]) -> list[tuple[str, str]]:
    """Leave out nodes that follow from others without noise: their causes act in their place."""
    found = set()
    for cause in kept:
        ahead = [cause] if cause in graph else []
        while ahead:
            for effect in graph.successors(ahead.pop()):
                if effect in kept:
                    found.add((cause, effect))
                else:
                    ahead.append(effect)
    return sorted(found)


def observed_part(name: str, written: Mapping[str, Any], names: Sequence[str]) -> GroundTruth:
    """Project a graph on the variables that are in a table (a latent projection).

    A cause acts through hidden variables as if directly. A hidden variable with noise confounds all
    pairs that it reaches through hidden ones only; one that keeps its value over an episode does so
    across control steps, a variable with itself among them.

    Args:
        name: Of the system.
        written: The graph, as one of the functions above wrote it.
        names: The variables of the table.

    Source:
        Verma and Pearl, *Equivalence and synthesis of causal models*, UAI 1990.
    """
    known, after = set(names), dict[str, list[tuple[str, int]]]()
    for cause, effect, lag, _ in written["edges"]:
        after.setdefault(cause, []).append((effect, lag))
    for held in written.get("held", ()):
        if held not in known:
            after.setdefault(held, []).append((held, 1))

    def reached(start: str) -> list[tuple[str, int]]:
        found: dict[tuple[str, int], None] = {}
        ahead, seen = [(start, 0)], set[tuple[str, int]]()
        while ahead:
            node, steps = ahead.pop()
            for effect, lag in after.get(node, ()):
                place = (effect, steps + lag)
                if effect in known:
                    found[place] = None
                elif place not in seen and place[1] <= LONGEST:
                    seen.add(place)
                    ahead.append(place)
        return sorted(found)

    edges = [(cause, effect, lag) for cause in names for effect, lag in reached(cause)]
    confounded: dict[Pair, None] = {}
    for source in written["noisy"]:
        if source in known:
            continue
        children = reached(source)
        for i, (one, early) in enumerate(children):
            for other, late in children[i + 1 :]:
                first, second = sorted([(early, one), (late, other)])
                confounded[first[1], second[1], second[0] - first[0]] = None
    weights = {
        (cause, effect, lag): float(weight)
        for cause, effect, lag, weight in written["edges"]
        if weight is not None and {cause, effect} <= known
    }
    unscored = (tuple(pair) for pair in written.get("unscored", ()))
    return GroundTruth(
        name=name,
        names=tuple(names),
        edges=tuple(edges),
        confounded=tuple(confounded),
        weights=weights,
        unscored=tuple((a, b) for a, b in unscored if {a, b} <= known),
    )
