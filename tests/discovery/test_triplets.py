"""Pairs of pictures before and after an intervention."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world import World
from scm_world.discovery.data import triplets
from scm_world.errors import UnknownOption, UnknownVariable, UnreadableFile

parquet = pytest.importorskip("pyarrow.parquet")
Image = pytest.importorskip("PIL.Image")

FACTORS = ("tool_block.color", "floor_color", "tool_block.cylindrical_position", "tool_block.size")


def rows(folder: Path) -> list[dict[str, Any]]:
    """Read all pairs."""
    files = sorted(folder.glob("*.parquet"))
    return [row for file in files for row in parquet.read_table(file).to_pylist()]


def pixels(cell: dict[str, Any]) -> Any:
    """Decode a picture."""
    return np.asarray(Image.open(io.BytesIO(cell["bytes"])))


def test_pairs_differ_in_their_targets(tmp_path: Path) -> None:
    """And in what follows from them: a block that grows lies higher."""
    folder = triplets(World("pushing"), FACTORS, 12, tmp_path / "t", shard=5, seed=3)
    found = rows(folder)
    assert [row["pair"] for row in found] == list(range(12))
    assert len({tuple(row["targets"]) for row in found}) > 1
    for row in found:
        (target,) = row["targets"]
        moved = {n for n in FACTORS if row[f"z.{n}"] != row[f"z_counterfactual.{n}"]}
        follows = {"tool_block.cylindrical_position"} if target == "tool_block.size" else set()
        assert target in moved <= {target} | follows
        one, other = pixels(row["image"]), pixels(row["image_counterfactual"])
        assert one.shape == other.shape == (64, 64, 3)
        assert (one != other).any()
    about = json.loads(parquet.read_schema(next(folder.glob("*.parquet"))).metadata[b"huggingface"])
    assert about["info"]["features"]["image"] == {"_type": "Image"}


def test_files_do_not_depend_on_how_they_were_made(tmp_path: Path) -> None:
    """In one go, resumed, or by processes; another call is refused."""
    world, how = World("pushing", backend="fake"), {"shard": 3, "size": (16, 24), "targets": 2}
    whole = triplets(world, FACTORS, 8, tmp_path / "a", **how)
    other = triplets(world, FACTORS, 8, tmp_path / "b", workers=2, **how)
    files = sorted(path.name for path in whole.iterdir())
    assert files == sorted(path.name for path in other.iterdir())
    assert all((whole / n).read_bytes() == (other / n).read_bytes() for n in files)
    first = whole / "triplets-00001-of-00003.parquet"
    kept = first.read_bytes()
    first.unlink()
    told: list[tuple[int, int]] = []
    triplets(world, FACTORS, 8, whole, progress=lambda *both: told.append(both), **how)
    assert (first.read_bytes(), told) == (kept, [(8, 8)])
    assert pixels(rows(whole)[0]["image"]).shape == (16, 24, 3)
    with pytest.raises(UnreadableFile, match="another call"):
        triplets(world, FACTORS, 8, whole, seed=1, **how)


def test_pictures_after_some_steps_share_their_noise(tmp_path: Path) -> None:
    """A mass shows nowhere in a block at rest; several cameras have a column each."""
    world = World("pushing")
    world.reset(seed=0)
    cameras = [camera.name for camera in world.cameras()][:2]
    folder = triplets(
        world, ["tool_block.mass", "tool_block.color"], 6, tmp_path / "t", steps=3, cameras=cameras
    )
    found = rows(folder)
    assert {tuple(row["targets"]) for row in found} == {
        (n,) for n in ("tool_block.mass", "tool_block.color")
    }
    for row in found:
        for camera in cameras:
            one, other = (
                pixels(row[f"image{which}.{camera}"]) for which in ("", "_counterfactual")
            )
            moved = int((one != other).any(axis=-1).sum())
            assert moved <= (50 if row["targets"] == ["tool_block.mass"] else 64 * 64)


@pytest.mark.parametrize(
    ("how", "error", "words"),
    [
        ({"factors": ["nothing"]}, UnknownVariable, "nothing"),
        ({"factors": ["joint_velocities_"]}, UnknownVariable, "joint"),
        ({"factors": []}, UnknownOption, "factors"),
        ({"targets": 9}, UnknownOption, "1 to 4"),
        ({"n": 0}, UnknownOption, "n"),
    ],
)
def test_what_makes_no_pairs_is_refused(
    how: dict[str, Any], error: type[Exception], words: str, tmp_path: Path
) -> None:
    """With what is allowed."""
    given: dict[str, Any] = {"factors": FACTORS, "n": 2, "out": tmp_path / "t", **how}
    with pytest.raises(error, match=words):
        triplets(World("pushing", backend="fake"), **given)
    assert not (tmp_path / "t").exists()
