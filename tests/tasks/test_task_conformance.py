"""Every task passes the same suite: all on the fake, on engines one of each kind of scene."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from typing import Any, ClassVar

import pytest

from scm_world.geometry.hulls import Hull, hull_of
from scm_world.tasks import TASKS, Task
from scm_world.testing.task import TaskConformance
from scm_world.world import Simulation

SMALLER: Mapping[str, Mapping[str, Any]] = {
    "towers": {"number_of_blocks_in_tower": (1, 2, 2)},
    "stacked_blocks": {"num_of_levels": 2, "max_level_width": 0.075},
    "creative_stacked_blocks": {"num_of_levels": 3, "max_level_width": 0.04},
    "general": {"nums_objects": 2},
}
"""Options that keep a suite short in which every quantity of every block is set."""


SHAPED = {f"{name}_of_a_wedge": TASKS[name] for name in ("pushing", "picking", "pick_and_place")}
"""Tasks whose block and goal may be a convex shape."""


def wedge() -> Hull:
    """Give half a cuboid of 7 x 6 x 6 cm, cut along a diagonal."""
    return hull_of([(x, y, z) for y in (0.0, 0.06) for x, z in ((0, 0), (0.07, 0), (0, 0.06))])


def make_case(name: str) -> Task:
    """Create a registered task, or one of them with a shape."""
    if name in SHAPED:
        return SHAPED[name](shape=wedge())  # type: ignore[call-arg] # these have it
    return TASKS[name](**SMALLER.get(name, {}))


WEDGE = "pick_and_place_of_a_wedge"
KINDS = ("reaching", "pushing", "pick_and_place", "stacking2", "creative_stacked_blocks", "general")
"""No block, one, an obstacle, several blocks, as many as variables say, and any number of all.

To an engine, the others are scenes of the same bodies.
"""


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run each suite on its tasks."""
    metafunc.parametrize("name", metafunc.cls.tasks)


class OnEveryTask(TaskConformance):
    """All tasks, on one of the engines."""

    backend: ClassVar[str]
    tasks: ClassVar[tuple[str, ...]] = (*TASKS, *SHAPED)
    task: str
    awake: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "obstacle_places": {"number_of_obstacles": 2},
        "wall_noise": {"wall_pattern": 1},
        "max_level_width": {"wall_pattern": 1},
    }

    @pytest.fixture(autouse=True)
    def _choose(self, name: str) -> None:
        self.task = name

    def make(self) -> Simulation:
        """Create a world."""
        return Simulation(make_case(self.task), backend=self.backend)


class TestFake(OnEveryTask):
    """Without physics."""

    backend = "fake"


class OnAnEngine(OnEveryTask):
    """What an engine does; what is declared without it, ``TestFake`` has of every task."""

    tasks = (*KINDS, WEDGE)
    test_spaces_lie_within_bounds = None  # type: ignore[assignment]
    test_the_model_survives_json = None  # type: ignore[assignment]
    test_the_observation_is_declared = None  # type: ignore[assignment]


class TestMujoco(OnAnEngine):
    """On MuJoCo, the default engine of all tasks."""

    backend = "mujoco"


@pytest.mark.skipif(importlib.util.find_spec("pybullet") is None, reason="needs pybullet")
class TestBullet(OnAnEngine):
    """On Bullet."""

    backend = "bullet"
