"""The family that the documents show keeps the promises of a task."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import pytest
from scm_world.tasks.trifinger.entities.blocks import block_size

from scm_world.errors import ModelError
from scm_world.tasks import Building
from scm_world.tasks.trifinger.building import Piece, blocks_mass
from scm_world.testing.task import TaskConformance
from scm_world.world import Simulation

ROOT = Path(__file__).parent.parent.parent
EXAMPLE = ROOT / "examples" / "new_family.py"


def _load(name: str) -> ModuleType:
    """Import the example under a name, as a package of the user's would be."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


family = _load("new_family")


class TestPyramid(TaskConformance):
    """The pyramid of the documents."""

    def make(self) -> Simulation:
        """Create a world."""
        return Simulation(family.Pyramid(), backend="fake")


def test_the_document_shows_the_example() -> None:
    """The text of the file stands in the document, word for word."""
    assert EXAMPLE.read_text() in (ROOT / "docs" / "extending.md").read_text()


@pytest.mark.parametrize("backend", ["fake", "mujoco"])
def test_levels_come_and_go(backend: str) -> None:
    """A level more is as many blocks more, in mid-episode too, and they do not collide."""
    world = Simulation(family.Pyramid(), backend=backend)
    world.reset(seed=0)
    world.step(np.array(world.task.start))
    assert world.do({"pyramid_levels": 3}).came == ("tool_0_2", "tool_1_1", "tool_2_0")
    world.step(np.array(world.task.start))
    world.do(world.task.solution(world.values()))
    assert world["success"] == 1


def middle(size: np.ndarray, *, center: np.ndarray) -> np.ndarray:
    """Return where a part belongs [m]."""
    return np.asarray(center + 0.0 * size)


class Given(Building):
    """Parts whose places are given as arrays."""

    name = "given"
    piece = Piece(size="block.size", place=(middle, "block.size"), start=(family.start,))
    places: ClassVar[dict[str, Any]] = {"a": np.array([0.1, 0.0, 0.05]), "b": [0.0, 0.1, 0.05]}

    def __init__(self) -> None:
        super().__init__()
        self.roots = (blocks_mass(0.02), block_size("block.size"))

    def parts(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """List the parts."""
        for number, (name, center) in enumerate(self.places.items()):
            yield name, {"center": center, "level": 0, "num": float(number)}


def test_numbers_of_parts_may_be_arrays() -> None:
    """Functions get them as arrays; what is not a number is refused by name."""
    world = Simulation(Given(), backend="fake")
    world.reset(seed=0)
    for name, center in Given.places.items():
        np.testing.assert_array_equal(world[f"goal_{name}.cartesian_position"], center)
    for wrong in ("middle", np.eye(3), None):
        task = Given()
        task.places = {"a": wrong}  # type: ignore[misc] # of this one only
        with pytest.raises(ModelError, match=r"Function\.constants"):
            Simulation(task, backend="fake")


def test_the_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    """It says what it built."""
    family.main("fake")
    assert "6 blocks fill 0.50" in capsys.readouterr().out
