"""What the documents show is true."""

from __future__ import annotations

import importlib.util
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from scm_world.cli.app import app
from scm_world.errors import MissingExtra
from scm_world.variables import Intervention, Variable

ROOT = Path(__file__).parent.parent
EXAMPLES_PAGE = ROOT / "docs" / "examples.md"
DOCUMENTS = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
BLOCK = re.compile(r"^```python\n(.*?)^```\n(?:\n```text\n(.*?)^```$)?", re.DOTALL | re.MULTILINE)
PROGRAMS = [path for path in DOCUMENTS if BLOCK.search(path.read_text())]


@pytest.fixture(autouse=True)
def _kinds() -> Iterator[None]:
    """Forget the kinds that a page declares, whose names other tests may use; close figures."""
    before = [(one.kinds, dict(one.kinds)) for one in (Intervention, Variable)]
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")
    for known, kept in before:
        known.clear()
        known.update(kept)


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: path.name)
def test_python_in_documents_runs(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The Python blocks of a page run in turn; a ``text`` block right after one is its output."""
    text, names, missing = path.read_text(), {"__name__": "document"}, None
    for found in BLOCK.finditer(text):
        block = "\n" * text[: found.start(1)].count("\n") + found[1]  # line numbers of the page
        try:
            exec(compile(block, str(path), "exec"), names)  # noqa: S102 # our own text
        except MissingExtra as error:
            if error.extra != "train":
                raise
            missing = str(error)
        printed = capsys.readouterr().out
        if found[2] is not None:
            assert printed == found[2]
    if missing is not None:
        pytest.skip(missing)


QUESTION = re.compile(r"^\| [^|]+\? \| `([^`]+)` \| \[", re.MULTILINE)


def test_calls_of_the_page_of_questions_run() -> None:
    """Each call of a row runs with the names of the page's program."""
    text = (ROOT / "docs" / "questions.md").read_text()
    names: dict[str, object] = {"__name__": "document"}
    for found in BLOCK.finditer(text):
        exec(found[1], names)  # noqa: S102 # our own text
    calls = QUESTION.findall(text)
    assert len(calls) == text.count("? | ") > 30
    for call in calls:
        assert eval(call, names) is not None, call  # noqa: S307 # our own text


NOTEBOOKS = ROOT / "docs" / "notebooks"


@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.ipynb")), ids=lambda path: path.stem)
def test_the_page_of_a_notebook_has_its_cells(path: Path) -> None:
    """The page has all cells in their order, which run above; the file for Colab, too."""
    build = runpy.run_path(str(NOTEBOOKS / "build.py"))
    text, page = path.with_suffix(".py").read_text(), path.with_suffix(".md").read_text()
    found = build["cells"](text)
    assert [body for is_text, body in found if not is_text] == [
        code[1].rstrip("\n") for code in BLOCK.finditer(page)
    ]
    places = [page.find(body) for is_text, body in found if is_text]
    assert -1 not in places
    assert places == sorted(places)
    assert path.read_text() == build["notebook"](text)
    assert text.count("plt.subplots(") == page.count(f"](../images/notebooks/{path.stem}-")


CONSOLE = re.compile(r"^```console\n(.*?)^```$", re.DOTALL | re.MULTILINE)
SHORT_COMMANDS: dict[str, dict[str, tuple[str, ...]]] = {  # numbers that make them short
    "agents.md": {
        "train": ("--steps=1024", "--set=trials.protocols=[]"),
        "evaluate zoo": ("-n", "4", "--env=max_episode_length=20", "--workers=1"),
    }
}


@pytest.mark.parametrize("name", SHORT_COMMANDS)
def test_commands_of_a_guide_run_one_after_another(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each ends without an error, and finds what those before it have written."""
    pytest.importorskip("stable_baselines3")
    pytest.importorskip("pybullet")
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs" / "guides" / name).read_text()
    lines = [line for found in CONSOLE.findall(text) for line in found.splitlines()]
    commands = [line.removeprefix("scm-world ") for line in lines if line.startswith("scm-world ")]
    assert len(commands) > 3
    for command in commands:
        more = [n for start, n in SHORT_COMMANDS[name].items() if command.startswith(start)]
        words = [*shlex.split(command), *(word for one in more for word in one)]
        done = CliRunner().invoke(app, words, catch_exceptions=False)
        assert done.exit_code == 0, (command, done.output)


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(path: Path) -> None:
    """Every relative link leads to a file; those of the site lead to files of the site."""
    text = path.read_text()
    for target in re.findall(r"\]\(([^)#]+)\)", text) + re.findall(r'src="([^"]+)"', text):
        if "://" not in target:
            found = (path.parent / target).resolve()
            assert found.exists(), target
            assert path.name == "README.md" or found.is_relative_to(ROOT / "docs"), target


def test_every_page_is_in_the_navigation_once() -> None:
    """``mkdocs.yml`` names every page of ``docs`` once, and no other."""
    named = re.findall(r"(\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    pages = (ROOT / "docs").rglob("*.md")
    assert sorted(named) == sorted(str(path.relative_to(ROOT / "docs")) for path in pages)


def test_texts_for_language_models_have_every_page_and_no_dead_link() -> None:
    """``llms.txt`` lists each page with a sentence; links of both files lead to files."""
    made = runpy.run_path(str(ROOT / ".ci" / "llms.py"))
    short, whole = made["texts"](made["pages"]())
    listed = re.findall(r"^- \[[^\]]+\]\((\S+)\): (?=[A-Z`]).+$", short, re.MULTILINE)
    pages = [path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")]
    assert sorted(listed) == sorted(pages)
    links = re.findall(r"\]\(([^)#]+)[^)]*\)|src=\"([^\"]+)\"", short + whole)
    inner = {one or other for one, other in links if "://" not in one + other}
    assert len(inner) > len(pages)
    assert [one for one in inner if not (ROOT / "docs" / one).exists()] == []
    assert not re.search(r"^--8<--|^:::", whole, re.MULTILINE)


def test_modules_of_the_reference_exist() -> None:
    """Every module that the reference documents can be imported."""
    pages = "".join(path.read_text() for path in (ROOT / "docs" / "reference").glob("*.md"))
    modules = re.findall(r"^::: (\S+)$", pages, re.MULTILINE)
    assert len(modules) > 10
    for module in modules:
        assert importlib.import_module(module).__file__, module  # a folder alone is no module


def test_every_example_is_shown() -> None:
    """The page of examples shows every file of the folder once."""
    shown = re.findall(r'^--8<-- "examples/(\w+)\.py"$', EXAMPLES_PAGE.read_text(), re.MULTILINE)
    assert sorted(shown) == sorted(path.stem for path in (ROOT / "examples").glob("*.py"))


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_extras_in_documents_exist(path: Path) -> None:
    """Every extra that a page installs is declared."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for extras in re.findall(r"pip install .*?\[([\w,-]+)\]", path.read_text()):
        assert set(extras.split(",")) <= project["optional-dependencies"].keys()


def test_the_readme_is_short() -> None:
    """It has at most 150 lines, and the first command is within the first screen."""
    lines = (ROOT / "README.md").read_text().splitlines()
    assert len(lines) <= 150
    assert "pip install . && scm-world discover pushing" in lines[:24]


def test_the_tables_of_variables_are_up_to_date() -> None:
    """``docs/variables.md`` is what ``.ci/variables.py`` writes."""
    page = runpy.run_path(str(ROOT / ".ci" / "variables.py"))["variables_page"]()
    assert (ROOT / "docs" / "variables.md").read_text() == page


EXAMPLES: dict[str, tuple[str, ...]] = {  # each with arguments that make it short
    "adaptation": ("cart", "--steps", "1600", "--episodes", "2", "--out", ""),
    "augmentation": ("24", "60"),
    "cartpole": (),
    "cartpole_swing_up": (),
    "curricula": (),
    "demonstrations": ("1", "10", "0", "2"),
    "discovery": (),
    "environments": (),
    "evaluation": (),
    "grasping": ("1",),
    "interventions": (),
    "lab_agents": ("0", "2"),
    "lab_chat": (),
    "learners": ("mujoco", "60"),
    "new_family": (),
    "own_backend": ("1", "10"),
    "own_curriculum": ("2048", "", "1"),
    "own_learner": (),
    "own_rl_learner": ("3",),
    "own_task": ("2",),
    "panda_reach": (),
    "predator_prey": ("10",),
    "recording": (),
    "representations": ("60", "1", "1"),
    "sim_to_sim": ("sweep", "pushing", "2"),
    "train_and_evaluate": ("1024", "", "1"),
    "transfer_a_to_b": ("sweep", "pushing", "2"),
    "vector": (),
}
SHORT = (
    *("augmentation", "own_backend", "own_curriculum", "own_rl_learner", "own_task"),
    *("cartpole", "cartpole_swing_up", "panda_reach", "predator_prey"),
    *("sim_to_sim", "train_and_evaluate", "transfer_a_to_b"),
)
LEARNING = {  # they need the extra "train", which few machines have
    "adaptation": ("sb3_contrib",),
    "train_and_evaluate": ("stable_baselines3",),
    "representations": ("torch", "sklearn", "pyarrow", "PIL"),
    "demonstrations": ("torch",),
}
MODELS = {"panda_reach": "robosuite"}  # where the model comes from; importing it takes seconds


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_run(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Every example runs and prints something."""
    for library in LEARNING.get(name, ()):
        pytest.importorskip(library)
    if name in MODELS and importlib.util.find_spec(MODELS[name]) is None:
        pytest.skip(f"{MODELS[name]} is not installed")
    runpy.run_path(str(ROOT / "examples" / f"{name}.py"))["main"](*EXAMPLES[name])
    assert capsys.readouterr().out


@pytest.mark.parametrize("name", SHORT)
def test_examples_of_training_are_short(name: str) -> None:
    """Each has at most 60 lines, so that it is read in one go."""
    assert len((ROOT / "examples" / f"{name}.py").read_text().splitlines()) <= 60


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


def test_discovery_loads_no_library_before_it_is_used() -> None:
    """``scm_world`` does not load it; loading it loads no optional library and no table."""
    program = (
        "import sys, scm_world; "
        "assert 'scm_world.discovery' not in sys.modules; "
        "from scm_world.discovery import collect, evaluate, learners, problem; "
        "assert learners.learners(); "
        "heavy = {'pandas', 'pyarrow', 'matplotlib', 'gadjid', 'causallearn', 'pybullet', "
        "'scipy.stats'}; "
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)"
    )
    done = subprocess.run(  # noqa: S603 # our own text
        [sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
