"""What is said while functions are compiled for the first time."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest
from numba import njit

from scm_world.world import kernels


def compiled(module: str) -> None:
    """Compile a new function of a module."""

    def function(x: float) -> float:
        return x + 1.0

    function.__module__ = module
    assert njit(function)(1.0) == 2.0


@pytest.mark.parametrize(("module", "times"), [("scm_world.geometry", 1), ("mine", 0)])
def test_a_long_compilation_is_said_once(
    module: str, times: int, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That of this package, which the cache spares later starts; functions of users are theirs."""
    monkeypatch.setattr(kernels, "LONG", 2)
    monkeypatch.setattr(kernels.COMPILING, "count", 0)
    for _ in range(3):
        compiled(module)
    said = [one for one in caplog.records if one.name == "scm_world"]
    assert len(said) == times
    assert all(one.levelno == logging.WARNING for one in said)


@pytest.mark.slow
def test_the_first_start_says_why_it_takes_long_and_later_ones_do_not(tmp_path: Path) -> None:
    """One line in the error output, none in the output; a warm cache says nothing."""
    make = "gymnasium.make('scm_world/Pushing-v0')"
    program = f"import gymnasium, scm_world; print({make}.reset()[0].shape)"
    for lines in (1, 0):
        done = subprocess.run(  # noqa: S603 # our own text
            [sys.executable, "-W", "error", "-c", program],
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout == "(56,)\n"
        assert len(done.stderr.splitlines()) == lines
