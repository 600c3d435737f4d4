"""The robot, blocks, obstacles and goals together."""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping
from typing import TYPE_CHECKING, Any, final

from scm_world._types import Values
from scm_world.models import GoalRegion, Light, ParameterKey, Scene
from scm_world.models.camera import Camera
from scm_world.models.scene import Overlap
from scm_world.tasks.base import Timing
from scm_world.tasks.composition import Composition, Entity
from scm_world.tasks.model import causes_of
from scm_world.tasks.trifinger.conventions import TriFingerConventions
from scm_world.tasks.trifinger.entities.robot import RobotCommands, acted_on
from scm_world.tasks.trifinger.entities.stage import cameras_of, light_of
from scm_world.tasks.trifinger.feasibility import buried_goals, overlaps, thin
from scm_world.tasks.trifinger.hardware import FINGERS, LINK_NAMES, PRESETS
from scm_world.variables import Variable
from scm_world.variables.kinds import Coupled
from scm_world.variables.reserved import PRESET

PARAMETERS = {
    "gravity": ("world", "gravity"),
    "floor_friction": ("floor", "friction"),
    "stage_friction": ("stage", "friction"),
    "floor_color": ("floor", "color"),
    "stage_color": ("stage", "color"),
    "restitution": ("world", "restitution"),
    "spinning_friction": ("world", "spinning_friction"),
    "robot_height": ("robot", "height"),
    "finger_friction": ("robot", "friction"),
    "joint_damping": ("robot", "joint_damping"),
    "position_gains": ("controller", "position_gains"),
    "velocity_gains": ("controller", "velocity_gains"),
    "safety_damping": ("controller", "safety_damping"),
    "torque_limit": ("controller", "torque_limit"),
}
"""Variables that are parameters of the model, as far as it has them, under other names."""

QUANTITIES = {
    "mass": "mass",
    "size": "size",
    "friction": "friction",
    "color": "color",
    "cartesian_position": "position",
    "orientation": "orientation",
}
"""Quantities of bodies that are parameters, as far as the model has them, and its names of them."""

if TYPE_CHECKING:
    from scm_world.tasks.trifinger.system import TriFinger


@final
class BlockWorld(Composition):
    """The robot, blocks, obstacles, goals and what they stand in.

    Args:
        entities: In the order of the observation.
        shared: Variables that belong to no single entity.
        deciding: Variables that decide which entities there are. A body that comes or goes acts
            on the others by contact, so they do.
        timing: Says how the robot is commanded, and how finely joints are cut.
        conventions: Say how deep bodies may lie in one another after an intervention, and
            whether Bullet has the physics of the predecessor.
        unchecked: Entities on which an intervention is accepted however deep it puts bodies.
    """

    solid = True

    def __init__(
        self,
        entities: tuple[Entity, ...],
        shared: tuple[Variable, ...],
        deciding: tuple[str, ...],
        timing: Timing,
        conventions: TriFingerConventions,
        unchecked: tuple[str, ...] = (),
    ) -> None:
        self.entities, self._shared, self._deciding = entities, shared, deciding
        self._timing, self._conventions, self._unchecked = timing, conventions, unchecked
        self.blocks = tuple(e.name for e in entities if e.kind == "block")
        self.obstacles = tuple(e.name for e in entities if e.kind == "obstacle")
        blocks = (e for e in entities if e.kind == "block")
        self.hulls = tuple((e.name, e.hull) for e in blocks if e.hull is not None)
        self.bodies, self.hides_goals = (*self.blocks, *self.obstacles), bool(self.obstacles)
        self._systems: dict[int, TriFinger] = {}
        super().__init__(self._system(0), RobotCommands(timing.action_mode))

    def structure(self, values: Values) -> TriFinger:
        """Return the model of the bodies, with the settings that a preset stands for."""
        return self._system(int(values[PRESET]))

    def _system(self, number: int) -> TriFinger:
        if number not in self._systems:
            from scm_world.tasks.trifinger.system import trifinger  # it loads an engine

            self._systems[number] = trifinger(
                self.blocks,
                [*PRESETS.values()][number],
                self.obstacles,
                self.hulls,
                torques=self._timing.action_mode == "joint_torques",
                resolution=self._timing.resolution,
                published=self._conventions.published,
            )
        return self._systems[number]

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
        if any(name.partition(".")[0] in self._unchecked for name in asked):
            return ()
        robot, others = self._conventions.robot_tolerance, self._conventions.tolerance
        least = min(robot, others)
        return tuple(
            overlap
            for overlap in overlaps(scene, tolerance=least, enough=max(enough, robot, others))
            if overlap.depth > (others if set(LINK_NAMES).isdisjoint(overlap.bodies) else robot)
        )

    def thin(self, candidates: Any, limit: float) -> None:
        """Leave out candidates whose fingers cross one another."""
        thin(candidates, max(limit, self._conventions.robot_tolerance))

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
        commands = acted_on(self._timing.action_mode, self._timing.resolution)
        for name, states in commands.items():
            reached = frozenset().union(*(trees[state] for state in states))
            effects[name] = reached, every - reached
        nowhere: frozenset[int] = frozenset()
        effects |= {PRESET: (every, nowhere), **dict.fromkeys(self._deciding, (nowhere, every))}
        causes = causes_of(effects, set(trees.values()))

        def coupled(variable: Variable) -> Variable:
            if variable.name not in trees:
                return variable
            parents = Coupled(*causes[trees[variable.name]], variable.all_parents)
            return variable.model_copy(update={"parents": parents})

        return (*self._shared, *(coupled(v) for e in self.entities for v in e.variables))

    def parameters(self) -> dict[str, ParameterKey]:
        """Return which variable sets which physical parameter."""
        known, found = {row.key for row in self.system.parameters}, dict[str, ParameterKey]()
        for entity in self.entities:
            names = dict.fromkeys(variable.name for variable in entity.variables)
            found |= {name: key for name, key in PARAMETERS.items() if name in names}
            split = [name.rpartition(".") for name in names]
            found |= {
                f"{body}.{ours}": (body, its)
                for ours, its in QUANTITIES.items()
                for body, _, quantity in split
                if quantity == ours
            }
        return {name: key for name, key in found.items() if key in known}

    def buried(self, scene: Scene, names: Container[str]) -> tuple[Overlap, ...]:
        """List goals that lie in an obstacle."""
        return buried_goals(scene, names)

    def movers(self) -> tuple[str, ...]:
        """Name the fingers, then the blocks. The bases of fingers are fixed."""
        return (*(f"robot_finger_{finger}" for finger in FINGERS), *self.blocks)

    def shaped(self) -> Mapping[str, str]:
        """Map parameters to the body that they are a property of."""
        bodies = self.touched()
        return {name: body for name, (body, _) in self.parameters().items() if body in bodies}

    def goals(self, values: Values) -> tuple[GoalRegion, ...]:
        """Describe all goals."""
        return tuple(
            GoalRegion(
                name=entity.name,
                shape=entity.shape if entity.hull is None else "hull",
                size=values[f"{entity.name}.size"],
                position=values[f"{entity.name}.cartesian_position"],
                orientation=values[f"{entity.name}.orientation"],
                color=values[f"{entity.name}.color"],
                hull=entity.hull,
            )
            for entity in self.entities
            if entity.kind == "goal"
        )

    def light(self, values: Values) -> Light:
        """Describe the light of pictures."""
        return light_of(values)

    def cameras(self, values: Values) -> tuple[Camera, ...]:
        """Describe the three cameras of the robot."""
        return cameras_of(values)
