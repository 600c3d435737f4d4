"""Short names for many variables, for tables and figures."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from scm_world.queries.experiments.effects import EdgeKey

_NUMBER = re.compile(r"\d+")


def braces(names: Iterable[str]) -> list[str]:
    """Write names that differ in numbers only as one, without loss.

    Example:
        >>> braces(["gravity", "block_1.mass", "block_2.mass", "block_2.size"])
        ['gravity', 'block_{1,2}.mass', 'block_2.size']
    """
    alike: dict[str, list[str]] = {}
    for name in dict.fromkeys(names):
        alike.setdefault(_NUMBER.sub("{}", name), []).append(name)
    return [short for members in alike.values() for short in _shorten(members)]


def _shorten(members: Sequence[str]) -> Iterator[str]:
    numbers = [_NUMBER.findall(name) for name in members]
    choices = [list(dict.fromkeys(column)) for column in zip(*numbers, strict=True)]
    if math.prod(map(len, choices)) == len(members):
        written = iter(c[0] if len(c) == 1 else "{" + ",".join(c) + "}" for c in choices)
        yield _NUMBER.sub(lambda _: next(written), members[0])
        return
    split = next(i for i, choice in enumerate(choices) if len(choice) > 1)
    for value in choices[split]:
        yield from _shorten([m for m, n in zip(members, numbers, strict=True) if n[split] == value])


def by_entity(names: Iterable[str]) -> list[str]:
    """Write the quantities of one entity together, without loss.

    Example:
        >>> by_entity(["block.mass", "gravity", "block.size"])
        ['block.{mass, size}', 'gravity']
    """
    entities: dict[str, list[str]] = {}
    for name in braces(names):
        entity, dot, quantity = name.partition(".")
        entities.setdefault(entity + dot, []).append(quantity)
    return [
        entity + (found[0] if len(found) == 1 else "{" + ", ".join(found) + "}")
        for entity, found in entities.items()
    ]


def families_of(names: Iterable[str], edges: Iterable[EdgeKey]) -> dict[str, tuple[str, ...]]:
    """Group variables that differ in numbers only and have the same edges.

    Two of them have the same edges if these lead to as many variables of each family, with
    the same lags, and to those of the same number (the same block, say) alike.

    Args:
        names: The variables.
        edges: The declared edges.

    Returns:
        The variables of each family, by a short name.

    Source:
        Color refinement: Weisfeiler and Leman, *The reduction of a graph to canonical form*, 1968.

    Example:
        >>> edges = [("size_1", "mass_1", 0), ("size_2", "mass_2", 0)]
        >>> families_of(["size_1", "size_2", "mass_1", "mass_2"], edges)
        {'size_{1,2}': ('size_1', 'size_2'), 'mass_{1,2}': ('mass_1', 'mass_2')}
    """
    around: dict[str, list[tuple[str, int, bool, str]]] = {name: [] for name in names}
    for cause, effect, lag in edges:
        own = _NUMBER.findall(cause) == _NUMBER.findall(effect)
        around.setdefault(cause, []).append(("out", lag, own, effect))
        around.setdefault(effect, []).append(("in", lag, own, cause))
    part: dict[str, Any] = {name: _NUMBER.sub("{}", name) for name in around}
    count = 0
    while count < (count := len(set(part.values()))):
        part = {
            name: (part[name], frozenset(Counter((*to, part[n]) for *to, n in links).items()))
            for name, links in around.items()
        }
        number = {key: i for i, key in enumerate(dict.fromkeys(part.values()))}
        part = {name: number[key] for name, key in part.items()}
    alike: dict[object, list[str]] = {}
    for name, which in part.items():
        alike.setdefault(which, []).append(name)
    whole = [", ".join(braces(family)) for family in alike.values()]
    short = [_short(family) for family in alike.values()]
    found: dict[str, tuple[str, ...]] = {}
    for few, every, family in zip(short, whole, alike.values(), strict=True):
        is_clear = len(few) < len(every) and short.count(few) == 1 and few not in whole
        found[few if is_clear else every] = tuple(family)
    return found


def _short(members: Sequence[str]) -> str:
    """Write ``tool_{…}.mass (5)`` for the masses of blocks whose names have several numbers."""
    entity, dot, quantity = _NUMBER.sub("{}", members[0]).partition(".")
    if len(members) == 1 or entity.count("{}") < 2:
        return ", ".join(braces(members))
    kind = entity.partition("{}")[0].rstrip("_").rpartition("_")[0]
    return f"{kind}_{{…}}{dot}{quantity} ({len(members)})"
