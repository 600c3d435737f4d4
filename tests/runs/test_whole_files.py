"""Files that are whole or absent, and folders with one writer."""

from __future__ import annotations

import errno
import multiprocessing
from pathlib import Path
from uuid import UUID

import pytest

from scm_world.errors import UnreadableFile, UnwritableFolder
from scm_world.runs import files
from scm_world.runs.files import locked, write_whole


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
    write_whole(path, "first\n")

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(UnwritableFolder, match=r"notes\.txt: No space left") as caught:
        write_whole(path, "second\n")
    assert caught.value.path == str(tmp_path)
    assert path.read_text() == "first\n"
    assert list(tmp_path.iterdir()) == [path]


def test_folders_are_made_where_there_can_be_some(tmp_path: Path) -> None:
    """A file in the place of one is told, and stays."""
    write_whole(tmp_path / "some" / "file", b"1")
    with pytest.raises(UnwritableFolder, match="file"):
        write_whole(tmp_path / "some" / "file" / "below", b"")
    assert (tmp_path / "some" / "file").read_bytes() == b"1"


def test_every_text_can_be_written(tmp_path: Path) -> None:
    """Also one with half a letter."""
    write_whole(tmp_path / "text", "a\ud800→\n")
    assert (tmp_path / "text").read_bytes() == "a\\ud800→\n".encode()


def _write_often(path: Path, letter: str) -> None:
    for _ in range(200):
        write_whole(path, letter.encode() * 100_000)


def test_two_writers_leave_whole_files(tmp_path: Path) -> None:
    """Whoever reads meanwhile finds what one of them wrote, and no write fails."""
    path = tmp_path / "results"
    write_whole(path, b"a" * 100_000)
    context = multiprocessing.get_context("spawn")
    writers = [context.Process(target=_write_often, args=(path, letter)) for letter in "ab"]
    for writer in writers:
        writer.start()
    reads = 0
    while any(writer.is_alive() for writer in writers):
        data = path.read_bytes()
        assert len(data) == 100_000
        assert len(set(data)) == 1
        reads += 1
    assert reads > 10
    assert [writer.exitcode for writer in writers] == [0, 0]
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_in_the_place_of_a_draft_is_not_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it points to stays as it is."""
    name = UUID(int=0)
    victim, draft = tmp_path / "victim", tmp_path / f".file.{name.hex[:16]}.part"
    victim.write_text("mine")
    draft.symlink_to(victim)
    monkeypatch.setattr(files, "uuid4", lambda: name)
    with pytest.raises(UnwritableFolder, match="file"):
        write_whole(tmp_path / "file", b"theirs")
    assert victim.read_text() == "mine"
