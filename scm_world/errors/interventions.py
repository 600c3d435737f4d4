"""Causal models that cannot be built, and interventions that are refused."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from scm_world.errors.base import ScmWorldError, nearest, suggested

SHOWN = 8
"""Near names that a message lists."""


class ModelError(ScmWorldError, ValueError):
    """A causal model that cannot be built.

    Attributes:
        problems: One sentence for each fault.
    """

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = tuple(problems)
        lines = "\n".join(f"  - {problem}" for problem in self.problems)
        super().__init__(f"the model has {len(self.problems)} problem(s):\n{lines}")


class CyclicModel(ModelError):
    """A causal model whose contemporaneous edges form cycles.

    Attributes:
        cycles: The variables of one cycle for each knot.
    """

    def __init__(self, cycles: Iterable[Sequence[str]]) -> None:
        self.cycles = tuple(tuple(cycle) for cycle in cycles)
        paths = (" → ".join([*cycle, cycle[0]]) for cycle in self.cycles)
        super().__init__([f"contemporaneous edges form a cycle: {path}" for path in paths])


class InterventionError(ScmWorldError, ValueError):
    """An intervention that was refused. Nothing has changed.

    Attributes:
        variable: The name of the variable.
        value: What was asked for.
    """

    def __init__(self, message: str, *, variable: str, value: Any = None) -> None:
        self.variable = variable
        self.value = value
        super().__init__(message)


class UnknownVariable(InterventionError):
    """No variable has this name.

    Attributes:
        near: Names of which this is the first or the last part, the shortest first.
        suggestion: The nearest name there is, or None.
    """

    def __init__(self, name: str, known: Iterable[str]) -> None:
        known = list(known)
        parts = (n for n in known if n.startswith(f"{name}.") or n.endswith(f".{name}"))
        self.near = tuple(sorted(parts, key=len))
        self.suggestion = self.near[0] if self.near else nearest(name, known)
        hint = suggested(self.suggestion)
        if self.near:
            more = f" and {len(self.near) - SHOWN} more" if len(self.near) > SHOWN else ""
            hint = f"; near it are: {', '.join(self.near[:SHOWN])}{more}"
        super().__init__(f"no variable is named {name!r}{hint}", variable=name)


class NotIntervenable(InterventionError):
    """The variable cannot be set.

    Attributes:
        causes: Variables that can be set instead.
    """

    def __init__(self, name: str, reason: str, causes: Iterable[str] = ()) -> None:
        self.causes = tuple(causes)
        instead = (
            f"; intervene on a cause of it instead: {', '.join(self.causes)}" if self.causes else ""
        )
        super().__init__(f"{name!r} {reason}{instead}", variable=name)


class WrongType(InterventionError):
    """The value is not a number of the declared dtype."""

    def __init__(self, name: str, value: Any, expected: str) -> None:
        self.expected = expected
        super().__init__(
            f"do({name}): expected {expected}, got {value!r} of type {type(value).__name__}",
            variable=name,
            value=value,
        )


class WrongShape(InterventionError):
    """The value has another shape than the variable.

    Attributes:
        expected: The shape of the variable.
        actual: The shape of the value.
    """

    def __init__(
        self, name: str, value: Any, expected: tuple[int, ...], actual: tuple[int, ...]
    ) -> None:
        self.expected = expected
        self.actual = actual
        super().__init__(
            f"do({name}): expected shape {expected}, got {actual}", variable=name, value=value
        )


class NotFinite(InterventionError):
    """The value has a NaN or an infinity."""

    def __init__(self, name: str, value: Any) -> None:
        super().__init__(
            f"do({name}): every number must be finite, got {value!r}", variable=name, value=value
        )


class _Outside(InterventionError):
    """A value outside what is allowed.

    Attributes:
        allowed: What is allowed, in words.
        nearest: The nearest value that is allowed.
    """

    def __init__(self, name: str, value: Any, *, allowed: str, nearest: Any, unit: str) -> None:
        self.allowed = allowed
        self.nearest = nearest
        unit = "" if unit in ("", "1") else f" [{unit}]"
        super().__init__(
            f"do({name}): {value!r} is outside {allowed}{unit}; the nearest allowed value is "
            f"{nearest!r}",
            variable=name,
            value=value,
        )


class OutOfBounds(_Outside):
    """The value is physically impossible."""


class OutOfSpace(_Outside):
    """The value is possible, but not in the space that was asked for.

    Attributes:
        space: ``"A"``, ``"B"`` or ``"A|B"``.
    """

    def __init__(
        self, name: str, value: Any, *, space: str, allowed: str, nearest: Any, unit: str
    ) -> None:
        self.space = space
        super().__init__(
            name, value, allowed=f"space {space} = {allowed}", nearest=nearest, unit=unit
        )


class ConflictingTargets(InterventionError):
    """Two targets of one do() are coordinates of one and the same quantity.

    Attributes:
        names: The targets that exclude each other.
    """

    def __init__(self, names: Sequence[str], quantity: str) -> None:
        self.names = tuple(names)
        super().__init__(
            f"{' and '.join(map(repr, self.names))} both set {quantity!r}; give one of them",
            variable=self.names[0],
        )


class ClosesCycle(InterventionError, ModelError):
    """A mechanism, or a draw from a space that follows others, closes a cycle.

    Attributes:
        cycle: The variables that would drive one another within an instant.
        problems: It as one sentence.
    """

    def __init__(self, name: str, value: Any, cycle: Sequence[str]) -> None:
        self.cycle = tuple(cycle)
        path = " → ".join([*self.cycle, self.cycle[0]])
        self.variable, self.value = name, value
        message = f"do({name}): contemporaneous edges would form a cycle: {path}"
        self.problems = (message,)
        Exception.__init__(self, message)  # that of a model counts its problems


class Infeasible(InterventionError):
    """The intervention would put two bodies in one place, or one outside the arena.

    Attributes:
        problems: One sentence for each pair of bodies that would overlap.
        nearest: The nearest value that is feasible, where one was found.
    """

    def __init__(self, name: str, value: Any, problems: Sequence[str], nearest: Any = None) -> None:
        self.problems = tuple(problems)
        self.nearest = nearest
        hint = f"; the nearest feasible value is {nearest!r}" if nearest is not None else ""
        super().__init__(
            f"do({name}): {value!r} is not feasible: {'; '.join(self.problems)}{hint}",
            variable=name,
            value=value,
        )


class SeveralProblems(InterventionError):
    """More than one problem in one do().

    Attributes:
        problems: The errors, in the order of the request.
    """

    def __init__(self, problems: Sequence[InterventionError]) -> None:
        self.problems = tuple(problems)
        lines = "\n".join(f"  - {problem}" for problem in self.problems)
        super().__init__(
            f"{len(self.problems)} problems, nothing was changed:\n{lines}",
            variable=self.problems[0].variable,
        )


def raise_all(problems: Sequence[InterventionError]) -> None:
    """Raise the one problem, or all of them together; nothing if there is none."""
    if len(problems) == 1:
        raise problems[0]
    if problems:
        raise SeveralProblems(problems)
