"""Models in and out as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from pydantic import TypeAdapter, ValidationError

from scm_world._arguments import typed
from scm_world._fingerprint import differing, fingerprint
from scm_world.errors import InterventionError, ModelError
from scm_world.graph.scm import SCM
from scm_world.variables import Function, Intervention, Variable
from scm_world.variables.mechanisms import check_portable, check_trusted
from scm_world.variables.spaces import problems_of

FORMAT = "scm_world/model/2"

_VARIABLES: TypeAdapter[Any] = TypeAdapter(list[Variable])
_INTERVENTIONS: TypeAdapter[Any] = TypeAdapter(dict[str, Intervention])


def _plain(adapter: TypeAdapter[Any], data: object) -> Any:
    """Return plain data, with infinities as text: JSON has no number for them."""
    return json.loads(json.dumps(adapter.dump_python(data, mode="json")), parse_constant=str)


def _functions(
    variables: Iterable[Variable], *held: Mapping[str, Intervention]
) -> Iterator[Function]:
    for declared in (*(act.root for layer in held for act in layer.values()), *variables):
        yield from declared.functions()


def _hashes(model: SCM) -> dict[str, str]:
    """Return a hash of each function, by name; the file has everything else."""
    plain = ("declaration of ", "intervention on ")
    found = fingerprint(model, libraries=False)
    return {name: part for name, part in found.items() if not name.startswith(plain)}


@typed
def to_json(model: SCM) -> str:
    """Write a model as JSON text, without loss.

    Raises:
        ModelError: A mechanism is a lambda or another function without a name.
    """
    context = dict(model.context)
    check_portable(_functions(model.variables, model.interventions, context))
    data = {
        "format": FORMAT,
        "functions": _hashes(model),
        "variables": _plain(_VARIABLES, list(model.variables)),
        "interventions": _plain(_INTERVENTIONS, dict(model.done().values())),
    }
    if context:
        data["context"] = _plain(_INTERVENTIONS, context)
    return json.dumps(data, indent=1, allow_nan=False)


@typed
def from_json(text: str, *, trusted: Sequence[str] = ()) -> SCM:
    """Read a model that ``to_json`` wrote.

    Args:
        text: The text.
        trusted: Packages whose functions may serve as mechanisms, in addition to those of this
            package that compute numbers.

    Raises:
        ModelError: The text is not a model, names a function outside the trusted packages, or one
            that was changed since.
    """
    try:
        data = json.loads(text)
    except Exception as error:
        raise ModelError([f"not a model: {error}"]) from None
    found = data.get("format") if isinstance(data, dict) else data
    if found != FORMAT:
        raise ModelError([f"not a model: expected format {FORMAT!r}, got {found!r}"])
    try:
        variables = _VARIABLES.validate_json(json.dumps(data["variables"]))
        held, context = (
            _INTERVENTIONS.validate_json(json.dumps(data.get(layer, {})))
            for layer in ("interventions", "context")
        )
    except ValidationError as error:
        raise ModelError(problems_of(error)) from None
    except Exception as error:  # a field too many, or too few
        raise ModelError([f"not a model: {error}"]) from None
    # Before anything of theirs is imported:
    check_trusted(_functions(variables, held, context), trusted)
    try:
        below = SCM(variables).do(context, any_variable=True)._as_context()
        model = below.do(held, any_variable=True)
    except InterventionError as error:
        raise ModelError([f"an intervention of the file does not fit: {error}"]) from None
    other = differing(data.get("functions", {}), _hashes(model))
    if other:
        problem = f"functions of the file are not the same here: {', '.join(other)} differ"
        advice = "bring back these functions, or write the model again with to_json"
        raise ModelError([f"{problem}; {advice}"])
    return model
