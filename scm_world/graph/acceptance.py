"""Whether an intervention fits the variable that it is meant for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from scm_world.errors import InterventionError, UnknownVariable
from scm_world.graph.evaluate import AppliedIntervention, source_of
from scm_world.variables import (
    SOFT,
    Derived,
    Draw,
    Function,
    Hard,
    Intervention,
    Mechanism,
    Null,
    Variable,
)
from scm_world.variables.checks import check_bounds, check_draw, coerce
from scm_world.variables.interventions import ACTS


def refuse_time(name: str, act: Any) -> None:
    """Refuse an intervention with a time, or several, where there is no episode for it.

    Raises:
        InterventionError: It is one.
    """
    is_plan = isinstance(act, tuple) and any(hasattr(one, "time") for one in act)
    if is_plan or getattr(act, "time", None) is not None:
        said = "interventions one after another count" if is_plan else f"a time ({act.time}) counts"
        raise InterventionError(
            f"do({name}): {said} in the plan of an episode: give it to rollout, sample, effect or "
            "counterfactual, to given or reset(do=…) of a World, or to a curriculum",
            variable=name,
            value=act,
        )


def accepted(declared: Mapping[str, Variable], variable: Variable, value: Any) -> Intervention:
    """Return a checked intervention: type, shape, finite, fixed bounds, known parents.

    Raises:
        InterventionError: It is refused, with the reason.
    """
    name, said = variable.name, ""
    kind = type(value)  # the classes of interventions are final
    if kind is tuple or kind in ACTS:
        refuse_time(name, value)
    if kind is Hard or kind not in ACTS:
        number = coerce(variable, _plain(variable, value) if kind is Hard else value)
        bounds = variable.bounds
        if bounds is not None and not bounds.parents() and not bounds.contains(number, {}):
            check_bounds(variable, number, {})
        return Hard.of(number)
    if kind is Draw:
        check_draw(variable, value)
        _known(declared, source_of(AppliedIntervention(value, variable)).parents())
    elif kind is Mechanism:
        value = _complete(variable, value)
        _known(declared, (parent.name for parent in value.parents))
        own = (name, *variable.parts)
        if any(parent.name in own and not parent.lag for parent in value.parents):
            said = "a variable cannot follow itself within an instant; use Shift or Scale"
    elif kind is Null:
        said = "a variable cannot be taken away; a body of a world can be"
    elif kind in SOFT and variable.dtype == "categorical":
        said = f"categories have no order, so there is no {value!r}; set a category, Draw one, or "
        said += "give a Mechanism"
    elif kind in SOFT:
        coerce(variable, value.by if np.ndim(value.by) else np.full(variable.shape, value.by))
    if said:
        raise InterventionError(f"do({name}): {said}", variable=name, value=value)
    return value  # type: ignore[no-any-return]


def _complete(variable: Variable, value: Mechanism) -> Mechanism:
    """Fill in what a mechanism leaves out: function and noise of the variable."""
    own = variable if isinstance(variable, Derived) else None
    if value.function is None and (own is None or own.noise is None):
        said = "it has no noise that could be another one"
    elif value.function is None and own is not None:
        fields = ("parents", "inverse_noise")
        kept = {"function": own.mechanism, **{name: getattr(own, name) for name in fields}}
        return value.model_copy(update=kept)
    elif value.noise is not None and not value.equation.takes_noise:
        said = "its function does not take noise; give it an argument `noise`"
    elif (
        not (isinstance(value.function, Function) and value.equation.takes_noise)
        or value.noise is not None
        or (own is not None and own.noise is not None)
    ):
        return value
    else:
        said = "its function takes noise, of which there is none; give Mechanism(…, noise=…)"
    raise InterventionError(f"do({variable.name}): {said}", variable=variable.name, value=value)


def _known(declared: Mapping[str, Variable], names: Iterable[str]) -> None:
    for name in sorted(names):
        if name not in declared:
            raise UnknownVariable(name, declared)


def _plain(variable: Variable, value: Hard) -> Any:
    matrix = len(variable.shape) > 1 and np.size(value.value) == np.prod(variable.shape)
    return np.reshape(value.value, variable.shape) if matrix else value.value


def settable_causes(declared: Mapping[str, Variable], name: str) -> list[str]:
    """Return the nearest causes that can be set, past others that cannot."""
    found: dict[str, None] = {}
    stack, seen = [name], {name}
    while stack:
        for parent in declared[stack.pop(0)].all_parents:
            if parent.name in seen:
                continue
            seen.add(parent.name)
            if declared[parent.name].settable:
                found[parent.name] = None
            else:
                stack.append(parent.name)
    return list(found)
