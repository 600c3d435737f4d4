"""Files that are whole or absent, and folders with one writer."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from scm_world.errors import UnreadableFile, UnwritableFolder
from scm_world.output import durable
from scm_world.output.durable import locked, write_durably, write_whole


def test_a_folder_has_one_writer(tmp_path: Path) -> None:
    """While it is locked a second one is refused, and then no more."""
    with (
        locked(tmp_path / "new"),
        pytest.raises(UnreadableFile, match="another process"),
        locked(tmp_path / "new"),
    ):
        pass
    with locked(tmp_path / "new"):
        assert (tmp_path / "new").is_dir()


def test_a_disk_that_fails_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The old file is whole, nothing lies beside it, and the error names folder and file."""
    path = tmp_path / "notes.txt"
    write_whole("first\n", path)

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left")

    monkeypatch.setattr(durable.os, "fsync", full)
    with pytest.raises(UnwritableFolder, match=r"notes\.txt: No space left") as caught:
        write_whole("second\n", path)
    assert caught.value.path == str(tmp_path)
    assert path.read_text() == "first\n"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    """It is not made."""
    with pytest.raises(UnwritableFolder, match="No such file"):
        write_durably(tmp_path / "none" / "file", b"")
    assert not (tmp_path / "none").exists()


def test_every_text_can_be_written(tmp_path: Path) -> None:
    """Also one with half a letter."""
    write_whole("a\ud800→\n", tmp_path / "text")
    assert (tmp_path / "text").read_bytes() == "a\\ud800→\n".encode()
