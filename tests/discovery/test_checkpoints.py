"""Discovery that is interrupted, or killed, goes on where it was."""

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
from scm_world.cli.app import app
from scm_world.discovery import DiscoveryReport
from scm_world.errors import UnreadableFile

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


def test_going_on_gives_the_same(tmp_path: Path) -> None:
    """Interrupted after one probe state and resumed: nothing in the report differs."""
    path = tmp_path / "probes"
    with World("pushing") as world:
        at_once = discover(world, probes=PROBES, seed=3)
        part = interrupted(world, path, 1)
        assert (part.probes, part.planned) == (1, PROBES)
        assert len(list(path.glob("probe-*.json"))) == 1
    told: list[int] = []
    with World("pushing") as world:
        again = discover(
            world, probes=PROBES, seed=3, checkpoint=path, progress=lambda n, _: told.append(n)
        )
    assert told == [1, 2, 3]
    assert whole(again) == whole(at_once)


@pytest.mark.parametrize("text", ["{", '{"largest": []}'])
def test_damaged_checkpoints_are_refused(text: str, tmp_path: Path) -> None:
    """The error names the file, which stays as it was."""
    with World("pushing", backend="fake") as world:
        interrupted(world, tmp_path / "probes", 1)
        file = tmp_path / "probes" / "probe-0.json"
        file.write_text(text)
        with pytest.raises(UnreadableFile, match=r"probe-0\.json") as caught:
            discover(world, probes=2, seed=3, checkpoint=tmp_path / "probes")
    assert caught.value.path == str(file)
    assert file.read_text() == text


def test_checkpoints_of_others_are_refused(tmp_path: Path) -> None:
    """Another seed or another task does not go on from there."""
    path = tmp_path / "probes"
    with World("pushing", backend="fake") as world:
        interrupted(world, path, 1)
        with pytest.raises(UnreadableFile, match=r"differ: seed \(3 there, 4 here\)"):
            discover(world, probes=2, seed=4, checkpoint=path)
    with (
        World("reaching", backend="fake") as other,
        pytest.raises(UnreadableFile, match="differ"),
    ):
        discover(other, probes=2, seed=3, checkpoint=path)


def test_a_killed_command_goes_on(tmp_path: Path) -> None:
    """``kill -9`` loses at most the probe state in work."""
    words = ["discover", "pushing", "--backend", "fake", "--probes", "3", "--out"]
    out = tmp_path / "out"
    command = [sys.executable, "-m", "scm_world", *words, str(out)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)  # noqa: S603 # ours
    deadline = time.monotonic() + 120.0
    first = out / "probes" / "probe-0.json"
    while not first.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert first.exists()
    for folder in (out, tmp_path / "plain"):
        assert CliRunner().invoke(app, [*words, str(folder)]).exit_code == 0
    reports = [json.loads((tmp_path / f / "report.json").read_text()) for f in ("out", "plain")]
    for report in reports:
        del report["seconds"]
    assert reports[0] == reports[1]
