"""What a structured observation consists of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

TIME = "time_left_for_task"


@final
@dataclass(frozen=True)
class Observed:
    """A part of the structured observation.

    Attributes:
        variable: What is observed.
        low: Lower bound of each component; the declared one if None.
        high: Upper bound.
        published: Lower and upper bound of the predecessor's normalisation.
    """

    variable: str
    published: tuple[Any, Any]
    low: Any = None
    high: Any = None
