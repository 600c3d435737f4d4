"""Facts about results: what the figures mean, and what is kept in files."""

from __future__ import annotations

import errno
import json
from pathlib import Path

import numpy as np
import pandas
import pytest
from evaluation_samples import (
    by_hand,
    contents,
    linear,
    small,
)

from scm_world.errors import (
    UnknownOption,
    UnreadableFile,
    UnwritableFolder,
)
from scm_world.evaluation import METRICS, Evaluation
from scm_world.evaluation.episodes import scored
from scm_world.runs import files

# --- scores ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fractions", "last", "ends", "full"),
    [
        ([0.5], 0.5, 0.5, 0.5),
        ([1.0, 0.0, 0.5], 0.5, 0.5, 0.5),
        ([1.0] + [0.0] * 19, 0.0, 0.05, 0.05),
        ([1.0] + [0.0] * 20, 0.0, 0.0, 1 / 21),
        ([0.0] * 80 + [1.0] * 20, 1.0, 1.0, 0.2),
        ([0.0] * 81 + [1.0] * 19, 1.0, 0.95, 0.19),
    ],
)
def test_d12_the_last_steps_are_the_last_ones(
    fractions: list[float], last: float, ends: float, full: float
) -> None:
    """The mean over the last twenty control steps, or over fewer where there are fewer."""
    found = scored(fractions, success=False, total=0.0)
    assert found["last_fractional_success"] == last
    assert found["last_integrated_fractional_success"] == pytest.approx(ends, abs=1e-15)
    assert found["full_integrated_fractional_success"] == pytest.approx(full, abs=1e-15)


def test_paired_differences_are_surer() -> None:
    """Where episodes decide most, the paired interval is far narrower than two apart."""
    rng = np.random.default_rng(0)
    hard, gain = 0.9 * rng.random(100), 0.04 * rng.random(100)
    rows = by_hand(hard, agent="a") + by_hand(hard + gain, agent="b")
    found = Evaluation({"task": "pushing"}, pandas.DataFrame(rows))
    difference = found.difference("b", "a", "P1")
    assert difference.value == pytest.approx(gain.mean())
    assert difference.width < 0.6 * found.score("P1", agent="a").width
    with pytest.raises(UnknownOption, match="both have played"):
        Evaluation({}, pandas.DataFrame(rows[:-1])).difference("b", "a", "P1")


def test_it_is_printed_as_a_table_of_means() -> None:
    """A row for each protocol and a column for each agent, not all arrays."""
    rows = by_hand([0.25, 0.75], agent="a") + by_hand([1.0, 0.5], agent="b")
    title, _, _, means = str(Evaluation({"task": "reaching"}, pandas.DataFrame(rows))).splitlines()
    assert title == "4 episodes of reaching, mean last fractional success"
    assert means.split() == ["P1", "0.500", "0.750"]


def test_several_runs_of_an_agent_count_once_an_episode() -> None:
    """All of them met the same draws; IQM and the rest are over the runs."""
    found = small({"mine": ["still", "random", "sweep"], "other": linear})
    assert found.runs("mine") == (0, 1, 2)
    assert found.scores(agent="mine").shape == (3, 2, 3)
    assert set(found.overall(agent="mine")) == {
        "mean",
        "median",
        "interquartile_mean",
        "optimality_gap",
    }
    score, episodes = found.score("P6", agent="mine"), found.scores(agent="mine")[:, 1]
    assert (score.n, score.value) == (3, pytest.approx(episodes.mean()))
    assert found.difference("mine", "other", "P0").n == 3


def test_what_is_asked_for_must_exist() -> None:
    """Agents, protocols, metrics, engines and columns, by name."""
    found = small({"a": "still", "b": "random"})
    for ask, said in [
        (lambda: found.score("P0"), "agent"),
        (lambda: found.score("P0", agent="c"), "agent"),
        (lambda: found.score("P7", agent="a"), "protocol"),
        (lambda: found.score("P0", "succes", agent="a"), "did you mean 'success'"),
        (lambda: found.score("P0", agent="a", engine="bullet"), "engine"),
        (lambda: found.only(color="red"), "column"),
        (lambda: found.difference("fake", "bullet", "P0", agent="a"), "engine"),
        (lambda: found.causes("P7", agent="a"), "protocol"),
    ]:
        with pytest.raises(UnknownOption, match=said):
            ask()


# --- files ----------------------------------------------------------------------------------------


def test_files_keep_every_bit(tmp_path: Path) -> None:
    """Of integers, floats, texts and NaN; the summary has every score with its interval."""
    found = small({"a": linear, "b": ["random", "still"]}, "P0,P10")
    summary, table = found.save(tmp_path / "out")
    for path in (tmp_path / "out", summary):
        again = Evaluation.load(path)
        assert again == found
        assert again.about == json.loads(json.dumps(dict(found.about)))
        assert {n: c.dtype.kind for n, c in again.frame.items()} == {
            n: c.dtype.kind for n, c in found.frame.items()
        }
    data = json.loads(summary.read_text())
    scores = [name for name in METRICS if name != "failed"]  # only of worlds that may fail
    assert [*data["scores"][0]] == ["agent", "engine", "protocol", *scores]
    assert len(data["scores"]) == 4
    assert {"python", "scm-world", "numpy", "fake"} <= set(data["about"]["versions"]["fake"])
    assert table.name == "episodes.parquet"


def test_saving_over_results_is_whole_or_absent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that is full leaves no file half-written."""

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(UnwritableFolder, match="No space left"):
        small().save(tmp_path)
    assert contents(tmp_path) == {}


@pytest.mark.parametrize(
    "how", ["no table", "cut", "fewer", "no json", "list", "format", "about", "text"]
)
def test_damaged_results_are_not_read(how: str, tmp_path: Path) -> None:
    """The error names the file and says what to give."""
    summary, table = small().save(tmp_path)
    data = json.loads(summary.read_text())
    match how:
        case "no table":
            table.unlink()
        case "cut":
            table.write_bytes(table.read_bytes()[:-20])
        case "fewer":
            small(n=1).save(tmp_path / "other")
            table.write_bytes((tmp_path / "other" / table.name).read_bytes())
        case "no json":
            summary.write_text("{")
        case "list":
            summary.write_text("[]")
        case "format":
            summary.write_text(json.dumps({**data, "format": "something/1"}))
        case "about":
            summary.write_text(json.dumps({**data, "about": {"task": "pushing"}}))
        case "text":
            table.write_text("agent\nme\n\0\n")
    with pytest.raises(UnreadableFile, match=r"results\.json"):
        Evaluation.load(tmp_path)


def test_what_is_not_there_is_not_read(tmp_path: Path) -> None:
    """Folders without results, and files that do not exist."""
    for path in (tmp_path, tmp_path / "none", tmp_path / "none.json"):
        with pytest.raises(UnreadableFile):
            Evaluation.load(path)
