"""Commands on a causal model without a backend, which a function of a file gives."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from scm_world.cli.app import app

FILE = """
import scm_world as sw
from scm_world.variables import Normal


def chain(weight=2.0):
    return sw.SCM([
        sw.Exogenous(name="x", distribution=Normal()),
        sw.Derived(name="y", parents=("x",), mechanism=sw.Linear(weights=(weight,)),
                   noise=Normal()),
    ])
"""


@pytest.fixture
def reference(tmp_path: Path) -> str:
    """Write the file."""
    (tmp_path / "chain.py").write_text(FILE)
    return f"{tmp_path / 'chain.py'}:chain"


@pytest.mark.parametrize(
    ("command", "report"),
    [
        (["discover", "--probes", "2"], "report.json"),
        (["verify", "--probes", "16"], "report.json"),
        (["effect", "y", "x=1", "--versus", "x=0", "-n", "5"], "effect.json"),
    ],
)
def test_commands_take_a_model_without_a_backend(
    reference: str, tmp_path: Path, command: list[str], report: str
) -> None:
    """Their reports are those of the functions."""
    name, *rest = command
    out = tmp_path / "out"
    found = CliRunner().invoke(app, [name, reference, *rest, "--out", str(out)])
    assert found.exit_code == 0, found.output
    data = json.loads((out / report).read_text())
    if name == "effect":
        assert data["mean"] == pytest.approx(2.0, abs=1e-12)
        assert data["engine"] == "equations"


def test_other_commands_say_what_they_take(reference: str) -> None:
    """Stepping needs a world."""
    found = CliRunner().invoke(app, ["do", reference, "x=1"])
    assert found.exit_code != 0
    assert "without a backend" in found.output
