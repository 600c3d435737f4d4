"""How the lines, bars and words of all pictures of evaluations look."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

from scm_world.errors import UnknownOption
from scm_world.evaluation.arena import LAST, METRICS
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.statistics import Interval
from scm_world.output.canvas import PALETTE

if TYPE_CHECKING:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

HATCHES = ("", "////", "....", "xxxx", "----", "oooo")
MARKERS = "osD^vPX*<>ph"
DASHES: Sequence[Any] = ("solid", (0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)))
PALER = (0.0, 0.6, 0.85, 0.4)  # how much white is mixed into the color, by engine

WORDS: Mapping[str, str] = {
    "last_fractional_success": "fractional success at the end",
    "last_integrated_fractional_success": f"fractional success over the last {LAST} steps",
    "full_integrated_fractional_success": "fractional success over the whole episode",
    "success": "success rate",
    "return": "return",
}


def metric_words(metric: str) -> str:
    """Say in words what a metric is.

    Raises:
        UnknownOption: There is no such metric.

    Example:
        >>> metric_words("success")
        'success rate'
    """
    if metric not in METRICS:
        raise UnknownOption("metric", metric, METRICS)
    return WORDS[metric]


def is_fraction(metric: str) -> bool:
    """Tell whether a metric goes from 0 to 1."""
    return metric != "return"


@final
@dataclass(frozen=True)
class Line:
    """An agent on an engine: what one bar of each protocol, or one line, stands for."""

    agent: str
    engine: str


def lines_of(evaluation: Evaluation) -> list[Line]:
    """List who acted on which engine, agents in their order and then engines."""
    columns = evaluation.columns
    there = set(zip(columns["agent"].tolist(), columns["engine"].tolist(), strict=True))
    return [
        Line(agent, engine)
        for agent in evaluation.agents
        for engine in evaluation.engines
        if (agent, engine) in there
    ]


Scores = dict[tuple[Line, str], Interval]


def intervals(evaluation: Evaluation, metric: str) -> Scores:
    """Estimate all mean scores; a line has no entry for a protocol in which it did not act."""
    found: Scores = {}
    for line in lines_of(evaluation):
        mine = evaluation.only(agent=line.agent, engine=line.engine)
        for protocol in mine.protocols:
            found[line, protocol] = mine.score(protocol, metric)
    return found


def counted(evaluation: Evaluation) -> str:
    """Say how many runs and episodes stand behind a number.

    Example:
        >>> from scm_world.evaluation.pipeline import evaluate
        >>> counted(evaluate("still", "P0", n=2, backend="fake", env={"max_episode_length": 3}))
        '2 episodes of each protocol'
    """
    keys = ("agent", "engine", "protocol", "run")
    rows = zip(*(evaluation.columns[key].tolist() for key in keys), strict=True)
    each = sorted(set(Counter(rows).values()))
    runs = sorted({len(evaluation.runs(agent)) for agent in evaluation.agents})
    some = "" if runs == [1] else f" and {_range(runs)} training runs of each agent"
    return f"{_range(each)} episodes of each protocol{some}"


def _range(numbers: Sequence[int]) -> str:
    return f"{numbers[0]}" if numbers[0] == numbers[-1] else f"{numbers[0]} to {numbers[-1]}"


def protocol_words(evaluation: Evaluation) -> dict[str, str]:
    """Say what varies in each protocol; nothing about one of which the evaluation says nothing."""
    told = {one["name"]: one for one in evaluation.about.get("protocols", ())}
    return {name: _varies(told.get(name, {})) for name in evaluation.protocols}


def _varies(protocol: Mapping[str, Any]) -> str:
    said = str(protocol.get("doc") or "")
    varies, space = protocol.get("varies") or (), protocol.get("space")
    if not said and varies:
        said = ", ".join(varies) + (f" from {space}" if isinstance(space, str) else "")
    step = protocol.get("step") or 0
    return f"{said} after {step} steps".strip() if step else said


@final
class Looks:
    """Colors, hatches, markers and dashes: agents differ by the first three, engines by the last.

    Past the seventh agent colors come again with another hatch and another marker.

    Args:
        lines: All that are drawn, such as ``lines_of`` an evaluation.
        between: Stands between the names of agent and engine.
    """

    def __init__(self, lines: Sequence[Line], between: str = " on ") -> None:
        self.lines, self.between = list(lines), between
        self.agents = tuple(dict.fromkeys(line.agent for line in lines))
        self.engines = tuple(dict.fromkeys(line.engine for line in lines))

    def color(self, line: Line) -> str:
        """Give the color of the agent."""
        return PALETTE[self.agents.index(line.agent) % len(PALETTE)]

    def bar(self, line: Line) -> dict[str, Any]:
        """Give the arguments of a bar: the engine decides how pale it is."""
        group = self.agents.index(line.agent) // len(PALETTE)
        color, pale = self.color(line), PALER[self._engine(line) % len(PALER)]
        dark = pale == 0.0 and group > 0
        return {
            "facecolor": _mixed(color, pale),
            "edgecolor": "white" if dark else color,
            "hatch": HATCHES[group % len(HATCHES)],
            "linewidth": 0.9,
        }

    def line(self, line: Line) -> dict[str, Any]:
        """Give the arguments of a line: the engine decides how it is dashed."""
        return {
            "color": self.color(line),
            "marker": MARKERS[self.agents.index(line.agent) % len(MARKERS)],
            "linestyle": DASHES[self._engine(line) % len(DASHES)],
            "markersize": 5.0,
            "linewidth": 1.5,
        }

    def label(self, line: Line) -> str:
        """Name a line; the engine only where there are several."""
        name = " ".join(line.agent.split())
        return name if len(self.engines) == 1 else f"{name}{self.between}{line.engine}"

    def bar_key(self) -> list[Patch]:
        """Make the entries of a legend of bars."""
        from matplotlib.patches import Patch

        return [Patch(label=self.label(line), **self.bar(line)) for line in self.lines]

    def line_key(self) -> list[Line2D]:
        """Make the entries of a legend of lines."""
        from matplotlib.lines import Line2D

        return [Line2D([], [], label=self.label(line), **self.line(line)) for line in self.lines]

    def _engine(self, line: Line) -> int:
        return self.engines.index(line.engine)


def _mixed(color: str, white: float) -> str:
    """Mix a color with white.

    Example:
        >>> _mixed("#0072B2", 0.5)
        '#80b8d8'
    """
    parts = (int(color[i : i + 2], 16) for i in (1, 3, 5))
    return "#" + "".join(f"{round(part + (255 - part) * white):02x}" for part in parts)
