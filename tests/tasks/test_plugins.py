"""Installed packages add tasks, models, learners and backends by entry points."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import scm_world as sw
from scm_world import _plugins
from scm_world.backends import backends, make_backend
from scm_world.backends import known as known_backends
from scm_world.discovery.learners import baselines, learner, learners
from scm_world.errors import ModelError, UnknownOption
from scm_world.tasks import models, read_source, tasks
from scm_world.tasks.sources import is_causal, is_named

EXAMPLE = Path(__file__).parents[2] / "examples" / "plugin"
Install = Callable[..., None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Provide a function that installs a package with entry points, for this test."""

    def done(package: str, code: str, **groups: dict[str, str]) -> None:
        (tmp_path / f"{package}.py").write_text(code)
        about = tmp_path / f"{package}-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        sections = [
            "\n".join([f"[scm_world.{group}]", *(f"{name} = {at}" for name, at in entries.items())])
            for group, entries in groups.items()
        ]
        (about / "entry_points.txt").write_text("\n\n".join(sections) + "\n")
        _plugins.declared.cache_clear()

    before = {*sys.modules}
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr("scm_world.tasks.sources._REGISTERED", {})
    yield done
    _plugins.declared.cache_clear()
    for name in {*sys.modules} - before:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(str(tmp_path)):
            del sys.modules[name]


def test_the_example_is_found_once_it_is_installed(tmp_path: Path) -> None:
    """A wheel is built and unpacked; another process knows what it declares, by name."""
    pytest.importorskip("hatchling")
    build = ("-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path))
    subprocess.run([sys.executable, *build], cwd=EXAMPLE, check=True, capture_output=True)  # noqa: S603 # our own text
    (wheel,) = tmp_path.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    program = (
        "import sys, scm_world as sw; from scm_world.discovery.learners import learner; "
        "from scm_world.tasks import models, tasks; "
        "print('hang' in tasks(), 'rod' in models(), 'swinging' in sys.modules); "
        "found = learner('shifted'); "
        "world = sw.World('hang', backend='fake'); world.reset(seed=0); "
        "print(found.name, world.task.name, sw.World('rod', backend='fake').task.name, "
        "float(world['rod.mass']))"
    )
    path = os.pathsep.join((str(tmp_path / "site"), *filter(None, sys.path)))
    done = subprocess.run(  # noqa: S603 # our own text
        [sys.executable, "-c", program],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stderr == ""
    assert done.stdout == "True True False\nshifted hang rod 0.1\n"


def test_names_are_known_before_modules_are_imported(install: Install) -> None:
    """A look-up by name imports the module, and gives the object that it has."""
    code = (
        "from pathlib import Path\n"
        "import scm_world as sw\n"
        "from scm_world.tasks import Pushing\n"
        "class Mine(Pushing):\n    'One more.'\n    name = 'mine'\n"
        "def equations():\n    return sw.SCM([sw.Exogenous(name='x')])\n"
        "model, saved = equations(), Path('no_such.json')\n"
        "def nothing(data, *, seed=0):\n    'Find nothing.'\n"
    )
    named = {"mine": "lazy_one:Mine"}
    sources = {"law": "lazy_one:equations", "made": "lazy_one:model", "saved": "lazy_one:saved"}
    nothing = {"nothing": "lazy_one:nothing"}
    install("lazy_one", code, tasks=named, models=sources, learners=nothing)
    assert ("mine" in tasks(), "law" in models(), "nothing" in learners()) == (True, True, True)
    assert (len(models()), is_named("mine"), is_named("law"), is_named("la")) == (
        3,
        True,
        True,
        False,
    )
    assert "lazy_one" not in sys.modules
    assert tasks()["mine"].__name__ == "Mine"
    assert tuple(sw.World("law").model) == ("x",)
    assert tuple(read_source("made").made) == ("x",)  # type: ignore[arg-type] # an SCM
    assert (is_causal("made"), is_causal("law"), is_causal("mine")) == (True, False, False)
    assert learner("nothing").doc == "Find nothing."
    assert "nothing" not in baselines()
    with pytest.raises(sw.ScmWorldError, match=r"no_such\.json"):
        read_source("saved")
    with pytest.raises(UnknownOption, match=r"mine.*law"):
        read_source("minee")


@pytest.mark.parametrize(
    ("at", "said"),
    [
        ("broken_one:Missing", "AttributeError: module 'broken_one' has no attribute 'Missing'"),
        ("no_such_module:Task", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("broken_one:number", "3 is not a class derived from"),
        ("broken_one:Other", "the name of Other is 'other', not 'bad'"),
    ],
    ids=["attribute", "module", "number", "name"],
)
def test_what_fails_is_named_with_its_package(install: Install, at: str, said: str) -> None:
    """The error has the package, the entry point and the cause; other names work."""
    code = (
        "from scm_world.tasks import Pushing\nnumber = 3\n"
        "class Other(Pushing):\n    'Another.'\n    name = 'other'\n"
        "class Good(Pushing):\n    'Fine.'\n    name = 'good'\n"
    )
    install("broken_one", code, tasks={"bad": at, "good": "broken_one:Good"})
    with pytest.raises(ModelError, match=r"the package 'broken_one' declares 'bad'") as found:
        tasks()["bad"]
    assert f"{at!r} fails: {said}" in str(found.value)
    listed = tasks().described(lambda kind: str(kind.__doc__))
    assert listed["bad"].startswith(f"not available: {found.value}")
    assert listed["good"] == "Fine. (package broken_one)"


def test_a_name_belongs_to_one_package(install: Install) -> None:
    """Two packages with one name are refused; names of this package are never taken over."""
    for package in ("first_one", "second_one"):
        install(package, "", models={"arm": "a:b"}, tasks={"pushing": "a:b"})
    with pytest.raises(ModelError, match=r"\w+_one and \w+_one declare 'arm'; uninstall all but"):
        read_source("arm")
    assert tasks()["pushing"] is sw.make_task("pushing").__class__
    assert "which is not used: the name was taken" in tasks().described(lambda _: "")["pushing"]


def test_backends_and_learners_of_other_kinds_are_refused(install: Install) -> None:
    """An object that is no backend, learner or model is named."""
    code = "from scm_world.backends.fake import FakeBackend\n"
    entries = {"wrong": "math:pi"}
    engines = {**entries, "declared": "engine_one:FakeBackend"}
    install("engine_one", code, backends=engines, learners=entries, models=entries)
    assert {"declared", "wrong"} <= {*backends()}
    assert make_backend("declared").name == "fake"
    with pytest.raises(ModelError, match=r"'engine_one' .*does not make a Backend for 'wrong'"):
        make_backend("wrong")
    with pytest.raises(ModelError, match=r"'engine_one' .*a Learner or a function"):
        learner("wrong")
    with pytest.raises(ModelError, match=r"'engine_one' .*a file, a text, a function or an SCM"):
        sw.World("wrong")
    with pytest.raises(UnknownOption, match="declared"):
        make_backend("declare")
    assert known_backends()["declared"]().name == "fake"
