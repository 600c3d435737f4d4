"""Saved datasets: their own order, their own folder, their own advice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world.discovery.data import Dataset, folders, load, save
from scm_world.errors import UnreadableFile


def contents(folder: Path) -> dict[str, bytes]:
    """Read every file of a folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("kind", ["parquet", "csv"])
def test_saving_keeps_the_order_of_episodes(tmp_path: Path, kind: str) -> None:
    """Episodes that stand in another order than their numbers come back in it."""
    if kind == "parquet":
        pytest.importorskip("pyarrow")
    table = Dataset.of(np.arange(4.0)[:, None], ["a"], episode=[9, 9, 2, 5], step=[0, 4, 0, 0])
    assert load(save(table, tmp_path, shard=2, format=kind)) == table


def test_another_dataset_is_not_saved_over(tmp_path: Path) -> None:
    """Of the same shape, with other numbers or other targets: refused, and nothing is lost."""
    rows = np.arange(4.0)[:, None]
    mine = Dataset.of(rows, ["a"])
    others = [Dataset.of(rows + 1.0, ["a"]), Dataset.of(rows, ["a"], targets=[("a",)] * 4)]
    save(mine, tmp_path / "mine", format="csv")
    for other in others:
        with pytest.raises(UnreadableFile, match="another dataset: content differ"):
            save(other, tmp_path / "mine", format="csv")
    assert load(save(mine, tmp_path / "mine", format="csv")) == mine
    save(others[0], tmp_path / "other", format="csv")
    foreign = (tmp_path / "other" / "shard-00000.csv").read_bytes()
    (tmp_path / "mine" / "shard-00000.csv").write_bytes(foreign)
    with pytest.raises(UnreadableFile, match=r"belongs to another dataset.*save the same dataset"):
        load(tmp_path / "mine")


def test_saving_is_complete_at_its_end_only(tmp_path: Path, monkeypatch: Any) -> None:
    """Interrupted, the folder says so; the same call ends it."""
    table = Dataset.of(np.arange(4.0)[:, None], ["a"])
    save(table, tmp_path, shard=2, format="csv")
    whole = contents(tmp_path)
    (tmp_path / "shard-00001.csv").unlink()

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(folders.Folder, "write", stop)
        with pytest.raises(KeyboardInterrupt):
            save(table, tmp_path, shard=2, format="csv")
    assert '"complete": false' in (tmp_path / "dataset.json").read_text()
    with pytest.raises(UnreadableFile, match="save the same dataset again to go on"):
        load(tmp_path)
    save(table, tmp_path, shard=2, format="csv")
    assert contents(tmp_path) == whole


def test_a_csv_row_that_was_cut_is_named(tmp_path: Path) -> None:
    """The message is ours: which row, and how many cells it has."""
    save(Dataset.of(np.ones((3, 2)), ["a", "b"]), tmp_path, format="csv")
    path = tmp_path / "shard-00000.csv"
    lines = path.read_text().splitlines()
    lines[3] = lines[3].rpartition(",")[0]
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(UnreadableFile, match=r"shard-00000\.csv.*row 2 has 5 cells, not 6"):
        load(tmp_path)
