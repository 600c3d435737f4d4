"""Interventions on a variable, as values.

A plain number or array is the hard intervention: the variable is cut from its parents and held
at this value. ``Shift`` and ``Scale`` keep the parents and change their effect; ``Draw`` cuts
them and draws. In a plan each has a time: ``Hard(0.2, at=10)``, ``Shift(0.1, during=(5, 9))``,
``Draw("A", every=25)``, ``Natural(when=Contact("robot", "tool_block"))``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Any, Literal, Self, final

import numpy as np
from pydantic import (
    BeforeValidator,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from scm_world._arguments import whole_number
from scm_world._types import Value
from scm_world.errors import ModelError, UnknownOption
from scm_world.variables.distributions import Distribution
from scm_world.variables.kinds import (
    SPACES,
    AsMechanism,
    AsNumber,
    AsParents,
    InverseNoise,
    Parent,
    SpaceName,
    Variable,
    names,
)
from scm_world.variables.mechanisms import EQUATIONS, Equation, check_order
from scm_world.variables.spaces import Box, Frozen


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

    def __init__(self, first: str, second: str, **fields: Any) -> None:
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

    def __init__(self, name: str, **fields: Any) -> None:
        if (fields.get("above") is None) == (fields.get("below") is None):
            raise UnknownOption("Reaches", fields, ("above=…", "below=…"))
        super().__init__(name=name, **fields)


Event = Annotated[Contact | Reaches, Field(discriminator="kind")]


class _Short(Frozen):
    """A declaration whose representation and file leave out fields that are None."""

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """List the fields that are shown, the time at the end."""
        found = [pair for pair in super().__repr_args__() if pair[1] is not None]
        return iter(sorted(found, key=lambda pair: pair[0] == "time"))

    @model_serializer(mode="wrap")
    def _shorter(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {name: value for name, value in handler(self).items() if value is not None}


@final
class Time(_Short):
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
        if self.during is None or self.when is not None:
            return False
        start, stop = self.during
        return start <= step and (stop is None or step < stop)

    @property
    def start(self) -> int | None:
        """The first step at which it takes place; None for an event."""
        first = self.at if self.during is None else self.during[0]
        return None if self.when is not None else first or 0


class TimedIntervention(_Short):
    """Base class of interventions: each may have a time in the episode of a plan.

    Attributes:
        time: At the beginning if None; given as ``at=``, ``during=``, ``every=`` or ``when=``.
    """

    model_config = ConfigDict(allow_inf_nan=True)  # refused when it is done, as any value

    time: Time | None = None

    @property
    def root(self) -> Any:
        """The intervention that decides the mechanism: the lowest one that a soft one acts on."""
        return self

    def __init__(self, **fields: Any) -> None:
        if given := {name: fields.pop(name) for name in Time.model_fields if name in fields}:
            fields["time"] = Time(**given)
        super().__init__(**fields)


@final
class Hard(TimedIntervention):
    """Set a variable to a value, independently of its parents."""

    kind: Literal["hard"] = "hard"
    value: AsNumber

    def __init__(self, value: Any, **fields: Any) -> None:
        super().__init__(value=value, **fields)

    @classmethod
    def of(cls, value: Value) -> Self:
        """Return the intervention for an array that has been checked, without validating it."""
        numbers = value.ravel().astype(np.float64, copy=False).tolist()
        plain = tuple(numbers) if value.ndim else numbers[0]
        act, put = object.__new__(cls), object.__setattr__
        put(act, "__dict__", {"time": None, "kind": "hard", "value": plain})
        put(act, "__pydantic_fields_set__", {"value"})
        put(act, "__pydantic_extra__", None)
        put(act, "__pydantic_private__", None)
        return act


@final
class Draw(TimedIntervention):
    """Draw a variable from its space ``"A"``, ``"B"`` or ``"A|B"``, or from a distribution.

    Two numbers are the ends of a ``Box``: ``Draw(0.8, 1.2)``.

    Attributes:
        source: The space or distribution.
        stream: Name of its noise: draws of one variable at one control step give the same numbers
            if they have the same name; those of other variables do not. If None, the draws of a
            model have nothing in common with the variable's own noise.
        of: A bundle that is drawn as a whole; the variable gets its part of it. ``do`` sets it on
            the parts of a bundle.

    Example:
        >>> Draw("A").source, Draw(0.8, 1.2) == Draw(Box(0.8, 1.2))
        ('A', True)
    """

    kind: Literal["draw"] = "draw"
    source: SpaceName | Distribution
    stream: str | None = None
    of: str | None = None

    def __init__(self, source: Any, high: Any = None, **fields: Any) -> None:
        source = source if high is None else Box(source, high)
        if not (isinstance(source, Frozen | dict) or str(source) in SPACES):
            raise UnknownOption("Draw(source)", source, (*SPACES, "a distribution, such as a Box"))
        super().__init__(source=source, **fields)

    def drawn_from(self, variable: Variable) -> Distribution:
        """Return the distribution that a variable is drawn from."""
        space = variable.space(self.source) if isinstance(self.source, str) else self.source
        if space is None:
            raise ModelError([f"{variable.name!r} has no space {self.source}"])
        return space


class _Soft(TimedIntervention):
    kind: Literal["shift", "scale"]  # first: the noise of a curriculum is a function of its text
    by: AsNumber | Draw
    shared: Annotated[bool | str | None, BeforeValidator(lambda given: given or None)] = None
    below: tuple[str, Intervention] | None = None

    @property
    def root(self) -> Any:
        """The intervention that decides the mechanism: the lowest one that a soft one acts on."""
        return self if self.below is None else self.below[1].root

    @model_validator(mode="after")
    def _draw_is_relative(self) -> Self:
        given, by = f"{type(self).__name__}(by)", self.by
        if not isinstance(by, Draw):
            if self.shared:
                allowed = ("left out: a number is the same for all variables",)
                raise UnknownOption("shared", self.shared, allowed)
        elif isinstance(by.source, str) or by.source.parents() or by.time or by.of:
            wanted = "Draw(low, high)", "Draw of a distribution that follows no variables"
            raise UnknownOption(given, by, wanted)
        return self


@final
class Shift(_Soft):
    """Add a number to the value that a variable would have. Its parents remain causes.

    Attributes:
        by: The number, or those of all components; or a ``Draw`` of it. The draw of a parameter or
            a state is a number from the instant of the intervention on; that of an action is
            another one in every control step.
        shared: Whether the variables that a pattern fits get one number, the same for all
            components; by default each component of each variable has a draw of its own. A text
            joins variables under any names: those with the same text get one number.
        below: Name and intervention of a lower layer, on which it acts; the variable's own
            mechanism if None. A plan sets it.

    Example:
        >>> Shift(0.1)
        Shift(kind='shift', by=0.1)
        >>> noisy = {"*.control": Shift(Draw(-0.01, 0.01))}
    """

    kind: Literal["shift"] = "shift"

    def __init__(self, by: Any, **fields: Any) -> None:
        super().__init__(by=by, **fields)


@final
class Scale(_Soft):
    """Multiply the value that a variable would have. Its parents remain causes.

    Attributes:
        by: The factor; see ``Shift``.
        shared: Whether it is one draw for all variables; see ``Shift``.
        below: See ``Shift``.

    Example:
        >>> heavier = {"*.mass": Scale(Draw(0.8, 1.2)), "*.damping": Scale(Draw(0.5, 2.0))}
        >>> together = {"*.mass": Scale(Draw(0.8, 1.2), shared=True)}
    """

    kind: Literal["scale"] = "scale"

    def __init__(self, by: Any, **fields: Any) -> None:
        super().__init__(by=by, **fields)


@final
class Mechanism(TimedIntervention):
    """Replace the structural equation of a variable, which then follows other variables.

    A parameter may follow parameters (so that a color can cause a friction, which it does not by
    default), a state is set to the result of the function at that instant, and an action follows
    anything at every step: then the function is the policy.

    The noise stays the same: a function that takes ``noise`` is given the numbers of the one that
    it replaces. With ``noise`` alone, function and parents stay, and the noise is another one.

    Attributes:
        function: Called with the values of the parents, in their order, and with ``noise=`` if it
            takes that; None for the variable's own. One whose arguments have the names of the
            parents in another order is refused.
        parents: The causes; the graph then has these edges in place of the others.
        noise: Distribution of the noise; that of the variable if None.
        inverse_noise: As in ``Derived``, for counterfactuals of units observed under it.
        of: A bundle that the function returns as a whole; the variable gets its part of it.

    Example:
        >>> tie = Mechanism(lambda color: color[..., 0], ["floor_color"])
        >>> tie.parents[0].name, tie.parents[0].lag
        ('floor_color', 0)
    """

    kind: Literal["mechanism"] = "mechanism"
    function: AsMechanism | None = None
    parents: AsParents = ()
    noise: Distribution | None = None
    inverse_noise: InverseNoise | None = None
    of: str | None = None

    @property
    def equation(self) -> Equation:
        """The function; ``do`` has replaced None by that of the variable."""
        if self.function is None:
            raise ModelError(["a mechanism without a function is complete only in a model"])
        return self.function

    def __init__(self, function: Any = None, parents: Any = (), **fields: Any) -> None:
        named = (parents,) if isinstance(parents, str | Parent) else parents
        named = tuple(named) if isinstance(named, Iterable) else named  # refused below
        known = callable(function) or isinstance(function, (*EQUATIONS, dict))
        noise_alone = function is None and fields.get("noise") is not None and not named
        if not known and not noise_alone:
            allowed = ("a function of the parents", "Function", "Linear", "Table")
            raise UnknownOption("Mechanism(function)", function, allowed)
        super().__init__(function=function, parents=named, **fields)

    @model_validator(mode="after")
    def _arguments_are_in_order(self) -> Mechanism:
        check_order("Mechanism", self.function, names(self.parents))
        return self


@final
class Natural(TimedIntervention):
    """End an earlier intervention on a variable: it is what the layers below make of it.

    That is its own structural equation, unless a context says otherwise; see ``Plan``.
    """

    kind: Literal["natural"] = "natural"


@final
class Null(TimedIntervention):
    """Remove an entity: a block, an obstacle or a goal, by its name.

    It leaves the world and its graph, with everything that is computed from it, and comes back
    with the next episode.
    """

    kind: Literal["null"] = "null"

    def __init__(self, **fields: Any) -> None:
        if fields.get("during") is not None:
            allowed = ("a value or an intervention on a variable", "Null(at=step)")
            raise UnknownOption("intervention of a window", "Null", allowed)
        super().__init__(**fields)


ACTS = (Hard, Shift, Scale, Draw, Mechanism, Natural, Null)
"""The classes of interventions."""

SOFT = (Shift, Scale)
"""The interventions that leave the parents in place."""


def joined(act: Any, pattern: str) -> Any:
    """Return an intervention by a pattern: what its variables share is a draw of this pattern."""
    if isinstance(act, list | tuple):
        return type(act)(joined(one, pattern) for one in act)
    is_shared = isinstance(act, SOFT) and act.shared is True
    return act.model_copy(update={"shared": pattern}) if is_shared else act


Intervention = Annotated[
    Hard | Shift | Scale | Draw | Mechanism | Natural | Null, Field(discriminator="kind")
]
"""Anything that ``do`` accepts, once a plain value has become ``Hard``."""

Shift.model_rebuild()
Scale.model_rebuild()


def in_context(act: Any, kind: str) -> Any:
    """Return an intervention of a context: what a soft one draws has noise of its own there."""
    if not isinstance(act, SOFT) or not isinstance(act.by, Draw) or act.by.stream is not None:
        return act
    return act.model_copy(update={"by": act.by.model_copy(update={"stream": f"by in {kind}"})})


def lowest(name: str, act: Any) -> tuple[str, Any]:
    """Return the root of an intervention, with the name that it was requested of."""
    below = getattr(act, "below", None)
    return (name, act) if below is None else lowest(*below)


def on(act: Any, below: tuple[str, Any] | None) -> Any:
    """Return an intervention with what lies below it; only a soft one depends on that."""
    same = not isinstance(act, SOFT) or act.below is below
    return act if same else act.model_copy(update={"below": below})


def has_times(request: Any) -> bool:
    """Return whether a request contains times, or plain data that may contain them."""
    if isinstance(request, Mapping):
        return "kind" in request or any(map(has_times, request.values()))
    if isinstance(request, list | tuple):
        return len(request) > 0 and isinstance(request[0], ACTS) and any(map(has_times, request))
    return isinstance(request, ACTS) and request.time is not None
