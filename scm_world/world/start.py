"""How an episode begins, and the options that a world accepts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from scm_world._types import Value, Values
from scm_world.errors import UnknownOption
from scm_world.graph import Moment
from scm_world.scene import PhysicalState
from scm_world.variables import Measured

if TYPE_CHECKING:
    from scm_world.world.declaration import Declaration


def beginning(
    declaration: Declaration, moment: Moment | None
) -> tuple[dict[str, Value], PhysicalState]:
    """Compute where an episode begins when nobody intervenes.

    Args:
        declaration: Of the world.
        moment: Where to draw what is random by declaration; its default if None.

    Returns:
        The values of everything that physics does not move, and the state of the rest.
    """
    static = declaration.model.solve(only=declaration.static_names, moment=moment)
    state = PhysicalState(declaration.n_blocks)
    for variable in declaration.model.variables:
        where = declaration.slices.get(variable.name)
        if where is not None and isinstance(variable, Measured):
            state.vector[where] = _first(declaration, variable, static)
    return static, state


def _first(declaration: Declaration, variable: Measured, static: Values) -> Value:
    if variable.start is None:
        return variable.array(variable.default)
    known = {**static}
    for name in variable.set_parents():
        parent = declaration.model.declared(name)
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
