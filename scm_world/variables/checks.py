"""Checks of values, spaces and interventions for a variable; they raise errors of interventions."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from math import isfinite

import numpy as np

from scm_world._types import Value, Values
from scm_world.errors import InterventionError, OutOfBounds, UnknownVariable, WrongValue
from scm_world.variables.distributions import Distribution, Noise
from scm_world.variables.kinds import SPACES, SpaceName, Variable
from scm_world.variables.spaces import Categories, Space
from scm_world.variables.subsets import Subset

_REFUSED = np.asarray("")
_LARGEST = 2.0**53  # up to here every whole number is a float, so JSON keeps it


def coerce(variable: Variable, value: object) -> Value:
    """Return a user's value as an array of the declared shape; float64 if real, else int64.

    Another kind or shape, and numbers that are not finite, raise ``WrongValue``.
    """
    if isinstance(variable.bounds, Categories) and variable.bounds.labels:
        with suppress(KeyError, ValueError, TypeError):  # refused below
            value = variable.bounds.numbers(value)
    try:
        given = np.asarray(value)
    except (ValueError, TypeError):  # a ragged list, or an object that refuses
        given = _REFUSED
    # A masked array hides numbers under its mask.
    if given.dtype.kind not in "iuf" or isinstance(value, np.ma.MaskedArray):
        raise WrongValue(variable.name, value, _expected(variable))
    if given.shape != variable.shape:
        raise WrongValue(variable.name, value, variable.shape, given.shape)
    if not all(map(isfinite, given.ravel().tolist())):
        raise WrongValue(variable.name, value)
    if variable.dtype == "real":
        return given.astype(np.float64)
    whole = given.dtype.kind != "f" or (given == np.rint(given)).all()
    if not whole or (np.abs(given.astype(np.float64)) >= _LARGEST).any():
        raise WrongValue(variable.name, value, _expected(variable))
    return given.astype(np.int64)


def _expected(variable: Variable) -> str:
    noun = "numbers" if variable.dtype == "real" else "whole numbers"
    if isinstance(variable.bounds, Categories) and variable.bounds.labels:
        noun = " or ".join(map(repr, variable.bounds.labels))
    where = f" of shape {variable.shape}" if variable.shape else ""
    drawn = [f'Draw("{name}")' for name in SPACES if variable.space(name) is not None]
    return f"{noun}{where}" + (f", or {', '.join(drawn)}" if drawn else "")


def _out_of_bounds(
    variable: Variable, value: Value, allowed: str, nearest: Value | None, space: str = ""
) -> OutOfBounds:
    plain = None if nearest is None else np.asarray(nearest).tolist()
    given, unit = np.asarray(value).tolist(), variable.unit
    return OutOfBounds(variable.name, given, allowed=allowed, nearest=plain, unit=unit, space=space)


def check_bounds(variable: Variable, value: Value, values: Values) -> None:
    """Refuse a value that is physically impossible, or not finite after a shift or scale."""
    if not np.isfinite(value).all():
        raise WrongValue(variable.name, np.asarray(value).tolist())
    bounds = variable.bounds
    if bounds is not None and not bounds.contains(value, values):
        allowed = bounds.describe()
        raise _out_of_bounds(variable, value, allowed, bounds.nearest(value, values))


def check_rows(variable: Variable, values: Value) -> None:
    """Refuse whole numbers, shape ``(..., *shape)``, beyond bounds that follow no other variable.

    Real numbers may leave them in equations, where bounds say what a value may be set to.
    """
    bounds = variable.bounds
    if variable.dtype == "real" or bounds is None or bounds.parents():
        return
    if not variable.shape and bounds.contains(values):
        return
    for value in np.reshape(values, (-1, *variable.shape)):
        check_bounds(variable, value, {})


def check_draw(
    variable: Variable,
    source: SpaceName | Distribution,
    act: object = None,
    shape: tuple[int, ...] | None = None,
) -> None:
    """Refuse to draw from a space that is not declared, or from a distribution of another shape.

    Args:
        variable: The variable.
        source: The name of a space, or a distribution.
        act: The intervention that draws, for the error; the source if None.
        shape: The shape that is wanted; that of the variable if None.
    """
    said, shape = "", variable.shape if shape is None else shape
    if isinstance(source, str):
        if variable.space(source) is None:
            said = f"{variable.name!r} has no space {source} to draw from; draw from a "
            said += "distribution, such as Draw(Box(low, high))"
    elif not source.parents():  # else known only when it is drawn
        fits = None
        with suppress(ValueError):
            fits = Noise(0).draw(source, variable.name, shape, {})[0].shape
        if fits != shape:
            said = f"do({variable.name}): {source!r} does not fit its shape {shape}; give "
            said += "one number for all, or one for each component"
    if said:
        raise InterventionError(said, variable=variable.name, value=source if act is None else act)


def check_region(variable: Variable, region: SpaceName | Space) -> None:
    """Refuse a region that a variable does not have, or that reaches beyond its bounds."""
    check_draw(variable, region)
    if isinstance(region, str) or region.parents() or variable.bounds is None:
        return
    if variable.bounds.parents():
        return  # known only when it is set
    n = region.n_uniforms(variable.shape)
    for corner in (0.0, np.nextafter(1.0, 0.0)):
        drawn = region.transform(np.full((1, n), corner), variable.shape, {})
        check_bounds(variable, drawn[0], {})


def check_subset(subset: Subset, variables: Iterable[Variable], *, may_come: bool = False) -> None:
    """Refuse patterns without a variable, unless some may come, and regions beyond bounds."""
    known = {variable.name: variable for variable in variables}
    if not may_come:
        for pattern in subset.unused(known):
            raise UnknownVariable(pattern, known)
    exact = {pattern for pattern, _ in subset.parts}
    for name, variable in known.items():
        region = subset.region(name)
        if region is not None and (name in exact or not isinstance(region, str)):
            check_region(variable, region)


def check_space(
    variable: Variable, value: Value, space: SpaceName | Subset, values: Values
) -> None:
    """Refuse a value outside the space that was asked for."""
    region = space.region(variable.name) if isinstance(space, Subset) else space
    if isinstance(region, str):
        inside = variable.in_space(value, region, values)
        found, nearest = variable.space(region), variable.nearest_in_space(value, region, values)
        words = "∅ (none is declared)" if found is None else found.describe()
        if region == "B" and found is not None and variable.a not in (None, variable.b):
            words += " without A"
    else:
        inside = region is not None and region.contains(value, values)
        found, nearest = region, None if region is None else region.nearest(value, values)
        words = "∅ (it is not to be set)" if found is None else found.describe()
    if not inside:
        name = str(region if isinstance(region, str) else space)
        raise _out_of_bounds(variable, value, words, nearest, name)
