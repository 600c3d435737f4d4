"""Discovery that is interrupted, or killed, goes on where it was."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from scm_world import World, discover
from scm_world.cli import app
from scm_world.discovery import DiscoveryReport
from scm_world.errors import UnreadableFile, UnwritableFolder
from scm_world.runs import files
from scm_world.runs.files import write_whole

PROBES = 3


def whole(report: DiscoveryReport) -> dict[str, Any]:
    """Give all of a report but the time it took."""
    return report.model_dump(exclude={"seconds"})


def interrupted(world: World, path: Path, after: int) -> DiscoveryReport:
    """Discover, and press Ctrl-C after some probe states."""

    def progress(done: int, _: int) -> None:
        if done == after:
            raise KeyboardInterrupt

    return discover(world, probes=PROBES, seed=3, progress=progress, checkpoint=path)


@pytest.mark.parametrize(("task", "backend"), [("pushing", "mujoco"), ("reaching", "bullet")])
def test_going_on_gives_the_same(task: str, backend: str, tmp_path: Path) -> None:
    """Interrupted after one probe state and resumed: nothing in the report differs."""
    path = tmp_path / "progress.json"
    with World(task, backend=backend) as world:
        at_once = discover(world, probes=PROBES, seed=3)
        part = interrupted(world, path, 1)
        assert (part.probes, part.planned) == (1, PROBES)
        assert json.loads(path.read_text())["done"] == 1
    told: list[int] = []
    with World(task, backend=backend) as world:
        again = discover(
            world, probes=PROBES, seed=3, checkpoint=path, progress=lambda n, _: told.append(n)
        )
    assert told == [2, 3]
    assert whole(again) == whole(at_once)
    assert not path.exists()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{", "Expecting property name"),
        ('{"format": "something else"}', "expected the format"),
        ('{"format": "scm_world/discovery-progress/4", "terms": {}}', "task"),
    ],
)
def test_damaged_checkpoints_are_refused(text: str, reason: str, tmp_path: Path) -> None:
    """The error names the file; the file stays as it was."""
    path = tmp_path / "progress.json"
    path.write_text(text)
    with (
        World("pushing", backend="fake") as world,
        pytest.raises(UnreadableFile, match=reason) as caught,
    ):
        discover(world, probes=2, checkpoint=path)
    assert caught.value.path == str(path)
    assert path.read_text() == text


def test_checkpoints_of_others_are_refused(tmp_path: Path) -> None:
    """Another seed or another task does not go on from there."""
    path = tmp_path / "progress.json"
    with World("pushing", backend="fake") as world:
        interrupted(world, path, 1)
        with pytest.raises(UnreadableFile, match="seed differ"):
            discover(world, probes=2, seed=4, checkpoint=path)
    with (
        World("reaching", backend="fake") as other,
        pytest.raises(UnreadableFile, match="task differ"),
    ):
        discover(other, probes=2, seed=3, checkpoint=path)


def test_files_are_on_the_disk_before_they_have_their_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the disk fails, the last checkpoint and the last text are as they were."""
    path, text = tmp_path / "progress.json", tmp_path / "study.json"
    write_whole(text, "first\n")

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left")

    with World("pushing", backend="fake") as world:
        interrupted(world, path, 1)
        before = path.read_bytes()
        monkeypatch.setattr(files.os, "fsync", full)
        with pytest.raises(UnwritableFolder, match=r"progress\.json: No space left"):
            discover(world, probes=PROBES, seed=3, checkpoint=path)
    with pytest.raises(UnwritableFolder, match=r"study\.json: No space left"):
        write_whole(text, "second\n")
    assert (path.read_bytes(), text.read_text()) == (before, "first\n")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["progress.json", "study.json"]


def test_a_killed_command_goes_on(tmp_path: Path) -> None:
    """``kill -9`` loses at most the probe state in work."""
    words = ["discover", "pushing", "--backend", "fake", "--probes", "3", "--out"]
    out = tmp_path / "out"
    command = [sys.executable, "-m", "scm_world", *words, str(out)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)  # noqa: S603 # ours
    deadline = time.monotonic() + 120.0
    while not (out / "progress.json").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    done = json.loads((out / "progress.json").read_text())["done"]
    assert 1 <= done < 3
    for folder in (out, tmp_path / "plain"):
        assert CliRunner().invoke(app, [*words, str(folder)]).exit_code == 0
    reports = [json.loads((tmp_path / f / "report.json").read_text()) for f in ("out", "plain")]
    for report in reports:
        del report["seconds"]
    assert reports[0] == reports[1]
    assert not (out / "progress.json").exists()
