"""Interventions on a variable, as values.

A plain number or array is the hard intervention: the variable is cut from its parents and held
at this value. ``Shift`` and ``Scale`` keep the parents and change their effect; ``Draw`` cuts
them and draws. In a plan each has a time: ``Hard(0.2, at=10)``, ``Shift(0.1, during=(5, 9))``,
``Draw("A", every=25)``, ``Natural(when=Contact("robot", "tool_block"))``.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self, final

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

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
from scm_world.variables.times import TimedIntervention


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
        stream: Name of its noise: draws of the variable with one name give the same numbers. If
            None, the draws of a model have nothing in common with the variable's own noise.
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
        if not isinstance(source, Frozen | dict) and source not in SPACES:
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
        named = (parents,) if isinstance(parents, str | Parent) else tuple(parents)
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
    """Return a variable to its own structural equation, and end an earlier intervention on it."""

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
