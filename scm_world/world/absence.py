"""Worlds without something: what is left of a declaration."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, final

from scm_world.entities import Composition, Entity
from scm_world.errors import InterventionError, UnknownVariable
from scm_world.tasks import Task
from scm_world.variables import Linear, Measured, Null, Variable

REWARD = "reward"


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


def remaining(entities: tuple[Entity, ...], task: Task) -> tuple[Composition, list[Variable]]:
    """Leave out what is absent, and what is computed from something that is not there.

    An entity of which something cannot be computed any more goes as well, such as the places of
    a pile of which a block is missing. The reward sums up the terms that are left.

    Args:
        entities: All of them.
        task: Knows which are absent.

    Returns:
        The entities that are left, and their variables with those of the task.
    """
    there = tuple(entity for entity in entities if entity.name not in task.absent)
    while True:
        made = Composition(there, tuple(task.shared()), task.decided_by)
        variables: list[Variable] = [*made.variables(), *task.readouts()]
        if not task.absent:
            return made, variables
        variables = _computable(variables)
        names = {variable.name for variable in variables}
        whole = tuple(e for e in there if all(v.name in names for v in e.variables()))
        if len(whole) == len(there):
            return made, variables
        there = whole


def _computable(variables: list[Variable]) -> list[Variable]:
    while True:
        names = {variable.name for variable in variables}
        kept = [_kept(variable, names) for variable in variables]
        left = [variable for variable in kept if variable is not None]
        if len(left) == len(variables):
            return left
        variables = left


def _kept(variable: Variable, names: set[str]) -> Variable | None:
    parents = variable.all_parents
    there = [index for index, parent in enumerate(parents) if parent.name in names]
    if len(there) == len(parents):
        return variable
    mechanism: Any = getattr(variable, "mechanism", None)
    if variable.name == REWARD and isinstance(variable, Measured) and isinstance(mechanism, Linear):
        weights = tuple(mechanism.weights[index] for index in there)
        return variable.model_copy(
            update={
                "parents": tuple(parents[index] for index in there),
                "mechanism": mechanism.model_copy(update={"weights": weights}),
            }
        )
    return None


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
