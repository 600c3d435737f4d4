"""How an episode begins, and the options that a world accepts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from scm_world._types import Value, Values
from scm_world.errors import UnknownOption
from scm_world.graph import SCM
from scm_world.scene import PhysicalState
from scm_world.variables import Measured


def beginning(
    model: SCM, static_names: Sequence[str], slices: Mapping[str, slice], n_blocks: int
) -> tuple[dict[str, Value], PhysicalState]:
    """Compute where an episode begins when nobody intervenes.

    Returns:
        The values of everything that physics does not move, and the state of the rest.
    """
    static = model.solve(only=static_names)
    state = PhysicalState(n_blocks)
    for variable in model.variables:
        where = slices.get(variable.name)
        if where is not None and isinstance(variable, Measured):
            state.vector[where] = _first(model, variable, static)
    return static, state


def _first(model: SCM, variable: Measured, static: Values) -> Value:
    if variable.start is None:
        return variable.array(variable.default)
    known = {**static}
    for name in variable.set_parents():
        parent = model.declared(name)
        if isinstance(parent, Measured):
            known[name] = parent.array(parent.default)
    parents = [known[name] for name in variable.set_parents()]
    return np.asarray(variable.start.bind()(*parents))


def whole_number(option: str, value: Any, *, least: int) -> int:
    """Check an option that is a whole number.

    Raises:
        UnknownOption: It is none, or too small.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise UnknownOption(option, value, (f"any whole number from {least} on",))
    return int(value)
