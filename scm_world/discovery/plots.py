"""Pictures of graphs. matplotlib is loaded when one is drawn; nothing here opens a window."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import networkx as nx

from scm_world.discovery.layers import Arrow, Drawing, lay_out
from scm_world.discovery.names import Families
from scm_world.discovery.report import DiscoveryReport
from scm_world.graph import SCM
from scm_world.output.canvas import FAINT, HEIGHT, INK, WIDTH, blank, save
from scm_world.output.locations import Location
from scm_world.queries.experiments.effects import EdgeKey

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DECLARED, MATCHED, EXTRA, MISSING = "#4a5568", "#1f6fb4", "#f28e2b", "#d62728"
AT_ONCE, LAGGED = "#5f6b7a", "#9a6fb0"
MARKERS = {0: "o", 1: ">"}
KINDS = {
    "exogenous": "#fff1c9",
    "derived": "#d9ecd5",
    "measured": "#d5e5f5",
    "action": "#f7d6d0",
    "fixed": "#e6e6e6",
}


# --- the two graphs of a discovery ---------------------------------------------------------------


@final
@dataclass(frozen=True)
class _Cell:
    """The edges between two families of variables with one lag.

    Attributes:
        matched: How many are found and declared.
        extra: How many are found, but not declared.
        missing: How many are declared, but not found.
        own: Whether not every member of one is declared to affect every member of the other:
            each block has its own size, say.
    """

    matched: int
    extra: int
    missing: int
    own: bool


@final
class _Matrix:
    """Who causes whom, with variables as rows and columns.

    Args:
        report: What was found.
    """

    def __init__(self, report: DiscoveryReport) -> None:
        self.report = report
        self.every = {*report.declared, *report.found}
        names = sorted({name for edge in self.every for name in edge[:2]})
        families = Families(names, report.declared)
        self.order = _entities_together(families, self.every)
        self.causes = [n for n in self.order if any(families.of[e[0]] == n for e in self.every)]
        self.effects = [n for n in self.order if any(families.of[e[1]] == n for e in self.every)]
        self.cells = self._cells(families)

    def _cells(self, families: Families) -> dict[EdgeKey, _Cell]:
        found, declared = set(self.report.found), set(self.report.declared)
        sets = (found & declared, found - declared, declared - found)
        counts: dict[EdgeKey, list[int]] = {}
        for number, edges in enumerate(sets):
            for cause, effect, lag in edges:
                key = (families.of[cause], families.of[effect], lag)
                counts.setdefault(key, [0, 0, 0])[number] += 1
        return {
            key: _Cell(matched, extra, missing, self._own(families, key, matched + missing))
            for key, (matched, extra, missing) in counts.items()
        }

    def _own(self, families: Families, key: EdgeKey, declared: int) -> bool:
        cause, effect, _ = key
        return 0 < declared < len(families.members[cause]) * len(families.members[effect])


def entity(label: str) -> str:
    """Give the entity of a name: what stands before the dot."""
    return label.partition(".")[0] if "." in label else ""


def _entities_together(families: Families, edges: Iterable[EdgeKey]) -> list[str]:
    """Order families entity by entity, causes before effects as far as there is an order."""
    graph = nx.DiGraph()
    graph.add_nodes_from(families.members)
    graph.add_edges_from((families.of[c], families.of[e]) for c, e, _ in sorted(edges))
    knots = nx.condensation(graph)
    depth: dict[str, int] = {}
    for level, layer in enumerate(nx.topological_generations(knots)):
        depth.update({name: level for knot in layer for name in knots.nodes[knot]["members"]})
    groups: dict[str, list[str]] = {}
    for name in sorted(depth, key=lambda n: (depth[n], n)):
        groups.setdefault(entity(name), []).append(name)
    mean = {e: sum(depth[n] for n in found) / len(found) for e, found in groups.items()}
    return [name for e in sorted(groups, key=lambda e: (mean[e], e)) for name in groups[e]]


def draw_graphs(report: DiscoveryReport, path: Location | str) -> None:
    """Draw the declared and the found graph side by side, as matrices.

    A column is a cause, a row an effect. A dot is an edge within the instant, a triangle one
    from one control step to the next. Variables with no edge in either graph are left out.

    Args:
        report: What was found.
        path: Of the PNG, 1600 x 900 pixels.
    """
    matrix = _Matrix(report)
    figure = blank()
    axes = figure.subplots(1, 2, sharey=True)
    figure.subplots_adjust(left=0.155, right=0.992, bottom=0.255, top=0.855, wspace=0.02)
    titles = (
        f"DECLARED: {len(report.declared)} edges",
        f"FOUND: {len(report.found)} edges",
    )
    for ax, title, draw in zip(axes, titles, (_draw_declared, _draw_found), strict=True):
        _grid(ax, matrix)
        ax.set_title(title, fontsize=13, color=INK, loc="left", pad=6)
        for (cause, effect, lag), cell in matrix.cells.items():
            spot = _spot(matrix, cause, effect, lag)
            draw(ax, spot, lag, cell)
    axes[0].set_ylabel("effect", fontsize=11, color=INK)
    _heading(figure, report)
    _legend(figure)
    save(figure, path)


def _spot(matrix: _Matrix, cause: str, effect: str, lag: int) -> tuple[float, float]:
    """Find the place of an edge; two lags of one pair stand side by side."""
    both = (cause, effect, 1 - lag) in matrix.cells
    aside = (0.26 if lag else -0.26) if both else 0.0
    return matrix.causes.index(cause) + aside, float(matrix.effects.index(effect))


def _grid(ax: Axes, matrix: _Matrix) -> None:
    """Label rows and columns, and set off the entities from one another."""
    ax.set_xlim(-0.5, max(len(matrix.causes), 1) - 0.5)
    ax.set_ylim(max(len(matrix.effects), 1) - 0.5, -0.5)
    size = max(5.0, min(10.0, 260.0 / max(len(matrix.effects), len(matrix.causes), 1)))
    ax.set_xticks(range(len(matrix.causes)), matrix.causes, rotation=90, fontsize=size)
    ax.set_yticks(range(len(matrix.effects)), matrix.effects, fontsize=size)
    ax.set_xlabel("cause", fontsize=11, color=INK)
    ax.tick_params(length=0, colors=INK)
    for spine in ax.spines.values():
        spine.set_color(FAINT)
    bands: tuple[tuple[list[str], Callable[..., Any]], ...] = (
        (matrix.causes, ax.axvspan),
        (matrix.effects, ax.axhspan),
    )
    for names, span in bands:
        entities = list(dict.fromkeys(map(entity, names)))
        for number, name in enumerate(names):
            if entities.index(entity(name)) % 2:
                span(number - 0.5, number + 0.5, color="#5a6b8c", alpha=0.09, lw=0, zorder=0)
    for x in range(len(matrix.causes)):
        ax.axvline(x, color=FAINT, lw=0.5, zorder=1)
    for y in range(len(matrix.effects)):
        ax.axhline(y, color=FAINT, lw=0.5, zorder=1)


def _mark(ax: Axes, spot: tuple[float, float], lag: int, cell: _Cell, color: str) -> None:
    """Draw edges; hollow where each member of a family has its own."""
    face, size = ("white", 36) if cell.own else (color, 46)
    width = 1.6 if cell.own else 0.0
    ax.scatter(*spot, s=size, marker=MARKERS[lag], fc=face, ec=color, zorder=3, lw=width)


def _draw_declared(ax: Axes, spot: tuple[float, float], lag: int, cell: _Cell) -> None:
    if cell.matched or cell.missing:
        _mark(ax, spot, lag, cell, DECLARED)


def _draw_found(ax: Axes, spot: tuple[float, float], lag: int, cell: _Cell) -> None:
    """Draw what was found, and over it what was missed or found too much."""
    if cell.matched:
        _mark(ax, spot, lag, cell, MATCHED)
    if cell.extra:
        ax.scatter(*spot, s=170, marker="s", color=EXTRA, zorder=2.5, lw=0)
        ax.scatter(*spot, s=40, marker=MARKERS[lag], color="white", zorder=3, lw=0)
    if cell.missing:
        ax.scatter(*spot, s=90, marker="X", fc="white", ec=MISSING, zorder=4, lw=1.6)
        ax.scatter(*spot, s=9, marker=MARKERS[lag], color=MISSING, zorder=5, lw=0)
    if cell.missing and cell.matched:
        label = f"{cell.missing} of {cell.missing + cell.matched} missed"
        place = {"xytext": (7, 5), "textcoords": "offset points"}
        ax.annotate(label, spot, color=MISSING, fontsize=7, zorder=6, **place)  # type: ignore[arg-type]


def _heading(figure: Figure, report: DiscoveryReport) -> None:
    score = report.score
    engine = f"{report.backend} {report.versions.get(report.backend, '')}".strip()
    title = f"{report.task} on {engine}"
    numbers = (
        f"SHD {score.shd}   precision {score.precision:.3f}   recall {score.recall:.3f}   "
        f"F1 {score.f1:.3f}   undeclared {len(score.undeclared)}   missed {len(score.missed)}   "
        f"{report.probes} probe states, {report.rollouts} rollouts"
    )
    figure.text(0.012, 0.955, title, fontsize=17, weight="bold", color=INK)
    figure.text(0.012, 0.918, numbers, fontsize=12, color=INK)


def _hollow(color: str) -> dict[str, Any]:
    return {"markerfacecolor": "white", "markeredgecolor": color, "markeredgewidth": 1.6}


def _legend(figure: Figure) -> None:
    from matplotlib.lines import Line2D

    def key(marker: str, label: str, color: str, **style: Any) -> Line2D:
        look = {"markersize": 8, "markeredgewidth": 0, **style}
        return Line2D([], [], ls="", marker=marker, color=color, label=label, **look)

    handles = [
        key("o", "at once", DECLARED),
        key(">", "one control step later", DECLARED),
        key("o", "each its own", DECLARED, **_hollow(DECLARED)),
        key("o", "found and declared", MATCHED),
        key("s", "found, not declared", EXTRA, markersize=11),
        key("X", "declared, not found", MISSING, **_hollow(MISSING)),
    ]
    figure.legend(
        handles=handles,
        ncol=2,
        frameon=False,
        fontsize=10,
        loc="upper right",
        bbox_to_anchor=(0.995, 0.995),
    )


# --- a declared model ---------------------------------------------------------------------------


def draw_model(model: SCM, path: Location | str, *, title: str = "") -> None:
    """Draw a model as a layered graph, causes left of effects.

    Variables that differ in numbers only and have the same edges are one node. Where several
    variables have the same causes of one step before, the arrows run through one node.

    Args:
        model: Any model.
        path: Of the PNG, 1600 x 900 pixels.
        title: What the model is.
    """
    drawing = lay_out(model)
    figure = blank()
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    ax.set_xlim(0, WIDTH)
    ax.set_ylim(HEIGHT, 0)
    ax.axis("off")
    for arrow in drawing.arrows:
        _arrow(ax, arrow)
    for name, (x, y) in drawing.places.items():
        _node(ax, drawing, name, x, y)
    ax.text(20, 34, title or "causal model", fontsize=17, weight="bold", color=INK)
    size = f"{len(model)} variables, {len(model.edges)} edges"
    ax.text(20, 62, size, fontsize=12, color=INK)
    _model_legend(ax, drawing)
    save(figure, path)


def _arrow(ax: Axes, arrow: Arrow) -> None:
    """Draw one arrow as a smooth line that leaves and arrives horizontally."""
    from matplotlib.patches import FancyArrowPatch
    from matplotlib.path import Path as Line

    points, codes = [arrow.path[0]], [Line.MOVETO]
    for (x0, y0), (x1, y1) in zip(arrow.path, arrow.path[1:], strict=False):
        bend = 0.5 * (x1 - x0)
        points += [(x0 + bend, y0), (x1 - bend, y1), (x1, y1)]
        codes += [Line.CURVE4] * 3
    patch = FancyArrowPatch(
        path=Line(points, codes),
        arrowstyle="<|-|>" if arrow.both else "-|>",
        mutation_scale=9,
        color=LAGGED if arrow.lag else AT_ONCE,
        linestyle=(0, (4, 2.5)) if arrow.lag else "solid",
        lw=1.1,
        shrinkA=0,
        shrinkB=0,
        zorder=1,
    )
    ax.add_patch(patch)


def _node(ax: Axes, drawing: Drawing, name: str, x: float, y: float) -> None:
    from matplotlib.patches import FancyBboxPatch

    width, height = drawing.box
    kind = drawing.kinds[name]
    face, ink = (INK, "white") if kind == "hub" else (KINDS[kind], INK)
    corner = (x - width / 2, y - height / 2)
    look = {"boxstyle": "round,pad=0,rounding_size=6", "fc": face, "ec": "#6b7686", "lw": 0.8}
    ax.add_patch(FancyBboxPatch(corner, width, height, zorder=3, **look))  # type: ignore[arg-type]
    upper, dot, lower = name.strip().partition(".")
    text = f"{upper}.\n{lower}" if dot else upper
    longest = max(map(len, text.split("\n")))
    size = min(9.0, 1.15 * width / longest)
    center = {"ha": "center", "va": "center", "linespacing": 1.05}
    ax.text(x, y, text, fontsize=size, color=ink, zorder=4, **center)  # type: ignore[arg-type]
    if name in drawing.loops:
        _loop(ax, x, y - height / 2)


def _loop(ax: Axes, x: float, y: float) -> None:
    """Draw the arrow from a node to itself, one control step later."""
    from matplotlib.patches import FancyArrowPatch

    loop = FancyArrowPatch(
        (x - 16, y),
        (x + 16, y),
        connectionstyle="arc3,rad=-1.3",
        arrowstyle="-|>",
        mutation_scale=8,
        color=LAGGED,
        linestyle=(0, (3, 2)),
        shrinkA=0,
        shrinkB=0,
        zorder=2,
    )
    ax.add_patch(loop)


def _model_legend(ax: Axes, drawing: Drawing) -> None:
    """Explain colors and lines, and list the variables that have no edge."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    kinds = [kind for kind in KINDS if kind in drawing.kinds.values()]
    handles: list[Any] = [Patch(fc=KINDS[kind], ec="#6b7686", label=kind) for kind in kinds]
    handles.append(Line2D([], [], color=AT_ONCE, label="at once"))
    handles.append(Line2D([], [], color=LAGGED, ls="--", label="one control step later"))
    if "hub" in drawing.kinds.values():
        label = "each arrow in stands for one to every node it points at"
        handles.append(Patch(fc=INK, label=label))
    ax.legend(
        handles=handles,
        ncol=4,
        frameon=False,
        fontsize=10,
        loc="upper right",
        bbox_to_anchor=(0.995, 0.995),
    )
    if drawing.alone:
        words = textwrap.fill(f"No edge at all: {', '.join(drawing.alone)}", 190)
        ax.text(20, HEIGHT - 18, words, fontsize=10, color=INK, va="bottom")
