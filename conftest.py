"""Tests run with one thread each; modules whose extra is not installed are not collected."""

import gc
import multiprocessing
import os
import sys
from collections import deque
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from types import SimpleNamespace
from typing import Any
from weakref import WeakValueDictionary

import pytest

# Before numpy is imported: threads of its BLAS in several workers mostly wait for one another.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
# Tests start a hundred processes that import the package: only the first compiles it. And pytest
# takes ten seconds to rewrite the assertions of all tests, if it may not keep what it wrote.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

NEEDS = {
    "stable_baselines3": ["scm_world/training/algorithms.py", "scm_world/training/sb3.py"],
    "rsl_rl": ["scm_world/training/many.py"],
    "starlette": ["scm_world/studio/server.py"],
    "mujoco_warp": ["scm_world/backends/warp"],
}

collect_ignore = [path for name, paths in NEEDS.items() if not find_spec(name) for path in paths]


def pytest_collection_finish() -> None:
    """Let the garbage collector pass over what all tests share: a twentieth of their time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000)  # what dies in cycles may stay a while


class Staying(WeakValueDictionary[Any, Any]):
    """Keeps the last structures that were compiled, as worlds that stay open would."""

    def __init__(self) -> None:
        super().__init__()
        self._last = deque[Any](maxlen=24)

    def __setitem__(self, key: Any, value: Any) -> None:
        super().__setitem__(key, value)
        self._last.append(value)


@pytest.fixture(scope="session", autouse=True)
def _made_once() -> None:
    """Compile a task, and build the parser of the commands, once for many tests."""
    import typer.testing

    from scm_world.world import structures

    structures._ALIVE = Staying()
    typer.testing._get_command = cache(typer.testing._get_command)


PRELOADED = ("scm_world.discovery.benchmarks", "scm_world.evaluation", "scm_world.world", "mujoco")


@pytest.fixture(scope="session", autouse=True)
def _forked() -> None:
    """Fork processes from one that has imported the package, which takes each of them a second.

    ``tests/runs/test_pool.py``, and programs that tests start, start them as users do.
    """
    from scm_world.runs import processes

    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload([*PRELOADED])
    alike = {"get_context": lambda _: server, "parent_process": multiprocessing.parent_process}
    processes.multiprocessing = SimpleNamespace(**alike)  # type: ignore[assignment]


class Here:
    """Does the jobs of a benchmark in this process, as ``Worker`` does them in another one."""

    def __init__(self, work: Callable[..., Any]) -> None:
        self._work = work

    def ask(self, *job: Any, timeout: float | None = None) -> Any:
        """Do a job."""
        return self._work(*job)

    def close(self) -> None:
        """Close nothing."""


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Start no process for a benchmark, which takes two seconds, where a test is not about it."""
    monkeypatch.setattr("scm_world.discovery.benchmarks.Worker", Here)


@pytest.fixture
def sketched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write a file, but render no figure, where a test is not about what it shows."""
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", _unrendered)


def _unrendered(figure: Any, made: Any, **_: Any) -> None:
    made.write(b"\x89PNG")
