"""The local causal graph: the edges that are active in one control step.

The graph of a world has every *possible* edge, for all bodies that can touch. In one control step,
only touching bodies act on one another, directly or through others. Bodies that touch, directly or
through movable bodies, are an *island*; static bodies (floor, stage, obstacles) transmit nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, cast
from weakref import WeakKeyDictionary

import networkx as nx

from scm_world._arguments import typed
from scm_world._types import ArrayLike, Floats
from scm_world.backends.base import Backend, ContactPoint
from scm_world.errors import ModelError
from scm_world.world import CausalSystem, Simulation
from scm_world.world.compiled_task import Vectors

__all__ = ["local_graph"]

Touching = Sequence[Sequence[ContactPoint]]
"""The contacts of each physics step of a control step."""

_TERMS: WeakKeyDictionary[Vectors, dict[str, Any]] = WeakKeyDictionary()


@typed
def local_graph(world: CausalSystem, action: ArrayLike | None = None) -> nx.MultiDiGraph:
    """Return the declared graph with the active edges; see ``World.local_graph``."""
    before = world.snapshot()
    steps: Touching = (world.contacts(),)
    if action is not None:
        try:
            steps = contacts_of(world, action)
        finally:
            world.restore(before)
    pressing = {contact.bodies for step in steps for contact in step if contact.force > 0.0}
    if world.backend is not None and world.compiled not in _TERMS:
        _TERMS[world.compiled] = contact_terms(cast(Simulation, world))
    acts = holds(_TERMS.get(world.compiled, {"of": {}, "still": (), "together": ()}), pressing)
    graph = nx.MultiDiGraph()
    graph.add_nodes_from(world.graph)
    for edge in world.graph.edges:
        apart = edge.when == "contact" and not acts(edge.cause, edge.effect)
        if not apart and (edge.when != "set" or world.index == 0):  # set where an episode begins
            graph.add_edge(edge.cause, edge.effect, lag=edge.lag, when=edge.when)
    return graph


def contact_terms(world: Simulation) -> dict[str, Any]:
    """Return the bodies that determine when edges with ``when="contact"`` are active.

    The bodies of a variable are those of the states that it affects in every step, or depends on;
    a parameter of a body or shape also has that body; a variable without known bodies matches any.

    Returns:
        Plain data. ``"together"``: groups of bodies that are coupled in every step. ``"still"``:
        static bodies. ``"of"``: the bodies of each variable, one of each group.
    """
    model, touched = world.model, world.composition.touched()
    states = {v.name for v in model.variables if v.role == "state"}
    coupled, ahead, back = nx.Graph(), nx.DiGraph(), nx.DiGraph()  # until the next states
    parents = {name: model[name].all_parents for name in model}
    effects: dict[int, list[str]] = {}  # of the same causes: in a tree all states have the same
    for name, causes in parents.items():
        effects.setdefault(id(causes), []).append(name)
    coupled.add_nodes_from((name, "state") for name in states)
    coupled.add_edges_from(
        ((body, "body"), (name, "state")) for body, moved in touched.items() for name in moved
    )
    ahead.add_nodes_from(model)
    back.add_nodes_from(model)
    for knot, found in effects.items():  # a node between the causes and their effects
        before = [p.name for p in parents[found[0]] if p.when != "contact"]
        moving, moved = ([n for n in names if n in states] for names in (before, found))
        if moving and moved:
            nx.add_star(coupled, [(name, "state") for name in (*moving, *moved)])
        ahead.add_edges_from((name, knot) for name in before if name not in states)
        ahead.add_edges_from((knot, name) for name in found)
        back.add_edges_from((name, knot) for name in found if name not in states)
        back.add_edges_from((knot, name) for name in before)
    together, groups = list[list[str]](), dict[str, list[str]]()  # by state: the first of them
    for part in nx.connected_components(coupled):
        bodies = sorted(name for name, kind in part if kind == "body")
        together += [bodies] if bodies else []
        groups.update((name, bodies[:1]) for name, kind in part if kind == "state")
    of = {name: {body} for name, body in world.composition.shaped().items()}
    for graph in (ahead, back):
        knots, after = nx.condensation(graph), dict[int, set[str]]()
        for knot in reversed([*nx.topological_sort(knots)]):
            after[knot] = set[str]().union(*(after[other] for other in knots.succ[knot]))
            for name in knots.nodes[knot]["members"]:
                after[knot].update(groups.get(name, ()))
        for name in model:
            of.setdefault(name, set()).update(after[knots.graph["mapping"][name]])
    still = sorted(body for body, moved in touched.items() if not moved)
    known = {name: sorted(of[name]) for name in model}
    return {"of": known, "together": sorted(together), "still": still}


def holds(
    terms: Mapping[str, Any], touching: Iterable[Iterable[str]]
) -> Callable[[str, str], bool]:
    """Return a function of cause and effect: whether their edge by contact is active.

    It is if a chain of contacts (pairs of bodies) between movable bodies joins a body of the cause
    to one of the effect. A body that the ``contact_terms`` do not contain joins all.
    """
    still, together = set(terms["still"]), [set(group) for group in terms["together"]]
    group = {body: bodies for bodies in together for body in bodies}
    everything = set[str]().union(*together)
    islands: list[set[str]] = []
    for pair in touching:
        moving = (group.get(body, everything) for body in pair if body not in still)
        members = set(pair).union(*moving)
        joined = [island for island in islands if island & members - still]
        islands = [island for island in islands if not island & members - still]
        islands.append(members.union(*joined))
    bodies = {name: set(found) for name, found in terms["of"].items()}

    def found(cause: str, effect: str) -> bool:
        ends = bodies.get(cause), bodies.get(effect)
        return any(all(island & end for end in ends if end) for island in islands)

    return found


class _Listener:
    """Wraps a backend and records the contacts of every physics step, not only the last."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend
        self.recorded: list[tuple[ContactPoint, ...]] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def step(self, command: Floats, substeps: int) -> None:
        for _ in range(substeps):
            self._backend.step(command, 1)
            self.recorded.append(self._backend.contacts())


def contacts_of(world: Any, action: ArrayLike) -> Touching:
    """Take a control step and return the contacts of each physics step."""
    if world.backend is None:
        world.step(action)
        return []
    if getattr(world.structure, "staged", False):
        problem = "the contacts in each stage of RK4 are not known, so that any edge may act"
        remedy = "read the model with settings={'integrator': 'implicitfast'} to know them"
        raise ModelError([f"{problem}; {remedy}"])
    backend, listener = world.backend, _Listener(world.backend)
    world.backend = listener  # it forwards all calls
    try:
        world.step(action)
    finally:
        world.backend = backend
    return listener.recorded
