"""Figures: estimated graphs beside declared ones, a model in layers, and verifications."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, final

import networkx as nx

from scm_world.discovery.names import Families, by_entity
from scm_world.discovery.run import DiscoveryReport
from scm_world.graph import SCM
from scm_world.graph.exchange.html import (
    FILLS,
    columns_of,
    forward,
    heights_of,
    neighbors_of,
    routes_of,
)
from scm_world.output.canvas import DPI, FAINT, INK, WIDTH, blank, save
from scm_world.output.remote import Location
from scm_world.queries.agreement import FACTORS, Agreement
from scm_world.queries.experiments.effects import EdgeKey
from scm_world.queries.verification import Verification, arrow

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DECLARED, MATCHED, EXTRA, MISSING = "#4a5568", "#1f6fb4", "#f28e2b", "#d62728"
LAG_0, LAG_1 = "#5f6b7a", "#9a6fb0"
MARKERS = {0: "o", 1: ">"}
HUB = "one control step"
BOX, GAP, LANE = 30.0, 8.0, 22.0  # [pixels]: height of a node, between two, of an edge that passes

# --- the two graphs of a discovery ---------------------------------------------------------------


def draw_graphs(report: DiscoveryReport, path: Location | str) -> None:
    """Draw the declared and the estimated graph side by side, as matrices.

    A column is a cause, a row an effect. A dot is a contemporaneous edge, a triangle one
    from one control step to the next; it is hollow where not every member of a family of variables
    is declared to affect every member of the other. Variables with no edge in either graph are
    left out.

    Args:
        report: The result of a discovery.
        path: Of the PNG, 1600 x 900 pixels.
    """
    found, declared = set(report.found), set(report.declared)
    every = sorted(found | declared)
    families = Families(sorted({name for edge in every for name in edge[:2]}), report.declared)
    order = _entities_together(families, every)
    causes = [n for n in order if any(families.of[edge[0]] == n for edge in every)]
    effects = [n for n in order if any(families.of[edge[1]] == n for edge in every)]
    cells: dict[EdgeKey, list[EdgeKey]] = {}
    for edge in every:
        cells.setdefault((families.of[edge[0]], families.of[edge[1]], edge[2]), []).append(edge)
    figure = blank()
    axes = figure.subplots(1, 2, sharey=True)
    figure.subplots_adjust(left=0.155, right=0.992, bottom=0.255, top=0.855, wspace=0.02)
    for ax in axes:
        _grid(ax, causes, effects)
    axes[0].set_title(f"DECLARED: {len(declared)} edges", fontsize=13, color=INK, loc="left", pad=6)
    axes[1].set_title(f"ESTIMATED: {len(found)} edges", fontsize=13, color=INK, loc="left", pad=6)
    axes[0].set_ylabel("effect", fontsize=11, color=INK)
    for (cause, effect, lag), edges in cells.items():
        both = (cause, effect, 1 - lag) in cells  # two lags of one pair stand side by side
        x = causes.index(cause) + ((0.26 if lag else -0.26) if both else 0.0)
        counts = [len({*edges} & one) for one in (found & declared, found - declared)]
        right, missed = counts[0], len({*edges} & (declared - found))
        most = len(families.members[cause]) * len(families.members[effect])
        hollow = 0 < right + missed < most
        y = effects.index(effect)
        if right or missed:
            _mark(axes[0], x, y, lag, DECLARED, hollow=hollow)
        if right:
            _mark(axes[1], x, y, lag, MATCHED, hollow=hollow)
        if counts[1]:
            axes[1].scatter(x, y, s=170, marker="s", color=EXTRA, zorder=2.5, lw=0)
            axes[1].scatter(x, y, s=40, marker=MARKERS[lag], color="white", zorder=3, lw=0)
        if missed:
            axes[1].scatter(x, y, s=90, marker="X", fc="white", ec=MISSING, zorder=4, lw=1.6)
            axes[1].scatter(x, y, s=9, marker=MARKERS[lag], color=MISSING, zorder=5, lw=0)
        if missed and right:
            axes[1].annotate(
                f"{missed} of {missed + right} missed", (x, y), xytext=(7, 5), fontsize=7,
                textcoords="offset points", color=MISSING, zorder=6,
            )  # fmt: skip
    score = report.score
    engine = f"{report.backend} {report.versions.get(report.backend, '')}".strip()
    numbers = (
        f"SHD {score.shd}   precision {score.precision:.3f}   recall {score.recall:.3f}   "
        f"F1 {score.f1:.3f}   undeclared {len(score.undeclared)}   missed {len(score.missed)}   "
        f"{report.probes} probe states, {report.rollouts} rollouts"
    )
    title: Any = {"fontsize": 17, "weight": "bold", "color": INK}
    figure.text(0.012, 0.955, f"{report.task} on {engine}", **title)
    figure.text(0.012, 0.918, numbers, fontsize=12, color=INK)
    handles = [
        _key("o", "contemporaneous", DECLARED),
        _key(">", "one control step later", DECLARED),
        _key("o", "each its own", DECLARED, hollow=True),
        _key("o", "declared and estimated", MATCHED),
        _key("s", "estimated, not declared", EXTRA, size=11),
        _key("X", "declared, not estimated", MISSING, hollow=True),
    ]
    corner: Any = {"loc": "upper right", "bbox_to_anchor": (0.995, 0.995)}
    figure.legend(handles=handles, ncol=2, frameon=False, fontsize=10, **corner)
    save(figure, path)


def _entity(name: str) -> str:
    return name.partition(".")[0] if "." in name else ""


def _entities_together(families: Families, edges: Iterable[EdgeKey]) -> list[str]:
    """Order families entity by entity, causes before effects as far as there is an order."""
    graph = nx.DiGraph()
    graph.add_nodes_from(families.members)
    graph.add_edges_from((families.of[c], families.of[e]) for c, e, _ in edges)
    knots = nx.condensation(graph)
    depth: dict[str, int] = {}
    for level, layer in enumerate(nx.topological_generations(knots)):
        depth.update({name: level for knot in layer for name in knots.nodes[knot]["members"]})
    groups: dict[str, list[str]] = {}
    for name in sorted(depth, key=lambda n: (depth[n], n)):
        groups.setdefault(_entity(name), []).append(name)
    mean = {e: sum(depth[n] for n in found) / len(found) for e, found in groups.items()}
    return [name for e in sorted(groups, key=lambda e: (mean[e], e)) for name in groups[e]]


def _grid(ax: Axes, causes: Sequence[str], effects: Sequence[str]) -> None:
    ax.set_xlim(-0.5, max(len(causes), 1) - 0.5)
    ax.set_ylim(max(len(effects), 1) - 0.5, -0.5)
    size = max(5.0, min(10.0, 260.0 / max(len(effects), len(causes), 1)))
    ax.set_xticks(range(len(causes)), causes, rotation=90, fontsize=size)
    ax.set_yticks(range(len(effects)), effects, fontsize=size)
    ax.set_xlabel("cause", fontsize=11, color=INK)
    ax.tick_params(length=0, colors=INK)
    ax.grid(color=FAINT, lw=0.5)
    ax.set_axisbelow(True)
    for spine in ax.spines.values():
        spine.set_color(FAINT)
    for names, span in ((causes, ax.axvspan), (effects, ax.axhspan)):
        entities = list(dict.fromkeys(map(_entity, names)))
        for number, name in enumerate(names):
            if entities.index(_entity(name)) % 2:
                span(number - 0.5, number + 0.5, color="#5a6b8c", alpha=0.09, lw=0, zorder=0)


def _mark(ax: Axes, x: float, y: float, lag: int, color: str, *, hollow: bool) -> None:
    face, size, width = ("white", 36, 1.6) if hollow else (color, 46, 0.0)
    ax.scatter(x, y, s=size, marker=MARKERS[lag], fc=face, ec=color, zorder=3, lw=width)


def _key(marker: str, label: str, color: str, *, hollow: bool = False, size: float = 8) -> Any:
    from matplotlib.lines import Line2D

    face, width = ("white", 1.6) if hollow else (color, 0)
    return Line2D(
        [], [], ls="", marker=marker, label=label, markersize=size, markerfacecolor=face,
        markeredgecolor=color, markeredgewidth=width,
    )  # fmt: skip


# --- a declared model ---------------------------------------------------------------------------


@final
@dataclass(frozen=True)
class LayeredModel:
    """A model in layers [pixels], y downwards.

    Attributes:
        places: Center of each node.
        kinds: Kind of each node; ``"hub"`` for a node that stands for many edges.
        box: Width and height of a node.
        arrows: Points from cause to effect, the lag, and whether it also points back.
        loops: Nodes that affect themselves.
        alone: Variables without any edge, in few words.
        height: Of all of it.
    """

    places: dict[str, tuple[float, float]]
    kinds: dict[str, str]
    box: tuple[float, float]
    arrows: tuple[tuple[tuple[tuple[float, float], ...], int, bool], ...]
    loops: tuple[str, ...]
    alone: tuple[str, ...]
    height: float


def lay_out(model: SCM) -> LayeredModel:
    """Return places for families of variables; lagged edges of many causes run through hubs."""
    families = Families(model, (edge.key for edge in model.edges))
    graph = nx.DiGraph()
    for edge in model.edges:
        cause, effect = families.of[edge.cause], families.of[edge.effect]
        lags = graph.get_edge_data(cause, effect, {"lags": set()})["lags"]
        graph.add_edge(cause, effect, lags={edge.lag, *lags})
    hubs = _bundle(graph)
    ahead = forward(graph)
    ahead.add_edges_from((hub, effect) for hub in hubs for effect in graph.successors(hub))
    column = columns_of(ahead)
    routes = routes_of(ahead, column)
    items = column | {item: item[2] for route in routes.values() for item in route[1:-1]}
    y = heights_of(
        items, neighbors_of(routes.values()), lambda i: BOX + GAP if isinstance(i, str) else LANE
    )
    step = WIDTH / (max(column.values(), default=0) + 1)
    half = min(170.0, 0.72 * step) / 2.0
    at = {item: (step * (number + 0.5), y[item]) for item, number in items.items()}
    arrows = []
    for (cause, effect), route in routes.items():
        lanes = [(at[i][0] + side, at[i][1]) for i in route[1:-1] for side in (-half, half)]
        start, end = (at[cause][0] + half, at[cause][1]), (at[effect][0] - half, at[effect][1])
        back = graph.has_edge(effect, cause) and not ahead.has_edge(effect, cause)
        lags = sorted(graph.edges[cause, effect]["lags"])
        for lag in lags:
            aside = (8.0 * lag - 4.0) if len(lags) > 1 else 0.0
            points = tuple((x, height + aside) for x, height in (start, *lanes, end))
            arrows.append((points, lag, back))
    first: dict[str, Any] = {name: model.declared(m[0]) for name, m in families.members.items()}
    return LayeredModel(
        places={name: at[name] for name in graph},
        kinds={name: "hub" if name in hubs else first[name].kind for name in graph},
        box=(2.0 * half, BOX),
        arrows=tuple(arrows),
        loops=tuple(name for name in graph if graph.has_edge(name, name)),
        alone=tuple(by_entity(name for name in model if families.of[name] not in graph)),
        height=max(y.values(), default=0.0) + BOX,
    )


def _bundle(graph: nx.DiGraph) -> list[str]:
    """Run the lagged edges of several effects with the same causes through one node each."""
    bundles: dict[frozenset[str], list[str]] = {}
    for name in graph:
        causes = frozenset(c for c, _, lags in graph.in_edges(name, data="lags") if 1 in lags)
        bundles.setdefault(causes, []).append(name)
    hubs: list[str] = []
    for causes, effects in bundles.items():
        if len(causes) > 2 and len(effects) > 1:
            hubs.append(HUB + " " * len(hubs))
            for effect in effects:
                for cause in sorted(causes):
                    lags = graph.edges[cause, effect]["lags"]
                    lags.discard(1)
                    if not lags:
                        graph.remove_edge(cause, effect)
                    graph.add_edge(cause, hubs[-1], lags={1})
                graph.add_edge(hubs[-1], effect, lags={1})
    return hubs


def draw_model(model: SCM, path: Location | str, *, title: str = "") -> None:
    """Draw a model as a layered graph, causes left of effects.

    Variables that differ in numbers only and have the same edges are one node. Where several
    variables have the same causes of one step before, the arrows run through one node.

    Args:
        model: Any model.
        path: Of the PNG, 1600 pixels wide and as high as it takes.
        title: What the model is.
    """
    from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
    from matplotlib.path import Path as Line

    drawing = lay_out(model)
    alone = textwrap.fill(f"No edge at all: {', '.join(drawing.alone)}", 190)
    below = 22.0 * (alone.count("\n") + 1) + 10.0 if drawing.alone else 10.0
    top, height = 85.0, 85.0 + drawing.height + below
    figure = blank(WIDTH / DPI, height / DPI)
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    ax.set_xlim(0, WIDTH)
    ax.set_ylim(height - top, -top)
    ax.axis("off")
    for points, lag, both in drawing.arrows:
        line, codes = [points[0]], [Line.MOVETO]
        for (x0, y0), (x1, y1) in pairwise(points):  # it leaves and arrives horizontally
            bend = 0.5 * (x1 - x0)
            line += [(x0 + bend, y0), (x1 - bend, y1), (x1, y1)]
            codes += [Line.CURVE4] * 3
        style: Any = {"arrowstyle": "<|-|>" if both else "-|>", "mutation_scale": 9, "lw": 1.1}
        style |= {"color": LAG_1 if lag else LAG_0, "ls": (0, (4, 2.5)) if lag else "solid"}
        ax.add_patch(FancyArrowPatch(path=Line(line, codes), shrinkA=0, shrinkB=0, **style))
    width, high = drawing.box
    for name, (x, y) in drawing.places.items():
        hub = drawing.kinds[name] == "hub"
        face, ink = (INK, "white") if hub else (FILLS[drawing.kinds[name]], INK)
        look: Any = {"boxstyle": "round,pad=0,rounding_size=6", "fc": face, "ec": "#6b7686"}
        corner = (x - width / 2, y - high / 2)
        ax.add_patch(FancyBboxPatch(corner, width, high, lw=0.8, zorder=3, **look))
        upper, dot, lower = name.strip().partition(".")
        text = f"{upper}.\n{lower}" if dot else upper
        size = min(9.0, 1.15 * width / max(map(len, text.split("\n"))))
        place: Any = {"ha": "center", "va": "center", "linespacing": 1.05, "zorder": 4}
        ax.text(x, y, text, fontsize=size, color=ink, **place)
        if name in drawing.loops:
            style = {"connectionstyle": "arc3,rad=-1.3", "arrowstyle": "-|>", "mutation_scale": 8}
            style |= {"color": LAG_1, "ls": (0, (3, 2)), "shrinkA": 0, "shrinkB": 0, "zorder": 2}
            ends = ((x - 16, y - high / 2), (x + 16, y - high / 2))
            ax.add_patch(FancyArrowPatch(*ends, **style))
    ax.text(20, 34 - top, title or "causal model", fontsize=17, weight="bold", color=INK)
    counts = f"{len(model)} variables, {len(model.edges)} edges"
    ax.text(20, 62 - top, counts, fontsize=12, color=INK)
    if drawing.alone:
        ax.text(20, height - top - 10, alone, fontsize=10, color=INK, va="bottom")
    _legend(ax, set(drawing.kinds.values()))
    save(figure, path)


def _legend(ax: Axes, kinds: set[str]) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [
        Patch(fc=fill, ec="#6b7686", label=kind) for kind, fill in FILLS.items() if kind in kinds
    ]
    handles.append(Line2D([], [], color=LAG_0, label="contemporaneous"))
    handles.append(Line2D([], [], color=LAG_1, ls="--", label="one control step later"))
    if "hub" in kinds:
        label = "each arrow in stands for one to every node it points at"
        handles.append(Patch(fc=INK, label=label))
    place: Any = {"loc": "upper right", "bbox_to_anchor": (0.995, 0.995)}
    ax.legend(handles=handles, ncol=4, frameon=False, fontsize=10, **place)


SHADES = ("#1f6fb4", "#f28e2b", "#4c9a6a", "#9a6fb0")
GOOD, BAD = "#4c9a6a", "#d62728"
LISTED = 26  # lines of names that fit


def draw_verification(found: Verification | Agreement, path: Location | str) -> None:
    """Draw how soon edges fired, what is wrong, and the signs on two engines.

    Args:
        found: A verification, or that of two engines.
        path: Of the PNG, 1600 x 900 pixels.
    """
    both = isinstance(found, Agreement)
    reports = found.verifications if isinstance(found, Agreement) else (found,)
    figure = blank()
    color, verdict = (GOOD, "passed") if found.passed else (BAD, "not passed")
    title: Any = {"fontsize": 18, "weight": "bold"}
    figure.text(0.02, 0.945, f"Verification of {reports[0].task}", color=INK, **title)
    figure.text(0.98, 0.945, verdict, ha="right", color=color, **title)
    words = "     ".join(
        f"{one.backend} {one.versions.get(one.backend, '')}: floor {one.floor:g}, "
        f"{len(one.undeclared)} undeclared, {len(one.never_fired)} never seen, "
        f"{one.rollouts:,} rollouts"
        for one in reports
    )
    figure.text(0.02, 0.9, words, fontsize=11, color=INK)
    _coverage(figure.add_axes((0.055, 0.09, 0.36, 0.72)), reports)
    if isinstance(found, Agreement):
        _signs(figure.add_axes((0.46, 0.09, 0.27, 0.72)), found)
    _names(figure, 0.765 if both else 0.47, found)
    save(figure, path)


def _coverage(ax: Axes, reports: Iterable[Verification]) -> None:
    """Draw the share of the declared edges that had fired after each probe state."""
    from matplotlib.ticker import MaxNLocator

    lowest = 1.0
    for found, shade in zip(reports, SHADES, strict=False):
        declared = len(found.declared)
        share = [count / declared if declared else 1.0 for count in found.coverage]
        label = f"{found.backend}: {len(found.fired)} of {declared}"
        numbers = range(1, len(share) + 1)
        ax.step(numbers, share, where="mid", color=shade, lw=2.2, label=label, alpha=0.85)
        lowest = min(lowest, *share)
    ax.axhline(1.0, color=FAINT, lw=1.0, zorder=0)
    ax.set_ylim(lowest - 0.08 * (1.02 - lowest) - 0.002, 1.0 + 0.06 * (1.02 - lowest))
    ax.yaxis.set_major_formatter(lambda y, _: f"{round(100 * y, 3):g} %" if y <= 1.0 else "")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_title("declared edges seen", loc="left", fontsize=13, color=INK)
    ax.set_xlabel("probe states", fontsize=11, color=INK)
    ax.legend(loc="lower right", frameon=False, fontsize=11)
    _plain(ax)


def _signs(ax: Axes, found: Agreement) -> None:
    """Draw bars of equal signs: the clearer the effects, the further to the right."""
    shares = [found.at(factor) for factor in FACTORS]
    for number, share in enumerate(shares):
        part = share.edges_equal / share.edges if share.edges else 0.0
        ax.bar(number, part, color=GOOD, alpha=0.35 + 0.2 * number, width=0.7)
        label = f"{100 * part:.1f} %\n{share.edges_equal}/{share.edges}" if share.edges else "none"
        ax.text(number, part + 0.015, label, ha="center", fontsize=9, color=INK)
    ax.set_ylim(0.0, 1.12)
    ax.set_xticks(range(len(shares)), [f"> {share.factor:g}" for share in shares])
    ax.set_yticks([])
    ax.set_title(f"same sign on {' and '.join(found.backends)}", loc="left", fontsize=13, color=INK)
    ax.set_xlabel("effect / what the engines differ by anyway", fontsize=11, color=INK)
    _plain(ax)


def _plain(ax: Axes) -> None:
    ax.tick_params(colors=INK)
    for side, spine in ax.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(FAINT)


def _wrong(found: Verification | Agreement) -> Iterator[tuple[str, tuple[EdgeKey, ...]]]:
    if isinstance(found, Agreement):
        for report in found.verifications:
            yield from _wrong(report)
        yield "sign not the same", found.opposite
        return
    yield f"{found.backend}, never seen", found.never_fired
    yield f"{found.backend}, undeclared", tuple(edge.key for edge in found.undeclared)
    yield f"{found.backend}, color moves something", found.colors


def _names(figure: Figure, left: float, found: Verification | Agreement) -> None:
    """Name the edges with which something is wrong."""
    lines: list[tuple[str, str]] = []
    for title, edges in _wrong(found):
        if edges:
            lines.append((f"{title}: {len(edges)}", "bold"))
            for edge in edges:
                parts = textwrap.wrap(arrow(edge), 48, subsequent_indent="    ")
                lines += [(part, "normal") for part in parts]
    if not lines:
        lines = [("Every declared edge was seen, and nothing else.", "normal")]
    if len(lines) > LISTED:
        lines = [*lines[: LISTED - 1], ("and more, see report.json", "normal")]
    for number, (line, weight) in enumerate(lines):
        figure.text(left, 0.8 - 0.028 * number, line, fontsize=9.5, weight=weight, color=INK)
