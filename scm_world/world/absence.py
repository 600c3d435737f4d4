"""Worlds without something: what is left of a declaration."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, final

from scm_world.errors import InterventionError, UnknownVariable
from scm_world.tasks.composition import Entity
from scm_world.variables import Null


@final
@dataclass(frozen=True)
class Without:
    """A structure from which entities were taken.

    Attributes:
        plan: Of the task.
        absent: Names of the entities.
    """

    plan: Hashable
    absent: frozenset[str]


def taken_apart(plan: Hashable) -> tuple[Hashable, frozenset[str]]:
    """Tell the plan of the task from what was taken out of it."""
    return (plan.plan, plan.absent) if isinstance(plan, Without) else (plan, frozenset())


def put_together(plan: Hashable, absent: frozenset[str]) -> Hashable:
    """Give one name to a plan and what was taken out of it."""
    return Without(plan, absent) if absent else plan


def taken_away(
    request: Mapping[str, Any], requests: Iterable[Any], entities: Iterable[Entity]
) -> frozenset[str]:
    """Name what a request, and those of the same instant, take away.

    Args:
        request: What is asked for now, flat.
        requests: What was asked for at this instant so far.
        entities: That there are.

    Raises:
        InterventionError: It is no block, obstacle or goal.
        UnknownVariable: There is nothing of this name.
    """
    asked = {name for name, act in request.items() if isinstance(act, Null)}
    before = {name for name, act in requests if isinstance(act, Null)}
    there = {entity.name: entity for entity in entities}
    for name in sorted(asked - before):
        entity = there.get(name)
        if entity is None:
            raise UnknownVariable(name, there)
        if not (entity.is_block or entity.is_obstacle or is_goal(entity)):
            raise InterventionError(
                f"do({name}): it cannot be taken away; blocks, obstacles and goals can: "
                + ", ".join(
                    n for n, e in there.items() if e.is_block or e.is_obstacle or is_goal(e)
                ),
                variable=name,
                value=Null(),
            )
    return frozenset(asked | before)


def is_goal(entity: Entity) -> bool:
    """Tell whether an entity is a place where something should be."""
    return type(entity).goal is not Entity.goal
