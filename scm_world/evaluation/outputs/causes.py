"""Which cause broke the agent, as a picture: a panel for each protocol that varies something."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from scm_world.evaluation.outputs.looks import metric_words, protocol_words
from scm_world.evaluation.outputs.sheets import GAP, MARGIN, PLAIN, Sheet, text_size, wrapped
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.statistics import Cause, Causes
from scm_world.output.canvas import INK, PALETTE, save
from scm_world.output.locations import Location

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ALPHA = 0.05
ACROSS = 2  # panels side by side
NAMES, AXIS, SAID = 2.7, 3.0, 1.35  # [inches]: names, bars, and what stands to their right
ROW, LOW = 0.24, 0.5  # [inches]: of a variable, and for the numbers below
SHOWN = 10  # variables of a panel, unless more of them have an effect
TEXT, HEAD = 8.0, 10.0  # [points]
SURE, UNSURE = PALETTE[0], "#aab2bd"
SIGNS: Mapping[str, str] = {"up": "▲", "down": "▼", "unclear": "?"}


def causes_of(
    evaluation: Evaluation,
    agent: str | None = None,
    engine: str | None = None,
    metric: str | None = None,
) -> dict[str, Causes]:
    """Estimate the effects in every protocol in which an agent acted on an engine.

    Raises:
        UnknownOption: There is no such agent, engine or metric, or it has to be named.
    """
    metric = evaluation.metric(metric)
    agent, engine = evaluation.the("agent", agent), evaluation.the("engine", engine)
    mine = evaluation.only(agent=agent, engine=engine)
    return {protocol: mine.causes(protocol, metric) for protocol in mine.protocols}


def draw_causes(
    evaluation: Evaluation,
    path: Location | str,
    agent: str | None = None,
    engine: str | None = None,
    metric: str | None = None,
) -> None:
    """Draw what each varied variable does to the score, the strongest one above.

    A bar is the share of the score's variance that a variable explains, with its 95 % interval. It
    is blue with a star if the effect is significant (Holm p at most 0.05 within the protocol). To
    its right stands how much higher the score is in the upper third of the drawn values than in the
    lower third: ▲ if it rises, ▼ if it falls.

    Args:
        evaluation: Any.
        path: Of the PNG. The same evaluation gives the same bytes.
        agent: Who acted; need not be named if there is only one.
        engine: Where; need not be named if there is only one.
        metric: One of ``METRICS``.

    Raises:
        UnknownOption: There is no such agent, engine or metric, or it has to be named.
        UnwritableFolder: There is no such folder, no room, or no permission.
    """
    found = causes_of(evaluation, agent, engine, metric)
    agent, engine = evaluation.the("agent", agent), evaluation.the("engine", engine)
    save(causes_figure(evaluation, found, agent, engine, metric), path)


def causes_figure(
    evaluation: Evaluation,
    found: Mapping[str, Causes],
    agent: str,
    engine: str,
    metric: str | None = None,
) -> Figure:
    """Draw effects that are known already, by protocol."""
    metric = evaluation.metric(metric)
    varied = {name: one for name, one in found.items() if one.causes or one.left_out}
    panels = {name: one for name, one in varied.items() if not is_flat(one)}
    flat = [name for name in varied if name not in panels]
    nothing = [name for name in found if name not in varied]
    note = (
        "Share of the score's variance that a variable explains, with 95 % intervals. Blue with a "
        "star: it has an effect (Holm p ≤ 0.05). Right: mean score with high values minus that "
        "with low ones, ▲ it rises, ▼ it falls with the value, ? unclear."
    )
    if nothing:
        note += f" Nothing varies in {', '.join(nothing)}."
    if flat:
        note += f" All episodes had the same score in {', '.join(flat)}."
    words = protocol_words(evaluation)
    heads = {name: _head(name, words[name]) for name in panels}
    rows = [list(panels)[i : i + ACROSS] for i in range(0, len(panels), ACROSS)]
    heights = [max(_height(panels[n], heads[n]) for n in row) for row in rows]
    width = NAMES + AXIS + SAID
    sheet = Sheet(
        min(ACROSS, len(panels) or 1) * width + 2 * MARGIN, sum(heights),
        title=f"{evaluation.task}: what the {metric_words(metric)} of {agent} on {engine} "
        "depends on",
        note=note,
    )  # fmt: skip
    down = 0.0
    for row, height in zip(rows, heights, strict=True):
        for column, name in enumerate(row):
            _panel(sheet, MARGIN + column * width, down, heads[name], panels[name], name)
        down += height
    return sheet.figure


def is_flat(found: Causes) -> bool:
    """Tell whether there is nothing to explain: the score was the same in every episode."""
    return bool(found.causes) and all(
        cause.share.high == 0.0 and cause.p == 1.0 for cause in found.causes
    )


def _head(name: str, doc: str) -> str:
    text = f"{name}: {doc}" if doc else name
    return wrapped(text, NAMES + AXIS + SAID - 0.4, HEAD, bold=True)


def _shown(found: Causes) -> Sequence[Cause]:
    return found.ranked()[: max(SHOWN, len(found.found(ALPHA)))]


def _rest(found: Causes) -> str:
    """Say what is not drawn."""
    said = []
    hidden = found.ranked()[len(_shown(found)) :]
    if hidden:
        most = max(cause.share.value for cause in hidden)
        said.append(f"{len(hidden)} more explain {most:.2f} or less each, none significantly")
    if found.left_out:
        name, reason = next(iter(found.left_out.items()))
        more = f", and {len(found.left_out) - 1} more" if len(found.left_out) > 1 else ""
        said.append(f"left out: {name} ({reason}){more}")
    return wrapped("; ".join(said), NAMES + AXIS + SAID - 0.4, TEXT)


def _label(cause: Cause) -> str:
    return wrapped(cause.variable, NAMES - GAP, TEXT)


def _rows(found: Causes) -> list[float]:
    return [max(ROW, text_size(_label(cause), TEXT)[1] + 0.08) for cause in _shown(found)]


def _height(found: Causes, head: str) -> float:
    rest = _rest(found)
    below = text_size(rest, TEXT)[1] + GAP if rest else 0.0
    bars = sum(_rows(found)) + LOW if found.causes else 0.0
    return text_size(head, HEAD, bold=True)[1] + GAP + bars + below + 2 * GAP


def _panel(sheet: Sheet, left: float, down: float, head: str, found: Causes, protocol: str) -> None:
    sheet.write(left, sheet.up(down), head, size=HEAD, weight="bold", va="top")
    down += text_size(head, HEAD, bold=True)[1] + GAP
    if found.causes:
        rows = _rows(found)
        ax = sheet.axes(left + NAMES, down, AXIS, sum(rows))
        _bars(ax, rows, _shown(found), protocol)
        down += sum(rows) + LOW
    rest = _rest(found)
    if rest:
        sheet.write(left, sheet.up(down), rest, size=TEXT, va="top")


def _bars(ax: Axes, rows: Sequence[float], causes: Sequence[Cause], protocol: str) -> None:
    ax.set_xlim(0.0, 1.0)
    ax.set_ylim(sum(rows), 0.0)
    ax.grid(visible=False, axis="y")
    ax.set_xlabel("share of variance", size=TEXT, labelpad=1.0, **PLAIN)
    places = [sum(rows[: k + 1]) - rows[k] / 2 for k in range(len(rows))]
    for y, cause in zip(places, causes, strict=True):
        sure = cause.p_holm <= ALPHA
        ax.barh(
            y, cause.share.value, 0.16, color=SURE if sure else UNSURE,
            gid=f"{protocol}|{cause.variable}",
        )  # fmt: skip
        if not math.isnan(cause.share.width):
            ax.hlines(y, cause.share.low, cause.share.high, color=INK, lw=1.0, clip_on=False)
        ax.annotate(
            effect_words(cause), (1.0, y), xytext=(6, 0), textcoords="offset points", va="center",
            size=TEXT, annotation_clip=False, weight="bold" if sure else "normal", **PLAIN,
        )  # fmt: skip
    ax.set_yticks(places, [_label(cause) for cause in causes], size=TEXT)
    for text in ax.get_yticklabels():
        text.set_parse_math(False)


def effect_words(cause: Cause) -> str:
    """Say in a few signs what a variable does: which way, how much, of which component, how sure.

    A star stands for a Holm p of at most 0.05.
    """
    column = cause.column
    part = column.name.removeprefix(cause.variable)
    sign = SIGNS[column.direction]
    star = " *" if cause.p_holm <= ALPHA else ""
    return f"{sign} {column.contrast.value:+z.2f} {part}".rstrip() + star
