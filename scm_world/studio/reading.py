"""Worlds, audits and errors as plain data."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from itertools import product
from typing import Any, final

import networkx as nx
import numpy as np

from scm_world._types import Value
from scm_world.backends.step import StepModel
from scm_world.discovery.model_pictures import fold
from scm_world.errors import ScmWorldError
from scm_world.policies.zoo import zoo
from scm_world.queries import Plan, World
from scm_world.queries.local import contact_terms, holds
from scm_world.studio.spec import Spec
from scm_world.variables.spaces import Box, Categories, Either, Integers
from scm_world.world import Audit

MOST_ARROWS = 200
"""Arrows between groups that can still be followed."""


def plain(value: object) -> Any:
    """Return numbers as JSON can hold them; None stands for numbers that are not finite."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def in_words(act: object) -> str:
    """Return an intervention in a few words."""
    return str(Plan({"x": act}))[len("do(x = ") : -1]


def audited(audit: Audit | None) -> dict[str, Any]:
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


def nearest(error: ScmWorldError) -> list[dict[str, Any]]:
    """List the nearest possible values that an error names."""
    parts = (part for part in getattr(error, "problems", ()) if isinstance(part, ScmWorldError))
    found = [one for part in parts for one in nearest(part)]
    value = getattr(error, "nearest", None)
    if value is not None and not callable(value):
        found.append({"name": error.variable, "value": plain(np.asarray(value))})
    return found


def marks(
    space: object, shape: tuple[int, ...], values: Mapping[str, Value]
) -> list[dict[str, Any]] | None:
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
            both = (marks(part, shape, values) for part in (first, second))
            return [one for part in both for one in part or ()]
    return None


def cut_off(live: World, held: Mapping[str, Any]) -> list[str]:
    """List the variables that hard interventions in force cut from all their causes."""
    roots = {name: act.root for name, act in held.items()}
    hard = [name for name, act in roots.items() if act.replaces and not act.computes]
    targets = dict.fromkeys(one for name in hard for one in (name, *live.model.targets(name)))
    acted = {one for name in live.graph.interventions for one in live.model.targets(name)}
    return [name for name in targets if name not in acted or not live.graph[name].all_parents]


@final
class Bundles:
    """The edges in bundles: effects with the same causes, as the states of a tree have them.

    Attributes:
        bundles: Causes and effects.
        bodies: The number of the bodies of each variable, by name: those that act by contact.
    """

    def __init__(self, live: World) -> None:
        model, effects = live.model, dict[int, list[str]]()
        parents = {name: model[name].all_parents for name in model}
        for name, causes in parents.items():
            effects.setdefault(id(causes), []).append(name)
        self.bundles = [(parents[names[0]], names) for names in effects.values()]
        by_contact = any(p.when == "contact" for causes, _ in self.bundles for p in causes)
        self._terms = contact_terms(live) if by_contact else {"of": {}}
        of = {name: tuple(self._terms["of"].get(name, ())) for name in model}
        self._one_of = {bodies: name for name, bodies in of.items()}
        number = {bodies: n for n, bodies in enumerate(self._one_of)}
        self.bodies = {name: number[bodies] for name, bodies in of.items()}
        self._pairs = sorted(self.between(self.bodies, "contact"))
        self.lit = lru_cache(maxsize=256)(self._lit)

    def between(self, of: Mapping[str, Any], when: str | None = None) -> set[tuple[Any, Any]]:
        """Return which groups are joined, by any edge or by those of a condition."""
        return {
            pair
            for causes, effects in self.bundles
            for pair in product(
                {of[p.name] for p in causes if when in (None, p.when)},
                {of[name] for name in effects},
            )
        }

    def _lit(self, touching: frozenset[tuple[str, str]]) -> list[tuple[int, int]]:
        """Return the ``bodies`` of causes and effects that act while these bodies touch."""
        if not touching or not self._pairs:
            return []
        acts, names = holds(self._terms, touching), [*self._one_of.values()]
        return [(a, b) for a, b in self._pairs if acts(names[a], names[b])]


def groups_of(system: World, edges: Bundles) -> tuple[dict[str, str], dict[str, int]]:
    """Name the group of every variable, and return the rank of each group that has edges.

    A group is the entity of a variable, or the beginning of its name. Where the bodies of a system
    act on one another so much that no arrow could be followed, it is one quantity of a kinematic
    tree. Causes come before their effects; groups that act on one another share a rank; a root
    stands right before its first effect.
    """
    owners: dict[str, str] = {}
    for entity in system.composition.entities if system.backend is not None else ():
        owners |= {one.name: entity.name for one in entity.variables}
    model, roles = system.model, {"readout": "outcomes", "action": "actions"}
    groups = {
        name: owners.get(name)
        or name.rpartition(".")[0]
        or roles.get(model.declared(name).role, "world")
        for name in model
    }
    if len(edges.between(groups)) > MOST_ARROWS:
        members = fold(model, {name: (name,) for name in model})
        groups = {name: label for label, names in members.items() for name in names}
    joined = nx.DiGraph(sorted(edges.between(groups)))
    knots = nx.condensation(joined)
    layers = enumerate(nx.topological_generations(knots))
    rank = {knot: number for number, layer in layers for knot in layer}
    for knot in knots:
        if knots.out_degree(knot) and not knots.in_degree(knot):
            rank[knot] = min(rank[effect] for effect in knots.successors(knot)) - 1
    ranks = {group: rank[knot] for group, knot in knots.graph["mapping"].items()}
    return {name: g if g in joined else "no edges" for name, g in groups.items()}, ranks


def described(spec: Spec, live: World, edges: Bundles) -> dict[str, Any]:
    """Describe a world, or equations: variables, edges, actions, policies."""
    model, (groups, ranks), variables = live.model, groups_of(live, edges), []
    place = {name: number for number, name in enumerate(model)}
    for name in model:
        variable = model.declared(name)
        category = variable.bounds if isinstance(variable.bounds, Categories) else None
        variables.append(
            {
                **{
                    key: getattr(variable, key) for key in ("name", "kind", "role", "unit", "dtype")
                },
                "group": groups[name],
                "bodies": edges.bodies[name],
                "shape": list(variable.shape),
                "doc": " ".join(variable.doc.split()),
                "settable": bool(variable.settable),
                "categories": category
                and [list(category.members), list(category.labels) or list(category.members)],
            }
        )
    policies, shapes = ["random"], False
    if live.backend is not None:
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
        "backend": live.engine,
        "dt": float(live.options.control_period) if live.backend is not None else 1.0,
        "variables": variables,
        "bundles": [
            [[[place[p.name], p.lag, p.when] for p in causes], [place[name] for name in effects]]
            for causes, effects in edges.bundles
            if causes
        ],
        "ranks": ranks,
        "actions": actions,
        "policies": policies,
        "has_shapes": shapes,
    }
