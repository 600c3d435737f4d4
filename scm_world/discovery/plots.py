"""Figures of what was found: estimated graphs beside declared ones, and verifications."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import networkx as nx

from scm_world.discovery.names import Families
from scm_world.discovery.run import DiscoveryReport
from scm_world.queries.experiments.effects import EdgeKey
from scm_world.queries.verification import Verification, arrow
from scm_world.runs.canvas import FAINT, INK, blank, save
from scm_world.runs.files import Location

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DECLARED, MATCHED, EXTRA, MISSING = "#4a5568", "#1f6fb4", "#f28e2b", "#d62728"
MARKERS = {0: "o", 1: ">"}

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
    seen = report.provenance.items()
    numbers = (
        "   ".join(f"{by}: {a} of {n}, {b} undeclared" for by, (a, n, b) in seen if n or b)
        + f"   precision {score.precision:.3f}   recall {score.recall:.3f}   "
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


# --- verifications ------------------------------------------------------------------------------

OUTCOMES = {"confirmed": "#4c9a6a", "not refuted": EXTRA, "refuted": MISSING}
LISTED = 26  # lines of names that fit


def draw_verification(found: Verification, path: Location | str) -> None:
    """Draw how soon edges fired, and what is wrong.

    Args:
        found: A verification.
        path: Of the PNG, 1600 x 900 pixels.
    """
    figure = blank()
    title: Any = {"fontsize": 18, "weight": "bold"}
    figure.text(0.02, 0.945, f"Verification of {found.task}", color=INK, **title)
    figure.text(0.98, 0.945, found.outcome, ha="right", color=OUTCOMES[found.outcome], **title)
    words = (
        f"{found.backend} {found.versions.get(found.backend, '')}: {len(found.undeclared)} "
        f"undeclared, {len(found.never_fired)} never seen, {found.rollouts:,} rollouts"
    )
    figure.text(0.02, 0.9, words, fontsize=11, color=INK)
    _coverage(figure.add_axes((0.055, 0.09, 0.36, 0.72)), found)
    _names(figure, 0.47, found)
    save(figure, path)


def _coverage(ax: Axes, found: Verification) -> None:
    """Draw the share of the declared edges that had fired after each probe state."""
    from matplotlib.ticker import MaxNLocator

    declared = len(found.declared)
    share = [count / declared if declared else 1.0 for count in found.coverage]
    label = f"{found.backend}: {len(found.fired)} of {declared}"
    ax.step(range(1, len(share) + 1), share, where="mid", color=MATCHED, lw=2.2, label=label)
    lowest = min(1.0, *share)
    ax.axhline(1.0, color=FAINT, lw=1.0, zorder=0)
    ax.set_ylim(lowest - 0.08 * (1.02 - lowest) - 0.002, 1.0 + 0.06 * (1.02 - lowest))
    ax.yaxis.set_major_formatter(lambda y, _: f"{round(100 * y, 3):g} %" if y <= 1.0 else "")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_title("declared edges seen", loc="left", fontsize=13, color=INK)
    ax.set_xlabel("probe states", fontsize=11, color=INK)
    ax.legend(loc="lower right", frameon=False, fontsize=11)
    _plain(ax)


def _plain(ax: Axes) -> None:
    ax.tick_params(colors=INK)
    for side, spine in ax.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(FAINT)


def _names(figure: Figure, left: float, found: Verification) -> None:
    """Name the edges with which something is wrong."""
    lines: list[tuple[str, str]] = []
    undeclared = tuple(edge.key for edge in found.undeclared)
    for title, edges in (("never seen", found.never_fired), ("undeclared", undeclared)):
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
