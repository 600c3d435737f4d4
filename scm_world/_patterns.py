"""Patterns of names: ``*`` stands for any letters, ``?`` for one, ``[ab]`` for one of some."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from fnmatch import fnmatchcase
from typing import Any

from scm_world.errors import (
    ConflictingTargets,
    InterventionError,
    UnknownOption,
    UnknownVariable,
    raise_all,
)


def is_pattern(name: object) -> bool:
    """Return whether a name has a letter that stands for others."""
    return isinstance(name, str) and not {*"*?["}.isdisjoint(name)


def fits(name: str, patterns: Iterable[str]) -> bool:
    """Return whether a name fits one of some patterns, or is one of some names."""
    return any(isinstance(one, str) and (name == one or fnmatchcase(name, one)) for one in patterns)


def as_names(given: object) -> tuple[Any, ...]:
    """Return names as a tuple; a text is a single one."""
    if not isinstance(given, Iterable):
        raise UnknownOption("names", given, ("a name", "names of variables"))
    return (given,) if isinstance(given, str) else tuple(given)


def fitting(patterns: object, names: Collection[str], option: str = "") -> tuple[str, ...]:
    """Return the names that fit a pattern, or some patterns, in their own order."""
    given = as_names(patterns)
    for pattern in given:
        if not any(fits(name, (pattern,)) for name in names):
            if option:
                raise UnknownOption(option, pattern, names)
            raise UnknownVariable(str(pattern), names)
    return tuple(name for name in names if fits(name, given))


def meant(
    keys: Iterable[str],
    names: Collection[str],
    quantities: Callable[[str], tuple[str, ...]] = lambda name: (name,),
    problems: list[InterventionError] | None = None,
    literal: Collection[str] = (),
) -> dict[str, str]:
    """Return for each meant variable the key that means it: a name, or a pattern that it fits.

    A name counts more than a pattern. Of several names of one quantity a pattern means that of the
    quantity itself. Two patterns may not fit the same quantity. Names that do not exist are kept.

    Args:
        keys: Names and patterns.
        names: The variables that patterns may mean, in order.
        quantities: Returns the quantities that a name sets: other coordinates set one, bundles
            several.
        problems: A list for the errors; they are raised if None.
        literal: Further names, which are not patterns even with such letters.

    Example:
        >>> meant(["*.mass", "cart.mass"], ["cart.mass", "pole.mass", "pole.size"])
        {'pole.mass': '*.mass', 'cart.mass': 'cart.mass'}
    """
    found: list[InterventionError] = [] if problems is None else problems
    keys = tuple(keys)
    known = {*names, *literal}
    patterns = [key for key in keys if is_pattern(key) and key not in known]
    exact = [key for key in keys if key not in patterns]
    there = {of: name for name in exact if name in known for of in quantities(name)}
    result: dict[str, str] = {}
    for key in keys:
        if key not in patterns:
            result[key] = key
            continue
        fitting = [name for name in names if fnmatchcase(name, key)]
        if not fitting:
            found.append(UnknownVariable(key, names))
        elif [f"{name}*" for name in fitting] == [key]:  # name*=2 on a command line
            said = f"the pattern {key!r} fits {fitting[0]!r} alone: to set it, write its name; "
            said += "to multiply it, Scale(2), or scale:2 on a command line"
            found.append(InterventionError(said, variable=key))
            continue
        for name in sorted(fitting, key=lambda one: quantities(one) != (one,)):
            own = quantities(name)
            before = {there[of] for of in own if of in there}
            if key in before or (before.issubset(exact) and there.keys() >= {*own}):
                continue
            if before:
                found.append(ConflictingTargets((before.pop(), key), name))
                continue
            result[name] = key
            there |= dict.fromkeys(own, key)
    if problems is None:
        raise_all(found)
    return result


def by_name(option: str, given: object, names: Collection[str]) -> dict[str, Any]:
    """Return the values of an option by name in place of those by names and patterns."""
    if not isinstance(given, Mapping):
        raise UnknownOption(option, given, ("a dictionary by name",))
    found = list[InterventionError]()
    keys = meant(given, names, problems=found)
    for key in (*(one.variable for one in found if isinstance(one, UnknownVariable)), *keys):
        if key not in names:
            raise UnknownOption(option, key, names)
    raise_all(found)
    return {name: given[key] for name, key in keys.items()}
