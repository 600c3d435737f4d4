"""What can go wrong, and what to do about it.

Every error of the package carries its data as attributes and says what was given, what is
allowed and what to do::

    ScmWorldError
    ├── ModelError               a causal model that cannot be built (all its problems at once)
    │   └── FunctionFailure      a function of a user that raised an error
    ├── InterventionError        a do() that was refused; the world is as it was
    │   ├── UnknownVariable      no such name; the nearest one is suggested
    │   ├── NotIntervenable      the variable is measured, not set
    │   ├── WrongType            not a number, or not of the declared dtype
    │   ├── WrongShape
    │   ├── NotFinite            NaN or infinity
    │   ├── OutOfBounds          physically impossible
    │   ├── OutOfSpace           possible, but outside the space that was asked for
    │   ├── ConflictingTargets   two names of one quantity in the same do()
    │   ├── ClosesCycle          a mechanism that makes variables cause one another at lag 0
    │   ├── Infeasible           two bodies in one place, or a body outside the arena
    │   └── SeveralProblems      more than one of the above
    ├── ImpossibleObservation    values that a causal model cannot give (a ModelError)
    ├── CyclicModel              a causal model with contemporaneous cycles (a ModelError)
    ├── ActionError              an action the robot cannot take
    ├── NotReset                 a world that was never reset
    ├── UnknownOption            a task, backend, preset or mode that does not exist
    ├── EngineError              the physics engine
    │   ├── MissingEngine        it is not installed
    │   ├── MixedInstallation    two versions of it in one folder
    │   └── EngineFailure        it produced a state that is not finite
    ├── SnapshotMismatch         a snapshot of another scene
    ├── UnreadableFile           a file that is not what it should be
    ├── UnwritableFolder         a folder without room or permission
    ├── Forbidden                a question that a laboratory does not allow
    ├── BudgetExhausted          an experiment that costs more than is left
    ├── EvaluationError          an episode that could not be played, with its place
    ├── Diverged                 a training whose weights are no finite numbers any more
    └── MissingExtra             an optional package that is not installed
"""

from __future__ import annotations

import difflib
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Self

__all__ = [
    "ActionError",
    "BudgetExhausted",
    "ClosesCycle",
    "ConflictingTargets",
    "CyclicModel",
    "Diverged",
    "EngineError",
    "EngineFailure",
    "EvaluationError",
    "Forbidden",
    "FunctionFailure",
    "ImpossibleObservation",
    "Infeasible",
    "InterventionError",
    "MissingEngine",
    "MissingExtra",
    "MixedInstallation",
    "ModelError",
    "NotFinite",
    "NotIntervenable",
    "NotReset",
    "OutOfBounds",
    "OutOfSpace",
    "ScmWorldError",
    "SeveralProblems",
    "SnapshotMismatch",
    "UnknownOption",
    "UnknownVariable",
    "UnreadableFile",
    "UnwritableFolder",
    "WrongShape",
    "WrongType",
    "blamed",
    "in_one_line",
    "nearest",
    "raise_all",
]

SHOWN = 8
"""Near names that a message lists."""

DAMAGED: tuple[type[Exception], ...] = (
    OSError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    ArithmeticError,
    RuntimeError,
    MemoryError,
    EOFError,
    zlib.error,
    zipfile.BadZipFile,
)
"""What the standard library and NumPy raise where a file is not what it should be."""


def nearest(name: str, known: Iterable[str]) -> str | None:
    """Find the known name that looks most like ``name``.

    Example:
        >>> nearest("tool_blok.mass", ["tool_block.mass", "floor_friction"])
        'tool_block.mass'
    """
    matches = difflib.get_close_matches(str(name), list(known), n=1, cutoff=0.5)
    return matches[0] if matches else None


def suggested(suggestion: str | None) -> str:
    """Say it as a question; nothing if there is none."""
    return f"; did you mean {suggestion!r}?" if suggestion else ""


def _rebuild(kind: type[ScmWorldError], message: str, data: dict[str, Any]) -> ScmWorldError:
    """Make an error from its message and attributes, without its constructor."""
    error = kind.__new__(kind, message)
    error.args = (message,)  # an OSError takes no message before its constructor
    error.__dict__.update(data)
    return error


class ScmWorldError(Exception):
    """Anything this package raises on purpose. It can be pickled, attributes included."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (type(self), str(self), self.__dict__)


def in_one_line(error: Exception) -> str:
    """Write an error in one line; with its name, unless it is one of ours.

    Example:
        >>> in_one_line(KeyError("mass")), in_one_line(ScmWorldError("too heavy"))
        ("KeyError: 'mass'", 'too heavy')
    """
    text = " ".join(str(error).split())
    name = type(error).__name__
    return text if text and isinstance(error, ScmWorldError) else f"{name}: {text}".rstrip(": ")


# --- models and interventions -----------------------------------------------------------------


class ModelError(ScmWorldError, ValueError):
    """A causal model, a table or a graph that cannot be built or used.

    Attributes:
        problems: One sentence for each fault.
    """

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = tuple(problems)
        several = [f"{len(self.problems)} problems:", *(f"  - {one}" for one in self.problems)]
        super().__init__("\n".join(self.problems if len(self.problems) == 1 else several))


class FunctionFailure(ModelError):
    """A function of a user that raised an error, or gave what it must not give.

    Attributes:
        row: Of several worlds, the number of the one in which it happened.
    """

    row: int | None = None

    def __init__(self, problem: str) -> None:
        self.problems = (problem,)
        Exception.__init__(self, problem)  # it is one sentence, and not about a declaration

    @classmethod
    def of(cls, name: str, error: Exception) -> Self:
        """Return the one that names who raised an error."""
        return cls(f"{name} raised {in_one_line(error)}")


class blamed:  # noqa: N801 # used like the functions of ``contextlib``
    """Name a function, module or policy of a user in the errors that it raises.

    Errors of this package pass through as they are.

    Args:
        name: Begins the message; or a function that gives it, where this is done often.

    Raises:
        FunctionFailure: Another error was raised, which is its cause.

    Example:
        >>> with blamed("the policy 'mine'"):
        ...     {}["speed"]
        Traceback (most recent call last):
        scm_world.errors.FunctionFailure: the policy 'mine' raised KeyError: 'speed'
    """

    def __init__(self, name: str | Callable[[], str]) -> None:
        self.name = name

    def __enter__(self) -> None:
        """Do nothing."""

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        """Name it in an error."""
        if isinstance(error, Exception) and not isinstance(error, ScmWorldError):
            name = self.name() if callable(self.name) else self.name
            raise FunctionFailure.of(name, error) from error


class ImpossibleObservation(ModelError):
    """An observation that the model cannot give.

    Attributes:
        variable: The variable that was observed.
    """

    def __init__(self, variable: str, reason: str) -> None:
        self.variable = variable
        super().__init__([f"{variable!r}: {reason}"])


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
    """No variable has this name, or fits this pattern.

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
        said = f"is named {name!r}"
        if {*"*?"} & {*str(name)}:
            ends = (f"*.{one.rpartition('.')[2]}" for one in known if "." in one)
            patterns = [*dict.fromkeys(ends)] or known
            self.suggestion = next(iter(difflib.get_close_matches(name, patterns, 1, 0.75)), None)
            more = ", …" if len(patterns) > SHOWN else ""
            shown = f"; there are: {', '.join(patterns[:SHOWN])}{more}"
            hint, said = suggested(self.suggestion) or shown, f"fits the pattern {name!r}"
        super().__init__(f"no variable {said}{hint}", variable=name)


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


# --- engines ----------------------------------------------------------------------------------


class EngineError(ScmWorldError, RuntimeError):
    """The physics engine cannot do its work.

    Attributes:
        engine: The name of the backend.
    """

    def __init__(self, message: str, engine: str) -> None:
        self.engine = engine
        super().__init__(message)


class MissingEngine(EngineError, ImportError):
    """The engine is not installed.

    Attributes:
        install: The command that installs it.
    """

    def __init__(self, engine: str, install: str, reason: str = "") -> None:
        self.install = install
        because = f" ({reason})" if reason else ""
        EngineError.__init__(
            self, f"the {engine} engine is not installed{because}; try: {install}", engine
        )


class MixedInstallation(EngineError):
    """Two versions of an engine lie in one folder.

    Attributes:
        versions: What was found, by distribution.
        repair: The command that repairs it.
    """

    def __init__(self, engine: str, versions: dict[str, str], repair: str) -> None:
        self.versions = dict(versions)
        self.repair = repair
        found = ", ".join(f"{name} {version}" for name, version in versions.items())
        super().__init__(
            f"the {engine} installation mixes versions ({found}); repair it with: {repair}", engine
        )


class EngineFailure(EngineError):
    """The engine produced a state that is not finite.

    Attributes:
        unmoved: Of a batch, the numbers of the scenes that are as they were.
    """

    unmoved: tuple[int, ...] = ()


class SnapshotMismatch(ScmWorldError, ValueError):
    """A snapshot of another scene cannot be restored here."""


# --- wrong options, actions, files, budgets and extras ------------------------------------------


class ActionError(ScmWorldError, ValueError):
    """An action that the robot cannot take.

    Attributes:
        action: What was given.
    """

    def __init__(self, message: str, action: Any) -> None:
        self.action = action
        super().__init__(message)


class NotReset(ScmWorldError, RuntimeError):
    """The world was never reset, or was ``closed``: nothing to step, ask or intervene on."""

    def __init__(self, *, closed: bool = False) -> None:
        self.closed = closed
        why = "was closed, which ended its episode; call reset() to begin another one"
        why = why if closed else "has no episode yet; call reset() first"
        super().__init__(f"the world {why}")


class UnknownOption(ScmWorldError, ValueError):
    """A name that is none of the choices.

    Attributes:
        option: What is being chosen, for example ``"task"``.
        value: What was given.
        choices: What there is.
    """

    def __init__(self, option: str, value: Any, choices: Iterable[str]) -> None:
        self.option = option
        self.value = value
        self.choices = tuple(choices)
        what = f"{option} cannot be {value!r}; it can be"
        if isinstance(value, str) and not any(" " in choice for choice in self.choices):
            near = suggested(nearest(value, self.choices))
            what = f"no {option} is named {value!r}{near}; there are"
        super().__init__(f"{what}: {', '.join(self.choices)}")


class UnreadableFile(ScmWorldError, ValueError):
    """A file (``path``) that is not what it should be (``reason``)."""

    def __init__(self, path: str, reason: str, advice: str) -> None:
        self.path, self.reason = path, reason
        super().__init__(f"{path!r} cannot be read: {reason}; {advice}")


class UnwritableFolder(ScmWorldError, OSError):
    """A folder (``path``) that cannot be written to, or not any more (``reason``)."""

    def __init__(self, path: str, reason: str) -> None:
        self.path, self.reason = path, reason
        super().__init__(
            f"{path!r} cannot be written to: {reason}; what is in it already is complete, and the "
            "same call goes on there once there is room, or the permission"
        )


class Forbidden(ScmWorldError, RuntimeError):
    """A question that a laboratory does not allow; ``allowed`` says what it does."""

    def __init__(self, what: str, allowed: Iterable[str]) -> None:
        self.what, self.allowed = what, tuple(allowed)
        shown = ", ".join(self.allowed[:20]) + (", …" if len(self.allowed) > 20 else "")
        super().__init__(f"this laboratory does not let you {what}; allowed: {shown or 'nothing'}")


class BudgetExhausted(ScmWorldError, RuntimeError):
    """An experiment that costs more episodes (``asked``) than there are left (``left``)."""

    def __init__(self, asked: int, left: int) -> None:
        self.asked, self.left = asked, left
        super().__init__(
            f"the experiment takes {asked} episodes, but {left} are left of the budget; ask for "
            "fewer, or open a laboratory with a larger budget on the same log"
        )


class EvaluationError(ScmWorldError, RuntimeError):
    """An episode of an evaluation that could not be played.

    Attributes:
        place: Agent, engine, protocol, seed, episode and control step, by name.
        reason: What went wrong.
    """

    def __init__(self, place: Mapping[str, Any], reason: str) -> None:
        self.place = dict(place)
        self.reason = reason
        where = ", ".join(f"{name} {value}" for name, value in self.place.items())
        super().__init__(f"{where}: {reason}")


class Diverged(ScmWorldError, ArithmeticError):
    """A training whose weights are no finite numbers any more, after so many ``steps``."""

    def __init__(self, steps: int) -> None:
        self.steps = steps
        super().__init__(
            f"the weights are no finite numbers any more after {steps:,} steps; the last "
            "checkpoint is from before; begin in another folder with a lower learning rate "
            "(rate.initial) or smaller rewards"
        )


class MissingExtra(ScmWorldError, ImportError):
    """An optional package that is not installed.

    Attributes:
        package: Its name.
        extra: The extra of this package that brings it; None if none does.
    """

    def __init__(self, package: str, extra: str | None = None) -> None:
        self.package, self.extra = package, extra
        install = package if extra is None else f"'scm-world[{extra}]'"
        super().__init__(
            f"this needs the package {package!r}; install it with: pip install {install}"
        )
