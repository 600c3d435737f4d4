"""Arguments of an environment, read and checked, and how its episodes begin."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from scm_world._arguments import one_of, scalar
from scm_world._patterns import fits
from scm_world.errors import InterventionError, UnknownOption, UnknownVariable
from scm_world.graph import SCM, NoiseKey, flatten
from scm_world.graph.scm import request_of
from scm_world.queries.plans import Plan
from scm_world.variables import Draw
from scm_world.variables.kinds import SPACES
from scm_world.world import Simulation
from scm_world.world.compiled_task import CompiledTask

RESETS = ("do", "episode", "space", "draws")
"""Options of a reset."""


def reset_options(options: object, known: Iterable[str]) -> dict[str, Any]:
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
        several = value if isinstance(value, list | tuple) else (value,)
        if any(getattr(act, "removes", False) for act in several):
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

    def read(name: str, value: object) -> object:
        if not isinstance(value, list | tuple) or len(value) != 2:
            return value
        if not all(isinstance(scalar(end), int | float) for end in value):
            return value
        shapes = {model.declared(one).shape for one in model if fits(one, (name,))}
        return Draw(*value) if shapes == {()} else value

    return {name: read(name, value) for name, value in flatten(request_of(given)).items()}


def beginning_structure(
    world: Simulation, acts: Mapping[str, Any], key: NoiseKey | None = None
) -> CompiledTask:
    """Return the structure in which an episode begins after an intervention at its reset.

    ``key`` is the noise of the episode; that of the present one if None.
    """
    structures, head = world.structures, world.structures.head
    natural = structures.natural(None)
    if not len(head):
        return natural
    due = Plan(acts).named(natural.model).composed(natural.model)
    deciding = {name: act for name, act in due.items() if name in head}
    found = structures.after(deciding, head, head.solve(), key or world.noise_key(0))
    return natural if found is None else structures.compiled(found)


def check_names(acts: Mapping[str, Any], model: SCM, head: SCM) -> None:
    """Refuse names that no variable can have.

    Where variables decide which bodies exist, further bodies may have the variables of present
    ones.
    """
    ends = {name.rpartition(".")[2] for name in model if "." in name} if len(head) else set()
    for name in Plan(acts).named(model):
        if name not in model and name not in head:
            body, _, end = name.rpartition(".")
            if not body or end not in ends:
                raise UnknownVariable(name, model)
