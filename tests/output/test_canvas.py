"""The sheet of all pictures."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from matplotlib.image import imread

from scm_world.errors import UnwritableFolder
from scm_world.output.canvas import HEIGHT, PALETTE, WIDTH, blank, png, save, small_png


def test_a_picture_is_written_whole(tmp_path: Path) -> None:
    """With its size in pixels, nothing beside it, and the bytes that ``png`` gives."""
    path = tmp_path / "sheet.png"
    figure = blank()
    save(figure, path)
    assert imread(path).shape[:2] == (HEIGHT, WIDTH)
    assert path.read_bytes() == png(figure)
    assert list(tmp_path.iterdir()) == [path]


def test_a_picture_nowhere_is_an_error_of_ours(tmp_path: Path) -> None:
    """The folder has to be there."""
    with pytest.raises(UnwritableFolder, match=r"sheet\.png"):
        save(blank(), tmp_path / "none" / "sheet.png")


def test_a_picture_in_a_page_is_small() -> None:
    """It shows the same within what 64 colors can, in fewer bytes."""
    figure = blank()
    axes = figure.add_subplot()
    for number, color in enumerate(PALETTE):
        axes.plot([0, 1], [number, number + 1], color=color)
    large, small = png(figure), small_png(figure)
    seen = [imread(io.BytesIO(data))[..., :3] for data in (large, small)]
    assert len(small) < 0.7 * len(large)
    assert abs(seen[0] - seen[1]).max() < 0.2
