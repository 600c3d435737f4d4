"""Sheets that grow with what is on them: a title above, a legend below, panels between them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any, final

from scm_world.output.canvas import DPI, FAINT, INK, blank

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARGIN = 0.2  # [inches]
GAP = 0.12  # [inches] between title, panels and legend
NARROWEST = 5.0  # [inches]
TITLE, NOTE, KEY = 12.0, 9.0, 9.0  # [points]
HANDLE = 0.75  # [inches] of a legend's entry besides its words
PLAIN: dict[str, Any] = {"color": INK, "parse_math": False}
"""How texts are written: a name with two dollar signs is no formula."""


@cache
def _ruler() -> Figure:
    return blank()


@lru_cache(maxsize=4096)
def text_size(text: str, points: float, *, bold: bool = False) -> tuple[float, float]:
    """Measure a text, width and height [inches].

    Args:
        text: Of any number of lines.
        points: Size of the letters.
        bold: Whether they are bold.
    """
    figure = _ruler()
    made = figure.text(0.0, 0.0, text, size=points, weight=_weight(bold), parse_math=False)
    box = made.get_window_extent(figure.canvas.get_renderer())  # type: ignore[attr-defined]
    made.remove()
    return float(box.width) / DPI, float(box.height) / DPI


def wrapped(text: str, width: float, points: float, *, bold: bool = False) -> str:
    """Break a text into lines that are no wider than asked; a longer word is broken too.

    Args:
        text: What is written.
        width: Of the lines [inches]; at least one letter stands in each.
        points: Size of the letters.
        bold: Whether they are bold.

    Example:
        >>> wrapped("goal, start, mass from A", 0.9, 8.0).splitlines()
        ['goal, start,', 'mass from A']
    """
    lines: list[str] = []
    for word in text.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if text_size(longer, points, bold=bold)[0] <= width:
            lines[-1:] = [longer]
            continue
        lines += _pieces(word, width, points, bold)
    return "\n".join(lines)


def balanced(text: str, width: float, points: float, *, bold: bool = False) -> str:
    """Break a text into as few lines as ``wrapped`` does, of lengths as even as can be.

    Example:
        >>> wrapped("goal, start, mass from A", 1.3, 8.0).splitlines()
        ['goal, start, mass from', 'A']
        >>> balanced("goal, start, mass from A", 1.3, 8.0).splitlines()
        ['goal, start,', 'mass from A']
    """
    found = wrapped(text, width, points, bold=bold)
    for part in (0.9, 0.8, 0.7, 0.6):
        other = wrapped(text, part * width, points, bold=bold)
        if other.count("\n") > found.count("\n") or other.split() != found.split():
            break
        found = other
    return found


def _pieces(word: str, width: float, points: float, bold: bool) -> list[str]:
    """Break a word where it becomes too wide, after a sign of punctuation if there is one."""
    if text_size(word, points, bold=bold)[0] <= width or len(word) == 1:
        return [word]
    fits = 1
    while text_size(word[: fits + 1], points, bold=bold)[0] <= width:
        fits += 1
    nice = max((word[:fits].rfind(sign) + 1 for sign in "._-/@"), default=0)
    cut = nice if nice > fits // 3 else fits
    return [word[:cut], *_pieces(word[cut:], width, points, bold)]


def _weight(bold: bool) -> str:
    return "bold" if bold else "normal"


@final
class Sheet:
    """A figure with room for panels.

    Args:
        width: Of the figure [inches]; it is at least five.
        room: Height of the room for panels [inches].
        title: Above all; broken into lines if need be.
        note: Small, below the title.
        handles: Entries of the legend.
    """

    def __init__(
        self,
        width: float,
        room: float,
        *,
        title: str,
        note: str = "",
        handles: Sequence[Artist] = (),
    ) -> None:
        self.figure = blank()
        self.width = max(width, NARROWEST)
        inner = self.width - 2 * MARGIN
        texts = [(wrapped(title, inner, TITLE, bold=True), TITLE, True)]
        texts += [(wrapped(note, inner, NOTE), NOTE, False)] if note else []
        heights = [text_size(text, size, bold=bold)[1] for text, size, bold in texts]
        self._above = MARGIN + sum(heights) + GAP * len(heights)
        self.figure.set_size_inches(self.width, 1.0)
        below = _legend(self.figure, handles, inner) if handles else 0.0
        self.height = self._above + room + below + MARGIN
        self.figure.set_size_inches(self.width, self.height)
        for legend in self.figure.legends:
            legend.set_bbox_to_anchor((0.5, MARGIN / 2 / self.height))
        top = self.height - MARGIN
        for (text, size, bold), height in zip(texts, heights, strict=True):
            self.write(MARGIN, top, text, size=size, weight=_weight(bold), va="top")
            top -= height + GAP

    def write(self, x: float, y: float, text: str, **looks: Any) -> None:
        """Write a text; the place is in inches from the lower left corner of the figure."""
        self.figure.text(x / self.width, y / self.height, text, **{**PLAIN, **looks})

    def up(self, down: float) -> float:
        """Turn inches from the top of the room into inches from the bottom of the figure."""
        return self.height - self._above - down

    def axes(self, left: float, down: float, width: float, height: float, **kind: Any) -> Axes:
        """Add a panel.

        Args:
            left: Of its frame, from the left edge of the figure [inches].
            down: Of the top of its frame, from the top of the room [inches].
            width: Of its frame [inches].
            height: Of its frame [inches].
            kind: Such as ``projection="polar"``.
        """
        bottom = self.up(down) - height
        place = (
            left / self.width,
            bottom / self.height,
            width / self.width,
            height / self.height,
        )
        ax: Axes = self.figure.add_axes(place, **kind)
        ax.grid(color=FAINT, lw=0.5)
        ax.set_axisbelow(True)
        ax.tick_params(colors=INK, labelsize=8)
        return ax


def _legend(figure: Figure, handles: Sequence[Artist], width: float) -> float:
    """Write the legend in as many columns as fit, and give its height [inches]."""
    labels = [wrapped(str(one.get_label()), width - HANDLE, KEY) for one in handles]
    widest = max(text_size(label, KEY)[0] for label in labels) + HANDLE
    rows = math.ceil(len(labels) / max(1, int(width / widest)))
    columns = math.ceil(len(labels) / rows)
    made = figure.legend(
        handles, labels, ncol=columns, loc="lower center", frameon=False, fontsize=KEY,
        handlelength=2.6, columnspacing=1.5, borderaxespad=0.0, borderpad=0.2,
    )  # fmt: skip
    for text in made.get_texts():
        text.set_parse_math(False)
        text.set_color(INK)
    box = made.get_window_extent(figure.canvas.get_renderer())  # type: ignore[attr-defined]
    return float(box.height) / DPI + GAP
