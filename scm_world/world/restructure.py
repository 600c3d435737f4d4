"""What becomes of a world when entities come or go."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from scm_world._types import Value
from scm_world.errors import InterventionError
from scm_world.graph import SCM, Moment, flatten
from scm_world.models import State
from scm_world.variables import Exogenous, Intervention, Measured
from scm_world.world.absence import put_together, taken_away
from scm_world.world.declaration import Declaration
from scm_world.world.family import Family

if TYPE_CHECKING:
    from scm_world.world.proposal import Instant


def restructured(
    family: Family, instant: Instant, request: Mapping[str, Any], moment: Moment
) -> Instant:
    """Give the instant as it is in the structure that a request asks for.

    What exists before and after keeps its values, its state and the interventions on it; what is
    new begins as at the start of an episode. Where the structure stays, so does the instant.
    """
    present = instant.declaration
    flat = flatten(request)
    asked = [(name, act) for name, act in instant.requests.values()]
    gone = taken_away(flat, asked, present.composition.entities)
    declaration: Declaration | None = None
    if len(family.head):
        acts = dict(instant.requests.values())
        acts |= _structural(family, instant, request)
        declaration = family.after(acts, instant.model, instant.static, moment)
    absent = present.task.absent | gone
    if absent:
        plan = (declaration or present).task.plan
        declaration = family.declaration(put_together(plan, absent))
    if declaration is None or declaration is present:
        return instant
    model = _held(instant.model, declaration)
    static = _static(instant, declaration, model, moment)
    state = _state(instant, declaration)
    fresh = frozenset(declaration.slices.keys() - instant.declaration.slices.keys())
    return replace(
        instant,
        declaration=declaration,
        model=model,
        static=static,
        state=state,
        fresh=fresh,
    )


def _structural(
    family: Family, instant: Instant, request: Mapping[str, Any]
) -> dict[str, Intervention]:
    """Pick what concerns the structure out of a request; what is wrong is reported later."""
    found: dict[str, Intervention] = {}
    for name, value in flatten(request).items():
        if name in family.head:
            try:
                found[name] = instant.declaration.model.accept(name, value)
            except InterventionError:
                continue
    return found


def _held(before: SCM, declaration: Declaration) -> SCM:
    model = declaration.model
    kept = {name: act for name, act in before.interventions.items() if name in model}
    return model.with_interventions(kept)


def _static(
    instant: Instant, declaration: Declaration, model: SCM, moment: Moment
) -> dict[str, Value]:
    """Solve the new model from the roots that both have; those that are held follow from that."""
    held = {target for name in model.interventions for target in model.targets(name)}
    known = {
        v.name: instant.static[v.name]
        for v in model.variables
        if isinstance(v, Exogenous) and v.name in instant.static and v.name not in held
    }
    solved = model.solve(known, moment=moment, only=declaration.static_names)
    return {name: solved[name] for name in declaration.static_names}


def _state(instant: Instant, declaration: Declaration) -> State:
    """Keep the states that both have; the others get what they are without causes."""
    before, state = instant.declaration.slices, declaration.empty_state()
    for name, where in declaration.slices.items():
        variable = declaration.model.declared(name)
        if name in before:
            state.vector[where] = instant.state.vector[before[name]]
        elif isinstance(variable, Measured) and variable.default is not None:
            state.vector[where] = np.ravel(variable.array(variable.default))
    return state
