"""Settings of a learner: their defaults, and what is allowed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

from scm_world.errors import UnknownOption


@final
@dataclass(frozen=True)
class Setting:
    """One setting.

    Attributes:
        default: Its value if none is given.
        allowed: What it may be, in words.
        fits: Whether a value is allowed.
    """

    default: Any
    allowed: str
    fits: Callable[[Any], bool]


Settings = Mapping[str, Setting]


def level(default: float) -> Setting:
    """Declare a level of significance."""
    return Setting(
        default, "a number between 0 and 1", lambda given: _is_number(given) and 0.0 < given < 1.0
    )


def weight(default: float) -> Setting:
    """Declare a positive number."""
    return Setting(default, "a number above 0", lambda given: _is_number(given) and given > 0.0)


def count(default: int | None, *, least: int = 0) -> Setting:
    """Declare a whole number; None, where it is the default, for no limit."""
    limit = " or None for no limit" if default is None else ""
    return Setting(
        default,
        f"a whole number from {least} on{limit}",
        lambda given: (
            (given is None and default is None)
            or (isinstance(given, int) and not isinstance(given, bool) and given >= least)
        ),
    )


def switch(default: bool) -> Setting:
    """Declare a yes or no."""
    return Setting(default, "a yes or no: True, False", lambda given: isinstance(given, bool))


def some_of(*choices: str) -> Setting:
    """Declare a list of choices, in an order of its own; all of them by default."""
    return Setting(
        choices,
        f"a list of {', '.join(choices)}",
        lambda given: (
            isinstance(given, Sequence)
            and not isinstance(given, str)
            and len(given) > 0
            and set(given) <= set(choices)
        ),
    )


def chosen(learner: str, declared: Settings, given: Mapping[str, Any]) -> dict[str, Any]:
    """Fill in the defaults, and check what was given.

    Raises:
        UnknownOption: There is no such setting, or its value is not allowed.

    Example:
        >>> chosen("pc", {"alpha": level(0.01)}, {})
        {'alpha': 0.01}
        >>> chosen("pc", {"alpha": level(0.01)}, {"alhpa": 0.05})
        Traceback (most recent call last):
            ...
        scm_world.errors.UnknownOption: no setting of 'pc' is named 'alhpa'; did you mean
        'alpha'?; there are: alpha
    """
    for name, value in given.items():
        if name not in declared:
            raise UnknownOption(f"setting of {learner!r}", name, declared)
        if not declared[name].fits(value):
            raise UnknownOption(f"{name} of {learner!r}", value, (declared[name].allowed,))
    used = {name: given.get(name, setting.default) for name, setting in declared.items()}
    return {name: list(to) if isinstance(to, tuple) else to for name, to in used.items()}


def _is_number(given: Any) -> bool:
    return isinstance(given, int | float) and not isinstance(given, bool)
