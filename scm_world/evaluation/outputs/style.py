"""How figures of evaluations look: colors, hatches, markers, titles, legends."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

from scm_world.evaluation.outputs.labels import Line
from scm_world.output.canvas import PALETTE

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

HATCHES = ("", "////", "....", "xxxx", "----", "oooo")
MARKERS = "osD^vPX*<>ph"
DASHES: Sequence[Any] = ("solid", (0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)))
PALER = (0.0, 0.6, 0.85, 0.4)  # how much white is mixed into the color, by engine


@final
@dataclass(frozen=True)
class Look:
    """How a line looks: agents differ in color, hatch and marker, engines in dashes and paleness.

    Attributes:
        label: In legends.
        line: Arguments of a line.
        bar: Arguments of a bar.
    """

    label: str
    line: Mapping[str, Any]
    bar: Mapping[str, Any]


def looks_of(lines: Sequence[Line]) -> dict[Line, Look]:
    """Choose how all lines of a figure look."""
    agents = list(dict.fromkeys(line.agent for line in lines))
    engines = list(dict.fromkeys(line.engine for line in lines))
    found = {}
    for line in lines:
        a, e = agents.index(line.agent), engines.index(line.engine)
        color, group = PALETTE[a % len(PALETTE)], a // len(PALETTE)
        white, rgb = PALER[e % len(PALER)], [int(color[i : i + 2], 16) for i in (1, 3, 5)]
        face = "#" + "".join(f"{round(part + (255 - part) * white):02x}" for part in rgb)
        name = line.agent if len(engines) == 1 else f"{line.agent} on {line.engine}"
        found[line] = Look(
            textwrap.fill(name, 60),
            {
                "color": color,
                "marker": MARKERS[a % len(MARKERS)],
                "linestyle": DASHES[e % len(DASHES)],
                "markersize": 5.0,
                "linewidth": 1.5,
            },
            {
                "facecolor": face,
                "edgecolor": "white" if group and not white else color,
                "hatch": HATCHES[group % len(HATCHES)],
                "linewidth": 0.9,
            },
        )
    return found


def framed(
    figure: Figure, title: str, note: str, handles: Sequence[Artist], beyond: float = 0.0
) -> Figure:
    """Put title and note above what is drawn, and the legend below it.

    They lie beyond the edges of the figure; it is written with whatever is drawn on it.

    Args:
        figure: All of it is drawn on.
        title: In bold letters.
        note: Below the title; broken into lines.
        handles: Entries of the legend.
        beyond: How far labels reach beyond the figure [inches].
    """
    width, height = figure.get_size_inches()
    above = textwrap.wrap(note, max(60, int(width * 13)))
    top = 1.0 + (beyond + 0.1) / height
    figure.text(0.0, top, "\n".join(above), va="bottom", size=9, linespacing=1.3)
    head = textwrap.fill(title, max(40, int(width * 8)))
    above_note = top + (len(above) * 0.163 + 0.08) / height
    figure.text(0.0, above_note, head, va="bottom", size=12, weight="bold")
    if handles:
        longest = max(len(part) for one in handles for part in str(one.get_label()).split("\n"))
        rows = math.ceil(len(handles) / max(1, int(width / (0.8 + 0.08 * longest))))
        columns = math.ceil(len(handles) / rows)
        place: Any = {"bbox_to_anchor": (0.5, -beyond / height), "loc": "upper center"}
        figure.legend(handles=handles, ncol=columns, fontsize=9, handlelength=2.6, **place)
    return figure


def beside(ax: Axes, x: float, y: float, text: str, **looks: Any) -> None:
    """Write a text to the right of a point."""
    place: dict[str, Any] = {"xytext": (5, 0), "textcoords": "offset points", "va": "center"}
    ax.annotate(text, (x, y), annotation_clip=False, **place, **looks)
