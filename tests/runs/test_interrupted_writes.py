"""Jobs that are interrupted while they write: what is there is whole, and the same call goes on."""

from __future__ import annotations

import errno
import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import textwrap
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import scm_world as sw
from scm_world.discovery import discover
from scm_world.discovery.data import Design, collect, sweep
from scm_world.errors import UnreadableFile, UnwritableFolder
from scm_world.runs import files
from scm_world.runs.processes import THREADS, Worker, single_threaded
from scm_world.variables import Box, Derived, Exogenous, Linear, Normal

MODEL = sw.SCM(
    [
        Exogenous(name="a", distribution=Normal(), a=Box(-1.0, 1.0)),
        Derived(name="b", parents=("a",), mechanism=Linear(weights=(2.0,))),
    ]
)
DESIGN = Design("single", ("a",), observational_fraction=0.5)

JOBS: dict[str, Callable[[Path], object]] = {
    "collect": lambda out: collect(MODEL, DESIGN, 6, shard=2, out=out),
    "sweep": lambda out: sweep(MODEL, {"a": [0.0, 1.0]}, n=3, shard=2, out=out),
    "discover": lambda out: discover(MODEL, probes=3, checkpoint=out),
}
SIGNALS = (signal.SIGKILL, signal.SIGINT, signal.SIGTERM)


def contents(folder: Path) -> dict[str, bytes]:
    """Return all files of a folder by their names, drafts of other processes too."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def forked(work: Callable[[], object]) -> int:
    """Do work in a fork of this process; return its exit code, or minus the signal that ends it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forks of several threads
        child = os.fork()
    if not child:
        code = 1
        try:
            work()
            code = 0
        except KeyboardInterrupt:
            code = 2
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def interrupted(job: Callable[[], object], at: int, sent: signal.Signals) -> int:
    """Do a job in a fork that gets a signal when half of its write number ``at`` is on the disk."""
    flush, count = os.fsync, [0]

    def fsync(handle: int) -> None:
        if count[0] == at:
            os.ftruncate(handle, os.fstat(handle).st_size // 2)
            os.kill(os.getpid(), sent)
            time.sleep(0.05)  # Python handles the signal before the next instruction
        count[0] += 1
        flush(handle)

    def work() -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        files.os.fsync = fsync  # type: ignore[assignment]
        job()

    return forked(work)


@pytest.mark.parametrize("sent", SIGNALS[:2])  # SIGTERM ends a process as SIGKILL does
@pytest.mark.parametrize("name", JOBS)
def test_an_interrupted_write_leaves_whole_files(
    name: str, sent: signal.Signals, tmp_path: Path
) -> None:
    """At every write of a job: each file is absent or as in an uninterrupted job.

    The same call makes the files of an uninterrupted one, byte for byte, and leaves no draft.
    """
    job = JOBS[name]
    job(tmp_path / "whole")
    whole = contents(tmp_path / "whole")
    for at in range(len(whole)):
        out = tmp_path / f"{at}"
        ended = interrupted(lambda out=out: job(out), at, sent)
        if name == "discover" and sent == signal.SIGINT and ended == 0:
            assert len(contents(out)) > 1  # it reports the probes that are finished
        else:
            assert ended == (2 if sent == signal.SIGINT else -sent)
        left = contents(out)
        drafts = {path for path in left if path.endswith(files.DRAFT)}
        assert len(drafts) == (sent != signal.SIGINT)
        assert {path: left[path] for path in left if path not in drafts}.items() <= whole.items()
        job(out)
        assert contents(out) == whole


@pytest.mark.parametrize("name", JOBS)
def test_a_disk_that_fills_in_the_middle_loses_nothing(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever write fails: the error says so, and with room the same call goes on."""
    job, flush = JOBS[name], os.fsync
    job(tmp_path / "whole")
    whole = contents(tmp_path / "whole")
    for at in range(len(whole)):
        left = [at]

        def fsync(handle: int, left: list[int] = left) -> None:
            left[0] -= 1
            if left[0] < 0:
                raise OSError(errno.ENOSPC, "No space left on device")
            flush(handle)

        out = tmp_path / f"{at}"
        with monkeypatch.context() as full:
            full.setattr(files.os, "fsync", fsync)
            with pytest.raises(UnwritableFolder, match=r"No space left.*the same call goes on"):
                job(out)
        assert contents(out).items() <= whole.items()
        job(out)
        assert contents(out) == whole


def test_a_write_that_the_system_cuts_is_no_file(tmp_path: Path) -> None:
    """With a limit on the size of files, a write fails after some of its bytes."""
    whole = contents(tmp_path / "whole") if JOBS["collect"](tmp_path / "whole") else {}
    largest = max(map(len, whole.values()))

    def work() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest - 1, resource.RLIM_INFINITY))
        with pytest.raises(UnwritableFolder, match="File too large"):
            JOBS["collect"](tmp_path / "cut")

    assert forked(work) == 0
    assert contents(tmp_path / "cut").items() < whole.items()
    JOBS["collect"](tmp_path / "cut")
    assert contents(tmp_path / "cut") == whole


# --- threads, fork and spawn ----------------------------------------------------------------------


def test_jobs_in_threads_write_what_one_writes(tmp_path: Path) -> None:
    """In folders of their own; of two in the same folder one may be refused, and nothing mixes."""
    JOBS["collect"](tmp_path / "whole")
    refused: list[str] = []

    def run(out: Path) -> None:
        try:
            JOBS["collect"](out)
        except UnreadableFile as error:
            refused.append(str(error))

    outs = [tmp_path / name for name in ("a", "b", "c", "c", "c")]
    threads = [threading.Thread(target=run, args=(out,)) for out in outs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all("another process is writing" in said for said in refused)
    assert len(refused) <= 2
    for name in "abc":
        assert contents(tmp_path / name) == contents(tmp_path / "whole")


def test_threads_that_overlap_leave_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first that begins ends first: the second one still has its limit, and then it is gone."""
    monkeypatch.setenv(THREADS[0], "3")
    monkeypatch.delenv(THREADS[1], raising=False)
    one, other = single_threaded(), single_threaded()
    one.__enter__()
    other.__enter__()
    one.__exit__(None, None, None)
    assert [os.environ.get(name) for name in THREADS[:2]] == ["1", "1"]
    other.__exit__(None, None, None)
    assert [os.environ.get(name) for name in THREADS[:2]] == ["3", None]


def test_a_fork_leaves_the_workers_of_its_parent() -> None:
    """Closing a copy of a worker ends nothing."""
    worker = Worker(pow)
    assert worker.ask(2, 3, timeout=60.0) == 8
    assert forked(worker.close) == 0
    assert worker.ask(2, 4, timeout=60.0) == 16
    worker.close()


@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_a_process_of_any_kind_writes_the_same(method: str, tmp_path: Path) -> None:
    """A job in a fork, or in a new process, makes the same files."""
    JOBS["collect"](tmp_path / "whole")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        context: Any = multiprocessing.get_context(method)
        process = context.Process(target=_collect, args=(tmp_path / "out",))
        process.start()
    process.join(120.0)
    assert process.exitcode == 0
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def _collect(out: Path) -> None:
    JOBS["collect"](out)


# --- whole jobs in processes of their own --------------------------------------------------------

PROGRAMS = {
    "collect": "data.collect(world, design, 400, steps=20, shard=2, out=out)",
    "sweep": "data.sweep(world, {'floor_friction': [.3, .6]}, n=200, steps=20, shard=2, out=out)",
    "discover": "sw.discover(world, probes=12, checkpoint=out)",
    "train": "loop.train(recipe('reaching', worlds=2, steps=8192, n_steps=64), out=out)",
}
HEAD = """
import sys
from pathlib import Path
import scm_world as sw
from scm_world.discovery import data
from scm_world.training import loop
from scm_world.training.recipe import recipe
out = Path(sys.argv[1])
world = sw.World("pushing")
design = data.Design("single", ("floor_friction",))
print("begun", flush=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize("sent", SIGNALS)
@pytest.mark.parametrize("name", PROGRAMS)
def test_a_slow_job_goes_on_after_any_moment(
    name: str, sent: signal.Signals, tmp_path: Path
) -> None:
    """Interrupted five times at different moments, and then left alone: the files of one run."""
    if name == "train":
        pytest.importorskip("stable_baselines3")
    program = textwrap.dedent(HEAD) + PROGRAMS[name]

    def started(out: Path) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", program, str(out)]
        how: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        return subprocess.Popen(command, **how)  # noqa: S603 # ours

    process = started(tmp_path / "whole")
    assert process.stdout is not None
    process.stdout.readline()
    began = time.monotonic()
    assert process.communicate()[1] is not None
    assert process.returncode == 0
    lasts, hits = time.monotonic() - began, 0
    for moment in (0.1, 0.15, 0.2, 0.25, 0.3):
        process = started(tmp_path / "parts")
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(moment * lasts)
        hits += process.poll() is None
        process.send_signal(sent)
        process.communicate()
    assert hits >= 3
    process = started(tmp_path / "parts")
    said = process.communicate()[1]
    assert process.returncode == 0, said
    whole, parts = (contents(tmp_path / which) for which in ("whole", "parts"))
    if name == "train":  # curves and checkpoints tell of the interruptions
        assert "policy.safetensors" in parts
        assert not [path for path in parts if path.endswith(files.DRAFT)]
    else:
        assert parts == whole
