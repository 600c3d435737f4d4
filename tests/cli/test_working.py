"""Options that say where the work is done: the same ones for every command with shards."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from scm_world.cli import app
from scm_world.cli.working import Work
from scm_world.errors import UnknownOption
from scm_world.work.threads import cores

COLLECT = ("collect", "pushing", "--backend", "fake", "--steps", "1", "-n", "6", "--shard", "2")
EVALUATE = ("evaluate", "still", "--protocols", "P0", "-n", "2", "--backend", "fake")
SHORT = ("--env", "max_episode_length=2")
EXAM = ("discover", "er2:3", "--learner", "pooled", "--budget", "20", "--seeds", "1")
SWEEP = ("sweep", "pushing", "--backend", "fake", "--steps", "1", "-n", "2", "--over")
COMMANDS = {
    "collect": (*COLLECT, "--format", "csv"),
    "evaluate": (*EVALUATE, *SHORT, "--format", "csv"),
    "discover": EXAM,
    "sweep": (*SWEEP, "tool_block.mass=A:2", "--format", "csv"),
}


def call(*arguments: str) -> Result:
    """Run a command in this process."""
    return CliRunner().invoke(app, [*arguments])


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_say_where_they_work(command: str, tmp_path: Path) -> None:
    """In a line, with the engine that was asked for."""
    done = call(*COMMANDS[command], "--engine", "serial", "--out", str(tmp_path / "out"))
    assert done.exit_code == 0, done.output
    assert "the work is done in this process\n" in done.output


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (("--engine", "dask"), "no engine of work is named 'dask'"),
        (("--engine", "serial", "--workers", "2"), "workers of the engine 'serial'"),
        (("--address", "auto"), "'ray' has one"),
    ],
)
def test_commands_refuse_what_does_not_fit(
    command: str, wrong: tuple[str, ...], said: str, tmp_path: Path
) -> None:
    """In a line, with exit code 2; nothing was begun."""
    done = call(*COMMANDS[command], *wrong, "--out", str(tmp_path / "out"))
    assert done.exit_code == 2, done.output
    assert said in " ".join(done.output.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (("--engine", "ray"), "--engine cannot be 'ray'; it can be: serial, or left out"),
        (("--workers", "2"), "--workers cannot be 2; it can be: 1, or left out"),
        (("--address", "auto"), "--address cannot be 'auto'; it can be: left out"),
    ],
)
def test_experiments_of_one_graph_stay_here(
    wrong: tuple[str, ...], said: str, tmp_path: Path
) -> None:
    """Without --learner nothing is done elsewhere, and nobody is told that it is."""
    done = call("discover", "pushing", "--backend", "fake", *wrong, "--out", str(tmp_path / "out"))
    assert done.exit_code == 2, done.output
    assert f"{said}: discover without --learner works" in " ".join(done.output.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("command", "usual"),
    [("evaluate", "as many as there are cores"), ("collect", "1; with --engine")],
)
def test_help_tells_how_many_workers_there_are(command: str, usual: str) -> None:
    """An evaluation has all cores without being asked."""
    done = CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "400"})
    line = next(text for text in done.output.splitlines() if "--workers" in text)
    assert f"default: ({usual}" in line


def test_two_processes_write_what_one_does(tmp_path: Path) -> None:
    """The same files, byte for byte."""
    for name, workers in (("one", "1"), ("two", "2")):
        done = call(*COMMANDS["collect"], "--workers", workers, "--out", str(tmp_path / name))
        assert done.exit_code == 0, done.output
    assert "the work is done in 2 processes of this machine" in done.output
    one, two = (
        {path.name: path.read_bytes() for path in (tmp_path / name).iterdir()}
        for name in ("one", "two")
    )
    assert one == two
    assert len(one) == 4


def test_zero_workers_are_all_cores() -> None:
    """Without an engine none means one, with an engine all; a usual engine keeps the number."""
    with Work().begun() as executor:
        assert executor.where == "in this process"
    for work in (Work(engine="process"), Work(engine="process", workers=0)):
        with work.begun() as executor:
            assert executor.workers == cores()
    with Work().begun(usual="process") as executor:
        assert executor.where == "in 1 process of this machine"
    with Work(workers=0).begun(usual="process") as executor:
        assert executor.workers == cores()
    with pytest.raises(UnknownOption, match="workers"), Work(workers=-1).begun():
        pass
