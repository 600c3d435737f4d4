"""A physics client with any model in it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple, final

import numpy as np

from scm_world._types import Floats
from scm_world.backends.base import Contact
from scm_world.backends.bullet.client import Client
from scm_world.backends.bullet.model.build import Built, build, solid
from scm_world.backends.bullet.model.forces import Forces
from scm_world.backends.bullet.model.frames import Ball, Frame
from scm_world.backends.bullet.model.friction import shares, usual_friction
from scm_world.backends.bullet.model.support import changes, unsupported
from scm_world.backends.bullet.values import Values, normalize, plain_state
from scm_world.errors import ModelError, NotIntervenable, UnknownOption
from scm_world.models.bodies import Bodies
from scm_world.models.model import Model
from scm_world.models.scene import ControlMode, ParameterKey
from scm_world.models.state import State


class Scalars(NamedTuple):
    """Hinges and slides of one multibody.

    Attributes:
        multibody: Its number.
        links: Their links.
        places: Where they begin in the state, and their references.
    """

    multibody: int
    links: list[int]
    places: list[tuple[int, float]]


class Drive(NamedTuple):
    """Hinges and slides of one multibody that are told forces.

    Attributes:
        multibody: Its number.
        links: Their links.
        dofs: Their degrees of freedom.
    """

    multibody: int
    links: list[int]
    dofs: list[int]


@lru_cache(maxsize=64)
def _rotations(model: Model) -> tuple[int, ...]:
    """List where in the state quaternions begin."""
    slices = model.layout.slices
    return tuple(slices[row.name].start for row in model.states if row.kind == "rotation")


@final
class ModelClient(Client):
    """A physics client with a ``Model`` in it.

    Springs, dampers and actuators are not in the engine, but in the forces that it is told.
    """

    modes: ClassVar[tuple[ControlMode, ...]] = (ControlMode.CONTROLS,)

    def __init__(self, engine: Any) -> None:
        super().__init__(engine)
        self._model: Any = None
        self._inside: Values = {}  # parameters that were built into the bodies
        self._size = 0  # of the state

    # --- what a model is -------------------------------------------------------------------------

    @staticmethod
    def keys(structure: Model) -> Iterable[ParameterKey]:
        """List every parameter of a model, also those that the engine lacks."""
        return (row.key for row in structure.parameters)

    @staticmethod
    def check(structure: Model, parameters: Values) -> None:
        """Say what the engine cannot honour, before anything is made.

        Raises:
            ModelError: All of it that is in the model.
            NotIntervenable: A parameter that the engine lacks is not as in the model.
        """
        problems = unsupported(structure)
        if problems:
            advice = "take it out of the model, or use backend='mujoco'"
            raise ModelError([f"Bullet cannot honour {what}; {advice}" for what in problems])
        known = changes(structure.bodies)
        for row in structure.parameters:
            if row.visual or row.key in known:
                continue
            default, value = np.array(row.default), parameters[row.key]
            if not np.array_equal(np.broadcast_to(default, row.shape), value):
                raise NotIntervenable(
                    row.name,
                    f"is no parameter on Bullet: there it keeps its default {row.default}; use "
                    "backend='mujoco'",
                )

    @staticmethod
    def heavy(structure: Model) -> Iterable[ParameterKey]:
        """List the parameters that need new bodies."""
        known = changes(structure.bodies)
        return [row.key for row in structure.parameters if known.get(row.key) == "rebuilt"]

    @staticmethod
    def settle(structure: Model, given: State) -> list[float]:
        """Turn a state into plain numbers, with unit quaternions of either sign."""
        plain = plain_state(structure, given)
        normalize(plain, _rotations(structure))
        return plain

    @staticmethod
    def rotations(structure: Model) -> Sequence[int]:
        """List where in the state the quaternions begin."""
        return _rotations(structure)

    # --- bodies ----------------------------------------------------------------------------------

    def furnish(self) -> None:
        """Set how the engine works; nothing stands in every scene."""
        self.set_solver()

    def construct(self, structure: Model, parameters: Values) -> None:
        """Make everything anew, unless only other parameters differ from what is there."""
        inside = {key: parameters[key] for key in self.heavy(structure)}
        if self._model == structure and self._inside == inside:
            return
        self._model, self._inside = structure, inside
        self.engine.resetSimulation(physicsClientId=self.handle)
        self.furnish()
        self.applied = dict(parameters)
        self._bodies = bodies = structure.bodies.with_parameters(
            {key: value for key, value in parameters.items() if key in changes(structure.bodies)}
        )
        self._built = build(self.engine, self.handle, bodies)
        self._find(bodies, self._built, structure.layout.size)
        self._shares = [math.nan] * len(bodies.geoms)
        for number in self._built.bodies:
            self._weigh(number)
        for number in range(len(bodies.joints)):
            self._limit(number)
        self._set_world()
        self._follow()

    def _find(self, bodies: Bodies, built: Built, size: int) -> None:
        """Remember how states are written and read."""
        self._size = size
        self._frames: list[Frame] = []
        self._ball_joints: dict[int, Ball] = {}
        scalars: dict[int, Scalars] = {}
        for number, joint in enumerate(bodies.joints):
            multibody, link = built.joints[number]
            if joint.kind == "free":
                body = bodies.bodies[joint.body]
                self._frames.append(Frame(multibody, joint.start, body.center, body.axes))
            elif joint.kind == "ball":
                last = max(bodies.joints_of(joint.body)) == number  # the others carry no mass
                axes = bodies.bodies[joint.body].axes if last else (0.0, 0.0, 0.0, 1.0)
                self._ball_joints[number] = Ball(multibody, link, joint.start, axes)
            else:
                found = scalars.setdefault(multibody, Scalars(multibody, [], []))
                found.links.append(link)
                found.places.append((joint.start, joint.reference))
        self._scalars = list(scalars.values())

    def pose(self, parameters: Values, state: list[float]) -> None:
        """Put all that moves in its place, and make the engine forget what touched what."""
        engine, handle = self.engine, self.handle
        for multibody, links, places in self._scalars:
            for link, (start, reference) in zip(links, places, strict=True):
                value, speed = state[start] - reference, state[start + 1]
                engine.resetJointState(multibody, link, value, speed, physicsClientId=handle)
        for ball in self._ball_joints.values():
            turn, spin = ball.to_engine(state)
            engine.resetJointStateMultiDof(
                ball.multibody, ball.link, turn, spin, physicsClientId=handle
            )
        for frame in self._frames:
            position, turn, linear, angular = frame.to_engine(state)
            engine.resetBasePositionAndOrientation(
                frame.multibody, position, turn, physicsClientId=handle
            )
            engine.resetBaseVelocity(frame.multibody, linear, angular, physicsClientId=handle)
        for multibody, link, group, mask in self._built.groups:
            engine.setCollisionFilterGroupMask(multibody, link, group, mask, physicsClientId=handle)

    def ask(self) -> list[float]:
        """Ask the engine for the state."""
        engine, handle, state = self.engine, self.handle, [0.0] * self._size
        for multibody, links, places in self._scalars:
            rows = engine.getJointStates(multibody, links, physicsClientId=handle)
            for (start, reference), row in zip(places, rows, strict=True):
                state[start], state[start + 1] = row[0] + reference, row[1]
        for ball in self._ball_joints.values():
            row = engine.getJointStateMultiDof(ball.multibody, ball.link, physicsClientId=handle)
            state[ball.start : ball.start + 7] = ball.from_engine(row[0], row[1])
        for frame in self._frames:
            pose = engine.getBasePositionAndOrientation(frame.multibody, physicsClientId=handle)
            twist = engine.getBaseVelocity(frame.multibody, physicsClientId=handle)
            state[frame.start : frame.start + 13] = frame.from_engine(pose, twist)
        return state

    # --- parameters ------------------------------------------------------------------------------

    def write(self, key: ParameterKey, value: Any) -> None:
        """Set one parameter of live bodies; forces follow from all of them, see ``written``."""
        if key not in changes(self._model.bodies):
            return
        self._bodies = self._bodies.with_parameters({key: value})
        table, row, parts = self._bodies.places[key]
        field = parts[0].field
        if table == "bodies" and row in self._built.bodies:
            self._weigh(row)
        elif table == "joints" and field in ("range", "friction"):
            self._limit(row)
        elif not table:
            self._set_world()

    def written(self, keys: Iterable[ParameterKey]) -> None:
        """Compute forces and frictions anew."""
        self._follow()

    def _weigh(self, body: int) -> None:
        """Give a body its mass and moments of inertia."""
        moments, _ = solid(self._bodies, body)
        self.engine.changeDynamics(
            *self._built.bodies[body],
            mass=self._bodies.bodies[body].mass,
            localInertiaDiagonal=moments.tolist(),
            physicsClientId=self.handle,
        )

    def _limit(self, number: int) -> None:
        """Give a joint its limits and its dry friction."""
        joint, place = self._bodies.joints[number], self._built.joints[number]
        if joint.range is not None:
            low, high = (end - joint.reference for end in joint.range)
            self.engine.changeDynamics(
                *place, jointLowerLimit=low, jointUpperLimit=high, physicsClientId=self.handle
            )
        if joint.kind in ("hinge", "slide"):
            self.engine.setJointMotorControl2(
                *place,
                self.engine.VELOCITY_CONTROL,
                targetVelocity=0.0,
                force=joint.friction,
                physicsClientId=self.handle,
            )

    def _set_world(self) -> None:
        """Set gravity and the physics step; dry friction is kept as an impulse for each step."""
        bodies = self._bodies
        self.engine.setGravity(*bodies.gravity, physicsClientId=self.handle)
        self.engine.setPhysicsEngineParameter(
            fixedTimeStep=bodies.timestep, physicsClientId=self.handle
        )
        for number, joint in enumerate(bodies.joints):
            if joint.friction:
                self._limit(number)

    def _follow(self) -> None:
        """Let forces and frictions follow from the parameters."""
        bodies, built = self._bodies, self._built
        numbers = shares(bodies, usual_friction(self._model.bodies))
        for number, (handle, share) in enumerate(zip(built.geoms, numbers, strict=True)):
            if share != self._shares[number]:
                self._shares[number] = math.nan  # unknown, should the engine fail
                self.engine.changeDynamics(
                    *handle, lateralFriction=share, physicsClientId=self.handle
                )
                self._shares[number] = share
        self._forces = forces = Forces(bodies)
        self._driven_balls = [
            (ball, forces.dofs[number])
            for number, ball in self._ball_joints.items()
            if number in forces.driven
        ]
        drives: dict[int, Drive] = {}
        for number in forces.driven:
            multibody, link = built.joints[number]
            if number not in self._ball_joints:
                found = drives.setdefault(multibody, Drive(multibody, [], []))
                found.links.append(link)
                found.dofs.append(forces.dofs[number])
        self._drives = list(drives.values())

    def parameter(self, key: ParameterKey) -> Floats:
        """Ask the engine for a parameter: mass, inertia, gravity and step; it has no others."""
        value = np.array(self.applied[key])
        if key not in changes(self._model.bodies):
            return value
        engine, handle = self.engine, self.handle
        _, row, parts = self._bodies.places[key]
        field = parts[0].field
        if field == "gravity":
            physics = engine.getPhysicsEngineParameters(physicsClientId=handle)
            return np.array([physics[f"gravityAcceleration{axis}"] for axis in "XYZ"])
        if field == "timestep":
            physics = engine.getPhysicsEngineParameters(physicsClientId=handle)
            return np.array(physics["fixedTimeStep"])
        if field in ("mass", "inertia") and row in self._built.bodies and key not in self._inside:
            info = engine.getDynamicsInfo(*self._built.bodies[row], physicsClientId=handle)
            return np.array(info[0] if field == "mass" else info[2])
        return value

    def inertia(self, body: str) -> Floats:
        """Ask for the principal moments of inertia of a body that can move [kg m²].

        Raises:
            UnknownOption: There is no such body.
        """
        names = {self._bodies.bodies[number].name: number for number in self._built.bodies}
        if body not in names:
            raise UnknownOption("body", body, names)
        place = self._built.bodies[names[body]]
        return np.array(self.engine.getDynamicsInfo(*place, physicsClientId=self.handle)[2])

    # --- steps -----------------------------------------------------------------------------------

    def advance(self, mode: ControlMode, command: Sequence[float], substeps: int) -> list[float]:
        """Hold a command for some physics steps."""
        engine, handle, forces = self.engine, self.handle, self._forces
        ask, step, tell = self.ask, engine.stepSimulation, engine.setJointMotorControlArray
        driven, torque_control = bool(forces.driven), engine.TORQUE_CONTROL
        total = forces([0.0] * self._size, command) if driven and forces.constant else []
        for _ in range(substeps):
            if driven and not forces.constant:
                total = forces(ask(), command)
            for multibody, links, dofs in self._drives:
                each = [total[dof] for dof in dofs]
                tell(multibody, links, torque_control, forces=each, physicsClientId=handle)
            for ball, dof in self._driven_balls:
                engine.setJointMotorControlMultiDof(
                    ball.multibody,
                    ball.link,
                    torque_control,
                    force=ball.torque(total[dof : dof + 3]),
                    physicsClientId=handle,
                )
            step(physicsClientId=handle)
        return []

    def contacts(self) -> tuple[Contact, ...]:
        """List the points that touch or press."""
        owners = self._built.owners
        return tuple(
            Contact(
                bodies=(owners[point[1], point[3]], owners[point[2], point[4]]),
                position=(np.array(point[5]) + np.array(point[6])) / 2,
                normal=-np.array(point[7]),  # the engine's points to the first body
                depth=-point[8],
                force=point[9],
            )
            for point in self.engine.getContactPoints(physicsClientId=self.handle)
            if point[8] <= 0.0 or point[9] > 0.0
        )
