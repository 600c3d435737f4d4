"""How episodes begin: the interventions of the environment, of the goal and of the user."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from scm_world.errors import Infeasible, InterventionError
from scm_world.graph import flatten
from scm_world.variables import Draw, Null
from scm_world.variables.kinds import SPACES
from scm_world.world import World
from scm_world.world.compiled_task import CompiledTask


def asked(given: Mapping[str, Any] | None) -> dict[str, Any]:
    """Read an intervention; the name of a space stands for a draw from it.

    Example:
        >>> asked({"tool_block": {"mass": "A", "friction": 0.7}})
        {'tool_block.mass': Draw(kind='draw', source='A'), 'tool_block.friction': 0.7}
    """
    flat = flatten(given or {})
    for name, value in flat.items():
        if isinstance(value, Null):
            raise InterventionError(
                f"do({name}): an environment observes all that its task has; take something away "
                "in a World instead",
                variable=name,
                value=value,
            )
    return {
        name: Draw(value) if isinstance(value, str) and value in SPACES else value
        for name, value in flat.items()
    }


def begin(
    world: World,
    seed: int | None,
    acts: Mapping[str, Any],
    attempts: int,
    episode: int | None = None,
) -> None:
    """Reset a world, with an intervention that may draw something impossible.

    Args:
        world: To reset.
        seed: Of the noise.
        acts: What is done at the reset.
        attempts: How often bodies may be drawn into one place until that is an error. Every
            attempt is the beginning of the next episode, so it draws anew.
        episode: Number of the first one within the noise.

    Raises:
        InterventionError: The intervention was refused, at the last attempt.
    """
    if episode is not None and seed is None:
        seed = world.noise.seed
    for left in reversed(range(attempts)):
        try:
            world.reset(seed=seed, episode=episode or 0, do=acts)
        except Infeasible:
            if not left:
                raise
            seed = episode = None
        else:
            return


def beginning_structure(world: World, acts: Mapping[str, Any]) -> CompiledTask:
    """Give the structure in which an episode begins after an intervention at its reset."""
    family = world.structures
    mine: dict[str, Any] = {}
    for name, value in acts.items():
        if name in family.head:
            try:
                mine[name] = family.head.accept(name, value)
            except InterventionError:  # the reset will say so
                continue
    found = family.after(mine, family.head, family.head.solve(), world.noise_key(0))
    return family.natural(None) if found is None else family.compiled(found)
