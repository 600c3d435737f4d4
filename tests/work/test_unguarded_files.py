"""A main file without a guard: processes that read it cannot begin, which is told at once."""

from __future__ import annotations

import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
from work_samples import Bench, Task, make

from scm_world.errors import EngineFailure
from scm_world.work.executors import Processes
from scm_world.work.processes import Ended, Worker

UNGUARDED = """
import sys
from functools import partial
from pathlib import Path
from scm_world.work.executors import Processes

with Path(sys.argv[1]).open("a") as begun:
    begun.write("begun\\n")
if __name__ == "__mp_main__":
    raise SystemExit("no room for two")
with Processes(2) as executor:
    list(executor.run(partial(partial, pow, 2), range(50)))
"""


def test_a_file_without_a_guard_is_told(tmp_path: Path) -> None:
    """After one try, not after three of each job, and with what has to be done."""
    script, begun = tmp_path / "run.py", tmp_path / "begun"
    script.write_text(UNGUARDED)
    done = subprocess.run(  # noqa: S603 # our own
        [sys.executable, str(script), str(begun)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "EngineFailure: a process cannot begin: it ended with exit code 1" in done.stderr
    assert """under 'if __name__ == "__main__":'""" in done.stderr
    assert len(begun.read_text().split()) <= 1 + 2


def test_a_job_that_ends_its_process_is_no_such_thing(tmp_path: Path) -> None:
    """Even the first one of a process, with the same exit code: the others are done."""
    with Worker(Bench) as worker, pytest.raises(Ended, match="exit code 1") as caught:
        worker.ask("leave", 1)
    assert not caught.value.cannot_begin
    jobs = [Task(0, "die", tmp_path), Task(2), Task(3)]
    found: dict[int, int] = {}
    with Processes(1) as executor, pytest.raises(EngineFailure, match="tried 3 times"):
        found.update(executor.run(partial(make, None), jobs))
    assert found == {1: 4, 2: 9}
