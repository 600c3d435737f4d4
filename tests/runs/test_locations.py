"""Files in folders of this machine and in stores: the same names, the same promises."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path
from typing import Any

import pytest
from stores import MemoryFileSystem, fresh, refuse

from scm_world.errors import MissingExtra, UnknownOption, UnwritableFolder
from scm_world.runs.files import Location, located, write_whole


@pytest.fixture(params=("path", "memory"))
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Location:
    """A folder of each kind."""
    return tmp_path if request.param == "path" else fresh()


def test_files_are_alike_everywhere(folder: Location) -> None:
    """What is written is read and listed; what is removed is gone."""
    file = folder / "cells" / "a-1.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    write_whole(file, "é\n")
    write_whole(folder / "cells/b.csv", "1\n")
    write_whole(folder / "top.json", "2\n")
    assert (file.name, file.suffix, file.parent.name) == ("a-1.json", ".json", "cells")
    assert (file.read_text(encoding="utf-8"), file.read_bytes()) == ("é\n", b"\xc3\xa9\n")
    assert sorted(one.name for one in folder.iterdir()) == ["cells", "top.json"]
    assert list(folder.glob("cells/*.json")) == [file] == list(folder.glob("*/a-*"))
    assert (folder.is_dir(), file.exists(), file.is_dir()) == (True, True, False)
    file.unlink()
    file.unlink(missing_ok=True)
    assert not file.exists()
    assert [one.name for one in (folder / "cells").iterdir()] == ["b.csv"]


def test_what_is_not_there(folder: Location) -> None:
    """It is no folder and no file, holds nothing, and reading or removing it says so."""
    none = folder / "none"
    assert (none.exists(), none.is_dir(), list(none.glob("*"))) == (False, False, [])
    with pytest.raises(FileNotFoundError):
        none.read_bytes()
    with pytest.raises(FileNotFoundError):
        none.unlink()


def test_names_are_kept() -> None:
    """Slashes at the end are none of a name; equal URLs are equal, also in other processes."""
    place = located("memory://bucket/run/")
    assert str(place / "a" / "b.tar.gz") == "memory://bucket/run/a/b.tar.gz"
    assert str((place / "x.json").with_name("y")) == "memory://bucket/run/y"
    assert pickle.loads(pickle.dumps(place)) == place == located("memory://bucket/run")  # noqa: S301
    assert len({place, located(place), located("memory://bucket/other")}) == 2


@pytest.mark.parametrize("given", ["file://", "local://", "file://localhost"])
def test_urls_of_this_machine_are_paths(given: str, tmp_path: Path) -> None:
    """They are written as durably as any path, and escapes in them are read."""
    assert located(f"{given}{tmp_path}/a%20b") == tmp_path / "a b"
    with pytest.raises(UnknownOption, match="three slashes"):
        located("file://run")


def test_no_permission_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error names the folder and the file."""
    monkeypatch.setattr(MemoryFileSystem, "pipe_file", refuse)
    monkeypatch.setattr(MemoryFileSystem, "_open", refuse)
    with pytest.raises(UnwritableFolder, match=r"memory://.*a\.json: Access Denied"):
        write_whole(fresh() / "a.json", "")


def test_others_are_seen_at_once() -> None:
    """What another one has written is listed, though the folder was listed before."""
    folder = fresh()
    assert not folder.exists()
    write_whole(located(str(folder)) / "new", "")
    assert [one.name for one in folder.iterdir()] == ["new"]


# --- refused --------------------------------------------------------------------------------------


def test_unknown_protocols_are_refused() -> None:
    """The error lists some that are known."""
    with pytest.raises(UnknownOption, match=r"cannot be 's4'; it can be: .*gs.* s3"):
        located("s4://bucket/run")


def test_a_url_has_a_protocol() -> None:
    """Without one, fsspec would take it for a path."""
    with pytest.raises(UnknownOption, match="s3://bucket/run"):
        located("://run")


def test_a_missing_package_is_named() -> None:
    """With the command that installs it, as fsspec names it."""
    fsspec: Any = pytest.importorskip("fsspec")
    advice = "Install nowhere-fs to get there"
    fsspec.register_implementation("nowhere", "no_such_package.Files", True, advice)
    with pytest.raises(MissingExtra, match="'nowhere-fs'; install it with: pip install nowhere-fs"):
        located("nowhere://run")


def test_upath_is_optional(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without it paths work, and URLs name the extra."""
    monkeypatch.setitem(sys.modules, "upath", None)
    assert located("run") == Path("run")
    with pytest.raises(MissingExtra, match=r"universal_pathlib.*scm-world\[cloud\]"):
        located("memory://run")


def test_passwords_are_refused_and_not_repeated() -> None:
    """A URL is written into messages and results."""
    with pytest.raises(UnknownOption, match="without a password") as caught:
        located("sftp://me:secret@host/run")
    assert "secret" not in str(caught.value)


def test_a_url_that_was_made_a_path_is_refused() -> None:
    """A slash is missing by then; results would be in a folder named 's3:'."""
    with pytest.raises(UnknownOption, match="URL as a text"):
        located(Path("s3://bucket/run"))
