"""What the documents show is true."""

from __future__ import annotations

import importlib.util
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from scm_world.errors import MissingExtra

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
    try:
        exec(compile(block, "document", "exec"), {"__name__": "document"})  # noqa: S102 # our own text
    except MissingExtra as missing:
        if missing.extra != "train":
            raise
        pytest.skip(str(missing))


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


EXAMPLES: dict[str, tuple[str, ...]] = {  # each with arguments that make it short
    "augmentation": ("24", "60"),
    "cartpole_swing_up": (),
    "curricula": (),
    "discovery": (),
    "environments": (),
    "evaluation": (),
    "grasping": (),
    "interventions": (),
    "learners": (),
    "new_family": (),
    "own_backend": ("1", "10"),
    "own_curriculum": ("4096",),
    "own_learner": (),
    "own_rl_learner": ("3",),
    "own_task": ("2",),
    "panda_reach": (),
    "predator_prey": ("10",),
    "recording": (),
    "sim_to_sim": ("sweep", "pushing", "2"),
    "train_and_evaluate": ("4096", "", "1"),
    "transfer_a_to_b": ("sweep", "pushing", "2"),
    "vector": (),
}
SHORT = (
    *("augmentation", "own_backend", "own_curriculum", "own_rl_learner", "own_task"),
    *("cartpole_swing_up", "panda_reach", "predator_prey"),
    *("sim_to_sim", "train_and_evaluate", "transfer_a_to_b"),
)
LEARNING = {"train_and_evaluate"}  # they need the extra "train", which few machines have
MODELS = {"panda_reach": "robosuite"}  # where the model comes from; importing it takes seconds


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_run(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Every example runs and prints something."""
    if name in LEARNING:
        pytest.importorskip("stable_baselines3")
    if name in MODELS and importlib.util.find_spec(MODELS[name]) is None:
        pytest.skip(f"{MODELS[name]} is not installed")
    runpy.run_path(str(ROOT / "examples" / f"{name}.py"))["main"](*EXAMPLES[name])
    assert capsys.readouterr().out


@pytest.mark.parametrize("name", SHORT)
def test_examples_of_training_are_short(name: str) -> None:
    """Each has fewer than 60 lines, so that it is read in one go."""
    assert len((ROOT / "examples" / f"{name}.py").read_text().splitlines()) < 60


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


@pytest.mark.parametrize(
    "name", ["scm_world", "scm_world.curricula", "scm_world.discovery", "scm_world.evaluation"]
)
def test_all_is_honest(name: str) -> None:
    """Every public name of a package exists, and is what its other spelling means."""
    package = importlib.import_module(name)
    found: dict[str, object] = {}
    exec(f"from {name} import *", found)  # noqa: S102 # our own text
    assert {*package.__all__} <= {*found} & {*dir(package)}
    assert all(getattr(package, public) is found[public] for public in package.__all__)
    assert not hasattr(package, "no_such_name")


def test_discovery_is_loaded_when_it_is_used() -> None:
    """Importing it loads no optional library, no engine and none of its own parts."""
    program = (
        "import sys, scm_world.discovery; "
        "heavy = {'pandas', 'pyarrow', 'scipy', 'matplotlib', 'numba', 'mujoco', 'pybullet', "
        "'gadjid', 'scm_world.world', 'scm_world.discovery.data'} & set(sys.modules); "
        "assert not heavy, heavy; "
        "from scm_world.discovery import collect, evaluate, learners, problem; "
        "assert learners.learners(); "
        "heavy = {'pandas', 'pyarrow', 'matplotlib', 'gadjid', 'causallearn'} & set(sys.modules); "
        "assert not heavy, heavy"
    )
    done = subprocess.run(  # noqa: S603 # our own text
        [sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
