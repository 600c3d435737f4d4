"""The sheet that all pictures are drawn on. matplotlib is loaded when one is drawn."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH, HEIGHT, DPI = 1600, 900, 100  # [pixels], [pixels], [pixels/inch]
INK, FAINT = "#222222", "#c9ced6"


def blank() -> Figure:
    """Begin a picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH / DPI, HEIGHT / DPI), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: Path | str) -> None:
    """Write the picture whole or not at all."""
    target = Path(path)
    part = target.with_name(target.name + ".part")
    figure.savefig(part, format="png")
    part.replace(target)
