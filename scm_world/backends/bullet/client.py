"""One physics client of the engine, with robot, floor, stage and blocks in it."""

from __future__ import annotations

import operator
import weakref
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, final

import numpy as np

from scm_world._types import Floats
from scm_world.backends.bullet import arena, dynamics
from scm_world.backends.bullet.description import JOINTS
from scm_world.backends.bullet.dynamics import Bodies
from scm_world.backends.bullet.law import Law, compile_law
from scm_world.backends.bullet.passive import MASSES, Resistance, resistance
from scm_world.backends.bullet.values import Instant, Values, arrays, heavy, number, numbers
from scm_world.errors import EngineFailure
from scm_world.models.scene import ControlMode, ParameterKey
from scm_world.scene.scene import Structure, controller_spec
from scm_world.scene.state import BLOCK_SIZE, ROBOT_SIZE

SOLVER_ITERATIONS = 50  # with 20, towers spike at 40 mm/s
TOLERANCE = 1e-6  # how far a state that was set may read back from what was asked


@final
class Client:
    """A physics client, and what is known about it without asking.

    Attributes:
        engine: The module ``pybullet``.
        handle: The number of the client; None once it is closed.
        bodies: The engine's numbers of all bodies.
        applied: The value of each parameter that is in force.
        generation: Counts the canonical states; a saved state is exact within one of them.
    """

    def __init__(self, engine: Any) -> None:
        self.engine = engine
        self.handle = engine.connect(engine.DIRECT)
        if self.handle < 0:
            raise EngineFailure("Bullet has no physics client left; close some backends", "bullet")
        self.bodies = Bodies(-1, -1, ())
        self.applied: Values = {}
        self.generation = 0
        self._timestep = 0.0
        self._laws: dict[ControlMode, Law] = {}
        self._untouched: list[float] | None = None
        self._saved: dict[int, int] = {}  # ticket to the engine's number, which it uses again
        self._tickets = 0
        self._doomed: list[int] = []
        self._close = weakref.finalize(self, _disconnect, engine, self.handle)

    def close(self) -> None:
        """Disconnect. Closing twice is harmless."""
        self._close()
        self.handle = None

    def furnish(self) -> None:
        """Add what stands in every scene."""
        engine, handle = self.engine, self.handle
        floor = arena.add_floor(engine, handle)
        stage = arena.add_stage(engine, handle)
        self.bodies = Bodies(arena.add_robot(engine, handle), floor, stage)
        engine.setPhysicsEngineParameter(
            numSolverIterations=SOLVER_ITERATIONS,
            # An early end, decided for all bodies together, would let bodies act on each other
            # without touching.
            solverResidualThreshold=0.0,
            deterministicOverlappingPairs=1,
            physicsClientId=handle,
        )

    def canonicalize(self, instant: Instant) -> None:
        """Bring about the one world that has these parameters and this state, whatever was before.

        Bodies stay where all their shapes stay; all else that remembers the past, the contact
        caches, goes when the collision objects are entered anew, always in one order.
        """
        self.generation += 1
        self._doomed.extend(self._saved)
        self._bury()
        structure, parameters, state = instant.structure, instant.parameters, instant.state
        timestep = structure.preset.timestep
        if timestep != self._timestep:
            self.engine.setPhysicsEngineParameter(
                fixedTimeStep=timestep, physicsClientId=self.handle
            )
            self._timestep = timestep
        self._shape(structure, parameters)
        self._place(parameters)
        self._pose(number(parameters, ("robot", "height")), state)
        self.applied.update((key, parameters[key]) for key in heavy(structure))
        self.edit(parameters)
        self._check(state)
        self._untouched = state

    def _shape(self, structure: Structure, parameters: Values) -> None:
        """Make sure that the obstacles and blocks are there, with their shapes."""
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
        blocks = {name: arena.add_block(engine, handle, shapes[name]) for name in structure.blocks}
        self.bodies = Bodies(was.robot, was.floor, was.stage, obstacles, blocks, shapes)

    def _place(self, parameters: Values) -> None:
        """Put the obstacles in their places, and enter them anew."""
        engine, handle = self.engine, self.handle
        group, mask = arena.OBSTACLE, arena.OBSTACLE_MASK
        for name, body in self.bodies.obstacles.items():
            position = numbers(parameters, (name, "position"))
            turn = numbers(parameters, (name, "orientation"))
            if not any(turn):
                raise EngineFailure(
                    f"{name}.orientation must be a quaternion, got {turn}", "bullet"
                )
            engine.resetBasePositionAndOrientation(body, position, turn, physicsClientId=handle)
            engine.setCollisionFilterGroupMask(body, -1, group, mask, physicsClientId=handle)

    def _pose(self, height: float, state: list[float]) -> None:
        """Put all that moves in its place, and make the engine forget what touched what."""
        engine, handle, robot = self.engine, self.handle, self.bodies.robot
        position, orientation = arena.robot_pose(height)
        engine.resetBasePositionAndOrientation(robot, position, orientation, physicsClientId=handle)
        for joint, angle, speed in zip(JOINTS, state[:9], state[9:18], strict=True):
            engine.resetJointState(robot, joint, angle, speed, physicsClientId=handle)
        for link, group, mask in arena.LINK_GROUPS:
            engine.setCollisionFilterGroupMask(robot, link, group, mask, physicsClientId=handle)
        for index, body in enumerate(self.bodies.blocks.values()):
            row = state[ROBOT_SIZE + BLOCK_SIZE * index :][:BLOCK_SIZE]
            engine.resetBasePositionAndOrientation(body, row[:3], row[3:7], physicsClientId=handle)
            engine.resetBaseVelocity(body, row[7:10], row[10:13], physicsClientId=handle)
            engine.setCollisionFilterGroupMask(body, -1, arena.BLOCK, -1, physicsClientId=handle)

    def edit(self, parameters: Values) -> None:
        """Change parameters that need no new bodies. What is in force already is left alone."""
        other_law = False
        for key, value in parameters.items():
            if self.applied.get(key) != value:
                self.applied.pop(key, None)  # unknown, should the engine fail
                dynamics.write(self.engine, self.handle, self.bodies, key, value)
                self.applied[key] = value
                other_law = other_law or key[0] == "controller"
        if other_law:
            told = {key: v for key, v in self.applied.items() if key[0] == "controller"}
            spec = controller_spec(arrays(told))
            self._laws = {mode: compile_law(spec, mode) for mode in ControlMode}

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

    def advance(self, mode: ControlMode, command: Sequence[float], substeps: int) -> list[float]:
        """Hold a command for some physics steps, and return the torques of the last one [N m].

        Each physics step asks the engine once and tells it once. The torques are those of the
        controller; the resistance of viscous joints comes on top.
        """
        engine, handle, robot = self.engine, self.handle, self.bodies.robot
        ask, step = engine.getJointStates, engine.stepSimulation
        tell, torque_control = engine.setJointMotorControlArray, engine.TORQUE_CONTROL
        law, resist, torques = self._laws[mode], self._resistance(), []
        self._untouched = None
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

    def read(self, torques: list[float]) -> list[float]:
        """Read the present state as the numbers of a ``PhysicalState``.

        A state that was set and not stepped yet reads as it was set; ``canonicalize`` has made
        sure that the engine agrees up to rounding.
        """
        if self._untouched is not None:
            return [*self._untouched[:18], *torques, *self._untouched[ROBOT_SIZE:]]
        return self._ask(torques)

    def _ask(self, torques: list[float]) -> list[float]:
        engine, handle = self.engine, self.handle
        joints = engine.getJointStates(self.bodies.robot, JOINTS, physicsClientId=handle)
        state = [joint[0] for joint in joints]
        state += [joint[1] for joint in joints]
        state += torques
        for body in self.bodies.blocks.values():
            position, turn = engine.getBasePositionAndOrientation(body, physicsClientId=handle)
            linear, angular = engine.getBaseVelocity(body, physicsClientId=handle)
            state += position
            state += turn if turn[3] >= 0.0 else [-part for part in turn]
            state += linear
            state += angular
        return state

    def _check(self, state: list[float]) -> None:
        """Make sure that the engine took the state, up to rounding and the sign of a quaternion.

        Raises:
            EngineFailure: It did not.
        """
        actual = self._ask(state[18:ROBOT_SIZE])
        for start in range(ROBOT_SIZE + 3, len(actual), BLOCK_SIZE):
            turn, wanted = actual[start : start + 4], state[start : start + 4]
            if sum(map(operator.mul, turn, wanted)) < 0.0:
                actual[start : start + 4] = [-part for part in turn]
        if any(
            not abs(there - here) <= TOLERANCE * (1.0 + abs(here))
            for here, there in zip(state, actual, strict=True)
        ):
            raise EngineFailure("Bullet did not take the state that was set", "bullet")

    def save(self) -> int:
        """Keep the engine's own state in this process and return a ticket for it."""
        self._bury()
        self._tickets += 1
        self._saved[self._tickets] = self.engine.saveState(physicsClientId=self.handle)
        return self._tickets

    def load(self, ticket: int) -> None:
        """Go back to a state saved in this generation. Parameters are not part of it."""
        self.engine.restoreState(stateId=self._saved[ticket], physicsClientId=self.handle)
        self._untouched = None

    def forget(self, ticket: int) -> None:
        """Free a saved state, at the next quiet moment: this may run amid an engine call."""
        self._doomed.append(ticket)

    def _bury(self) -> None:
        while self._doomed:
            number = self._saved.pop(self._doomed.pop(), None)
            if number is not None:
                self.engine.removeState(number, physicsClientId=self.handle)


def _disconnect(engine: Any, handle: int) -> None:
    with suppress(engine.error):
        engine.disconnect(physicsClientId=handle)
