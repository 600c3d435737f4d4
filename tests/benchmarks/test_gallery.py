"""The moving pictures of the gallery are twins that differ in one cause."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.gallery import BAR, GAP, IMAGES, SIZE, TWINS, filmed, moving

PAGE = Path(__file__).parents[2] / "docs" / "gallery.md"


def test_the_page_shows_every_twin_once() -> None:
    """Each has a file of at most 400 kB, and its command."""
    text = PAGE.read_text(encoding="utf-8")
    shown = re.findall(r"images/gallery/(\w+)\.webp", text)
    commands = re.findall(r"^python -m benchmarks.gallery (\w+)$", text, re.MULTILINE)
    assert shown == commands == [*TWINS]
    assert sorted(path.stem for path in IMAGES.iterdir()) == sorted(TWINS)
    assert max(path.stat().st_size for path in IMAGES.iterdir()) <= 400_000


def test_both_worlds_begin_alike_and_only_the_cause_parts_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With one value of the cause for both, pictures are the same; with two, the last is not."""
    twin = replace(TWINS["cart"], steps=8, every=4)
    one, other = filmed("cart", twin)
    np.testing.assert_array_equal(one[0], other[0])
    assert (one[-1] != other[-1]).any()
    one, other = filmed("cart", replace(twin, values=(1.5, 1.5)))
    np.testing.assert_array_equal(one, other)
    monkeypatch.setitem(TWINS, "cart", twin)
    with Image.open(io.BytesIO(moving("cart"))) as film:
        assert film.size == (2 * SIZE[1] + GAP, SIZE[0] + BAR)
        assert film.n_frames >= 3
