"""Saved datasets: their own order, their own folder, their own advice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world.discovery.data import Dataset, folders, load, save
from scm_world.errors import UnreadableFile

pytest.importorskip("pyarrow")


def contents(folder: Path) -> dict[str, bytes]:
    """Read every file of a folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_saving_keeps_the_order_of_episodes(tmp_path: Path) -> None:
    """Episodes that stand in another order than their numbers come back in it."""
    table = Dataset.of(np.arange(4.0)[:, None], ["a"], episode=[9, 9, 2, 5], step=[0, 4, 0, 0])
    assert load(save(table, tmp_path, shard=2)) == table


def test_another_dataset_is_not_saved_over(tmp_path: Path) -> None:
    """Of the same shape, with other numbers or other targets: refused, and nothing is lost."""
    rows = np.arange(4.0)[:, None]
    mine = Dataset.of(rows, ["a"])
    others = [Dataset.of(rows + 1.0, ["a"]), Dataset.of(rows, ["a"], targets=[("a",)] * 4)]
    save(mine, tmp_path / "mine")
    for other in others:
        with pytest.raises(UnreadableFile, match="another dataset: content differ"):
            save(other, tmp_path / "mine")
    assert load(save(mine, tmp_path / "mine")) == mine
    save(others[0], tmp_path / "other")
    foreign = (tmp_path / "other" / "shard-00000.parquet").read_bytes()
    (tmp_path / "mine" / "shard-00000.parquet").write_bytes(foreign)
    with pytest.raises(UnreadableFile, match=r"belongs to another dataset.*save the same dataset"):
        load(tmp_path / "mine")


def test_saving_is_complete_at_its_end_only(tmp_path: Path, monkeypatch: Any) -> None:
    """Interrupted, the folder says so; the same call ends it."""
    table = Dataset.of(np.arange(4.0)[:, None], ["a"])
    save(table, tmp_path, shard=2)
    whole = contents(tmp_path)
    (tmp_path / "shard-00001.parquet").unlink()

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(folders.Folder, "write", stop)
        with pytest.raises(KeyboardInterrupt):
            save(table, tmp_path, shard=2)
    assert '"complete": false' in (tmp_path / "dataset.json").read_text()
    with pytest.raises(UnreadableFile, match="save the same dataset again to go on"):
        load(tmp_path)
    save(table, tmp_path, shard=2)
    assert contents(tmp_path) == whole
