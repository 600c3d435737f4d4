"""Worlds, audits and errors as plain data."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, final

import networkx as nx
import numpy as np

from scm_world import _types
from scm_world.backends.step import StepModel
from scm_world.discovery.model_pictures import fold
from scm_world.policies.zoo import zoo
from scm_world.queries import Plan
from scm_world.queries.local import contact_terms, holds
from scm_world.studio.spec import Spec
from scm_world.variables.spaces import Box, Categories, Either, Integers
from scm_world.world import Simulation

MOST_ARROWS = 200
"""Arrows between groups that can still be followed."""


def plain(value: Any) -> Any:
    """Return numbers as JSON can hold them; None stands for numbers that are not finite."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def in_words(act: Any) -> str:
    """Return an intervention in a few words."""
    return str(Plan({"x": act}))[len("do(x = ") : -1]


def audited(audit: Any) -> dict[str, Any]:
    """Write an audit as plain data."""
    if audit is None:
        return {"targets": [], "followed": [], "came": [], "went": []}
    changes = [*audit.followed.items(), *audit.engine.items()]
    return {
        "targets": [
            {
                "name": name,
                "requested": in_words(one.requested),
                "applied": plain(one.applied),
                "read_back": plain(one.read_back),
            }
            for name, one in audit.targets.items()
        ],
        "followed": [[name, plain(old), plain(new)] for name, (old, new) in changes],
        "came": list(audit.came),
        "went": list(audit.went),
    }


def nearest(error: Any) -> list[dict[str, Any]]:
    """List the nearest possible values that an error names."""
    found = [one for part in getattr(error, "problems", ()) if not isinstance(part, str)
             for one in nearest(part)]  # fmt: skip
    value = getattr(error, "nearest", None)
    if value is not None and not callable(value):
        found.append({"name": error.variable, "value": plain(np.asarray(value))})
    return found


def marks(space: Any, shape: tuple[int, ...], values: Any) -> list[dict[str, Any]] | None:
    """Return the parts of a space as plain data, for marks on a scale; None where it has none."""
    match space:
        case Box():
            low, high = space.bounds(shape, values)
            return [{"low": plain(np.ravel(low)), "high": plain(np.ravel(high))}]
        case Integers(low=low, high=high):
            return [{"low": [low], "high": [high], "whole": True}]
        case Categories(members=members, labels=labels):
            return [{"members": list(members), "labels": list(labels)}]
        case Either(first=first, second=second):
            parts = (marks(part, shape, values) for part in (first, second))
            return [one for part in parts for one in part or ()]
    return None


@final
class EdgeColumns:
    """The edges of a model as columns, in the order of ``model.edges``, and what groups they join.

    Attributes:
        cause, effect: Numbers of variables, shape (n,).
        lag: Control steps, shape (n,).
        when: Indices into ``conditions``, shape (n,); 0 where there is none.
        contact: Whether an edge acts by contact, shape (n,).
    """

    def __init__(self, model: Any) -> None:
        place = {name: number for number, name in enumerate(model)}
        parents = [model[name].all_parents for name in model]
        conditions: dict[str | None, int] = {None: 0}
        known: dict[int, Any] = {}  # the states of a tree have the same causes
        for causes in parents:
            if id(causes) not in known:
                rows = [
                    (place[p.name], p.lag, conditions.setdefault(p.when, len(conditions)))
                    for p in causes
                ]
                known[id(causes)] = np.array(rows, dtype=np.uint32).reshape(-1, 3)
        columns = [np.zeros((0, 3), dtype=np.uint32), *(known[id(causes)] for causes in parents)]
        self.cause, self.lag, self.when = np.concatenate(columns).T
        self.effect = np.repeat(np.arange(len(parents)), [len(rows) for rows in columns[1:]])
        self.conditions = [*conditions]
        self.contact = self.when == conditions.get("contact", -1)

    def between(self, groups: Sequence[str]) -> list[tuple[str, str]]:
        """Return which groups are joined, given the group of each variable."""
        number, names = _numbered(groups), [*dict.fromkeys(groups)]
        codes = np.unique(number[self.cause] * len(names) + number[self.effect]).tolist()
        return [(names[code // len(names)], names[code % len(names)]) for code in codes]


def _numbered(things: Iterable[Any]) -> _types.Integers:
    """Number things in the order in which they come; equal ones have the same number."""
    known: dict[Any, int] = {}
    return np.array([known.setdefault(thing, len(known)) for thing in things], dtype=np.int64)


def groups_of(system: Any, edges: EdgeColumns) -> tuple[list[str], dict[str, int]]:
    """Name the group of every variable, and return the rank of each group that has edges.

    A group is what declared a variable, or the beginning of its name. Where the bodies of a system
    act on one another so much that no arrow could be followed, it is one quantity of a kinematic
    tree. Causes come before their effects; groups that act on one another share a rank; a root
    stands right before its first effect.
    """
    owners: dict[str, str] = {}
    for entity in system.composition.entities if isinstance(system, Simulation) else ():
        owners |= {one.name: entity.name for one in entity.variables}
    model, roles = system.model, {"readout": "outcomes", "action": "actions"}
    groups = [
        owners.get(name) or name.rpartition(".")[0] or roles.get(model.declared(name).role, "world")
        for name in model
    ]
    if len(edges.between(groups)) > MOST_ARROWS:
        members = fold(model, {name: (name,) for name in model})
        label = {name: label for label, names in members.items() for name in names}
        groups = [label[name] for name in model]
    joined = nx.DiGraph(edges.between(groups))
    knots = nx.condensation(joined)
    layers = enumerate(nx.topological_generations(knots))
    rank = {knot: number for number, layer in layers for knot in layer}
    for knot in knots:
        if knots.out_degree(knot) and not knots.in_degree(knot):
            rank[knot] = min(rank[effect] for effect in knots.successors(knot)) - 1
    ranks = {group: rank[knot] for group, knot in knots.graph["mapping"].items()}
    return [group if group in joined else "no edges" for group in groups], ranks


def described(spec: Spec, live: Any, contact: ContactEdges) -> dict[str, Any]:
    """Describe a world, or equations: variables, edges, actions, policies."""
    model, edges = live.model, contact.edges
    (groups, ranks), variables = groups_of(live, edges), []
    for name, group in zip(model, groups, strict=True):
        variable = model.declared(name)
        category = variable.bounds if isinstance(variable.bounds, Categories) else None
        variables.append(
            {
                "name": name,
                "group": group,
                "kind": variable.kind,
                "role": variable.role,
                "unit": variable.unit,
                "shape": list(variable.shape),
                "dtype": variable.dtype,
                "doc": " ".join(variable.doc.split()),
                "settable": bool(variable.settable),
                "state": variable.role == "state",
                "categories": category
                and [list(category.members), list(category.labels) or list(category.members)],
            }
        )
    policies, shapes = ["random"], False
    if isinstance(live, Simulation):
        policies += live.task.policies
        policies += [name for name, card in zoo().items() if card.task == live.task.name]
        shapes = not isinstance(live.structure, StepModel)
    low, high = plain(live.action_low), plain(live.action_high)
    actions = [
        {"name": f"{name}[{i}]" if part.stop - part.start > 1 else name, "low": low[k],
         "high": high[k], "unit": model.declared(name).unit}
        for name, part in live.compiled.actions.items()
        for i, k in enumerate(range(part.start, part.stop))
    ]  # fmt: skip
    return {
        "title": spec.title,
        "backend": live.engine if isinstance(live, Simulation) else "equations",
        "dt": period(live),
        "variables": variables,
        "edges": {
            "cause": edges.cause.astype("<u4"),
            "effect": edges.effect.astype("<u4"),
            "lag": edges.lag.astype("u1"),
            "when": edges.when.astype("u1"),
            "conditions": edges.conditions,
        },
        "bodies": contact.bodies.tolist(),
        "ranks": ranks,
        "actions": actions,
        "policies": policies,
        "has_shapes": shapes,
    }


def period(live: Any) -> float:
    """Return the length of a control step [s]; equations count steps of one second."""
    return float(live.options.control_period) if isinstance(live, Simulation) else 1.0


@final
class ContactEdges:
    """Which edges by contact are active: those between the bodies of their ends.

    Attributes:
        edges: All edges.
        bodies: A number for the bodies of each variable.
    """

    def __init__(self, live: Any) -> None:
        self.edges = edges = EdgeColumns(live.model)
        names, some = list(live.model), edges.contact
        self._terms: Any = contact_terms(live) if some.any() else {"of": {}}
        self.bodies = number = _numbered(tuple(self._terms["of"].get(name, ())) for name in names)
        self._size = int(number.max(initial=0)) + 1
        codes = number[edges.cause] * self._size + number[edges.effect]
        codes, first = np.unique(np.where(some, codes, -1), return_index=True)
        ends = zip(edges.cause[first].tolist(), edges.effect[first].tolist(), strict=True)
        pairs = zip(codes.tolist(), ends, strict=True)
        self._ends = {code: (names[c], names[e]) for code, (c, e) in pairs if code >= 0}

    def lit(self, pairs: frozenset[tuple[str, str]]) -> list[list[int]]:
        """Return the ``bodies`` of causes and effects that act while these bodies touch."""
        if not pairs or not self._ends:
            return []
        acts = holds(self._terms, pairs)
        return [[*divmod(c, self._size)] for c, ends in self._ends.items() if acts(*ends)]
