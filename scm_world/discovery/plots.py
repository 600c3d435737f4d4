"""Figures: estimated graphs beside declared ones, and verifications."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from typing import Any

import networkx as nx

from scm_world.discovery.names import Families
from scm_world.discovery.run import DiscoveryReport
from scm_world.queries.experiments.effects import EdgeKey
from scm_world.queries.verification import Verification, arrow
from scm_world.runs.canvas import FAINT, INK, blank, save
from scm_world.runs.files import Location

DECLARED, MATCHED, EXTRA, MISSING = "#4a5568", "#1f6fb4", "#f28e2b", "#d62728"
OUTCOMES = {"confirmed": "#4c9a6a", "not refuted": EXTRA, "refuted": MISSING}
LISTED = 26  # lines of names that fit
LEFT: Any = {"loc": "left", "fontsize": 13, "color": INK}
TITLE: Any = {"fontsize": 17, "weight": "bold", "color": INK}


def draw_graphs(report: DiscoveryReport, path: Location | str) -> None:
    """Draw the declared and the estimated graph side by side, as matrices.

    A column is a cause, a row an effect. A dot is a contemporaneous edge, a triangle one
    from one control step to the next; it is hollow where not every member of a family of variables
    is declared to affect every member of the other. Variables with no edge in either graph are
    left out.

    Args:
        report: The result of a discovery.
        path: Path of the PNG, 1600 x 900 pixels.
    """
    found, declared = set(report.found), set(report.declared)
    every = sorted(found | declared)
    families = Families(sorted({name for edge in every for name in edge[:2]}), report.declared)
    cells: dict[EdgeKey, list[EdgeKey]] = {}
    for edge in every:
        cells.setdefault((families.of[edge[0]], families.of[edge[1]], edge[2]), []).append(edge)
    order = _causes_first(cells)
    causes, effects = ([n for n in order if n in {key[side] for key in cells}] for side in (0, 1))
    figure = blank()
    axes = figure.subplots(1, 2, sharey=True)
    figure.subplots_adjust(left=0.155, right=0.992, bottom=0.255, top=0.855, wspace=0.02)
    size = max(5.0, min(10.0, 260.0 / max(len(effects), len(causes), 1)))
    for ax in axes:
        ax.set(xlim=(-0.5, max(len(causes), 1) - 0.5), ylim=(max(len(effects), 1) - 0.5, -0.5))
        ax.set_xticks(range(len(causes)), causes, rotation=90, fontsize=size)
        ax.set_yticks(range(len(effects)), effects, fontsize=size)
        ax.set_xlabel("cause", fontsize=11, color=INK)
        ax.tick_params(length=0, colors=INK)
        ax.grid(color=FAINT, lw=0.5)
        ax.set_axisbelow(True)
    axes[0].set_title(f"DECLARED: {len(declared)} edges", **LEFT)
    axes[1].set_title(f"ESTIMATED: {len(found)} edges", **LEFT)
    axes[0].set_ylabel("effect", fontsize=11, color=INK)
    for (cause, effect, lag), edges in cells.items():
        both = (cause, effect, 1 - lag) in cells  # two lags of one pair stand side by side
        x = causes.index(cause) + ((0.26 if lag else -0.26) if both else 0.0)
        y, these = effects.index(effect), set(edges)
        most = len(families.members[cause]) * len(families.members[effect])
        hollow = 0 < len(these & declared) < most
        for ax, color, marked in (
            (axes[0], DECLARED, these & declared),
            (axes[1], MATCHED, these & declared & found),
            (axes[1], EXTRA, these - declared),
            (axes[1], MISSING, these - found),
        ):
            if not marked:
                continue
            face = "white" if color == MISSING or (hollow and color != EXTRA) else color
            shape = {EXTRA: "s", MISSING: "X"}.get(color, "o>"[bool(lag)])
            ax.scatter(x, y, s=46, marker=shape, fc=face, ec=color, lw=1.6, zorder=3)
            if color == MISSING and len(marked) < len(these):
                part = f"{len(marked)} of {len(these)} missed"
                ax.annotate(part, (x, y), xytext=(7, 5), textcoords="offset points", fontsize=7)
    for marker, label, color, face in (
        ("o", "contemporaneous", DECLARED, DECLARED),
        (">", "one control step later", DECLARED, DECLARED),
        ("o", "each its own", DECLARED, "white"),
        ("o", "declared and estimated", MATCHED, MATCHED),
        ("s", "estimated, not declared", EXTRA, EXTRA),
        ("X", "declared, not estimated", MISSING, "white"),
    ):
        axes[0].scatter([], [], s=46, marker=marker, fc=face, ec=color, lw=1.6, label=label)
    corner: Any = {"loc": "upper right", "bbox_to_anchor": (0.995, 0.995)}
    figure.legend(ncol=2, frameon=False, fontsize=10, **corner)
    score = report.score
    engine = f"{report.backend} {report.versions.get(report.backend, '')}".strip()
    seen = report.provenance.items()
    numbers = (
        "   ".join(f"{by}: {a} of {n}, {b} undeclared" for by, (a, n, b) in seen if n or b)
        + f"   precision {score.precision:.3f}   recall {score.recall:.3f}   "
        f"{report.probes} probe states, {report.rollouts} rollouts"
    )
    figure.text(0.012, 0.955, f"{report.task} on {engine}", **TITLE)
    figure.text(0.012, 0.918, numbers, fontsize=12, color=INK)
    save(figure, path)


def _causes_first(edges: Iterable[EdgeKey]) -> list[str]:
    """Order variables so that causes stand before effects, as far as there is an order."""
    knots = nx.condensation(nx.DiGraph((cause, effect) for cause, effect, _ in edges))
    layers = nx.topological_generations(knots)
    members = ([n for knot in layer for n in knots.nodes[knot]["members"]] for layer in layers)
    return [name for layer in members for name in sorted(layer)]


def draw_verification(found: Verification, path: Location | str) -> None:
    """Draw how soon edges fired, and the undeclared ones.

    Args:
        found: A verification.
        path: Path of the PNG, 1600 x 900 pixels.
    """
    from matplotlib.ticker import MaxNLocator

    figure = blank()
    figure.text(0.02, 0.945, f"Verification of {found.task}", **TITLE)
    outcome = {**TITLE, "color": OUTCOMES[found.outcome]}
    figure.text(0.98, 0.945, found.outcome, ha="right", **outcome)
    backend = f"{found.backend} {found.versions.get(found.backend, '')}".strip()
    words = (
        f"{backend}: {len(found.undeclared)} undeclared, {len(found.never_fired)} never seen, "
        f"{found.rollouts:,} rollouts"
    )
    figure.text(0.02, 0.9, words, fontsize=11, color=INK)
    declared = len(found.declared)
    share = [100.0 * count / declared if declared else 100.0 for count in found.coverage]
    ax = figure.add_axes((0.055, 0.09, 0.36, 0.72))
    label = f"{found.backend}: {len(found.fired)} of {declared}"
    ax.step(range(1, len(share) + 1), share, where="mid", color=MATCHED, lw=2.2, label=label)
    ax.axhline(100.0, color=FAINT, lw=1.0, zorder=0)
    ax.set_ylim(0.0, 105.0)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_title("declared edges seen [%]", **LEFT)
    ax.set_xlabel("probe states", fontsize=11, color=INK)
    ax.legend(loc="lower right", frameon=False, fontsize=11)
    ax.spines[["top", "right"]].set_visible(False)
    undeclared = tuple(edge.key for edge in found.undeclared)
    lines: list[tuple[str, str]] = []
    for heading, edges in (("never seen", found.never_fired), ("undeclared", undeclared)):
        if edges:
            lines.append((f"{heading}: {len(edges)}", "bold"))
        for edge in edges:
            parts = textwrap.wrap(arrow(edge), 48, subsequent_indent="    ")
            lines += [(part, "normal") for part in parts]
    if not lines:
        lines = [("Every declared edge was seen, and nothing else.", "normal")]
    if len(lines) > LISTED:
        lines = [*lines[: LISTED - 1], ("and more, see report.json", "normal")]
    for number, (line, weight) in enumerate(lines):
        figure.text(0.47, 0.8 - 0.028 * number, line, fontsize=9.5, weight=weight, color=INK)
    save(figure, path)
