"""Videos of episodes: the right ones, played again, with what happened written below."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from output_samples import made

from scm_world.errors import MissingExtra, SnapshotMismatch, UnknownOption, UnwritableFolder
from scm_world.evaluation.outputs import record_videos
from scm_world.evaluation.outputs.videos import captioned, choose
from scm_world.evaluation.pipeline import ShardRunner, played
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.setups import Setup, prepare
from scm_world.tasks.trifinger.cameras import OVERVIEW

SMALL = replace(OVERVIEW, width=321, height=120)
STEPS = 7

pytest.importorskip("moviepy")


@pytest.fixture(scope="module")
def setup() -> Setup:
    """Prepare an evaluation in which an action takes a hundredth of a second."""
    env = {"max_episode_length": STEPS, "frame_skip": 3}
    given: dict[str, Any] = {"n": 2, "seeds": 0, "backend": "fake", "env": env, "trusted": None}
    return prepare({"x": "random"}, "P0,P8", task="pushing", **given)


@pytest.fixture(scope="module")
def evaluation(setup: Setup) -> Evaluation:
    """Play it."""
    return Evaluation.of(setup.about(), played(setup))


@pytest.fixture
def shard_runner(setup: Setup) -> Iterator[ShardRunner]:
    """Give where it can be played again."""
    made = ShardRunner(setup)
    yield made
    made.close()


def frames(path: Path) -> tuple[list[Any], float]:
    """Read a video and how many frames a second has."""
    from moviepy import VideoFileClip

    clip = VideoFileClip(str(path))
    found, rate = list(clip.iter_frames()), float(clip.fps)
    process = clip.reader.proc
    clip.close()
    for pipe in (process.stdout, process.stderr):
        pipe.close()  # which moviepy forgets if the process has ended by then
    return found, rate


def test_best_median_and_worst_are_chosen_by_score() -> None:
    """Over all protocols and runs; the return decides among equals, then the order."""
    evaluation = made(2, 4, runs=2)
    chosen = choose(evaluation, agent="sac")
    columns = evaluation.columns
    scores = columns["last_fractional_success"]
    mine = np.sort(scores[columns["agent"] == "sac"])
    assert {word: scores[place] for word, place in chosen.items()} == {
        "best": mine[-1], "median": mine[len(mine) // 2], "worst": mine[0],
    }  # fmt: skip
    assert {columns["agent"][place] for place in chosen.values()} == {"sac"}

    columns["return"][:] = 0.0
    columns["last_fractional_success"][:] = 0.5
    places = choose(evaluation, agent="ppo")
    assert places["best"] == 0
    assert places["worst"] == np.flatnonzero(columns["agent"] == "ppo")[-1]
    columns["return"][5] = 1.0
    assert choose(evaluation, agent="ppo")["best"] == 5


def test_an_episode_is_chosen_once() -> None:
    """Of a single episode there is one video."""
    assert choose(made(1, 1, n=1)) == {"best": 0}


def test_choices_that_do_not_exist_are_refused() -> None:
    """Agents and metrics are named."""
    evaluation = made(2, 1)
    with pytest.raises(UnknownOption, match="ppo"):
        choose(evaluation)
    with pytest.raises(UnknownOption, match="metric"):
        choose(evaluation, agent="ppo", metric="luck")


def test_videos_show_the_episodes(
    shard_runner: ShardRunner, evaluation: Evaluation, tmp_path: Path
) -> None:
    """Each has its frames at 25 a second at most, in real time, with a caption below."""
    told: list[tuple[int, int]] = []
    found = record_videos(
        shard_runner,
        evaluation,
        tmp_path / "new",
        camera=SMALL,
        progress=lambda *at: told.append(at),
    )
    assert sorted(tmp_path.glob("**/*.*")) == sorted(found)
    places = choose(evaluation)
    assert [path.name for path in found] == [
        f"{word}-{evaluation.columns['protocol'][place]}-episode"
        f"{evaluation.columns['episode'][place]}.mp4"
        for word, place in places.items()
    ]
    assert told[-1] == (len(found) * STEPS, len(found) * STEPS)
    assert told == sorted(told)
    pictures, rate = frames(found[0])
    assert rate == pytest.approx(1 / 0.048, abs=0.01)  # every fourth action of 12 ms
    assert len(pictures) == 2  # at steps 0 and 4 of 7
    height, width, _ = pictures[0].shape
    assert width == 322
    assert height > 120 + 40
    assert pictures[0][124:, :300].min() < 100 < 250 < pictures[0][124:, :300].max()


def test_another_episode_is_no_video(
    shard_runner: ShardRunner, evaluation: Evaluation, tmp_path: Path
) -> None:
    """If something else happens when it is played again, nothing is written."""
    columns = dict(evaluation.columns)
    columns["hash"] = np.array(["other"] * len(evaluation))
    with pytest.raises(SnapshotMismatch, match="protocol P"):
        record_videos(shard_runner, Evaluation(evaluation.about, columns), tmp_path, camera=SMALL)
    assert not list(tmp_path.iterdir())


def test_a_shard_runner_of_others_is_refused(shard_runner: ShardRunner, tmp_path: Path) -> None:
    """The agent of the evaluation does not act there."""
    with pytest.raises(SnapshotMismatch, match="no such agent"):
        record_videos(shard_runner, made(1, 1, n=1), tmp_path)


def test_a_folder_that_cannot_be_made_is_said(
    shard_runner: ShardRunner, evaluation: Evaluation, tmp_path: Path
) -> None:
    """A file is in its place."""
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(UnwritableFolder):
        record_videos(shard_runner, evaluation, tmp_path / "file", camera=SMALL)


def test_moviepy_is_optional(
    shard_runner: ShardRunner,
    evaluation: Evaluation,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without it the message says what to install, before anything is played."""
    monkeypatch.setitem(sys.modules, "moviepy.video.io.ffmpeg_writer", None)
    with pytest.raises(MissingExtra, match=r"scm-world\[video\]"):
        record_videos(shard_runner, evaluation, tmp_path)


def test_captions_are_cut_where_they_do_not_fit() -> None:
    """Lines that are too long end with dots; of the values seven lines are shown."""
    frame = np.zeros((20, 641, 3), dtype=np.uint8)
    drawn = ", ".join(f"robot_finger_60.link_{k}.mass 0.{k}" for k in range(400))
    full = captioned(frame, ["P8: everything", "x " * 300], drawn, "0.00 s")
    assert full.shape == (20 + 2 * 8 + 9 * 18, 642, 3)
    assert captioned(frame, ["P0"], "", "0.00 s").shape == (20 + 2 * 8 + 18, 642, 3)
    assert full[20:, :641].min() < 100 < 250 < full[20:, :641].max()
