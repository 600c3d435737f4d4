"""The document about the predecessor tells of all its defects, and names tests that exist."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

import pytest
from given import ROOT

TEXT = (ROOT / "docs" / "causal_world.md").read_text()
ROWS = re.findall(r"^\| (D\d\d) \| (.*) \| (.*) \|$", TEXT, re.MULTILINE)
NAMED = re.findall(r"`((?:tests|scm_world)/[\w/]+\.py)::(test_\w+)`", TEXT)
MISSING = "there is no such part", "this package"
PARTS = re.compile("tracker|sim2real|transfer")


def test_every_defect_has_one_row() -> None:
    """The numbers run from 1 to 65, in order, and each has a sentence."""
    assert [number for number, *_ in ROWS] == [f"D{number:02}" for number in range(1, 66)]
    assert all(len(sentence) > 20 for _, sentence, _ in ROWS)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_every_row_has_a_proof_or_says_why_there_is_none(row: Any) -> None:
    """A test of this repository, or that what was defective does not exist here."""
    assert "::test_" in row[2] or row[2].startswith(MISSING)


@cache
def functions(path: str) -> frozenset[str]:
    """Name the functions of a file."""
    return frozenset(re.findall(r"^ *def (\w+)", (ROOT / path).read_text(), re.MULTILINE))


@pytest.mark.parametrize("test", sorted(set(NAMED)), ids="::".join)
def test_every_named_test_exists(test: Any) -> None:
    """The file that is named has a test of that name."""
    path, name = test
    assert name in functions(path)


def test_every_test_of_a_defect_is_named() -> None:
    """A test whose name has the number of a defect stands in the row of that defect."""
    proofs = {number: proof for number, _, proof in ROWS}
    for file in sorted((ROOT / "tests").rglob("test_*.py")):
        path = file.relative_to(ROOT).as_posix()
        for name in sorted(n for n in functions(path) if n.startswith("test_d")):
            numbers = re.findall(r"(?<=_)d(\d\d)(?=_)", name)
            assert numbers or not file.stem.startswith("test_defects")
            assert all(f"`{path}::{name}`" in proofs[f"D{number}"] for number in numbers), name


def test_parts_that_are_said_to_be_missing_are_missing() -> None:
    """When a tracker or a bridge to the real robot comes, its row needs a test."""
    root = ROOT / "scm_world"
    assert [path.name for path in root.rglob("*.py") if PARTS.search(path.stem)] == []
