"""Where the variables of a subject and the arrows between them go, in every picture of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TypeVar, final

import networkx as nx

from scm_world.discovery.exam.results import Truth
from scm_world.discovery.layers import (
    Item,
    Point,
    chains_of,
    heights_of,
    in_order,
    levels_of,
    neighbors_of,
    room_of,
)
from scm_world.queries.experiments.effects import EdgeKey

CHAR = 6.0  # [pixels] of a letter of ten pixels
BOX, BETWEEN, EDGE = 28.0, 58.0, 14.0  # [pixels]: height of a node, between layers, at the rim
CLOSE = 0.85  # of the room that a node would like
ASIDE = 5.0  # [pixels] between two lags of one pair
SPOTS = (0.5, 0.38, 0.62)  # along an arrow: where signs stand, in turn, so that few meet
OTHERS = (0.5, 0.3, 0.7, 0.2, 0.8, 0.1, 0.9)  # where they stand if there is a node

_K = TypeVar("_K")
_N = TypeVar("_N", int, float)


@final
class Places:
    """A layered layout that depends on the declared graph only.

    Attributes:
        centers: Of each variable [pixels], y downwards.
        box: Width and height of a variable [pixels].
        width: Of the picture [pixels].
        height: Of the picture [pixels].
    """

    def __init__(self, truth: Truth) -> None:
        ahead = _ahead(truth)
        level = _from(0, levels_of(ahead))
        chains = chains_of(ahead, level)
        near = neighbors_of(chains.values())
        layers = in_order(level, chains.values(), near)
        room = max((sum(map(room_of, layer)) for layer in layers), default=0.0)
        y = _from(
            EDGE + BOX, heights_of(layers, near, 0.0, max(room * CLOSE, 60.0)) if layers else {}
        )
        widest = max((len(line) for name in truth.names for line in label(name)), default=1)
        self.box = (CHAR * widest + 12.0, BOX)
        step = self.box[0] + BETWEEN
        self._at: dict[Item, Point] = {
            item: (EDGE + self.box[0] / 2 + step * number, y[item])
            for number, layer in enumerate(layers)
            for item in layer
        }
        self._chains = chains
        self.centers = {name: self._at[name] for name in truth.names}
        self.width = step * len(layers) - BETWEEN + 2 * EDGE + 40.0
        self.height = max(y.values(), default=0.0) + BOX + EDGE

    def path(self, key: EdgeKey) -> tuple[tuple[Point, ...], ...]:
        """Lead an edge from its cause to its effect.

        Returns:
            Cubic Bézier curves of four points each [pixels].
        """
        cause, effect, lag = key
        if cause == effect:
            return (self._loop(cause),)
        aside = ASIDE * ((lag + 1) // 2 * (-1) ** lag)
        for ends, turn in (((cause, effect), 1), ((effect, cause), -1)):
            if ends in self._chains:
                return _curves(self._through(ends, aside)[::turn])
        return (self._straight(cause, effect, aside),)

    def spot(self, key: EdgeKey) -> Point:
        """Find the place for the sign of an edge."""
        curves = self.path(key)
        turn = sum(map(len, key[:2])) + list(self.centers).index(key[0])
        if key[0] == key[1]:
            return _bezier(curves[0], 0.5)
        middle = curves[(len(curves) - 1) // 2]
        spots = [_bezier(middle, t) for t in (SPOTS[turn % len(SPOTS)], *OTHERS)]
        return next((spot for spot in spots if self._is_free(spot)), spots[0])

    def _is_free(self, spot: Point) -> bool:
        """Tell whether a sign here lies on no variable."""
        wide, high = self.box[0] / 2 + 7.0, self.box[1] / 2 + 7.0
        return not any(
            abs(spot[0] - x) < wide and abs(spot[1] - y) < high for x, y in self.centers.values()
        )

    def _through(self, ends: tuple[str, str], aside: float) -> list[Point]:
        """List the points that a long arrow passes, in the free lanes of the layers between."""
        half = self.box[0] / 2
        (x0, y0), *between, (x1, y1) = (self._at[item] for item in self._chains[ends])
        lanes = [(x + side, y + aside) for x, y in between for side in (-half, half)]
        return [(x0 + half, y0 + aside), *lanes, (x1 - half, y1 + aside)]

    def _straight(self, cause: str, effect: str, aside: float) -> tuple[Point, ...]:
        (x0, y0), (x1, y1) = self.centers[cause], self.centers[effect]
        half = self.box[0] / 2
        if x0 == x1:
            out = x0 + half + 20.0 + min(26.0, abs(y1 - y0) / 10)
            start, end = (x0 + half, y0 + aside), (x1 + half, y1 + aside)
            return (start, (out, start[1]), (out, end[1]), end)
        side = half if x1 > x0 else -half
        return _curve((x0 + side, y0 + aside), (x1 - side, y1 + aside))

    def _loop(self, name: str) -> tuple[Point, ...]:
        x, y = self.centers[name]
        right = x + self.box[0] / 2
        return ((right, y - 11.0), (right + 26.0, y - 26.0), (right + 30.0, y), (right, y - 4.0))


def label(name: str) -> tuple[str, ...]:
    """Break a name at its first dot.

    Example:
        >>> label("tool_block.mass"), label("x1")
        (('tool_block.', 'mass'), ('x1',))
    """
    before, dot, after = name.partition(".")
    return (before + dot, after) if dot and after else (name,)


def _ahead(truth: Truth) -> nx.DiGraph:
    """Take the declared edges that do not close a cycle, those within an instant first."""
    ahead = nx.DiGraph()
    ahead.add_nodes_from(truth.names)
    for cause, effect, _ in sorted(truth.edges, key=lambda key: (key[2], key)):
        if cause != effect and not nx.has_path(ahead, effect, cause):
            ahead.add_edge(cause, effect)
    return ahead


def _from(first: _N, values: Mapping[_K, _N]) -> dict[_K, _N]:
    """Move numbers so that they begin somewhere."""
    low = min(values.values(), default=first)
    return {key: first + value - low for key, value in values.items()}


def _curves(points: Sequence[Point]) -> tuple[tuple[Point, ...], ...]:
    return tuple(_curve(one, other) for one, other in pairwise(points))


def _curve(start: Point, end: Point) -> tuple[Point, ...]:
    """Leave and arrive level."""
    bend = (end[0] - start[0]) / 2
    return (start, (start[0] + bend, start[1]), (end[0] - bend, end[1]), end)


def _bezier(curve: Sequence[Point], t: float) -> Point:
    weights = ((1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3)
    x, y = (
        sum(w * point[i] for w, point in zip(weights, curve, strict=True)) for i in (0, 1)
    )  # fmt: skip
    return (x, y)
