"""Models in and out: JSON, networkx, DOT."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import networkx as nx
from pydantic import TypeAdapter, ValidationError

from scm_world.errors import ModelError
from scm_world.graph.scm import SCM
from scm_world.graph.views import summary
from scm_world.variables import AnyVariable, Function, Intervention

FORMAT = "scm_world/model/1"
PACKAGE = "scm_world"

_VARIABLES: TypeAdapter[Any] = TypeAdapter(list[AnyVariable])
_INTERVENTIONS: TypeAdapter[Any] = TypeAdapter(dict[str, Intervention])


def _check_portable(model: SCM) -> None:
    problems = [
        f"{variable.name!r} has the function {mechanism.reference!r}, which cannot be found "
        "under this name; define it at the top level of a module"
        for variable in model.variables
        for mechanism in (
            getattr(variable, field, None) for field in ("mechanism", "inverse", "start", "carry")
        )
        if isinstance(mechanism, Function) and not mechanism.is_portable()
    ]
    if problems:
        raise ModelError(problems)


def to_dict(model: SCM) -> dict[str, Any]:
    """Write a model as plain data.

    Raises:
        ModelError: A mechanism is a lambda or another function without a name of its own.
    """
    _check_portable(model)
    return {
        "format": FORMAT,
        "variables": _VARIABLES.dump_python(list(model.variables), mode="json"),
        "interventions": _INTERVENTIONS.dump_python(dict(model.interventions), mode="json"),
    }


def from_dict(data: dict[str, Any], *, trusted: Sequence[str] = ()) -> SCM:
    """Read a model that ``to_dict`` wrote.

    Args:
        data: Plain data.
        trusted: Packages, besides this one, whose functions may serve as mechanisms.

    Raises:
        ModelError: The data is no model, or names a function outside the trusted packages.
    """
    if data.get("format") != FORMAT:
        raise ModelError([f"not a model: expected format {FORMAT!r}, got {data.get('format')!r}"])
    context = {"trusted": (PACKAGE, *trusted)}
    try:
        variables = _VARIABLES.validate_json(json.dumps(data["variables"]), context=context)
        held = _INTERVENTIONS.validate_json(json.dumps(data.get("interventions", {})))
    except ValidationError as error:
        raise ModelError(
            [f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors()]
        ) from None
    return SCM(variables).with_interventions(held)


def to_json(model: SCM) -> str:
    """Write a model as JSON text, without loss."""
    return json.dumps(to_dict(model), indent=1)


def from_json(text: str, *, trusted: Sequence[str] = ()) -> SCM:
    """Read a model that ``to_json`` wrote. See ``from_dict`` for ``trusted`` and errors."""
    return from_dict(json.loads(text), trusted=trusted)


def to_networkx(model: SCM) -> nx.DiGraph:
    """Write a model as a summary graph whose nodes carry their declarations, without loss."""
    graph = summary(model)
    plain = to_dict(model)
    for data in plain["variables"]:
        graph.nodes[data["name"]]["declaration"] = data
    graph.graph.update(format=FORMAT, interventions=plain["interventions"])
    return graph


def from_networkx(graph: nx.DiGraph, *, trusted: Sequence[str] = ()) -> SCM:
    """Read a model from a graph that ``to_networkx`` wrote."""
    variables = [data["declaration"] for _, data in graph.nodes(data=True)]
    plain = {**graph.graph, "variables": variables}
    return from_dict(plain, trusted=trusted)


_SHAPES = {
    "exogenous": "ellipse",
    "derived": "box",
    "measured": "octagon",
    "action": "diamond",
    "fixed": "plaintext",
}


def to_dot(model: SCM) -> str:
    """Write the summary graph in the DOT language; lagged edges are dashed."""
    lines = ["digraph scm {", "  rankdir=LR;"]
    for name in model:
        variable: Any = model[name]
        label = f"{name}\\n[{variable.unit}]"
        lines.append(f'  "{name}" [shape={_SHAPES[variable.kind]}, label="{label}"];')
    for edge in model.edges:
        style = "dashed" if edge.lag else "solid"
        when = f', label="{edge.when}"' if edge.when else ""
        lines.append(f'  "{edge.cause}" -> "{edge.effect}" [style={style}{when}];')
    return "\n".join([*lines, "}"])
