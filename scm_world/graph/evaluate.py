"""Evaluation of one variable of a causal model, under an intervention or none."""

from __future__ import annotations

from typing import Any, NamedTuple, final

import numpy as np

from scm_world._types import Value
from scm_world.variables import Distribution, Intervention, Moment, Soft, Variable


@final
class AppliedIntervention(NamedTuple):
    """An intervention on a variable.

    Attributes:
        intervention: The intervention.
        requested: The variable it was requested of: the variable itself, other coordinates of it,
            or a bundle that it is a part of.
        below: The intervention that a soft one acts on; None for the variable's own mechanism.
    """

    intervention: Intervention
    requested: Variable
    below: AppliedIntervention | None = None

    @property
    def root(self) -> AppliedIntervention:
        """The lowest one: it decides the mechanism."""
        return self if self.below is None else self.below.root

    @property
    def relative(self) -> Distribution | None:
        """The distribution of a shift or factor that is drawn; None if there is none."""
        own = self.intervention.relative
        return own if own is not None or self.below is None else self.below.relative


def given(requested: Any, name: str, value: Value) -> Value:
    """Return the value of a variable for one of a bundle, or of other coordinates."""
    if requested.name == name:
        return np.asarray(value)
    if requested.parts:
        return np.asarray(requested.split(value)[requested.parts.index(name)])
    return np.asarray(requested.inverse.bind()(value))


def evaluate(name: str, act: AppliedIntervention | None, at: Moment) -> Value:
    """Compute a variable from the values so far, under an intervention or none."""
    if act is None:
        return at.declared[name].value_of(at)
    requested, soft = act.requested, act.intervention
    if requested.name == name or not isinstance(soft, Soft):
        return given(requested, name, intended(name, act, at))
    below, before, after = _moved(soft, name, act, at)
    found = given(requested, name, after)
    stays = np.all(before == after, axis=tuple(range(-len(requested.shape), 0)))
    # The inverse of coordinates is rounded: what stays in them stays itself.
    return np.where(stays[(..., *(None,) * len(at.declared[name].shape))], below, found)


def intended(name: str, act: AppliedIntervention, at: Moment) -> Value:
    """Compute what an intervention makes of the variable that it was requested of."""
    done = act.intervention
    if isinstance(done, Soft):
        return _moved(done, name, act, at)[2]
    return done.value_of(act.requested, at)


def _moved(
    done: Soft, name: str, act: AppliedIntervention, at: Moment
) -> tuple[Value, Value, Value]:
    """Return what a soft intervention acts on, that in the requested coordinates, and moved."""
    below, requested = evaluate(name, act.below, at), act.requested
    there = below
    if requested.name != name:
        coordinates: Any = requested
        there = np.asarray(coordinates.equation.bind()(below))
    moved = done.moved(there, requested, at)
    return below, there, moved if requested.dtype == "real" else np.rint(moved).astype(np.int64)
