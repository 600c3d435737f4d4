"""What the documents show is true."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
DOCUMENTS = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
BLOCKS = [
    pytest.param(block, id=f"{path.name}-{number}")
    for path in DOCUMENTS
    for number, block in enumerate(re.findall(r"```python\n(.*?)```", path.read_text(), re.DOTALL))
]


@pytest.mark.parametrize("block", BLOCKS)
def test_python_in_documents_runs(block: str) -> None:
    """Every Python block of the README and the docs runs as it stands."""
    exec(compile(block, "document", "exec"), {"__name__": "document"})  # noqa: S102 # our own text


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(path: Path) -> None:
    """Every relative link of a document points to a file that exists."""
    for target in re.findall(r"\]\(([^)#]+)\)", path.read_text()):
        if "://" not in target:
            assert (path.parent / target).exists(), target


def test_the_tables_of_variables_are_up_to_date() -> None:
    """``docs/variables.md`` is what ``scm-world variables all --markdown`` writes."""
    from scm_world.cli.variables import markdown

    assert (ROOT / "docs" / "variables.md").read_text() == markdown()


@pytest.mark.parametrize("name", ["interventions", "discovery", "environments", "new_family"])
def test_examples_run(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Every example runs and prints something."""
    runpy.run_path(str(ROOT / "examples" / f"{name}.py"))["main"]()
    assert capsys.readouterr().out


def test_import_is_silent_and_light() -> None:
    """Importing the package prints nothing, warns of nothing and loads no engine."""
    program = (
        "import sys, scm_world; "
        "heavy = {'mujoco', 'pybullet', 'numba', 'matplotlib', 'scipy'} & set(sys.modules); "
        "assert not heavy, heavy"
    )
    done = subprocess.run(  # noqa: S603 # our own text
        [sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_all_is_honest() -> None:
    """Every public name of the package exists."""
    import scm_world

    assert all(getattr(scm_world, name) is not None for name in scm_world.__all__)
    assert not hasattr(scm_world, "no_such_name")
