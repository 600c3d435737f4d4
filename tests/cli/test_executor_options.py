"""Options of executors: the same ones for every command with independent episodes or runs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pandas
import pytest
from typer.testing import CliRunner, Result

from scm_world.cli.app import app
from scm_world.cli.options import Jobs
from scm_world.discovery import problem
from scm_world.errors import UnknownOption
from scm_world.runs.processes import cores

FAKE = ("--backend", "fake")
SHORT = ("--env", "max_episode_length=1", "--protocols", "P0")
COMMANDS = {
    "collect": ("collect", "reaching", *FAKE, "--steps", "1", "-n", "2"),
    "evaluate": ("evaluate", "still", *FAKE, *SHORT, "-n", "2"),
    "discover": ("discover", "er2:3", "--learner", "paired", "--budget", "20", "--seeds", "1"),
    "sweep": ("sweep", "reaching", *FAKE, "--steps", "1", "-n", "1", "--over", "gravity=A:2"),
}


def call(*arguments: str) -> Result:
    """Run a command in this process."""
    return CliRunner().invoke(app, [*arguments])


@pytest.mark.usefixtures("_undrawn")
@pytest.mark.parametrize("command", ["collect", "evaluate", "sweep"])
def test_commands_say_where_they_run(command: str) -> None:
    """In a line, with the executor that was asked for."""
    done = call(*COMMANDS[command], "--executor", "serial", "--out", "out")
    assert done.exit_code == 0, done.output
    assert "the work is done in this process\n" in done.output


@pytest.mark.usefixtures("in_this_process")
def test_failed_learners_are_printed_with_the_reason() -> None:
    """Below the tables, with the learner, the problem and how many runs it is."""
    lines = ("def broken(data, *, seed=0):", "    raise ValueError('no idea at all')", "")
    Path("learner_of_a_test.py").write_text("\n".join(lines))
    done = call(
        *("discover", "er2:4", "--learner=learner_of_a_test:broken", "--seeds=1", "--budget=4,5"),
        *("--executor=serial", "--out=failed"),
    )
    assert done.exit_code == 0, done.output
    said = " ".join(done.output.split())
    assert "the work is done in this process" in said
    assert "not done in 3 run(s): " in said
    assert "no idea at all" in said
    assert "er2:4: 4 variables" in said


@pytest.mark.usefixtures("drawn")
def test_the_command_of_the_guide_runs_its_learner() -> None:
    """The guide's function in a file of the present folder is benchmarked beside do_order."""
    text = (Path(__file__).parents[2] / "docs" / "guides" / "causality.md").read_text()
    block = next(b for b in re.findall(r"```python\n(.*?)```", text, re.S) if "def moves" in b)
    Path("mine.py").write_text("import numpy as np\n" + block.partition("\n\nfound =")[0])
    command = re.search(r"`scm-world (discover [^`]*mine\.py:moves[^`]*)`", text)
    assert command is not None
    done = call(*command[1].split(), "--budget=30,40", "--seeds=1", "--no-baselines", "--out=out")
    assert done.exit_code == 0, done.output
    frame = pandas.read_csv("out/results.csv")
    assert {*frame.status} == {"done"}
    assert "mine.py:moves" in {*frame.learner}
    wrong = call("discover", "er2:4", "--learner=mine.py:moved")
    assert wrong.exit_code == 2
    assert "did you mean 'moves'" in " ".join(wrong.output.split())


@pytest.mark.usefixtures("in_this_process")
def test_the_header_of_a_benchmark_is_about_all_seeds() -> None:
    """Each seed draws its own graph, so the title gives the fewest and the most edges."""
    given = ("--learner=do_order", "--budget=40", "--seeds=3", "--no-baselines", "--out=out")
    done = call("discover", "er2:6:1", *given)
    assert done.exit_code == 0, done.output
    truths = [problem("er2:6:1", seed=seed).truth for seed in range(3)]
    edges, hidden = ([len(getattr(t, of)) for t in truths] for of in ("edges", "confounded"))
    said = " ".join(done.output.split())
    assert len({*edges}) > 1
    assert f"6 variables, {min(edges)} to {max(edges)} true edges, {min(hidden)} to" in said


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (("--executor", "dask"), "'dask'"),
        (("--engine", "serial", "--workers", "2"), "'serial'"),
        (("--address", "auto"), "'ray' has one"),
    ],
)
def test_commands_refuse_what_does_not_fit(command: str, wrong: tuple[str, ...], said: str) -> None:
    """In a line, with exit code 2; nothing was begun."""
    done = call(*COMMANDS[command], *wrong, "--out", "out")
    assert done.exit_code == 2, done.output
    assert said in " ".join(done.output.split())
    assert not Path("out").exists()


@pytest.mark.parametrize(
    "wrong", [("--executor", "ray"), ("--workers", "2"), ("--address", "auto")]
)
def test_experiments_of_one_graph_stay_here(wrong: tuple[str, str]) -> None:
    """Without --learner there is one process, and nobody is told that there are more."""
    done = call("discover", "pushing", "--backend", "fake", *wrong, "--out", "out")
    assert done.exit_code == 2, done.output
    said = " ".join(done.output.split())
    assert f"{wrong[0]} cannot be" in said
    assert "discover without --learner runs in this process" in said
    assert not Path("out").exists()


@pytest.mark.parametrize(
    ("command", "usual"),
    [("evaluate", "as many as there are cores"), ("collect", "1; with --executor")],
)
def test_help_tells_how_many_workers_there_are(command: str, usual: str) -> None:
    """An evaluation has all cores without being asked."""
    done = CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "400"})
    line = next(text for text in done.output.splitlines() if "--workers" in text)
    assert f"default: ({usual}" in line


def test_zero_workers_are_all_cores() -> None:
    """Without an executor None means one, with one all."""

    def pool(executor: str | None, workers: int | None) -> Any:
        with Jobs(workers, executor).open("runs", Path("out"), "*", "runs") as job:
            return job["engine"]

    assert pool(None, None).where == "in this process"
    for workers in (None, 0):
        assert pool("process", workers).workers == cores()
    with pytest.raises(UnknownOption, match="workers"):
        pool(None, -1)
