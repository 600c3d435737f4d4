"""The time of an intervention in an episode, and the events that it can wait for."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal, final

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer

from scm_world._arguments import whole_number
from scm_world.errors import UnknownOption
from scm_world.variables.spaces import Frozen


@final
class Contact(Frozen):
    """The event that two bodies touch: in the last physics step, with a force.

    Attributes:
        first: Name of a body, or the beginning of one: ``"robot"`` means any link.
        second: That of the other body.
    """

    kind: Literal["contact"] = "contact"
    first: str
    second: str

    def __init__(self, first: str, second: str, **fields: object) -> None:
        super().__init__(first=first, second=second, **fields)


@final
class Reaches(Frozen):
    """The event that a number lies above or below a threshold.

    Attributes:
        name: Name of the variable.
        above: The event occurs where the variable is greater.
        below: The event occurs where it is smaller.
        component: Index of the number, where the variable has several.
    """

    kind: Literal["reaches"] = "reaches"
    name: str
    above: float | None = None
    below: float | None = None
    component: int = Field(default=0, ge=0)

    def __init__(self, name: str, **fields: object) -> None:
        if (fields.get("above") is None) == (fields.get("below") is None):
            raise UnknownOption("Reaches", fields, ("above=…", "below=…"))
        super().__init__(name=name, **fields)


Event = Annotated[Contact | Reaches, Field(discriminator="kind")]


class Short(Frozen):
    """A declaration whose representation and file leave out fields that are None."""

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """List the fields that are shown, the time at the end."""
        found = [pair for pair in super().__repr_args__() if pair[1] is not None]
        return iter(sorted(found, key=lambda pair: pair[0] in ("below", "time")))

    @model_serializer(mode="wrap")
    def _shorter(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {name: value for name, value in handler(self).items() if value is not None}


@final
class Time(Short):
    """The time of an intervention in an episode, counted in control steps.

    Attributes:
        at: The step at which it takes place; with ``every``, the first one.
        during: First step of a window, and the step at which it ends; None is the end of the
            episode. A state is put there again at every step of the window: its mechanism is cut
            for as long. A parameter is set once and has its own mechanism again at the end.
        every: Number of steps from one time to the next.
        when: It takes place at the first step, after the plan began, at which this holds; with
            ``during``, within that window.
    """

    at: int | None = None
    during: tuple[int, int | None] | None = None
    every: int | None = None
    when: Event | None = None

    def __init__(self, **fields: Any) -> None:
        given = {name: value for name, value in fields.items() if value is not None}
        one, pairs = "at=, during=, every=, when=", ({"at", "every"}, {"during", "when"})
        if len(given) != 1 and {*given} not in pairs:
            both = "at= and every=", "during= and when="
            raise UnknownOption("time of an intervention", given, (f"one of {one}", *both))
        for name, least in (("at", 0), ("every", 1)):
            if name in given:
                given[name] = whole_number(name, given[name], least=least)
        if "during" in given:
            try:
                start, stop = given["during"]
            except (TypeError, ValueError):
                allowed = ("(start, stop)", "(start, None)")
                raise UnknownOption("during", given["during"], allowed) from None
            start = whole_number("start of a window", start, least=0)
            if stop is not None:
                stop = whole_number("end of a window", stop, least=start + 1)
            given["during"] = start, stop
        if "when" in given and not isinstance(given["when"], Contact | Reaches | dict):
            allowed = ("Contact(first, second)", "Reaches(name, above=…)")
            raise UnknownOption("event", given["when"], allowed)
        super().__init__(**given)

    def __str__(self) -> str:
        if self.when is not None:
            window = "" if self.during is None else f", {Time(during=self.during)}"
            return f"when {self.when!r}{window}"
        if self.during is not None:
            start, stop = self.during
            return f"from {start} to {'the end' if stop is None else stop}"
        again = "" if self.every is None else f"every {self.every} steps from "
        return f"{again or 'at '}{self.at or 0}"

    def holds(self, step: int) -> bool:
        """Return whether this is a window, and a control step lies in it."""
        return self.when is None and self.during is not None and self.covers(step)

    def covers(self, step: int) -> bool:
        """Return whether a control step lies between the first one and the end."""
        return self.first <= step and (self.stop is None or step < self.stop)

    @property
    def first(self) -> int:
        """The first step at which it can take place, or from which an event is awaited."""
        return (self.at or 0) if self.during is None else self.during[0]

    @property
    def stop(self) -> int | None:
        """The step at which its window ends; None if it has no window, or one without an end."""
        return None if self.during is None else self.during[1]

    @property
    def last(self) -> float:
        """The last step at which it can take place; infinite but for a single time."""
        return math.inf if self.at is None or self.every is not None else self.at

    @property
    def start(self) -> int | None:
        """The first step at which it takes place; None for an event."""
        return None if self.when is not None else self.first
