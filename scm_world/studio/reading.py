"""What a session is made of, and worlds, audits and errors as plain data."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, final

import networkx as nx
import numpy as np
from pydantic import BaseModel, ConfigDict

from scm_world.backends.step import StepModel
from scm_world.discovery.model_pictures import fold
from scm_world.discovery.problems import system_of
from scm_world.errors import UnknownOption
from scm_world.policies.zoo import zoo
from scm_world.queries import SCM, Plan, World
from scm_world.queries.local import contact_terms, holds
from scm_world.variables.spaces import Box, Categories, Either, Integers
from scm_world.world import Simulation

MOST_ARROWS = 200
"""Arrows between groups that can still be followed."""


class Spec(BaseModel):
    """What a world is made of: as in ``system_of``, with arguments of the task and of ``World``."""

    model_config = ConfigDict(extra="forbid")
    system: str
    options: dict[str, Any] = {}
    settings: dict[str, Any] = {}

    def make(self) -> Any:
        """Return the world, or the causal model without a backend that was named."""
        made = system_of(self.system, **self._given)
        if not isinstance(made, SCM):
            return World(made, **self.settings)
        if self.settings:
            allowed = ("left out: a causal model without a backend has none",)
            raise UnknownOption("setting of a world", next(iter(self.settings)), allowed)
        return made

    @property
    def _given(self) -> dict[str, Any]:
        """The arguments, with tuples again where JSON has lists."""
        listed = self.options.items()
        return {key: tuple(value) if isinstance(value, list) else value for key, value in listed}

    @property
    def title(self) -> str:
        """The system in few words: of a file, its name."""
        home, _, function = self.system.rpartition(":")
        return f"{Path(home).stem}:{function}" if home else Path(function).name

    def code(self, made_of: Any) -> list[str]:
        """Return the lines of Python that make it."""
        if isinstance(made_of, SCM):
            given = ", ".join(f"{name}={value!r}" for name, value in self._given.items())
            module, made = "tasks.factories", f"load_factory({self.system!r})({given})"
            if self.system.endswith(".json"):
                module, made = "discovery.problems", f"model_of_file({self.system!r})"
            imported = f"from scm_world.{module} import {made.partition('(')[0]}"
            return ["import scm_world as sw", imported, "", f"world = sw.SCM({made})"]
        settings = "".join(f", {name}={value!r}" for name, value in self.settings.items())
        made = repr(self.system)
        if self.options:
            given = ", ".join(f"{name}={value!r}" for name, value in self._given.items())
            made = f"sw.make_task({made}, {given})"
        first = ["import scm_world as sw", "from scm_world.evaluation import in_world", ""]
        return [*first, f"world = sw.World({made}{settings})"]


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


def group_of(system: Any) -> dict[str, str]:
    """Name the group of every variable: what declared it, or the beginning of its name.

    Where the bodies of a system act on one another so much that no arrow could be followed, a group
    is one quantity of a kinematic tree.
    """
    owners: dict[str, str] = {}
    for entity in system.composition.entities if isinstance(system, Simulation) else ():
        owners |= {one.name: entity.name for one in entity.variables}
    model, roles = system.model, {"readout": "outcomes", "action": "actions"}
    found = {
        name: owners.get(name)
        or name.rpartition(".")[0]
        or roles.get(model.declared(name).role, "world")
        for name in model
    }
    if len({(found[e.cause], found[e.effect]) for e in model.edges}) > MOST_ARROWS:
        members = fold(model, {name: (name,) for name in model})
        found = {name: label for label, names in members.items() for name in names}
    joined = {found[name] for e in model.edges for name in (e.cause, e.effect)}
    return {name: group if group in joined else "no edges" for name, group in found.items()}


def ranks_of(model: Any, groups: Mapping[str, str]) -> dict[str, int]:
    """Return the rank of each group that has edges: causes come before their effects.

    Groups that act on one another share a rank; a root stands right before its first effect.
    """
    joined = nx.DiGraph({(groups[e.cause], groups[e.effect]) for e in model.edges})
    knots = nx.condensation(joined)
    layers = enumerate(nx.topological_generations(knots))
    rank = {knot: number for number, layer in layers for knot in layer}
    for knot in knots:
        if knots.out_degree(knot) and not knots.in_degree(knot):
            rank[knot] = min(rank[effect] for effect in knots.successors(knot)) - 1
    return {group: rank[knot] for group, knot in knots.graph["mapping"].items()}


def described(spec: Spec, live: Any, contact: ContactEdges) -> dict[str, Any]:
    """Describe a world, or equations: variables, edges, actions, policies."""
    model, groups = live.model, group_of(live)
    names = list(model)
    place = {name: index for index, name in enumerate(names)}
    variables = []
    for name in names:
        variable = model.declared(name)
        category = variable.bounds if isinstance(variable.bounds, Categories) else None
        variables.append(
            {
                "name": name,
                "group": groups[name],
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
        "edges": [[place[e.cause], place[e.effect], e.lag, e.when] for e in model.edges],
        "contact": contact.groups,
        "ranks": ranks_of(model, groups),
        "actions": actions,
        "policies": policies,
        "has_shapes": shapes,
    }


def period(live: Any) -> float:
    """Return the length of a control step [s]; equations count steps of one second."""
    return float(live.options.control_period) if isinstance(live, Simulation) else 1.0


@final
class ContactEdges:
    """The numbers of the edges by contact, in groups by the bodies that have to touch."""

    def __init__(self, live: Any) -> None:
        self._terms: Any = contact_terms(live) if isinstance(live, Simulation) else {}
        groups: dict[Any, list[int]] = {}
        self._ends: dict[Any, tuple[str, str]] = {}
        for number, edge in enumerate(live.model.edges):
            if edge.when == "contact":
                ends = edge.cause, edge.effect
                bodies = tuple(tuple(self._terms["of"][name]) for name in ends)
                groups.setdefault(bodies, []).append(number)
                self._ends[bodies] = ends
        self.groups = [*groups.values()]

    def lit(self, pairs: frozenset[tuple[str, str]]) -> list[int]:
        """Return the groups that are active while these bodies touch."""
        if not pairs or not self._ends:
            return []
        acts = holds(self._terms, pairs)
        return [number for number, ends in enumerate(self._ends.values()) if acts(*ends)]
