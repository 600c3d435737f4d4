"""A declared and a found graph held against each other, edge by edge."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import final

from scm_world.discovery.exam.results import Truth
from scm_world.discovery.learners.found import Found
from scm_world.queries.experiments.effects import EdgeKey


@final
@dataclass(frozen=True)
class Verdict:
    """What can be said of an edge.

    Attributes:
        name: In one word; class of its line in the picture.
        sign: Drawn on the line.
        words: What it means.
        color: Of line and sign.
        width: Of the line [pixels].
        dashes: Lengths of dashes and gaps of the line [pixels]; ``"1 0"`` has no gaps.
    """

    name: str
    sign: str
    words: str
    color: str
    width: float
    dashes: str = "1 0"

    @property
    def text(self) -> str:
        """What stands in a matrix."""
        return self.sign or "●"


VERDICTS = (
    Verdict("correct", "", "declared and found", "#0072B2", 1.5),
    Verdict("missing", "−", "declared, not found", "#B34700", 1.5, "6 4"),
    Verdict("extra", "+", "found, not declared", "#B0508C", 3.2),
    Verdict("reversed", "⇄", "found the other way round", "#00785A", 2.0, "9 3 2 3"),
    Verdict("undirected", "?", "declared, found without direction", "#222222", 2.0, "2 2"),
    Verdict("unscored", "∘", "not scored", "#6B7280", 1.0, "1 4"),
)
"""Told apart by dashes, width, sign and color; each of the first three alone is enough."""
VERDICT = {verdict.name: verdict for verdict in VERDICTS}
WRONG = ("missing", "extra", "reversed", "undirected")


@final
@dataclass(frozen=True, order=True)
class Link:
    """An edge as it is shown.

    Attributes:
        cause: Name of the cause; of one end if there is no direction.
        effect: Name of the effect.
        lag: In control steps.
        verdict: Name of a verdict.
        directed: Whether it has an arrowhead.
    """

    cause: str
    effect: str
    lag: int
    verdict: str
    directed: bool = True

    @property
    def key(self) -> EdgeKey:
        """Cause, effect and lag."""
        return (self.cause, self.effect, self.lag)

    @property
    def words(self) -> str:
        """Cause, effect and lag in words.

        Example:
            >>> Link("x", "y", 1, "extra").words
            'x → y, t−1'
        """
        between = "→" if self.directed else "—"
        return f"{self.cause} {between} {self.effect}" + (f", {when(self.lag)}" if self.lag else "")


def when(lag: int) -> str:
    """Write how long before its effect a cause was, in control steps."""
    return f"t−{lag}"


def compare(truth: Truth, found: Found) -> tuple[Link, ...]:
    """Say of every declared and of every found edge what became of it.

    Args:
        truth: The declared graph.
        found: Over the same variables; others of it are not shown.

    Returns:
        One link per edge, sorted. An edge that was turned around is one link, in the direction
        that was found.

    Example:
        >>> truth = Truth(name="chain", names=("x", "y", "z"), edges=(("x", "y", 0), ("y", "z", 0)))
        >>> links = compare(truth, Found.of_edges(["x", "y", "z"], [("y", "x", 0), ("x", "z", 1)]))
        >>> [(link.words, link.verdict) for link in links]
        [('x → z, t−1', 'extra'), ('y → x', 'reversed'), ('y → z', 'missing')]
    """
    seen = found.restricted(truth.names)
    declared, directed = set(truth.edges), set(seen.directed)
    links: list[Link] = []
    for one, other in seen.undirected:
        ways = [(one, other, 0), (other, one, 0)]
        known = next((way for way in ways if way in declared), None)
        verdict = "extra" if known is None else "undirected"
        links.append(Link(*(known or ways[0]), verdict, directed=False))
        declared -= set(ways)
    for cause, effect, lag in directed:
        key, back = (cause, effect, lag), (effect, cause, lag)
        if key in declared:
            verdict = "correct"
        elif lag == 0 and back in declared and back not in directed:
            verdict = "reversed"
        else:
            verdict = "extra"
        links.append(Link(*key, verdict))
        declared -= {back} if verdict == "reversed" else {key}
    links += [Link(*key, "missing") for key in declared]
    return tuple(sorted(_scored(truth, links)))


def as_declared(truth: Truth) -> tuple[Link, ...]:
    """Give the declared edges alone."""
    return tuple(sorted(_scored(truth, (Link(*key, "correct") for key in set(truth.edges)))))


def _scored(truth: Truth, links: Iterable[Link]) -> Iterable[Link]:
    """Set apart the pairs that are not scored."""
    apart = {frozenset(pair) for pair in truth.left_out}
    for link in links:
        left_out = frozenset((link.cause, link.effect)) in apart
        yield Link(*link.key, "unscored" if left_out else link.verdict, link.directed)
