"""The sheet of all pictures."""

from __future__ import annotations

from pathlib import Path

import pytest
from matplotlib.image import imread

from scm_world.errors import UnwritableFolder
from scm_world.runs.canvas import HEIGHT, WIDTH, blank, png, save


def test_a_picture_is_written_whole(tmp_path: Path) -> None:
    """With its size in pixels, nothing beside it, and the bytes that ``png`` gives."""
    path = tmp_path / "sheet.png"
    figure = blank()
    save(figure, path)
    assert imread(path).shape[:2] == (HEIGHT, WIDTH)
    assert path.read_bytes() == png(figure)
    assert list(tmp_path.iterdir()) == [path]


def test_a_picture_nowhere_is_an_error_of_ours(tmp_path: Path) -> None:
    """There can be no folder in the place of a file."""
    (tmp_path / "file").touch()
    with pytest.raises(UnwritableFolder, match="file"):
        save(blank(), tmp_path / "file" / "sheet.png")
