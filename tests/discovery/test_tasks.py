"""Every task is discovered, on every engine."""

from __future__ import annotations

import importlib.util
from typing import Any

import pytest

from scm_world.discovery import DiscoveryReport, discover
from scm_world.tasks import TASKS, make_task
from scm_world.variables import Function, Parent
from scm_world.world import Simulation

ENGINES = ["mujoco"] + (["bullet"] if importlib.util.find_spec("pybullet") else [])

SMALL: dict[str, dict[str, Any]] = {
    "towers": {"number_of_blocks_in_tower": (1, 1, 2), "tower_dims": (0.035, 0.035, 0.07)},
    "stacked_blocks": {"num_of_levels": 2, "max_level_width": 0.04},
    "creative_stacked_blocks": {"num_of_levels": 2, "max_level_width": 0.04},
    "general": {"nums_objects": 2},
}
"""Two blocks, where there are more by default."""

LARGER: dict[str, dict[str, Any]] = {
    "stacked_blocks": {"num_of_levels": 2, "max_level_width": 0.075},
    "creative_stacked_blocks": {"num_of_levels": 3, "max_level_width": 0.04},
}
"""Four and three blocks; all other tasks are as they are by default."""

DECLARED = {
    "reaching": 114,
    "pushing": 270,
    "picking": 278,
    "pick_and_place": 309,
    "stacking2": 518,
    "towers": 514,
    "stacked_blocks": 533,
    "creative_stacked_blocks": 544,
    "general": 509,
}
"""How many edges the small tasks declare."""


def found(task: str, backend: str, probes: int, options: dict[str, Any]) -> DiscoveryReport:
    """Discover a task."""
    return discover(Simulation(make_task(task, **options), backend=backend), probes=probes)


def first(value: Any, *_: Any) -> Any:
    """Pass the first cause on."""
    return value


KINDS = ("reaching", "pushing", "pick_and_place", "stacking2", "general")
"""The others are scenes of the same bodies: Bullet sees one of each kind."""
RUNS = [
    (task, backend) for backend in ENGINES for task in TASKS if backend == "mujoco" or task in KINDS
]


@pytest.mark.parametrize(("task", "backend"), RUNS)
def test_few_probes_find_nothing_false(task: str, backend: str) -> None:
    """Four probe states find six of seven edges, none that is not declared, no noise."""
    report = found(task, backend, 4, SMALL.get(task, {}))
    assert report.score.undeclared == ()
    assert report.floor == 0.0
    assert report.score.recall > 0.85
    assert len(report.declared) == DECLARED[task]


@pytest.mark.slow
@pytest.mark.parametrize("backend", ENGINES)
@pytest.mark.parametrize("task", TASKS)
def test_many_probes_find_everything(task: str, backend: str) -> None:
    """Forty probe states find exactly what is declared."""
    report = found(task, backend, 40, LARGER.get(task, {}))
    assert report.score.shd == 0, (report.score.undeclared, report.score.missed)
    assert report.floor == 0.0


def test_what_decides_the_structure_is_held_like_any_other() -> None:
    """A random wall puts its blocks elsewhere, even those that it would not have."""
    report = found("stacked_blocks", "fake", 3, {"num_of_levels": 1, "max_level_width": 0.075})
    for name in ("tool_level_0_num_0", "tool_level_0_num_1"):
        assert ("wall_pattern", f"{name}.cartesian_position", 0) in report.found
    assert ("wall_pattern", "wall.layout", 0) in report.found


def test_a_false_edge_into_a_mechanism_is_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cause that a mechanism ignores is listed as missed, whatever it is set to."""
    from scm_world.tasks.trifinger.entities.block_world import BlockWorld

    honest = BlockWorld.variables
    extra = Parent("floor_friction", 0)

    def tampered(self: BlockWorld) -> tuple[Any, ...]:
        return tuple(
            v.model_copy(update={"parents": (*v.parents, extra), "mechanism": Function(first)})
            if v.name == "tool_level_0_num_0.mass"
            else v
            for v in honest(self)
        )

    monkeypatch.setattr(BlockWorld, "variables", tampered)
    monkeypatch.setattr("scm_world.world.structures._ALIVE", {})  # honest worlds may be alive
    report = found("stacked_blocks", "fake", 1, SMALL["stacked_blocks"])
    assert ("floor_friction", "tool_level_0_num_0.mass", 0) in report.score.missed
    assert ("blocks_mass", "tool_level_0_num_0.mass", 0) in report.found
