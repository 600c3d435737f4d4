"""The robot, blocks, obstacles and goals together, and which of them are in one place."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, final

import numpy as np

from scm_world._types import Floats, Values
from scm_world.geometry.numbers import njit
from scm_world.geometry.rotations import rotation_matrix
from scm_world.models import GoalRegion, Light, ParameterKey, Scene
from scm_world.models.camera import Camera, camera_from
from scm_world.models.scene import SURFACES, TOLERANCE, Overlap
from scm_world.tasks.composition import Composition, Entity
from scm_world.tasks.model import causes_of
from scm_world.tasks.trifinger.cameras import CAMERAS
from scm_world.tasks.trifinger.entities.robot import RobotCommands, acted_on
from scm_world.tasks.trifinger.grasping.hand import deepest_kernel
from scm_world.tasks.trifinger.hardware import (
    FINGERS,
    LINK_NAMES,
    N_JOINTS,
    PRESETS,
    WALL_HEIGHT,
    WALL_RADIUS,
    link_name,
)
from scm_world.tasks.trifinger.kinematics import forward, forward_kernel
from scm_world.tasks.trifinger.types import of_robot
from scm_world.variables import Variable
from scm_world.variables.kinds import coupled
from scm_world.variables.reserved import PRESET

if TYPE_CHECKING:
    from scm_world.tasks.base import Options
    from scm_world.tasks.trifinger.base import TriFingerTask
    from scm_world.tasks.trifinger.system import TriFinger

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

BALLS_MARGIN = 1e-3  # [m] by which balls of two legs may be deeper in one another than capsules


def overlaps(scene: Scene, *, tolerance: float) -> tuple[Overlap, ...]:
    """List all pairs of bodies that lie deeper in one another than a tolerance.

    Compared are blocks with everything; the middle and lower links of different fingers with one
    another; both with the floor and obstacles; the tips with the ring. A block or a tip with its
    center beyond the ring has left the arena, and lies in the stage: a block at any height, a tip
    below the upper end.

    Args:
        scene: With complete parameters.
        tolerance: How deep is too deep [m].

    Returns:
        One entry for each pair of names, blocks first.

    Example:
        >>> from scm_world.tasks.trifinger.system import trifinger
        >>> scene = trifinger(("tool_block",)).default_scene()
        >>> overlaps(scene, tolerance=1e-4)
        ()
        >>> scene.state.positions[0, 2] = 0.03
        >>> print(*overlaps(scene, tolerance=1e-4))
        'tool_block' lies 2.5 mm deep in 'floor'
    """
    from scm_world.backends.mujoco import overlaps as engine

    found, (structure, state) = engine.overlaps(scene, tolerance), of_robot(scene)
    tips = forward(state.joint_positions, float(scene.parameters["robot", "height"])).reshape(3, 3)
    centers = np.vstack([state.positions, tips])
    beyond = np.hypot(centers[:, 0], centers[:, 1]) - WALL_RADIUS
    beyond[len(state.positions) :][tips[:, 2] > WALL_HEIGHT] = 0.0
    if beyond.max() <= tolerance:
        return found
    names = *structure.blocks, *(link_name(f, 3) for f in FINGERS)
    deepest = {overlap.bodies: overlap.depth for overlap in found}
    for name, depth in zip(names, beyond.tolist(), strict=True):
        if depth > tolerance:
            deepest[name, "stage"] = max(depth, deepest.get((name, "stage"), 0.0))
    return tuple(Overlap(bodies, depth) for bodies, depth in deepest.items())


@njit(cache=True)
def _first_clear(joints: Floats, heights: Floats, limit: float) -> int:
    """Return the first row of joints in which fingers may be clear of one another and of the ring.

    ``overlaps`` decides.
    """
    none = np.empty((0, 3, 5))
    for row in range(len(joints)):
        tips, apart = forward_kernel(joints[row], heights[row]), True
        for x, y, z in tips.reshape(3, 3):
            apart &= z > WALL_HEIGHT or math.hypot(x, y) - WALL_RADIUS <= limit
        most = limit + BALLS_MARGIN
        if apart and deepest_kernel(joints[row], heights[row], none) <= most:
            return row
    return len(joints)


@final
class BlockWorld(Composition):
    """The robot, blocks, obstacles, goals and the stage.

    Args:
        entities: In the order of the observation.
        shared: Variables that belong to no single entity.
        task: Its conventions say how deep bodies may lie in one another after an intervention, and
            whether Bullet has the physics of the predecessor. A body that comes or goes acts on the
            others by contact, so the variables of ``decided_by`` do.
        options: Says how the robot is commanded, and how finely joints are cut.
    """

    system: TriFinger
    solid = True
    structural = frozenset({PRESET})

    def __init__(
        self,
        entities: tuple[Entity, ...],
        shared: tuple[Variable, ...],
        task: TriFingerTask,
        options: Options,
    ) -> None:
        self.entities, self._shared, self._options = entities, shared, options
        self._deciding, self._conventions = task.decided_by, task.conventions
        self._unchecked = task.unchecked if self._conventions.published else ()
        self.blocks = tuple(e.name for e in entities if e.kind == "block")
        self.obstacles = tuple(e.name for e in entities if e.kind == "obstacle")
        blocks = (e for e in entities if e.kind == "block")
        self.hulls = tuple((e.name, e.hull) for e in blocks if e.hull is not None)
        self.bodies = (*self.blocks, *self.obstacles)
        if self.obstacles:  # goals, and the cameras, which are drawn again together with them
            every = (*shared, *(one for entity in entities for one in entity.variables))
            places = (one.name for one in every if one.name.endswith(tuple(SURFACES)))
            self.kept_clear = frozenset(places)
        self._systems: dict[int, TriFinger] = {}
        super().__init__(self._system(0), RobotCommands(options.action_mode))
        states = self.system.layout.slices.items()
        joints = (name for name, where in states if where.stop <= N_JOINTS)
        self.screened = ("robot_height", *joints)

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
                torques=self._options.action_mode == "joint_torques",
                resolution=self._options.resolution,
                published=self._conventions.published,
            )
        return self._systems[number]

    def overlaps(
        self, scene: Scene, tolerance: float | None = None, asked: Iterable[str] = ()
    ) -> tuple[Overlap, ...]:
        """List the bodies that lie deeper in one another than a tolerance [m]."""
        if tolerance is not None:
            return overlaps(scene, tolerance=tolerance)
        if any(name.partition(".")[0] in self._unchecked for name in asked):
            return ()
        robot, others = self._conventions.robot_tolerance, self._conventions.tolerance
        return tuple(
            overlap
            for overlap in overlaps(scene, tolerance=min(robot, others))
            if overlap.depth > (others if set(LINK_NAMES).isdisjoint(overlap.bodies) else robot)
        )

    def first_clear(self, values: Values, limit: float) -> int:
        """Return the first draw that leaves fingers clear of one another and of the ring."""
        joints = np.hstack([values[name] for name in self.screened[1:]])
        limit = max(limit, self._conventions.robot_tolerance)
        return int(_first_clear(joints, values["robot_height"].ravel(), limit))

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
        commands = acted_on(self._options.action_mode, self._options.resolution)
        for name, states in commands.items():
            reached = frozenset().union(*(trees[state] for state in states))
            effects[name] = reached, every - reached
        nowhere: frozenset[int] = frozenset()
        effects |= {PRESET: (every, nowhere), **dict.fromkeys(self._deciding, (nowhere, every))}
        causes = causes_of(effects, set(trees.values()))

        def driven(variable: Variable) -> Variable:
            if variable.name not in trees:
                return variable
            parents = coupled(*causes[trees[variable.name]], variable.all_parents)
            return variable.model_copy(update={"parents": parents})

        return (*self._shared, *(driven(v) for e in self.entities for v in e.variables))

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

    def obstructed(self, scene: Scene, drawn: Collection[str]) -> tuple[Overlap, ...]:
        """List drawn goals deeper than ``TOLERANCE`` in an obstacle: nothing can fill them."""
        found, obstacles = list[Overlap](), of_robot(scene)[0].obstacles
        names = {name.partition(".")[0] for name in drawn}
        goals = [goal for goal in scene.goals if obstacles and goal.name in names]
        for goal in (goal for goal in goals if goal.shape == "sphere"):
            inside = (Overlap((goal.name, o), _depth_in_box(goal, scene, o)) for o in obstacles)
            found += [overlap for overlap in inside if overlap.depth > TOLERANCE]
        solid = [goal for goal in goals if goal.shape != "sphere"]
        if solid:
            listed = overlaps(_filled(solid, scene.parameters, obstacles), tolerance=TOLERANCE)
            found += [overlap for overlap in listed if overlap.bodies[1] in obstacles]
        return tuple(found)

    def movers(self) -> tuple[str, ...]:
        """Name the fingers, then the blocks. The bases of fingers are fixed."""
        return (*(f"robot_finger_{finger}" for finger in FINGERS), *self.blocks)

    def shaped(self) -> Mapping[str, str]:
        """Map parameters to the body that they are a property of; those of the world have none.

        What all fingers have in common belongs to a link: the links move together, and nothing
        touches the hub.
        """
        bodies = {body: body for body in {*self.touched()} - {"world"}}
        bodies["robot"] = link_name(FINGERS[0], 1)
        owners = {name: body for name, (body, _) in self.parameters().items() if body in bodies}
        return {name: bodies[body] for name, body in owners.items()}

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


def _filled(
    goals: Sequence[GoalRegion], parameters: Mapping[Any, Any], obstacles: tuple[str, ...] = ()
) -> Scene:
    """Return a scene with blocks in the places of goals."""
    from scm_world.tasks.trifinger.system import trifinger  # it loads an engine

    hulls = tuple((goal.name, goal.hull) for goal in goals if goal.hull is not None)
    blocks = tuple(goal.name for goal in goals)
    scene = trifinger(blocks, obstacles=obstacles, hulls=hulls).default_scene()
    sizes = {(goal.name, "size"): goal.size for goal in goals if goal.hull is None}
    for pose, goal in zip(of_robot(scene)[1].blocks, goals, strict=True):
        pose[:3], pose[3:7] = goal.position, goal.orientation
    return scene.with_(parameters={**scene.parameters, **parameters, **sizes})


def _depth_in_box(goal: GoalRegion, scene: Scene, obstacle: str) -> float:
    """Measure how far a sphere would have to be moved out of an obstacle [m]."""
    size, place, turn = (
        scene.parameters[obstacle, what] for what in ("size", "position", "orientation")
    )
    beyond = np.abs((goal.position - place) @ rotation_matrix(turn)) - 0.5 * size
    distance = np.linalg.norm(np.maximum(beyond, 0.0)) + min(beyond.max(), 0.0)
    return 0.5 * float(goal.size[0]) - float(distance)


def fingers_reach(
    size: Floats, position: Floats, orientation: Floats, joints: Floats, height: float
) -> bool:
    """Return whether a finger lies in a box with these edges and this pose, at given joints."""
    box = GoalRegion("box", "box", size, position, orientation, color=np.zeros(3))
    scene = _filled([box], {("robot", "height"): height})
    of_robot(scene)[1].joint_positions[:] = joints
    found = overlaps(scene, tolerance=TOLERANCE)
    return any("box" in o.bodies and o.bodies[1] in LINK_NAMES for o in found)
