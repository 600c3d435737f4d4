"""Panels with a slot for each protocol, as many rows of them as need be."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

from scm_world.evaluation.outputs.looks import is_fraction
from scm_world.evaluation.outputs.sheets import GAP, MARGIN, PLAIN, Sheet, balanced, text_size
from scm_world.output.canvas import INK

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

WIDEST = 20.0  # [inches] of slots side by side, unless one alone is wider
LEFT = 0.85  # [inches] for the numbers and the name of the axis
PANEL = 2.9  # [inches]: height of a panel
DROP = 0.08  # [inches] from the axis down to the names
NAME, DOC = 10.0, 8.0  # [points]
LEAST = 0.92  # [inches]: a slot holds a word of what varies


@final
@dataclass(frozen=True)
class Slot:
    """A protocol below an axis: its name and what varies, broken into lines."""

    protocol: str
    name: str
    doc: str

    @property
    def heights(self) -> tuple[float, float]:
        """Heights of the two texts [inches]."""
        name = text_size(self.name, NAME, bold=True)[1]
        return name, text_size(self.doc, DOC)[1] if self.doc else 0.0


@final
class Strips:
    """A sheet with rows of protocols.

    Args:
        words: What varies, by protocol.
        width: Of a slot [inches].
        repeat: How many panels stand one below the other for the same protocols.
        looks: Title, note and handles of the sheet.
    """

    def __init__(
        self, words: dict[str, str], width: float, *, repeat: int = 1, **looks: Any
    ) -> None:
        self.slot = max(width, LEAST)
        room = self.slot - 0.1
        slots = [
            Slot(name, balanced(name, room, NAME, bold=True), balanced(doc, room, DOC))
            for name, doc in words.items()
        ]
        rows = math.ceil(len(slots) / max(1, int(WIDEST / self.slot)))
        across = math.ceil(len(slots) / rows)
        self._rows = [slots[i : i + across] for i in range(0, len(slots), across)] * repeat
        self._below = [DROP + max(sum(slot.heights) + 0.05 for slot in row) for row in self._rows]
        height = sum(PANEL + below + 2 * GAP for below in self._below)
        handles: Sequence[Artist] = looks.pop("handles", ())
        self.sheet = Sheet(LEFT + across * self.slot + MARGIN, height, handles=handles, **looks)

    def panels(self) -> Iterator[tuple[Axes, list[str]]]:
        """Make the panels, each with its protocols; that of number i stands at x = i."""
        down = GAP
        for row, below in zip(self._rows, self._below, strict=True):
            width = len(row) * self.slot
            ax = self.sheet.axes(LEFT, down, width, PANEL)
            ax.set_xlim(-0.5, len(row) - 0.5)
            ax.set_xticks([])
            ax.grid(visible=False, axis="x")
            for place, slot in enumerate(row):
                _name(ax, place, slot)
            for edge in range(1, len(row)):
                ax.axvline(edge - 0.5, color="#e6e9ee", lw=0.8, zorder=0.5)
            yield ax, [slot.protocol for slot in row]
            down += PANEL + below + 2 * GAP


def _name(ax: Axes, place: int, slot: Slot) -> None:
    """Write the name of a protocol below an axis, and what varies below the name."""
    down = DROP
    looks = ((slot.name, NAME, "bold"), (slot.doc, DOC, "normal"))
    for (text, size, weight), height in zip(looks, slot.heights, strict=True):
        if text:
            ax.annotate(
                text, (place, 0.0), xycoords=("data", "axes fraction"), xytext=(0, -72 * down),
                textcoords="offset points", ha="center", va="top", size=size, weight=weight,
                **PLAIN,
            )  # fmt: skip
        down += height + 0.05


def value_axis(ax: Axes, metric: str, label: str, ends: Sequence[float]) -> None:
    """Prepare the axis of scores: from 0 to 1 with both lines drawn, or free for returns.

    Args:
        ax: The panel.
        metric: What is drawn.
        label: Name of the axis.
        ends: All values that must be seen.
    """
    seen = [0.0, *ends, *([1.0] if is_fraction(metric) else [])]
    low, high = min(seen), max(seen)
    room = 0.06 * ((high - low) or 1.0)
    ax.set_ylim(low - (room if low < 0.0 else 0.25 * room), high + 2.0 * room)
    for line in (0.0, 1.0) if is_fraction(metric) else (0.0,):
        ax.axhline(line, color=INK, lw=0.9, zorder=1.5, gid=f"line {line:g}")
    ax.set_ylabel(label, size=9, **PLAIN)
