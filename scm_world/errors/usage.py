"""Calls that cannot be answered: wrong options, actions, files, budgets and extras."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterable, Mapping
from typing import Any

from scm_world.errors.base import ScmWorldError, nearest, suggested

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


class ActionError(ScmWorldError, ValueError):
    """An action that the robot cannot take.

    Attributes:
        action: What was given.
    """

    def __init__(self, message: str, action: Any) -> None:
        self.action = action
        super().__init__(message)


class NotReset(ScmWorldError, RuntimeError):
    """The world was never reset, so there is nothing to step, ask or intervene on."""

    def __init__(self) -> None:
        super().__init__("the world has no episode yet; call reset() first")


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
