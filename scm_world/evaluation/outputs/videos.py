"""Videos of the best, the median and the worst episode, played again to the same bits."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import load
from scm_world.env import ScmWorldEnv
from scm_world.errors import SnapshotMismatch, UnknownOption, UnwritableFolder
from scm_world.evaluation.outputs.labels import metric_words, protocol_words
from scm_world.evaluation.pipeline import ShardRunner
from scm_world.evaluation.results import DRAWN, KEYS, Evaluation
from scm_world.evaluation.setups import Setup
from scm_world.models.camera import Camera
from scm_world.output.durable import write_durably
from scm_world.output.locations import Location, located
from scm_world.queries.progress import Progress

WHICH = ("best", "median", "worst")
FASTEST = 25.0  # frames per second
INK, PAPER = (34, 34, 34), (255, 255, 255)
SIZE, LINE, EDGE = 13, 18, 8  # [pixels]: letters, from a line to the next, room around
MOST = 7  # lines of drawn values


def record_videos(
    given: Setup | ShardRunner,
    evaluation: Evaluation,
    folder: Location | str,
    *,
    agent: str | None = None,
    engine: str | None = None,
    metric: str | None = None,
    which: Sequence[str] = WHICH,
    camera: Camera | None = None,
    progress: Progress | None = None,
) -> list[Location]:
    """Record the best, the median and the worst episode of an agent on an engine.

    They are chosen over all runs and protocols; among equal scores the return decides, and then
    which was played first. An episode that was chosen twice is recorded once. The videos run in
    real time, with at most 25 frames per second; the drawn values are below the picture.

    Args:
        given: What was evaluated; ``checking.shard_runner_of`` makes it from an evaluation.
        evaluation: Its results.
        folder: Where the videos are put, under names such as ``worst-P6-episode17.mp4``, with run,
            seed, agent and engine if there are several.
        agent: Who acts; need not be named if there is only one.
        engine: Where; need not be named if there is only one.
        metric: By which episodes are chosen; one of ``METRICS``.
        which: Of best, median and worst.
        camera: Where from; if None, that of pictures for people.
        progress: Called with how many control steps are played.

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
    steps = {word: int(evaluation.columns["steps"][place]) for word, place in chosen.items()}
    files, done, total = [], 0, sum(steps.values())
    with (
        nullcontext(given)
        if isinstance(given, ShardRunner)
        else closing(ShardRunner(given)) as shard_runner,
        TemporaryDirectory(prefix="videos-") as drafts,
    ):
        for word, place in chosen.items():
            draft = Path(drafts) / _name(evaluation, place, word)
            texts = _texts(evaluation, place, word, metric)

            def tell(step: int, before: int = done) -> None:
                if progress is not None and step:
                    progress(before + step, total)

            _film(shard_runner, evaluation, place, partial(writer, str(draft)), camera, texts, tell)
            path = located(folder) / draft.name
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise UnwritableFolder(str(path.parent), error.strerror or str(error)) from None
            write_durably(path, draft.read_bytes())
            files.append(path)
            done += steps[word]
    return files


def choose(
    evaluation: Evaluation,
    *,
    agent: str | None = None,
    engine: str | None = None,
    metric: str | None = None,
    which: Sequence[str] = WHICH,
) -> dict[str, int]:
    """Return places of episodes among the rows of the evaluation, each once; see ``record_videos``.

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


def _film(
    shard_runner: ShardRunner,
    evaluation: Evaluation,
    place: int,
    opened: Callable[..., Any],
    camera: Camera | None,
    texts: tuple[Sequence[str], str],
    tell: Callable[[int], None],
) -> None:
    """Play an episode again and write its frames, or raise ``SnapshotMismatch``."""
    from scm_world.backends.renderer import render, scene_camera

    row = {name: evaluation.columns[name][place].item() for name in (*KEYS, "hash")}
    shard = shard_runner.setup.shard_of(row)
    video: Any = None

    def watch(env: ScmWorldEnv) -> None:
        nonlocal video
        step, period = env.world.index, env.world.control_period
        every = math.ceil(round(1.0 / (FASTEST * period), 9))
        if step % every == 0:
            scene = env.world.scene()
            shown = render(scene, camera or scene_camera(scene)).rgb
            frame = captioned(shown, texts, f"{step * period:.2f} s")
            if video is None:
                video = opened(frame.shape[1::-1], 1.0 / (every * period), "libx264")
            video.write_frame(frame)
        tell(step)

    try:
        again = shard_runner.play(shard, shard.first, watch=watch)
    finally:
        if video is not None:
            video.close()
    if again.hash != row["hash"]:
        where = ", ".join(f"{key} {row[key]}" for key in KEYS)
        raise SnapshotMismatch(
            f"{where}: played again, something else happened; give the policies and the versions "
            "with which the evaluation was made"
        )


def captioned(
    frame: NDArray[np.uint8], texts: tuple[Sequence[str], str], time: str
) -> NDArray[np.uint8]:
    """Return a frame with a bar of texts below it, of even height and width.

    ``texts`` are lines, and a longer text below them, of which seven lines are shown; ``time`` is
    in the upper right corner of the bar.
    """
    import matplotlib
    from PIL import Image, ImageDraw, ImageFont

    face = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSansMono.ttf"
    font = ImageFont.truetype(str(face), SIZE)
    width = frame.shape[1]
    letters = max(8, int((width - 2 * EDGE) / font.getlength("m")))
    heads, more = texts
    lines = [textwrap.shorten(head, letters, placeholder=" …") for head in heads]
    lines += textwrap.wrap(more, letters, max_lines=MOST, placeholder=" …")
    bar = Image.new("RGB", (width, 2 * EDGE + LINE * len(lines)), PAPER)
    pen = ImageDraw.Draw(bar)
    for number, line in enumerate(lines):
        pen.text((EDGE, EDGE + LINE * number), line, fill=INK, font=font)
    pen.text((width - EDGE, EDGE), time, fill=INK, font=font, anchor="ra")
    whole = np.concatenate([frame, np.asarray(bar, dtype=np.uint8)])
    odd = [(0, whole.shape[0] % 2), (0, width % 2), (0, 0)]
    return np.pad(whole, odd, constant_values=255)


def _name(evaluation: Evaluation, place: int, word: str) -> str:
    row = {key: evaluation.columns[key][place].item() for key in KEYS}
    several = {key: len(set(evaluation.columns[key].tolist())) > 1 for key in KEYS}
    parts = [word]
    parts += [str(row[key]) for key in ("agent", "engine") if several[key]]
    parts += [f"run{row['run']}"] if several["run"] else []
    parts += [row["protocol"]]
    parts += [f"seed{row['seed']}"] if several["seed"] else []
    parts += [f"episode{row['episode']}"]
    return "-".join(re.sub(r"[^\w@.+]+", "_", part) for part in parts) + ".mp4"


def _texts(evaluation: Evaluation, place: int, word: str, metric: str) -> tuple[list[str], str]:
    columns = evaluation.columns
    row = {key: columns[key][place].item() for key in KEYS}
    words = protocol_words(evaluation)[row["protocol"]]
    heads = [
        f"{row['protocol']}: {words}" if words else row["protocol"],
        f"episode {row['episode']}, seed {row['seed']}; {row['agent']}, run {row['run']}, "
        f"on {row['engine']}",
        f"{word}: {metric_words(metric)} {columns[metric][place]:.3f}, "
        f"return {columns['return'][place]:.2f}",
    ]
    drawn: dict[str, list[str]] = {}
    for name, column in columns.items():
        if name.startswith(DRAWN) and not math.isnan(column[place]):
            variable = name.removeprefix(DRAWN).partition("[")[0]
            drawn.setdefault(variable, []).append(f"{column[place]:.4g}")
    values = (
        f"{name} {parts[0] if len(parts) == 1 else '(' + ', '.join(parts) + ')'}"
        for name, parts in drawn.items()
    )
    return heads, ", ".join(values)
