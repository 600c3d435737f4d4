"""What one can do to a variable, as values.

A plain number or array is the hard intervention: the variable is cut from its parents and held
at this value. ``Shift`` and ``Scale`` keep the parents and change what they say; ``Draw`` cuts
them and draws.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, final

import numpy as np
from pydantic import Field

from scm_world.errors import UnknownOption
from scm_world.variables.distributions import Distribution
from scm_world.variables.kinds import SPACES, SpaceName
from scm_world.variables.spaces import Frozen

Number = float | tuple[float, ...]


def _number(what: str, value: Any) -> Any:
    try:
        given = np.asarray(value)
    except ValueError:  # a ragged list
        given = np.asarray("")
    if given.dtype.kind not in "iufb":
        raise UnknownOption(what, value, ("a number", "an array of numbers"))
    return tuple(given.ravel().tolist()) if given.ndim else value


@final
class Hard(Frozen):
    """Set a variable to a value, whatever its parents say."""

    kind: Literal["hard"] = "hard"
    value: Number

    def __init__(self, value: Any, **fields: Any) -> None:
        super().__init__(value=_number("Hard(value)", value), **fields)  # type: ignore[call-arg]


@final
class Shift(Frozen):
    """Add to what a variable would have been. Its parents go on mattering.

    Example:
        >>> Shift(0.1)
        Shift(kind='shift', by=0.1)
    """

    kind: Literal["shift"] = "shift"
    by: Number

    def __init__(self, by: Any, **fields: Any) -> None:
        super().__init__(by=_number("Shift(by)", by), **fields)  # type: ignore[call-arg]


@final
class Scale(Frozen):
    """Multiply what a variable would have been. Its parents go on mattering."""

    kind: Literal["scale"] = "scale"
    by: Number

    def __init__(self, by: Any, **fields: Any) -> None:
        super().__init__(by=_number("Scale(by)", by), **fields)  # type: ignore[call-arg]


@final
class Draw(Frozen):
    """Draw a variable from its space ``"A"``, ``"B"`` or ``"A|B"``, or from a distribution.

    Example:
        >>> Draw("A").source
        'A'
    """

    kind: Literal["draw"] = "draw"
    source: SpaceName | Distribution

    def __init__(self, source: Any, **fields: Any) -> None:
        if not isinstance(source, Frozen | dict) and source not in SPACES:
            raise UnknownOption("Draw(source)", source, (*SPACES, "a distribution, such as a Box"))
        super().__init__(source=source, **fields)  # type: ignore[call-arg]


Intervention = Annotated[Hard | Shift | Scale | Draw, Field(discriminator="kind")]
"""Anything that ``do`` accepts, once a plain value has become ``Hard``."""

SOFT = (Shift, Scale)
"""The interventions that leave the parents in place."""
