"""A reader of the part of the DOT language that graphs need; dagitty's language is like it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from itertools import pairwise, product
from typing import final

Attributes = dict[str, str]
NodeParts = Iterable[tuple[str, Attributes]]
EdgeParts = Iterable[tuple[str, str, Attributes]]

_TOKEN = re.compile(
    r"""
    (?P<space>\s+ | //[^\n]* | \#[^\n]* | /\*.*?\*/)
    | "(?P<quoted>(?:[^"\\]|\\.)*)"
    | (?P<arrow><->|->|<-|--|@-@|@->|<-@|@--|--@)
    | (?P<bare>[\w.]+|-[.\d]+)
    | (?P<mark>[\[\]{};,=])
    """,
    re.VERBOSE | re.DOTALL,
)
_DEFAULTS = ("graph", "node", "edge")

Token = tuple[str, str]
"""What it is (``"bare"``, ``"quoted"``, ``"arrow"``, ``"mark"`` or ``"end"``), and its text."""


def _tokens(text: str) -> Iterator[Token]:
    at = 0
    while at < len(text):
        found = _TOKEN.match(text, at)
        if found is None:
            line = text.count("\n", 0, at) + 1
            raise ValueError(f"line {line}: cannot read {text[at : at + 20]!r}")
        at = found.end()
        kind = str(found.lastgroup)
        if kind == "quoted":
            yield kind, re.sub(r"\\([\"\\])", r"\1", found["quoted"])
        elif kind != "space":
            yield kind, found[kind]
    yield "end", "the end"


@final
class _Parser:
    """A recursive descent over statements."""

    def __init__(self, text: str) -> None:
        self._tokens = list(_tokens(text))
        self._at = 0
        self.nodes: dict[str, Attributes] = {}
        self.edges: list[tuple[str, str, Attributes]] = []

    def next(self) -> Token:
        token = self._tokens[self._at]
        self._at = min(self._at + 1, len(self._tokens) - 1)
        return token

    def has(self, *texts: str, ahead: int = 0) -> bool:
        at = min(self._at + ahead, len(self._tokens) - 1)
        kind, text = self._tokens[at]
        return kind in ("bare", "mark") and text.lower() in texts

    def take(self, *texts: str) -> bool:
        found = self.has(*texts)
        self._at += found
        return found

    def expect(self, text: str) -> None:
        if not self.take(text):
            raise ValueError(f"expected {text!r}, got {self._tokens[self._at][1]!r}")

    def end(self) -> None:
        if self._tokens[self._at][0] != "end":
            raise ValueError(f"expected one graph, got {self._tokens[self._at][1]!r} after it")

    def name(self) -> str:
        kind, text = self.next()
        if kind not in ("bare", "quoted"):
            raise ValueError(f"expected a name, got {text!r}")
        return text

    def statements(self) -> list[str]:
        found: list[str] = []
        while not self.take("}"):
            if self.take(";", ","):
                continue
            if self.has(*_DEFAULTS) and self.has("[", ahead=1):
                self.next()
                self.attributes()
            elif self.has("=", ahead=1):
                self._at += 2
                self.name()
            else:
                found.extend(self.chain())
        return found

    def group(self) -> list[str]:
        if self.take("subgraph") and not self.has("{"):
            self.name()
        if self.take("{"):
            return self.statements()
        name = self.name()
        self.nodes.setdefault(name, {})
        return [name]

    def chain(self) -> list[str]:
        groups, arrows = [self.group()], []
        while self._tokens[self._at][0] == "arrow":
            arrows.append(self.next()[1])
            groups.append(self.group())
        data = self.attributes()
        for (left, right), arrow in zip(pairwise(groups), arrows, strict=True):
            if arrow not in ("->", "<-"):
                raise ValueError(f"{left[0]!r} {arrow} {right[0]!r} is no directed edge")
            causes, effects = (left, right) if arrow == "->" else (right, left)
            self.edges.extend((cause, effect, data) for cause, effect in product(causes, effects))
        if not arrows:
            for name in groups[0]:
                self.nodes[name].update(data)
        return [name for group in groups for name in group]

    def attributes(self) -> Attributes:
        found: Attributes = {}
        while self.take("["):
            while not self.take("]"):
                if not self.take(",", ";"):
                    key = self.name()
                    found[key] = self.name() if self.take("=") else ""
        return found


def parse(text: str, word: str) -> tuple[NodeParts, EdgeParts]:
    """Read one graph that begins with ``word``, ``"digraph"`` or ``"dag"``.

    Returns:
        Names with attributes; causes and effects with attributes.

    Raises:
        ValueError: With what was wrong.

    Example:
        >>> nodes, edges = parse('dag { x -> "y z" <- x2 [beta=1] }', "dag")
        >>> list(nodes), [edge[:2] for edge in edges]
        ([('x', {}), ('y z', {}), ('x2', {})], [('x', 'y z'), ('x2', 'y z')])
    """
    parser = _Parser(text)
    parser.take("strict")
    parser.expect(word)
    if not parser.has("{"):
        parser.name()
    parser.expect("{")
    parser.statements()
    parser.end()
    return list(parser.nodes.items()), parser.edges
