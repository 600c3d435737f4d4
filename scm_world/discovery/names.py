"""Many names in few words, for tables and pictures."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import final

from scm_world.discovery.scores import EdgeKey

_NUMBER = re.compile(r"\d+")
_LINK = "robot_finger_{}_link_{}."


def _template(name: str) -> str:
    return _NUMBER.sub("{}", name)


def braces(names: Iterable[str]) -> list[str]:
    """Write names that differ in numbers only as one, without loss.

    Example:
        >>> braces(["gravity", "block_1.mass", "block_2.mass", "block_2.size"])
        ['gravity', 'block_{1,2}.mass', 'block_2.size']
    """
    alike: dict[str, list[str]] = {}
    for name in dict.fromkeys(names):
        alike.setdefault(_template(name), []).append(name)
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


@final
class Families:
    """Variables that differ in numbers only and have the same declared edges, taken as one.

    Args:
        names: The variables.
        edges: The declared edges.
    """

    def __init__(self, names: Iterable[str], edges: Iterable[EdgeKey]) -> None:
        around: dict[str, set[tuple[str, str, int]]] = {}
        for cause, effect, lag in edges:
            around.setdefault(cause, set()).add(("out", effect, lag))
            around.setdefault(effect, set()).add(("in", cause, lag))
        alike: dict[object, list[str]] = {}
        for name in names:
            key = (_template(name), frozenset(around.get(name, ())))
            alike.setdefault(key, []).append(name)
        self.members = {_label(found): tuple(found) for found in alike.values()}
        self.of = {name: label for label, found in self.members.items() for name in found}


def _label(members: Sequence[str]) -> str:
    if len(members) == 1:
        return members[0]
    template = _template(members[0])
    if template.startswith(_LINK):
        links = sorted({_NUMBER.findall(name)[1] for name in members})
        which = links[0] if len(links) == 1 else f"{links[0]}-{links[-1]}"
        fingers = {_NUMBER.findall(name)[0] for name in members}
        if len(fingers) * len(links) == len(members):
            return f"robot links {which}.{template.removeprefix(_LINK)} ({len(members)})"
    return ", ".join(braces(members))
