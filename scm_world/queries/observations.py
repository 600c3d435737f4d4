"""Observations of units: a row or a table, as numbers by variable."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from scm_world._arguments import real_numbers
from scm_world._types import Integers as Numbers
from scm_world._types import Value
from scm_world.errors import ImpossibleObservation, ModelError, UnknownOption, UnknownVariable
from scm_world.graph import SCM
from scm_world.variables import Categories

NUMBERS = ("episode", "step", "regime")
TARGETS = "intervention_targets"
RECORDED = (*NUMBERS, TARGETS)
"""Columns of frames and files of a ``Dataset`` in addition to its variables."""


class Observations(NamedTuple):
    """Observations of some units."""

    values: dict[str, Value]  # of every variable, shape (rows, steps, *shape); NaN if unobserved
    rows: int  # number of units
    steps: int  # number of control steps; 1 without lagged edges
    one: bool  # whether a single unit was given, without an axis for rows

    def some(self, rows: Numbers) -> Observations:
        """Return the observations of some of the units."""
        values = {name: values[rows] for name, values in self.values.items()}
        return self._replace(values=values, rows=len(rows))


def observations(model: SCM, observed: object) -> Observations:
    """Read observations: values or labels by name, a data frame, or a ``Dataset``.

    Components, such as ``"v[2]"``, are joined to their variable, and rows of one episode to its
    control steps. Variables that are drawn once per episode need one observation.
    """
    temporal, columns = model.is_temporal, _columns(model, observed)
    leads = set[tuple[int, ...]]()
    for name, values in columns.items():
        shape = model.declared(name).shape
        lead = values.shape[: values.ndim - len(shape)]
        if values.shape[len(lead) :] != shape or len(lead) not in (temporal, temporal + 1):
            allowed = "(steps,) or (rows, steps)" if temporal else "() or (rows,)"
            text = f"{name!r} was observed with shape {values.shape}: give {allowed}"
            raise ModelError([text + f" and then {shape}" * bool(shape)])
        leads.add(lead)
        unknown = np.isnan(values.reshape(*lead, int(np.prod(shape))))
        if np.isinf(values).any():
            text = "an observation is finite, or NaN where there is none"
            raise ImpossibleObservation(name, text)
        if (unknown.any(axis=-1) & ~unknown.all(axis=-1)).any():
            raise ModelError([f"{name!r} was observed in part: give all of its numbers, or none"])
    if len(leads) != 1 or 0 in next(iter(leads)):
        text = "observe at least one variable, and all of the same rows and control steps"
        raise ModelError([text])
    lead = leads.pop()
    rows, steps = lead[0] if len(lead) > temporal else 1, lead[-1] if temporal else 1
    found: dict[str, Value] = {}
    for variable in (model[name] for name in model):
        values = columns.get(variable.name, np.array(np.nan))
        whole = (rows, steps, *variable.shape)
        values = values.reshape(whole) if values.ndim else np.full(whole, values)
        if variable.per_episode:
            first = np.isfinite(values).argmax(axis=1)[:, None]
            values = np.where(np.isnan(values), np.take_along_axis(values, first, axis=1), values)
        found[variable.name] = values
    return Observations(found, rows, steps, len(lead) == temporal)


def _columns(model: SCM, observed: Any) -> dict[str, Value]:
    """Return numbers by variable, shape (..., *shape), with leading axes for rows and steps."""
    if hasattr(observed, "regimes"):  # a Dataset
        given: dict[str, Any] = dict(zip(observed.names, observed.values.T, strict=True))
        given |= {"episode": observed.episode, "step": observed.step}
        given[TARGETS] = observed.targets
    elif isinstance(observed, Mapping) or hasattr(observed, "columns"):
        names = [*(observed if isinstance(observed, Mapping) else observed.columns)]
        given = {str(name): observed[name] for name in names}
        if len(given) < len(names):
            raise ModelError([f"two of the columns {', '.join(map(str, names))} have one name"])
    else:
        allowed = ("values by name", "a table by name", "a data frame", "a Dataset")
        raise UnknownOption("observed", observed, allowed)
    about = {name: given.pop(name) for name in RECORDED if name in given and name not in model}
    if any(map(names_in, about.get(TARGETS, ()))):
        advice = "take its rows without (table.observational), or ask model.do({…}) of the others"
        raise ModelError([f"the table has rows in which something was done: {advice}"])
    columns: dict[str, Value] = {}
    for name, values in given.items():
        whole, _, place = name.removesuffix("]").rpartition("[")
        shape = model.declared(whole).shape if whole in model and name.endswith("]") else ()
        if name in model:
            columns[name] = _numbers(model, name, values)
        elif shape and place in map(str, range(int(np.prod(shape)))):
            numbers = _numbers(model, whole, values)
            empty = np.full((*numbers.shape, *shape), np.nan)
            columns.setdefault(whole, empty).reshape(*numbers.shape, -1)[..., int(place)] = numbers
        else:
            raise UnknownVariable(name, model)
    if model.is_temporal and "step" in about:
        step = whole_numbers("step", about["step"])
        episode = whole_numbers("episode", about.get("episode", np.zeros_like(step)))
        order = np.lexsort((step, episode))
        _, counts = np.unique(episode, return_counts=True)
        if len(set(counts.tolist())) != 1:
            raise ModelError(["the episodes of the table have different lengths; give one at once"])
        both = (len(counts), counts[0])
        columns = {name: v[order].reshape(*both, *v.shape[1:]) for name, v in columns.items()}
    return columns


def _numbers(model: SCM, name: str, observed: object) -> Value:
    """Convert numbers or labels of a variable to numbers; None and pandas.NA become NaN."""
    bounds, known = model.declared(name).bounds, dict[Any, int]()
    if isinstance(bounds, Categories) and bounds.labels:
        known = dict(zip(bounds.labels, bounds.members, strict=True))
    try:
        values = np.asarray(observed)
        if known and values.dtype.kind in "OUS":
            coded = [known.get(cell, cell) for cell in values.ravel().tolist()]
            values = np.array(coded, dtype=object).reshape(values.shape)
        return real_numbers(values)
    except (TypeError, ValueError) as error:
        allowed = f", and labels are {', '.join(known)}" if known else ""
        raise ImpossibleObservation(name, f"observations are numbers{allowed}: {error}") from None


def whole_numbers(name: str, values: object) -> Numbers:
    """Return the whole numbers of a column, shape (n,), or raise a ``ModelError``."""
    found = np.asarray(values)
    whole = found.dtype.kind in "iu"
    if found.dtype.kind == "f":
        whole = bool(np.isfinite(found).all() and np.array_equal(found, np.rint(found)))
    if not whole and found.size:
        raise ModelError([f"{name!r} holds numbers of dtype {found.dtype}: give whole numbers"])
    return found.astype(np.int64)


def names_in(cell: Any) -> tuple[str, ...]:
    """Read targets: names with semicolons, a sequence (also as CSV writes it), or nothing."""
    import pandas

    if isinstance(cell, str):
        with suppress(ValueError, SyntaxError):
            if isinstance(written := ast.literal_eval(cell), tuple | list):
                return tuple(map(str, written))
        return tuple(name.strip() for name in cell.split(";") if name.strip())
    if isinstance(cell, Iterable):
        return tuple(map(str, cell))
    if pandas.isna(cell):
        return ()
    raise ModelError([f"{TARGETS} has {cell!r}: it can be None, names with ';', or a tuple"])
