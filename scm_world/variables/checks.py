"""Whether a value may be given to a variable, and the error that says why not."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import numpy as np

from scm_world._types import Value, Values
from scm_world.errors import (
    InterventionError,
    OutOfBounds,
    UnknownVariable,
    WrongValue,
)
from scm_world.variables.interventions import Draw
from scm_world.variables.kinds import SPACES, SpaceName, Variable
from scm_world.variables.noise import Noise
from scm_world.variables.spaces import Categories, Space
from scm_world.variables.subsets import Subset

_LARGEST = 2.0**53  # up to here every whole number is a float, so JSON keeps it


def _expected(variable: Variable) -> str:
    noun = {"real": "numbers", "integer": "whole numbers", "categorical": "whole numbers"}
    if isinstance(variable.bounds, Categories) and variable.bounds.labels:
        noun["categorical"] = " or ".join(map(repr, variable.bounds.labels))
    where = f" of shape {variable.shape}" if variable.shape else ""
    drawn = [f'Draw("{name}")' for name in SPACES if variable.space(name) is not None]
    return f"{noun[variable.dtype]}{where}" + (f", or {', '.join(drawn)}" if drawn else "")


def coerce(variable: Variable, value: Any) -> Value:
    """Turn what a user gave into a value of the variable.

    Returns:
        An array of the declared shape; float64 for a real variable, int64 else.

    Raises:
        WrongValue: It is not a number, not a whole one where one is asked for, not finite, or of
            another shape.
    """
    if isinstance(variable.bounds, Categories) and variable.bounds.labels:
        with suppress(KeyError, ValueError, TypeError):  # refused below
            value = variable.bounds.numbers(value)
    if np.ma.isMaskedArray(value):  # there is something under the mask
        raise WrongValue(variable.name, value, _expected(variable))
    try:
        given = np.asarray(value)
    except (ValueError, TypeError):  # a ragged list, or an object that refuses
        raise WrongValue(variable.name, value, _expected(variable)) from None
    if given.dtype.kind not in "iuf":
        raise WrongValue(variable.name, value, _expected(variable))
    if given.shape != variable.shape:
        raise WrongValue(variable.name, value, variable.shape, given.shape)
    if not np.isfinite(given).all():
        raise WrongValue(variable.name, value)
    if variable.dtype == "real":
        return given.astype(np.float64)
    whole = given.dtype.kind != "f" or (given == np.rint(given)).all()
    if not whole or (np.abs(given.astype(np.float64)) >= _LARGEST).any():
        raise WrongValue(variable.name, value, _expected(variable))
    return given.astype(np.int64)


def _plain(value: Any) -> Any:
    return np.asarray(value).tolist()


def check_bounds(variable: Variable, value: Value, values: Values) -> None:
    """Refuse what is physically impossible.

    Raises:
        WrongValue: It came out of a shift, a scale or other coordinates without being finite.
        OutOfBounds: With the nearest value that is possible.
    """
    if not np.isfinite(value).all():
        raise WrongValue(variable.name, _plain(value))
    bounds = variable.bounds
    if bounds is not None and not bounds.contains(value, values):
        raise OutOfBounds(
            variable.name,
            _plain(value),
            allowed=bounds.describe(variable.shape, values),
            nearest=_plain(bounds.nearest(value, values)),
            unit=variable.unit,
        )


def check_draw(variable: Variable, act: Draw) -> None:
    """Refuse a draw from a space that is not declared, or of another shape than the variable.

    Raises:
        InterventionError: There is no such space, or the numbers of a distribution are too many
            or too few.
    """
    if isinstance(act.source, str):
        if variable.space(act.source) is None:
            raise InterventionError(
                f"{variable.name!r} has no space {act.source} to draw from; draw from a "
                "distribution, such as Draw(Box(low, high))",
                variable=variable.name,
                value=act,
            )
        return
    if act.source.parents():
        return  # known only when it is drawn
    try:
        fits = Noise(0).draw(act.source, variable.name, variable.shape, {})[0].shape
    except ValueError:
        fits = None
    if fits != variable.shape:
        raise InterventionError(
            f"do({variable.name}): {act.source!r} does not fit its shape {variable.shape}; give "
            "one number for all, or one for each component",
            variable=variable.name,
            value=act,
        )


def check_region(variable: Variable, region: SpaceName | Space) -> None:
    """Refuse a region that a variable does not have, or that reaches beyond its bounds.

    Raises:
        InterventionError: There is no such space, or it is of another shape.
        OutOfBounds: A corner of it is physically impossible.
    """
    check_draw(variable, Draw(region))
    if isinstance(region, str) or region.parents() or variable.bounds is None:
        return
    if variable.bounds.parents():
        return  # known only when it is set
    n = region.n_uniforms(variable.shape)
    for corner in (0.0, np.nextafter(1.0, 0.0)):
        drawn = region.transform(np.full((1, n), corner), variable.shape, {})
        check_bounds(variable, drawn[0], {})


def check_subset(subset: Subset, variables: Iterable[Variable], *, may_come: bool = False) -> None:
    """Refuse patterns that name nothing, and regions that variables cannot lie in.

    Args:
        subset: Of the parameter space.
        variables: That there are.
        may_come: Whether others may come, which patterns may name.

    Raises:
        UnknownVariable: A pattern names nothing.
        InterventionError: A region is none of the variable, or beyond its bounds.
    """
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
    """Refuse what lies outside the space that was asked for.

    Raises:
        OutOfBounds: With the nearest value of the space.
    """
    region = space.region(variable.name) if isinstance(space, Subset) else space
    found = variable.space(region) if isinstance(region, str) else region
    without, near, inside = "", None, False
    if isinstance(region, str):
        inside = variable.in_space(value, region, values)
        without = " without A" * (region == "B" and variable.a not in (None, variable.b))
        near = variable.nearest_in_space(value, region, values)
    elif region is not None:
        inside, near = region.contains(value, values), region.nearest(value, values)
    if inside:
        return
    none = "∅ (none is declared)" if isinstance(region, str) else "∅ (it is not to be set)"
    raise OutOfBounds(
        variable.name,
        _plain(value),
        space=region if isinstance(region, str) else str(space),
        allowed=none if found is None else found.describe(variable.shape, values) + without,
        nearest=None if near is None else _plain(near),
        unit=variable.unit,
    )
