"""Checks of arguments, and optional libraries."""

from __future__ import annotations

import inspect
import math
import re
import sys
from collections import abc
from collections.abc import Callable, Collection, Container, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cache, wraps
from importlib import import_module
from importlib.util import find_spec
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

import numpy as np

from scm_world._types import ArrayLike, Floats
from scm_world.errors import MissingExtra, ModelError, UnknownOption

MANY = 10**9
"""The largest count: a loop over more would not end."""

EPISODES = 2**62
"""The largest number of an episode: counters of the noise have 64 bits."""


def scalar(value: object) -> Any:
    """Return a number of NumPy, or an array of shape (), as one of Python; else the value."""
    return value.item() if isinstance(value, np.generic | np.ndarray) and not value.shape else value


def whole_number(option: str, value: object, *, least: int, most: float | None = None) -> int:
    """Return an option that is a whole number from ``least`` on, or raise ``UnknownOption``.

    ``most`` is the largest one. If None, counts (``least`` is positive) go up to ``MANY``, and
    other numbers, such as seeds, have no upper limit.
    """
    number = scalar(value)
    most = (MANY if least > 0 else math.inf) if most is None else most
    if isinstance(number, int) and not isinstance(number, bool) and least <= number <= most:
        return number
    upper = "on" if most == math.inf else f"to {most:,}"
    raise UnknownOption(option, number, (f"any whole number from {least} {upper}",))


def real_number(
    option: str, value: object, *, least: float = -math.inf, most: float = math.inf
) -> float:
    """Return an option that is a finite number from ``least`` to ``most``, or refuse it."""
    number = scalar(value)
    is_number = isinstance(number, int | float) and not isinstance(number, bool)
    if not is_number or not math.isfinite(number) or not least <= number <= most:
        allowed = "any finite number" + f" from {least:g} on" * (least > -math.inf)
        allowed += f" to {most:g}" * (most < math.inf)
        raise UnknownOption(option, number, (allowed,))
    return float(number)


SWITCH = ("True or False, not a text or a number",)


def true_or_false(option: str, value: object) -> bool:
    """Return an option that is True or False, also NumPy's, or raise ``UnknownOption``."""
    if not isinstance(value, bool | np.bool_):
        raise UnknownOption(option, value, SWITCH)
    return bool(value)


def one_of(option: str, value: object, allowed: Collection[object]) -> None:
    """Refuse an option that is not among those allowed; None is left out of the message."""
    try:
        known = value in allowed
    except (TypeError, ValueError):  # an array, or not hashable
        known = False
    if not known:
        raise UnknownOption(option, value, [one for one in allowed if one is not None])


F = TypeVar("F", bound=Callable[..., Any])
NUMBERS = {float: (int, float), int: (int,), bool: (bool,)}


def typed(function: F) -> F:
    """Make a function, or a class, refuse arguments of another kind than annotated.

    Numbers may be those of NumPy, and sequences of numbers arrays; the function gets Python's.
    True and False are not numbers. Annotations other than classes allow everything. The function
    itself checks ranges.
    """
    if isinstance(function, type):
        kind: Any = function
        kind.__init__ = typed(kind.__init__)
        return function

    @wraps(function)
    def call(*given: object, **named: object) -> Any:
        signature, hints = _annotations(function)
        try:
            bound = signature.bind(*given, **named)
        except TypeError:
            return function(*given, **named)  # Python says which one is missing, or one too many
        for name, given_value in bound.arguments.items():
            hint = hints.get(name, Any)
            value = plain(given_value) if _has_numbers(hint) else given_value
            value = scalar(value) if name in hints else value
            refuse_other(name, value, hint)
            bound.arguments[name] = value
        return function(*bound.args, **bound.kwargs)

    return call  # type: ignore[return-value] # it has the same arguments


@cache
def _annotations(function: Callable[..., Any]) -> tuple[inspect.Signature, dict[str, Any]]:
    """Return the signature of a function, and its annotations as objects."""
    signature, hints = inspect.signature(function), dict[str, Any]()
    names = {**vars(sys.modules[function.__module__]), **getattr(function, "__globals__", {})}
    for name, parameter in signature.parameters.items():
        text = parameter.annotation
        if isinstance(text, str) and parameter.kind not in (2, 4):  # no *arguments, no **options
            with suppress(NameError, TypeError):  # imported for types only, or an alias as a text
                hints[name] = eval(text, names)  # noqa: S307 # it is our own text
    return signature, hints


def refuse_other(option: str, value: object, hint: object) -> None:
    """Refuse an option of another kind than annotated; see ``typed``."""
    if not _fits(value, hint):
        kind = hint.__name__ if isinstance(hint, type) else re.sub(r"\w+\.", "", str(hint))
        parts = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
        named = all(get_origin(part) is Literal or part is type(None) for part in parts)
        allowed = (f"of type {kind}",)
        if named:
            allowed = tuple(choice for part in parts for choice in get_args(part) or ("None",))
        allowed = SWITCH if hint in (bool, bool | None) else allowed
        raise UnknownOption(option, value if len(repr(value)) < 80 else type(value), allowed)


@cache
def _has_numbers(hint: object) -> bool:
    """Return whether an annotation is of Python's numbers, and not of arrays or functions."""
    other = get_origin(hint) is abc.Callable or "rray" in str(hint)
    return hint in NUMBERS or (not other and any(map(_has_numbers, get_args(hint))))


def _fits(value: object, hint: object) -> bool:
    """Return whether a value is of an annotated kind."""
    kind: Any = get_origin(hint) or hint
    parts = get_args(hint)
    if kind in (Union, UnionType):
        return any(_fits(value, part) for part in parts)
    if kind is Literal:
        return isinstance(value, str) and value in parts
    if kind is None:
        return value is None
    if not isinstance(kind, type):
        return True
    if kind in NUMBERS:
        return isinstance(value, NUMBERS[kind]) and (kind is bool or not isinstance(value, bool))
    try:
        listed = kind in (Sequence, tuple) and not hasattr(value, "columns")  # no table
        known = isinstance(value, Collection if listed else kind)
    except TypeError:  # a protocol that says nothing when the program runs
        return True
    if callable(value) and kind is abc.Callable and parts and parts[0] is not ...:
        return takes(value, *[None] * len(parts[0])) is not False
    if not known or not parts or not isinstance(value, Collection):
        return known
    if kind is abc.Callable or kind.__module__.startswith("numpy"):
        return known
    if isinstance(value, Mapping) and not listed:
        return all(_fits(key, parts[0]) for key in value)
    each = value.tolist() if isinstance(value, np.ndarray) else value
    each = [value] if isinstance(value, str | bytes) else each
    if kind is tuple and parts[-1] is not ...:
        return len(each) == len(parts) and all(map(_fits, each, parts))
    return all(_fits(one, parts[0]) for one in each)


def takes(function: Callable[..., Any], *given: object, **options: object) -> bool | None:
    """Return whether a function can be called with these arguments; None if it does not say."""
    try:
        inspect.signature(function).bind(*given, **options)
    except ValueError:  # a function in C
        return None
    except TypeError:
        return False
    return True


def plain(value: object) -> Any:
    """Return numbers and arrays of NumPy as Python's, also in dictionaries, lists and tuples."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if type(value) is dict:
        return {name: plain(one) for name, one in value.items()}
    if type(value) is list:
        return [*map(plain, value)]
    return tuple(map(plain, value)) if type(value) is tuple else value


def real_numbers(value: ArrayLike) -> Floats:
    """Return real numbers as 64-bit floats; None and ``pandas.NA`` become NaN.

    Raises:
        TypeError: It holds something else, such as text, dates or lists; the error says what.
    """
    found = np.asarray(value)
    if found.dtype.kind not in "biuf":
        import pandas

        cells = found.ravel()
        kind = pandas.api.types.infer_dtype(cells)
        if kind not in ("floating", "integer", "boolean", "mixed-integer-float", "empty"):
            advice = "give real numbers, one in each row, such as seconds or a code"
            raise TypeError(f"it holds {kind}, not real numbers: {advice}")
        found = np.where(pandas.isna(cells), np.nan, cells).reshape(found.shape)
    return found.astype(np.float64, copy=False)


def finite_numbers(value: object) -> Floats | None:
    """Return finite real numbers as an array; None for anything else."""
    try:
        found = np.asarray(value)
    except ValueError:  # a ragged list
        return None
    numeric = found.dtype.kind in "iuf" and np.isfinite(found).all()
    return found.astype(np.float64) if numeric else None


def load(module: str, library: str, extra: str = "") -> Any:
    """Import a module of an optional library, which an extra of this package installs.

    The extra has the name of the library on the package index, unless another one is given.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise missing(error, module, library, extra) from error


def missing(error: ImportError, module: str, library: str, extra: str = "") -> MissingExtra:
    """Return the error that names the missing library, or one that it imports, for ``load``."""
    absent = (error.name or "").partition(".")[0]
    other = absent not in ("", module.partition(".")[0]) and find_spec(absent) is None
    return MissingExtra(absent if other else library, extra or library)


def enter(
    registry: dict[str, Any],
    kind: object,
    base: type,
    *,
    what: str,
    taken: Container[str],
    check: Callable[[Any], Iterable[str]],
) -> None:
    """Enter a user's class into a registry, by its ``name``; ``check`` lists further faults.

    A class whose module was run again replaces the earlier one.
    """
    if not (inspect.isclass(kind) and issubclass(kind, base)):
        public = f"{base.__module__.rpartition('.')[0]}.{base.__name__}"
        raise ModelError([f"{kind!r} is not a class derived from {public}"])
    missing = sorted(getattr(kind, "__abstractmethods__", ()))
    problems = [f"{kind.__name__} does not define {method!r}" for method in missing]
    name = getattr(kind, "name", None)
    if not isinstance(name, str) or not name:
        problems.append(f"{kind.__name__} has no name; set name = 'mine' in the class")
    if problems := [*problems, *check(kind)]:
        raise ModelError(problems)
    other = registry.get(str(name), kind)
    same = (other.__module__, other.__qualname__) == (kind.__module__, kind.__qualname__)
    if name in taken or not same:
        raise UnknownOption(f"name of a {what}", name, ("a name that is not taken",))
    registry[str(name)] = kind
