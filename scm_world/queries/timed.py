"""Timed interventions: at an instant, over a window, on an event."""

from __future__ import annotations

from typing import Annotated, Any, Literal, final

import numpy as np
from pydantic import Field

from scm_world._arguments import real_number, whole_number
from scm_world.errors import UnknownOption
from scm_world.models import Model
from scm_world.queries.equations import System
from scm_world.variables import Draw, Hard, Intervention, Mechanism, Natural, Null, Scale, Shift
from scm_world.variables.kinds import SPACES
from scm_world.variables.spaces import Frozen
from scm_world.world import Simulation

ACTS = (Hard, Shift, Scale, Draw, Mechanism, Natural, Null)


def as_act(value: Any) -> Any:
    """Make a plain value a hard intervention, and the name of a space a draw from it.

    Raises:
        UnknownOption: It is neither numbers nor an intervention.
    """
    if isinstance(value, ACTS) or (isinstance(value, dict) and "kind" in value):  # from a file
        return value
    if isinstance(value, dict):
        allowed = "a value or an intervention: {'pole.mass': At(3, 1.0)}, not At(3, {…})"
        raise UnknownOption("act", value, (allowed,))
    if isinstance(value, str) and value in SPACES:
        return Draw(value)
    given = value if not isinstance(value, np.ndarray) else value.tolist()
    return Hard(given)


@final
class At(Frozen):
    """Intervene at the beginning of one control step.

    Attributes:
        step: Number of the control step.
        act: What is done.

    Example:
        >>> At(50, [0.0, 0.0, 0.1]).step
        50
    """

    kind: Literal["at"] = "at"
    step: int
    act: Intervention

    def __init__(self, step: Any, act: Any, **fields: Any) -> None:
        super().__init__(step=whole_number("At(step)", step, least=0), act=as_act(act), **fields)


@final
class Clamp(Frozen):
    """Hold a variable during a window of control steps, and hand it back at its end.

    A state is put there again at the beginning of every control step of the window: its
    mechanism is cut for as long. A parameter is set once, and follows its own mechanism afterwards.

    Attributes:
        act: What it is held at.
        start: First control step of the window.
        stop: The step at which it ends; None for the end of the episode.

    Example:
        >>> Clamp([0.0, 0.9, -1.7] * 3, 100, 200).stop
        200
    """

    kind: Literal["clamp"] = "clamp"
    act: Intervention
    start: int = 0
    stop: int | None = None

    def __init__(self, act: Any, start: Any = 0, stop: Any = None, **fields: Any) -> None:
        first = whole_number("Clamp(start)", start, least=0)
        last = None if stop is None else whole_number("Clamp(stop)", stop, least=first + 1)
        if isinstance(act, Null):
            allowed = ("a value or an intervention on a variable", "At(step, Null())")
            raise UnknownOption("Clamp(act)", act, allowed)
        super().__init__(act=as_act(act), start=first, stop=last, **fields)


@final
class Contact(Frozen):
    """The event that two bodies touch.

    Attributes:
        first: Name of a body, or the beginning of one: ``"robot"`` is any link.
        second: Likewise.
    """

    kind: Literal["contact"] = "contact"
    first: str
    second: str

    def __init__(self, first: str, second: str, **fields: Any) -> None:
        for body in (first, second):
            if not isinstance(body, str):
                raise UnknownOption("body", body, ("the name of a body, or its beginning",))
        super().__init__(first=first, second=second, **fields)

    @property
    def bodies(self) -> tuple[str, str]:
        """Both names."""
        return self.first, self.second

    def happens(self, world: System) -> bool:
        """Tell whether they touch now: in the last physics step, with a force.

        Raises:
            UnknownOption: The model has no such body; equations have none at all.
        """
        if not isinstance(world, Simulation):
            raise UnknownOption("event of equations", self, ("Reaches(name, above=…)",))
        known = world.structure.body_names if isinstance(world.structure, Model) else ()
        for body in self.bodies if known else ():
            if not any(name.startswith(body) for name in known):
                raise UnknownOption("body of a contact", body, known)
        return any(
            contact.force > 0.0 and (self._are(*contact.bodies) or self._are(*contact.bodies[::-1]))
            for contact in world.backend.contacts()
        )

    def _are(self, one: str, other: str) -> bool:
        return one.startswith(self.first) and other.startswith(self.second)


@final
class Reaches(Frozen):
    """The event that a number lies above or below a threshold.

    Attributes:
        name: Of any variable.
        above: The event occurs where the variable is greater.
        below: The event occurs where it is smaller.
        component: Which number of it, where it has several.
    """

    kind: Literal["reaches"] = "reaches"
    name: str
    above: float | None = None
    below: float | None = None
    component: int = 0

    def __init__(self, name: str, **fields: Any) -> None:
        given = [fields.get("above"), fields.get("below")]
        number: Any = given[0] if given[1] is None else given[1]
        if (fields.get("above") is None) == (fields.get("below") is None):
            raise UnknownOption("Reaches", fields, ("above=…", "below=…"))
        real_number("threshold of Reaches", number)
        whole_number("component of Reaches", fields.get("component", 0), least=0)
        super().__init__(name=name, **fields)

    def happens(self, world: System) -> bool:
        """Tell whether it is there now."""
        numbers = np.ravel(world[self.name])
        if self.component >= len(numbers):
            allowed = (f"0 to {len(numbers) - 1}",)
            raise UnknownOption(f"component of {self.name}", self.component, allowed)
        number = float(numbers[self.component])
        if self.above is not None:
            return number > self.above
        return self.below is not None and number < self.below


Event = Annotated[Contact | Reaches, Field(discriminator="kind")]


@final
class On(Frozen):
    """Intervene at the first control step, after the plan began, at which something is the case.

    Attributes:
        event: ``Contact`` or ``Reaches``.
        act: What is done.

    Example:
        >>> On(Contact("robot", "tool_block"), 0.3).act.value
        0.3
    """

    kind: Literal["on"] = "on"
    event: Event
    act: Intervention

    def __init__(self, event: Any, act: Any, **fields: Any) -> None:
        if not isinstance(event, Contact | Reaches | dict):
            raise UnknownOption(
                "event", event, ("Contact(first, second)", "Reaches(name, above=…)")
            )
        super().__init__(event=event, act=as_act(act), **fields)


TIMED = (At, Clamp, On)
Timed = Annotated[
    Hard | Shift | Scale | Draw | Mechanism | Natural | Null | At | Clamp | On,
    Field(discriminator="kind"),
]
"""Anything that a plan does to one variable."""
