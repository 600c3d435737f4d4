"""Datasets in folders: nothing is lost, nothing is half there, and all of it is checked."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import runpy
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world import SCM, Box, Exogenous
from scm_world.discovery.data import (
    Dataset,
    Design,
    collect,
    load,
    save,
)
from scm_world.errors import ModelError, UnknownOption, UnreadableFile, UnwritableFolder
from scm_world.queries import World
from scm_world.runs import files
from scm_world.variables import Mechanism

pytest.importorskip("pyarrow")

DESIGN = Design(
    "half", ("tool_block.mass", "floor_friction", "gravity"), observational_fraction=0.3
)
HOW: dict[str, Any] = {"steps": 2, "seed": 5, "shard": 4, "nature": {"sensor_noise": 0.01}}


def contents(folder: Path) -> dict[str, bytes]:
    """Read every file of a folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def world() -> World:
    """A world without physics."""
    return World("pushing", backend="fake")


@pytest.fixture(scope="module")
def written(world: World, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Dataset]:
    """A folder, and what is in it."""
    folder = tmp_path_factory.mktemp("data") / "whole"
    return folder, collect(world, DESIGN, 10, out=folder, **HOW)


@pytest.fixture
def copied(written: tuple[Path, Dataset], tmp_path: Path) -> Path:
    """A copy of the folder, to be spoiled."""
    folder = tmp_path / "copy"
    folder.mkdir()
    for name, data in contents(written[0]).items():
        (folder / name).write_bytes(data)
    return folder


# --- whole ------------------------------------------------------------------------------------


def test_a_folder_holds_what_was_collected(written: tuple[Path, Dataset], world: World) -> None:
    """Loaded, it is bit for bit what came out, and what comes out without a folder."""
    folder, found = written
    names = sorted(path.name for path in folder.iterdir())
    shards = (f"shard-0000{i}.parquet" for i in range(3))
    assert names == ["dataset.json", *shards, "study.json"]
    assert load(folder) == found
    assert collect(world, DESIGN, 10, **HOW) == found


def test_saving_is_without_loss(written: tuple[Path, Dataset], tmp_path: Path) -> None:
    """Any table comes back: extreme numbers, several rows per episode, unused regimes."""
    _, found = written
    values = [[-0.0, 1e-310], [np.nextafter(1.0, 2.0), -1.7976931348623157e308], [0.1, 1 / 3]]
    table = Dataset.of(
        values, ["a", 'b;"c'], targets=[(), ("a",), ()], episode=[7, 7, 9], step=[0, 1, 0], x=[1]
    )
    for number, data in enumerate((found, table, table.rows([0]), table.rows([]))):
        back = load(save(data, tmp_path / str(number), shard=1))
        assert back == data
        assert back.values.tobytes() == data.values.tobytes()


def test_files_are_tables_for_others(written: tuple[Path, Dataset]) -> None:
    """Other libraries read them without this package, targets included."""
    pandas = pytest.importorskip("pandas")
    folder, found = written
    path = folder / "shard-00000.parquet"
    frame = pandas.read_parquet(path)
    rows = frame["tool_block.mass"].to_numpy()
    np.testing.assert_array_equal(rows, found["tool_block.mass"][:4])
    told = frame["intervention_targets"].fillna("")[1]
    assert told == ";".join(np.array(found.names)[found.targeted[1]])


def test_a_model_goes_into_a_folder(tmp_path: Path) -> None:
    """Also one with a function without a name, which its content tells from others."""
    named = SCM([Exogenous(name="x", distribution=Box(0.0, 1.0))])
    found = collect(named, Design(), 7, out=tmp_path / "a", shard=3)
    assert load(tmp_path / "a") == found == collect(named, Design(), 7)
    nameless = named.do({"x": Mechanism(lambda: 1.0)})
    assert len(collect(nameless, Design(), 2, out=tmp_path / "b")) == 2
    with pytest.raises(UnreadableFile, match="differ: function that sets 'x'"):
        collect(named.do({"x": Mechanism(lambda: 2.0)}), Design(), 2, out=tmp_path / "b")


def test_mechanisms_are_read_back_where_they_are_trusted(tmp_path: Path) -> None:
    """Who collects trusts the functions of the design; who loads says so."""
    model = SCM([Exogenous(name="x"), Exogenous(name="y")])
    design = Design("all", ("y",), Mechanism(np.negative, ["x"]), 0.0)
    found = collect(model, design, 3, out=tmp_path, shard=2)
    assert collect(model, design, 3, out=tmp_path, shard=2) == found
    with pytest.raises(ModelError, match="trusted"):
        load(tmp_path)
    assert load(tmp_path, trusted=["numpy"]) == found


# --- interrupted ------------------------------------------------------------------------------


@pytest.mark.parametrize("after", [1, 4, 7])
def test_ctrl_c_keeps_what_is_complete(
    written: tuple[Path, Dataset], world: World, tmp_path: Path, after: int
) -> None:
    """The same call goes on, and every file is as if nothing had happened."""
    folder, found = written

    def interrupt(done: int, planned: int) -> None:
        if done >= after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        collect(world, DESIGN, 10, out=tmp_path, progress=interrupt, **HOW)
    assert len(list(tmp_path.glob("shard-*"))) == -(-after // 4)
    with pytest.raises(UnreadableFile, match="it is not there yet"):
        load(tmp_path)
    assert load(tmp_path, partial=True) == found.first(-(-after // 4) * 4)
    told: list[int] = []
    again = collect(world, DESIGN, 10, out=tmp_path, progress=lambda d, _: told.append(d), **HOW)
    assert again == found
    assert contents(tmp_path) == contents(folder)
    assert told[-1] == 10
    assert len(told) == len(set(told))


PROGRAM = """
import sys
from scm_world.discovery.data import Design, collect
from scm_world.queries import World
from scm_world.runs import files
design = Design("half", ("tool_block.mass", "floor_friction", "gravity"))
print("begin", flush=True)
collect(World("pushing", backend="fake"), design, 150, out=sys.argv[1], shard=3, steps=2)
"""


def test_a_killed_process_leaves_nothing_broken(world: World, tmp_path: Path) -> None:
    """After SIGKILL the same call makes the files of an uninterrupted run, byte for byte."""
    folder = tmp_path / "killed"
    with subprocess.Popen(  # noqa: S603 # our own text
        [sys.executable, "-c", PROGRAM, str(folder)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "begin\n"
        while process.poll() is None and not list(folder.glob("shard-*")):
            time.sleep(0.001)
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    there = len(list(folder.glob("shard-*")))
    assert 0 < there < 50
    for out in (folder, tmp_path / "whole"):
        collect(world, DESIGN, 150, out=out, shard=3, steps=2)
    assert contents(folder) == contents(tmp_path / "whole")


def test_drafts_of_the_dead_are_swept_away(copied: Path, world: World) -> None:
    """Half a file under another name is no part of anything; other hidden files are left alone."""
    (copied / ".shard-00001.parquet.part").write_bytes(b"half a")
    (copied / ".mine").write_text("to be kept")
    collect(world, DESIGN, 10, out=copied, **HOW)
    assert sorted(path.name for path in copied.glob(".*")) == [".mine"]


def test_more_episodes_go_on_from_there(
    written: tuple[Path, Dataset], copied: Path, world: World, tmp_path: Path
) -> None:
    """Complete files stay as they are; the folder becomes that of the larger collection."""
    before = (copied / "shard-00000.parquet").stat().st_mtime_ns
    more = collect(world, DESIGN, 15, out=copied, **HOW)
    assert more.first(10) == written[1]
    assert (copied / "shard-00000.parquet").stat().st_mtime_ns == before
    collect(world, DESIGN, 15, out=tmp_path / "new", **HOW)
    assert contents(copied) == contents(tmp_path / "new")
    with pytest.raises(UnknownOption, match="15 or more"):
        collect(world, DESIGN, 10, out=copied, **HOW)


# --- spoiled ----------------------------------------------------------------------------------


def test_every_kind_of_damage_is_seen(copied: Path, world: World) -> None:
    """A file that was cut, changed or exchanged is named, and what to do with it."""
    paths = sorted(copied.glob("shard-*"))
    data = paths[1].read_bytes()
    other = save(Dataset.of([[0.0]], ["x"]), copied.with_name("other")) / "shard-00000.parquet"
    page = data.index(b"\x28\xb5\x2f\xfd") + 9  # within the first page, compressed by zstd
    changed = data[:page] + bytes([data[page] ^ 16]) + data[page + 1 :]
    whole = load(copied)
    for text in (b"", data[:-1], data[: len(data) // 2], b"notes", other.read_bytes(), changed):
        paths[1].write_bytes(text)
        for again in (load, lambda folder: collect(world, DESIGN, 10, out=folder, **HOW)):
            with pytest.raises(UnreadableFile, match="delete") as caught:
                again(copied)
            assert caught.value.path == str(paths[1])
    paths[1].unlink()
    assert collect(world, DESIGN, 10, out=copied, **HOW) == whole
    assert paths[1].read_bytes() == data


@pytest.mark.parametrize(
    ("change", "named"),
    [({"seed": 6}, "seed"), ({"steps": 3}, "steps"), ({"nature": None}, "nature")],
)
def test_another_collection_is_not_mixed_in(
    written: tuple[Path, Dataset], world: World, change: dict[str, Any], named: str
) -> None:
    """The folder of another one is refused, and the error says what differs."""
    folder, _ = written
    before = contents(folder)
    with pytest.raises(UnreadableFile, match=f"another dataset; these differ: {named}"):
        collect(world, DESIGN, 10, out=folder, **{**HOW, **change})
    with pytest.raises(UnreadableFile, match="differ: design"):
        collect(world, Design(), 10, out=folder, **HOW)
    assert contents(folder) == before


@pytest.mark.parametrize("name", ["study.json", "dataset.json"])
def test_what_a_folder_says_of_itself_is_read_whole(
    name: str, copied: Path, tmp_path: Path
) -> None:
    """Missing, cut or of another kind, the file is named."""
    path = copied / name
    for spoiled in (path.read_text()[:-10], "[]", "{}"):
        path.write_text(spoiled)
        with pytest.raises(UnreadableFile, match=re.escape(name)):
            load(copied)
    path.unlink()
    for folder in (copied, tmp_path / "nowhere"):
        with pytest.raises(UnreadableFile, match=r"study\.json|dataset\.json"):
            load(folder)


def test_a_folder_with_other_things_is_left_alone(world: World, tmp_path: Path) -> None:
    """Nothing is written between the files of somebody else."""
    (tmp_path / "thesis.txt").write_text("final")
    with pytest.raises(UnreadableFile, match=r"something else: thesis\.txt"):
        collect(world, DESIGN, 10, out=tmp_path, **HOW)
    assert contents(tmp_path) == {"thesis.txt": b"final"}


def test_two_processes_do_not_write_to_one_folder(copied: Path, world: World) -> None:
    """The second one is told."""
    handle = os.open(copied, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        with pytest.raises(UnreadableFile, match="another process"):
            collect(world, DESIGN, 10, out=copied, **HOW)
    finally:
        os.close(handle)


def test_a_full_disk_loses_nothing(
    written: tuple[Path, Dataset], world: World, tmp_path: Path, monkeypatch: Any
) -> None:
    """The error says so; with room again the same call goes on."""
    folder, _ = written
    calls = iter(range(100))

    def full(handle: int) -> None:
        if next(calls) == 3:  # the settings, the count and the first file are there
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(files.os, "fsync", full)
        with pytest.raises(UnwritableFolder, match=r"shard-00001.*No space left"):
            collect(world, DESIGN, 10, out=tmp_path, **HOW)
    assert sorted(contents(tmp_path)) == ["dataset.json", "shard-00000.parquet", "study.json"]
    collect(world, DESIGN, 10, out=tmp_path, **HOW)
    assert contents(tmp_path) == contents(folder)


def test_a_place_that_cannot_be_is_told(world: World, tmp_path: Path) -> None:
    """A file where the folder should be."""
    (tmp_path / "file").write_text("")
    with pytest.raises(UnwritableFolder, match="cannot be written to"):
        collect(world, DESIGN, 10, out=tmp_path / "file", **HOW)


def test_the_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    """It collects, goes on, and prints what each library would get."""
    path = Path(__file__).parents[2] / "examples" / "collect.py"
    runpy.run_path(str(path))["main"](episodes=20)
    assert "rows with do(nothing)" in capsys.readouterr().out
