"""Pairs of pictures before and after an intervention."""

from __future__ import annotations

import hashlib
import io
import json
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest

from scm_world import World
from scm_world.discovery.data import (
    Design,
    Pictures,
    as_huggingface,
    collect,
    load,
    triplets,
)
from scm_world.errors import UnknownOption, UnknownVariable, UnreadableFile
from scm_world.variables import Mechanism

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
    assert (first.read_bytes(), told[-1]) == (kept, (8, 8))
    assert pixels(rows(whole)[0]["image"]).shape == (16, 24, 3)
    with pytest.raises(
        UnreadableFile, match=r"another triplets; these differ: seed \(0 there, 1 here\)"
    ):
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
        ({"cameras": ["61"]}, UnknownOption, "60"),
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


def test_a_counterfactual_that_shows_nothing_is_the_same_picture(tmp_path: Path) -> None:
    """Byte for byte: a mass is seen nowhere, and noise stays."""
    factors = ["tool_block.mass", "light_ambient"]
    for row in rows(triplets(World("pushing"), factors, 12, tmp_path / "t", size=(24, 24))):
        same = row["image"] == row["image_counterfactual"]
        assert same == (row["targets"] == ["tool_block.mass"])
        fixed = factors[1 - factors.index(row["targets"][0])]
        assert row[f"z.{fixed}"] == row[f"z_counterfactual.{fixed}"]


def darker(color: Any) -> Any:
    """Give half a color."""
    return color / 2.0


def test_a_factor_with_a_mechanism_follows_it(tmp_path: Path) -> None:
    """In x, and in x̃ unless it is the target."""
    tie = Mechanism(darker, ["floor_color"])
    with World("pushing", backend="fake") as plain, plain.given({"stage_color": tie}) as world:
        found = rows(
            triplets(world, ["floor_color", "stage_color"], 8, tmp_path / "t", size=(16, 16))
        )
    for row in found:
        for which in ("", "_counterfactual"):
            follows = np.allclose(
                row[f"z{which}.stage_color"], np.divide(row[f"z{which}.floor_color"], 2)
            )
            assert follows == (not which or row["targets"] == ["floor_color"])


def test_causal_circuit_has_the_published_layout(tmp_path: Path) -> None:
    """Arrays of the published names and shapes; x̃ has the same noise but for its target."""
    example = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "causal_circuit.py"))
    example["main"](str(tmp_path), "20", "24")
    parts = [dict(np.load(tmp_path / f"train-{i}.npz")) for i in range(10)]
    assert {path.name for path in tmp_path.glob("*.npz")} == {
        *(f"train-{i}.npz" for i in range(10)), "val.npz", "test.npz",
    }  # fmt: skip
    (tmp_path / "train-3.npz").unlink()
    example["main"](str(tmp_path), "20", "24")
    again = dict(np.load(tmp_path / "train-3.npz"))
    assert all(np.array_equal(again[name], parts[3][name]) for name in again)
    data = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    latents, noise, labels = (
        data[n] for n in ("original_latents", "epsilon", "intervention_labels")
    )
    assert latents.shape == noise.shape == (20, 2, 4)
    assert data["pressed"].shape == (20, 2, 3)
    assert data["imgs"].shape == (20, 2)
    assert ((latents >= 0.0) & (latents <= 1.0)).all()
    assert set(labels) == {0, 1, 2, 3, 4}
    for i, label in enumerate(labels):
        assert data["intervention_masks"][i].tolist() == [label == k + 1 for k in range(4)]
        others = [k for k in range(4) if k + 1 != label]
        np.testing.assert_allclose(noise[i, 1, others], noise[i, 0, others], atol=1e-9)
        one, other = (np.asarray(Image.open(io.BytesIO(cell))) for cell in data["imgs"][i])
        assert one.shape == (24, 24, 3)
        assert (one == other).all() == (label == 0)
        moved = {k for k in range(4) if latents[i, 0, k] != latents[i, 1, k]}
        follows = {0: set(), 1: {0}, 2: {0, 1}, 3: {0, 2}, 4: {0, 1, 2, 3}}[int(label)]
        assert moved <= follows
        assert label == 0 or label - 1 in moved


def test_pictures_beside_rows(tmp_path: Path) -> None:
    """What is seen at an instant is what the row says; a shard without them is made anew."""
    world, design = World("pushing"), Design("single", ("tool_block.mass",))
    pictures = Pictures(cameras=("60", "120"), size=(24, 24), goals=True)
    how: dict[str, Any] = {"steps": 2, "shard": 2, "every_step": True, "pictures": pictures}
    out = tmp_path / "a"
    table = collect(world, design, 3, out=out, **how)
    files = sorted(out.glob("pictures-*.parquet"))
    seen = [row for file in files for row in parquet.read_table(file).to_pylist()]
    assert [(row["episode"], row["step"]) for row in seen] == list(
        zip(table.episode.tolist(), table.step.tolist(), strict=True)
    )
    assert set(seen[0]) == {"episode", "step"} | {
        f"{kind}image.{camera}" for kind in ("", "goal_") for camera in ("60", "120")
    }
    episode = world.rollout("random", seed=0, episode=1, steps=2)
    world.reset(seed=0, episode=1)
    world.step(episode.actions[0])
    scene, cameras = episode.scene(1)
    assert pictures.take(scene, cameras) == pictures.take(world.scene(), world.cameras())
    kept = [file.read_bytes() for file in files]
    files[0].unlink()
    assert collect(world, design, 3, out=out, **how) == table == load(out)
    assert [file.read_bytes() for file in files] == kept
    with pytest.raises(UnknownOption, match="camera"):
        collect(world, design, 2, out=tmp_path / "c", pictures=Pictures(cameras=("61",)))
    assert not (tmp_path / "c").exists()
    with pytest.raises(UnknownOption, match="folder"):
        collect(world, design, 2, pictures=pictures)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_mlcroissant_reads_what_is_described(tmp_path: Path) -> None:
    """Without a warning, and without the network."""
    croissant = pytest.importorskip("mlcroissant", reason="mlcroissant is not installed")
    folder = triplets(World("pushing", backend="fake"), FACTORS, 4, tmp_path / "t", shard=3)
    as_huggingface(folder, **ABOUT)
    read = croissant.Dataset(folder / "croissant.json")
    assert not read.metadata.issues.errors
    assert not read.metadata.issues.warnings
    found = list(read.records("pairs"))
    assert len(found) == 4
    assert found[0]["pairs/z.floor_color"] == pytest.approx(rows(folder)[0]["z.floor_color"])
    assert found[0]["pairs/image"].size == (64, 64)


ABOUT = {
    "name": "pairs",
    "license": "cc-by-4.0",
    "creator": "us",
    "url": "https://example.org",
    "datePublished": "2026-01-01",
    "citeAs": "@misc{pairs}",
}


def test_a_card_of_rows_has_every_column(tmp_path: Path) -> None:
    """Numbers and words of a collection have their types, whatever pandas calls a text."""
    design = Design("single", ("floor_friction",), observational_fraction=0.5)
    collect(World("pushing", backend="fake"), design, 4, steps=1, out=tmp_path / "rows")
    as_huggingface(tmp_path / "rows", **ABOUT)
    about = json.loads((tmp_path / "rows" / "croissant.json").read_text())
    (records,) = about["recordSet"]
    types = {field["name"]: field["dataType"] for field in records["field"]}
    shown = pandas.read_parquet(tmp_path / "rows" / "shard-00000.parquet")
    assert list(types) == list(shown.columns)
    for name, kind in types.items():
        values = shown[name].tolist()
        python = {"cr:Int64": int, "cr:Float64": float, "sc:Text": str}[kind]
        assert all(isinstance(value, python) for value in values)
    assert types["intervention_targets"] == "sc:Text"


def test_croissant_and_hugging_face(tmp_path: Path) -> None:
    """Sums of the files and all columns are there; the libraries read what is described."""
    folder = triplets(World("pushing", backend="fake"), FACTORS, 4, tmp_path / "t", shard=3)
    as_huggingface(folder, **ABOUT)
    about = json.loads((folder / "croissant.json").read_text())
    assert about["conformsTo"] == "http://mlcommons.org/croissant/1.1"
    sums = {part["name"]: part.get("sha256") for part in about["distribution"]}
    for path in folder.glob("*.parquet"):
        assert sums[path.name] == hashlib.sha256(path.read_bytes()).hexdigest()
    (records,) = about["recordSet"]
    assert [field["name"] for field in records["field"]] == list(rows(folder)[0])
    assert 'data_files: "triplets-*.parquet"' in (folder / "README.md").read_text()
    assert triplets(World("pushing", backend="fake"), FACTORS, 4, folder, shard=3) == folder
    with pytest.raises(UnreadableFile, match="Parquet"):
        as_huggingface(tmp_path)
