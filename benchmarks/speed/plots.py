"""The picture: cost over blocks, where it goes, and how it compares."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill
from typing import Any

from benchmarks.speed.goals import Figures
from benchmarks.speed.parts import PARTS
from benchmarks.speed.tables import TITLES
from scm_world.runs.canvas import FAINT, INK, PALETTE, blank, save

ENGINE_COLORS = dict(zip(TITLES, PALETTE, strict=False))
CHANGES = ("reset [µs]", "do: mass [µs]", "do: size [µs]", "snapshot [µs]")
GROWING = ("towers", "stacked_blocks")
DASHES = ("-", "--", ":", "-.")
SMALL = 9  # [points]


def draw(results: Figures, path: Path) -> None:
    """Draw what was measured on one sheet; a field stays empty where nothing was."""
    figure = blank()
    drawn = {"step": stepping, "changes": changing, "profile": profile, "predecessor": ratios}
    for axis, (section, paint) in zip(figure.subplots(2, 2).flat, drawn.items(), strict=True):
        if section in results:
            paint(axis, results)
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(colors=INK, labelsize=SMALL)
    figure.tight_layout()
    save(figure, path)


def curve(results: Figures, section: str, engine: str, figure: str) -> tuple[Any, Any]:
    """Give a figure over the number of blocks, of the scenes that are made for it."""
    rows = results.get(section, {}).get(engine, {})
    points = sorted(
        (row["blocks"], row[figure]) for name, row in rows.items() if name.startswith(GROWING)
    )
    return [x for x, _ in points], [y for _, y in points]


def _title(axis: Any, title: str) -> None:
    axis.set_title(title, loc="left", fontsize=11, color=INK)


def _over_blocks(axis: Any, title: str) -> None:
    _title(axis, title)
    axis.set(xscale="log", yscale="log", xlabel="blocks", ylabel="µs")
    blocks = [1, 2, 5, 10, 35]
    axis.set_xticks(blocks, [str(n) for n in blocks])
    axis.minorticks_off()
    axis.grid(color=FAINT, linewidth=0.5)
    _beside(axis)


def _beside(axis: Any) -> None:
    """Put the legend beside the field."""
    axis.legend(fontsize=SMALL, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))


def stepping(axis: Any, results: Figures) -> None:
    """Draw a control step, and the engine alone."""
    for engine, title in TITLES.items():
        color = ENGINE_COLORS[engine]
        for label, figure, style in (
            ("env.step", "env.step [µs]", "o-"),
            ("engine alone", "raw physics [µs]", "x:"),
        ):
            x, y = curve(results, "step", engine, figure)
            axis.plot(x, y, style, color=color, label=f"{title}, {label}")
        x, y = curve(results, "pixels", engine, "step with pixels [µs]")
        axis.plot(x, y, "s--", color=color, alpha=0.5, label=f"{title}, with pixels")
    _over_blocks(axis, "A control step over the number of blocks")


def changing(axis: Any, results: Figures) -> None:
    """Draw resets, interventions and snapshots."""
    for engine, title in TITLES.items():
        for figure, dash in zip(CHANGES, DASHES, strict=True):
            x, y = curve(results, "changes", engine, figure)
            label = f"{title}, {figure.removesuffix(' [µs]')}"
            axis.plot(x, y, dash, marker="o", color=ENGINE_COLORS[engine], label=label)
    _over_blocks(axis, "Reset, do and snapshot over the number of blocks")


def profile(axis: Any, results: Figures) -> None:
    """Stack the parts of a step, as shares of the whole."""
    bars = [
        (fill(f"{TITLES.get(engine, engine)} {scene}", width=9), row)
        for engine, scenes in results.get("profile", {}).items()
        for scene, row in scenes.items()
    ]
    below = [0.0] * len(bars)
    for part, color in zip(PARTS, PALETTE, strict=True):
        heights = [100.0 * row.get(part, 0.0) / sum(row.values()) for _, row in bars]
        axis.bar([name for name, _ in bars], heights, bottom=below, color=color, label=part)
        below = [a + b for a, b in zip(below, heights, strict=True)]
    for index, (_, row) in enumerate(bars):
        axis.text(index, 101, f"{sum(row.values()):,.0f} µs", ha="center", fontsize=SMALL)
    axis.set(ylim=(0, 110), ylabel="share of a step [%]")
    _title(axis, "Where the time of a step goes")
    _beside(axis)


def ratios(axis: Any, results: Figures) -> None:
    """Draw how many times faster everything is than in the predecessor."""
    found = results["predecessor"]
    names = [name for name in found if name != "versions"]
    height = 0.38
    for shift, (engine, title) in zip((-0.5, 0.5), TITLES.items(), strict=True):
        values = [found[name][f"{engine}: ratio"] for name in names]
        places = [index + shift * height for index in range(len(names))]
        axis.barh(places, values, height, color=ENGINE_COLORS[engine], label=title)
        for place, value in zip(places, values, strict=True):
            axis.text(value * 1.05, place, f"{value:,.1f}", va="center", fontsize=SMALL)
    _title(axis, "Times as fast as CausalWorld 1.2, in turns")
    axis.set_xscale("log")
    axis.set_yticks(range(len(names)), names)
    axis.invert_yaxis()
    axis.legend(fontsize=SMALL, frameon=False)
