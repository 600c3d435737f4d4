"""A physics client with any model in it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, final

import numpy as np

from scm_world._types import Floats
from scm_world.backends.bullet.client import Client, Values
from scm_world.backends.bullet.model.build import Built, build, solid
from scm_world.backends.bullet.model.forces import Forces
from scm_world.backends.bullet.model.support import changes, shares, unsupported, usual_friction
from scm_world.errors import Infeasible, ModelError, NotIntervenable, UnknownOption
from scm_world.models.bodies import ModelBodies
from scm_world.models.model import Model
from scm_world.models.scene import REVERSED, ParameterKey, reversed_ranges

Numbers = Sequence[float]


@final
class Frame:
    """The frame of a free body.

    Args:
        multibody: Its number in the engine.
        start: Where its joint begins in the state.
        center: Center of mass in the frame of the body [m].
        axes: From the principal axes of inertia to the frame of the body (x, y, z, w).
    """

    def __init__(self, multibody: int, start: int, center: Numbers, axes: Numbers) -> None:
        self.multibody, self.start = multibody, start
        self._center, self._axes = center, axes
        self._back = (-axes[0], -axes[1], -axes[2], axes[3])

    def to_engine(self, state: list[float]) -> tuple[Numbers, Numbers, Numbers, Numbers]:
        """Turn the state of the body into what the engine has.

        Returns:
            Position of the center and orientation of the principal axes, velocity of the center
            and angular velocity, all in the world.
        """
        at = self.start
        turn, linear = state[at + 3 : at + 7], state[at + 7 : at + 10]
        arm, spin = rotated(turn, self._center), rotated(turn, state[at + 10 : at + 13])
        return (
            [state[at + k] + arm[k] for k in range(3)],
            composed(turn, self._axes),
            _carried(linear, spin, arm, 1.0),
            spin,
        )

    def from_engine(
        self, pose: tuple[Numbers, Numbers], twist: tuple[Numbers, Numbers]
    ) -> list[float]:
        """Turn what the engine has into the state of the body, with a quaternion whose w >= 0.

        The engine keeps a matrix: which of two quaternions it makes of it has no meaning.
        """
        (position, orientation), (linear, spin) = pose, twist
        turn = composed(orientation, self._back)
        if turn[3] < 0.0:
            turn = [-part for part in turn]
        arm = rotated(turn, self._center)
        back = (-turn[0], -turn[1], -turn[2], turn[3])
        return [
            position[0] - arm[0],
            position[1] - arm[1],
            position[2] - arm[2],
            *turn,
            *_carried(linear, spin, arm, -1.0),
            *rotated(back, spin),
        ]


@final
class Ball:
    """A ball joint. The engine has it about the principal axes of the body.

    Args:
        multibody: Its number in the engine.
        link: Its link.
        start: Where it begins in the state.
        axes: From the principal axes of inertia to the frame of the body (x, y, z, w).
    """

    def __init__(self, multibody: int, link: int, start: int, axes: Numbers) -> None:
        self.multibody, self.link, self.start = multibody, link, start
        self._axes = axes
        self._back = (-axes[0], -axes[1], -axes[2], axes[3])

    def to_engine(self, state: list[float]) -> tuple[Numbers, Numbers]:
        """Turn the state of the joint into orientation and angular velocity in the engine."""
        at = self.start
        turn, spin = state[at : at + 4], state[at + 4 : at + 7]
        return composed(composed(self._back, turn), self._axes), rotated(self._back, spin)

    def from_engine(self, turn: Numbers, spin: Numbers) -> list[float]:
        """Turn what the engine has into the state of the joint."""
        own = composed(composed(self._axes, turn), self._back)
        return [*own, *rotated(self._axes, spin)]

    def torque(self, torque: Numbers) -> Numbers:
        """Turn a torque in the frame of the body into one about the principal axes."""
        return rotated(self._back, torque)


def rotated(turn: Numbers, v: Numbers) -> Numbers:
    """Rotate a vector by a unit quaternion (x, y, z, w)."""
    x, y, z, w = turn
    a, b, c = v
    p, q, r = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return (
        a + w * p + (y * r - z * q),
        b + w * q + (z * p - x * r),
        c + w * r + (x * q - y * p),
    )


def composed(p: Numbers, q: Numbers) -> Numbers:
    """Compose two rotations (x, y, z, w): first q, then p."""
    a, b, c, d = p
    x, y, z, w = q
    return (
        d * x + a * w + b * z - c * y,
        d * y + b * w + c * x - a * z,
        d * z + c * w + a * y - b * x,
        d * w - a * x - b * y - c * z,
    )


def _carried(linear: Numbers, spin: Numbers, arm: Numbers, sign: float) -> Numbers:
    """Give the velocity of the point at an arm from the one that has the linear velocity."""
    return (
        linear[0] + sign * (spin[1] * arm[2] - spin[2] * arm[1]),
        linear[1] + sign * (spin[2] * arm[0] - spin[0] * arm[2]),
        linear[2] + sign * (spin[0] * arm[1] - spin[1] * arm[0]),
    )


@final
class ModelClient(Client):
    """A physics client with a ``Model`` in it.

    Springs, dampers and actuators are not in the engine, but in the forces that are applied to it.
    """

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
            Infeasible: The ends of a range are the wrong way round.
        """
        problems = unsupported(structure)
        if problems:
            advice = "take it out of the model, or use backend='mujoco'"
            raise ModelError([f"Bullet cannot honour {what}; {advice}" for what in problems])
        for key in reversed_ranges(parameters):
            raise Infeasible(".".join(key), parameters[key], [REVERSED])
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
    def rotations(structure: Model) -> Sequence[int]:
        """List where in the state the quaternions begin."""
        slices = structure.layout.slices
        return [slices[row.name].start for row in structure.states if row.kind == "rotation"]

    # --- bodies ----------------------------------------------------------------------------------

    def construct(self, structure: Model, parameters: Values) -> None:
        """Make everything again, unless only other parameters differ from what is there."""
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

    def _find(self, bodies: ModelBodies, built: Built, size: int) -> None:
        """Prepare writing and reading of states."""
        self._size = size
        self._frames: list[Frame] = []
        self._ball_joints: dict[int, Ball] = {}
        scalars: dict[int, tuple[list[int], list[tuple[int, float]]]] = {}
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
                links, places = scalars.setdefault(multibody, ([], []))
                links.append(link)
                places.append((joint.start, joint.reference))
        self._scalars = [(multibody, *both) for multibody, both in scalars.items()]

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
        """Compute forces and frictions again."""
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
        """Derive forces and frictions from the parameters."""
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
        drives: dict[int, tuple[list[int], list[int]]] = {}
        for number in forces.driven:
            multibody, link = built.joints[number]
            if number not in self._ball_joints:
                links, dofs = drives.setdefault(multibody, ([], []))
                links.append(link)
                dofs.append(forces.dofs[number])
        self._drives = [(multibody, *both) for multibody, both in drives.items()]

    def parameter(self, key: ParameterKey) -> Floats:
        """Ask the engine for a parameter: mass, inertia, gravity and step; it has no others."""
        value = np.array(self.applied[key])
        if key not in changes(self._model.bodies):
            return value
        engine, handle = self.engine, self.handle
        _, row, parts = self._bodies.places[key]
        field = parts[0].field
        if field == "gravity":
            return self.gravity()
        if field == "timestep":
            physics = engine.getPhysicsEngineParameters(physicsClientId=handle)
            return np.array(physics["fixedTimeStep"])
        if field in ("mass", "inertia") and row in self._built.bodies and key not in self._inside:
            info = engine.getDynamicsInfo(*self._built.bodies[row], physicsClientId=handle)
            return np.array(info[0] if field == "mass" else info[2])
        return value

    def remarks(self, before: Values) -> tuple[str, ...]:
        """Say which frictions were changed without an effect; see ``shares``."""
        usual, places = usual_friction(self._model.bodies), self._bodies.places
        return tuple(
            f"{'.'.join(key)} has no effect: the larger coefficient of two shapes counts, and "
            "those of the others are larger"
            for key, old in before.items()
            if key in places and places[key].parts[0].field == "friction"
            if places[key].table == "geoms"
            if shares(self._bodies.with_parameters({key: old}), usual) == self._shares
        )

    def carrier(self, body: str) -> tuple[int, int]:
        """Give multibody and link that carry the mass of a body that can move."""
        names = {self._bodies.bodies[number].name: number for number in self._built.bodies}
        if body not in names:
            raise UnknownOption("body", body, names)
        return self._built.bodies[names[body]]

    # --- steps -----------------------------------------------------------------------------------

    def advance(self, command: Sequence[float], substeps: int) -> list[float]:
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

    def owner(self, multibody: int, link: int) -> str:
        """Name the body that a shape of the engine belongs to."""
        return self._built.owners[multibody, link]
