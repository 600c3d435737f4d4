"""Saved datasets: their own order, their own folder, their own advice."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from scm_world.discovery.data import Dataset, batches, load, save
from scm_world.errors import ModelError, UnreadableFile

pytest.importorskip("pyarrow")


def contents(folder: Path) -> dict[str, bytes]:
    """Read every file of a folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_saving_keeps_the_order_of_episodes(tmp_path: Path) -> None:
    """Episodes that stand in another order than their numbers come back in it."""
    table = Dataset.of(np.arange(4.0)[:, None], ["a"], episode=[9, 9, 2, 5], step=[0, 4, 0, 0])
    assert load(save(table, tmp_path, shard=2)) == table


def test_nothing_is_saved_over(tmp_path: Path) -> None:
    """A folder with a dataset, or with anything else, is refused, and nothing is lost."""
    mine = Dataset.of(np.arange(4.0)[:, None], ["a"])
    save(mine, tmp_path)
    before = contents(tmp_path)
    with pytest.raises(UnreadableFile, match="give a new or an empty folder"):
        save(mine, tmp_path)
    assert contents(tmp_path) == before


def test_tables_are_written_and_read_one_by_one(tmp_path: Path) -> None:
    """In bounded memory; together they are one dataset."""
    made = (
        Dataset.of(np.full((10, 2), float(i)), ["a", "b"], episode=np.arange(10) + 10 * i)
        for i in range(5)
    )
    save(made, tmp_path, shard=4)
    parts = [*batches(tmp_path)]
    assert [len(part) for part in parts] == [4, 4, 2] * 5
    assert load(tmp_path) == Dataset.joined(parts)
    assert load(tmp_path)["a"].tolist() == np.repeat(np.arange(5.0), 10).tolist()
    others = (Dataset.of([[1.0]], [name]) for name in ("a", "b"))
    with pytest.raises(ModelError, match="cannot be joined"):
        save(others, tmp_path / "others")


def test_saving_is_complete_or_nothing(tmp_path: Path) -> None:
    """Interrupted, or refused, it leaves no folder, and the same call can be made again."""

    def tables() -> Iterator[Dataset]:
        yield Dataset.of(np.arange(4.0)[:, None], ["a"])
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        save(tables(), tmp_path / "one", shard=2)
    assert [*tmp_path.iterdir()] == []
    table = next(tables())
    assert load(save(table, tmp_path / "one")) == table
    with pytest.raises(KeyboardInterrupt):
        save(tables(), "memory://half/one", shard=2)
    assert load(save(table, "memory://half/one")) == table


def test_a_file_copied_over_another_is_named(tmp_path: Path) -> None:
    """By ``load`` and by ``batches``, with the one whose episodes it has."""
    save(Dataset.of(np.arange(6.0)[:, None], ["a"]), tmp_path, shard=2)
    (tmp_path / "shard-00002.parquet").write_bytes((tmp_path / "shard-00001.parquet").read_bytes())
    for read in (load, lambda folder: [*batches(folder)]):
        with pytest.raises(UnreadableFile, match=r"00002.* same episodes as shard-00001"):
            read(tmp_path)


def test_tables_that_cannot_be_joined_are_not_saved_together(tmp_path: Path) -> None:
    """Two of them with the same episode numbers are refused while they are written."""
    table = Dataset.of(np.arange(6.0).reshape(3, 2), ["a", "b"])
    with pytest.raises(ModelError, match="same episode numbers"):
        save([table, table], tmp_path / "twice")


def test_a_folder_without_columns_is_named(tmp_path: Path) -> None:
    """The settings of another study are none of a dataset."""
    table = Dataset.of(np.arange(6.0).reshape(3, 2), ["a", "b"])
    folder = Path(str(save(table, tmp_path / "one")))
    head = folder / "study.json"
    data = json.loads(head.read_text())
    head.write_text(json.dumps({**data, "settings": {}}))
    with pytest.raises(UnreadableFile, match="no columns in it"):
        load(folder)
