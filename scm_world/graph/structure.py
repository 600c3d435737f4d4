"""The edges of a causal model, checked once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from functools import cached_property
from operator import attrgetter
from typing import Any, NamedTuple, final

import networkx as nx

from scm_world.errors import CyclicModel, ModelError, UnknownOption, nearest
from scm_world.variables import Parent, Variable

_KEY = attrgetter("name", "lag")  # of a parent


class Edge(NamedTuple):
    """A causal edge.

    Attributes:
        cause: Name of the parent.
        effect: Name of the child.
        lag: 0 or 1 control steps.
        when: The condition under which it holds, or None.
    """

    cause: str
    effect: str
    lag: int = 0
    when: str | None = None

    @property
    def key(self) -> tuple[str, str, int]:
        """Cause, effect and lag."""
        return (self.cause, self.effect, self.lag)


@final
class EdgeIndex:
    """The edges among some variables, as graphs of networkx.

    Args:
        parents: The edges into each variable by name, in the order of declaration.

    Attributes:
        order: The variables, causes before their contemporaneous effects.
        late: The edges of lags above 1.
    """

    def __init__(self, parents: Mapping[str, tuple[Parent, ...]]) -> None:
        self._parents = parents
        shared = {id(causes): causes for causes in parents.values()}  # by many states of a tree
        rest = {key: [p for p in causes if p.lag != 1] for key, causes in shared.items()}
        unlike = [(p, name) for name, causes in parents.items() for p in rest[id(causes)]]
        self.late = tuple(Edge(p.name, n, p.lag, p.when) for p, n in unlike if p.lag)
        edges = [(p.name, n, {"when": p.when}) for p, n in unlike if not p.lag]
        ends = {end for edge in edges for end in edge[:2]}
        self._instant = nx.DiGraph()  # of those with such edges, in the order of declaration
        self._instant.add_nodes_from(name for name in parents if name in ends)
        self._instant.add_edges_from(edges)
        followers = {edge[1] for edge in edges}
        try:
            later = [name for name in nx.topological_sort(self._instant) if name in followers]
            self.order = *(name for name in parents if name not in followers), *later
        except nx.NetworkXUnfeasible:
            knots = map(self._instant.subgraph, nx.strongly_connected_components(self._instant))
            cyclic = (knot for knot in knots if knot.number_of_edges())
            raise CyclicModel([c for c, _ in nx.find_cycle(knot)] for knot in cyclic) from None

    @cached_property
    def edges(self) -> tuple[Edge, ...]:
        """All edges; where many bodies can touch there are very many."""
        return tuple(
            Edge(parent.name, name, parent.lag, parent.when)
            for name, causes in self._parents.items()
            for parent in causes
        )

    @cached_property
    def graph(self) -> nx.DiGraph:
        """The edges of all lags."""
        graph = nx.DiGraph()
        graph.add_nodes_from(self._parents)
        graph.add_edges_from((p.name, name) for name, found in self._parents.items() for p in found)
        return graph

    @cached_property
    def _acting(self) -> nx.DiGraph:
        """The contemporaneous edges that do not need something to be set."""
        edges = self._instant.edges(data="when")
        return nx.DiGraph([edge[:2] for edge in edges if edge[2] != "set"])

    def instant_descendants(self, names: Iterable[str]) -> list[str]:
        """Return what follows some variables within the same instant, causes before effects."""
        some = [name for name in names if name in self._acting]
        found = set().union(*(nx.descendants(self._acting, name) for name in some))
        return [name for name in self.order if name in found] if found else []


def _parent_problems(causes: tuple[Parent, ...], known: Mapping[str, Variable]) -> list[str]:
    found = []
    for (name, lag), times in Counter(map(_KEY, causes)).items():
        if name not in known:
            hint = nearest(name, known)
            suggestion = f"; did you mean {hint!r}?" if hint else ""
            found.append(f"has the unknown parent {name!r}{suggestion}")
        if times > 1:
            found.append(f"names the parent {name!r} twice with lag {lag}")
    return found


def _variable_problems(variable: Variable, known: Mapping[str, Variable]) -> Iterable[str]:
    of: Any = variable  # fields of some kinds only
    for label, space in (("bounds", of.bounds), ("space A", of.a), ("space B", of.b)):
        for name in () if space is None else space.parents():
            if name not in known:
                yield f"{label} of {of.name!r} depends on the unknown variable {name!r}"
    noise = None if of.equation is None else of.own_noise
    if noise is not None and noise.parents():
        yield f"the noise of {of.name!r} depends on a variable: let the mechanism scale it"
    if variable.coordinates_of is not None:
        target = known.get(variable.coordinates_of)
        if target is not None and target.coordinates_of is not None:
            yield f"{of.name!r} are coordinates of coordinates {target.name!r}"
        elif target is not None and target.shape != variable.shape and not target.settable:
            yield f"{of.name!r} are coordinates of {target.name!r}, which cannot be set"
    for name, shape in zip(of.parts, of.equation.shapes if of.parts else (), strict=True):
        part = known.get(name)
        if part is not None and part.shape != shape:
            yield f"the bundle {of.name!r} has {name!r} as {shape}, not {part.shape}"
        if part is not None and (part.parts or part.coordinates_of):
            yield f"{name!r} in the bundle {of.name!r} is not a quantity of its own"


def checked(variables: Iterable[Variable]) -> tuple[dict[str, Variable], EdgeIndex]:
    """Return variables by name and their edges, or raise one error that lists all faults."""
    by_name: dict[str, Variable] = {}
    problems: list[str] = []
    for variable in variables:
        if not isinstance(variable, Variable):
            *kinds, last = (kind.__name__ for kind in Variable.kinds.values())
            kinds = [f"a declaration: {', '.join(kinds)} or {last}"]
            raise UnknownOption("variable of a model", variable, kinds)
        if variable.name in by_name:
            problems.append(f"{variable.name!r} is declared twice")
        by_name[variable.name] = variable
    parents = {name: variable.all_parents for name, variable in by_name.items()}
    shared = {id(causes): causes for causes in parents.values()}
    faults = {key: _parent_problems(causes, by_name) for key, causes in shared.items()}
    for variable in by_name.values():
        wrong = faults[id(parents[variable.name])]
        problems += [f"{variable.name!r} {fault}" for fault in wrong]
        problems += _variable_problems(variable, by_name)
    if problems:  # cycles among declared parents are reported, too
        for name, causes in parents.items():
            parents[name] = tuple(parent for parent in causes if parent.name in by_name)
    try:
        edges = EdgeIndex(parents)
    except CyclicModel as error:
        problems += error.problems
    if problems:
        raise ModelError(problems)
    return by_name, edges
