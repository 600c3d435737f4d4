"""Facts about what an import costs."""

from __future__ import annotations

import subprocess
import sys

import pytest

ENGINES = {"mujoco", "pybullet"}
HEAVY = ENGINES | {"matplotlib", "scipy", "numba", "pandas", "torch"}


def imported(module: str) -> tuple[set[str], str]:
    """Import a module in a fresh process, with warnings as errors.

    Returns:
        The top-level packages that are loaded afterwards, and what was printed.
    """
    program = (
        f"import {module}, sys\nprint('#'.join({{name.partition('.')[0] for name in sys.modules}}))"
    )
    run = subprocess.run(  # noqa: S603 our own interpreter
        [sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, check=True
    )
    *printed, last = run.stdout.splitlines()
    return set(last.split("#")), "".join(printed) + run.stderr


@pytest.mark.parametrize("module", ["scm_world.variables", "scm_world.graph"])
def test_the_causal_column_imports_no_physics(module: str) -> None:
    """Variables and graphs could describe an economy: no engine, no compiler, no pictures."""
    loaded, printed = imported(module)
    assert not loaded & HEAVY
    assert printed == ""
