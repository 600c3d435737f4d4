"""Pictures of verifications: how soon edges were seen, and what two engines agree on."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from scm_world.output.canvas import FAINT, INK, blank, save
from scm_world.output.locations import Location
from scm_world.queries.agreement import FACTORS, Agreement
from scm_world.queries.experiments.effects import EdgeKey
from scm_world.queries.verification import Verification, arrow

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHADES = ("#1f6fb4", "#f28e2b", "#4c9a6a", "#9a6fb0")
GOOD, BAD = "#4c9a6a", "#d62728"
LISTED = 26  # lines of names that fit


def draw_verification(found: Verification | Agreement, path: Location | str) -> None:
    """Draw how soon edges were seen, what is wrong, and the signs on two engines.

    Args:
        found: A verification, or that of two engines.
        path: Of the PNG, 1600 x 900 pixels.
    """
    both = isinstance(found, Agreement)
    reports = found.verifications if isinstance(found, Agreement) else (found,)
    figure = blank()
    _heading(figure, reports, passed=found.passed)
    curve = figure.add_axes((0.055, 0.09, 0.36, 0.72))
    _coverage(curve, reports)
    if isinstance(found, Agreement):
        _signs(figure.add_axes((0.46, 0.09, 0.27, 0.72)), found)
    _names(figure, 0.765 if both else 0.47, found)
    save(figure, path)


def _heading(figure: Figure, reports: Iterable[Verification], *, passed: bool) -> None:
    first = next(iter(reports))
    figure.text(0.02, 0.945, f"Verification of {first.task}", fontsize=18, weight="bold", color=INK)
    figure.text(
        0.98,
        0.945,
        "passed" if passed else "not passed",
        fontsize=18,
        weight="bold",
        ha="right",
        color=GOOD if passed else BAD,
    )
    words = "     ".join(
        f"{found.backend} {found.versions.get(found.backend, '')}: floor {found.floor:g}, "
        f"{len(found.undeclared)} undeclared, {len(found.never_fired)} never seen, "
        f"{found.rollouts:,} rollouts"
        for found in reports
    )
    figure.text(0.02, 0.9, words, fontsize=11, color=INK)


def _coverage(ax: Axes, reports: Iterable[Verification]) -> None:
    """Draw which share of the declared edges had been seen after each probe state."""
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
    """List what is wrong, and where engines differ."""
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
            lines += [(part, "normal") for edge in edges for part in _wrapped(arrow(edge))]
    if not lines:
        lines = [("Every declared edge was seen, and nothing else.", "normal")]
    if len(lines) > LISTED:
        lines = [*lines[: LISTED - 1], ("and more, see report.json", "normal")]
    for number, (line, weight) in enumerate(lines):
        figure.text(left, 0.8 - 0.028 * number, line, fontsize=9.5, weight=weight, color=INK)


def _wrapped(line: str) -> list[str]:
    return textwrap.wrap(line, 48, subsequent_indent="    ")
