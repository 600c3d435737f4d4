"""Videos of the best, the median and the worst episode, played again to the same bits."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, final

import numpy as np

from scm_world.env import ScmWorldEnv
from scm_world.errors import SnapshotMismatch, UnknownOption, UnwritableFolder
from scm_world.evaluation.outputs.captions import Caption, Frame
from scm_world.evaluation.outputs.looks import metric_words, protocol_words
from scm_world.evaluation.pipeline import Bench
from scm_world.evaluation.results import DRAWN, KEYS, Evaluation
from scm_world.evaluation.setups import Setup
from scm_world.graph.exchange.libraries import load
from scm_world.output.durable import write_durably
from scm_world.output.locations import Location, located
from scm_world.queries.progress import Progress
from scm_world.scene.camera import OVERVIEW, Camera

WHICH = ("best", "median", "worst")
FASTEST = 25.0  # frames per second


def record_videos(
    given: Setup | Bench,
    evaluation: Evaluation,
    folder: Location | str,
    *,
    agent: str | None = None,
    engine: str | None = None,
    metric: str | None = None,
    which: Sequence[str] = WHICH,
    camera: Camera = OVERVIEW,
    progress: Progress | None = None,
) -> list[Location]:
    """Record the best, the median and the worst episode of an agent on an engine.

    They are chosen over all runs and protocols; among equal scores the return decides, and then
    which was played first. An episode that was chosen twice is recorded once. The videos run in
    real time, with at most 25 frames per second.

    Args:
        given: What was evaluated; ``again.bench_of`` makes it from an evaluation.
        evaluation: What came out.
        folder: Where the videos are put, under names such as ``worst-P6-episode17.mp4``; run and
            seed stand in them if there are several, agent and engine as well.
        agent: Who acts; need not be named if there is only one.
        engine: Where; need not be named if there is only one.
        metric: By which episodes are chosen; one of ``METRICS``.
        which: Of best, median and worst.
        camera: Where from.
        progress: Told how many control steps are played.

    Returns:
        The files, in the order of ``which``. Each is whole or absent.

    Raises:
        MissingExtra: moviepy is not installed.
        SnapshotMismatch: An episode did not happen as it did in the evaluation.
        UnknownOption: There is no such agent, engine, metric or choice.
        UnwritableFolder: There is no room, or no permission.
    """
    metric = evaluation.metric(metric)
    writer = load("moviepy.video.io.ffmpeg_writer", "moviepy", "video").FFMPEG_VideoWriter
    chosen = choose(evaluation, agent=agent, engine=engine, metric=metric, which=which)
    total = sum(int(evaluation.columns["steps"][place]) for place in chosen.values())
    made, done = [], 0
    with _benched(given) as bench, TemporaryDirectory(prefix="videos-") as drafts:
        for word, place in chosen.items():
            name = _name(evaluation, place, word)
            film = Film(
                writer, Path(drafts) / name, camera, _caption(evaluation, place, word, metric)
            )
            film.tell = lambda steps, so_far=done: progress and progress(so_far + steps, total)
            _play(bench, evaluation, place, film)
            made.append(_keep(located(folder) / name, film.path))
            done += int(evaluation.columns["steps"][place])
    return made


def choose(
    evaluation: Evaluation,
    *,
    agent: str | None = None,
    engine: str | None = None,
    metric: str | None = None,
    which: Sequence[str] = WHICH,
) -> dict[str, int]:
    """Choose episodes of an agent on an engine.

    Returns:
        Places among the rows of the evaluation, each once.

    Raises:
        UnknownOption: There is no such agent, engine, metric or choice.
    """
    metric = evaluation.metric(metric)
    agent, engine = evaluation.the("agent", agent), evaluation.the("engine", engine)
    columns = evaluation.columns
    mine = np.flatnonzero((columns["agent"] == agent) & (columns["engine"] == engine))
    if not len(mine):
        raise UnknownOption("engine", engine, evaluation.only(agent=agent).engines)
    order = mine[np.lexsort([-mine, columns["return"][mine], columns[metric][mine]])]
    places = {"best": -1, "median": len(order) // 2, "worst": 0}
    found: dict[str, int] = {}
    for word in which:
        if word not in WHICH:
            raise UnknownOption("episode", word, WHICH)
        place = int(order[places[word]])
        if place not in found.values():
            found[word] = place
    return found


@contextmanager
def _benched(given: Setup | Bench) -> Iterator[Bench]:
    """Give a bench; one that was made here is closed here."""
    if isinstance(given, Bench):
        yield given
        return
    bench = Bench(given)
    try:
        yield bench
    finally:
        bench.close()


def _play(bench: Bench, evaluation: Evaluation, place: int, film: Film) -> None:
    """Play an episode again and film it.

    Raises:
        SnapshotMismatch: Something else happened, or it is none of the bench.
    """
    row = {name: evaluation.columns[name][place].item() for name in (*KEYS, "hash")}
    where = ", ".join(f"{key} {row[key]}" for key in KEYS)
    shard = bench.setup.shard_of(row)
    with film:
        again = bench.play(shard, shard.first, watch=film)
    if again.hash != row["hash"]:
        raise SnapshotMismatch(
            f"{where}: played again, something else happened; give the policies and the versions "
            "with which the evaluation was made"
        )


def _keep(path: Location, draft: Path) -> Location:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        data = draft.read_bytes()
    except OSError as error:
        raise UnwritableFolder(str(path.parent), error.strerror or str(error)) from None
    write_durably(path, data)
    return path


@final
@dataclass
class Film:
    """Writes frames of an episode; it is called at every instant.

    Attributes:
        writer: What moviepy writes videos with.
        path: Of the draft.
        camera: Where from.
        caption: Below the frames.
        tell: Told how many control steps are over.
    """

    writer: Any
    path: Path
    camera: Camera
    caption: Caption
    tell: Any = None
    _stream: Any = field(default=None, init=False)
    _every: int = field(default=1, init=False)
    _last: Frame | None = field(default=None, init=False)

    def __call__(self, env: ScmWorldEnv) -> None:
        """Write a frame, if it is time for one."""
        step, period = env.world.index, env.world.control_period
        if self._stream is None:
            self._every = math.ceil(round(1.0 / (FASTEST * period), 9))
        if step % self._every == 0:
            self._write(self._frame(env, step * period), 1.0 / (self._every * period))
        if self.tell is not None and step:
            self.tell(step)

    def _frame(self, env: ScmWorldEnv, time: float) -> Frame:
        from scm_world.backends.renderer import render

        return self.caption.below(render(env.world.scene(), self.camera).rgb, f"{time:.2f} s")

    def _write(self, frame: Frame, rate: float) -> None:
        if self._stream is None:
            size = (frame.shape[1], frame.shape[0])
            self._stream = self.writer(str(self.path), size, rate, codec="libx264")
        self._stream.write_frame(frame)

    def __enter__(self) -> Film:
        return self

    def __exit__(self, *_: object) -> None:
        if self._stream is not None:
            self._stream.close()


# --- words ------------------------------------------------------------------------------------


def _name(evaluation: Evaluation, place: int, word: str) -> str:
    """Name a video; what is the same in all episodes is not in it."""
    row = {key: evaluation.columns[key][place].item() for key in KEYS}
    several = {key: len(set(evaluation.columns[key].tolist())) > 1 for key in KEYS}
    parts = [word]
    parts += [str(row[key]) for key in ("agent", "engine") if several[key]]
    parts += [f"run{row['run']}"] if several["run"] else []
    parts += [row["protocol"]]
    parts += [f"seed{row['seed']}"] if several["seed"] else []
    parts += [f"episode{row['episode']}"]
    return "-".join(re.sub(r"[^\w@.+]+", "_", part) for part in parts) + ".mp4"


def _caption(evaluation: Evaluation, place: int, word: str, metric: str) -> Caption:
    columns = evaluation.columns
    row = {key: columns[key][place].item() for key in KEYS}
    words = protocol_words(evaluation)[row["protocol"]]
    what = f"{row['protocol']}: {words}" if words else row["protocol"]
    heads = [
        f"{what}, episode {row['episode']}, seed {row['seed']}",
        f"{row['agent']}, run {row['run']}, on {row['engine']}",
        f"{word}: {metric_words(metric)} {columns[metric][place]:.3f}, "
        f"return {columns['return'][place]:.2f}",
    ]
    return Caption(heads, _values(evaluation, place))


def _values(evaluation: Evaluation, place: int) -> dict[str, str]:
    """List the values that were drawn in an episode."""
    found: dict[str, list[str]] = {}
    for name, column in evaluation.columns.items():
        if name.startswith(DRAWN) and not math.isnan(column[place]):
            variable = name.removeprefix(DRAWN).partition("[")[0]
            found.setdefault(variable, []).append(f"{column[place]:.4g}")
    return {
        name: parts[0] if len(parts) == 1 else f"({', '.join(parts)})"
        for name, parts in found.items()
    }
