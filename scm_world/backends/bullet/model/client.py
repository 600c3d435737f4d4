"""A physics client with any model in it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple, final

import numpy as np

from scm_world._types import Floats
from scm_world.backends.base import Contact
from scm_world.backends.bullet.client import SOLVER_ITERATIONS, Client
from scm_world.backends.bullet.model.build import Built, build, solid
from scm_world.backends.bullet.model.forces import DOFS, Forces
from scm_world.backends.bullet.model.frames import Frame
from scm_world.backends.bullet.model.friction import shares
from scm_world.backends.bullet.model.support import (
    parameters_without,
    rebuilt,
    supports,
    unsupported,
)
from scm_world.backends.bullet.values import Values, normalize, plain_state
from scm_world.errors import ModelError, UnknownOption
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
    """Joints of one multibody that are told forces.

    Attributes:
        multibody: Its number.
        links: Their links.
        dofs: Their degrees of freedom; three for each ball.
        balls: Whether they are balls.
    """

    multibody: int
    links: list[int]
    dofs: list[int]
    balls: bool


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
            UnknownOption: A parameter that the engine lacks is not as in the model.
        """
        problems = unsupported(structure)
        if problems:
            advice = "take it out of the model, or use backend='mujoco'"
            raise ModelError([f"Bullet cannot honour {what}; {advice}" for what in problems])
        lacking, defaults = parameters_without(structure), _defaults(structure)
        for key in lacking:
            if parameters[key] != defaults[key]:
                others = (".".join(row.key) for row in structure.parameters)
                raise UnknownOption(
                    "parameter on bullet",
                    ".".join(key),
                    (name for name in others if name),
                )

    @staticmethod
    def heavy(structure: Model) -> Iterable[ParameterKey]:
        """List the parameters that need new bodies."""
        return rebuilt(structure)

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
        self.engine.setPhysicsEngineParameter(
            numSolverIterations=SOLVER_ITERATIONS,
            # An early end, decided for all bodies together, would let bodies act on each other
            # without touching.
            solverResidualThreshold=0.0,
            deterministicOverlappingPairs=1,
            physicsClientId=self.handle,
        )

    def construct(self, structure: Model, parameters: Values) -> None:
        """Make everything anew, unless only other parameters differ from what is there."""
        inside = {key: parameters[key] for key in rebuilt(structure)}
        if self._model == structure and self._inside == inside:
            return
        self._model, self._inside = structure, inside
        self.engine.resetSimulation(physicsClientId=self.handle)
        self.furnish()
        self.applied = dict(parameters)
        self._bodies = bodies = structure.bodies.with_parameters(
            {key: value for key, value in parameters.items() if self._acts(key)}
        )
        self._built = build(self.engine, self.handle, bodies)
        self._find(bodies, self._built, structure.layout.size)
        self._shares: list[float] = []
        for number in self._built.bodies:
            self._weigh(number)
        for number in range(len(bodies.joints)):
            self._limit(number)
        self._set_world()
        self._follow()

    def _acts(self, key: ParameterKey) -> bool:
        """Tell whether a parameter is more than a color or a default."""
        return key in self._model.bodies.places and supports(self._model, key)

    def _find(self, bodies: Bodies, built: Built, size: int) -> None:
        """Remember how states are written and read."""
        self._size = size
        self._frames, self._balls = [], []
        scalars: dict[int, Scalars] = {}
        for joint, (multibody, link) in zip(bodies.joints, built.joints, strict=True):
            if joint.kind == "free":
                body = bodies.bodies[joint.body]
                self._frames.append(Frame(multibody, joint.start, body.center, body.axes))
            elif joint.kind == "ball":
                self._balls.append((multibody, link, joint.start))
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
        for multibody, link, start in self._balls:
            engine.resetJointStateMultiDof(
                multibody,
                link,
                state[start : start + 4],
                state[start + 4 : start + 7],
                physicsClientId=handle,
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
        for multibody, link, start in self._balls:
            row = engine.getJointStateMultiDof(multibody, link, physicsClientId=handle)
            state[start : start + 4], state[start + 4 : start + 7] = row[0], row[1]
        for frame in self._frames:
            pose = engine.getBasePositionAndOrientation(frame.multibody, physicsClientId=handle)
            twist = engine.getBaseVelocity(frame.multibody, physicsClientId=handle)
            state[frame.start : frame.start + 13] = frame.from_engine(pose, twist)
        return state

    # --- parameters ------------------------------------------------------------------------------

    def write(self, key: ParameterKey, value: Any) -> None:
        """Set one parameter of live bodies; forces follow from all of them, see ``written``."""
        if not self._acts(key):
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
        numbers = shares(bodies)
        for handle, share, before in zip(
            built.geoms, numbers, self._shares or [-1.0] * len(numbers), strict=True
        ):
            if share != before:
                self.engine.changeDynamics(
                    *handle, lateralFriction=share, physicsClientId=self.handle
                )
        self._shares = numbers
        self._forces = forces = Forces(bodies)
        drives: dict[tuple[int, bool], Drive] = {}
        for number in forces.driven:
            multibody, link = built.joints[number]
            kind, first = bodies.joints[number].kind, forces.dofs[number]
            found = drives.setdefault(
                (multibody, kind == "ball"), Drive(multibody, [], [], kind == "ball")
            )
            found.links.append(link)
            found.dofs.extend(range(first, first + DOFS[kind]))
        self._drives = list(drives.values())

    def parameter(self, key: ParameterKey) -> Floats:
        """Ask the engine for a parameter: mass, inertia, gravity and step; it has no others."""
        value = np.array(self.applied[key])
        if not self._acts(key):
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
        engine, handle, forces, drives = self.engine, self.handle, self._forces, self._drives
        step, state, total = engine.stepSimulation, [0.0] * self._size, []
        if drives and forces.constant:
            total = forces(state, command)
        for _ in range(substeps):
            if drives and not forces.constant:
                total = forces(self.ask(), command)
            for multibody, links, dofs, balls in drives:
                if balls:
                    engine.setJointMotorControlMultiDofArray(
                        multibody,
                        links,
                        engine.TORQUE_CONTROL,
                        forces=[total[dof : dof + 3] for dof in dofs[::3]],
                        physicsClientId=handle,
                    )
                else:
                    engine.setJointMotorControlArray(
                        multibody,
                        links,
                        engine.TORQUE_CONTROL,
                        forces=[total[dof] for dof in dofs],
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


@lru_cache(maxsize=64)
def _defaults(model: Model) -> dict[ParameterKey, Any]:
    """Give the parameters as they are in the model, as plain numbers."""
    return {key: value.tolist() for key, value in model.default_parameters().items()}
