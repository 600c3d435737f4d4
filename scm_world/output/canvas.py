"""The sheet that all pictures are drawn on. matplotlib is loaded when one is drawn."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

from scm_world.output.durable import write_durably
from scm_world.output.locations import Location

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH, HEIGHT, DPI = 1600, 900, 100  # [pixels], [pixels], [pixels/inch]
INK, FAINT = "#222222", "#c9ced6"
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Colors that differ for everyone; the yellow of the eight is left out, it is too pale on white.

Source:
    Okabe and Ito, *Color universal design*, 2008.
"""
COLORS = 64  # of a picture in a page: a third of the bytes


def blank() -> Figure:
    """Begin a picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH / DPI, HEIGHT / DPI), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: Location | str) -> None:
    """Write the picture whole or not at all.

    Raises:
        UnwritableFolder: There is no such folder, no room, or no permission.
    """
    write_durably(path, png(figure))


def png(figure: Figure) -> bytes:
    """Give the picture as it is."""
    made = io.BytesIO()
    figure.savefig(made, format="png")
    return made.getvalue()


def small_png(figure: Figure) -> bytes:
    """Give the picture with 64 colors, for a page that holds its pictures in itself."""
    from PIL import Image  # matplotlib brings it

    small = io.BytesIO()
    with Image.open(io.BytesIO(png(figure))) as image:
        image.convert("RGB").quantize(COLORS).save(small, format="png", optimize=True)
    return small.getvalue()
