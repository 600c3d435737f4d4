"""What a training leaves on disk: whole or absent, and readable without running code."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world.errors import UnreadableFile, UnwritableFolder
from scm_world.output import durable
from scm_world.training import checkpoints as module
from scm_world.training.checkpoints import (
    Checkpoint,
    checkpoints,
    read_checkpoint,
    write_checkpoint,
)
from scm_world.training.curves import COLUMNS, Curve, read_curve
from scm_world.training.recipe import recipe
from scm_world.training.runs import Run


def instant(steps: int) -> Checkpoint:
    """Make a checkpoint of every type of array."""
    arrays = {
        "floats": np.linspace(0, 1, 7, dtype=np.float32),
        "turned": np.arange(6.0).reshape(2, 3).T,
        "words": np.array([1, 2**63], np.uint64),
        "none": np.zeros((0, 4, 9), np.float32),
    }
    return Checkpoint(steps, arrays, {"rate": 0.1 + 0.2, "large": 2**127})


def test_a_checkpoint_is_read_as_it_was_written(tmp_path: Path) -> None:
    """Every bit; and the last two are kept."""
    for steps in (8, 16, 128):
        path = write_checkpoint(tmp_path, instant(steps))
    assert [one.name for one in checkpoints(tmp_path)] == ["16", "128"]
    found, wanted = read_checkpoint(path), instant(128)
    assert (found.steps, dict(found.state)) == (128, dict(wanted.state))
    for name, array in wanted.tensors.items():
        np.testing.assert_array_equal(found.tensors[name], array)
        assert found.tensors[name].dtype == array.dtype


def test_damage_is_found(tmp_path: Path) -> None:
    """A cut file, another byte, another format, or nothing at all."""
    for name, change in (
        ("tensors.safetensors", lambda data: data[:-5]),
        ("tensors.safetensors", lambda data: data[:-5] + b"wrong"),
        ("state.json", lambda data: data[:-5]),
        ("state.json", lambda data: data.replace(b"checkpoint/2", b"checkpoint/9")),
        ("state.json", lambda data: data.replace(b"0.3", b"0.4")),
        ("state.json", lambda _: b"[]"),
    ):
        path = write_checkpoint(tmp_path, instant(8))
        (path / name).write_bytes(change((path / name).read_bytes()))
        with pytest.raises(UnreadableFile, match="remove this folder"):
            read_checkpoint(path)
    with pytest.raises(UnreadableFile, match="9"):
        read_checkpoint(tmp_path / "9")


@pytest.mark.parametrize("fatal", [1, 2, 3])
def test_a_full_disk_leaves_the_last_checkpoint_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fatal: int
) -> None:
    """Whichever write fails, the error says so, and nothing half is left."""
    write_checkpoint(tmp_path, instant(8))
    calls = 0

    def fail(*given: Any) -> None:
        nonlocal calls
        calls += 1
        if calls == fatal:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(durable.os, "fsync", fail)
    monkeypatch.setattr(module, "synced", fail)
    with pytest.raises(UnwritableFolder, match="No space left"):
        write_checkpoint(tmp_path, instant(16))
    monkeypatch.undo()
    assert [one.name for one in checkpoints(tmp_path)] == ["8"]
    assert read_checkpoint(checkpoints(tmp_path)[-1]).steps == 8
    assert not [*tmp_path.glob(".*")]


def test_what_a_crash_left_half_is_removed(tmp_path: Path) -> None:
    """With the next checkpoint, whichever it is."""
    (tmp_path / ".8.part").mkdir()
    (tmp_path / ".8.part" / "tensors.safetensors").write_bytes(b"half")
    write_checkpoint(tmp_path, instant(16))
    assert [path.name for path in tmp_path.iterdir()] == ["16"]


def test_a_curve_goes_on_where_a_checkpoint_was(tmp_path: Path) -> None:
    """Later rows and a last line that is not whole are forgotten."""
    path = tmp_path / "progress.csv"
    curve = Curve(path)
    for steps in (64, 128, 192):
        curve.add({"steps": steps, "kl": 0.1 / steps})
    with path.open("a") as file:
        file.write("256,1.0,")
    assert [row["steps"] for row in read_curve(path)] == [64, 128, 192]
    again = Curve(path, steps=128)
    again.add({"steps": 192, "return": -1.5})
    rows = read_curve(path)
    assert [row["steps"] for row in rows] == [64, 128, 192]
    assert rows[1]["kl"] == pytest.approx(0.1 / 128)
    assert np.isnan(rows[1]["return"])
    assert rows[2]["return"] == -1.5


def test_what_is_no_curve_is_refused(tmp_path: Path) -> None:
    """Missing, another table, or words in place of numbers."""
    path = tmp_path / "progress.csv"
    for text in (None, "a,b\n1,2\n", ",".join(COLUMNS) + "\n" + "x," * 9 + "\n"):
        if text is not None:
            path.write_text(text)
        with pytest.raises(UnreadableFile, match=r"progress\.csv"):
            read_curve(path)


def test_a_folder_holds_one_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another recipe, seed, engine or start is refused, and it is said what is different."""
    monkeypatch.setattr("scm_world.training.runs.LIBRARIES", ())
    folder, made = tmp_path / "run", recipe("pushing")
    assert not Run(folder, made, 0, "fake").open("fake 1")
    assert not Run(folder, made, 0, "fake").open("fake 1")
    for other, said in (
        (Run(folder, made.but(**{"rate.initial": 0.25}), 0, "fake"), "rate.initial is .* 0.25 was"),
        (Run(folder, made, 1, "fake"), "seed is 0 there, and 1 was"),
        (Run(folder, made, 0, "mujoco"), "'fake' there, and 'mujoco'"),
        (Run(folder, recipe("picking"), 0, "fake"), "'pushing' there, and 'picking'"),
    ):
        with pytest.raises(UnreadableFile, match=said):
            other.open("fake 1")
    with pytest.raises(UnreadableFile, match="nothing"):
        Run(folder, made, 0, "fake", start=tmp_path / "nothing").open("fake 1")


def test_a_crash_at_the_very_beginning_leaves_no_stranger(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The draft of the first file is nobody else's work."""
    monkeypatch.setattr("scm_world.training.runs.LIBRARIES", ())
    (tmp_path / ".run.json.part").write_text("{")
    assert not Run(tmp_path, recipe("pushing"), 0, "fake").open("fake 1")


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    """And so is one whose description is damaged."""
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(UnreadableFile, match="thesis"):
        Run(tmp_path, recipe("pushing"), 0, "fake").open("")
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(UnreadableFile, match=r"run\.json"):
        Run(tmp_path, recipe("pushing"), 0, "fake").open("")
