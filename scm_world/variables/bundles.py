"""Bundles: variables that are others one after another, such as the joints of all fingers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from scm_world.variables.interventions import (
    Draw,
    Hard,
    Intervention,
    Mechanism,
    Natural,
    Null,
    Scale,
    Shift,
)
from scm_world.variables.kinds import Derived, Measured, Parent, Variable
from scm_world.variables.mechanisms import Concatenation
from scm_world.variables.spaces import Box, Space


def bundle(name: str, parts: Sequence[Variable], **fields: Any) -> Derived | Measured:
    """Declare a bundle: a computed variable on which an intervention is one on each of its parts.

    Args:
        name: Of the bundle.
        parts: What it is put together from: all parameters, all states, all readouts or all
            actions.
        fields: Further fields of the variable. If not given, the unit is what the parts have in
            common, and bounds, A and B are boxes if those of all parts are.

    Raises:
        ValueError: The parts are of different roles.

    Example:
        >>> from scm_world.variables import Action
        >>> left, right = (Action(name=n, unit="N", bounds=Box(-1.0, 1.0)) for n in "lr")
        >>> both = bundle("action", [left, right])
        >>> both.parts, both.shape, both.bounds.high
        (('l', 'r'), (2,), (1.0, 1.0))
    """
    roles = {part.role for part in parts}
    if len(roles) != 1:
        raise ValueError(f"{name}: the parts of a bundle have one role, got {sorted(roles)}")
    (role,) = roles
    shapes = tuple(part.shape for part in parts)
    units = {part.unit for part in parts}
    given: dict[str, Any] = {
        "name": name,
        "unit": units.pop() if len(units) == 1 else ", ".join(part.unit for part in parts),
        "shape": (sum(int(np.prod(shape)) for shape in shapes),),
        "parents": tuple(Parent(part.name) for part in parts),
        "mechanism": Concatenation(shapes=shapes),
        "doc": f"{', '.join(part.name for part in parts)}, one after another.",
        **{s: _joined([getattr(part, s) for part in parts], shapes) for s in ("bounds", "a", "b")},
        **fields,
    }
    if role == "parameter":
        return Derived(**given)
    return Measured(settable_state=role == "state", **given)


def _joined(spaces: Sequence[Space | None], shapes: tuple[tuple[int, ...], ...]) -> Box | None:
    """Put boxes together; None where one is no box, or follows other variables."""
    low: list[float] = []
    high: list[float] = []
    for space, shape in zip(spaces, shapes, strict=True):
        if not isinstance(space, Box) or space.parents():
            return None
        ends = space.bounds(shape, {})
        low += np.ravel(ends[0]).tolist()
        high += np.ravel(ends[1]).tolist()
    return Box(tuple(low), tuple(high))


def part_of(box: Box, where: slice, size: int, shape: tuple[int, ...]) -> Box:
    """Give the part of a box that belongs to some of its components.

    Args:
        box: Of ``size`` components.
        where: Which components.
        size: How many there are.
        shape: Of the part.

    Example:
        >>> part_of(Box((0.0, 1.0, 2.0), 3.0), slice(1, 2), 3, ())
        Box(kind='box', low=1.0, high=3.0)
    """
    ends = (np.ravel(end)[where].tolist() for end in box.bounds((size,), {}))
    low, high = ((tuple(end) if shape else end[0]) for end in ends)
    return Box(low, high)


def divided(variable: Variable, act: Intervention) -> dict[str, Intervention]:
    """Give the interventions on the parts of a bundle that one on the bundle stands for.

    A draw, and another mechanism, are those of the whole bundle: the noise is the same, and so is
    the function; see ``Draw.of``.

    Args:
        variable: The bundle, or any other variable: then the intervention is on itself.
        act: Which has been checked.
    """
    parts = variable.parts
    if not parts:
        return {variable.name: act}
    mechanism: Any = getattr(variable, "mechanism", None)  # a bundle has one
    match act:
        case Draw() | Mechanism():
            return dict.fromkeys(parts, act.model_copy(update={"of": variable.name}))
        case Hard(value=numbers) | Shift(by=numbers) | Scale(by=numbers):
            whole = np.broadcast_to(numbers, variable.shape)
            values = (value.tolist() for value in mechanism.split(whole))
            return {part: type(act)(value) for part, value in zip(parts, values, strict=True)}
        case Natural() | Null():
            return dict.fromkeys(parts, act)


def whole_of(act: Any, name: str) -> str:
    """Name the bundle that an intervention is a part of; the variable itself if there is none."""
    return (type(act) in (Draw, Mechanism) and act.of) or name
