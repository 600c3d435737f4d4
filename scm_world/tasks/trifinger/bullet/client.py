"""A physics client with robot, floor, stage and blocks in it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from scm_world._types import Floats
from scm_world.backends.base import Contact
from scm_world.backends.bullet.client import Client
from scm_world.backends.bullet.values import (
    Values,
    arrays,
    known,
    normalize,
    number,
    numbers,
    plain_state,
)
from scm_world.errors import EngineFailure
from scm_world.models.scene import ControlMode, ParameterKey
from scm_world.models.state import State
from scm_world.tasks.trifinger.bullet import arena, dynamics, touch
from scm_world.tasks.trifinger.bullet.description import JOINTS
from scm_world.tasks.trifinger.bullet.dynamics import Bodies
from scm_world.tasks.trifinger.bullet.law import Law, compile_law
from scm_world.tasks.trifinger.bullet.passive import MASSES, Resistance, resistance
from scm_world.tasks.trifinger.state import BLOCK_SIZE, ROBOT_SIZE
from scm_world.tasks.trifinger.structure import Structure, controller_spec, parameter_keys

NO_TORQUES = [0.0] * len(JOINTS)


class TriFingerClient(Client):
    """A physics client with a TriFinger in it.

    Attributes:
        bodies: The engine's numbers of all bodies.
        block_damping: What share of its speed a block loses in a second, roughly.
    """

    block_damping: ClassVar[float] = 0.0

    modes: ClassVar[tuple[ControlMode, ...]] = (
        ControlMode.JOINT_POSITIONS,
        ControlMode.JOINT_TORQUES,
    )

    def __init__(self, engine: Any) -> None:
        super().__init__(engine)
        self.bodies = Bodies(-1, -1, ())
        self._timestep = 0.0
        self._laws: dict[ControlMode, Law] = {}

    @staticmethod
    def keys(structure: Structure) -> Iterable[ParameterKey]:
        """List every parameter of a structure."""
        return parameter_keys(structure)

    @staticmethod
    def check(structure: Structure, parameters: Values) -> None:
        """Find nothing: the engine can honour all of it."""

    @staticmethod
    def heavy(structure: Structure) -> Iterator[ParameterKey]:
        """List the parameters that need new bodies, or new contacts."""
        yield ("robot", "height")
        hulls = dict(structure.hulls)
        for name in structure.blocks:
            if name not in hulls:
                yield (name, "size")
        for name in structure.obstacles:
            yield from ((name, quantity) for quantity in ("size", "position", "orientation"))

    @staticmethod
    def settle(structure: Structure, given: State) -> list[float]:
        """Turn a state into plain numbers, with unit quaternions whose w is not negative."""
        plain = plain_state(structure, given)
        plain[18:ROBOT_SIZE] = NO_TORQUES
        rotations = TriFingerClient.rotations(structure)
        normalize(plain, rotations)
        for start in rotations:
            if plain[start + 3] < 0.0:
                plain[start : start + 4] = [-part for part in plain[start : start + 4]]
        return plain

    @staticmethod
    def rotations(structure: Structure) -> Sequence[int]:
        """List where the quaternions of the blocks begin."""
        return range(ROBOT_SIZE + 3, structure.layout.size, BLOCK_SIZE)

    def furnish(self) -> None:
        """Add what stands in every scene."""
        engine, handle = self.engine, self.handle
        floor = arena.add_floor(engine, handle)
        stage = arena.add_stage(engine, handle)
        self.bodies = Bodies(arena.add_robot(engine, handle), floor, stage)
        self.set_solver()

    def construct(self, structure: Structure, parameters: Values) -> None:
        """Make sure that the obstacles and blocks are there, with their shapes."""
        timestep = structure.preset.timestep
        if timestep != self._timestep:
            self.engine.setPhysicsEngineParameter(
                fixedTimeStep=timestep, physicsClientId=self.handle
            )
            self._timestep = timestep
        hulls = dict(structure.hulls)
        shapes = {
            name: hulls.get(name) or numbers(parameters, (name, "size"))
            for name in (*structure.obstacles, *structure.blocks)
        }
        same = list(self.bodies.shapes.items()) == list(shapes.items())
        if not same or tuple(self.bodies.blocks) != structure.blocks:
            self._remake(structure, shapes)

    def _remake(self, structure: Structure, shapes: dict[str, arena.Shape]) -> None:
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

    def _place(self, parameters: Values) -> None:
        """Put the obstacles in their places."""
        engine, handle = self.engine, self.handle
        for name, body in self.bodies.obstacles.items():
            position = numbers(parameters, (name, "position"))
            turn = numbers(parameters, (name, "orientation"))
            if not any(turn):
                raise EngineFailure(
                    f"{name}.orientation must be a quaternion, got {turn}", "bullet"
                )
            engine.resetBasePositionAndOrientation(body, position, turn, physicsClientId=handle)

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
        self._place(parameters)
        engine, handle, robot = self.engine, self.handle, self.bodies.robot
        position, orientation = arena.robot_pose(number(parameters, ("robot", "height")))
        engine.resetBasePositionAndOrientation(robot, position, orientation, physicsClientId=handle)
        for joint, angle, speed in zip(JOINTS, state[:9], state[9:18], strict=True):
            engine.resetJointState(robot, joint, angle, speed, physicsClientId=handle)
        for index, body in enumerate(self.bodies.blocks.values()):
            row = state[ROBOT_SIZE + BLOCK_SIZE * index :][:BLOCK_SIZE]
            engine.resetBasePositionAndOrientation(body, row[:3], row[3:7], physicsClientId=handle)
            engine.resetBaseVelocity(body, row[7:10], row[10:13], physicsClientId=handle)
        for body, link, group, mask in self.entered():
            engine.setCollisionFilterGroupMask(body, link, group, mask, physicsClientId=handle)

    def write(self, key: ParameterKey, value: Any) -> None:
        """Set one parameter of live bodies."""
        dynamics.write(self.engine, self.handle, self.bodies, key, value)

    def written(self, keys: Iterable[ParameterKey]) -> None:
        """Compile another controller, if it was one."""
        if any(key[0] == "controller" for key in keys):
            told = {key: v for key, v in self.applied.items() if key[0] == "controller"}
            spec = controller_spec(arrays(told))
            self._laws = {mode: compile_law(spec, mode) for mode in self.modes}

    def parameter(self, key: ParameterKey) -> Floats:
        """Ask the engine for a parameter, in the units of the scene.

        Controller and joint damping are not in the engine, but in the torques it is given.
        """
        if key[0] == "controller" or key[1] == "joint_damping":
            return np.array(self.applied[key])
        value = dynamics.read(self.engine, self.handle, self.bodies, key)
        if key[1] == "orientation" and np.dot(value, self.applied[key]) < 0.0:
            return -value  # the same orientation
        return value

    def inertia(self, body: str) -> Floats:
        """Ask for the principal moments of inertia of a block or link, shape (3,) [kg m²].

        The fingertip is a link of its own in this engine, and no part of link 3.
        """
        known(self.applied, [(body, "mass")])
        place = self.bodies.place(body)
        return np.array(self.engine.getDynamicsInfo(*place, physicsClientId=self.handle)[2])

    def advance(self, mode: ControlMode, command: Sequence[float], substeps: int) -> list[float]:
        """Hold a command for some physics steps, and return the torques of the last one [N m].

        Each physics step asks the engine once and tells it once. The torques are those of the
        controller; the resistance of viscous joints comes on top.
        """
        engine, handle, robot = self.engine, self.handle, self.bodies.robot
        ask, step = engine.getJointStates, engine.stepSimulation
        tell, torque_control = engine.setJointMotorControlArray, engine.TORQUE_CONTROL
        law, resist, torques = self._laws[mode], self._resistance(), []
        for _ in range(substeps):
            joints = ask(robot, JOINTS, physicsClientId=handle)
            torques = law(joints, command)
            total = torques if resist is None else resist(joints, torques)
            tell(robot, JOINTS, torque_control, forces=total, physicsClientId=handle)
            step(physicsClientId=handle)
        return torques

    def _resistance(self) -> Resistance | None:
        """Give what viscous joints add to torques; None where they are not viscous."""
        damping = number(self.applied, ("robot", "joint_damping"))
        if not damping:
            return None
        gravity = numbers(self.applied, ("world", "gravity"))
        masses = [number(self.applied, key) for key in MASSES]
        return resistance(damping, self._timestep, gravity, masses)

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

    def contacts(self) -> tuple[Contact, ...]:
        """List the contact points of the last physics step."""
        return touch.contacts(self.engine, self.handle, self.bodies)
