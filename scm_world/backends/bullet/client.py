"""One physics client of the engine, with robot, floor, stage and blocks in it."""

from __future__ import annotations

import operator
import weakref
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, final

from scm_world.backends.bullet import arena
from scm_world.backends.bullet.description import JOINTS
from scm_world.backends.bullet.dynamics import Bodies, write
from scm_world.backends.bullet.law import Law, compile_law
from scm_world.backends.bullet.values import Instant, Values, number, numbers
from scm_world.errors import EngineFailure
from scm_world.scene.controller import ControllerSpec, ControlMode
from scm_world.scene.scene import Structure
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
        self._spec: ControllerSpec | None = None
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

        Blocks keep their bodies where their sizes stay; all else that remembers the past, the
        contact caches, goes when the collision objects are entered anew, always in one order.
        """
        self.generation += 1
        self._doomed.extend(self._saved)
        self._bury()
        structure, parameters, state = instant.structure, instant.parameters, instant.state
        self._configure(structure)
        sizes = [numbers(parameters, (name, "size")) for name in structure.blocks]
        if self.bodies.sizes != sizes or tuple(self.bodies.blocks) != structure.blocks:
            self._remake(structure.blocks, sizes)
        self._pose(number(parameters, ("robot", "height")), state)
        self.applied["robot", "height"] = parameters["robot", "height"]
        self.edit(parameters)
        self._check(state)
        self._untouched = state

    def _configure(self, structure: Structure) -> None:
        timestep = structure.preset.timestep
        if timestep != self._timestep:
            self.engine.setPhysicsEngineParameter(
                fixedTimeStep=timestep, physicsClientId=self.handle
            )
            self._timestep = timestep
        if structure.controller != self._spec:
            self._spec = structure.controller
            self._laws = {mode: compile_law(self._spec, mode) for mode in ControlMode}

    def _remake(self, names: Sequence[str], sizes: list[list[float]]) -> None:
        """Replace all blocks, so that their order in the engine is theirs in the structure."""
        engine, handle = self.engine, self.handle
        for body in reversed(self.bodies.blocks.values()):
            engine.removeBody(body, physicsClientId=handle)
        for name in self.bodies.blocks:
            for key in [key for key in self.applied if key[0] == name]:
                del self.applied[key]
        blocks = {
            name: arena.add_block(engine, handle, size)
            for name, size in zip(names, sizes, strict=True)
        }
        self.bodies = Bodies(self.bodies.robot, self.bodies.floor, self.bodies.stage, blocks, sizes)
        for name, size in zip(blocks, sizes, strict=True):
            self.applied[name, "size"] = size

    def _pose(self, height: float, state: list[float]) -> None:
        """Put everything in its place, and make the engine forget what touched what."""
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
        for key, value in parameters.items():
            if self.applied.get(key) != value:
                self.applied.pop(key, None)  # unknown, should the engine fail
                write(self.engine, self.handle, self.bodies, key, value)
                self.applied[key] = value

    def advance(self, mode: ControlMode, command: Sequence[float], substeps: int) -> list[float]:
        """Hold a command for some physics steps, and return the torques of the last one [N m].

        Each physics step asks the engine once and tells it once.
        """
        engine, handle, robot = self.engine, self.handle, self.bodies.robot
        ask, step = engine.getJointStates, engine.stepSimulation
        tell, torque_control = engine.setJointMotorControlArray, engine.TORQUE_CONTROL
        law, torques = self._laws[mode], []
        self._untouched = None
        for _ in range(substeps):
            torques = law(ask(robot, JOINTS, physicsClientId=handle), command)
            tell(robot, JOINTS, torque_control, forces=torques, physicsClientId=handle)
            step(physicsClientId=handle)
        return torques

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
        """Make sure that the engine took the state, up to rounding and the sign of a quaternion."""
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
