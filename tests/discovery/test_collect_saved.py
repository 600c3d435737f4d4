"""Saved datasets: their own order, their own folder, their own advice."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from scm_world.discovery.data import Dataset, batches, load, save
from scm_world.errors import UnreadableFile

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


def test_tables_are_read_file_by_file(tmp_path: Path) -> None:
    """In bounded memory; together they are one dataset."""
    save(Dataset.of(np.arange(20.0).reshape(10, 2), ["a", "b"]), tmp_path, shard=4)
    parts = [*batches(tmp_path)]
    assert [len(part) for part in parts] == [4, 4, 2]
    assert load(tmp_path) == Dataset.joined(parts)
    assert load(tmp_path)["a"].tolist() == [*range(0, 20, 2)]


def test_saving_is_complete_or_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Interrupted, it leaves no folder, and the same call can be made again."""
    table = Dataset.of(np.arange(4.0)[:, None], ["a"])

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    for place in (tmp_path / "one", "memory://half/one"):
        with monkeypatch.context() as during:
            during.setattr("scm_world.discovery.data.files.write_count", interrupt)
            with pytest.raises(KeyboardInterrupt):
                save(table, place, shard=2)
        assert not (tmp_path / "one").exists() or place != tmp_path / "one"
        assert load(save(table, place)) == table


def test_a_file_copied_over_another_is_named(tmp_path: Path) -> None:
    """By ``load`` and by ``batches``: its sum covers its name and its episodes."""
    save(Dataset.of(np.arange(6.0)[:, None], ["a"]), tmp_path, shard=2)
    (tmp_path / "shard-00002.parquet").write_bytes((tmp_path / "shard-00001.parquet").read_bytes())
    for read in (load, lambda folder: [*batches(folder)]):
        with pytest.raises(UnreadableFile, match=r"00002.* belongs elsewhere"):
            read(tmp_path)


def test_a_folder_without_columns_is_named(tmp_path: Path) -> None:
    """The settings of another study are none of a dataset."""
    table = Dataset.of(np.arange(6.0).reshape(3, 2), ["a", "b"])
    folder = Path(str(save(table, tmp_path / "one")))
    head = folder / "study.json"
    data = json.loads(head.read_text())
    head.write_text(json.dumps({**data, "settings": {}}))
    with pytest.raises(UnreadableFile, match="no columns in it"):
        load(folder)
