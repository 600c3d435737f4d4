"""The robot, blocks, obstacles and goals together."""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, final

from scm_world._types import Floats, Values
from scm_world.geometry.hulls import Hull
from scm_world.models import GoalRegion, Light, ParameterKey, Scene
from scm_world.models.scene import Overlap
from scm_world.tasks.composition import Commands, Composition, Entity
from scm_world.tasks.model import causes_of
from scm_world.tasks.trifinger.conventions import CONVENTIONS, TriFingerConventions
from scm_world.tasks.trifinger.feasibility import buried_goals, overlaps, thin
from scm_world.tasks.trifinger.hardware import (
    FINGERS,
    LINK_NAMES,
    PRESET_NAMES,
    RESOLUTIONS,
    preset,
)
from scm_world.variables import Variable
from scm_world.variables.reserved import PRESET

if TYPE_CHECKING:
    from scm_world.tasks.trifinger.system import TriFinger


@final
@dataclass(frozen=True)
class BlockWorld(Composition):
    """The robot, blocks, obstacles, goals and what they stand in.

    Attributes:
        entities: In the order of the observation.
        shared: Variables that belong to no single entity.
        deciding: Variables that decide which entities there are. A body that comes or goes acts
            on the others by contact, so they do.
        torques: Whether joint torques are commanded, and not joint positions.
        resolution: How finely joints are cut; see ``hardware.joints_of``.
        conventions: Say how deep bodies may lie in one another after an intervention, and
            whether Bullet has the physics of the predecessor.
        unchecked: What makes an intervention accepted however deep it puts bodies.
    """

    entities: tuple[Entity, ...] = ()
    shared: tuple[Variable, ...] = ()
    deciding: tuple[str, ...] = ()
    torques: bool = False
    resolution: str = RESOLUTIONS[0]
    conventions: TriFingerConventions = CONVENTIONS["scm_world"]
    unchecked: tuple[str, ...] = ()
    solid: bool = field(init=False, default=True)
    blocks: tuple[str, ...] = field(init=False)
    obstacles: tuple[str, ...] = field(init=False)
    hulls: tuple[tuple[str, Hull], ...] = field(init=False)
    bodies: tuple[str, ...] = field(init=False)
    hides_goals: bool = field(init=False)
    commands: Commands | None = field(init=False)
    system: TriFinger = field(init=False)
    _systems: dict[str, TriFinger] = field(init=False, default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        blocks = [entity for entity in self.entities if entity.is_block]
        commands = (entity.commands() for entity in self.entities)
        found: dict[str, Any] = {
            "blocks": tuple(entity.name for entity in blocks),
            "obstacles": tuple(entity.name for entity in self.entities if entity.is_obstacle),
            "hulls": tuple((e.name, e.hull) for e in blocks if e.hull is not None),
            "commands": next((one for one in commands if one is not None), None),
        }
        found["bodies"] = (*found["blocks"], *found["obstacles"])
        found["hides_goals"] = bool(found["obstacles"])
        for name, value in found.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "system", self._system(PRESET_NAMES[0]))

    def structure(self, values: Values) -> TriFinger:
        """Return the model of the bodies, with the settings that a preset stands for."""
        return self._system(PRESET_NAMES[int(values[PRESET])])

    def _system(self, name: str) -> TriFinger:
        if name not in self._systems:
            from scm_world.tasks.trifinger.system import trifinger  # it loads an engine

            self._systems[name] = trifinger(
                self.blocks,
                preset(name),
                self.obstacles,
                self.hulls,
                torques=self.torques,
                resolution=self.resolution,
                published=self.conventions.published_physics,
            )
        return self._systems[name]

    def overlaps(
        self,
        scene: Scene,
        tolerance: float | None = None,
        asked: Iterable[str] = (),
        enough: float = math.inf,
    ) -> tuple[Overlap, ...]:
        """List the bodies that lie deeper in one another than a tolerance [m]."""
        if tolerance is not None:
            return overlaps(scene, tolerance=tolerance)
        if self.unchecked and any(name.partition(".")[0] in self.unchecked for name in asked):
            return ()
        robot, others = self.conventions.robot_tolerance, self.conventions.tolerance
        return tuple(
            overlap
            for overlap in overlaps(
                scene,
                tolerance=min(robot, others),
                enough=max(enough, robot, others),
            )
            if overlap.depth > (others if set(LINK_NAMES).isdisjoint(overlap.bodies) else robot)
        )

    def thin(self, candidates: Any, limit: float) -> None:
        """Leave out candidates whose fingers cross one another."""
        thin(candidates, max(limit, self.conventions.robot_tolerance))

    def variables(self) -> tuple[Variable, ...]:
        """Declare every variable; edges into states follow from the kinematic trees."""
        system = self.system
        trees = {row.name: row.trees for row in system.states}
        every = frozenset(range(len(system.trees)))
        rows = {row.key: row for row in system.parameters}
        effects = {
            name: (rows[key].always, rows[key].contact)
            for name, key in self.parameters().items()
            if not rows[key].visual
        }
        effects |= {
            row.name: (row.always, row.contact) for row in system.states if not row.reported
        }
        for entity in self.entities:
            for name, acted_on in entity.actions().items():
                reached = frozenset().union(*(trees[state] for state in acted_on))
                effects[name] = reached, every - reached
        nowhere: frozenset[int] = frozenset()
        effects |= {PRESET: (every, nowhere), **dict.fromkeys(self.deciding, (nowhere, every))}
        causes = causes_of(effects, set(trees.values()))
        declared: list[Variable] = list(self.shared)
        for entity in self.entities:
            variables, states = entity.declared
            declared.extend(variables)
            declared.extend(state.declare(*causes[trees[state.name]]) for state in states)
        return tuple(declared)

    def parameters(self) -> dict[str, ParameterKey]:
        """Say which variable sets which physical parameter."""
        return {k: v for entity in self.entities for k, v in entity.parameters().items()}

    def buried(self, scene: Scene, names: Container[str]) -> tuple[Overlap, ...]:
        """List goals that lie in an obstacle."""
        return buried_goals(scene, names)

    def movers(self) -> tuple[str, ...]:
        """Name the fingers, then the blocks. The bases of fingers are fixed."""
        return (*(f"robot_finger_{finger}" for finger in FINGERS), *self.blocks)

    def shaped(self) -> Mapping[str, str]:
        """Map parameters to the body that they are a property of."""
        return {name: key[0] for name, key in self.parameters().items() if key[0] in self.touched()}

    def goals(self, values: Values) -> tuple[GoalRegion, ...]:
        """Describe all goals."""
        goals = (entity.goal(values) for entity in self.entities)
        return tuple(goal for goal in goals if goal is not None)

    def light(self, values: Values) -> Light:
        """Describe the light of pictures."""
        lights = (entity.light(values) for entity in self.entities)
        return next((light for light in lights if light is not None), Light())


def lowest_point(size: Floats, orientation: Floats) -> float:
    """Compute how far a box reaches below its center [m].

    Args:
        size: Edge lengths, shape (3,) [m].
        orientation: Quaternion (x, y, z, w).
    """
    x, y, z, w = orientation.tolist()
    length, width, height = size.tolist()
    row = (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))
    return 0.5 * float(abs(row[0]) * length + abs(row[1]) * width + abs(row[2]) * height)
