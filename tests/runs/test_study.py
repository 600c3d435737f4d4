"""A folder of a long job: the same call goes on with what is missing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from run_samples import Adder

from scm_world.errors import UnreadableFile, UnwritableFolder
from scm_world.runs.files import located
from scm_world.runs.pool import Pool
from scm_world.runs.study import Study, settings_in

CELLS = {f"cells/{number}.json": number for number in range(4)}


def squared(number: int) -> int:
    """Return a square."""
    return number**2


def ended(number: int) -> int:
    """Fail at the third cell."""
    if number == 2:
        raise ZeroDivisionError
    return number**2


def run(folder: Any, make: Any = squared, settings: Any = None, **more: Any) -> dict[str, int]:
    """Do all cells in this process."""
    settings = {"power": 2} if settings is None else settings
    with Pool() as pool, Study(folder, "squares", settings) as study:
        found = study.map(
            CELLS, make, read=json.loads, write=lambda x: json.dumps(x).encode(), pool=pool, **more
        )
        return dict(found)


WHOLE = {name: number**2 for name, number in CELLS.items()}


def test_what_is_done_is_read_and_the_rest_is_made(tmp_path: Path) -> None:
    """A job that ended by an error, or was killed while it wrote, goes on with the same result."""
    with pytest.raises(ZeroDivisionError):
        run(tmp_path, ended)
    assert sorted(path.name for path in (tmp_path / "cells").iterdir()) == [
        "0.json", "1.json", "3.json"
    ]  # fmt: skip
    (tmp_path / "cells" / ".2.json.0123.part").write_text("cut")
    again = Adder()
    made: list[int] = []

    def make(number: int) -> int:
        made.append(number)
        again(number)
        return squared(number)

    told: list[tuple[int, int]] = []
    assert run(tmp_path, make, progress=lambda *at: told.append(at)) == WHOLE
    assert made == [2]
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert not list(tmp_path.rglob("*.part"))
    assert settings_in(tmp_path, "squares") == {"power": 2}


def test_nothing_is_kept_without_a_folder() -> None:
    """All cells are made."""
    assert run(None) == run(None) == WHOLE


def test_a_study_may_be_behind_a_url() -> None:
    """And goes on from there."""
    place = "memory://study/squares"
    assert run(place) == WHOLE
    (located(place) / "cells" / "1.json").unlink()
    assert run(place, lambda number: -number) == {**WHOLE, "cells/1.json": -1}


def test_other_settings_are_refused(tmp_path: Path) -> None:
    """The error names what differs; nothing is read or written."""
    run(tmp_path, settings={"power": 2, "fingerprint": {"physics": "a", "policy": "p"}})
    with pytest.raises(
        UnreadableFile,
        match=r"another squares; these differ: power \(2 there, 3 here\), physics; give",
    ):
        run(tmp_path, settings={"power": 3, "fingerprint": {"physics": "b", "policy": "p"}})
    with pytest.raises(UnreadableFile, match=r"'squares', format 2; give .* 'cubes'"):
        settings_in(tmp_path, "cubes")


def test_a_folder_with_something_else_is_refused(tmp_path: Path) -> None:
    """And stays as it is."""
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UnreadableFile, match=r"something else: notes\.txt; give an empty folder"):
        run(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    with pytest.raises(UnwritableFolder):
        run(tmp_path / "notes.txt")


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe"])
def test_a_cut_file_is_named_with_the_remedy(tmp_path: Path, content: bytes) -> None:
    """Of a cell as well as of the settings."""
    run(tmp_path)
    path = tmp_path / "cells" / "1.json"
    path.write_bytes(content)
    with pytest.raises(UnreadableFile, match="delete this file, and it is made again") as caught:
        run(tmp_path)
    assert caught.value.path == str(path)
    path.unlink()
    assert run(tmp_path) == WHOLE
    (tmp_path / "study.json").write_bytes(content)
    with pytest.raises(UnreadableFile, match=r"study\.json"):
        run(tmp_path)


def test_a_study_has_one_writer(tmp_path: Path) -> None:
    """A second one is refused, and then no more."""
    refused = pytest.raises(UnreadableFile, match="another process is writing")
    with Study(tmp_path, "squares", {"power": 2}), refused:
        run(tmp_path)
    assert run(tmp_path) == WHOLE
