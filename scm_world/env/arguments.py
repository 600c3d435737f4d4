"""Arguments of an environment, read and checked, and how its episodes begin."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from scm_world._arguments import one_of, scalar
from scm_world._patterns import fits
from scm_world._types import Values
from scm_world.errors import InterventionError, UnknownOption, UnknownVariable
from scm_world.graph import SCM, NoiseKey, flatten
from scm_world.graph.scm import request_of
from scm_world.queries.plans import Plan
from scm_world.variables import Draw, Null
from scm_world.variables.kinds import SPACES
from scm_world.world import Simulation
from scm_world.world.compiled_task import CompiledTask
from scm_world.world.structures import StructureCache

RESETS = ("do", "episode", "space")
"""Options of a reset."""


def reset_options(options: Any, known: Iterable[str]) -> dict[str, Any]:
    """Read the options of a reset, by name."""
    given = {} if options is None else options
    if not isinstance(given, Mapping):
        raise UnknownOption("options of a reset", options, ("a dictionary", *known))
    for name in given:
        one_of("reset option", name, [*known])
    return dict(given)


def asked(given: Mapping[str, Any]) -> dict[str, Any]:
    """Read an intervention; a space, a distribution, or the name of one stands for a draw from it.

    Example:
        >>> asked({"tool_block": {"mass": "A", "friction": 0.7}})
        {'tool_block.mass': Draw(kind='draw', source='A'), 'tool_block.friction': 0.7}
    """
    flat = flatten(given)
    for name, value in flat.items():
        several = value if isinstance(value, list | tuple) else ()
        if isinstance(value, Null) or any(isinstance(act, Null) for act in several):
            raise InterventionError(
                f"do({name}): an environment observes all that its task has; take something away "
                "in a World instead",
                variable=name,
                value=value,
            )
    return {
        name: Draw(value)
        if hasattr(value, "n_uniforms") or (isinstance(value, str) and value in SPACES)
        else value
        for name, value in flat.items()
    }


def ranges(given: Mapping[str, Any] | None, model: SCM) -> dict[str, Any]:
    """Return an intervention in which two numbers for one stand for a draw between them."""

    def read(name: str, value: Any) -> Any:
        two = isinstance(value, list | tuple) and len(value) == 2
        if not (two and all(isinstance(scalar(end), int | float) for end in value)):
            return value
        shapes = {model.declared(one).shape for one in model if fits(one, (name,))}
        return Draw(*value) if shapes == {()} else value

    return {name: read(name, value) for name, value in flatten(request_of(given)).items()}


def beginning_structure(world: Simulation, acts: Mapping[str, Any]) -> CompiledTask:
    """Return the structure in which an episode begins after an intervention at its reset."""
    family, key = world.structures, world.noise_key(0)
    if not len(family.head):
        return family.natural(None)
    found = structure_after(family, acts, family.head, family.head.solve(), key)
    return found or family.natural(None)


def check_names(acts: Mapping[str, Any], model: SCM, head: SCM) -> None:
    """Refuse names that no variable can have.

    Where variables decide which bodies exist, further bodies may have what the present ones have.
    """
    ends = {name.rpartition(".")[2] for name in model if "." in name} if len(head) else set()
    for name in Plan(acts).named(model):
        if name not in model and name not in head:
            body, _, end = name.rpartition(".")
            if not body or end not in ends:
                raise UnknownVariable(name, model)


def structure_after(
    structures: StructureCache, acts: Mapping[str, Any], held: SCM, static: Values, key: NoiseKey
) -> CompiledTask | None:
    """Return the structure after an intervention; None where it decides nothing of that."""
    model = structures.natural(None).model
    due = Plan(acts).named(model).composed(model)
    deciding = {name: act for name, act in due.items() if name in structures.head}
    found = structures.after(deciding, held, static, key)
    return None if found is None else structures.compiled(found)
