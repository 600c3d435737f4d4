"""Files of finished work that are well formed and wrong: edited, swapped, of another folder."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest

import scm_world as sw
from scm_world.discovery import discover
from scm_world.discovery.data import Design, Pictures, collect, load
from scm_world.discovery.data.dataset import Dataset
from scm_world.errors import ScmWorldError, UnreadableFile, UnwritableFolder
from scm_world.evaluation import evaluate
from scm_world.policies.networks import MlpPolicy, policy_in
from scm_world.runs.files import read_bytes, write_whole
from scm_world.runs.study import Study, sealed, unsealed
from scm_world.variables import Box, Derived, Exogenous, Linear, Normal

NUMBERS = np.arange(7.0, dtype=np.float32)


def archive() -> bytes:
    """Return an archive of NumPy."""
    stream = io.BytesIO()
    np.savez(stream, a=NUMBERS)
    return stream.getvalue()


def policy() -> MlpPolicy:
    """Return a policy of one layer that says what it was trained for."""
    tensors = {"layers.0.weight": NUMBERS.reshape(1, 7), "layers.0.bias": NUMBERS[:1]}
    return MlpPolicy.of(tensors, {"task": "mine", "card": {"round": 0}})


FILES: dict[str, tuple[bytes, Callable[[bytes], Any]]] = {
    "a.json": (b'[{"reward": 1.5}]\n', lambda data: json.loads(data)["content"]),
    "a.npz": (archive(), lambda data: np.load(io.BytesIO(data))["a"].tolist()),
    "a.parquet": (
        pandas.DataFrame({"a": NUMBERS, "b": "word"}).to_parquet(None),
        lambda data: pandas.read_parquet(io.BytesIO(data))["a"].tolist(),
    ),
    "a.safetensors": (policy().content(), lambda data: policy_in(data).sha256),
}


@pytest.mark.parametrize("name", FILES)
def test_a_sum_hides_from_readers_of_the_format(name: str) -> None:
    """Any library reads the file as without it, and taking it off leaves the content."""
    content, read = FILES[name]
    data = sealed(name, content, {"seed": 1})
    assert unsealed(name, data, {"seed": 1}) == content
    known = {
        "a.json": [{"reward": 1.5}],
        "a.npz": NUMBERS.tolist(),
        "a.parquet": NUMBERS.tolist(),
        "a.safetensors": policy().sha256,
    }
    assert read(data) == known[name]


@pytest.mark.parametrize("name", FILES)
def test_a_sum_covers_content_name_settings_and_episodes(name: str) -> None:
    """Every changed or missing byte of them counts; the frame around the sum is not content."""
    content, _ = FILES[name]
    data = sealed(name, content, {"seed": 1}, range(3))
    refused = 0
    for place in range(len(data)):
        changed = bytearray(data)
        changed[place] ^= 1
        try:
            assert unsealed(name, bytes(changed), {"seed": 1}, range(3)) == content
        except ValueError:
            refused += 1
    assert refused >= len(content) - 1  # the end of a line of JSON
    for cut in (0, 1, len(data) // 2, len(data) - 1):
        with pytest.raises(ValueError, match=r"cut|edited"):
            unsealed(name, data[:cut], {"seed": 1}, range(3))
    for other, settings, episodes in (
        (f"b{name}", {"seed": 1}, range(3)),
        (name, {"seed": 2}, range(3)),
        (name, {"seed": 1}, range(2)),
    ):
        with pytest.raises(ValueError, match="belongs elsewhere"):
            unsealed(other, data, settings, episodes)
    with pytest.raises(ValueError, match="no sum"):
        unsealed(name, content, {"seed": 1}, range(3))


def swap(one: Path, other: Path) -> None:
    """Let two files have each other's names."""
    aside = one.with_name("aside")
    one.rename(aside)
    other.rename(one)
    aside.rename(other)


MODEL = sw.SCM(
    [
        Exogenous(name="a", distribution=Normal(), a=Box(-1.0, 1.0)),
        Derived(name="b", parents=("a",), mechanism=Linear(weights=(2.0,))),
    ]
)
DESIGN = Design("single", ("a",), observational_fraction=0.5)


def collected(out: Path, n: int = 12, seed: int = 0) -> Dataset:
    """Collect episodes in files of five."""
    return collect(MODEL, DESIGN, n, seed=seed, out=out, shard=5)


def test_swapped_and_foreign_shards_are_refused(tmp_path: Path) -> None:
    """Of the same collection, of one with another seed, and of a smaller one."""
    whole = collected(tmp_path / "a")
    first, second, third = (tmp_path / "a" / f"shard-0000{i}.parquet" for i in range(3))
    swap(first, second)
    for read in (lambda: load(tmp_path / "a"), lambda: collected(tmp_path / "a")):
        with pytest.raises(UnreadableFile, match=r"shard-00000\.parquet.*belongs elsewhere"):
            read()
    swap(first, second)
    collected(tmp_path / "b", seed=1)
    kept = first.read_bytes()
    first.write_bytes((tmp_path / "b" / first.name).read_bytes())
    with pytest.raises(UnreadableFile, match="belongs elsewhere"):
        load(tmp_path / "a")
    first.write_bytes(kept)
    collected(tmp_path / "c", n=11)
    third.write_bytes((tmp_path / "c" / third.name).read_bytes())
    with pytest.raises(UnreadableFile, match="belongs elsewhere"):
        load(tmp_path / "a")
    third.unlink()
    assert collected(tmp_path / "a") == whole == load(tmp_path / "a")


def test_a_number_that_pandas_changed_is_refused(tmp_path: Path) -> None:
    """The file is well formed, and has lost its sum."""
    collected(tmp_path)
    path = tmp_path / "shard-00001.parquet"
    frame = pandas.read_parquet(path)
    frame.loc[0, "b"] += 1.0
    frame.to_parquet(path)
    with pytest.raises(UnreadableFile, match="no sum of its content"):
        load(tmp_path)


def test_an_edited_evaluation_is_not_used(tmp_path: Path) -> None:
    """The error names the part; without it, it is played again."""
    asked: Any = {"n": 2, "backend": "fake", "env": {"max_episode_length": 2}, "out": tmp_path}
    found = evaluate("still", "P0,P5", **asked)
    one, other = sorted(tmp_path.glob("parts/*.json"))
    kept = one.read_text()
    one.write_text(kept.replace('"episode": 1', '"episode": 0'))
    assert one.read_text() != kept
    with pytest.raises(UnreadableFile, match="edited") as caught:
        evaluate("still", "P0,P5", **asked)
    assert caught.value.path == str(one)
    one.write_text(other.read_text())
    with pytest.raises(UnreadableFile, match="belongs elsewhere"):
        evaluate("still", "P0,P5", **asked)
    one.unlink()
    assert evaluate("still", "P0,P5", **asked).frame.equals(found.frame)


def test_swapped_probes_are_refused(tmp_path: Path) -> None:
    """A discovery that goes on reads each of its states once."""
    discover(MODEL, probes=2, checkpoint=tmp_path)
    swap(tmp_path / "probe-0.json", tmp_path / "probe-1.json")
    with pytest.raises(UnreadableFile, match=r"probe-0\.json.*belongs elsewhere"):
        discover(MODEL, probes=2, checkpoint=tmp_path)


def test_pictures_of_other_rows_are_refused(tmp_path: Path) -> None:
    """And those of a last file that was not full are made again when the collection grows."""
    pytest.importorskip("PIL")
    world, design = sw.World("pushing", backend="fake"), Design("single", ("floor_friction",))
    pictures = Pictures(size=(8, 8))

    def run(n: int, out: Path) -> None:
        collect(world, design, n, steps=1, shard=2, out=out, pictures=pictures)

    run(3, tmp_path / "a")
    old = (tmp_path / "a" / "pictures-00001.parquet").read_bytes()
    run(4, tmp_path / "a")
    run(4, tmp_path / "b")
    names = [f"pictures-0000{i}.parquet" for i in range(2)]
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    (tmp_path / "a" / names[1]).write_bytes(old)
    with pytest.raises(UnreadableFile, match=r"pictures-00001\.parquet.*belongs elsewhere"):
        run(4, tmp_path / "a")


# --- what has the name of a file or folder --------------------------------------------------------


def place(kind: str, path: Path) -> Path:
    """Make something that is neither a regular file nor a folder, or is in the wrong place."""
    if kind == "link":
        path.symlink_to(path.with_name("nowhere"))
    elif kind == "device":
        path.symlink_to("/dev/null")
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "file":
        path.write_text("mine")
    else:
        path.mkdir()
    return path


WORDS = {
    "link": r"is a link to .*nowhere, which does not exist",
    "device": "but a device, a pipe or a socket",
    "pipe": "but a device, a pipe or a socket",
    "file": "is not a folder, but a regular file",
    "folder": "is not a regular file, but a folder",
}


@pytest.mark.parametrize("kind", ["link", "device", "pipe", "file"])
@pytest.mark.parametrize("below", [False, True])
def test_a_folder_that_cannot_be_one_is_described(kind: str, below: bool, tmp_path: Path) -> None:
    """In its own words, for the folder of a study and for one above it; it stays."""
    path = place(kind, tmp_path / "out")
    out = path / "more" / "deep" if below else path
    with pytest.raises(UnwritableFolder, match=WORDS[kind] + ".*; give another path"):
        collected(out)
    with pytest.raises(UnreadableFile, match=WORDS[kind]):
        load(out)
    assert path.is_symlink() or not path.is_dir()


@pytest.mark.parametrize("kind", ["link", "device", "pipe", "folder"])
def test_a_file_that_cannot_be_one_is_described(kind: str, tmp_path: Path) -> None:
    """It is neither replaced nor read."""
    path = place(kind, tmp_path / "notes.json")
    with pytest.raises(UnwritableFolder, match=WORDS[kind] + ".*; give another path"):
        write_whole(path, b"1")
    with pytest.raises(OSError, match=WORDS[kind]):
        read_bytes(path)
    assert path.is_symlink() or not path.is_file()
    with Study(tmp_path / "study", "squares", {}) as study:
        place(kind, tmp_path / "study" / "0.json")
        with pytest.raises(ScmWorldError, match=WORDS[kind]):
            dict(study.map({"0.json": 2}, abs, read=int, write=lambda x: str(x).encode()))
