"""The robot, blocks, obstacles and goals together."""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping
from typing import TYPE_CHECKING, Any, final

import numpy as np

from scm_world._types import Values
from scm_world.models import GoalRegion, Light, ParameterKey, Scene
from scm_world.models.camera import Camera, camera_from
from scm_world.models.scene import Overlap
from scm_world.tasks.base import Timing
from scm_world.tasks.composition import Composition, Entity
from scm_world.tasks.model import causes_of
from scm_world.tasks.trifinger.cameras import CAMERAS
from scm_world.tasks.trifinger.entities.robot import RobotCommands, acted_on
from scm_world.tasks.trifinger.feasibility import buried_goals, clear, overlaps
from scm_world.tasks.trifinger.hardware import FINGERS, LINK_NAMES, N_JOINTS, PRESETS
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

QUANTITIES = ("mass", "size", "friction", "color", "cartesian_position", "orientation")
"""Quantities of bodies that are parameters, as far as the model has them; ``position`` in it."""

if TYPE_CHECKING:
    from scm_world.tasks.trifinger.system import TriFinger


@final
class BlockWorld(Composition):
    """The robot, blocks, obstacles, goals and what they stand in.

    Args:
        entities: In the order of the observation.
        shared: Variables that belong to no single entity.
        task: Its conventions say how deep bodies may lie in one another after an intervention, and
            whether Bullet has the physics of the predecessor. A body that comes or goes acts on the
            others by contact, so the variables of ``decided_by`` do.
        timing: Says how the robot is commanded, and how finely joints are cut.
    """

    solid = True

    def __init__(
        self, entities: tuple[Entity, ...], shared: tuple[Variable, ...], task: Any, timing: Timing
    ) -> None:
        self.entities, self._shared, self._timing = entities, shared, timing
        self._deciding, self._conventions = task.decided_by, task.conventions
        self._unchecked = task.unchecked if self._conventions.published else ()
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
        """Leave out candidates whose fingers lie deep in one another, or beyond the ring.

        Most draws of the joints are of this kind.
        """
        joints = candidates.state(slice(0, N_JOINTS))
        if len(joints) > 1:
            heights = np.broadcast_to(candidates.parameter(("robot", "height")), len(joints))
            limit = max(limit, self._conventions.robot_tolerance)
            candidates.keep(clear(joints, np.ascontiguousarray(heights), limit))

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
            names = [variable.name for variable in entity.variables]
            found |= {name: PARAMETERS[name] for name in names if name in PARAMETERS}
            for part in QUANTITIES:
                bodies = (
                    name.removesuffix(f".{part}") for name in names if name.endswith(f".{part}")
                )
                its = part.removeprefix("cartesian_")
                found |= {f"{body}.{part}": (body, its) for body in bodies}
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

    def looks(self, values: Values) -> tuple[tuple[GoalRegion, ...], Light]:
        """Describe all goals, and the light of pictures."""
        goals = tuple(
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
        x, y, z = values["light_direction"].tolist()
        return goals, Light((x, y, z), float(values["light_ambient"]))

    def cameras(self, values: Values) -> tuple[Camera, ...]:
        """Describe the three cameras of the robot, with pictures of 128 x 128 pixels."""
        return tuple(
            camera_from(
                camera.name,
                values[f"camera_{camera.name}.position"],
                values[f"camera_{camera.name}.orientation"],
                float(values[f"camera_{camera.name}.field_of_view"]),
            )
            for camera in CAMERAS
        )
