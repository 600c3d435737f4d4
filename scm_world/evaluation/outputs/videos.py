"""Videos of the best, the median and the worst episode, played again to the same bits."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import load
from scm_world.env import ScmWorldEnv
from scm_world.errors import SnapshotMismatch
from scm_world.evaluation.outputs.comparisons import metric_words, protocol_words
from scm_world.evaluation.pipeline import ShardRunner
from scm_world.evaluation.results import KEYS, Evaluation
from scm_world.models.camera import Camera
from scm_world.output.durable import made, write_durably
from scm_world.output.remote import Location, located
from scm_world.queries.progress import Progress

FASTEST = 25.0  # frames per second
INK, PAPER = (34, 34, 34), (255, 255, 255)
SIZE, LINE, EDGE = 13, 18, 8  # [pixels]: letters, from a line to the next, room around
MOST = 7  # lines of drawn values


def record_videos(
    shard_runner: ShardRunner,
    evaluation: Evaluation,
    folder: Location | str,
    *,
    agent: str | None = None,
    engine: str | None = None,
    metric: str | None = None,
    camera: Camera | None = None,
    progress: Progress | None = None,
) -> list[Location]:
    """Record the best, the median and the worst episode of an agent on an engine.

    They are chosen over all runs and protocols; among equal scores the return decides, and then
    which was played first. An episode that was chosen twice is recorded once. The videos run in
    real time, with at most 25 frames per second; the drawn values are below the picture.

    Args:
        shard_runner: Of the evaluation; see ``checking.shard_runner_of``.
        evaluation: Its results.
        folder: Where the videos are put, under names such as ``worst-P6-episode17.mp4``, with run,
            seed, agent and backend if there are several.
        agent: Who acts; need not be named if there is only one.
        engine: Where; need not be named if there is only one.
        metric: By which episodes are chosen; one of ``METRICS``.
        camera: Where from; if None, that of pictures for people.
        progress: Called with how many control steps are played.

    Returns:
        The files. Each is whole or absent.

    Raises:
        MissingExtra: moviepy is not installed.
        SnapshotMismatch: The rerun of an episode differs from the evaluation.
        UnknownOption: There is no such agent, backend or metric.
        UnwritableFolder: There is no room, or no permission.
    """
    metric = evaluation.metric(metric)
    writer = load("moviepy.video.io.ffmpeg_writer", "moviepy", "video").FFMPEG_VideoWriter
    columns = evaluation.columns
    several = {key: len(set(columns[key].tolist())) > 1 for key in KEYS}
    chosen = choose(evaluation, agent=agent, engine=engine, metric=metric)
    total, done = sum(int(columns["steps"][place]) for place in chosen.values()), 0
    files = []
    for word, place in chosen.items():
        row = {name: columns[name][place].item() for name in (*KEYS, "hash")}
        varied = protocol_words(evaluation)[row["protocol"]]
        heads = [
            f"{row['protocol']}: {varied}" if varied else row["protocol"],
            f"episode {row['episode']}, seed {row['seed']}; {row['agent']}, run {row['run']}, "
            f"on {row['engine']}",
            f"{word}: {metric_words(metric)} {columns[metric][place]:.3f}, "
            f"return {columns['return'][place]:.2f}",
        ]
        values = ((name, drawn[place]) for name, drawn in evaluation.drawn().items())
        texts = ", ".join(
            f"{name} {' '.join(f'{number:.4g}' for number in value)}"
            for name, value in values
            if not np.isnan(value).any()
        )
        names = [word, *(str(row[key]) for key in ("agent", "engine") if several[key])]
        names += [f"run{row['run']}"] if several["run"] else []
        names += [row["protocol"], *([f"seed{row['seed']}"] if several["seed"] else [])]
        names += [f"episode{row['episode']}"]
        name = "-".join(re.sub(r"[^\w@.+]+", "_", part) for part in names) + ".mp4"
        with TemporaryDirectory(prefix="videos-") as drafts:
            draft = Path(drafts) / name
            tell = None if progress is None else lambda step, at=done: progress(at + step, total)
            captions = partial(captioned, heads=heads, more=texts)
            hash_ = _film(shard_runner, row, partial(writer, str(draft)), captions, camera, tell)
            if hash_ != row["hash"]:
                where = ", ".join(f"{key} {row[key]}" for key in KEYS)
                raise SnapshotMismatch(
                    f"{where}: played again, something else happened; give the policies and the "
                    "versions with which the evaluation was made"
                )
            files.append(made(located(folder)) / name)
            write_durably(files[-1], draft.read_bytes())
        done += int(columns["steps"][place])
    return files


def _film(
    shard_runner: ShardRunner,
    row: Mapping[str, Any],
    opened: Callable[..., Any],
    captions: Callable[..., Any],
    camera: Camera | None,
    tell: Callable[[int], None] | None,
) -> str:
    """Play an episode again, and write its frames; return its hash."""
    from scm_world.backends.renderer import render, scene_camera

    shard, video = shard_runner.setup.shard_of(row), list[Any]()

    def watch(env: ScmWorldEnv) -> None:
        step, period = env.world.index, env.world.options.control_period
        every = math.ceil(round(1.0 / (FASTEST * period), 9))
        if step % every == 0:
            scene = env.world.scene()
            shown = render(scene, camera or scene_camera(scene)).rgb
            frame = captions(shown, time=f"{step * period:.2f} s")
            if not video:
                video.append(opened(frame.shape[1::-1], 1.0 / (every * period), "libx264"))
            video[0].write_frame(frame)
        if tell is not None and step:
            tell(step)

    try:
        return shard_runner.play(shard, shard.first, watch=watch).hash
    finally:
        for one in video:
            one.close()


def choose(
    evaluation: Evaluation,
    *,
    agent: str | None = None,
    engine: str | None = None,
    metric: str | None = None,
) -> dict[str, int]:
    """Return places of episodes among the rows of the evaluation, each once; see ``record_videos``.

    Raises:
        UnknownOption: There is no such agent, backend or metric.
    """
    metric, columns = evaluation.metric(metric), evaluation.columns
    agent, engine = evaluation.the("agent", agent), evaluation.the("engine", engine)
    evaluation.only(agent=agent, engine=engine)  # refuses an agent that was not on this backend
    mine = np.flatnonzero((columns["agent"] == agent) & (columns["engine"] == engine))
    order = mine[np.lexsort([-mine, columns["return"][mine], columns[metric][mine]])]
    found: dict[str, int] = {}
    for word, rank in (("best", -1), ("median", len(order) // 2), ("worst", 0)):
        if int(order[rank]) not in found.values():
            found[word] = int(order[rank])
    return found


def captioned(
    frame: NDArray[np.uint8], heads: Sequence[str], more: str, time: str
) -> NDArray[np.uint8]:
    """Return a frame with a bar of texts below it, of even height and width.

    Args:
        frame: Shape (height, width, 3).
        heads: A line each.
        more: A longer text below them, of which seven lines are shown.
        time: In the upper right corner of the bar.
    """
    import matplotlib
    from PIL import Image, ImageDraw, ImageFont

    face = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSansMono.ttf"
    font = ImageFont.truetype(str(face), SIZE)
    width = frame.shape[1]
    letters = max(8, int((width - 2 * EDGE) / font.getlength("m")))
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
