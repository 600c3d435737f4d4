"""Every test of a command runs in an empty folder, on a terminal that is none."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run where nothing is lost."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # files beside a module are its results
    for name in ("FORCE_COLOR", "COLUMNS", "TTY_COMPATIBLE", "GITHUB_ACTIONS"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def drawn() -> None:
    """Render figures, in a test that looks at one or that runs a whole command."""


@pytest.fixture(autouse=True)
def _rendered_or_not(request: pytest.FixtureRequest) -> None:
    if "drawn" not in request.fixturenames:
        request.getfixturevalue("sketched")


@pytest.fixture
def _undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw nothing, where a test is about something else."""
    from scm_world.evaluation import figures

    def nothing(*_: Any, **__: Any) -> tuple[()]:
        return ()

    monkeypatch.setattr(figures, "write_figures", nothing)
