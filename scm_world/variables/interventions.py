"""Interventions on a variable, as values.

A plain number or array is the hard intervention: the variable is cut from its parents and held
at this value. ``Shift`` and ``Scale`` keep the parents and change their effect; ``Draw`` cuts
them and draws. In a plan each has a time: ``Hard(0.2, at=10)``, ``Shift(0.1, during=(5, 9))``,
``Draw("A", every=25)``, ``Natural(when=Contact("robot", "tool_block"))``.

Each class is a kind of intervention and answers for itself; ``docs/extending.md`` adds one.
"""
# ruff: noqa: D102 # ``Intervention`` describes the methods

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from math import isfinite
from typing import Any, ClassVar, Literal, Self, final

import numpy as np
from pydantic import ConfigDict, model_validator

from scm_world._types import ArrayLike, Value
from scm_world.errors import (
    InterventionError,
    ModelError,
    UnknownOption,
    UnknownVariable,
    WrongValue,
    blamed,
)
from scm_world.variables.checks import check_bounds, check_draw, coerce
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
    parent_of,
)
from scm_world.variables.mechanisms import EQUATIONS, Equation, Function, check_order
from scm_world.variables.moments import Moment, NoiseKey
from scm_world.variables.open_kinds import OpenKinds
from scm_world.variables.spaces import Box, Frozen
from scm_world.variables.times import Short, Time


class Intervention(OpenKinds, Short):
    """The base class of interventions; a subclass with a ``kind`` of its own is a kind.

    One that replaces the mechanism of a variable answers with ``follows`` and ``equation``; one
    that acts on whatever lies below it is a ``Soft`` intervention. Each may have a time in the
    episode of a plan, given as ``at=``, ``during=``, ``every=`` or ``when=``.

    Attributes:
        time: At the beginning if None.
    """

    model_config = ConfigDict(allow_inf_nan=True)  # refused when it is done, as any value
    kinds: ClassVar[dict[str, type[Any]]] = {}
    is_soft: ClassVar[bool] = False
    """Whether it acts on what lies below it, and leaves the parents in place."""
    replaces: ClassVar[bool] = True
    """Whether nothing that lies below it counts."""
    draws: ClassVar[bool] = False
    """Whether it draws the variable."""
    computes: ClassVar[bool] = True
    """Whether it computes the variable with an equation of its own."""
    releases: ClassVar[bool] = False
    """Whether it ends an earlier intervention."""
    removes: ClassVar[bool] = False
    """Whether it takes an entity away."""

    time: Time | None = None
    kind: str  # here, since the noise of a curriculum is a function of its text

    def __init__(self, **fields: object) -> None:
        if given := {name: fields.pop(name) for name in Time.model_fields if name in fields}:
            fields["time"] = Time(**given)
        super().__init__(**fields)

    def holds(self, step: int) -> bool:
        """Return whether it has a window, and a control step lies in it."""
        return self.time is not None and self.time.holds(step)

    # --- what a kind answers ----------------------------------------------------------------------

    @property
    def constant(self) -> float | tuple[float, ...] | None:
        """The value that it sets, whatever else happens; None if it has no such value."""
        return None

    @property
    def equation(self) -> Equation:
        """The function by which it replaces that of the variable; its arguments are ``follows``."""
        raise ModelError([f"{self!r} has no equation"])

    def follows(self, variable: Variable) -> tuple[Parent, ...]:
        """Return the causes that it gives to a variable, in the order of its function."""
        return ()

    def value_of(self, variable: Variable, at: Moment) -> Value:
        """Compute what it makes of the variable that it was requested of."""
        arguments = map(np.array, at.arguments(self.follows(variable)))  # copies
        noise = at.noise(variable, self.noise_for(variable))
        with blamed(lambda: f"the function of {variable.name!r}"):
            found = self.equation.bind()(*arguments, **noise)
        value = np.asarray(found)
        if value.dtype.kind not in ("iuf" if variable.dtype == "real" else "biuf"):
            raise WrongValue(variable.name, found, f"numbers of shape {variable.shape}")
        if value.shape[value.ndim - len(variable.shape) :] != variable.shape:
            try:
                value = variable.array(value)
            except (TypeError, ValueError):
                raise WrongValue(variable.name, self, variable.shape, value.shape) from None
        if variable.dtype != "real":
            value = np.rint(value).astype(np.int64)
        variable.refuse_wrong(value)
        return value

    def checked(self, variable: Variable, declared: Mapping[str, Variable]) -> Intervention:
        """Return it complete, or refuse it for a variable of a model.

        Raises:
            InterventionError: It does not fit the variable, or follows an unknown one.
        """
        followed = self.follows(variable)
        for unknown in sorted(parent.name for parent in followed if parent.name not in declared):
            raise UnknownVariable(unknown, declared)
        own = (variable.name, *variable.parts)
        if self.computes and any(parent.name in own and not parent.lag for parent in followed):
            said = "a variable cannot follow itself within an instant; use Shift or Scale"
            raise self.refused(variable, said)
        return self

    def refused(self, variable: Variable, said: str) -> InterventionError:
        """Return the error that it does not fit a variable."""
        text = f"do({variable.name}): {said}"
        return InterventionError(text, variable=variable.name, value=self)

    @property
    def is_finite(self) -> bool:
        """Whether its numbers are finite; those of a file are."""
        fields = (vars(self)[name] for name in type(self).model_fields)
        several = (value if isinstance(value, tuple) else (value,) for value in fields)
        return all(isfinite(n) for value in several for n in value if isinstance(n, float))

    def describe(self) -> str:
        """Return a few words for a table of interventions, without the time."""
        hidden = ("kind", "time", "below")
        fields = (f"{name}={v!r}" for name, v in self.__repr_args__() if name not in hidden)
        return f"{type(self).__name__}({', '.join(fields)})"

    def divided(self, bundle: Variable) -> Mapping[str, Intervention]:
        """Return the interventions on the parts of a bundle that one on it stands for.

        By default each part has the same one. If the variable is not a bundle, it is on itself.
        """
        return dict.fromkeys(bundle.parts or (bundle.name,), self)

    def distribution(self, variable: Variable) -> Distribution | None:
        """Return the distribution that it draws a variable from; None if it does not draw it."""
        return None

    # --- noise ------------------------------------------------------------------------------------

    @property
    def has_draw(self) -> bool:
        """Whether it draws something itself: the variable, or what it moves that by."""
        return self.draws or self.relative is not None

    @property
    def relative(self) -> Distribution | None:
        """The distribution of a shift or factor that it draws."""
        return None

    @property
    def factor(self) -> float | None:
        """By what it multiplies linear weights of the parents that it leaves; None if unknown."""
        return 1.0

    @property
    def noise_inverse(self) -> InverseNoise | None:
        """How the noise follows from a value; see ``Derived.inverse_noise``."""
        return None

    @property
    def has_new_noise(self) -> bool:
        """Whether it brings noise of another distribution than the variable's."""
        return False

    def noise_for(self, variable: Variable) -> Distribution | None:
        """Return the distribution of the noise that its function takes."""
        return _noise_of_function(variable) if self.equation.takes_noise else None

    def keeps_function(self, variable: Variable | None = None) -> bool:
        """Return whether the function of the variable stays."""
        return self.is_soft

    def shares(self, variable: Variable) -> str | None:
        """Name a draw that several variables have in common; None if there is none."""
        return variable.name if self.computes and variable.parts else None

    def redrawn(self, name: str, change: Callable[[str, Draw], Draw]) -> Self:
        """Return it with changed draws, also of what lies below; each is called with its name."""
        return self

    def drawn_as(self, other: Intervention, *, again: bool) -> Self:
        """Return it with the noise, or the numbers, of one that was done in its place.

        Args:
            other: What was done.
            again: Whether it is drawn again later, so that it keeps its own draw.
        """
        return self

    def settled(self, variable: Variable, key: NoiseKey) -> Self:
        """Return it with numbers in place of what it draws to move a variable."""
        return self

    def in_context(self, kind: str) -> Self:
        """Return it as part of a context, where what it draws has noise of its own."""
        return self

    def joined(self, pattern: str) -> Self:
        """Return it for the variables that fit a pattern, which may share a draw."""
        return self

    # --- layers -----------------------------------------------------------------------------------

    @property
    def lower(self) -> tuple[str, Intervention] | None:
        """Name and intervention of the layer below, on which a soft one acts."""
        return None

    @property
    def root(self) -> Intervention:
        """The intervention that decides the mechanism: the lowest one that a soft one acts on."""
        return self

    def lowest(self, name: str) -> tuple[str, Intervention]:
        """Return the root, with the name that it was requested of."""
        return (name, self) if self.lower is None else self.lower[1].lowest(self.lower[0])

    def on(self, below: tuple[str, Intervention] | None) -> Self:
        """Return it with what lies below it; only a soft one depends on that."""
        return self

    def rooted(self, root: Intervention) -> Intervention:
        """Return it with another root."""
        if self.lower is None:
            return root
        return self.on((self.lower[0], self.lower[1].rooted(root)))

    def whole(self, name: str) -> str:
        """Name the bundle of which it sets a part; the variable itself if there is none."""
        return name


@final
class Hard(Intervention):
    """Set a variable to a value, independently of its parents."""

    computes = False
    kind: Literal["hard"] = "hard"
    value: AsNumber

    def __init__(self, value: object, **fields: object) -> None:
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

    @property
    def constant(self) -> float | tuple[float, ...]:
        return self.value

    def value_of(self, variable: Variable, at: Moment) -> Value:
        return variable.array(self.value)

    def checked(self, variable: Variable, declared: Mapping[str, Variable]) -> Intervention:
        value: Any = self.value
        if len(variable.shape) > 1 and np.size(value) == np.prod(variable.shape):
            value = np.reshape(value, variable.shape)
        return accepted(declared, variable, value)

    def describe(self) -> str:
        return np.array2string(np.asarray(self.value), precision=4, separator=", ", threshold=9)

    def divided(self, bundle: Variable) -> Mapping[str, Intervention]:
        return split(Hard, bundle, self.value) if bundle.parts else {bundle.name: self}


@final
class Draw(Intervention):
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

    draws = True
    computes = False
    kind: Literal["draw"] = "draw"
    source: SpaceName | Distribution
    stream: str | None = None
    of: str | None = None

    def __init__(self, source: object, high: object = None, **fields: object) -> None:
        source = source if high is None else Box(source, high)
        if not (isinstance(source, Frozen | dict) or str(source) in SPACES):
            raise UnknownOption("Draw(source)", source, (*SPACES, "a distribution, such as a Box"))
        super().__init__(source=source, **fields)

    def distribution(self, variable: Variable) -> Distribution:
        space = variable.space(self.source) if isinstance(self.source, str) else self.source
        if space is None:
            raise ModelError([f"{variable.name!r} has no space {self.source}"])
        return space

    def follows(self, variable: Variable) -> tuple[Parent, ...]:
        return tuple(map(parent_of, sorted(self.distribution(variable).parents())))

    def value_of(self, variable: Variable, at: Moment) -> Value:
        if (key := at.key) is None:
            raise ModelError([f"{variable.name!r} is drawn: solve needs a noise key to draw with"])
        source, stream = self.distribution(variable), self.stream
        if stream is None and key.origin is None and key.given is None:
            stream = "do"  # of a model; a world counts its draws
        return key.of(variable).draw(source, variable.name, variable.shape, at.values, stream)

    def checked(self, variable: Variable, declared: Mapping[str, Variable]) -> Intervention:
        check_draw(variable, self.source, self)
        return super().checked(variable, declared)

    def describe(self) -> str:
        return f"Draw({self.source!r})"

    def divided(self, bundle: Variable) -> Mapping[str, Intervention]:
        return _as_whole(self, bundle)

    def shares(self, variable: Variable) -> str | None:
        alone = isinstance(self.distribution(variable), Box)  # component by component
        return variable.name if variable.parts and not alone else None

    def redrawn(self, name: str, change: Callable[[str, Draw], Draw]) -> Self:
        return change(name, self)

    def drawn_as(self, other: Intervention, *, again: bool) -> Self:
        if not isinstance(other, Draw):
            return self
        return self.model_copy(update={"stream": other.stream})

    def whole(self, name: str) -> str:
        return self.of or name


@final
class Mechanism(Intervention):
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

    def __init__(self, function: object = None, parents: object = (), **fields: object) -> None:
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

    @property
    def equation(self) -> Equation:
        """The function; ``do`` has replaced None by that of the variable."""
        if self.function is None:
            raise ModelError(["a mechanism without a function is complete only in a model"])
        return self.function

    def follows(self, variable: Variable) -> tuple[Parent, ...]:
        return self.parents

    def checked(self, variable: Variable, declared: Mapping[str, Variable]) -> Intervention:
        own, noise = variable.equation, _noise_of_function(variable)
        if self.function is None:
            if noise is None:
                raise self.refused(variable, "it has no noise that could be another one")
            inverse, parents = variable.noise_inverse, variable.all_parents
            kept = {"function": own, "parents": parents, "inverse_noise": inverse}
            return self.model_copy(update=kept).checked(variable, declared)
        takes = self.equation.takes_noise
        if self.noise is not None and not takes:
            said = "its function does not take noise; give it an argument `noise`"
            raise self.refused(variable, said)
        lacks = self.noise is None and noise is None
        if lacks and takes and isinstance(self.equation, Function):
            said = "its function takes noise, of which there is none; give Mechanism(…, noise=…)"
            raise self.refused(variable, said)
        return super().checked(variable, declared)

    def describe(self) -> str:
        return f"a function of {', '.join(names(self.parents)) or 'nothing'}"

    def divided(self, bundle: Variable) -> Mapping[str, Intervention]:
        return _as_whole(self, bundle)

    @property
    def noise_inverse(self) -> InverseNoise | None:
        return self.inverse_noise

    @property
    def has_new_noise(self) -> bool:
        return self.noise is not None

    def noise_for(self, variable: Variable) -> Distribution | None:
        return self.noise if self.noise is not None else super().noise_for(variable)

    def keeps_function(self, variable: Variable | None = None) -> bool:
        return self.function is (None if variable is None else variable.equation)

    def whole(self, name: str) -> str:
        return self.of or name


@final
class Natural(Intervention):
    """End an earlier intervention on a variable: it is what the layers below make of it.

    That is its own structural equation, unless a context says otherwise; see ``Plan``.
    """

    replaces = computes = False
    releases = True
    kind: Literal["natural"] = "natural"


@final
class Null(Intervention):
    """Remove an entity: a block, an obstacle or a goal, by its name.

    It leaves the world and its graph, with everything that is computed from it, and comes back
    with the next episode.
    """

    computes = False
    removes = True
    kind: Literal["null"] = "null"

    def __init__(self, **fields: object) -> None:
        if fields.get("during") is not None:
            allowed = ("a value or an intervention on a variable", "Null(at=step)")
            raise UnknownOption("intervention of a window", "Null", allowed)
        super().__init__(**fields)

    def checked(self, variable: Variable, declared: Mapping[str, Variable]) -> Intervention:
        said = "a variable cannot be taken away; a body of a world can be"
        raise self.refused(variable, said)


def accepted(declared: Mapping[str, Variable], variable: Variable, value: object) -> Intervention:
    """Return a checked intervention: type, shape, finite, fixed bounds, known parents."""
    if isinstance(value, Intervention):
        refuse_time(variable.name, value)
        return value.checked(variable, declared)
    if type(value) is tuple:
        refuse_time(variable.name, value)
    number, bounds = coerce(variable, value), variable.bounds
    if bounds is not None and not bounds.parents() and not bounds.contains(number, {}):
        check_bounds(variable, number, {})
    return Hard.of(number)


def refuse_time(name: str, act: object) -> None:
    """Refuse an intervention with a time, or several, where there is no episode for it."""
    is_plan = isinstance(act, tuple) and any(isinstance(one, Intervention) for one in act)
    time = act.time if isinstance(act, Intervention) else None
    if is_plan or time is not None:
        said = "interventions one after another count" if is_plan else f"a time ({time}) counts"
        raise InterventionError(
            f"do({name}): {said} in the plan of an episode: give it to rollout, sample, effect or "
            "counterfactual, to given or reset(do=…) of a World, or to a curriculum",
            variable=name,
            value=act,
        )


def joined(act: object, pattern: str) -> Any:
    """Return an intervention by a pattern: what its variables share is a draw of this pattern."""
    if isinstance(act, list | tuple):
        return type(act)(joined(one, pattern) for one in act)
    return act.joined(pattern) if isinstance(act, Intervention) else act


def _noise_of_function(variable: Variable) -> Distribution | None:
    """Return the distribution of the noise that the function of a variable takes."""
    return None if variable.equation is None else variable.own_noise


def _as_whole(act: Draw | Mechanism, bundle: Variable) -> Mapping[str, Intervention]:
    """Divide what remains an intervention on the whole bundle; see ``Draw.of``."""
    whole = act.model_copy(update={"of": bundle.name}) if bundle.parts else act
    return dict.fromkeys(bundle.parts or (bundle.name,), whole)


def split(
    made: Callable[[object], Intervention], bundle: Variable, numbers: ArrayLike
) -> Mapping[str, Intervention]:
    """Divide numbers of a bundle, or the one for all of them, among its parts."""
    values = bundle.split(np.broadcast_to(numbers, bundle.shape))
    return {part: made(v.tolist()) for part, v in zip(bundle.parts, values, strict=True)}


def has_times(request: object) -> bool:
    """Return whether a request contains times, or plain data that may contain them."""
    if isinstance(request, Mapping):
        return "kind" in request or any(map(has_times, request.values()))
    if isinstance(request, list | tuple):
        acts = len(request) > 0 and isinstance(request[0], Intervention)
        return acts and any(map(has_times, request))
    return isinstance(request, Intervention) and request.time is not None
