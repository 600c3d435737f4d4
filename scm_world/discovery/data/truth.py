"""The true graph of a table, over exactly its columns."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import TYPE_CHECKING, Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import one_of, typed, whole_number
from scm_world.discovery.data.recorded import first_name, is_state
from scm_world.errors import ModelError, UnknownOption
from scm_world.graph import SCM
from scm_world.graph.ancestral import Marks, last_slice, mag, pag, window
from scm_world.graph.ancestral import edge_words as edge_words
from scm_world.graph.views import applied, drawn_once, projection, unseen
from scm_world.queries.experiments.effects import EdgeKey
from scm_world.queries.experiments.given import EVERYTHING, Present
from scm_world.queries.identification import in_force, nature_graph
from scm_world.queries.local import holds
from scm_world.queries.plans import Plan
from scm_world.queries.samples import Outcome
from scm_world.variables import Linear

if TYPE_CHECKING:
    from scm_world.discovery.data.dataset import Dataset
    from scm_world.queries.verification import GraphReport

CONDITIONS = "contact", "set"

LONGEST = 3
"""Effects through hidden variables are listed up to this lag [control steps]."""

Pair = tuple[str, str, int]
"""Two variables with a hidden common cause; the first is so many control steps earlier."""


@final
@dataclass(frozen=True, kw_only=True)
class GroundTruth:
    """A true graph: directed edges, and pairs that hidden variables confound (an ADMG).

    Attributes:
        name: Name of the problem.
        names: Its variables, in order.
        edges: Cause, effect and lag [control steps].
        confounded: Pairs with a hidden common cause.
        weights: How much an effect moves with its cause while all else in the table is held, for
            edges whose mechanisms are linear; also for a confounded pair, where no regression of
            these rows would give it.
        unscored: Pairs that are not scored, in either direction and with any lag.
        about: Further properties of the problem, for readers of results.
        when: The edges that do not always hold, by condition: ``"contact"`` while bodies touch,
            ``"set"`` at the start of an episode and at the instant of an intervention.
        unseen: Edges that are not scored: an experiment never saw their effect, or it was weak.
        strength: The largest effect that an experiment saw, in spreads of the effect in free
            motion, of edges that have one.
    """

    name: str
    names: tuple[str, ...]
    edges: tuple[EdgeKey, ...]
    confounded: tuple[Pair, ...] = ()
    weights: Mapping[EdgeKey, float] = field(default_factory=dict)
    unscored: tuple[tuple[str, str], ...] = ()
    about: dict[str, Any] = field(default_factory=dict)
    when: Mapping[str, tuple[EdgeKey, ...]] = field(default_factory=dict)
    unseen: tuple[EdgeKey, ...] = ()
    strength: Mapping[EdgeKey, float] = field(default_factory=dict)

    @property
    def pairs(self) -> NDArray[np.bool_]:
        """Which pairs are scored, shape (p, p); (lags + 1, p, p) where an edge is unseen."""
        at = {name: i for i, name in enumerate(self.names)}
        lags = max((lag for *_, lag in self.unseen), default=0)
        mask = np.ones((lags + 1, len(at), len(at)), dtype=bool)
        for one, other in self.unscored:
            mask[:, at[one], at[other]] = mask[:, at[other], at[one]] = False
        for cause, effect, lag in self.unseen:
            mask[lag, at[cause], at[effect]] = False
        return mask if self.unseen else mask[0]

    @typed
    def marked(self, report: GraphReport, *, at_least: float = 0.0) -> GroundTruth:
        """Add the findings of ``verify`` or ``discover``: strength of edges, and ``unseen`` edges.

        ``pairs`` leaves out the edges that were never seen or are weaker than ``at_least``.
        """
        if not hasattr(report, "unseen"):
            raise UnknownOption("report", report, ("the report of verify or discover",))
        seen, never = report.strength, {edge.key for edge in report.unseen}
        never |= report.weak(at_least)
        return replace(
            self,
            unseen=tuple(edge for edge in self.edges if edge in never),
            strength={edge: seen[edge] for edge in self.edges if edge in seen},
        )

    def during(self, *conditions: str) -> GroundTruth:
        """Return the graph while only these conditions hold.

        ``during()`` has the edges that act in every control step, ``during("contact")`` also those
        that act while bodies touch. Confounded pairs stay.

        Raises:
            UnknownOption: A condition is neither ``"contact"`` nor ``"set"``.
        """
        for condition in conditions:
            one_of("condition", condition, CONDITIONS)
        return self._without(
            e for c in CONDITIONS if c not in conditions for e in self.when.get(c, ())
        )

    def for_rows(self, table: Dataset) -> GroundTruth:
        """Return the graph of the rows of a table: without edges whose condition held in none.

        An edge by contact stays if, in a control step that led to one of the rows, a chain of
        contacts joined its bodies; see ``Dataset.acting``. ``table.rows(table.touching("box"))``
        has the rows in which a body touched something.

        Raises:
            ModelError: The table was collected without contacts, or has other variables.
        """
        if not hasattr(table, "acting"):
            raise UnknownOption("table", table, ("a Dataset",))
        acting = table.acting().truth
        if acting is None or {*acting.names} != {*self.names}:
            raise ModelError(["the table has other variables than the graph: take table.truth"])
        kept = {*acting.edges}
        found = self._without(edge for edge in self.edges if edge not in kept)
        return replace(found, confounded=acting.confounded)

    def _without(self, edges: Iterable[EdgeKey]) -> GroundTruth:
        gone = {*edges}
        return replace(
            self,
            edges=tuple(e for e in self.edges if e not in gone),
            weights={e: weight for e, weight in self.weights.items() if e not in gone},
            when={c: tuple(e for e in found if e not in gone) for c, found in self.when.items()},
            unseen=tuple(e for e in self.unseen if e not in gone),
            strength={e: size for e, size in self.strength.items() if e not in gone},
        )

    @typed
    def adjacency(self, lag: int = 0) -> NDArray[np.bool_]:
        """Return the edges of a lag, shape (p, p): row causes column."""
        (edges, _), lag = self._matrices(), whole_number("lag", lag, least=0)
        return edges[lag] if lag < len(edges) else np.zeros_like(edges[0])

    @typed
    def mag(self, lags: int | None = None) -> Marks:
        """Return the maximal ancestral graph: edge marks, without circles.

        Args:
            lags: How many control steps before the present are observed; the longest lag of the
                graph if None. All earlier ones are hidden.

        Returns:
            Shape (lags + 1, p, p): at [lag, i, j] the mark at i, so many steps before j; see
            ``scm_world.graph.ancestral``.

        Raises:
            ModelError: There is a cycle within the instant.
        """
        return last_slice(*self._window(lags))

    @typed
    def pag(self, lags: int | None = None) -> Marks:
        """Return the partial ancestral graph: the marks that can be learned without interventions.

        The order of control steps is taken for known. Arguments and result are those of ``mag``.

        Example:
            >>> truth = GroundTruth(name="m", names=("x", "y"), edges=(("x", "y", 0),))
            >>> edge_words(truth.names, truth.mag()), edge_words(truth.names, truth.pag())
            (('x --> y',), ('x o-o y',))
        """
        marks, lags = self._window(lags)
        before = [int(name.rpartition("@-")[2]) if "@-" in name else 0 for name in self.names]
        tiers = [step - back for step, back in product(range(lags + 1), before)]
        return last_slice(pag(marks, tiers), lags)

    def _window(self, lags: int | None) -> tuple[Marks, int]:
        """Return the maximal ancestral graph of a window through time, and its lags."""
        edges, shared = self._matrices()
        lags = len(edges) - 1 if lags is None else whole_number("lags", lags, least=0, most=1000)
        return mag(*window(edges, shared, lags)), lags

    def _matrices(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Write edges and confounded pairs by lag, shape (most + 1, p, p) each."""
        at = {name: i for i, name in enumerate(self.names)}
        most = max((lag for *_, lag in (*self.edges, *self.confounded)), default=0)
        edges = np.zeros((most + 1, len(at), len(at)), dtype=bool)
        shared = np.zeros_like(edges)
        for matrix, pairs in ((edges, self.edges), (shared, self.confounded)):
            for one, other, lag in pairs:
                matrix[lag, at[one], at[other]] = True
        shared[0] |= shared[0].T
        return edges, shared


def truth_of_model(model: SCM) -> dict[str, Any]:
    """Return the graph of a model as plain data: edges with weights, and variables with noise."""
    edges: list[list[Any]] = []
    noisy, lasting = [], drawn_once(model)
    for name in model:
        variable = model[name]
        acts = [*applied(model, name)]
        mechanism = variable.equation if variable.role == "parameter" else None
        weights: Sequence[float | None] = [None] * len(variable.all_parents)
        factors = [act.factor for act, _ in acts]
        known = None not in factors and all(of.name == name for _, of in acts)
        if isinstance(mechanism, Linear) and known:
            weights = [weight * float(np.prod(factors)) for weight in mechanism.weights]  # type: ignore[arg-type] # they are known
        edges += [
            [parent.name, name, parent.lag, weight, parent.when]
            for parent, weight in zip(variable.all_parents, weights, strict=True)
        ]
        is_moved = any(act.relative is not None for act, _ in acts)
        if variable.own_noise is not None or is_moved:
            noisy.append(name)
    held = [n for n in model if n in lasting and not model[n].all_parents and model.is_temporal]
    return _with_unseen(
        {"edges": edges, "noisy": noisy, "held": held}, model, {n: n for n in model}
    )


def _with_unseen(written: dict[str, Any], model: SCM, shown: Mapping[str, str]) -> dict[str, Any]:
    """Add noise that no edge shows to a graph; ``shown`` has the names of variables in it."""
    lasting = drawn_once(model)
    for noise, effects in unseen(model).items():
        written["edges"] += [[noise, shown[n], 0, None, None] for n in effects if n in shown]
        written["noisy"].append(noise)
        if "held" in written and lasting.issuperset(effects):
            written["held"].append(noise)
    return written


def truth_of_steps(
    model: SCM,
    context: Mapping[str, Any],
    names: Iterable[str],
    bundles: Mapping[str, Any],
    terms: Mapping[str, Any] = {},
    there: Present = EVERYTHING,
) -> dict[str, Any]:
    """Return the graph of one control step of a world, over some of its variables.

    The edges are those of every mechanism that a variable has in the course of an episode under
    the interventions of ``context``; where an intervention sets a state at an instant, its edges
    have the condition ``"set"``. ``bundles`` has the parts of each bundle, ``terms`` the
    ``contact_terms`` of the world, where contacts are recorded, ``there`` the edges that act at
    the parameters of the table.
    """
    known = set(names)
    whole = {part: n for n, parts in bundles.items() if n in known for part in parts}
    edges: dict[EdgeKey, str | None] = {}
    first, more = in_force(model, context)
    for edge in (*first.edges, *more):
        cause, effect = whole.get(edge.cause, edge.cause), whole.get(edge.effect, edge.effect)
        acts = {cause, effect} <= known and (edge.lag or cause != effect)
        if acts and edge.key not in there.absent:
            key, when = (cause, effect, edge.lag), there.when(edge)
            edges[key] = when and edges.get(key, when)
    held = [name for name in model if name in known and model.declared(name).role == "parameter"]
    written = [[*edge, None, when] for edge, when in edges.items()]
    hidden = {f"noise of {noise}": states for noise, states in there.driven.items()}
    for noise, states in hidden.items():
        reached = sorted({whole.get(state, state) for state in states} & known)
        written += [[noise, state, 0, None, None] for state in reached]
    named = [(name, whole.get(name, name)) for name in model]
    contact = _renamed(terms, [(old, new) for old, new in named if new in known])
    shown = {old: new for old, new in named if new in known}
    noisy = [*sorted(known), *hidden]
    return _with_unseen({"edges": written, "noisy": noisy, "held": held, **contact}, first, shown)


def _renamed(terms: Mapping[str, Any], names: Iterable[tuple[str, str]]) -> dict[str, Any]:
    """Return the terms of contacts for the names in a table."""
    of: dict[str, set[str]] = {}
    for old, new in names if terms else ():
        of.setdefault(new, set()).update(terms["of"][old])
    bodies = {name: sorted(found) for name, found in of.items() if found}
    return {"contact": {**terms, "of": bodies}} if terms else {}


def truth_of_episodes(
    model: SCM,
    nature: Mapping[str, Any],
    causes: Sequence[str],
    outcomes: Sequence[Outcome],
    labels: Mapping[Outcome, str],
    terms: Mapping[str, Any] = {},
    there: Present = EVERYTHING,
) -> dict[str, Any]:
    """Return the graph of whole episodes, from the beginning of ``causes`` to the outcomes.

    Outcomes have ``labels`` in the table, and are not scored among one another. ``there`` has the
    edges that act at the parameters of the table. A context distribution, ``nature``, that changes
    later than at the beginning raises ``ModelError``.
    """
    names = [outcome.name for outcome in outcomes]
    graph = nature_graph(model, nature, names, without=there.absent)
    apart = nature_graph(model, nature, names, contact=False, without=there.absent | there.touching)
    named = {name: first_name(model, name) for name in causes}
    node = {f"{model.target(n)}@0" if is_state(model, n) else n: f for n, f in named.items()}
    kept = {**node, **{outcome.name: outcome.name for outcome in outcomes}}
    ends: dict[str, list[str]] = {}
    for outcome in outcomes:
        ends.setdefault(outcome.name, []).append(labels[outcome])
    final = {outcome.name: labels[outcome] for outcome in outcomes if outcome.how == "final"}
    source = {**final, **node}
    always = {*projection(apart, kept)[0].edges}
    edges = [
        [source[cause], label, 0, None, None if (cause, effect) in always else "contact"]
        for cause, effect in sorted(projection(graph, kept)[0].edges)
        if cause in source
        for label in ([node[effect]] if effect in node else ends[effect])
    ]
    shown = [label for each in ends.values() for label in each]
    pairs = [[a, b] for i, a in enumerate(shown) for b in shown[i + 1 :]]
    ended = ((outcome.name, labels[outcome]) for outcome in outcomes)
    contact = _renamed(terms, (*named.items(), *ended))
    written = {"edges": edges, "noisy": [*node.values()], "unscored": pairs, **contact}
    acts = {name: act for name, act in Plan(nature).at_start().items() if name in model}
    return _with_unseen(written, model.do(acts), {n.removesuffix("@0"): f for n, f in node.items()})


def observed_part(name: str, written: Mapping[str, Any], names: Sequence[str]) -> GroundTruth:
    """Project a graph on the variables that are in a table (a latent projection).

    A cause acts through hidden variables as if directly: the weight is the sum over the paths
    through them, of the product of the weights on each. A hidden variable with noise confounds all
    pairs that it reaches through hidden ones only; one that keeps its value over an episode does so
    across control steps, a variable with itself among them.

    Source:
        Verma and Pearl, *Equivalence and synthesis of causal models*, UAI 1990. Wright, *The method
        of path coefficients*, Annals of Mathematical Statistics 1934, for the weights.
    """
    known, after = set(names), dict[str, list[tuple[str, int, float, str | None]]]()
    for cause, effect, lag, weight, *when in written["edges"]:
        slope = np.nan if weight is None else float(weight)
        after.setdefault(cause, []).append((effect, lag, slope, when[0] if when else None))
    for held in written.get("held", ()):
        if held not in known:
            after.setdefault(held, []).append((held, 1, 1.0, None))

    def reached(start: str) -> dict[tuple[str, int], tuple[float, str | None]]:
        """Return weight and condition of each effect and its lag, path length by path length."""
        found: dict[tuple[str, int], tuple[float, str | None]] = {}
        ahead: dict[tuple[str, int], tuple[float, str | None]] = {(start, 0): (1.0, None)}
        for _ in range((LONGEST + 1) * len(after) + 1):
            new: dict[tuple[str, int], tuple[float, str | None]] = {}
            for (node, steps), (gain, condition) in ahead.items():
                for effect, lag, slope, when in after.get(node, ()):
                    place, into = (effect, steps + lag), found if effect in known else new
                    if effect in known or place[1] <= LONGEST:
                        sum_, either = into.get(place, (0.0, condition or when))
                        into[place] = sum_ + gain * slope, either and (condition or when)
            ahead = new
        return dict(sorted(found.items()))

    edges = {(c, e, lag): way for c in names for (e, lag), way in reached(c).items()}
    confounded: dict[Pair, None] = {}
    for source in written["noisy"]:
        children = [] if source in known else [*reached(source)]
        for i, (one, early) in enumerate(children):
            for other, late in children[i + 1 :]:
                first, second = sorted([(early, one), (late, other)])
                confounded[first[1], second[1], second[0] - first[0]] = None
    conditions = dict.fromkeys(when for _, when in edges.values() if when)
    unscored = (tuple(pair) for pair in written.get("unscored", ()))
    return GroundTruth(
        name=name,
        names=tuple(names),
        edges=tuple(edges),
        confounded=tuple(confounded),
        weights={edge: weight for edge, (weight, _) in edges.items() if not np.isnan(weight)},
        unscored=tuple((a, b) for a, b in unscored if {a, b} <= known),
        when={k: tuple(e for e, (_, when) in edges.items() if when == k) for k in conditions},
    )


# --- of tables ------------------------------------------------------------------------------------


def truth_of(table: Dataset) -> GroundTruth | None:
    """Return the graph that a table carries, projected on its columns; None without one."""
    written, system = table.about.get("truth"), str(table.about.get("system", "table"))
    if written is None:
        return None
    lags = max((column.lag for column in table.columns), default=0)
    if lags:
        now = tuple(dict.fromkeys(column.variable for column in table.columns))
        written = _unrolled(observed_part(system, written, now), lags)
    return observed_part(system, written, table.variables)


def _unrolled(truth: GroundTruth, lags: int) -> dict[str, Any]:
    """Return a graph through time as one of an instant, over columns of several control steps.

    Everything before the first of them is hidden, and confounds.
    """

    def at(name: str, lag: int) -> str:
        return f"{name}@-{lag}" if lag else name

    conditions = {edge: when for when, edges in truth.when.items() for edge in edges}
    edges: list[list[Any]] = []
    for c, e, lag in truth.edges:
        about = 0, truth.weights.get((c, e, lag)), conditions.get((c, e, lag))
        edges += [[at(c, back + lag), at(e, back), *about] for back in range(lags - lag + 1)]
    nodes = [at(name, back) for back in range(lags, -1, -1) for name in truth.names]
    _, shared = window(*truth._matrices(), lags)
    hidden = []
    for i, j in np.argwhere(np.triu(shared)).tolist():
        hidden.append(f"before {nodes[i]} and {nodes[j]}")
        edges += [[hidden[-1], nodes[end], 0, None, None] for end in (i, j)]
    steps = range(lags + 1)
    pairs = [[at(a, i), at(b, j)] for a, b in truth.unscored for i, j in product(steps, steps)]
    return {"edges": edges, "noisy": [*nodes, *hidden], "unscored": pairs}


Touch = frozenset[tuple[str, str]]
"""Pairs of bodies that touch."""


def touches(table: Dataset) -> list[dict[tuple[int, int], Touch]]:
    """Return which bodies touched in the control steps (episode, step) behind each row.

    Behind a row is the control step that led to it; behind one of ``lagged`` columns that many, and
    behind one that is an episode all.
    """
    record = table.about.get("touching")
    if record is None:
        raise ModelError(["the table has no contacts: collect it with contacts=True"])
    lags, whole = table.about.get("lags", 1), table.about["contacts"] == "episodes"
    known = {
        int(episode): [frozenset((one, other) for one, other in step) for step in steps]
        for episode, steps in record.items()
    }
    found = []
    for episode, step in zip(table.episode.tolist(), table.step.tolist(), strict=True):
        steps = known[episode]
        behind = range(len(steps)) if whole else range(max(step - lags, 0), step)
        found.append({(episode, i): steps[i] for i in behind})
    return found


def contact_edges(table: Dataset, *, between: bool = False) -> list[set[int]]:
    """Return for each row the numbers of the edges by contact that could act behind it.

    With ``between``, those among the states of one body are left out: to touch the floor is enough.
    """
    written, acting = table.about["truth"], dict[Touch, set[int]]()
    edges = [(i, *e[:2]) for i, e in enumerate(written["edges"]) if e[-1] == "contact"]
    if not edges:
        return [set() for _ in range(len(table))]
    behind = [[*steps.values()] for steps in touches(table)]
    if between:
        states = {column.variable for column in table.columns if column.role == "state"}
        of = {name: bodies for name, bodies in written["contact"]["of"].items() if name in states}
        edges = [e for e in edges if e[1] not in of or of[e[1]] != of.get(e[2])]
    if table.about["contacts"] == "episodes":  # one contact may act on through a later one
        behind = [[Touch().union(*steps)] for steps in behind]
    for touch in {touch for steps in behind for touch in steps}:
        acts = holds(written["contact"], touch)
        acting[touch] = {i for i, cause, effect in edges if acts(cause, effect)}
    return [set[int]().union(*(acting[touch] for touch in steps)) for steps in behind]


def acting_edges(table: Dataset) -> list[list[Any]]:
    """Return the edges, as plain data, whose condition held in a row at least."""
    written = table.about.get("truth")
    if written is None:
        raise ModelError(["the table does not know its graph: it was not collected here"])
    edges = written["edges"]
    missing = {i for i, (*_, when) in enumerate(edges) if when == "contact"}
    missing.difference_update(*contact_edges(table))
    first = int(table.step.min(initial=1)) - table.about.get("lags", 0)
    later = any(len(regime.plan.at_start()) < len(regime.plan) for regime in table.regimes)
    if first > 0 and not later:  # nothing is set in these rows
        missing |= {i for i, (*_, when) in enumerate(edges) if when == "set"}
    return [edge for i, edge in enumerate(edges) if i not in missing]
