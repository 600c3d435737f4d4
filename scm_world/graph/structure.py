"""The edges of a causal model, checked once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import Any, final

import networkx as nx

from scm_world.errors import CyclicModel, ModelError, nearest
from scm_world.variables import Derived, Parent, Variable
from scm_world.variables.kinds import Coupled

_SPACES = ("bounds", "space A", "space B")
_NAME, _KEY = attrgetter("name"), attrgetter("name", "lag")  # of parents


@final
@dataclass(frozen=True)
class Edge:
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
    """The edges among some variables, without what they mean.

    Args:
        parents: Of each variable by name, in the order of declaration.

    Raises:
        ModelError: Contemporaneous edges form a cycle.
    """

    def __init__(self, parents: Mapping[str, tuple[Parent, ...]]) -> None:
        self._parents = dict(parents)
        self._names = tuple(parents)
        self._instant = _instant(self._parents)
        self.order = _topological(self._names, self._instant)

    @cached_property
    def edges(self) -> tuple[Edge, ...]:
        """All edges; where many bodies can touch there are very many."""
        return tuple(
            Edge(parent.name, name, parent.lag, parent.when)
            for name, causes in self._parents.items()
            for parent in causes
        )

    @cached_property
    def _adjacency(self) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
        parents = {
            name: list(dict.fromkeys(parent.name for parent in self._parents[name]))
            for name in self._names
        }
        children: dict[str, list[str]] = {name: [] for name in self._names}
        for name, causes in parents.items():
            for cause in causes:
                children[cause].append(name)
        return parents, children

    def parents(self, name: str) -> tuple[str, ...]:
        """Return the direct causes, of any lag."""
        return tuple(self._adjacency[0][name])

    def children(self, name: str) -> tuple[str, ...]:
        """Return the direct effects, of any lag."""
        return tuple(self._adjacency[1][name])

    def ancestors(self, name: str) -> frozenset[str]:
        """Return the direct and indirect causes; a variable that drives itself is one of them."""
        return _reachable(name, self._adjacency[0])

    def descendants(self, name: str) -> frozenset[str]:
        """Return the direct and indirect effects."""
        return _reachable(name, self._adjacency[1])

    @cached_property
    def instant_children(self) -> dict[str, tuple[str, ...]]:
        """The variables that follow each variable within the same instant."""
        children: dict[str, list[str]] = {name: [] for name in self._names}
        for cause, effect, when in self._instant:
            if when != "set":
                children[cause].append(effect)
        return {name: tuple(found) for name, found in children.items()}

    def instant_descendants(self, names: Iterable[str]) -> list[str]:
        """Return what follows some variables within the same instant, causes before effects."""
        found: set[str] = set()
        stack = list(names)
        while stack:
            for child in self.instant_children[stack.pop()]:
                if child not in found:
                    found.add(child)
                    stack.append(child)
        return [name for name in self.order if name in found] if found else []


def _own(causes: tuple[Parent, ...]) -> tuple[Parent, ...]:
    """Return the edges into a variable that may have lag 0: not those that many states share."""
    return causes.own if isinstance(causes, Coupled) else causes


def _instant(parents: Mapping[str, tuple[Parent, ...]]) -> list[tuple[str, str, str | None]]:
    """List cause, effect and condition of the edges of lag 0; many states share their parents."""
    distinct = {id(causes): causes for causes in parents.values()}
    of_lag_0 = {key: [p for p in _own(causes) if not p.lag] for key, causes in distinct.items()}
    return [
        (parent.name, name, parent.when)
        for name, causes in parents.items()
        for parent in of_lag_0[id(causes)]
    ]


def _reachable(name: str, step: Mapping[str, Sequence[str]]) -> frozenset[str]:
    found: set[str] = set()
    stack = list(step[name])
    while stack:
        here = stack.pop()
        if here not in found:
            found.add(here)
            stack.extend(step[here])
    return frozenset(found)


def _topological(
    names: Iterable[str], edges: Sequence[tuple[str, str, str | None]]
) -> tuple[str, ...]:
    """Order variables so that causes come before effects, and else as they are declared.

    Source:
        Kahn, *Topological sorting of large networks*, 1962.
    """
    effects: dict[str, list[str]] = {name: [] for name in names}
    waiting = dict.fromkeys(effects, 0)
    for cause, effect, _ in edges:
        effects[cause].append(effect)
        waiting[effect] += 1
    order = [name for name, causes in waiting.items() if not causes]
    for name in order:  # it grows
        for effect in effects[name]:
            waiting[effect] -= 1
            if not waiting[effect]:
                order.append(effect)
    if len(order) < len(waiting):
        raise CyclicModel(_cycles(nx.DiGraph(edge[:2] for edge in edges)))
    return tuple(order)


def _cycles(graph: nx.DiGraph) -> Iterable[list[str]]:
    """Yield one cycle of every strongly connected component."""
    for knot in nx.strongly_connected_components(graph):
        part = graph.subgraph(knot)
        if part.number_of_edges():
            yield [cause for cause, _ in nx.find_cycle(part)]


def _parent_problems(
    variable: Variable, causes: tuple[Parent, ...], known: Mapping[str, Variable]
) -> Iterable[str]:
    names = set(map(_NAME, causes))
    unique = len(names) == len(causes) or len(set(map(_KEY, causes))) == len(causes)
    if unique and known.keys() >= names:
        return  # nearly always
    for (name, lag), times in Counter(map(_KEY, causes)).items():
        if name not in known:
            hint = nearest(name, known)
            suggestion = f"; did you mean {hint!r}?" if hint else ""
            yield f"{variable.name!r} has the unknown parent {name!r}{suggestion}"
        if times > 1:
            yield f"{variable.name!r} names the parent {name!r} twice with lag {lag}"


def _variable_problems(variable: Variable, known: Mapping[str, Variable]) -> Iterable[str]:
    for label, space in zip(_SPACES, (variable.bounds, variable.a, variable.b), strict=True):
        for name in () if space is None else space.parents():
            if name not in known:
                yield f"{label} of {variable.name!r} depends on the unknown variable {name!r}"
    if isinstance(variable, Derived) and variable.noise is not None and variable.noise.parents():
        yield f"the noise of {variable.name!r} depends on a variable: let the mechanism scale it"
    if isinstance(variable, Derived) and variable.inverse is not None:
        target = known.get(variable.parents[0].name)
        if isinstance(target, Derived) and target.inverse is not None:
            yield f"{variable.name!r} are coordinates of coordinates {target.name!r}"
        elif target is not None and target.shape != variable.shape and not target.settable:
            yield f"{variable.name!r} are coordinates of {target.name!r}, which cannot be set"


def _bundle_problems(variable: Variable, known: Mapping[str, Variable]) -> Iterable[str]:
    mechanism: Any = getattr(variable, "mechanism", None)  # a bundle has one
    for index, name in enumerate(variable.parts):
        part, shape = known.get(name), mechanism.shapes[index]
        if part is not None and part.shape != shape:
            yield f"the bundle {variable.name!r} has {name!r} as {shape}, not {part.shape}"
        if part is not None and (part.parts or getattr(part, "inverse", None)):
            yield f"{name!r} in the bundle {variable.name!r} is no quantity of its own"


def checked(variables: Iterable[Variable]) -> tuple[dict[str, Variable], EdgeIndex]:
    """Index variables by name, or raise one error that lists everything that is wrong.

    Returns:
        The variables by name, and the edges among them.

    Raises:
        ModelError: Duplicate names, unknown parents, contemporaneous cycles.
    """
    by_name: dict[str, Variable] = {}
    problems: list[str] = []
    for variable in variables:
        if variable.name in by_name:
            problems.append(f"{variable.name!r} is declared twice")
        by_name[variable.name] = variable
    parents = {name: variable.all_parents for name, variable in by_name.items()}
    sound: set[int] = set()  # parents that several variables share are checked once
    for variable in by_name.values():
        causes = parents[variable.name]
        shared = causes.shared if isinstance(causes, Coupled) else causes
        if id(shared) not in sound:
            found = tuple(_parent_problems(variable, causes, by_name))
            problems.extend(found)
            sound |= set() if found else {id(shared)}
        elif shared is not causes:
            problems.extend(_parent_problems(variable, _own(causes), by_name))
        problems.extend(_variable_problems(variable, by_name))
        problems.extend(_bundle_problems(variable, by_name))
    if problems:  # cycles among declared parents are reported, too
        for name, causes in parents.items():
            parents[name] = tuple(parent for parent in causes if parent.name in by_name)
    try:
        edges = EdgeIndex(parents)
    except ModelError as error:
        problems.extend(error.problems)
    if problems:
        raise ModelError(problems)
    return by_name, edges
