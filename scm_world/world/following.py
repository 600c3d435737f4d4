"""Variables that were given another mechanism, and what follows them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from scm_world._types import Value, Values
from scm_world.errors import InterventionError
from scm_world.graph import SCM
from scm_world.variables import Intervention, Mechanism, Variable, whole_of
from scm_world.variables.checks import coerce

if TYPE_CHECKING:
    from scm_world.world.declaration import Declaration


def refuse_continuous(
    acts: Mapping[str, tuple[str, Intervention]],
    static: Mapping[str, Value],
    actions: Iterable[str],
) -> None:
    """Refuse parameters that should follow what moves: they change at interventions only.

    Raises:
        InterventionError: With the parents that move, or, of an action, those of earlier.
    """
    for target, (name, act) in acts.items():
        if not isinstance(act, Mechanism):
            continue
        moving = [p.name for p in act.parents if p.lag or p.name not in static]
        who, what = "a parameter", "parameters of the same instant"
        if target in actions:
            moving, who, what = [p.name for p in act.parents if p.lag], "an action", "the present"
        if moving:
            asked = whole_of(act, name)
            raise InterventionError(
                f"do({asked}): {who} can follow {what} only, not {', '.join(moving)}; let a plan "
                "set it step by step instead",
                variable=asked,
                value=act,
            )


def policy_inputs(model: SCM, held: Iterable[str]) -> tuple[str, ...]:
    """Name what the mechanisms of held actions look at."""
    acts = (model.interventions[name] for name in held)
    return tuple(p.name for act in acts if isinstance(act, Mechanism) for p in act.parents)


def what_follows(
    world: Declaration, model: SCM, static: Mapping[str, Value], targets: tuple[str, ...]
) -> tuple[str, ...]:
    """Name what has to be computed anew, causes first; mechanisms may have added edges."""
    held = model.interventions.items()
    if not any(isinstance(act, Mechanism) and name not in world.actions for name, act in held):
        return world.static_order(targets)
    structure = model.structure
    follow = {*targets, *structure.instant_descendants(targets)}
    return tuple(n for n in structure.order if n in follow and n in static)


def followed(requested: Variable, act: Mechanism, values: Values) -> Value:
    """Compute the value that a state is set to.

    Raises:
        InterventionError: It should follow what is neither a parameter nor a state, or the
            function gives something of another shape or type.
    """
    unknown = [p.name for p in act.parents if p.lag or p.name not in values]
    if unknown:
        raise InterventionError(
            f"do({requested.name}): a state can be set to a function of parameters and states, "
            f"not of {', '.join(unknown)}",
            variable=requested.name,
            value=act,
        )
    found: Any = act.function.bind()(*(np.array(values[p.name]) for p in act.parents))
    return coerce(requested, found)
