"""Observations of units: a row or a table, as numbers by variable."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from scm_world._types import Value
from scm_world.errors import ImpossibleObservation, ModelError, UnknownOption, UnknownVariable
from scm_world.graph import SCM
from scm_world.variables import Categories

RECORDED = ("episode", "step", "regime", "intervention_targets")
"""Columns of a frame of a ``Dataset`` besides its variables."""


ONE = -1  # in the place of a number of rows: there is no axis for them


class Observations(NamedTuple):
    """What was observed of some units.

    Attributes:
        values: By variable, shape (rows, steps, *shape); NaN where nothing was observed.
        rows: How many units.
        steps: How many control steps; 1 without lagged edges.
        one: Whether a single unit was given, without an axis for rows.
    """

    values: dict[str, Value]
    rows: int
    steps: int
    one: bool


def observations(model: SCM, observed: Any) -> Observations:
    """Read what was observed.

    Args:
        model: Whose variables were observed.
        observed: Values or labels by name, a data frame, or a ``Dataset``. Names of components,
            such as ``"v[2]"``, are put together. Rows of several control steps are put side by
            side.

    Raises:
        UnknownVariable: The model has no variable of a name.
        ModelError: Shapes do not fit together, a vector was observed in part, or something was
            done in a row.
        ImpossibleObservation: A value is infinite, or neither number nor label.
    """
    temporal, columns = model.is_temporal, _columns(model, observed)
    rows, steps = set[int](), set[int]()
    for name, values in columns.items():
        shape = model.declared(name).shape
        lead = values.shape[: values.ndim - len(shape)]
        if values.shape[len(lead) :] != shape or len(lead) not in (temporal, temporal + 1):
            allowed = "(steps,) or (rows, steps)" if temporal else "() or (rows,)"
            said = f"{name!r} was observed with shape {values.shape}: give {allowed}"
            raise ModelError([said + f" and then {shape}" * bool(shape)])
        steps.add(lead[-1] if temporal else 1)
        rows.add(lead[0] if len(lead) > temporal else ONE)
    if len(rows) > 1 or len(steps) > 1 or not columns or 0 in steps | rows:
        said = "observe at least one variable, and all of the same rows and control steps"
        raise ModelError([said])
    count, length, found = max(1, *rows), steps.pop(), dict[str, Value]()
    for name, values in columns.items():
        found[name] = values.reshape(count, length, *model.declared(name).shape)
        unknown = np.isnan(values).reshape(count, length, -1)
        if np.isinf(values).any():
            said = "an observation is finite, or NaN where there is none"
            raise ImpossibleObservation(name, said)
        if (unknown.any(axis=2) & ~unknown.all(axis=2)).any():
            raise ModelError([f"{name!r} was observed in part: give all of its numbers, or none"])
    return Observations(found, count, length, rows == {ONE})


def _columns(model: SCM, observed: Any) -> dict[str, Value]:
    """Give numbers by variable, shape (..., *shape), with an axis for rows if there are several."""
    if hasattr(observed, "regimes"):  # a Dataset
        found = dict(zip(observed.names, observed.values.T, strict=True))
        found |= {"episode": observed.episode, "step": observed.step}
        found["intervention_targets"] = np.array([bool(names) for names in observed.targets])
    elif isinstance(observed, Mapping) or hasattr(observed, "columns"):
        names = observed if isinstance(observed, Mapping) else observed.columns
        found = {str(name): np.asarray(observed[name]) for name in names}
    else:
        allowed = ("values by name", "a table by name", "a data frame", "a Dataset")
        raise UnknownOption("observed", observed, allowed)
    apart = {name: found.pop(name) for name in RECORDED if name in found and name not in model}
    if any(target is not None and target is not np.False_ for target in apart.get(RECORDED[3], ())):
        advice = "take its rows without (table.observational), or ask model.do({…}) of the others"
        raise ModelError([f"the table has rows in which something was done: {advice}"])
    parts: dict[str, dict[int, Value]] = {}
    columns: dict[str, Value] = {}
    for name, values in found.items():
        whole, _, place = name.removesuffix("]").rpartition("[")
        if name not in model and name.endswith("]") and whole in model and place.isdecimal():
            parts.setdefault(whole, {})[int(place)] = _numbers(model, whole, values)
        elif name not in model:
            raise UnknownVariable(name, model)
        else:
            columns[name] = _numbers(model, name, values)
    for name, each in parts.items():
        shape = model.declared(name).shape
        lost = sorted(set(range(int(np.prod(shape)))) - set(each))
        if lost:
            said = f"{name!r} was observed in part: there is no '{name}[{lost[0]}]'"
            raise ModelError([f"{said}; give all of its numbers, or none"])
        stacked = np.stack([each[place] for place in sorted(each)], axis=-1)
        columns[name] = stacked.reshape(*stacked.shape[:-1], *shape)
    if model.is_temporal and "step" in apart:
        order = np.lexsort((apart["step"], apart["episode"]))
        _, counts = np.unique(apart["episode"], return_counts=True)
        if len(set(counts.tolist())) != 1:
            raise ModelError(["the episodes of the table have different lengths; give one at once"])
        columns = {
            name: values[order].reshape(len(counts), counts[0], *values.shape[1:])
            for name, values in columns.items()
        }
    return columns


def _numbers(model: SCM, name: str, values: Value) -> Value:
    """Read numbers or labels of a variable; None is NaN.

    Raises:
        ImpossibleObservation: Something is neither.
    """
    bounds = model.declared(name).bounds
    known = {}
    if isinstance(bounds, Categories) and bounds.labels:
        known = dict(zip(bounds.labels, bounds.members, strict=True))
    if values.dtype.kind in "OUS":
        values = np.array([known.get(v, v) for v in values.ravel().tolist()]).reshape(values.shape)
    try:
        return values.astype(float)
    except (TypeError, ValueError) as error:
        allowed = f", and labels are {', '.join(known)}" if known else ""
        raise ImpossibleObservation(name, f"observations are numbers{allowed}: {error}") from None
