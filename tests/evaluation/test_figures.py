"""Pictures of evaluations: what is on them, and that all of it can be read."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.text import Text
from output_samples import LONG, NAMES, made

from scm_world.errors import UnknownOption
from scm_world.evaluation.figures import (
    WORDS,
    Chart,
    bars_figure,
    profile_figure,
    radar_figure,
    recovery_figure,
    regret_figure,
    save,
    strength_figure,
    write_figures,
)
from scm_world.evaluation.protocols import protocols_of
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.statistics import mean_interval

DOCS = {protocol.name: protocol.doc for protocol in protocols_of("pushing")}
BOTH = ("mujoco", "bullet")

EVALUATIONS: dict[str, Callable[[], Evaluation]] = {
    "one agent": lambda: made(1, 3),
    "nine agents": lambda: made(9),
    "two engines": lambda: made(4, 5, engines=BOTH, runs=2),
    "long names": lambda: made([LONG.format(k) for k in range(3)], 5),
    "zeros": lambda: made(2, 4, score=0.0),
    "ones": lambda: made(2, 4, score=1.0),
    "one episode": lambda: made(2, 3, runs=2, n=1),
}


FIGURES: dict[str, Callable[[Evaluation], Figure]] = {
    "bars": bars_figure,
    "returns": lambda evaluation: bars_figure(evaluation, "return"),
    "radar": radar_figure,
    "profile": profile_figure,
}


def texts(figure: Figure) -> Iterator[Text]:
    """Give all texts that are seen."""
    yield from figure.texts
    for legend in figure.legends:
        yield from (legend.get_title(), *legend.get_texts())
    for ax in figure.axes:
        yield from ax.texts
        yield from (ax.title, ax._left_title)  # type: ignore[attr-defined]
        for axis in (ax.xaxis, ax.yaxis):
            low, high = sorted(axis.get_view_interval())
            yield axis.label
            yield from (
                tick.label1
                for tick in axis.get_major_ticks()
                if low <= tick.get_loc() <= high and tick.label1.get_visible()
            )


def words(figure: Figure) -> list[str]:
    """Give what stands on a picture, lines joined and one by one."""
    seen = [text.get_text() for text in texts(figure) if text.get_text().strip()]
    return [" ".join(text.split()) for text in seen] + [
        line for text in seen for line in text.split("\n")[1:]
    ]


def named(figure: Figure, gid: str) -> list[Any]:
    """Find what has a name that fits a pattern."""
    return [one for one in figure.findobj() if re.fullmatch(gid, str(one.get_gid() or ""))]


def assert_readable(figure: Figure) -> None:
    """Assert that no two texts overlap, and that all are on what is written."""
    figure.canvas.draw()
    renderer = figure.canvas.get_renderer()  # type: ignore[attr-defined]
    seen = [text for text in texts(figure) if text.get_text().strip()]
    boxes = [(text.get_text(), text.get_window_extent(renderer)) for text in seen]
    sheet = figure.get_tightbbox(renderer).padded(0.01)  # [inches]
    for text, box in boxes:
        corners = box.transformed(figure.dpi_scale_trans.inverted()).corners()
        assert all(sheet.contains(*corner) for corner in corners), f"{text!r} is not on the sheet"
    for (one, a), (other, b) in combinations(boxes, 2):
        wide = min(a.x1, b.x1) - max(a.x0, b.x0)
        high = min(a.y1, b.y1) - max(a.y0, b.y0)
        assert wide <= 1.0 or high <= 1.0, f"{one!r} and {other!r} overlap"


# --- all pictures -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("which", "figure"),
    [
        *((which, figure) for which in list(EVALUATIONS)[:4] for figure in FIGURES),
        *((which, "bars") for which in list(EVALUATIONS)[4:]),
        ("one episode", "returns"),
        ("zeros", "radar"),
    ],
)
def test_no_text_hides_another(which: str, figure: str) -> None:
    """However many agents, engines and protocols there are, all texts can be read."""
    assert_readable(FIGURES[figure](EVALUATIONS[which]()))


EVERY = (bars_figure, radar_figure, profile_figure)


@pytest.mark.parametrize("draw", EVERY)
def test_the_same_evaluation_gives_the_same_bytes(draw: Any, tmp_path: Path) -> None:
    """Nothing of the time or the place is in a picture."""
    evaluation = made(1, 4, engines=BOTH, runs=2)
    pictures = []
    for name in ("one.png", "other.png"):
        save(draw(evaluation), tmp_path / name)
        pictures.append((tmp_path / name).read_bytes())
    assert pictures[0] == pictures[1]
    assert pictures[0].startswith(b"\x89PNG")


@pytest.mark.parametrize("draw", EVERY)
def test_an_unknown_metric_is_refused(draw: Any) -> None:
    """The metrics that there are, are named."""
    evaluation = made(1, 3, engines=BOTH)
    with pytest.raises(UnknownOption, match="last_fractional_success"):
        draw(evaluation, metric="luck")


def test_all_lines_look_different() -> None:
    """Twenty agents on two engines have forty kinds of bars and of lines."""
    chart = Chart(made([f"agent {k}" for k in range(20)], 1, engines=BOTH, n=1))
    bars = {(look["facecolor"], look["hatch"]) for look in chart.bars.values()}
    lines = {tuple(map(str, look.values())) for look in chart.lines.values()}
    assert len(bars) == len(lines) == len(chart.lines) == 40


# --- bars -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("agents", "protocols", "engines"), [(1, 3, 1), (4, 12, 1), (9, 12, 2)])
def test_every_agent_has_a_bar_in_every_protocol(agents: int, protocols: int, engines: int) -> None:
    """None is left out, however many there are; a bar is as high as the mean score."""
    evaluation = made(agents, protocols, engines=BOTH[:engines])
    figure = bars_figure(evaluation)
    bars = {bar.get_gid(): bar.get_width() for bar in named(figure, r"[^ ]*\|.*\|P\d+")}
    assert len(bars) == agents * protocols * engines
    last = evaluation.protocols[-1]
    score = evaluation.score(last, agent=NAMES[agents - 1], engine=BOTH[engines - 1])
    assert bars[f"{NAMES[agents - 1]}|{BOTH[engines - 1]}|{last}"] == score.value

    intervals = [one.get_segments()[0][:, 0] for one in figure.findobj(LineCollection)]
    np.testing.assert_allclose(intervals[-1], [score.low, score.high])


def test_bars_are_named() -> None:
    """Below the bars stand protocols and what varies, in the legend agents and engines."""
    seen = words(bars_figure(made(2, engines=BOTH)))
    assert {f"{name} {doc}" for name, doc in DOCS.items()} <= set(seen)
    assert {"ppo on mujoco", "ppo on bullet", "sac on mujoco", "sac on bullet"} <= set(seen)
    assert {"ppo", "sac"} <= set(words(bars_figure(made(2))))


def test_the_axis_fits_the_metric() -> None:
    """Fractions have lines at 0 and 1; returns have one at 0 and may be negative."""
    fractions, returns = bars_figure(made(2, 3)), bars_figure(made(2, 3), "return")
    assert len(named(fractions, "line 0")) == len(named(fractions, "line 1")) == 1
    assert len(named(returns, "line 0")) == 1
    assert not named(returns, "line 1")
    assert returns.axes[0].get_xlim()[0] < -60.0
    assert WORDS["return"] in words(returns)


def test_a_protocol_in_which_an_agent_did_not_act_has_a_dash() -> None:
    """It is no score of zero."""
    evaluation = made(2, 3, kept=lambda row: (row["agent"], row["protocol"]) != ("sac", "P1"))
    figure = bars_figure(evaluation)
    assert len(named(figure, r"sac\|mujoco\|.*")) == 2
    assert [word.strip() for word in words(figure)].count("–") == 1


def test_a_score_of_one_episode_has_no_whisker() -> None:
    """Where numbers have no bounds the data say nothing about its interval."""
    figure = bars_figure(made(1, 3, n=1), metric="return")
    assert len(named(figure, r"ppo\|.*")) == 3
    assert not figure.findobj(LineCollection)


# --- radar ------------------------------------------------------------------------------------


def test_the_first_axis_of_a_radar_is_up() -> None:
    """The others follow clockwise, and the rings say their score."""
    figure = radar_figure(made(2))
    (ax,) = figure.axes
    assert (ax.get_theta_offset(), ax.get_theta_direction()) == (np.pi / 2, -1)  # type: ignore[attr-defined]
    figure.canvas.draw()
    places = {text.get_text(): text.get_window_extent() for text in ax.get_xticklabels()}
    assert places["P0"].y0 == max(places[name].y0 for name in DOCS)
    assert places["P3"].x0 == max(places[name].x0 for name in DOCS)
    assert {"0.2", "0.4", "0.6", "0.8", "1.0"} <= set(words(figure))
    assert any(all(doc in word for doc in DOCS.values()) for word in words(figure))


def test_no_agent_is_dropped_from_a_radar() -> None:
    """Every line has its band, however many there are."""
    evaluation = made(9, 4)
    figure = radar_figure(evaluation)
    for agent in evaluation.agents:
        (line,) = named(figure, rf"{agent}\|mujoco")
        assert line.get_ydata()[2] == evaluation.score("P2", agent=agent).value
        assert len(named(figure, rf"band {agent}\|mujoco")) == 1


def test_a_radar_grows_with_its_protocols() -> None:
    """The names of thirty axes do not meet."""
    many, few = radar_figure(made(1, 30, n=2)), radar_figure(made(1, 12, n=2))
    assert_readable(many)
    assert many.get_figwidth() > few.get_figwidth()
    assert any("P7@100: goal, start, mass from A after 100 steps;" in word for word in words(many))


def test_two_protocols_make_no_radar() -> None:
    """The message says what to draw instead."""
    with pytest.raises(UnknownOption, match="bars_figure"):
        radar_figure(made(1, 2))


def test_returns_may_be_negative_in_a_radar() -> None:
    """The center is below the lowest end of all intervals."""
    (ax,) = radar_figure(made(2, 4), "return").axes
    assert ax.get_ylim()[0] < -66.0


# --- profiles ---------------------------------------------------------------------------------


def test_profiles_are_complete() -> None:
    """Every agent has a line and a band."""
    evaluation = made(4, 3, runs=2)
    figure = profile_figure(evaluation)
    for agent in evaluation.agents:
        assert len(named(figure, agent)) == len(named(figure, f"band {agent}")) == 1
    assert any("of a run in a protocol" in word for word in words(figure))


def test_one_run_is_compared_by_episodes() -> None:
    """The picture says so."""
    figure = profile_figure(made(1, 3))
    assert any("of an episode in a protocol" in word for word in words(figure))
    assert len(figure.axes) == 1


def test_agents_in_other_protocols_have_no_profile() -> None:
    """A comparison over different protocols would say nothing."""
    evaluation = made(2, 3, kept=lambda row: (row["agent"], row["protocol"]) != ("sac", "P1"))
    with pytest.raises(UnknownOption, match="P1"):
        profile_figure(evaluation)


def test_agents_with_equal_scores_are_all_seen() -> None:
    """Their lines lie on one another, with other widths, and their markers beside one another."""
    agents = ("one", "two", "three")
    evaluation = made(agents, 4, score=0.5)
    for figure in (radar_figure(evaluation), profile_figure(evaluation)):
        lines = [named(figure, rf"{agent}(\|mujoco)?")[0] for agent in agents]
        assert len({line.get_linewidth() for line in lines}) == 3
        places = {(str(line.get_markevery()), line.get_xdata()[0]) for line in lines}
        assert len(places) == 3


# --- adaptation ---------------------------------------------------------------------------------


def test_strength_has_the_mean_score_of_each_bin() -> None:
    """P1 and P2 draw the mass alone: 80 draws are eight bins of ten, in the order of the mass."""
    evaluation = made(2, 3, n=40, runs=2)
    figure = strength_figure(evaluation)
    assert len(figure.axes) == 1  # the friction, which no protocol names, has no panel
    frame, column = evaluation.frame, "drawn tool_block.mass"
    for agent in evaluation.agents:
        mine = frame[(frame["agent"] == agent) & frame[column].notna()]
        draws = [(one[column].iloc[0], one["last_fractional_success"].mean())
                 for _, one in mine.groupby(["protocol", "episode"])]  # fmt: skip
        bins = np.array(sorted(draws)).reshape(8, 10, 2)
        (line,) = named(figure, rf"{agent}\|mujoco\|{column}\|0")
        np.testing.assert_allclose(line.get_xydata(), bins.mean(axis=1))
        (band,) = named(figure, rf"band {agent}\|.*")
        ends = [mean_interval(one) for one in bins[:, :, 1]]
        low, high = band.get_paths()[0].vertices[:, 1].min(), max(one.high for one in ends)
        np.testing.assert_allclose(low, min(one.low for one in ends))
        np.testing.assert_allclose(band.get_paths()[0].vertices[:, 1].max(), high)
    (shade,) = named(figure, "A")
    values = frame[frame["protocol"] == "P1"][column]
    assert shade.get_x() == values.min()
    assert shade.get_x() + shade.get_width() == pytest.approx(values.max())
    assert_readable(figure)


def test_strength_has_all_protocols_that_draw_the_same_numbers() -> None:
    """P1 and P2 draw mass and friction together: a panel for each, with the episodes of both."""
    evaluation = made(2, 3, n=40, kept=lambda row: row["protocol"] in ("P0", "P1", "P2"))
    both = ["tool_block.mass", "floor_friction"]
    named_so = [{**one, "varies": both if one["name"] in ("P1", "P2") else one["varies"]}
                for one in evaluation.about["protocols"]]  # fmt: skip
    evaluation = replace(evaluation, about={**evaluation.about, "protocols": named_so})
    panels = strength_figure(evaluation).axes
    assert len(panels) == 2
    assert all(ax.get_title().endswith("(P1, P2)") for ax in panels)


def test_regret_has_the_difference_of_the_means() -> None:
    """Rows are the protocols that vary one variable, columns all agents but the reference."""
    evaluation = made(3, 9)
    figure = regret_figure(evaluation, reference="sac")
    (ax,) = figure.axes
    mean = evaluation.frame.groupby(["protocol", "agent"])["last_fractional_success"].mean()
    rows = ["P1", "P2", "P3", "P4", "P5"]
    wanted = [[mean[row, "sac"] - mean[row, agent] for agent in ("ppo", "td3")] for row in rows]
    np.testing.assert_allclose(np.array(ax.images[0].get_array()), wanted)
    cell = evaluation.regret("td3", "sac", "P5")
    assert ax.texts[-1].get_text().split("\n")[0] == f"{cell.value:.2f}"
    assert_readable(figure)
    with pytest.raises(UnknownOption, match="varies one variable"):
        regret_figure(made(2, 1), reference="sac")


def test_recovery_has_the_mean_reward_by_step() -> None:
    """Of 120 steps, three make a point, and they are counted from the intervention at 100."""
    evaluation = made(2, 13, n=4, kept=lambda row: row["protocol"] == "P0@100")
    rewards = np.random.default_rng(0).random((8, 120))
    figure = recovery_figure(replace(evaluation, rewards=rewards))
    for agent in evaluation.agents:
        mine = rewards[(evaluation.frame["agent"] == agent).to_numpy()]
        (line,) = named(figure, rf"{agent}\|mujoco\|P0@100")
        points = [(at - 100, mine[:, at : at + 3].mean()) for at in range(1, 120, 3)]
        np.testing.assert_allclose(line.get_xydata(), points)
        assert len(named(figure, rf"band {agent}\|.*")) == 1
    assert_readable(figure)
    with pytest.raises(UnknownOption, match="steps=True"):
        recovery_figure(evaluation)


# --- files ------------------------------------------------------------------------------------


def test_every_figure_that_has_numbers_is_written(tmp_path: Path) -> None:
    """One episode in two protocols has bars only; nothing of an earlier evaluation stays."""
    many = write_figures(made(2, 4, runs=2), tmp_path, reference="sac")
    assert [path.stem for path in many] == ["bars", "radar", "profile", "strength", "regret"]
    few = write_figures(made(1, 2, n=1), tmp_path)
    assert [path.name for path in few] == ["bars.png"]
    assert [path.name for path in tmp_path.iterdir()] == ["bars.png"]
    with pytest.raises(UnknownOption, match="without episodes"):
        write_figures(Evaluation({"task": "pushing"}, made(1, 2).frame[:0]), tmp_path)
