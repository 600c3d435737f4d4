"""Errors of the package: each carries its data, and names the fault and the allowed values."""

from __future__ import annotations

import difflib
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from traceback import walk_tb
from typing import TYPE_CHECKING, Any

__all__ = [
    "ActionError",
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
    "InexactEngine",
    "Infeasible",
    "InterventionError",
    "MissingEngine",
    "MissingExtra",
    "ModelError",
    "NotIntervenable",
    "NotReset",
    "OutOfBounds",
    "ScmWorldError",
    "SeveralProblems",
    "SnapshotMismatch",
    "UnknownOption",
    "UnknownVariable",
    "UnreadableFile",
    "UnwritableFolder",
    "WrongValue",
]

SHOWN, MOST = 8, 40
"""Near names, or problems, that a message lists; names up to which it lists all."""

_OURS = {*sys.stdlib_module_names, "scm_world", "numpy", "pandas", "pydantic"}


def nearest(name: str, known: Iterable[str]) -> str | None:
    """Return the known name that looks most like ``name``.

    Example:
        >>> nearest("tool_blok.mass", ["tool_block.mass", "floor_friction"])
        'tool_block.mass'
    """
    matches = difflib.get_close_matches(str(name), list(known), n=1, cutoff=0.5)
    return matches[0] if matches else None


def some(names: Sequence[str], most: int = 4) -> str:
    """Return the first names, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def endings(names: Iterable[str]) -> list[str]:
    """Return the patterns of attributes that some names have; the names, if they have none."""
    known = [*names]
    return [*dict.fromkeys(f"*.{n.rpartition('.')[2]}" for n in known if "." in n)] or known


def _suggested(suggestion: str | None) -> str:
    return f"; did you mean {suggestion!r}?" if suggestion else ""


def in_one_line(error: BaseException) -> str:
    """Return an error in one line; with its name, unless it is one of ours."""
    text = " ".join(str(error).split())
    name = type(error).__name__
    return text if text and isinstance(error, ScmWorldError) else f"{name}: {text}".rstrip(": ")


def _rebuild(kind: type[ScmWorldError], message: str, data: dict[str, Any]) -> ScmWorldError:
    error = kind.__new__(kind, message)
    error.args = (message,)  # an OSError takes no message before its constructor
    error.__dict__.update(data)
    return error


class _Rebuilt(type):
    """Lets ``kind(error)`` return an error of that kind, as Gymnasium's ``AsyncVectorEnv`` does."""

    def __call__(cls, *given: object, **named: object) -> Any:
        is_one = len(given) == 1 and type(given[0]) is cls and not named
        return given[0] if is_one else super().__call__(*given, **named)


class ScmWorldError(Exception, metaclass=_Rebuilt):
    """Base class of the errors of this package. They can be pickled, attributes included.

    Args:
        message: The given value, the allowed ones, and the remedy.
        data: Its attributes.

    Attributes:
        scenes: The numbers of the scenes that refused, where a call was about several of them.
    """

    scenes: tuple[int, ...] = ()

    def __init__(self, message: str = "", **data: object) -> None:
        self.__dict__.update(data)
        super().__init__(message)

    if TYPE_CHECKING:  # each class names its attributes

        def __getattr__(self, name: str) -> Any: ...

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (type(self), str(self), self.__dict__)


class ModelError(ScmWorldError, ValueError):
    """A faulty causal model, table or graph; ``problems`` lists all its faults."""

    def __init__(self, problems: Sequence[str], **data: object) -> None:
        several = [f"{len(problems)} problems:", *(f"  - {one}" for one in problems)]
        message = "\n".join(problems if len(problems) == 1 else several)
        super().__init__(message, problems=tuple(problems), **data)


class FunctionFailure(ModelError):
    """A function of a user that raised an error, or returned a wrong value.

    Attributes:
        row: The number of the world in which it happened, if there are several.
    """

    row: int | None = None

    def __init__(self, problem: str) -> None:
        super().__init__([problem])


def is_of_user(error: BaseException) -> bool:
    """Return whether code was running that is not of this package or of its libraries."""
    frames = (frame.f_globals.get("__name__", "") for frame, _ in walk_tb(error.__traceback__))
    return not all(name.partition(".")[0] in _OURS for name in frames)


@contextmanager
def blamed(name: str | Callable[[], str]) -> Iterator[None]:
    """Name a function, module or policy of a user in the errors that it raises.

    Args:
        name: The beginning of the message; or a function that returns it, where this is done often.

    Raises:
        FunctionFailure: Another error than those of this package was raised, which is its cause.

    Example:
        >>> with blamed("the policy 'mine'"):
        ...     {}["speed"]
        Traceback (most recent call last):
        scm_world.errors.FunctionFailure: the policy 'mine' raised KeyError: 'speed'
    """
    try:
        yield
    except ScmWorldError:
        raise
    except Exception as error:
        who = name() if callable(name) else name
        raise FunctionFailure(f"{who} raised {in_one_line(error)}") from error


class ImpossibleObservation(ModelError):
    """An observation of a ``variable`` that is impossible in the model."""

    def __init__(self, variable: str, reason: str) -> None:
        super().__init__([f"{variable!r}: {reason}"], variable=variable)


class CyclicModel(ModelError):
    """A causal model whose contemporaneous edges form ``cycles``, one for each component."""

    def __init__(self, cycles: Iterable[Sequence[str]]) -> None:
        found = tuple(tuple(cycle) for cycle in cycles)
        paths = (" → ".join([*cycle, cycle[0]]) for cycle in found)
        said = [f"contemporaneous edges form a cycle: {path}" for path in paths]
        super().__init__(said, cycles=found)


class InterventionError(ScmWorldError, ValueError):
    """An intervention of a ``value`` on a ``variable`` that was refused. Nothing has changed."""

    def __init__(
        self, message: str, *, variable: str, value: object = None, **data: object
    ) -> None:
        super().__init__(message, variable=variable, value=value, **data)


class UnknownVariable(InterventionError, KeyError):
    """No variable has this name, or fits this pattern.

    ``near`` are names of which it is the first or the last part, the shortest first; ``suggestion``
    is the nearest name there is, or None.
    """

    def __init__(self, name: str, known: Iterable[str]) -> None:
        known = list(known)
        parts = (n for n in known if n.startswith(f"{name}.") or n.endswith(f".{name}"))
        near = tuple(sorted(parts, key=len))
        suggestion = near[0] if near else nearest(name, known)
        hint, said = _suggested(suggestion), f"is named {name!r}"
        if near:
            hint = f"; near it are: {', '.join(near[:SHOWN])}"
            hint += f" and {len(near) - SHOWN} more" * (len(near) > SHOWN)
        if {*"*?"} & {*str(name)}:
            patterns = endings(known)
            suggestion = next(iter(difflib.get_close_matches(str(name), patterns, 1, 0.75)), None)
            shown = f"; there are: {', '.join(patterns[:SHOWN])}" + ", …" * (len(patterns) > SHOWN)
            hint, said = _suggested(suggestion) or shown, f"fits the pattern {name!r}"
        message = f"no variable {said}{hint}"
        super().__init__(message, variable=name, near=near, suggestion=suggestion)

    __str__ = Exception.__str__  # that of a KeyError would quote it


class NotIntervenable(InterventionError):
    """The variable cannot be set; ``causes`` of it can."""

    def __init__(self, name: str, reason: str, causes: Iterable[str] = ()) -> None:
        causes = tuple(causes)
        instead = f"; intervene on a cause of it instead: {', '.join(causes)}" if causes else ""
        super().__init__(f"{name!r} {reason}{instead}", variable=name, causes=causes)


class WrongValue(InterventionError):
    """The value is not of the ``expected`` dtype or shape, or not finite."""

    def __init__(
        self, name: str, value: object, expected: object = None, actual: object = None
    ) -> None:
        said = f"expected {expected}, got {value!r} of type {type(value).__name__}"
        if actual is not None:
            said = f"expected shape {expected}, got {actual}"
        elif expected is None:
            said = f"every number must be finite, got {value!r}"
        data = {"expected": expected, "actual": actual}
        super().__init__(f"do({name}): {said}", variable=name, value=value, **data)


class OutOfBounds(InterventionError):
    """The value is physically impossible, or not in the space that was asked for.

    Attributes:
        allowed: The allowed values, in words.
        nearest: The nearest of them.
        space: ``"A"``, ``"B"`` or ``"A|B"``; empty if the value is impossible.
    """

    def __init__(
        self, name: str, value: object, *, allowed: str, nearest: object, unit: str, space: str = ""
    ) -> None:
        allowed = f"space {space} = {allowed}" if space else allowed
        unit = "" if unit in ("", "1") else f" [{unit}]"
        message = f"do({name}): {value!r} is outside {allowed}{unit}"
        message += f"; the nearest allowed value is {nearest!r}"
        data = {"allowed": allowed, "nearest": nearest, "space": space}
        super().__init__(message, variable=name, value=value, **data)


class ConflictingTargets(InterventionError):
    """Targets of one do(), their ``names``, are coordinates of one and the same quantity."""

    def __init__(self, names: Sequence[str], quantity: str) -> None:
        message = f"{' and '.join(map(repr, names))} both set {quantity!r}; give one of them"
        super().__init__(message, variable=names[0], names=tuple(names))


class ClosesCycle(InterventionError, ModelError):
    """A mechanism, or a draw from a space that follows others, closes a ``cycle``."""

    def __init__(self, name: str, value: object, cycle: Sequence[str]) -> None:
        said = f"do({name}): contemporaneous edges would form a cycle: "
        said += " → ".join([*cycle, cycle[0]])
        data = {"cycle": tuple(cycle), "problems": (said,)}
        ScmWorldError.__init__(self, said, variable=name, value=value, **data)


class Infeasible(InterventionError):
    """The intervention would put two bodies in one place, or one outside the arena.

    Attributes:
        problems: One sentence for each pair of bodies that would overlap.
        nearest: The nearest value that is feasible, where one was found; it is searched for when
            it, or the message, is first read.
    """

    def __init__(
        self, name: str, value: object, problems: Sequence[str], nearest: object = None
    ) -> None:
        message = f"do({name}): {value!r} is not feasible: {'; '.join(problems)}"
        super().__init__(message, variable=name, value=value, problems=tuple(problems))
        self._search = nearest if callable(nearest) else lambda: nearest

    @cached_property
    def nearest(self) -> Any:
        """The nearest value that is feasible, or None."""
        return self._search()

    def __str__(self) -> str:
        hint = f"; the nearest feasible value is {self.nearest!r}"
        return super().__str__() + (hint if self.nearest is not None else "")

    def __reduce__(self) -> tuple[Any, ...]:
        data = {**vars(self), "nearest": self.nearest}
        return _rebuild, (type(self), *self.args, {n: data[n] for n in data if n != "_search"})


class SeveralProblems(InterventionError):
    """Several ``problems`` in one do(), in the order of the request."""

    def __init__(self, problems: Sequence[InterventionError]) -> None:
        lines = [f"  - {problem}" for problem in problems[:SHOWN]]
        kinds = Counter(type(problem).__name__ for problem in problems[SHOWN:])
        if kinds:
            lines += [f"  - and {', '.join(f'{n} more {kind}' for kind, n in kinds.items())}"]
        message = "\n".join((f"{len(problems)} problems, nothing was changed:", *lines))
        super().__init__(message, variable=problems[0].variable, problems=tuple(problems))


def raise_all(problems: Sequence[InterventionError]) -> None:
    """Raise the one problem, or all of them together; do nothing without any."""
    if problems:
        raise problems[0] if len(problems) == 1 else SeveralProblems(problems)


class EngineError(ScmWorldError, RuntimeError):
    """The physics ``engine`` cannot do its work."""

    def __init__(self, message: str, engine: str, **data: object) -> None:
        super().__init__(message, engine=engine, **data)


class MissingEngine(EngineError, ImportError):
    """The engine is not installed, or not rightly; ``install`` is the command that does it."""

    def __init__(self, engine: str, install: str, reason: str = "") -> None:
        because = f" ({reason})" if reason else ""
        message = f"the {engine} engine is not installed{because}; try: {install}"
        super().__init__(message, engine, install=install)


class EngineFailure(EngineError):
    """The engine could not step, or lost the state: it is not finite any more, or unstable.

    Attributes:
        unmoved: The numbers of the scenes of a batch that did not change.
        lost: The numbers of the scenes whose state is lost, also where it is finite; 0 if alone.
        row: The number of the first scene of a batch that failed.
        diverged: Whether nothing else is wrong than that states grew beyond all bounds.
    """

    unmoved: tuple[int, ...] = ()
    lost: tuple[int, ...] = ()
    row: int = 0
    diverged: bool = False

    def after(self, earlier: EngineFailure | None) -> EngineFailure:
        """Return the worse one of this failure and an earlier one, with the scenes of both."""
        if earlier is None:
            return self
        worse = self if earlier.diverged and not self.diverged else earlier
        worse.lost, worse.unmoved = earlier.lost + self.lost, earlier.unmoved + self.unmoved
        return worse


class InexactEngine(EngineError):
    """A question that compares equal runs bit for bit, which they are not on the engine.

    Attributes:
        question: The question, in words.
        floor: How far apart equal runs may be there, or how far it may change what does not
            follow from a change.
        exact: The engines that can answer it.
    """

    def __init__(
        self,
        question: str,
        engine: str,
        floor: float,
        exact: Iterable[str],
        *,
        couples: bool = False,
    ) -> None:
        names = ", ".join(exact := tuple(exact)) or "no other one is installed"
        needs, apart = "equal runs to be equal bit for bit", f"be {floor:g} apart"
        if couples:
            needs = "bodies that do not touch to leave one another alone"
            apart = f"change one another by {floor:g} in each control step"
        message = f"{question} needs {needs}, and on {engine!r} they may {apart}; use a backend "
        message += f"that is exact: {names}"
        super().__init__(message, engine, question=question, floor=floor, exact=exact)


class SnapshotMismatch(ScmWorldError, ValueError):
    """A snapshot of another scene cannot be restored here."""


class ActionError(ScmWorldError, ValueError):
    """An ``action`` that the robot cannot take."""

    def __init__(self, message: str, action: object) -> None:
        super().__init__(message, action=action)


class NotReset(ScmWorldError, RuntimeError):
    """The world was never reset, or was ``closed``: nothing to step, ask or intervene on."""

    def __init__(self, *, closed: bool = False) -> None:
        why = "was closed, which ended its episode; call reset() to begin another one"
        why = why if closed else "has no episode yet; call reset() first"
        super().__init__(f"the world {why}", closed=closed)


class UnknownOption(ScmWorldError, ValueError):
    """A value of an option that is not among its choices.

    Attributes:
        option: The name of the option, for example ``"task"``.
        value: The given value.
        choices: The allowed values.
    """

    def __init__(self, option: str, value: object, choices: Iterable[object]) -> None:
        names, what = tuple(map(str, choices)), f"{option} cannot be {value!r}; it can be"
        shown = endings(names) if isinstance(value, str) and "*" in value else [*names]
        if isinstance(value, str) and not any(" " in choice for choice in shown):
            what = f"no {option} is named {value!r}{_suggested(nearest(value, shown))}; there are"
        if len(shown) > MOST:
            near = difflib.get_close_matches(str(value), shown, SHOWN, 0.3) or shown[:SHOWN]
            shown = [*near, f"and {len(shown) - len(near)} more"]
        message = f"{what}: {', '.join(shown)}"
        super().__init__(message, option=option, value=value, choices=names)


class UnreadableFile(ScmWorldError, ValueError):
    """A file (``path``) that is damaged or of another kind (``reason``)."""

    def __init__(self, path: str, reason: str, advice: str) -> None:
        message = f"{path!r} cannot be read: {reason}; {advice}"
        super().__init__(message, path=path, reason=reason)


@contextmanager
def reading(path: object, advice: str) -> Iterator[None]:
    """Raise whatever error the reading of a file raises as an ``UnreadableFile``."""
    try:
        yield
    except Exception as error:
        raise UnreadableFile(str(path), in_one_line(error), advice) from error


class UnwritableFolder(ScmWorldError, OSError):
    """A folder (``path``) that cannot be written to, or not any more (``reason``)."""

    def __init__(self, path: str, reason: str, advice: str = "") -> None:
        resume = "its files are complete, and the same call goes on there once there is room, or"
        advice = advice or f"{resume} the permission"
        message = f"{path!r} cannot be written to: {reason}; {advice}"
        super().__init__(message, path=path, reason=reason)


class Forbidden(ScmWorldError, RuntimeError):
    """A request that a laboratory does not allow; ``allowed`` lists its variables."""

    def __init__(self, what: str, allowed: Iterable[str]) -> None:
        allowed = tuple(allowed)
        shown = ", ".join(allowed[:20]) + (", …" if len(allowed) > 20 else "")
        message = f"this laboratory does not let you {what}; allowed: {shown or 'nothing'}"
        super().__init__(message, what=what, allowed=allowed)


class EvaluationError(ScmWorldError, RuntimeError):
    """An episode of an evaluation that could not be played.

    Attributes:
        place: Agent, engine, protocol, seed, episode and control step, by name.
        reason: What went wrong.
    """

    def __init__(self, place: Mapping[str, Any], reason: str) -> None:
        where = ", ".join(f"{name} {value}" for name, value in place.items())
        super().__init__(f"{where}: {reason}", place=dict(place), reason=reason)


class Diverged(ScmWorldError, ArithmeticError):
    """A training whose weights are not finite any more, after so many ``steps``."""

    def __init__(self, steps: int) -> None:
        super().__init__(
            f"the weights are not finite any more after {steps:,} steps; the last "
            "checkpoint is from before; begin in another folder with a lower learning rate "
            "(rate.initial) or smaller rewards",
            steps=steps,
        )


class MissingExtra(ScmWorldError, ImportError):
    """An optional ``package`` that is not installed; ``extra`` brings it, if one does."""

    def __init__(self, package: str, extra: str | None = None) -> None:
        install = package if extra is None else f"'scm-world[{extra}]'"
        message = f"this needs the package {package!r}; install it with: pip install {install}"
        super().__init__(message, package=package, extra=extra)
