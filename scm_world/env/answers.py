"""What ``check`` asks, of whom, and its answers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, final

import numpy as np
from pydantic import BaseModel, ConfigDict

from scm_world._types import ArrayLike, Floats
from scm_world.variables.distributions import Distribution
from scm_world.world.simulation import READ_BACK

QUESTIONS: Mapping[str, str] = {
    "applied": "The engine has the value that was set; or values differ after resets.",
    "in range": "Both ends are taken over; or values lie inside, uncut, in half of it and more.",
    "responds": "The state differs from that of an equal run with another value.",
    "at once": "It differs in this episode, not only after the next reset.",
    "neighbours": "Values and states of the other worlds do not change.",
    "second reset": "Doing it again gives the same; values do not drift from reset to reset.",
    "undo": "The old value gives the old states.",
    "partial reset": "A reset of one world leaves the others as they are.",
    "constants": "Constants derived from the value are those of a fresh compilation.",
}
"""The questions about each range, and the meaning of a pass."""

TARGETS = (1.0 - 1e-12, 0.0, 0.75, 0.25, 0.5, 0.9, 0.1)  # places in a range, tried in this order
ROUNDING = 1e-9  # share of the spread of a number that an effect in rounding has
Status = Literal["passed", "fault", "not asked"]


@final
class Answer(BaseModel):
    """The answer to one question about one range.

    Attributes:
        status: ``"passed"``, ``"fault"``, or ``"not asked"``.
        said: The finding, or why it was not asked.
        size: The largest difference in the state, in ``unit``, if it was measured.
        unit: Its unit.
        share: The same in spreads of this number in a run without a change.
    """

    model_config = ConfigDict(frozen=True, ser_json_inf_nan="strings")

    status: Status
    said: str = ""
    size: float | None = None
    unit: str = ""
    share: float | None = None


def at(space: Distribution, u: float, shape: tuple[int, ...], values: Mapping[str, Any]) -> Floats:
    """Return the value at a place in a space, from 0 to 1 in each of its numbers."""
    uniforms = np.full((1, space.n_uniforms(shape)), u)
    found: Floats = np.asarray(space.transform(uniforms, shape, values), dtype=np.float64)[0]
    return found


def near(one: Floats, other: Floats, room: Floats | float = 0.0) -> bool:
    """Return whether numbers are equal, but for rounding, or for a room."""
    return bool((np.abs(one - other) <= np.maximum(room, READ_BACK * (1e-9 + np.abs(other)))).all())


def missing(why: str) -> Answer:
    """Return the answer to a question that is not asked."""
    return Answer(status="not asked", said=why)


def none(why: str) -> dict[str, Answer]:
    """Return answers, none of which was asked for one reason."""
    return dict.fromkeys(QUESTIONS, missing(why))


def numbers(values: ArrayLike) -> str:
    """Return the first numbers as a text."""
    flat = np.ravel(values)
    shown = dict.fromkeys(f"{x:.4g}" for x in flat[:3].tolist())
    return ", ".join(shown) + ", …" * (flat.size > 3)


def is_pair(given: object) -> bool:
    """Return whether it has two members."""
    return isinstance(given, tuple | list | np.ndarray) and len(given) == 2
