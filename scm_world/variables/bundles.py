"""Bundles: variables that join others, such as the joints of all fingers, in one vector."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from scm_world._arguments import typed
from scm_world.errors import ModelError
from scm_world.variables.kinds import Derived, Measured, Parent, Variable
from scm_world.variables.mechanisms import Concatenation
from scm_world.variables.spaces import Box, Space


@typed
def bundle(name: str, parts: Sequence[Variable], **fields: object) -> Derived | Measured:
    """Declare a bundle: a computed variable on which an intervention is one on each of its parts.

    Args:
        name: Name of the bundle.
        parts: The variables that it joins: all parameters, all states, all readouts or all actions.
        fields: Further fields of the variable. If not given, the unit is the common unit of the
            parts, and bounds, A and B are boxes if those of all parts are.

    Raises:
        ModelError: The parts are of different roles, or there are none.

    Example:
        >>> from scm_world.variables import Action
        >>> left, right = (Action(name=n, unit="N", bounds=Box(-1.0, 1.0)) for n in "lr")
        >>> both = bundle("action", [left, right])
        >>> both.parts, both.shape, both.bounds.high
        (('l', 'r'), (2,), (1.0, 1.0))
    """
    roles = {part.role for part in parts}
    if len(roles) != 1:
        raise ModelError([f"{name}: the parts of a bundle have one role, got {sorted(roles)}"])
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
    """Join boxes; None where another space is given, or one that follows variables."""
    boxes = [space for space in spaces if isinstance(space, Box) and not space.parents()]
    if len(boxes) < len(spaces):
        return None
    ends = [box.bounds(shape, {}) for box, shape in zip(boxes, shapes, strict=True)]
    low, high = (np.concatenate([*map(np.ravel, end)]).tolist() for end in zip(*ends, strict=True))
    return Box(tuple(low), tuple(high))


def part_of(box: Box, where: slice, size: int, shape: tuple[int, ...]) -> Box:
    """Return the part of a box, of ``size`` components, for some of them, in the given shape.

    Example:
        >>> part_of(Box((0.0, 1.0, 2.0), 3.0), slice(1, 2), 3, ())
        Box(kind='box', low=1.0, high=3.0)
    """
    ends = (np.ravel(end)[where].tolist() for end in box.bounds((size,), {}))
    low, high = ((tuple(end) if shape else end[0]) for end in ends)
    return Box(low, high)
