"""Results in stores: the same bytes as in a folder, also after interruptions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from stores import MemoryFileSystem, everything, fresh, refuse

from scm_world.discovery import discover
from scm_world.discovery.benchmarks import benchmark
from scm_world.discovery.data import Dataset, Design, collect, load, save
from scm_world.errors import UnreadableFile, UnwritableFolder
from scm_world.evaluation import Evaluation, evaluate
from scm_world.evaluation.figures import write_figures
from scm_world.evaluation.recording import Recording
from scm_world.queries import World
from scm_world.runs.files import Location

HOW: dict[str, Any] = {"n": 60, "backend": "fake", "env": {"max_episode_length": 3}}
DESIGN = Design(
    "half", ("tool_block.mass", "floor_friction", "gravity"), observational_fraction=0.3
)


def below(folder: Path) -> dict[str, bytes]:
    """Read all files below a folder of this machine."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def stop_at(number: int) -> Any:
    """Interrupt once so many are done."""

    def told(done: int, _: int) -> None:
        if done >= number:
            raise KeyboardInterrupt

    return told


def evaluated(out: Path | str, *, drawn: bool = False, **more: Any) -> Evaluation:
    """Evaluate, and write the results; plots take longer."""
    found = evaluate({"one": "still", "other": "random"}, "P0,P5", out=out, **HOW, **more)
    found.save(out)
    if drawn:
        write_figures(found, out)
    return found


def collected(out: Path | str, n: int = 10, **more: Any) -> Dataset:
    """Collect some episodes, four in a file."""
    world = World("pushing", backend="fake")
    options: dict[str, Any] = {"steps": 2, "seed": 5, "shard": 4}
    return collect(world, DESIGN, n, out=out, **options, **more)


# --- the same bytes -------------------------------------------------------------------------------


def test_an_evaluation_is_the_same_in_a_store(tmp_path: Path) -> None:
    """Interrupted, gone on with, and saved: every file is that of a folder, and is read back."""
    local, folder = evaluated(tmp_path, drawn=True), fresh()
    with pytest.raises(KeyboardInterrupt):
        evaluated(str(folder), progress=stop_at(100))
    safe = everything(folder)
    assert 0 < len(safe) < len(below(tmp_path / "parts"))
    assert evaluated(str(folder), drawn=True) == local
    assert everything(folder) == below(tmp_path)
    assert Evaluation.load(str(folder)) == Evaluation.load(f"{folder}/results.json") == local
    assert Evaluation.load(f"file://{tmp_path}") == local


def test_a_dataset_is_the_same_in_a_store(tmp_path: Path) -> None:
    """Interrupted, gone on with, and made larger: every file is that of a folder."""
    local, folder = collected(tmp_path / "local"), fresh()
    with pytest.raises(KeyboardInterrupt):
        collected(str(folder), progress=stop_at(4))
    assert "shard-00001.parquet" not in everything(folder)
    assert len(load(str(folder), partial=True)) == 4
    assert collected(str(folder)) == local == load(str(folder))
    assert everything(folder) == below(tmp_path / "local")
    collected(tmp_path / "local", 13)
    collected(str(folder), 13)
    assert everything(folder) == below(tmp_path / "local")


def test_a_url_of_this_machine_is_a_folder(tmp_path: Path) -> None:
    """The same files are in it, with the same lock."""
    collected(tmp_path / "path")
    collected(f"file://{tmp_path}/url")
    assert below(tmp_path / "url") == below(tmp_path / "path")


def test_a_saved_dataset_is_the_same_in_a_store(tmp_path: Path) -> None:
    """And nothing is saved over it."""
    table, folder = collected(tmp_path / "whole"), fresh()
    save(table, tmp_path / "saved")
    assert str(save(table, str(folder))) == str(folder)
    assert everything(folder) == below(tmp_path / "saved")
    with pytest.raises(UnreadableFile, match=r"memory://.* not empty"):
        save(table.first(3), str(folder))


@pytest.mark.usefixtures("in_this_process")
def test_a_benchmark_resumes_from_a_store() -> None:
    """Run once, it is only read the second time; tables, pictures and report are there."""
    asked: Any = {"budgets": [40, 80], "seeds": 1, "standardised": False}
    folder = fresh()
    done = benchmark(["do_order"], ["er2:4"], **asked, out=str(folder))
    first = everything(folder)
    again = benchmark(["do_order"], ["er2:4"], **asked, out=str(folder))
    assert [run.as_dict() for run in again.runs] == [run.as_dict() for run in done.runs]
    assert everything(folder) == first
    assert sum(name.startswith("runs/") for name in first) == 2
    files = {"budget.png", "comparison.csv", "results.csv", "study.json"}
    assert {name for name in first if "/" not in name} == files
    with pytest.raises(UnreadableFile, match="another benchmark; these differ: seeds"):
        benchmark(["do_order"], ["er2:4"], **{**asked, "seeds": 2}, out=str(folder))


def test_a_discovery_goes_on_from_a_store() -> None:
    """What is found is the same."""
    folder = fresh() / "probes"
    whole = discover("reaching", probes=2, backend="fake")
    world = World("reaching", backend="fake")
    discover(world, probes=1, checkpoint=str(folder))
    assert set(everything(folder)) == {"study.json", "probe-0.json"}
    assert set(discover(world, probes=2, checkpoint=folder).found) == set(whole.found)


def test_a_recording_is_read_from_a_store() -> None:
    """It is a file like any other."""
    pytest.importorskip("pyarrow")
    import gymnasium

    from scm_world.evaluation.recording import record

    env = gymnasium.make("scm_world/Reaching-v0", backend="fake", max_episode_length=3)
    file = fresh() / "episodes.parquet"
    made = record("random", env, 2, out=str(file))
    env.close()
    assert len(Recording.load(str(file))) == len(made) == 2


# --- faults ---------------------------------------------------------------------------------------


def spoil(folder: Location, pattern: str) -> str:
    """Cut the end of a file off; give its name."""
    file = next(folder.glob(pattern))
    file.write_bytes(file.read_bytes()[:-9])
    return file.name


def test_damaged_objects_are_named() -> None:
    """The error says which, and what to do; nothing else is touched."""
    folder, data = fresh(), fresh()
    evaluated(str(folder))
    part = spoil(folder, "parts/*.json")
    with pytest.raises(UnreadableFile, match=rf"memory://.*{part}.*delete this file"):
        evaluated(str(folder))
    spoil(folder, "results.json")
    with pytest.raises(UnreadableFile, match=r"memory://.*results\.json"):
        Evaluation.load(str(folder))
    collected(str(data))
    shard = spoil(data, "shard-00001.parquet")
    with pytest.raises(UnreadableFile, match=rf"{shard}.*delete it, and collect again"):
        load(str(data))
    (data / shard).unlink()
    assert collected(str(data)) == load(str(data))


def test_nothing_is_done_where_nobody_may_write(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error comes before the first episode."""
    told: list[int] = []
    monkeypatch.setattr(MemoryFileSystem, "mkdir", refuse)
    monkeypatch.setattr(MemoryFileSystem, "pipe_file", refuse)
    monkeypatch.setattr(MemoryFileSystem, "_open", refuse)
    for do in (evaluated, collected):
        with pytest.raises(UnwritableFolder, match=r"memory://.*Access Denied"):
            do(str(fresh()), progress=lambda done, _: told.append(done))
    assert not any(told)


def test_there_is_nothing_to_read() -> None:
    """The error names the URL."""
    with pytest.raises(UnreadableFile, match=r"memory://.*cannot be read"):
        Evaluation.load(str(fresh()))
    with pytest.raises(UnreadableFile, match=r"memory://.*study\.json"):
        load(str(fresh()))
