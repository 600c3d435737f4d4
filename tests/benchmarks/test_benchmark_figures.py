"""Pictures of the benchmark pages show the recorded figures."""

import re
from pathlib import Path

import pytest

from benchmarks.figures import IMAGES, PICTURES, agents, pairing, read

PAGES = Path(__file__).parents[2] / "docs" / "benchmarks"


def test_every_picture_is_on_a_page() -> None:
    """Pages show all pictures that the script draws, and no other ones."""
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES.glob("*.md"))
    shown = re.findall(r"images/benchmarks/([\w-]+)\.png", text)
    drawn = sorted(path.stem for path in IMAGES.glob("*.png"))
    assert sorted(shown) == sorted(PICTURES) == drawn


def test_bars_are_the_recorded_ratios() -> None:
    """Of both engines, without the mass that does not move a sliding block."""
    table = read("checks.json")["pairing"]
    recorded = [
        float(row[column])
        for column in (table["head"].index("unpaired : paired"), 5)
        for row in table["rows"]
        if row[:2] != ["a sliding block", "tool_block.mass 0.02 → 0.1"]
    ]
    (axis,) = pairing().axes
    assert [bar.get_width() for bar in axis.patches] == pytest.approx(recorded)


def test_dots_are_the_recorded_scores() -> None:
    """The first dots of pushing on MuJoCo are those of P0, seeds 0, 1 and 2."""
    dots = agents().axes[0].collections[1].get_offsets()
    assert dots[:, 1].tolist() == [0.98, 0.97, 0.98]
