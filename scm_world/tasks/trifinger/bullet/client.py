"""A physics client with robot, floor, stage and blocks in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, final

import numpy as np

from scm_world._types import Floats
from scm_world.backends.bullet.client import Values, arrays, known
from scm_world.errors import EngineFailure
from scm_world.geometry.hulls import Hull
from scm_world.models.scene import ParameterKey
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.bullet import arena
from scm_world.tasks.trifinger.bullet.arena import (
    BLOCK_SPINNING,
    COLLIDING_LINKS,
    JOINTS,
    LINKS_IN_ENGINE,
    OTHER_SPINNING,
    Shape,
    link_index,
)
from scm_world.tasks.trifinger.bullet.base import Client
from scm_world.tasks.trifinger.bullet.passive import MASSES, resistance
from scm_world.tasks.trifinger.hardware import ControllerSpec, controller_spec
from scm_world.tasks.trifinger.state import BLOCK_SIZE, ROBOT_SIZE
from scm_world.tasks.trifinger.system import TriFinger

Law = Callable[[Sequence[Any], Sequence[float]], list[float]]
"""From joint states (position, velocity, …) and a command, nine each, to nine torques [N m]."""


def compile_law(spec: ControllerSpec, *, commanded: bool) -> Law:
    """Write ``ControllerSpec.torques`` without arrays; the numbers are the same, bit for bit."""
    gains = tuple(zip(spec.kp * 3, spec.kd * 3, spec.safety * 3, strict=True))
    high, low = spec.limit, -spec.limit

    def positions(states: Sequence[Any], command: Sequence[float]) -> list[float]:
        torques = []
        for state, target, (kp, kd, safety) in zip(states, command, gains, strict=True):
            velocity = state[1]
            torque = kp * (target - state[0]) - kd * velocity
            torque = high if torque > high else low if torque < low else torque
            torque -= safety * velocity
            torques.append(high if torque > high else low if torque < low else torque)
        return torques

    def torques(states: Sequence[Any], command: Sequence[float]) -> list[float]:
        safe = []
        for state, wanted, (_, _, safety) in zip(states, command, gains, strict=True):
            torque = high if wanted > high else low if wanted < low else wanted
            torque -= safety * state[1]
            safe.append(high if torque > high else low if torque < low else torque)
        return safe

    return torques if commanded else positions


TIP, LOWER = 4, 3  # links of a finger

LINKS = {
    hardware.link_name(name, link): (finger, link)
    for finger, name in enumerate(hardware.FINGERS)
    for link in range(hardware.LINKS_PER_FINGER)
}
"""Finger and number of every link, by its published name."""


@final
@dataclass(frozen=True)
class Handles:
    """The engine's numbers of all bodies.

    Attributes:
        robot: One body with fifteen links.
        floor: The plane.
        stage: The segments of the wall.
        obstacles: By name.
        blocks: By name, in the order of the state.
        shapes: Of obstacles and blocks, by name.
        spinning: What robot, floor and stage, obstacles, and blocks get of the spinning friction
            of the scene; see ``BLOCK_SPINNING``.
        ground: What is under the floor, if anything is.
    """

    robot: int
    floor: int
    stage: tuple[int, ...]
    obstacles: dict[str, int] = field(default_factory=dict)
    blocks: dict[str, int] = field(default_factory=dict)
    shapes: dict[str, Shape] = field(default_factory=dict)
    spinning: tuple[float, float, float] = (OTHER_SPINNING, OTHER_SPINNING, BLOCK_SPINNING)
    ground: int = -1

    def place(self, name: str) -> tuple[int, int]:
        """Give body and link of a block, obstacle, link or surface."""
        if name in LINKS:
            return self.robot, link_index(*LINKS[name])
        if name in self.blocks:
            return self.blocks[name], -1
        if name in self.obstacles:
            return self.obstacles[name], -1
        return {"floor": self.floor, "stage": self.stage[0]}[name], -1

    def places(self, name: str) -> list[tuple[int, int]]:
        """Give all bodies and links that a name stands for."""
        if name == "robot":
            return [(self.robot, link) for link in COLLIDING_LINKS]
        if name == "stage":
            return [(body, -1) for body in self.stage]
        if name in LINKS and LINKS[name][1] == LOWER:
            return [self.place(name), (self.robot, link_index(LINKS[name][0], TIP))]
        return [self.place(name)]

    def groups(self) -> tuple[list[tuple[int, int]], ...]:
        """Give bodies and links of robot, floor and stage, those of obstacles, and of blocks."""
        fixed = [*self.places("robot"), *((body, -1) for body in (self.floor, *self.stage))]
        return (
            fixed,
            [(b, -1) for b in self.obstacles.values()],
            [(b, -1) for b in self.blocks.values()],
        )


def moments(bodies: Handles, name: str, mass: float) -> list[float]:
    """Compute the principal moments of inertia of a solid block or of a link [kg m²]."""
    if name in LINKS:
        return [mass * moment for moment in hardware.INERTIAL[LINKS[name][1]].per_mass]
    shape = bodies.shapes[name]
    if isinstance(shape, Hull):
        return [mass * moment for moment in shape.moments]
    x, y, z = shape
    return [mass / 12 * (y * y + z * z), mass / 12 * (x * x + z * z), mass / 12 * (x * x + y * y)]


NO_TORQUES = [0.0] * len(JOINTS)


class TriFingerClient(Client):
    """A physics client with a TriFinger in it.

    Attributes:
        bodies: The engine's numbers of all bodies.
        block_damping: What share of its speed a block loses in a second, roughly.
    """

    signed: ClassVar[bool] = True
    block_damping: ClassVar[float] = 0.0

    def __init__(self, engine: Any) -> None:
        super().__init__(engine)
        self.bodies = Handles(-1, -1, ())
        self._timestep = 0.0
        self._laws: dict[bool, Law] = {}
        self._torques = False
        self.furnish()

    @staticmethod
    def keys(structure: TriFinger) -> Iterable[ParameterKey]:
        """List every parameter of a structure."""
        return [row.key for row in structure.parameters]

    @staticmethod
    def heavy(structure: TriFinger) -> Iterator[ParameterKey]:
        """List the parameters that need new bodies, or new contacts."""
        yield ("robot", "height")
        hulls = dict(structure.hulls)
        for name in structure.blocks:
            if name not in hulls:
                yield (name, "size")
        for name in structure.obstacles:
            yield from ((name, quantity) for quantity in ("size", "position", "orientation"))

    @staticmethod
    def rotations(structure: TriFinger) -> Sequence[int]:
        """List where the quaternions of the blocks begin."""
        return range(ROBOT_SIZE + 3, structure.layout.size, BLOCK_SIZE)

    def furnish(self) -> None:
        """Add what stands in every scene."""
        engine, handle = self.engine, self.handle
        floor = arena.add_floor(engine, handle)
        stage = arena.add_stage(engine, handle)
        self.bodies = Handles(arena.add_robot(engine, handle), floor, stage)
        super().furnish()

    def construct(self, structure: TriFinger, parameters: Values) -> None:
        """Make sure that the obstacles and blocks are there, with their shapes."""
        timestep, self._torques = structure.preset.timestep, structure.torques
        if timestep != self._timestep:
            self.engine.setPhysicsEngineParameter(
                fixedTimeStep=timestep, physicsClientId=self.handle
            )
            self._timestep = timestep
        hulls = dict(structure.hulls)
        shapes = {
            name: hulls.get(name) or parameters[name, "size"]
            for name in (*structure.obstacles, *structure.blocks)
        }
        same = list(self.bodies.shapes.items()) == list(shapes.items())
        if not same or tuple(self.bodies.blocks) != structure.blocks:
            self._remake(structure, shapes)

    def _remake(self, structure: TriFinger, shapes: dict[str, arena.Shape]) -> None:
        """Replace all obstacles and blocks: their order in the engine is that in the structure."""
        engine, handle, was = self.engine, self.handle, self.bodies
        for body in reversed((*was.obstacles.values(), *was.blocks.values())):
            engine.removeBody(body, physicsClientId=handle)
        gone = {*was.shapes, "world"}  # what holds for every contact is set on every body
        self.applied = {key: v for key, v in self.applied.items() if key[0] not in gone}
        obstacles = {
            name: arena.add_obstacle(engine, handle, shapes[name]) for name in structure.obstacles
        }
        blocks = {
            name: arena.add_block(engine, handle, shapes[name], damping=self.block_damping)
            for name in structure.blocks
        }
        self.bodies = replace(was, obstacles=obstacles, blocks=blocks, shapes=shapes)

    def entered(self) -> Iterator[tuple[int, int, int, int]]:
        """List bodies and links, each with group and mask, in the order in which they meet."""
        bodies = self.bodies
        for body in bodies.obstacles.values():
            yield body, -1, arena.OBSTACLE, arena.OBSTACLE_MASK
        for link, group, mask in arena.LINK_GROUPS:
            yield bodies.robot, link, group, mask
        for body in bodies.blocks.values():
            yield body, -1, arena.BLOCK, -1

    def pose(self, parameters: Values, state: list[float]) -> None:
        """Put all that stands or moves in its place, and make the engine forget the contacts."""
        engine, handle, robot = self.engine, self.handle, self.bodies.robot
        for name, body in self.bodies.obstacles.items():
            place, turn = parameters[name, "position"], parameters[name, "orientation"]
            if not any(turn):
                problem = f"{name}.orientation must be a quaternion, got {turn}"
                raise EngineFailure(problem, "bullet")
            engine.resetBasePositionAndOrientation(body, place, turn, physicsClientId=handle)
        yaw, z = hardware.WORLD_YAW, parameters["robot", "height"] - hardware.TABLE_OFFSET
        turn = [0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)]
        engine.resetBasePositionAndOrientation(robot, [0.0, 0.0, z], turn, physicsClientId=handle)
        for joint, angle, speed in zip(JOINTS, state[:9], state[9:18], strict=True):
            engine.resetJointState(robot, joint, angle, speed, physicsClientId=handle)
        for index, body in enumerate(self.bodies.blocks.values()):
            row = state[ROBOT_SIZE + BLOCK_SIZE * index :][:BLOCK_SIZE]
            engine.resetBasePositionAndOrientation(body, row[:3], row[3:7], physicsClientId=handle)
            engine.resetBaseVelocity(body, row[7:10], row[10:13], physicsClientId=handle)
        for body, link, group, mask in self.entered():
            engine.setCollisionFilterGroupMask(body, link, group, mask, physicsClientId=handle)

    def write(self, key: ParameterKey, value: Any) -> None:
        """Set one parameter of live bodies, and the inertia that follows from a mass.

        Nothing is to be done for those of the controller and for joint damping.
        """
        engine, handle, bodies, (name, quantity) = self.engine, self.handle, self.bodies, key
        changes: list[tuple[tuple[int, int], dict[str, Any]]] = []
        match quantity:
            case "gravity":
                engine.setGravity(*value, physicsClientId=handle)
            case "color":
                for place in bodies.places(name):
                    engine.changeVisualShape(
                        *place, rgbaColor=[*value, 1.0], physicsClientId=handle
                    )
            case "mass":
                inertia = moments(bodies, name, value)
                changes = [(bodies.place(name), {"mass": value, "localInertiaDiagonal": inertia})]
            case "friction":
                changes = [(place, {"lateralFriction": value}) for place in bodies.places(name)]
            case "restitution":  # that of a contact is the product
                if value < 0.0:
                    problem = f"restitution must not be negative, got {value}"
                    raise EngineFailure(problem, "bullet")
                root = {"restitution": math.sqrt(value)}
                changes = [(place, root) for places in bodies.groups() for place in places]
            case "spinning_friction":
                shares = zip(bodies.groups(), bodies.spinning, strict=True)
                changes = [
                    (place, {"spinningFriction": share * value})
                    for places, share in shares
                    for place in places
                ]
        for place, change in changes:  # one property a call, see ``add_robot``
            engine.changeDynamics(*place, physicsClientId=handle, **change)

    def written(self, keys: Iterable[ParameterKey]) -> None:
        """Compile another controller, if it was one."""
        if any(key[0] == "controller" for key in keys):
            told = {key: v for key, v in self.applied.items() if key[0] == "controller"}
            spec = controller_spec(arrays(told))
            self._laws = {torques: compile_law(spec, commanded=torques) for torques in (0, 1)}

    def parameter(self, key: ParameterKey) -> Floats:
        """Ask the engine for a parameter, in the units of the scene.

        Controller and joint damping are not in the engine, but in the torques it is given.
        """
        if key[0] == "controller" or key[1] == "joint_damping":
            return np.array(self.applied[key])
        engine, handle, bodies, (name, quantity) = self.engine, self.handle, self.bodies, key
        if quantity == "gravity":
            return self.gravity()
        if quantity == "height":
            pose = engine.getBasePositionAndOrientation(bodies.robot, physicsClientId=handle)
            return np.array(pose[0][2] + hardware.TABLE_OFFSET)
        if quantity == "color":
            body, link = bodies.place(name)
            shapes = engine.getVisualShapeData(body, physicsClientId=handle)
            return np.array(next(shape[7][:3] for shape in shapes if shape[1] == link))
        if quantity == "size" and name in bodies.obstacles:  # known from its picture only
            shapes = engine.getVisualShapeData(bodies.obstacles[name], physicsClientId=handle)
            return np.array(shapes[0][3])
        if quantity == "size":
            shapes = engine.getCollisionShapeData(bodies.blocks[name], -1, physicsClientId=handle)
            return np.array(shapes[0][3])
        if quantity in ("position", "orientation"):
            body = bodies.obstacles[name]
            position, turn = engine.getBasePositionAndOrientation(body, physicsClientId=handle)
            if quantity == "position":
                return np.array(position)
            value = np.array(turn)  # or the other one of the same orientation
            return -value if np.dot(value, self.applied[key]) < 0.0 else value
        place = bodies.places("robot" if name == "world" else name)[0]
        info = engine.getDynamicsInfo(*place, physicsClientId=handle)
        values = {  # that of every contact follows from a link's share of it
            "mass": info[0],
            "friction": info[1],
            "restitution": info[5] ** 2,
            "spinning_friction": info[7] / OTHER_SPINNING,
        }
        return np.array(values[quantity])

    def carrier(self, body: str) -> tuple[int, int]:
        """Give multibody and link of a block or link.

        The fingertip is a link of its own in this engine, and no part of link 3.
        """
        known(self.applied, [(body, "mass")])
        return self.bodies.place(body)

    def advance(self, command: Sequence[float], substeps: int) -> list[float]:
        """Hold a command for some physics steps, and return the torques of the last one [N m].

        Each physics step asks the engine once and tells it once. The torques are those of the
        controller; the resistance of viscous joints comes on top.
        """
        engine, handle, robot = self.engine, self.handle, self.bodies.robot
        ask, step = engine.getJointStates, engine.stepSimulation
        tell, torque_control = engine.setJointMotorControlArray, engine.TORQUE_CONTROL
        law, resist, torques = self._laws[self._torques], None, []
        damping = self.applied["robot", "joint_damping"]
        if damping:
            gravity, masses = self.applied["world", "gravity"], [self.applied[k] for k in MASSES]
            resist = resistance(damping, self._timestep, gravity, masses)
        for _ in range(substeps):
            joints = ask(robot, JOINTS, physicsClientId=handle)
            torques = law(joints, command)
            total = torques if resist is None else resist(joints, torques)
            tell(robot, JOINTS, torque_control, forces=total, physicsClientId=handle)
            step(physicsClientId=handle)
        return torques

    def ask(self) -> list[float]:
        """Ask the engine for the state, without the torques."""
        engine, handle = self.engine, self.handle
        joints = engine.getJointStates(self.bodies.robot, JOINTS, physicsClientId=handle)
        state = [joint[0] for joint in joints]
        state += [joint[1] for joint in joints]
        state += NO_TORQUES
        for body in self.bodies.blocks.values():
            position, turn = engine.getBasePositionAndOrientation(body, physicsClientId=handle)
            linear, angular = engine.getBaseVelocity(body, physicsClientId=handle)
            state += position
            state += turn if turn[3] >= 0.0 else [-part for part in turn]
            state += linear
            state += angular
        return state

    def owner(self, multibody: int, link: int) -> str:
        """Name the link, block, obstacle or surface that a shape of the engine belongs to."""
        bodies = self.bodies
        if multibody == bodies.robot:
            finger, part = divmod(link, LINKS_IN_ENGINE)
            return hardware.link_name(hardware.FINGERS[finger], min(part, LOWER))
        if multibody in (bodies.floor, bodies.ground):
            return "floor"
        boxes = (*bodies.blocks.items(), *bodies.obstacles.items())
        return next((name for name, number in boxes if number == multibody), "stage")
