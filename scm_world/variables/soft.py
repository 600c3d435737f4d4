"""Interventions that change the value which a variable would have; its parents remain causes."""
# ruff: noqa: D102 # ``Intervention`` describes the methods

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, Self, final

import numpy as np
from pydantic import BeforeValidator, model_validator

from scm_world._types import Value
from scm_world.errors import ModelError, UnknownOption
from scm_world.variables.checks import check_draw, coerce
from scm_world.variables.distributions import Distribution
from scm_world.variables.interventions import Draw, Intervention, split
from scm_world.variables.kinds import AsNumber, Variable
from scm_world.variables.moments import Moment, NoiseKey


class Soft(Intervention):
    """Base class of interventions that change the value which a variable would have.

    A subclass answers with ``moved``. It acts on whatever lies below: nature's draw, a mechanism, a
    given value, or another soft intervention of a lower layer.

    Attributes:
        below: Name and intervention of a lower layer, on which it acts; the variable's own
            mechanism if None. A plan sets it.
    """

    is_soft = True
    replaces = False
    computes = False
    below: tuple[str, Intervention] | None = None

    def moved(self, value: Value, variable: Variable, at: Moment) -> Value:
        """Return what it makes of the value that the variable would have, shape ``(..., *shape)``.

        Whole numbers and categories are rounded afterwards.
        """
        text = f"the kind {self.kind!r} has no method moved(value, variable, at)"
        raise ModelError([f"{text}: define it in {type(self).__name__}"])

    def undone(self, value: Value, name: str) -> Value:
        """Return the value before it, from the one that was observed, for counterfactuals.

        Raises:
            ModelError: The value before it is not known.
        """
        text = f"{name!r} was observed under {self!r}, which does not tell the value without it"
        raise ModelError([f"{text}: leave it out, or give NaN"])

    def checked(self, variable: Variable, declared: Mapping[str, Variable]) -> Intervention:
        if variable.dtype == "categorical":
            said = f"categories have no order, so there is no {self!r}; set a category, Draw one, "
            raise self.refused(variable, said + "or give a Mechanism")
        return super().checked(variable, declared)

    @property
    def factor(self) -> float | None:
        return None

    @property
    def lower(self) -> tuple[str, Intervention] | None:
        return self.below

    @property
    def root(self) -> Intervention:
        return self if self.below is None else self.below[1].root

    def on(self, below: tuple[str, Intervention] | None) -> Self:
        return self if self.below is below else self.model_copy(update={"below": below})

    def redrawn(self, name: str, change: Callable[[str, Draw], Draw]) -> Self:
        if self.below is None:
            return self
        asked, act = self.below
        return self.on((asked, act.redrawn(asked, change)))


class _Relative(Soft):
    """Move a variable by a number, or by a draw of it."""

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

    def amount(self, variable: Variable, key: NoiseKey | None) -> Value:
        """Return the number, drawn where it is a draw.

        A draw that variables share is one number for each episode, for all components.
        """
        by = self.by
        if not isinstance(by, Draw):
            return np.asarray(by)
        if key is None:
            raise ModelError([f"{variable.name!r} is changed by a draw: solve needs a noise key"])
        name, shape = (self.shared, ()) if self.shared else (variable.name, variable.shape)
        source, stream = by.distribution(variable), by.stream or "by"
        drawn = key.of(variable).draw(source, str(name), shape, {}, stream)
        ones = (1,) * len(variable.shape) if self.shared and drawn.ndim else ()
        return drawn.reshape(drawn.shape + ones)

    def known(self, name: str) -> Value:
        """Return the number, for an observed variable."""
        if isinstance(self.by, Draw):
            text = f"{name!r} was observed under {self!r}, whose draw is not known"
            raise ModelError([f"{text}: give the number that was drawn"])
        return np.asarray(self.by)

    def checked(self, variable: Variable, declared: Mapping[str, Variable]) -> Intervention:
        found = super().checked(variable, declared)
        if isinstance(self.by, Draw):
            alike = self.shared or variable.parts
            check_draw(variable, self.by.source, self.by, () if alike else variable.shape)
        else:
            coerce(variable, self.by if np.ndim(self.by) else np.full(variable.shape, self.by))
        return found

    def describe(self) -> str:
        by = self.by.describe() if isinstance(self.by, Draw) else self.by
        return f"{type(self).__name__}({by}{', shared' if self.shared else ''})"

    def divided(self, bundle: Variable) -> Mapping[str, Intervention]:
        by = self.by
        if isinstance(by, Draw) or not bundle.parts:  # each part has its draw
            return super().divided(bundle)
        return split(type(self), bundle, by)

    @property
    def relative(self) -> Distribution | None:
        return self.by.source if isinstance(self.by, Draw) else None  # type: ignore[return-value] # no name of a space

    def shares(self, variable: Variable) -> str | None:
        return str(self.shared) if self.shared else None

    def redrawn(self, name: str, change: Callable[[str, Draw], Draw]) -> Self:
        found = super().redrawn(name, change)
        if not isinstance(self.by, Draw):
            return found
        return found.model_copy(update={"by": change(f"by {self.shared or name}", self.by)})

    def drawn_as(self, other: Intervention, *, again: bool) -> Self:
        if again or not isinstance(other, _Relative):
            return self
        return self.model_copy(update={"by": other.by, "shared": other.shared})

    def settled(self, variable: Variable, key: NoiseKey) -> Self:
        if not isinstance(self.by, Draw):
            return self
        made: Any = type(self)
        return made(self.amount(variable, key), below=self.below)  # type: ignore[no-any-return]

    def in_context(self, kind: str) -> Self:
        if not isinstance(self.by, Draw) or self.by.stream is not None:
            return self
        by = self.by.model_copy(update={"stream": f"by in {kind}"})
        return self.model_copy(update={"by": by})

    def joined(self, pattern: str) -> Self:
        return self.model_copy(update={"shared": pattern}) if self.shared is True else self


@final
class Shift(_Relative):
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

    def __init__(self, by: object, **fields: object) -> None:
        super().__init__(by=by, **fields)

    def moved(self, value: Value, variable: Variable, at: Moment) -> Value:
        return value + self.amount(variable, at.key)

    def undone(self, value: Value, name: str) -> Value:
        return value - self.known(name)

    @property
    def factor(self) -> float | None:
        return 1.0


@final
class Scale(_Relative):
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

    def __init__(self, by: object, **fields: object) -> None:
        super().__init__(by=by, **fields)

    def moved(self, value: Value, variable: Variable, at: Moment) -> Value:
        return value * self.amount(variable, at.key)

    def undone(self, value: Value, name: str) -> Value:
        by = self.known(name)
        if not by.all():
            text = f"{name!r} was observed under Scale(0), which removes all information about it"
            raise ModelError([f"{text}: leave it out, or give NaN"])
        return value / by

    @property
    def factor(self) -> float | None:
        return float(self.by) if isinstance(self.by, int | float) else None
