"""Draw the pictures of ``docs/benchmarks`` from the recorded figures.

::

    python -m benchmarks.figures               # all of them, a few seconds
    python -m benchmarks.figures learners      # one of them

Nothing is measured here. Each picture reads the JSON and CSV files under ``benchmarks`` that the
scripts named on its page have written. ``python -m benchmarks.speed`` draws ``speed.png`` itself.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scm_world.runs.canvas import FAINT, INK, PALETTE, blank, save, styled

HERE = Path(__file__).parent
IMAGES = HERE.parent / "docs" / "images" / "benchmarks"
BLUE, RED, GREEN, PINK, ORANGE, SKY, BLACK = PALETTE
GREY = "#8a94a3"


def read(name: str) -> Any:
    """Read a file of results."""
    return json.loads((HERE / name).read_text(encoding="utf-8"))


def numbers(text: str) -> list[float]:
    """Return all numbers of a cell of a recorded table."""
    return [float(found) for found in re.findall(r"[-+]?\d*\.?\d+", text)]


def titled(axis: Any, title: str, **labels: Any) -> None:
    """Set the title and the labels of an axis."""
    axis.set_title(title, loc="left", color=INK)
    axis.set(**labels)
    axis.spines[["top", "right"]].set_visible(False)


def interval(
    axis: Any, x: Any, rows: Sequence[Mapping[str, Any]], label: str, color: str, marker: str = "o"
) -> None:
    """Draw values with their intervals."""
    value = np.array([row["value"] for row in rows], float)
    low, high = (
        np.array([row["value"] if row[end] is None else row[end] for row in rows], float)
        for end in ("low", "high")
    )
    error = np.maximum([value - np.maximum(low, 0.0), high - value], 0.0)
    style: dict[str, Any] = {"fmt": marker, "markersize": 5, "elinewidth": 1.2, "color": color}
    axis.errorbar(x, value, yerr=error, label=label, **style)


# --- intervals ------------------------------------------------------------------------------------


@styled
def coverage() -> Any:
    """Draw how many samples each row of ``coverage.json`` misses without a word of caution."""
    found = read("coverage.json")["results"]
    figure = blank(12.0, 8.0)
    axes = figure.subplots(2, 2, height_ratios=[5, 5])
    for axis, (part, rows) in zip(axes.flat, found.items(), strict=True):
        names = list(dict.fromkeys(row["of"] for row in rows))
        sizes = sorted({row["units"] for row in rows})
        for row in rows:
            shift = 0.24 * (sizes.index(row["units"]) / max(len(sizes) - 1, 1) - 0.5) * 2.0
            color = PALETTE[sizes.index(row["units"]) % len(PALETTE)]
            style = {"marker": "o"} if row["holds"] else {"marker": "x", "linewidths": 2.0}
            where = names.index(row["of"]) + shift
            axis.scatter(row["missed unseen"], where, s=32, color=color, **style)
        for size, color in zip(sizes, PALETTE, strict=False):
            axis.scatter([], [], color=color, label=f"{size} units")
        axis.axvline(0.05, color=INK, linewidth=1)
        axis.set_yticks(range(len(names)), [_wrapped(name) for name in names])
        axis.invert_yaxis()
        titled(axis, part, xlim=(-0.01, 0.56), xlabel="share of samples missed without caution")
        axis.legend(loc="lower right")
    figure.tight_layout()
    return figure


def _wrapped(text: str, width: int = 34) -> str:
    words, lines = text.split(), [""]
    for word in words:
        if len(lines[-1]) + len(word) > width:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines)


@styled
def rare_failures() -> Any:
    """Draw coverage and width of the methods of ``intervals.json``."""
    found = read("intervals.json")["results"]
    figure = blank(12.0, 5.0)
    left, right = figure.subplots(1, 2)
    for row, color in zip(found["methods"], (*PALETTE, GREY), strict=True):
        chosen = row["method"].endswith("at either bound") and row["method"].startswith("Student")
        left.scatter(row["mean width"], row["least coverage"], s=140 if chosen else 70, color=color)
        left.scatter(row["mean width"], row["least of 0/1"], s=70, color=color, facecolors="none")
        label = row["method"] + (" (chosen)" if chosen else "")
        left.scatter([], [], color=color, label=label)
    left.scatter([], [], color=INK, label="filled: least of all cells")
    left.scatter([], [], color=INK, facecolors="none", label="open: least of all rates of 0 and 1")
    left.axhline(0.93, color=INK, linewidth=1)
    labels = {"xlabel": "mean width", "ylabel": "least coverage of 95 % intervals"}
    titled(left, "Eight methods; the line is the criterion, 0.93", ylim=(-0.03, 1.03), **labels)
    left.legend(loc="center right")
    rates = sorted({row["rate"] for row in found["scores"]})
    compared = {"chosen": (found["methods"][0]["method"], BLUE)}
    compared |= {"bootstrap": ("bootstrap, percentiles", RED)}
    for short, (method, color) in compared.items():
        for size, dash in ((20, ":"), (40, "--"), (200, "-")):
            least = [
                min(
                    row["covers"]
                    for row in found["scores"]
                    if (row["method"], row["episodes"], row["rate"]) == (method, size, rate)
                )
                for rate in rates
            ]
            label = f"{short}, {size} episodes"
            right.plot(range(len(rates)), least, dash, marker="o", color=color, label=label)
    right.axhline(0.93, color=INK, linewidth=1)
    right.set_xticks(range(len(rates)), [f"{rate:g}" for rate in rates])
    labels = {"xlabel": "share of episodes that fail", "ylabel": "least coverage over six kinds"}
    titled(right, "The chosen interval beside a bootstrap", ylim=(-0.03, 1.03), **labels)
    right.legend(loc="lower right")
    figure.tight_layout()
    return figure


# --- verification ---------------------------------------------------------------------------------

CLASSES = {
    "effect": "an effect without an edge",
    "cut": "a declared edge that is cut",
    "readout": "readouts and mechanisms",
    "time": "time, memory and noise",
    "meaning": "a parameter that means\nsomething else",
}


@styled
def verification() -> Any:
    """Draw which sabotages ``verify`` finds, and how often two engines agree on a sign."""
    rows = read("sabotage.json")["sabotages"]
    figure = blank(12.0, 5.0)
    left, right = figure.subplots(1, 2)
    kinds: dict[str, tuple[Callable[[Any], bool], str]] = {
        "found by verify": (lambda row: row["caught"], BLUE),
        "no edge changes; a test of the adapters fails": (
            lambda row: not row["caught"] and bool(row["test"]), SKY,
        ),
        "neither": (lambda row: not row["caught"] and not row["test"], RED),
    }  # fmt: skip
    begin = np.zeros(len(CLASSES))
    for label, (counts, color) in kinds.items():
        width = np.array([sum(counts(r) for r in rows if r["kind"] == kind) for kind in CLASSES])
        left.barh(range(len(CLASSES)), width, left=begin, color=color, label=label)
        for place, (start, n) in enumerate(zip(begin, width, strict=True)):
            if n:
                left.text(start + n / 2, place, n, ha="center", va="center", color="white")
        begin += width
    left.set_yticks(range(len(CLASSES)), list(CLASSES.values()))
    left.invert_yaxis()
    titled(left, f"{len(rows)} sabotages", xlabel="sabotages")
    left.legend(loc="upper center", bbox_to_anchor=(0.4, -0.12), ncols=3)
    table = read("checks.json")["verification of tasks"]
    tasks = [row[0] for row in table["rows"]]
    columns = {"same sign, > 10": BLUE, "same sign, > 3": GREEN, "same sign, any": RED}
    for shift, (column, color) in zip((-0.22, 0.0, 0.22), columns.items(), strict=True):
        found = [numbers(row[table["head"].index(column)])[:2] for row in table["rows"]]
        bounds = np.array([_wilson(int(hit), int(n)) for hit, n in found]).T
        share = np.array([hit / n for hit, n in found])
        size = column.removeprefix("same sign, ")
        label = "all effects" if size == "any" else f"effects above {size[2:]} times the floor"
        style: dict[str, Any] = {"fmt": "o", "color": color, "label": label}
        places = np.arange(len(tasks)) + shift
        right.errorbar(share, places, xerr=abs(bounds - share), **style)
    right.axvline(0.95, color=INK, linewidth=1)
    right.set_yticks(range(len(tasks)), tasks)
    right.invert_yaxis()
    words = "share of edges whose effect has the same sign on MuJoCo and Bullet"
    titled(right, "Two engines; 95 % intervals (Wilson), the line is the goal", xlabel=words)
    right.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3)
    figure.tight_layout()
    return figure


def _wilson(hits: int, n: int) -> tuple[float, float]:
    """Return Wilson's interval of a share."""
    z, p = 1.96, hits / n
    middle, half = p + z * z / (2 * n), z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return (middle - half) / (1 + z * z / n), (middle + half) / (1 + z * z / n)


# --- pairs, and the published policies ------------------------------------------------------------


@styled
def pairing() -> Any:
    """Draw how many times fewer episodes pairs need."""
    table = read("checks.json")["pairing"]["rows"]
    rows = [row for row in table if float(row[3]) < 1e6]  # a mass does not move a sliding block
    figure = blank(9.0, 4.2)
    axis = figure.subplots()
    for shift, column, engine, color in ((-0.2, 3, "MuJoCo", BLUE), (0.2, 5, "Bullet", RED)):
        values = [float(row[column]) for row in rows]
        places = np.arange(len(rows)) + shift
        axis.barh(places, values, 0.38, color=color, label=engine)
        for place, value in zip(places, values, strict=True):
            axis.text(value * 1.03, place, f"{value:g}", va="center")
    axis.axvline(1.0, color=INK, linewidth=1)
    axis.set_yticks(range(len(rows)), [f"{row[0]}: {row[1]}" for row in rows])
    axis.invert_yaxis()
    words = "unpaired episodes for the interval of one pair; the line: no gain"
    titled(axis, "Times fewer episodes with pairs, 100 units", xscale="log", xlabel=words)
    ticks = (1, 2, 5, 10, 20, 50)
    axis.set_xticks(ticks, [str(tick) for tick in ticks])
    axis.minorticks_off()
    axis.set_xlim(0.9, 70)
    axis.legend()
    figure.tight_layout()
    return figure


@styled
def actors() -> Any:
    """Draw the predecessor's published policies on both engines."""
    rows = read("checks.json")["the predecessor's policies"]["rows"]
    figure = blank(9.0, 4.2)
    axis = figure.subplots()
    for place, row in enumerate(rows):
        axis.plot([place - 0.3, place + 0.3], [float(row[2])] * 2, color=INK, linewidth=2)
        for shift, column, color in ((-0.12, 3, BLUE), (0.12, 5, RED)):
            axis.scatter(place + shift, float(row[column]), marker="D", color=color, s=25)
            mean, spread = numbers(row[column + 1].replace("±", " "))
            ends = [[mean - max(0.0, mean - spread)], [min(1.0, mean + spread) - mean]]
            axis.errorbar(place + 1.8 * shift, mean, yerr=ends, fmt="o", color=color, markersize=4)
    axis.plot([], [], color=INK, linewidth=2, label="published")
    for color, engine in ((BLUE, "Bullet"), (RED, "MuJoCo")):
        axis.scatter([], [], marker="D", color=color, label=f"{engine}, mean action, one episode")
        axis.scatter([], [], marker="o", color=color, label=f"{engine}, drawn actions, ± deviation")
    axis.set_xticks(range(len(rows)), [f"{row[0]}\n({row[1]})" for row in rows])
    titled(axis, "Published actors of CausalWorld in the default task", ylabel="last fraction")
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=3)
    figure.tight_layout()
    return figure


# --- learners -------------------------------------------------------------------------------------

COLORS = {"do_gp": GREEN, "do_order": BLUE, "gies_shared": ORANGE, "gies": PINK, "boss": RED}
COLORS |= {"correlation": GREY, "sort_regress": SKY, "all_or_nothing": FAINT, "fci": BLACK}
COLORS |= {"pc": "#7a5c2e", "permscore": "#5b3f8c", "lpcmci": "#17a2a2", "pcmci+": "#a3195b"}
BASELINES = ("correlation", "sort_regress", "all_or_nothing")


def _learners(axis: Any, rows: list[Any], cases: Mapping[str, Callable[[Any], bool]]) -> None:
    """Draw the SHD of learners in cases, beside the empty graph."""
    for shift, (learner, color) in zip(np.linspace(-0.3, 0.3, 5), COLORS.items(), strict=False):
        chosen = [(n, r) for n, is_it in enumerate(cases.values()) for r in rows if is_it(r)]
        found = [(n, row) for n, row in chosen if row["learner"] == learner and row.get("shd")]
        places = [n + shift for n, _ in found]
        interval(axis, places, [row["shd"] for _, row in found], learner, color)
    for n, is_it in enumerate(cases.values()):
        empty = next(row for row in rows if row["learner"] == "empty" and is_it(row))
        level = empty["shd"]["value"]
        axis.plot(
            [n - 0.4, n + 0.4],
            [level, level],
            color=INK,
            linewidth=2,
            label="the empty graph" if not n else None,
        )
    axis.set_xticks(range(len(cases)), list(cases))


@styled
def learners() -> Any:
    """Draw SHD of learners over families of models and over faults of interventions."""
    families, nonlinear = (
        read(f"discovery/{n}.json")["results"] for n in ("families", "nonlinear")
    )
    figure = blank(12.0, 8.0)
    above, below = figure.subplots(2, 1)
    cases: dict[str, Callable[[Any], bool]] = {}
    for model in ("er2", "sf2", "sf2in", "iscm2", "uneven2", "heavy2", "mlp2", "gp2", "sine2"):
        cases[f"{model}:10"] = lambda row, m=f"{model}:10": (
            (row["model"], row["interventions"], row["each"]) == (m, "", 50)
        )
    for model in ("mlp2", "gp2", "sine2"):
        cases[f"{model}:20\n73 rows"] = lambda row, m=f"{model}:20": (
            row["model"] == m and not row["standardised"]
        )
    _learners(above, families + nonlinear, cases)
    titled(
        above,
        "Families of models, interventions as recorded, 50 rows for each target",
        ylabel="SHD",
    )
    above.legend(loc="upper left", ncols=3)
    faults: dict[str, Callable[[Any], bool]] = {}
    for fault in ("soft", "off-target", "failed", "partial", "half set", "projection", "latent"):
        faults[fault] = lambda row, f=fault: row["interventions"] == f
    for each in (5, 10, 20, 50, 100):
        faults[f"as recorded\n{each} rows"] = lambda row, e=each: (
            (row["model"], row["interventions"], row["each"]) == ("er2:10", "", e)
        )
    _learners(below, families, faults)
    words = "er2:10: faults of the interventions (50 rows for each target), and numbers of rows"
    titled(below, words, ylabel="SHD")
    figure.tight_layout()
    return figure


@styled
def learners_of_systems() -> Any:
    """Draw F1 in families of physics, and marks where variables are hidden."""
    figure = blank(12.0, 8.0)
    above, below = figure.subplots(2, 1)
    rows = read("discovery/physics.json")["results"]
    names = [f"{row['problem']}\n{row['rows']:,} rows" for row in rows]
    shown = ("do_order", "do_gp", "gies_shared", *BASELINES)
    for shift, learner in zip(np.linspace(-0.3, 0.3, 6), shown, strict=True):
        some = [(n + shift, row[learner]["f1"]) for n, row in enumerate(rows) if learner in row]
        _f1(above, learner, some)
    above.axhline(0.6, color=INK, linewidth=1)
    above.set_xticks(range(len(names)), names)
    words = "Families of physics; the line is the most that a baseline may have"
    titled(above, words, ylabel="F1", ylim=(-0.02, 1.05))
    above.legend(loc="upper center", ncols=6, bbox_to_anchor=(0.5, -0.13))
    hidden = read("discovery/hidden.json")["results"]
    keys = list(dict.fromkeys((row["model"], row["rows"]) for row in hidden))
    all_names = list(dict.fromkeys(row["learner"] for row in hidden))
    marked = [name for name in all_names if name in COLORS]
    for shift, learner in zip(np.linspace(-0.35, 0.35, len(marked)), marked, strict=True):
        some = [
            (keys.index((row["model"], row["rows"])) + shift, row["head_f1"])
            for row in hidden
            if row["learner"] == learner
        ]
        _f1(below, learner, some)
    below.set_xticks(range(len(keys)), [f"{model}\n{n:,} rows" for model, n in keys])
    titled(below, "Hidden variables: arrowheads", ylabel="F1 of heads", ylim=(-0.02, 1.05))
    below.legend(loc="upper center", ncols=6, bbox_to_anchor=(0.5, -0.15))
    figure.tight_layout()
    return figure


def _f1(axis: Any, learner: str, some: Sequence[tuple[float, Any]]) -> None:
    """Draw F1 of a learner, or, as squares, of a baseline."""
    label, marker = (f"{learner} (baseline)", "s") if learner in BASELINES else (learner, "o")
    interval(axis, [x for x, _ in some], [row for _, row in some], label, COLORS[learner], marker)


# --- agents ---------------------------------------------------------------------------------------


@styled
def agents() -> Any:
    """Draw the scores of policies learned by imitation, beside the script that taught them."""
    recorded = read("baselines/agents.json")
    figure = blank(12.0, 8.0)
    for axis, task in zip(
        figure.subplots(2, 2).flat,
        ("pushing", "picking", "pick_and_place", "stacking2"),
        strict=True,
    ):
        rows = recorded[f"{task}, imitation"]["rows"]
        for shift, column, engine, color in ((-0.14, 2, "MuJoCo", BLUE), (0.14, 3, "Bullet", RED)):
            for place, row in enumerate(rows):
                *seeds, low, high = numbers(row[column])
                axis.vlines(place + shift, low, high, color=color, linewidth=5, alpha=0.3)
                axis.scatter([place + shift] * len(seeds), seeds, s=18, color=color)
                script = numbers(row[5])[column - 2]
                axis.plot(
                    [place + shift - 0.12, place + shift + 0.12],
                    [script] * 2,
                    color=INK,
                    linewidth=1.5,
                )
            axis.scatter([], [], color=color, label=f"{engine}: seeds 0, 1, 2; 95 % of their mean")
        axis.plot([], [], color=INK, label="feedback, the script that taught it")
        axis.set_xticks(range(len(rows)), [row[0] for row in rows])
        titled(axis, task, ylabel="last fractional success", ylim=(0.0, 1.03))
    figure.axes[0].legend(loc="lower left")
    figure.tight_layout()
    return figure


CURVES = {
    "reaching": {f"seed {n}": [f"reaching/seed-{n}.csv"] for n in range(4)},
    "pushing": {
        **{
            f"seed {n}": [f"pushing/long-seed-{n}.csv", f"pushing/precise-seed-{n}.csv"]
            for n in range(3)
        },
    },
    "picking": {"seed 0": ["picking/by-reward-seed-0.csv"]},
}


@styled
def learning() -> Any:
    """Draw the learning curves of PPO."""
    figure = blank(12.0, 4.0)
    for axis, (task, runs) in zip(figure.subplots(1, 3), CURVES.items(), strict=True):
        for (name, files), color in zip(runs.items(), PALETTE, strict=False):
            begin = 0.0
            for part, file in enumerate(files):
                x, y = _curve(HERE / "baselines" / file)
                label = None if part else name
                axis.plot((x + begin) / 1e6, y, "--" if part else "-", color=color, label=label)
                begin += x[-1]
        titled(axis, task, xlabel="million control steps", ylim=(0.0, 1.03))
        axis.legend(loc="lower right")
    figure.axes[0].set_ylabel("last fractional success of training episodes")
    figure.axes[1].plot([], [], "--", color=INK, label="then, precision worth more")
    figure.axes[1].legend(loc="lower right")
    figure.tight_layout()
    return figure


def _curve(path: Path) -> tuple[Any, Any]:
    with path.open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["last_fractional_success"]]
    return tuple(
        np.array([float(row[k]) for row in rows]) for k in ("steps", "last_fractional_success")
    )


@styled
def causes() -> Any:
    """Draw what a network gains, or loses, that observes the causal parameters."""
    recorded = read("baselines/agents.json")
    figure = blank(12.0, 4.0)
    names = ("pushing, imitation: causes observed", "reaching, PPO: causes observed")
    for axis, name in zip(figure.subplots(1, 2, sharey=True), names, strict=True):
        rows = recorded[name]["rows"]
        for place, row in enumerate(rows):
            value, low, high = numbers(row[6].replace("[95 %]", ""))
            color = INK if low <= 0.0 <= high else RED
            axis.errorbar(place, value, yerr=[[value - low], [high - value]], fmt="o", color=color)
        axis.axhline(0.0, color=INK, linewidth=1)
        axis.set_xticks(range(len(rows)), [row[0] for row in rows])
        titled(axis, name.split(":")[0], ylim=(-1.3, 0.5))
    figure.axes[0].set_ylabel("observed - not observed, 95 % over three seeds")
    figure.tight_layout()
    return figure


@styled
def randomisation() -> Any:
    """Draw in how many environments each pattern of randomisation fails which question."""
    recorded = read("randomisation.json")
    patterns, rows = recorded["patterns"], recorded["rows"]
    count = len({row["environment"] for row in rows})
    questions = [*("applied", "in range", "responds", "at once", "second reset", "constants")]
    failed = np.array(
        [
            [sum(row["pattern"] == name and q in row["faults"] for row in rows) for q in questions]
            for name in patterns
        ]
    )
    figure = blank(9.0, 4.6, layout="constrained")
    axis = figure.subplots()
    for (y, x), number in np.ndenumerate(failed):
        color, alpha = (RED, 0.25 + 0.75 * number / count) if number else (FAINT, 0.5)
        axis.bar(x, 0.84, 0.92, y - 0.42, color=color, alpha=alpha)
        axis.text(x, y, f"{number}" * bool(number), ha="center", va="center", size=9)
    axis.set_yticks(range(len(patterns)), patterns.values())
    axis.set_xticks(range(len(questions)), questions)
    axis.set_ylim(len(patterns) - 0.5, -0.5)
    axis.grid(visible=False)
    titled(axis, f"In how many of {count} environments check finds a fault")
    return figure


def real() -> Any:
    """Draw errors of predictions of recordings of real machines, half a second ahead."""
    pairs = read("real.json")["pairs"]
    ways = {
        "predicted": BLUE,
        "without the do": ORANGE,
        "file": GREY,
        "refitted": GREEN,
        "independent fit": SKY,
        "constant velocity": FAINT,
    }
    figure = blank(9.0, 0.9 + 1.0 * len(pairs), layout="constrained")
    axis = figure.subplots()
    for row, found in enumerate(pairs.values()):
        for place, (way, color) in enumerate(ways.items()):
            each = found["errors"]["0.5"][way]
            ends = [[each["median"] - each["low"]], [each["high"] - each["median"]]]
            y = row + 0.13 * (place - 2.5)
            axis.barh(y, each["median"], 0.12, color=color, label="" if row else way)
            axis.errorbar(each["median"], y, xerr=ends, color=INK, elinewidth=0.8)
    axis.set_yticks(range(len(pairs)), pairs)
    axis.set(xscale="log", ylim=(len(pairs) - 0.5, -0.5))
    axis.legend(loc="upper right")
    titled(axis, "Median error half a second ahead", xlabel="rad (intervals of 95 % over windows)")
    return figure


@styled
def laboratories() -> Any:
    """Draw scores of agents in laboratories by budget: of each kind and level, and of all."""
    found = read("lab.json")["curves"]
    shares = np.array(found["shares"])
    names = [name for name, one in found.items() if isinstance(one, Mapping)]
    figure = blank(13.0, 9.5, layout="constrained")
    axes = figure.subplots(3, 5, sharex=True, sharey=True).flat
    for axis, name in zip(axes, names, strict=False):
        one = found[name]
        for number, (agent, rows) in enumerate(one["agents"].items()):
            interval(axis, shares * 1.035 ** (number - 2.5), rows, agent, PALETTE[number])
            axis.plot(shares, [row["value"] for row in rows], color=PALETTE[number], linewidth=1)
        trivial = one["best trivial answer"]["value"]
        axis.axhline(trivial, color=GREY, linestyle="--", label="best trivial answer")
        axis.set_xscale("log")
        axis.set_xticks(shares, [f"{share:g}" for share in shares])
        axis.minorticks_off()
        titled(axis, f"{name} ({one['questions']})", ylim=(-0.03, 1.03))
    lines, labels = axes[0].get_legend_handles_labels()
    for axis in axes[len(names) :]:
        axis.axis("off")
    axes[len(names)].legend(lines, labels, loc="center")
    figure.supxlabel("budget, in that of the question")
    figure.supylabel("score, with 95 % intervals over questions")
    return figure


PICTURES: Mapping[str, Callable[[], Any]] = {
    "coverage": coverage,
    "rare-failures": rare_failures,
    "verification": verification,
    "pairing": pairing,
    "actors": actors,
    "learners": learners,
    "learners-of-systems": learners_of_systems,
    "agents": agents,
    "learning": learning,
    "causes": causes,
    "randomisation": randomisation,
    "real": real,
    "lab": laboratories,
}


def main(given: Iterable[str] | None = None) -> None:
    """Draw pictures, all by default."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pictures", nargs="*", metavar="PICTURE", help=", ".join(PICTURES))
    parser.add_argument("--out", type=Path, default=IMAGES, help="folder of the pictures")
    asked = parser.parse_args(None if given is None else list(given))
    unknown = set(asked.pictures) - PICTURES.keys()
    if unknown:
        parser.error(f"no picture is named {min(unknown)!r}; there are {', '.join(PICTURES)}")
    asked.out.mkdir(parents=True, exist_ok=True)
    for name in asked.pictures or PICTURES:
        save(PICTURES[name](), asked.out / f"{name}.png")
        print(asked.out / f"{name}.png")


if __name__ == "__main__":
    main()
