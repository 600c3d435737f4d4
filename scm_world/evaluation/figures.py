"""Figures of evaluations: bars, radars, performance profiles, and figures of adaptation.

Each function returns a matplotlib figure; ``save`` writes it, with the same bytes for the same
evaluation. matplotlib is loaded when one is drawn. Lines of equal scores lie on one another, so the
first one is the widest and their markers are at different places.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast, final

import numpy as np

from scm_world._arguments import one_of
from scm_world._patterns import fits
from scm_world.errors import UnknownOption
from scm_world.evaluation.episodes import DRAWN, KEYS, LAST, drawn_columns
from scm_world.evaluation.results import RATES, Evaluation
from scm_world.evaluation.statistics import Interval, mean_interval, performance_profile
from scm_world.runs.canvas import INK, MARKERS, PALETTE, blank, save, styled
from scm_world.runs.files import Location, located, remove

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.projections.polar import PolarAxes

BAR = 0.16  # [inches] of a bar, and of a line of text
PAPER = {"fc": "white", "ec": "none", "pad": 0.6}
HATCHES = ("", "////", "....", "xxxx")
BINS, FEWEST = 8, 10  # bins of a drawn number at most, and draws in each at least, about
PANELS, CURVE = 12, 50  # of a figure, and points of a curve, at most
WIDEST, THINNEST = 4.5, 1.2  # [points] of the first and the last line
DASHES: Sequence[Any] = ("solid", (0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)))

WORDS: Mapping[str, str] = {
    "last_fractional_success": "fractional success at the end",
    "last_integrated_fractional_success": f"fractional success over the last {LAST} steps",
    "full_integrated_fractional_success": "fractional success over the whole episode",
    "success": "success rate",
    "return": "return",
    "published_overlap": "overlap at the end as CausalWorld has it",
}
"""Metrics in words."""

Line = tuple[str, str]
"""An agent on a backend: one line of a figure, or one bar of each protocol."""


@final
class Chart:
    """The parts of every figure of an evaluation: lines, their looks, words and scores.

    Args:
        evaluation: The evaluation.
        metric: One of ``METRICS``; the first that the evaluation has if None.

    Attributes:
        lines: Arguments of a line, by agent and backend: agents differ in color and marker,
            backends in dashes; of several lines the first one is the widest.
        bars: Arguments of a bar; backends differ in hatches.
        shifts: Place among all lines, from -0.5 to 0.5: markers are shifted by it.
        words: The varied variables in words, by protocol.
        scores: Mean scores, by line and protocol; none where an agent did not act in a protocol.
        is_fraction: Whether the metric goes from 0 to 1.
    """

    def __init__(self, evaluation: Evaluation, metric: str | None = None) -> None:
        import matplotlib
        from matplotlib.colors import to_hex

        self.evaluation, self.metric = evaluation, evaluation.metric(metric)
        self.metric_words, self.is_fraction = WORDS[self.metric], self.metric != "return"
        agents, engines = evaluation.agents, evaluation.engines
        there = set(evaluation.frame[["agent", "engine"]].itertuples(index=False, name=None))
        lines = [line for line in product(agents, engines) if line in there]
        colors = list(PALETTE)
        if len(agents) > len(PALETTE):
            spread = matplotlib.colormaps["turbo"](np.linspace(0.05, 0.95, len(agents)))
            colors = [*map(to_hex, spread)]
        self.lines: dict[Line, dict[str, Any]] = {}
        self.bars: dict[Line, dict[str, Any]] = {}
        self.shifts: dict[Line, float] = {}
        for place, line in enumerate(lines):
            agent, engine = line
            a, e = agents.index(agent), engines.index(engine)
            share = place / max(len(lines) - 1, 1)
            name = agent if len(engines) == 1 else f"{agent} on {engine}"
            label = textwrap.fill(name, 60)
            self.shifts[line] = share - 0.5
            self.lines[line] = {
                "label": label,
                "color": colors[a],
                "marker": MARKERS[a % len(MARKERS)],
                "linestyle": DASHES[e % len(DASHES)],
                "linewidth": WIDEST + share * (THINNEST - WIDEST) if len(lines) > 1 else 1.8,
                "markersize": 5.0,
            }
            hatch = HATCHES[e % len(HATCHES)]
            color = {"facecolor": colors[a], "edgecolor": "white"}
            self.bars[line] = {"label": label, **color, "hatch": hatch}
        declared = {one["name"]: one for one in evaluation.about.get("protocols", ())}
        self.words = {name: _varies(declared.get(name, {})) for name in evaluation.protocols}

    @property
    def scores(self) -> dict[tuple[Line, str], Interval]:
        """The mean scores with their intervals."""
        return {
            (line, protocol): mine.score(protocol, self.metric)
            for line in self.lines
            for mine in [self.evaluation.only(agent=line[0], engine=line[1])]
            for protocol in mine.protocols
        }

    @property
    def counted(self) -> str:
        """How many runs and episodes a number is of."""
        each = self.evaluation.frame.groupby(["agent", "engine", "protocol", "run"]).size()
        runs = [len(self.evaluation.runs(agent)) for agent in self.evaluation.agents]
        some = "" if max(runs) == 1 else f" and {_range(runs)} training runs of each agent"
        return f"{_range(each)} episodes of each protocol{some}"

    def sheet(
        self, width: float, height: float, note: str, handles: Sequence[Artist] | None = None
    ) -> Figure:
        """Begin a figure with a title above, and legend and note below the drawing.

        Args:
            width: Width of the figure [inches].
            height: Height of the drawing [inches].
            note: What the figure shows, in sentences.
            handles: Entries of the legend; the lines if None.
        """
        from matplotlib.lines import Line2D

        handles = handles or [Line2D([], [], **look) for look in self.lines.values()]
        task = Path(self.evaluation.task).name.rpartition(":")[2]  # without the file of a class
        title = f"{task}: {self.metric_words}"
        head, notes = textwrap.wrap(title, int(8 * width)), textwrap.wrap(note, int(13 * width))
        longest = max(len(row) for h in handles for row in str(h.get_label()).split("\n"))
        columns = max(1, int(width / (0.8 + 0.08 * longest)))
        rows = math.ceil(len(handles) / columns)
        around = 0.4 + 0.2 * len(head) + 0.17 * len(notes) + 0.2 * rows
        figure = blank(width, height + around, layout="constrained")
        figure.suptitle("\n".join(head), size=12, weight="bold")
        figure.legend(
            handles=handles, title="\n".join(notes), title_fontsize=9, alignment="left", fontsize=9,
            ncols=columns, handlelength=2.6, loc="outside lower center",
        )  # fmt: skip
        return figure


def _range(numbers: Iterable[int]) -> str:
    low, high = min(numbers), max(numbers)
    return f"{low}" if low == high else f"{low} to {high}"


def _varies(protocol: Mapping[str, Any]) -> str:
    text = str(protocol.get("doc") or "")
    varies, space = protocol.get("varies") or (), protocol.get("space")
    if not text and varies:
        text = ", ".join(varies) + (f" from {space}" if isinstance(space, str) else "")
    step = protocol.get("step") or 0
    return f"{text} after {step} steps".strip() if step else text


@styled
def bars_figure(evaluation: Evaluation, metric: str | None = None) -> Figure:
    """Draw the mean score in each protocol, a bar for each agent and engine.

    Whiskers are 95 % intervals; a bar has none if the data say nothing about it. Where an agent
    did not act in a protocol there is a dash. ``metric`` is one of ``METRICS``.

    Raises:
        UnknownOption: The metric is unknown.
    """
    from matplotlib.patches import Patch

    chart = Chart(evaluation, metric)
    bars, scores, count = chart.bars, chart.scores, len(chart.bars)
    labels = ["\n".join([*textwrap.wrap(protocol, 36), *textwrap.wrap(doc, 36)])
              for protocol, doc in chart.words.items()]  # fmt: skip
    row = max(count, *(label.count("\n") + 1 for label in labels)) * BAR + 0.12  # [inches]
    note = f"Means of {chart.counted}, with 95 % intervals."
    figure = chart.sheet(
        6.6, row * len(labels) + 0.5, note, [Patch(**look) for look in bars.values()]
    )
    ax = figure.add_subplot()
    ax.set_yticks(range(len(labels)), labels)
    ax.set_ylim(len(labels) - 0.5, -0.5)  # the first protocol is above
    ax.grid(visible=False, axis="y")
    for edge in range(1, len(labels)):
        ax.axhline(edge - 0.5, color="#e6e9ee", lw=0.8, zorder=0.5)
    seen = [0.0, *(end for one in scores.values() for end in one.ends)]
    seen += [1.0] if chart.is_fraction else []
    room = 0.06 * ((max(seen) - min(seen)) or 1.0)
    ax.set_xlim(min(seen) - 2.5 * room * (min(seen) < 0.0), max(seen) + 2.5 * room)
    ax.set_xlabel(chart.metric_words)
    for x in (0.0, 1.0) if chart.is_fraction else (0.0,):
        ax.axvline(x, color=INK, lw=0.9, zorder=1.5, gid=f"line {x:g}")
    for place, protocol in enumerate(chart.words):
        for number, (line, look) in enumerate(bars.items()):
            y = place + (number - (count - 1) / 2) * BAR / row
            one = scores.get((line, protocol))
            if one is None:
                ax.text(0.0, y, " –", va="center_baseline", size=7)
                continue
            known = not math.isnan(one.width)
            reach = [[one.value - one.low], [one.high - one.value]] if known else None
            bar = ax.barh(y, one.value, 0.9 * BAR / row, gid="|".join((*line, protocol)),
                          xerr=reach, error_kw={"ecolor": INK, "elinewidth": 1.1},
                          **look)  # fmt: skip
            digits = 2 if abs(one.value) < 10.0 else 1 if abs(one.value) < 100.0 else 0
            text = f"{one.value:z.{digits}f}".replace("-", "−")
            ax.bar_label(bar, [text], padding=3, size=7, bbox=PAPER)
    return figure


@styled
def profile_figure(evaluation: Evaluation, metric: str | None = None) -> Figure:
    """Draw the share of scores above each threshold, with a band: a panel for each backend.

    Where every agent has several training runs a score is that of a run in a protocol, else that of
    an episode; the figure says which.

    Raises:
        UnknownOption: The metric is unknown, or agents have not played the same protocols, or one
            episode only.
    """
    chart, engines = Chart(evaluation, metric), evaluation.engines
    for agent, protocol in product(evaluation.agents, evaluation.protocols):
        if protocol not in evaluation.only(agent=agent).protocols:
            allowed = (f"agents that have all played {protocol}",)
            raise UnknownOption("agent of a comparison", agent, allowed)
    scores = {(a, e): evaluation.scores(chart.metric, agent=a, engine=e) for a, e in chart.lines}
    over = "runs" if all(len(one) > 1 for one in scores.values()) else "episodes"
    units = [one.mean(axis=2) if over == "runs" else one for one in scores.values()]
    low, high = min(one.min() for one in units), max(one.max() for one in units)
    room = 0.02 * ((high - low) or 1.0)
    if chart.is_fraction:
        low, high, room = 0.0, 1.0, 0.0
    at = np.linspace(low - room, high + room, 101)
    unit = {"runs": "a run", "episodes": "an episode"}[over]
    note = f"Share of the scores of {unit} in a protocol that are higher; bands are 95 % intervals."
    figure = chart.sheet(6.2, 4.2 * len(engines), note)
    axes = figure.subplots(len(engines), 1, squeeze=False)[:, 0]
    panels = dict(zip(engines, axes, strict=True))
    for (agent, engine), look in chart.lines.items():
        ax, profile = panels[engine], performance_profile(scores[agent, engine], at, over=over)
        shift = chart.shifts[agent, engine]
        style = {**look, "markevery": (0.06 + 0.1 * shift, 0.12), "markersize": 4.0}
        ax.plot(at, profile.share, drawstyle="steps-post", gid=agent, **style)
        ax.fill_between(at, profile.low, profile.high, step="post", color=style["color"],
                        alpha=0.16, lw=0, gid=f"band {agent}")  # fmt: skip
    for engine, ax in panels.items():
        ax.set_ylim(-0.03, 1.03)
        ax.set_ylabel("share of scores above it")
        ax.set_xlabel(f"threshold of the {chart.metric_words}")
        ax.set_title(f"on {engine}" if len(panels) > 1 else "", loc="left", weight="bold")
    return figure


@styled
def radar_figure(evaluation: Evaluation, metric: str | None = None) -> Figure:
    """Draw the mean scores as polygons, with bands of their 95 % intervals.

    A line is open where its agent did not act in a protocol.

    Raises:
        UnknownOption: There are fewer than three protocols, or the metric is unknown.
    """
    chart = Chart(evaluation, metric)
    words, scores = chart.words, chart.scores
    if len(words) < 3:
        allowed = ("three protocols or more; bars_figure draws fewer",)
        raise UnknownOption("protocols of a radar", ", ".join(words), allowed)
    seen = [end for one in scores.values() for end in one.ends]
    low, high = min(seen), max(seen)
    room = 0.05 * ((high - low) or 1.0)
    note = f"Means of {chart.counted}; bands are 95 % intervals. "
    note += "; ".join(f"{name}: {doc}" for name, doc in words.items() if doc)
    size = max(7.0, 0.3 * len(words))
    figure = chart.sheet(size, size, note)
    ax = cast("PolarAxes", figure.add_subplot(projection="polar"))
    turns = np.linspace(0.0, 2.0 * np.pi, len(words) + 1)
    ax.set_theta_zero_location("N")
    ax.set_theta_direction(-1)
    ax.set_xticks(turns[:-1], [textwrap.fill(name, 16) for name in words], weight="bold")
    is_fraction = chart.is_fraction
    bottom = min(0.0, low) if is_fraction else low - room
    ax.set_ylim(bottom, max(1.0, high) if is_fraction else high)
    ax.set_rlabel_position(180.0 / len(words))
    ax.tick_params(axis="x", pad=12)
    ax.tick_params(axis="y", labelsize=7)
    for line, style in chart.lines.items():
        ring = [scores.get((line, protocol)) for protocol in (*words, next(iter(words)))]
        known = [one or Interval(math.nan, math.nan, math.nan, 0.0, 0) for one in ring]
        gid = "|".join(line)
        beside = turns + chart.shifts[line] * np.pi / (8 * len(words))
        ax.plot(beside, [one.value for one in known], gid=gid, clip_on=False, zorder=3, **style)
        lows, highs = ([f(one.ends) for one in known] for f in (min, max))
        band = {"color": style["color"], "alpha": 0.16, "lw": 0, "gid": f"band {gid}"}
        ax.fill_between(beside, lows, highs, **band)
    return figure


# --- adaptation -----------------------------------------------------------------------------------


def _drawn(evaluation: Evaluation) -> dict[str, list[str]]:
    """Return the columns that each protocol draws; of a function, also those of the environment."""
    varies = {one["name"]: one.get("varies") for one in evaluation.about.get("protocols", ())}
    found = {}
    for protocol in evaluation.protocols:
        frame = evaluation.only(protocol=protocol).frame
        every = {one: name for name, own in drawn_columns(frame).items() for one in own}
        every = {one: name for one, name in every.items() if frame[one].nunique() > 1}
        named = [one for one, name in every.items() if fits(name, varies.get(protocol) or ())]
        found[protocol] = named or [*every]
    return found


def _curve(
    ax: Axes, look: Mapping[str, Any], gid: str, x: Any, y: Any, low: Any, high: Any
) -> None:
    ax.plot(x, y, gid=gid, **look)
    ax.fill_between(x, low, high, color=look["color"], alpha=0.16, lw=0, gid=f"band {gid}")


@styled
def strength_figure(evaluation: Evaluation, metric: str | None = None) -> Figure:
    """Draw the mean score by the drawn value of each cause: a panel for each number that is drawn.

    Episodes are binned by that number, ten or more in a bin. They are those of the protocols that
    draw nothing else; if there is none, of those that draw the same others with it, the fewest, and
    these numbers come last. What every episode draws, such as start states, has panels where no
    protocol varies anything. Shaded is where the values of protocols with space A and B lie. The
    first twelve are drawn.

    Raises:
        UnknownOption: The metric is unknown, or no protocol draws a variable.
    """
    chart, drawn, frame = Chart(evaluation, metric), _drawn(evaluation), evaluation.by_draw.frame
    about = {one["name"]: one for one in evaluation.about.get("protocols", ())}
    varying = [one for one in drawn if about[one].get("varies") != []]
    panels: dict[tuple[str, int], list[str]] = {}  # protocols, by column and control step
    for protocol in sorted(varying or drawn, key=lambda one: len(drawn[one])):
        for column in drawn[protocol]:
            mine = panels.setdefault((column, about[protocol]["step"]), [])
            if not mine or drawn[protocol] == drawn[mine[0]]:
                mine.append(protocol)
    if not panels:
        raise UnknownOption("protocols", evaluation.protocols, ("one that draws a variable",))
    count = min(len(panels), PANELS)
    wide, high = min(3, count), math.ceil(count / 3)
    note = f"Means over bins of a drawn number, with 95 % intervals; {count} of {len(panels)} "
    note += "numbers. Shaded: drawn from A (light) and from B (dark)."
    figure = chart.sheet(max(3.2 * wide, 5.0), 2.6 * high, note)
    axes = figure.subplots(high, wide, squeeze=False, sharey=True)
    for ax in axes.flat[count:]:
        ax.remove()
    for ax, ((column, step), protocols) in zip(axes.flat, panels.items(), strict=False):
        for space, shade in (("A", 0.06), ("B", 0.14)):
            of = [one for one in protocols if about[one]["space"] == space]
            if len(lie := frame[column][frame["protocol"].isin(of)]):
                ax.axvspan(lie.min(), lie.max(), color=INK, alpha=shade, lw=0, gid=space)
        units = frame[frame["protocol"].isin(protocols)].groupby([*KEYS[:1], *KEYS[2:]])
        mean = units[[column, chart.metric]].mean().reset_index()  # over training runs
        values, draws = np.unique(mean[column]), mean.groupby([*KEYS[3:]]).ngroups
        parts = np.array_split(values, min(max(draws // FEWEST, 1), BINS, len(values)))
        mean["bin"] = np.searchsorted([part[0] for part in parts], mean[column], side="right")
        for (agent, engine), look in chart.lines.items():
            rows = mean[(mean["agent"] == agent) & (mean["engine"] == engine)]
            bins = [one for _, one in rows.groupby("bin")]
            scores = [one[chart.metric].to_numpy() for one in bins]
            found = [mean_interval(one, proportion=RATES[chart.metric]) for one in scores]
            ends = np.array([(one.value, one.low, one.high) for one in found]).reshape(-1, 3).T
            style, gid = {**look, "markersize": 4.0}, f"{agent}|{engine}|{column}|{step}"
            _curve(ax, style, gid, [one[column].mean() for one in bins], *ends)
        title = column.removeprefix(DRAWN) + (f" after {step} steps" if step else "")
        ax.set_title(textwrap.fill(f"{title} ({', '.join(protocols)})", 38), size=8)
    for ax in axes[:, 0]:
        ax.set_ylabel(textwrap.fill(chart.metric_words, 34))
    return figure


@styled
def regret_figure(
    evaluation: Evaluation, metric: str | None = None, *, reference: str | None = None
) -> Figure:
    """Draw the regret to a reference agent: a row for each protocol that varies one variable.

    A column is an agent on a backend, and a cell has the regret with its interval, see
    ``Evaluation.regret``; bold where the interval does not contain 0. A pattern of names counts as
    one variable.

    Raises:
        UnknownOption: The metric or the agent is unknown, or there is no such protocol, no other
            agent, or a draw that not all have played.
    """
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.patches import Patch

    chart, reference = Chart(evaluation, metric), evaluation.the("agent", reference)
    declared = {one["name"]: one.get("varies") or () for one in evaluation.about["protocols"]}
    names = [name for name in evaluation.protocols if len(declared[name]) == 1]
    lines = [line for line in chart.lines if line[0] != reference]
    if not (names and lines):
        allowed = ("one with another agent, and with a protocol that varies one variable",)
        raise UnknownOption("evaluation for regret", evaluation.protocols, allowed)
    found = [[evaluation.regret(agent, reference, name, chart.metric, engine=engine)
              for agent, engine in lines] for name in names]  # fmt: skip
    table = np.array([[one.value for one in row] for row in found])
    words = (f"{reference} scores lower", f"{reference} scores higher")
    ends = [Patch(color=c, label=word) for c, word in zip(PALETTE, words, strict=False)]
    note = f"By how much {reference} scores higher in the same draws, with 95 % intervals."
    figure = chart.sheet(max(2.8 + 1.2 * len(lines), 5.0), 0.45 * len(names) + 0.5, note, ends)
    ax = figure.add_subplot()
    most = 2.0 * (float(np.abs(table).max()) or 1.0)  # pale enough for text
    colors = LinearSegmentedColormap.from_list("regret", [PALETTE[0], "white", PALETTE[1]])
    ax.imshow(table, colors, vmin=-most, vmax=most, aspect="auto")
    ax.set_xticks(
        range(len(lines)), [textwrap.fill(chart.lines[one]["label"], 16) for one in lines]
    )
    texts = ["\n".join((*declared[name], f"{name} {chart.words[name]}")) for name in names]
    ax.set_yticks(range(len(names)), texts)
    ax.grid(visible=False)
    for y, row in enumerate(found):
        for x, one in enumerate(row):
            text = str(one).replace(" [", "\n[").replace("-", "−")
            weight = "bold" if one.excludes(0.0) else "normal"
            ax.text(x, y, text, ha="center", va="center", size=7, weight=weight)
    return figure


@styled
def recovery_figure(evaluation: Evaluation, metric: str | None = None) -> Figure:
    """Draw the mean reward by control step since an intervention within episodes, with bands.

    Each protocol of this kind has a panel; see ``Evaluation.since``. The metric does not matter.

    Raises:
        UnknownOption: The metric is unknown, no rewards were kept, or no protocol intervenes within
            episodes.
    """
    chart, rewards = Chart(evaluation, metric), evaluation.rewards
    about = {one["name"]: one["step"] for one in evaluation.about.get("protocols", ())}
    shown = [name for name in evaluation.protocols if about.get(name)]
    if rewards is None or not shown:
        allowed = ("one with steps=True, of a protocol such as P2@100",)
        raise UnknownOption("evaluation for recovery", evaluation.protocols, allowed)
    size = math.ceil(rewards.shape[1] / CURVE)
    chart.metric_words = "reward since an intervention"
    note = f"Means over {size} control steps of {chart.counted}, with 95 % intervals."
    figure = chart.sheet(6.2, 2.6 * len(shown), note)
    for ax, name in zip(figure.subplots(len(shown), squeeze=False)[:, 0], shown, strict=True):
        for (agent, engine), look in chart.lines.items():
            if name in evaluation.only(agent=agent, engine=engine).protocols:
                found = evaluation.since(name, agent=agent, engine=engine, every=size)
                style = {**look, "markevery": 5, "markersize": 4.0}
                _curve(ax, style, "|".join((agent, engine, name)), *found.to_numpy().T)
        ax.axvline(0.0, color=INK, lw=0.9, zorder=1.5)
        ax.set_xlabel("control steps since the intervention")
        ax.set_ylabel("reward of a control step")
        ax.set_title(f"{name} {chart.words[name]}", loc="left", weight="bold")
    return figure


FIGURES: Mapping[str, Callable[[Evaluation, str | None], Figure]] = {
    "bars": bars_figure,
    "radar": radar_figure,
    "profile": profile_figure,
    "strength": strength_figure,
    "recovery": recovery_figure,
}


def write_figures(
    evaluation: Evaluation,
    folder: Location | str,
    metric: str | None = None,
    *,
    reference: str | None = None,
) -> tuple[Location, ...]:
    """Draw every figure that an evaluation has numbers for.

    Args:
        evaluation: The evaluation.
        folder: Where to; it is there. It may be a URL. Figures of an earlier evaluation go.
        metric: One of ``METRICS``; the first that the evaluation has if None.
        reference: The agent with which ``regret.png`` compares the others; no such figure if None.

    Returns:
        The files: ``bars.png``; ``radar.png`` of three protocols or more; ``profile.png`` where all
        agents have played the same protocols; ``strength.png`` where variables are drawn;
        ``regret.png`` of protocols that vary one variable; and ``recovery.png`` of rewards by step.

    Raises:
        UnknownOption: The metric or the reference is unknown, or episodes are missing.
        UnwritableFolder: The disk is full, or permission is missing.
    """
    metric, place = evaluation.metric(metric), located(folder)
    if not len(evaluation):
        raise UnknownOption("evaluation", "without episodes", ("one with an episode or more",))
    one_of("reference", reference, (None, *evaluation.agents))
    files, drawn = list[Location](), dict(FIGURES)
    if reference is not None:
        drawn["regret"] = partial(regret_figure, reference=reference)
    for name in (*FIGURES, "regret"):
        path = place / f"{name}.png"
        remove(path)
        if name not in drawn:
            continue
        try:
            figure = drawn[name](evaluation, metric)
        except UnknownOption:
            if name == "bars":
                raise
            continue
        save(figure, path)
        files.append(path)
    return tuple(files)
