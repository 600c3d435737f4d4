"""The robot, blocks, obstacles and goals together."""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, final

from scm_world._types import Floats, Values
from scm_world.geometry.hulls import Hull
from scm_world.models import ControlMode, GoalRegion, Light, ParameterKey, Scene
from scm_world.models.scene import Overlap
from scm_world.tasks.composition import Commands, Composition, Entity
from scm_world.tasks.conventions import CONVENTIONS, Conventions
from scm_world.tasks.trifinger.feasibility import buried_goals, overlaps, thin
from scm_world.tasks.trifinger.hardware import (
    FINGERS,
    LINK_NAMES,
    PRESET_NAMES,
    preset,
)
from scm_world.tasks.trifinger.state import BLOCK_SIZE, ROBOT_SIZE, PhysicalState
from scm_world.tasks.trifinger.structure import TriFingerStructure
from scm_world.variables import Variable
from scm_world.variables.kinds import parent_of
from scm_world.variables.reserved import PRESET


def block_slice(block: int, start: int, stop: int) -> slice:
    """Give the place of some numbers of a block in the state vector."""
    offset = ROBOT_SIZE + BLOCK_SIZE * block
    return slice(offset + start, offset + stop)


@final
@dataclass(frozen=True)
class BlockWorld(Composition):
    """The robot, blocks, obstacles, goals and what they stand in.

    Attributes:
        entities: In the order of the observation.
        shared: Variables that belong to no single entity.
        deciding: Variables that decide which entities there are. A body that comes or goes acts
            on the others by contact, so they do.
        mode: What a command means.
        conventions: Say how deep bodies may lie in one another after an intervention, and
            whether Bullet has the physics of the predecessor.
        unchecked: What makes an intervention accepted however deep it puts bodies.
    """

    entities: tuple[Entity, ...]
    shared: tuple[Variable, ...] = ()
    deciding: tuple[str, ...] = ()
    mode: ControlMode = ControlMode.JOINT_POSITIONS
    conventions: Conventions = CONVENTIONS["scm_world"]
    unchecked: tuple[str, ...] = ()
    solid: bool = field(init=False, default=True)
    blocks: tuple[str, ...] = field(init=False)
    obstacles: tuple[str, ...] = field(init=False)
    hulls: tuple[tuple[str, Hull], ...] = field(init=False)
    commands: Commands | None = field(init=False)
    _structures: dict[str, TriFingerStructure] = field(init=False, default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        blocks = [entity for entity in self.entities if entity.is_block]
        commands = (entity.commands() for entity in self.entities)
        found = {
            "blocks": tuple(entity.name for entity in blocks),
            "obstacles": tuple(entity.name for entity in self.entities if entity.is_obstacle),
            "hulls": tuple((e.name, e.hull) for e in blocks if e.hull is not None),
            "commands": next((one for one in commands if one is not None), None),
        }
        for name, value in found.items():
            object.__setattr__(self, name, value)

    def structure(self, values: Values) -> TriFingerStructure:
        """Say which bodies the backend has to build, and how finely it cuts time."""
        name = PRESET_NAMES[int(values[PRESET])]
        if name not in self._structures:
            published = self.conventions.published_physics
            made = TriFingerStructure(
                self.blocks, preset(name), self.obstacles, self.hulls, published
            )
            self._structures[name] = made
        return self._structures[name]

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
        """Declare every variable, with the states coupled to all physical quantities."""
        names = [name for entity in self.entities for name in entity.inputs()]
        inputs = {name: parent_of(name, 1, "contact") for name in (*names, *self.deciding)}
        declared: list[Variable] = list(self.shared)
        for entity in self.entities:
            variables, states = entity.declared
            declared.extend(variables)
            declared.extend(state.declare(inputs) for state in states)
        return tuple(declared)

    def parameters(self) -> dict[str, ParameterKey]:
        """Say which variable sets which physical parameter."""
        return {k: v for entity in self.entities for k, v in entity.parameters().items()}

    def slices(self) -> dict[str, slice]:
        """Say where each state stands in the state vector."""
        found: dict[str, slice] = {}
        for entity in self.entities:
            block = self.blocks.index(entity.name) if entity.is_block else -1
            found.update(entity.slices(block))
        return found

    def empty_state(self) -> PhysicalState:
        """Give a state to read into."""
        return PhysicalState(len(self.blocks))

    def buried(self, scene: Scene, names: Container[str]) -> tuple[Overlap, ...]:
        """List goals that lie in an obstacle."""
        return buried_goals(scene, names)

    def movers(self) -> tuple[str, ...]:
        """Name the fingers, then the blocks. The bases of fingers are fixed."""
        return (*(f"robot_finger_{finger}" for finger in FINGERS), *self.blocks)

    def touched(self) -> Mapping[str, tuple[str, ...]]:
        """Map links and blocks to their states; floor, stage and obstacles are fixed."""
        still = dict.fromkeys(("floor", "stage", *self.obstacles), ())
        blocks = {e.name: (*e.slices(0),) for e in self.entities if e.is_block}
        robot = (name for e in self.entities if not e.is_block for name in e.slices(-1))
        return {**still, **blocks, **dict.fromkeys(LINK_NAMES, tuple(robot))}

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
