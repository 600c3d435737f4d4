"""The two graphs of a run as SVG: arrows for small ones, a matrix for large ones."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from typing import final

from scm_world.discovery.exam.results import Truth
from scm_world.discovery.exam.side_by_side import VERDICT, VERDICTS, Link, as_declared, when
from scm_world.discovery.exam.side_by_side_layout import Places, label
from scm_world.discovery.layers import Point
from scm_world.queries.experiments.effects import EdgeKey

NODES, EDGES = 40, 200  # more than these are drawn as a matrix
SQUARE, LETTER = 14.0, 5.6  # [pixels]: a field of a matrix, a letter beside it
FEW = 3000  # fields of a matrix that have a title each
SIGNS = {
    "missing": "M-4 0H4",
    "extra": "M-4 0H4M0-4V4",
    "reversed": "M-4-2H4L1.5-4.5M4 2H-4L-1.5 4.5",
    "undirected": "M-2.5-2C-2.5-5.5 3-5.5 2.5-2 2.2-.4 0-.4 0 1.6M0 3.6V4.8",
}
"""Signs as lines, so that they look alike whatever letters there are."""


@final
class Board:
    """Draws the pictures of one subject; what they share is drawn once.

    Args:
        truth: The subject.
        name: A word that begins all identifiers in the page.
        most: Edges of the picture that has the most.
    """

    def __init__(self, truth: Truth, name: str, most: int) -> None:
        self._truth, self._name = truth, name
        self._paths: dict[EdgeKey, str] = {}
        self.is_matrix = len(truth.names) > NODES or max(most, len(truth.edges)) > EDGES
        self._places = None if self.is_matrix else Places(truth)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of a picture [pixels]."""
        if self._places is None:
            side = SQUARE * len(self._truth.names) + self._margin
            return (side + 6.0, side + 6.0)
        return (self._places.width, self._places.height)

    @property
    def _margin(self) -> float:
        return LETTER * max((len(name) for name in self._truth.names), default=0) + 12.0

    def declared(self, title: str) -> str:
        """Draw the declared graph."""
        shared = f'<use href="#{self._name}d"/>'
        return self._svg(title, shared, "declared")

    def found(self, links: Sequence[Link], title: str) -> str:
        """Draw what a learner found, in the same places."""
        return self._svg(title, f'{self._links(links)}<use href="#{self._name}n"/>', "found")

    def shared(self) -> str:
        """Write what the pictures refer to; to be called after all of them were drawn."""
        declared = self._links(as_declared(self._truth))
        places = self._places
        nodes = self._grid() if places is None else self._nodes(places)
        paths = "" if places is None else self._lines(places)
        return (
            '<svg class="shared" width="0" height="0" aria-hidden="true"><defs>'
            f'{paths}<g id="{self._name}n">{nodes}</g>'
            f'<g id="{self._name}d" class="plain">{declared}<use href="#{self._name}n"/></g>'
            "</defs></svg>"
        )

    def _svg(self, title: str, inside: str, kind: str) -> str:
        width, height = self.size
        return (
            f'<svg class="graph {kind}" role="img" tabindex="0" aria-label="{escape(title)}" '
            f'viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}">'
            f"{inside}</svg>"
        )

    def _links(self, links: Iterable[Link]) -> str:
        if self._places is None:
            return self._marks(list(links))
        return "".join(self._arrow(self._places, link) for link in links)

    # --- arrows -----------------------------------------------------------------------------------

    def _arrow(self, places: Places, link: Link) -> str:
        path = self._paths.setdefault(link.key, f"{self._name}p{len(self._paths)}")
        x, y = places.spot(link.key)
        bare = "" if link.directed else " bare"
        sign = f'<use href="#y-{link.verdict}" x="{x:.0f}" y="{y:.0f}"/>'
        beside = 9.0 if link.verdict in SIGNS else 3.0
        aside, above = (-5.0, 9.0) if link.cause == link.effect else (beside, 3.0)
        where = f'x="{x + aside:.0f}" y="{y - above:.0f}"'
        lag = f'<text class="lag" {where}>{when(link.lag)}</text>'
        return (
            f'<g class="e {link.verdict}{bare}"><title>{_title(link)}</title>'
            f'<use href="#{path}"/>{sign if link.verdict in SIGNS else ""}'
            f"{lag if link.lag else ''}</g>"
        )

    def _lines(self, places: Places) -> str:
        """Write every line that some picture has."""
        return "".join(
            f'<path id="{name}" d="{_path(places.path(key))}"/>'
            for key, name in self._paths.items()
        )

    def _nodes(self, places: Places) -> str:
        width, height = places.box
        return "".join(
            f'<g class="n"><title>{escape(name)}</title><rect x="{x - width / 2:.0f}" '
            f'y="{y - height / 2:.0f}" width="{width:.0f}" height="{height:.0f}" rx="4"/>'
            f"{_label(name, x, y)}</g>"
            for name, (x, y) in places.centers.items()
        )

    # --- a matrix ---------------------------------------------------------------------------------

    def _grid(self) -> str:
        """Draw lines and names: causes at the left, effects above."""
        names, start = self._truth.names, self._margin
        end = start + SQUARE * len(names)
        lines, texts = [], []
        for number in range(len(names) + 1):
            at = start + SQUARE * number
            lines.append(f"M{start:.0f} {at:.0f}H{end:.0f}M{at:.0f} {start:.0f}V{end:.0f}")
        for number, name in enumerate(names):
            at, near = start + SQUARE * (number + 0.5) + 3.0, start - 5.0
            texts.append(f'<text class="r" x="{near:.0f}" y="{at:.0f}">{escape(name)}</text>')
            turned = f'transform="translate({at:.0f} {near:.0f})rotate(-90)"'
            texts.append(f'<text class="u" {turned}>{escape(name)}</text>')
        corner = f'<text class="r" x="{start - 5:.0f}" y="{start - 6:.0f}">cause ↓ effect →</text>'
        return f'<path class="grid" d="{"".join(lines)}"/>{corner}{"".join(texts)}'

    def _marks(self, links: Sequence[Link]) -> str:
        """Write a sign, or the signs of several lags, into the field of each pair."""
        at = {name: number for number, name in enumerate(self._truth.names)}
        fields: dict[tuple[str, str], list[Link]] = {}
        for link in links:
            fields.setdefault((link.cause, link.effect), []).append(link)
            if not link.directed:
                fields.setdefault((link.effect, link.cause), []).append(link)
        titled = len(fields) <= FEW
        marks = []
        for (cause, effect), found in sorted(fields.items()):
            x, y = (self._margin + SQUARE * (at[name] + 0.5) for name in (effect, cause))
            inside = "".join(_mark(link) for link in found)
            title = f"<title>{'; '.join(map(_title, found))}</title>" if titled else ""
            small = " small" if len(found) > 1 or found[0].lag else ""
            place = f'x="{x:.0f}" y="{y + 4:.0f}"'
            marks.append(f'<g class="e m{small}">{title}<text {place}>{inside}</text></g>')
        return "".join(marks)


def legend() -> str:
    """Explain lines and signs."""
    keys = "".join(
        f'<li><svg class="key" width="64" height="18" viewBox="0 0 64 18" aria-hidden="true">'
        f'<g class="e {v.name}{" bare" if v.name == "undirected" else ""}"><path d="M2 9H60"/>'
        f'{_sign(v.name)}</g></svg><b class="t-{v.name}">{v.text}</b> {v.name}: {v.words}</li>'
        for v in VERDICTS
    )
    lag = f"<li><b>{when(1)}</b> the cause acts one control step later; no mark: at once</li>"
    return f'<ul class="legend">{keys}{lag}</ul>'


def signs() -> str:
    """Write signs and arrowheads, once per page."""
    drawn = "".join(
        f'<g id="y-{name}" class="y"><circle r="6.5"/><path d="{line}"/></g>'
        for name, line in SIGNS.items()
    )
    tips = "".join(
        f'<marker id="tip-{v.name}" viewBox="0 0 8 8" refX="7.5" refY="4" markerWidth="9" '
        'markerHeight="9" markerUnits="userSpaceOnUse" orient="auto">'
        f'<path d="M0 0 8 4 0 8z" fill="{v.color}"/></marker>'
        for v in VERDICTS
    )
    hidden = '<svg class="shared" width="0" height="0" aria-hidden="true">'
    return f"{hidden}<defs>{drawn}{tips}</defs></svg>"


def _sign(name: str) -> str:
    return f'<use href="#y-{name}" x="28" y="9"/>' if name in SIGNS else ""


def _title(link: Link) -> str:
    return escape(f"{link.words}: {link.verdict}")


def _mark(link: Link) -> str:
    lag = str(link.lag) if link.lag else ""
    return f'<tspan class="t-{link.verdict}">{VERDICT[link.verdict].text}{lag}</tspan>'


def _path(curves: Sequence[Sequence[Point]]) -> str:
    start = f"M{_numbers(curves[0][:1])}"
    return start + "".join(f"C{_numbers(curve[1:])}" for curve in curves)


def _numbers(points: Iterable[Point]) -> str:
    return " ".join(f"{x:.0f} {y:.0f}" for x, y in points)


def _label(name: str, x: float, y: float) -> str:
    lines = label(name)
    first = y + 3.5 - 5.5 * (len(lines) - 1)
    return "".join(
        f'<text x="{x:.0f}" y="{first + 11 * number:.0f}">{escape(line)}</text>'
        for number, line in enumerate(lines)
    )
