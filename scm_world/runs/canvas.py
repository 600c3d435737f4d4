"""What all figures are drawn on. matplotlib is loaded when one is drawn, pyplot never."""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any, Literal, ParamSpec, TypeVar

from scm_world.runs.files import Location, write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

P = ParamSpec("P")
T = TypeVar("T")

WIDTH, HEIGHT, DPI = 1600, 900, 100  # [pixels], [pixels], [pixels/inch]
INK, FAINT = "#222222", "#c9ced6"
MARKERS = "osD^vPX*<>ph"
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Colors that differ for everyone; the yellow of the eight is left out, it is too pale on white.

Source:
    Okabe and Ito, *Color universal design*, 2008.
"""
STYLE: dict[Any, object] = {
    "text.parse_math": False,  # a name with two dollar signs is not a formula
    "font.size": 8,
    "axes.titlesize": 10,
    "axes.labelsize": 9,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": FAINT,
    "grid.linewidth": 0.5,
    "axes.edgecolor": "#8a94a3",
    "legend.frameon": False,
    **dict.fromkeys(("text.color", "axes.labelcolor", "xtick.color", "ytick.color"), INK),
}


def styled(draw: Callable[P, T]) -> Callable[P, T]:
    """Draw in the style of all figures of evaluations."""

    @wraps(draw)
    def inside(*args: P.args, **options: P.kwargs) -> T:
        import matplotlib

        with matplotlib.rc_context(STYLE):
            return draw(*args, **options)

    return inside


def blank(
    width: float = WIDTH / DPI,
    height: float = HEIGHT / DPI,
    *,
    layout: Literal["constrained"] | None = None,
) -> Figure:
    """Begin a figure of a width and a height [inches]."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=DPI, facecolor="white", layout=layout)
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: Location | str) -> None:
    """Write a figure whole or not at all; the same figure gives the same bytes."""
    write_whole(path, png(figure))


def png(figure: Figure) -> bytes:
    """Return a figure as PNG: 1600 pixels wide, or else with all that is drawn on or beyond it."""
    whole: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.15}
    made = io.BytesIO()
    figure.savefig(made, format="png", **{} if figure.get_figwidth() * DPI == WIDTH else whole)
    return made.getvalue()
