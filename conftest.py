"""Tests run with one thread each; modules whose extra is not installed are not collected."""

import gc
import os
import sys
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

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
