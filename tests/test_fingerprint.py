"""Fingerprints: what makes two systems different, and what does not."""

from __future__ import annotations

import functools
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from scipy import stats

import scm_world as sw
from scm_world._fingerprint import changes, differing, fingerprint

SOURCE = '''
import functools
import math
import numpy as np
import constants

GAIN = 2.0
TABLE = {"a": np.arange(3.0), "b": [1, (2, 3)]}
WORDS = {"one", "two", ("three", 4)}


def helper(x):
    return GAIN * x


@functools.lru_cache
def cached(x):
    return x + 1


class Law:
    power = 2

    def __init__(self, offset):
        self.offset = offset

    @functools.cached_property
    def costly(self):
        return 7

    def __call__(self, x):
        return self.offset + x**self.power


def make(shift):
    def law(x, scale=1.5, *, bias=0.0):
        """Say something."""
        part = lambda y: y + shift  # noqa: E731
        return helper(part(x)) * scale + bias + TABLE["a"][0] + math.pi * constants.RATE + cached(x)

    return law


law = make(1.0)
system = {
    "function": law,
    "object": Law(3.0),
    "method": Law(3.0).__call__,
    "partial": functools.partial(law, bias=2.0),
    "data": (TABLE, WORDS, float("nan"), np.float32(1.5)),
}
'''
CONSTANTS = "RATE = 5.0\n\n\ndef unused():\n    return 1\n"
SCRIPT = """
import json, sys
sys.path.insert(0, sys.argv[1])
import user_system
from scm_world._fingerprint import fingerprint
print(json.dumps(fingerprint(user_system.system)))
"""


def prints(folder: Path, source: str = SOURCE, constants: str = CONSTANTS, seed: str = "0") -> Any:
    """Return the fingerprint of the system that is written into a folder, in a new process."""
    import json

    folder.mkdir(exist_ok=True)
    (folder / "user_system.py").write_text(source)
    (folder / "constants.py").write_text(constants)
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-B", "-c", SCRIPT, str(folder)],
        capture_output=True,
        text=True,
        check=True,
        env={"PYTHONHASHSEED": seed, "PYTHONPATH": ":".join(sys.path)},
    )
    return json.loads(done.stdout)


def test_it_is_the_same_in_any_process_and_folder(tmp_path: Path) -> None:
    """Neither the order of sets, nor the place of a file, lines, comments and docstrings count."""
    one = prints(tmp_path / "one", seed="1")
    moved = SOURCE.replace("def helper", "# a comment\n\n\ndef helper")
    moved = moved.replace("Say something.", "Say something else.")
    assert prints(tmp_path / "two", moved, seed="2") == one
    assert list(one) == ["function", "object", "method", "partial", "data"]


CHANGES = [
    ("GAIN = 2.0", "GAIN = 2.5", ["function", "partial"]),
    ("return GAIN * x", "return GAIN + x", ["function", "partial"]),
    ("make(1.0)", "make(1.5)", ["function", "partial"]),
    ("scale=1.5", "scale=1.25", ["function", "partial"]),
    ("bias=0.0", "bias=0.5", ["function", "partial"]),
    ("y + shift", "y - shift", ["function", "partial"]),
    ("return x + 1", "return x + 2", ["function", "partial"]),
    ("power = 2", "power = 3", ["object", "method"]),
    ("self.offset + x", "self.offset - x", ["object", "method"]),
    ("Law(3.0),", "Law(4.0),", ["object"]),
    ("bias=2.0", "bias=2.5", ["partial"]),
    ("np.arange(3.0)", "np.arange(4.0)", ["function", "partial", "data"]),
    ('"two", ', '"too", ', ["data"]),
    ("np.float32(1.5)", "np.float64(1.5)", ["data"]),
]


@pytest.fixture(scope="module")
def unchanged(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Give the fingerprints of the source as it is."""
    return prints(tmp_path_factory.mktemp("unchanged"))


@pytest.mark.parametrize(("old", "new", "parts"), CHANGES, ids=[new for _, new, _ in CHANGES])
def test_a_change_is_named(
    tmp_path: Path, unchanged: dict[str, str], old: str, new: str, parts: list[str]
) -> None:
    """Code, constants, defaults, closures, globals and attributes count, and nothing else does."""
    assert old in SOURCE
    assert differing(unchanged, prints(tmp_path, SOURCE.replace(old, new))) == parts


def test_modules_of_the_project_count_by_what_is_used(tmp_path: Path) -> None:
    """A constant of an imported module counts; a function of it that nobody calls does not."""
    one = prints(tmp_path)
    assert differing(one, prints(tmp_path, constants=CONSTANTS.replace("5.0", "6.0"))) == [
        "function",
        "partial",
    ]
    assert prints(tmp_path, constants=CONSTANTS.replace("return 1", "return 2")) == one


DOTTED = """
import a.b
import a.inner.c as c

def dotted(x):
    return a.b.law(x)

def renamed(x):
    return c.law(x)

def enclosed(module):
    return lambda x: module.b.law(x)

system = {"dotted": dotted, "renamed": renamed, "closure": enclosed(a)}
"""


@pytest.mark.parametrize(
    ("file", "new", "parts"),
    [
        ("a/b.py", "import a\n\ndef law(x):\n    return x + 2\n", ["dotted", "closure"]),
        ("a/b.py", "import a\n\ndef law(x):\n    return x + 1\n\ndef other(): pass\n", []),
        ("a/inner/c.py", "def law(x):\n    return x + 2\n", ["renamed"]),
    ],
)
def test_modules_of_packages_count(tmp_path: Path, file: str, new: str, parts: list[str]) -> None:
    """What is reached by dots, under another name or in a closure is code of the project, too."""
    for name in ("a/__init__.py", "a/inner/__init__.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    (tmp_path / "a/b.py").write_text("import a\n\ndef law(x):\n    return x + 1\n")
    (tmp_path / "a/inner/c.py").write_text("def law(x):\n    return x + 1\n")
    before = prints(tmp_path, DOTTED)
    (tmp_path / file).write_text(new)
    assert differing(before, prints(tmp_path, DOTTED)) == parts


def test_libraries_count_by_their_version() -> None:
    """The version of a library is named when it differs."""
    one = fingerprint({"law": np.sin})
    assert one["version of numpy"] == np.__version__
    other = {**one, "version of numpy": "1.0"}
    assert differing(one, other) == [f"version of numpy ({np.__version__}, 1.0)"]
    assert "version of numpy" not in fingerprint({"law": np.sin}, libraries=False)


LIBRARY = """
__version__ = "7.1"
state = {"calls": 0}

class Odd:
    __slots__ = ("missing",)

    def __getattr__(self, name):
        raise RuntimeError(f"{name} does not exist")

odd = Odd()

def law(x):
    state["calls"] += 1
    return x
"""
USER = """
import elsewhere
from elsewhere.part import law
system = {"law": lambda x: law(x) + elsewhere.law(x), "odd": elsewhere.odd}
"""


@pytest.mark.parametrize(
    "record", [None, "elsewhere/__init__.py,,\nelsewhere/part.py,,\n", "x.py,,\n"]
)
def test_a_distribution_in_any_folder_is_a_library(tmp_path: Path, record: str | None) -> None:
    """Its content counts by its version, also where PYTHONPATH leads to it; other modules do not.

    A module beside it that the distribution does not list is the user's.
    """
    package = tmp_path / "elsewhere"
    package.mkdir()
    if record is not None:
        (tmp_path / "elsewhere-7.1.dist-info").mkdir()
        (tmp_path / "elsewhere-7.1.dist-info" / "RECORD").write_text(record)
    found = []
    for calls in ("0", "1"):
        for name in ("__init__.py", "part.py"):
            (package / name).write_text(LIBRARY.replace('"calls": 0', f'"calls": {calls}'))
        found.append(prints(tmp_path, source=USER))
    is_library = record is not None and "elsewhere" in record
    assert found[0].get("version of elsewhere") == ("7.1" if is_library else None)
    assert differing(*found) == ([] if is_library else ["law"])


def recursive(n: int) -> int:
    """Call itself."""
    return n and recursive(n - 1)


def test_what_refers_to_itself_ends() -> None:
    """Recursion, and lists that hold themselves, have a hash."""
    held: list[Any] = [1.0]
    held.append(held)
    assert len(fingerprint({"function": recursive, "list": held})) == 2


def test_compiled_functions_count_by_their_code() -> None:
    """A function of numba is told from one that computes something else."""

    def made(gain: float) -> Callable[..., Any]:
        return numba.njit(lambda x: gain * x)

    one, same, other = (fingerprint({"law": made(gain)}) for gain in (1.0, 1.0, 2.0))
    assert one == same
    assert differing(one, other) == ["law"]


def test_objects_of_libraries_count_by_their_state() -> None:
    """A generator, a frozen distribution of scipy and a partial of a ufunc have content."""

    def of(loc: float, seed: int) -> dict[str, str]:
        generator = np.random.default_rng(seed)
        parts = {"noise": generator, "law": stats.norm(loc), "part": functools.partial(np.add, loc)}
        return fingerprint(parts)

    assert of(0.0, 1) == of(0.0, 1)
    assert differing(of(0.0, 1), of(1.0, 2)) == ["noise", "law", "part"]


def test_an_attribute_that_is_computed_when_asked_does_not_count() -> None:
    """Looking at an object leaves its fingerprint alone."""

    class Law:
        @functools.cached_property
        def costly(self) -> int:
            return 7

    law = Law()
    before = fingerprint({"law": law})
    assert law.costly == 7
    assert fingerprint({"law": law}) == before
    box = sw.Box(0.0, 1.0)
    before = fingerprint({"space": box})
    assert box.contains(0.5)
    assert not box.parents()
    assert fingerprint({"space": box}) == before


def test_what_cannot_be_compared_is_said() -> None:
    """An object without readable content is named beside the hash."""
    assert fingerprint({"law": threading.Lock()})["law"].endswith("unread: _thread.lock")


def test_changes_name_settings_and_parts_of_a_fingerprint() -> None:
    """Of two descriptions of runs, the fingerprint is compared part by part."""
    one = {"seed": 0, "n": 3, "fingerprint": {"law": "a", "task": "b"}}
    other = {"seed": 1, "n": 3, "fingerprint": {"law": "c", "task": "b"}}
    assert changes(one, other) == ["seed (0 there, 1 here)", "law"]
    assert changes(one, one) == []


MJCF = """
<mujoco><include file="part.xml"/>
<worldbody>
  <body name="b"><joint name="j" stiffness="{}"/><geom size=".1" mass="2"/></body>
</worldbody>
</mujoco>
"""


def test_the_content_of_model_files_counts(tmp_path: Path) -> None:
    """A changed number of an MJCF, and of a file that it includes, changes the physics."""
    path, part = tmp_path / "m.xml", tmp_path / "part.xml"

    def made(stiffness: str, timestep: str) -> dict[str, str]:
        path.write_text(MJCF.format(stiffness))
        part.write_text(f'<mujoco><option timestep="{timestep}"/></mujoco>')
        return fingerprint(sw.World(path))

    one = made("1", ".002")
    assert made("1.0", ".002") == one
    assert "physics" in differing(one, made("1.5", ".002"))
    assert "physics" in differing(one, made("1", ".004"))


def test_worlds_and_models_name_their_parts() -> None:
    """Variables, functions and options of a world are parts of their own."""

    def model(gain: float, high: float) -> sw.SCM:
        def law(x: Any) -> Any:
            return gain * x

        root = sw.Exogenous(name="x", distribution=sw.Box(0.0, high))
        return sw.SCM([root, sw.Derived(name="y", parents=("x",), mechanism=law)])

    one = fingerprint(model(1.0, 1.0))
    assert differing(one, fingerprint(model(2.0, 1.0))) == ["mechanism of 'y'"]
    assert differing(one, fingerprint(model(1.0, 2.0))) == ["declaration of 'x'"]
    assert differing(one, fingerprint(model(1.0, 1.0).do({"x": 0.5}))) == ["intervention on 'x'"]
    push, slow = (
        sw.World("pushing", backend="fake"),
        sw.World("pushing", backend="fake", frame_skip=5),
    )
    assert "options" in differing(fingerprint(push), fingerprint(slow))


def test_a_function_that_holds_its_world_ends() -> None:
    """An outcome that looks at the world it is part of has a hash."""
    held: list[Any] = []

    def outcome(position: Any) -> Any:
        return position + 0.0 * len(held)

    body = '<body name="b"><joint name="j"/><geom size=".1"/></body>'
    text = f"<mujoco><worldbody>{body}</worldbody></mujoco>"
    world = sw.World(text, reward=(outcome, "j.position"))
    held.append(world)
    world.reset(seed=0)
    assert world.snapshot().world == world.identity
    assert "mechanism of 'reward'" in fingerprint(world)
