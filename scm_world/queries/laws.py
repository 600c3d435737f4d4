"""Laws of parameters: what each declared value means to the engine, in size and sign.

Expectations follow from the values of the variables and from mechanics that is written out here.
Nothing that the engine reports of its parameters is used. The state, forces and contacts it reports
are what is compared. Criteria and what they cannot see: docs/verification, "Laws".
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, final

import numpy as np

from scm_world._types import Floats
from scm_world.backends import Backend
from scm_world.backends.base import BackendWrapper
from scm_world.errors import EngineFailure, ScmWorldError, SnapshotMismatch
from scm_world.geometry.rotations import (
    from_rotation_vector,
    quaternion_product,
    rotation_matrix,
)
from scm_world.models.bodies import ModelBodies
from scm_world.models.scene import Difference, ParameterKey
from scm_world.queries.verification import Law
from scm_world.world import Simulation

RESIDUE, TOLERANCE = 0.03, 0.1
"""What steps may differ from the equations of motion by, of the largest change of each velocity,
and parameters from what would explain the steps best: a physics step is of first order."""
CLEAR = 4.0  # by how many standard errors
TURN = 0.01  # [rad] or [m] that a joint moves at most in a measured step
TINY = 1e-4  # [s] for derivatives in time
SHIFT = 1e-3  # relative, for derivatives
NOISE = 2e-3  # share of the largest change of velocity; what is below is no evidence
STATES, DRAWS = 3, 60  # without contact: how many are measured, and tried
SHARE = (0.75, 1.35)  # by which factors values are changed before they are measured
DRY = "frictionloss"
RESTING, SLIDING, BOUNCING = 0.05, 0.2, 0.15
"""What heights of shapes that lie and coefficients of friction may be off by, relative, and the
share of its speed that a box keeps when it bounces."""
BOUNCES, DROP = (0.3, 0.6), 1.0  # restitution, and [m/s] of what falls on the ground
FRICTIONS = ((0.6, 0.3), (0.3, 0.6), (0.6, 0.6))  # of the ground and of what slides on it
SETTLED, GLIDE, GLIDING = 0.4, 0.5, 0.2  # [s] to come to rest, [m/s] at first, [s] at most
LEAST = 12  # physics steps that sliding lasts, about: fewer say nothing of friction
STILL = 0.02  # [m/s] and [rad/s] that what is at rest has at most
SPOTS = (5.0, 20.0, 80.0)  # [m] from the origin: where nothing else is
ALOFT = 100.0  # [m] above the ground: where everything else is
UP = ((0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)), (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)))
UPRIGHT = (*UP, (0.0, 0.0, 0.0, 1.0))
"""Rotations after which the first, second or third axis is vertical."""
ATTRIBUTES = {"damping": 5.0, "armature": 0.3, "stiffness": 20.0}
"""What is set at least, for each unit of inertia that the joint feels: 5/s, 20/s² etc."""
KEPT = ("timestep", "orientation", "position", "axis")
"""What keeps its value, because another one changes where bodies are."""
DOFS = {"hinge": 1, "slide": 1, "ball": 3, "free": 6}
SPEED = {"hinge": 1, "slide": 1, "ball": 4, "free": 7}


def check_laws(world: Simulation, *, seed: int = 0) -> tuple[Law, ...]:
    """Measure what the engine makes of every physical parameter of a world.

    Parameters are first set to values that differ from one another, as ``do`` sets them. The world
    is afterwards as it was, bit for bit; one without an episode is at the beginning of one.

    Args:
        world: With physics, of a model or of the robot.
        seed: Of values and states.

    Returns:
        One law for each variable that a backend realises and that pictures do not only show.
        Empty for a world without bodies.
    """
    if not (world.backend.capabilities.physics and hasattr(world.structure, "described")):
        return ()
    try:
        if not world.has_begun:
            world.reset(seed=seed)
        before = world.snapshot()
        try:
            return tuple(_Laws(world, np.random.default_rng(seed)).all())
        finally:
            world.restore(before)
    except (EngineFailure, SnapshotMismatch) as error:
        return (Law(variable="engine", law="motion", passed=False, reason=str(error)),)


class Run(NamedTuple):
    """One physics step.

    Attributes:
        state: Coordinates of the description before it.
        command: That is held.
        pushes: Force [N] and torque [N m] on bodies, by number, shape (6,).
    """

    state: Floats
    command: Floats
    pushes: Mapping[int, Floats]


@final
class Mechanics:
    """The equations of motion of a description.

    Source:
        Featherstone, *Rigid Body Dynamics Algorithms*, 2008, sections 3.3 and 6.2.
    """

    def __init__(self, bodies: ModelBodies, known: dict[Any, Any] | None = None) -> None:
        self.bodies, self.known = bodies, {} if known is None else known
        self._shape = (
            *((b.parent, b.position, b.orientation, b.center, b.axes) for b in bodies.bodies),
            *((j.position, j.axis, j.reference) for j in bodies.joints),
        )
        sizes = [DOFS[joint.kind] for joint in bodies.joints]
        self.first = np.cumsum([0, *sizes]).tolist()
        self.speeds = np.concatenate(
            [np.empty(0, dtype=np.int64)]
            + [j.start + SPEED[j.kind] + np.arange(DOFS[j.kind]) for j in bodies.joints]
        )

    def jacobians(self, state: Floats) -> tuple[Floats, Floats, Floats]:
        """Give what velocities of joints mean to bodies.

        Returns:
            Velocity of the center and angular velocity of each body for each degree of freedom,
            shape (n, 3, n_dofs), and the principal axes of each, shape (n, 3, 3).
        """
        still = state.copy()
        still[self.speeds] = 0.0
        key = (self._shape, still.tobytes())
        if key not in self.known:
            self.known[key] = self._jacobians(state)
        found: tuple[Floats, Floats, Floats] = self.known[key]
        return found

    def _jacobians(self, state: Floats) -> tuple[Floats, Floats, Floats]:
        rows, n_dofs = self.bodies.bodies, len(self.speeds)
        turns, places = [np.eye(3)], [np.zeros(3)]
        levers, spins = np.zeros((len(rows), 3, n_dofs)), np.zeros((len(rows), 3, n_dofs))
        axes: list[list[tuple[int, Floats, Floats | None]]] = [[]]  # dof, axis, a point on it
        frames = np.zeros((len(rows), 3, 3))
        for number, body in enumerate(rows[1:], start=1):
            turn = turns[body.parent] @ rotation_matrix(body.orientation)
            place = places[body.parent] + turns[body.parent] @ np.array(body.position)
            moved = list(axes[body.parent])
            for index in self.bodies.joints_of(number):
                joint, dof = self.bodies.joints[index], self.first[index]
                at, anchor = joint.start, place + turn @ np.array(joint.position)
                axis = turn @ np.array(joint.axis)
                if joint.kind == "free":
                    place, turn = state[at : at + 3], rotation_matrix(state[at + 3 : at + 7])
                    moved += [(dof + k, np.eye(3)[k], None) for k in range(3)]
                    moved += [(dof + 3 + k, turn[:, k], place) for k in range(3)]
                elif joint.kind == "slide":
                    place = place + (state[at] - joint.reference) * axis
                    moved.append((dof, axis, None))
                else:
                    if joint.kind == "ball":
                        turn = turn @ rotation_matrix(state[at : at + 4])
                        moved += [(dof + k, turn[:, k], anchor) for k in range(3)]
                    else:
                        half = 0.5 * (state[at] - joint.reference)
                        about = math.sin(half) * np.array(joint.axis)
                        turn = turn @ rotation_matrix([*about, math.cos(half)])
                        moved.append((dof, axis, anchor))
                    place = anchor - turn @ np.array(joint.position)
            turns.append(turn)
            places.append(place)
            axes.append(moved)
            center = place + turn @ np.array(body.center)
            for dof, axis, point in moved:
                levers[number, :, dof] = axis if point is None else np.cross(axis, center - point)
                spins[number, :, dof] = 0.0 if point is None else axis
            frames[number] = turn @ rotation_matrix(body.axes)
        return levers, spins, frames

    def inertia(self, state: Floats) -> Floats:
        """Compute the mass matrix, shape (n_dofs, n_dofs)."""
        levers, spins, frames = self.jacobians(state)
        turns = frames.transpose(0, 2, 1) @ spins
        masses = np.array([body.mass for body in self.bodies.bodies])
        moments = np.array([body.inertia for body in self.bodies.bodies])
        n_dofs = levers.shape[2]
        heavy = (masses[:, None, None] * levers).reshape(-1, n_dofs)
        round_ = (moments[:, :, None] * turns).reshape(-1, n_dofs)
        matrix: Floats = levers.reshape(-1, n_dofs).T @ heavy + turns.reshape(-1, n_dofs).T @ round_
        for joint, dof in zip(self.bodies.joints, self.first, strict=False):
            own = range(dof, dof + DOFS[joint.kind])
            matrix[own, own] += joint.armature
        return matrix

    def bias(self, state: Floats) -> Floats:
        """Compute the forces that are quadratic in velocities, shape (n_dofs,)."""
        speeds = state[self.speeds]
        if not speeds.any():
            return np.zeros(len(speeds))
        key = (self._shape, state.tobytes(), "bias")
        if key not in self.known:
            self.known[key] = self._rates(state)
        rise, growth = self.known[key]
        levers, spins, frames = self.jacobians(state)
        masses = np.array([body.mass for body in self.bodies.bodies])
        moments = np.array([body.inertia for body in self.bodies.bodies])
        tensors = (frames * moments[:, None, :]) @ frames.transpose(0, 2, 1)
        spin = spins @ speeds
        turning = np.einsum("nij,nj->ni", tensors, growth)
        turning += np.cross(spin, np.einsum("nij,nj->ni", tensors, spin))
        pulls = (masses[:, None] * rise).ravel() @ levers.reshape(-1, len(speeds))
        found: Floats = pulls + turning.ravel() @ spins.reshape(-1, len(speeds))
        return found

    def _rates(self, state: Floats) -> tuple[Floats, Floats]:
        """Compute accelerations of bodies whose joints keep their speed, each of shape (n, 3)."""
        speeds, moved = state[self.speeds], []
        for step in (TINY, -TINY):
            other = state.copy()
            for joint in self.bodies.joints:
                at, first = joint.start, joint.start + SPEED[joint.kind]
                if joint.kind in ("hinge", "slide"):
                    other[at] += step * state[first]
                    continue
                if joint.kind == "free":
                    other[at : at + 3] += step * state[first : first + 3]
                    at, first = at + 3, first + 3
                spin = from_rotation_vector(step * state[first : first + 3])
                other[at : at + 4] = quaternion_product(state[at : at + 4], spin)
            moved.append(self.jacobians(other))
        rise = (moved[0][0] - moved[1][0]) @ speeds / (2.0 * TINY)
        growth = (moved[0][1] - moved[1][1]) @ speeds / (2.0 * TINY)
        return rise, growth

    def change(self, run: Run, implicit: int) -> Floats:
        """Predict by how much a physics step changes velocities, shape (n_dofs,).

        Args:
            run: The step.
            implicit: What brakes with the speed at the end of the step: nothing, dampers, dampers
                and actuators, or these unless the force on the joint is at its limit; from 4 on
                the same, where pushes are not braked. Each is an integrator of first order.
        """
        bodies, state = self.bodies, run.state
        levers, spins, _ = self.jacobians(state)
        forces = -self.bias(state)
        masses = np.array([0.0, *(body.mass for body in bodies.bodies[1:])])
        forces += np.outer(masses, bodies.gravity).ravel() @ levers.reshape(-1, len(forces))
        pushed = np.zeros(len(forces))
        for number, push in run.pushes.items():
            pushed += push[:3] @ levers[number] + push[3:] @ spins[number]
        driven, slopes = np.zeros(len(forces)), np.zeros(len(forces))
        for actuator in bodies.actuators:
            joint, dof = bodies.joints[actuator.joint], self.first[actuator.joint]
            low, high = actuator.control_range or (-math.inf, math.inf)
            control = min(max(run.command[actuator.control], low), high)
            gain, bias, gear = actuator.gain, actuator.bias, actuator.gear
            force, slope = gain[0] * control + bias[0], 0.0
            if joint.kind in ("hinge", "slide"):
                length, rate = gear[0] * state[joint.start], gear[0] * state[joint.start + 1]
                slope = gain[2] * control + bias[2]
                force += (gain[1] * control + bias[1]) * length + slope * rate
            low, high = actuator.force_range or (-math.inf, math.inf)
            slope = slope if low <= force <= high else 0.0
            for k in range(min(len(gear), DOFS[joint.kind])):
                driven[dof + k] += gear[k] * min(max(force, low), high)
                slopes[dof + k] -= gear[k] ** 2 * slope
        dampers = np.zeros(len(forces))
        for joint, dof in zip(bodies.joints, self.first, strict=False):
            own = slice(dof, dof + DOFS[joint.kind])
            if joint.effort is not None:
                cut: Floats = np.clip(driven[own], *joint.effort)
                inside = cut == driven[own]
                if implicit % 4 == 3:
                    inside &= (cut != joint.effort[0]) & (cut != joint.effort[1])
                slopes[own] = np.where(inside, slopes[own], 0.0)
                driven[own] = cut
            speeds = state[self.speeds[own]]
            driven[own] -= joint.damping * speeds
            driven[own] -= joint.friction * np.sign(speeds)
            dampers[own] = joint.damping
            if joint.kind in ("hinge", "slide"):
                driven[own] -= joint.stiffness * (state[joint.start] - joint.rest)
        braked = (0.0 * dampers, dampers, dampers + slopes)[min(implicit % 4, 2)]
        step = bodies.timestep
        matrix = self.inertia(state)
        left = matrix if implicit >= 4 else matrix + step * np.diag(braked)
        found = np.linalg.solve(matrix + step * np.diag(braked), forces + driven)
        return np.asarray(step * (found + np.linalg.solve(left, pushed)), dtype=np.float64)


def compared(
    name: str, law: str, pairs: list[tuple[float, float]], tolerance: float, said: str
) -> Law:
    """Compare expected and measured values: bounces as they are, all else relative."""
    errors = [abs(two - one) / (1.0 if law == "bouncing" else one) for one, two in pairs]
    passed, worst = max(errors) <= tolerance, pairs[int(np.argmax(errors))]
    return Law(
        variable=name, law=law, declared=tuple(one for one, _ in pairs),
        found=tuple(two for _, two in pairs), error=max(errors), passed=passed,
        reason="" if passed else said.format(*worst),
    )  # fmt: skip


@final
class _Laws:
    """All measurements on one world."""

    def __init__(self, world: Simulation, generator: np.random.Generator) -> None:
        self.world, self.rng, self.backend = world, generator, world.backend
        self.engine = world.backend
        while isinstance(self.engine, BackendWrapper):
            self.engine = self.engine.engine
        rows = {row.key for row in getattr(world.structure, "parameters", ()) if row.visual}
        self.keys: dict[str, ParameterKey] = {
            name: key
            for name, key in world.compiled.parameter_keys.items()
            if key not in rows and key[1] != "color" and self.backend.supports(world.structure, key)
        }
        self.refused: dict[str, str] = {}

    # --- the declared world ------------------------------------------------------------------

    def described(self, changed: Mapping[ParameterKey, Any] | None = None) -> ModelBodies:
        """Describe the bodies with the declared values, some of them replaced."""
        world, keys = self.world, self.world.compiled.parameter_keys
        if not changed:
            self.values = {key: world[name] for name, key in keys.items()}
        values = self.values | dict(changed or {})
        structure: Any = world.structure
        bodies: ModelBodies
        bodies, self.places = structure.described(values, world.composition.mode, self.engine.name)
        return bodies

    def vary(self) -> None:
        """Set parameters to values that differ from one another, where that is possible."""
        bodies = self.described()
        mechanics = Mechanics(bodies)
        scale = 1.0 / np.diag(np.linalg.inv(mechanics.inertia(self.state()[self.places])))
        for name, key in self.keys.items():
            value = np.array(self.world[name])
            variable: Any = self.world.model.declared(name)
            low, high = (
                np.broadcast_to(getattr(variable.bounds, end, -sign * math.inf), value.shape)
                for end, sign in (("low", 1.0), ("high", -1.0))
            )
            if key[1] in KEPT or key[1] == DRY or variable.dtype != "real":
                continue
            size = () if key[1] in ("inertia", "size") else value.shape
            new = value * self.rng.uniform(*SHARE, size)
            if key[1] == "gravity":
                new = value + self.rng.uniform(-2.0, 2.0, value.shape)
            elif not value.any() and variable.a is not None and hasattr(variable.a, "high"):
                new = self.rng.uniform(0.5, 1.0) * np.array(variable.a.high) + 0.0 * value
            elif key[1] in ATTRIBUTES and (place := bodies.places.get(key)) is not None:
                least = ATTRIBUTES[key[1]] * self.rng.uniform(*SHARE)
                new = np.maximum(new, least * scale[mechanics.first[place.row]])
            try:
                self.world.do({name: np.clip(new, low, high)})
            except EngineFailure as error:
                self.refused[name] = str(error)
            except ScmWorldError:
                continue  # it keeps its value

    def state(self) -> Floats:
        """Read the state vector."""
        found: Floats = self.backend.state().vector
        return found

    # --- measurements ------------------------------------------------------------------------

    def place(self, numbers: Floats) -> None:
        """Put everything where coordinates of the description say."""
        state = self.backend.state()
        state.vector[self.places] = numbers
        self.backend.apply(Difference(state=state))

    def step(self, command: Floats, pushes: Mapping[int, Floats]) -> Floats:
        """Take one physics step; give the coordinates of the description."""
        for number, push in pushes.items():
            self.backend.push(self.bodies.bodies[number].name, push[:3], push[3:])
        self.backend.step(self.world.composition.mode, command, 1)
        found: Floats = self.state()[self.places]
        return found

    def measured(self, run: Run) -> Floats | None:
        """Measure by how much a step changes velocities; None if something touches."""
        self.place(run.state)
        speeds = self.mechanics.speeds
        change: Floats = (self.step(run.command, run.pushes) - run.state)[speeds]
        return None if any(c.force > 0.0 for c in self.backend.contacts()) else change

    def draw(self, spread: float) -> tuple[Floats, Floats]:
        """Draw where everything is, without touching, and how fast joints move."""
        state, speeds = self.start.copy(), np.zeros(len(self.start))
        most = min(1.0, TURN / self.bodies.timestep)
        for index, joint in enumerate(self.bodies.joints):
            at = joint.start
            pace = most * self.rng.uniform(0.5, 1.0, 3) * self.rng.choice((-1.0, 1.0), 3)
            state[self.mechanics.speeds[self.mechanics.first[index] :][: DOFS[joint.kind]]] = 0.0
            if joint.kind == "free":
                state[at : at + 7] = (3.0 * index + 5.0, 0.0, 5.0, 0.0, 0.0, 0.0, 1.0)
                speeds[at + 7 : at + 13] = np.tile(pace, 2)
            elif joint.kind == "ball":
                turn = np.array([*(spread * self.rng.uniform(-1.0, 1.0, 3)), 1.0])
                state[at : at + 4] = turn / np.linalg.norm(turn)
                speeds[at + 4 : at + 7] = pace
            else:
                reach = 1.0 if joint.kind == "hinge" else 0.1
                low, high = joint.range or (state[at] - reach, state[at] + reach)
                middle, half = (low + high) / 2, (high - low) / 2
                aim = middle + half * 0.7 * self.rng.uniform(-1.0, 1.0)
                inside = min(max(state[at], middle - 0.8 * half), middle + 0.8 * half)
                state[at] = inside + spread * (aim - inside)
                speeds[at + 1] = pace[0]
        for tie in self.bodies.couplings:
            one, other = self.bodies.joints[tie.joint], self.bodies.joints[tie.leader]
            moved = state[other.start] - other.reference
            state[one.start] = one.reference + tie.offset + tie.ratio * moved
            speeds[one.start + 1] = tie.ratio * speeds[other.start + 1]
        return state, speeds

    def commanded(self, state: Floats) -> Floats:
        """Draw a command: forces up to a fifth beyond what actuators and joints can exert."""
        command = np.zeros(self.world.structure.n_commands)
        inertia = np.diag(self.mechanics.inertia(state))
        for actuator in self.bodies.actuators:
            joint = self.bodies.joints[actuator.joint]
            if not actuator.gain[0] or actuator.joint >= len(self.bodies.joints):
                continue
            limit = actuator.force_range or joint.effort
            gear = max(map(abs, actuator.gear)) or 1.0
            most = 10.0 * inertia[self.mechanics.first[actuator.joint]] / gear
            if limit is not None:
                most = 1.2 * max(map(abs, limit))
            force = most * self.rng.uniform(-1.0, 1.0)
            length = actuator.gear[0] * state[joint.start]
            command[actuator.control] = (
                force - actuator.bias[0] - actuator.bias[1] * length
            ) / actuator.gain[0]
            if actuator.control_range is not None and not actuator.bias[1]:
                low, high = actuator.control_range
                command[actuator.control] = self.rng.uniform(low, high)
        return command

    def runs(self, spread: float) -> tuple[Run, ...]:
        """Prepare five steps from one state: at rest, driven, pushed, and moving to and fro."""
        state, speeds = self.draw(spread)
        first, second = self.commanded(state), self.commanded(state)
        pushes = {}
        for number, body in enumerate(self.bodies.bodies):
            joints = [self.bodies.joints[j].kind for j in self.bodies.joints_of(number)]
            if joints and body.mass > 0.0:
                push = self.rng.uniform(0.5, 1.0, 6) * self.rng.choice((-1.0, 1.0), 6)
                arm = math.sqrt(max(body.inertia) / body.mass)
                pushes[number] = push * body.mass * 10.0 * np.repeat((1.0, arm), 3)
        return (
            Run(state, first, {}),
            Run(state, second, {}),
            Run(state, first, pushes),
            Run(state + speeds, first, {}),
            Run(state - speeds, first, {}),
        )

    def combined(self, changes: list[Floats]) -> Floats:
        """Combine five changes to four, each of which one kind of force dominates."""
        rest, driven, pushed, to, fro = changes
        return np.concatenate([driven - rest, pushed - rest, (to - fro) / 2, rest])

    def untied(self, state: Floats) -> Floats:
        """Give the projection that removes what the forces of couplings do, shape (n, n)."""
        n = len(self.mechanics.speeds)
        pulls = np.zeros((n, len(self.bodies.couplings)))
        for number, tie in enumerate(self.bodies.couplings):
            pulls[self.mechanics.first[tie.joint], number] = 1.0
            pulls[self.mechanics.first[tie.leader], number] = -tie.ratio
        if not self.bodies.couplings:
            return np.eye(n)
        basis, _ = np.linalg.qr(np.linalg.solve(self.mechanics.inertia(state), pulls))
        left: Floats = np.eye(n) - basis @ basis.T
        return left

    def all(self) -> Iterator[Law]:
        """Measure everything."""
        engine = self.engine
        if type(engine).push is Backend.push:
            reason = f"the backend {engine.name!r} cannot push bodies"
            yield from (self.silent(name, "motion", reason) for name in self.keys)
            return
        before = self.world.snapshot()
        touched = list(self.contact())
        self.world.restore(before)
        yield from touched
        told = {law.variable for law in touched if law.law != "lying"}
        self.vary()
        self.keys = {name: key for name, key in self.keys.items() if name not in told}
        self.bodies = self.described()
        lacking = [*self.bodies.missing]
        if getattr(self.world.structure, "published", False):
            lacking.append("damping of the predecessor")
        if engine.stages > 1:
            lacking.append("steps of Runge-Kutta, which are not of first order")
        if any(joint.friction for joint in self.bodies.joints):
            lacking.append("dry friction, a constraint that can stop a joint within a step")
        if lacking:
            reason = f"not in the equations of motion used here: {lacking[0]}"
            yield from (self.silent(name, "motion", reason) for name in self.keys)
            return
        keys = self.keys
        dry = {name: key for name, key in keys.items() if key[1] == DRY}
        self.keys = {name: key for name, key in keys.items() if name not in dry}
        yield from self.motion()
        self.keys = keys
        yield from (self.silent(name, "motion", "dry friction is a constraint") for name in dry)

    def silent(self, name: str, law: str, reason: str) -> Law:
        """Report that there is no law."""
        if name in self.refused:
            return Law(variable=name, law=law, passed=False, reason=self.refused[name])
        return Law(variable=name, law=law, reason=reason)

    # --- contact -----------------------------------------------------------------------------

    def contact(self) -> Iterator[Law]:
        """Lay boxes and balls that can move freely on level ground; let boxes bounce and slide."""
        self.bodies = bodies = self.described()
        self.mechanics, self.start = Mechanics(bodies), self.state()[self.places]
        grounds = [
            number
            for number, geom in enumerate(bodies.geoms)
            if geom.kind == "plane" and not bodies.roots[geom.body]
            if geom.position[2] == 0.0 and tuple(geom.orientation[:2]) == (0.0, 0.0)
        ]
        level = bodies.gravity[2] < 0.0 and not any(bodies.gravity[:2])
        if len(grounds) != 1 or not level or bodies.missing or bodies.geoms[grounds[0]].special:
            return
        ground, shaping = grounds[0], self.shaping()
        roots = [bodies.roots[geom.body] for geom in bodies.geoms]
        slid: dict[str, list[tuple[float, float]]] = {}
        bouncing = {name: key for name, key in self.keys.items() if key[1] == "restitution"}
        for joint in bodies.joints:
            own = [number for number, root in enumerate(roots) if root == joint.body]
            alone = bodies.roots.count(joint.body) == 1 and len(own) == 1
            if joint.kind != "free" or not alone or (ground, own[0]) not in bodies.touching:
                continue
            shape, geom = own[0], bodies.geoms[own[0]]
            self.low = min(geom.size, default=0.0)
            if geom.kind not in ("box", "sphere") or geom.special or joint.damping:
                continue
            found = [self.laid(joint, geom, axis) for axis in range(len(geom.size))]
            heights = [(half, f[0]) for half, f in zip(geom.size, found, strict=True) if f]
            for name, _ in shaping.get(("size", shape), ()) if heights else ():
                yield compared(name, "lying", heights, RESTING, "lies at {1:.3g} m, not {0:.3g}")
            rest = found[int(np.argmin(geom.size))]
            if geom.kind != "box" or geom.slippery or rest is None:
                continue
            for name, key in bouncing.items():  # of the first box: all contacts have the same
                kept = [(share, self.bounced(joint, rest[1], key, share)) for share in BOUNCES]
                yield compared(name, "bouncing", kept, BOUNCING, "keeps {1:.2f}, not {0:.2f}")
            bouncing = {}
            grips = shaping.get(("friction", ground), []), shaping.get(("friction", shape), [])
            for name, pairs in self.rubbed(joint, rest[1], (ground, shape), grips).items():
                slid.setdefault(name, []).extend(pairs)
        for name, pairs in slid.items():
            yield compared(name, "sliding", pairs, SLIDING, "brakes as {1:.2f}, not {0:.2f}")

    def shaping(self) -> dict[tuple[str, int], list[tuple[str, ParameterKey]]]:
        """Give the variables that sizes and frictions of shapes depend on."""
        found: dict[tuple[str, int], list[tuple[str, ParameterKey]]] = {}
        for name, key in self.keys.items():
            if key[1] not in ("friction", "size"):
                continue
            try:
                other = self.described({key: (1.0 + SHIFT) * self.values[key] + SHIFT})
            except (ScmWorldError, ValueError):
                continue  # no shape can have it
            for number, (one, two) in enumerate(zip(self.bodies.geoms, other.geoms, strict=True)):
                if getattr(one, key[1]) != getattr(two, key[1]):
                    found.setdefault((key[1], number), []).append((name, key))
        return found

    def rubbed(
        self, joint: Any, rest: Floats, pair: tuple[int, int], grips: tuple[list[Any], list[Any]]
    ) -> dict[str, list[tuple[float, float]]]:
        """Give the expected and the measured friction for each variable that it depends on."""
        found: dict[str, list[tuple[float, float]]] = {}
        for frictions in FRICTIONS:
            changed = {}
            for variables, friction in zip(grips, frictions, strict=True):
                for _, key in variables:
                    changed[key] = np.array(self.values[key])
                    changed[key].flat[0] = friction
            self.backend.apply(Difference(parameters=changed))
            acts = self.braked(joint, rest, -self.bodies.gravity[2])
            self.backend.apply(Difference(parameters={key: self.values[key] for key in changed}))
            if acts is None:
                continue
            both = [self.described(changed).geoms[number].friction for number in pair]
            expected = math.prod(both) if self.bodies.product else max(both)
            for name, _ in (*grips[0], *grips[1]):
                found.setdefault(name, []).append((expected, acts))
        return found

    def laid(self, joint: Any, geom: Any, axis: int) -> tuple[float, Floats] | None:
        """Let a shape come to rest on the ground, with one of its axes upright.

        Returns:
            How high its center is then, and the coordinates of everything; None where it does
            not come to rest on the ground alone, or would tip.
        """
        body, at = self.bodies.bodies[joint.body], joint.start
        turn = quaternion_product(UPRIGHT[axis], np.array(geom.orientation) * (-1, -1, -1, 1))
        offset = rotation_matrix(turn) @ np.array(geom.position)
        lever = rotation_matrix(turn) @ (np.array(body.center) - np.array(geom.position))
        if np.abs(lever[:2]).max() > 0.3 * min(geom.size):
            return None
        for spot in SPOTS:
            state = self.start.copy()
            for number, other in enumerate(self.bodies.joints):
                if other.kind == "free":
                    state[other.start : other.start + 3] = (0.0, 3.0 * number, ALOFT)
                    state[other.start + 7 : other.start + 13] = 0.0
            state[at : at + 3] = np.array([spot, spot, geom.size[axis]]) - offset
            state[at + 3 : at + 7] = turn
            self.place(state)
            self.backend.step(
                self.world.composition.mode,
                np.zeros(self.world.structure.n_commands),
                math.ceil(SETTLED / self.bodies.timestep),
            )
            rest = self.state()[self.places]
            if self.beneath(body.name) and np.abs(rest[at + 7 : at + 13]).max() <= STILL:
                middle = rotation_matrix(rest[at + 3 : at + 7]) @ np.array(geom.position)
                return float(rest[at + 2] + middle[2]), rest
        return None

    def beneath(self, name: str) -> bool:
        """Tell whether a body touches nothing but the ground under it."""
        own = [c for c in self.backend.contacts() if name in c.bodies and c.force > 0.0]
        return all(abs(c.normal[2]) > 0.99 and abs(c.position[2]) < self.low for c in own)

    def thrown(self, joint: Any, rest: Floats, velocity: tuple[float, float, float]) -> int:
        """Put a body where it lay at rest, with a velocity; tell where that is in the state."""
        state = rest.copy()
        for other in self.bodies.joints:
            if other.kind == "free":
                if other is not joint:
                    state[other.start + 2] = ALOFT
                state[other.start + 7 : other.start + 13] = 0.0
        state[joint.start + 7 : joint.start + 10] = velocity
        self.place(state)
        return int(joint.start + 7)

    def bounced(self, joint: Any, rest: Floats, key: ParameterKey, restitution: float) -> float:
        """Measure which share of its speed a body keeps that falls on the ground."""
        self.backend.apply(Difference(parameters={key: np.array(restitution)}))
        at = self.thrown(joint, rest, (0.0, 0.0, -DROP)) + 2
        command = np.zeros(self.world.structure.n_commands)
        steps = range(math.ceil(GLIDING / self.bodies.timestep))
        best = max(float(self.step(command, {})[at]) for _ in steps)
        self.backend.apply(Difference(parameters={key: self.values[key]}))
        return best / DROP

    def braked(self, joint: Any, rest: Floats, gravity: float) -> float | None:
        """Measure the coefficient of friction with which what lies there slides along x.

        It is the impulse along x for each unit of what the ground carries, which is not the weight
        of a box that hops.

        Returns:
            None if it touches something else, or hops most of the time.
        """
        step = self.bodies.timestep
        fast = max(GLIDE, LEAST * gravity * step)
        at = self.thrown(joint, rest, (fast, 0.0, 0.0))
        command, speeds = np.zeros(self.world.structure.n_commands), [(fast, 0.0)]
        for _ in range(max(math.ceil(GLIDING / step), LEAST)):
            found = self.step(command, {})
            speeds.append((float(found[at]), float(found[at + 2])))
            if not self.beneath(self.bodies.bodies[joint.body].name):
                return None
            if speeds[-1][0] < 0.3 * fast:
                break
        first = len(speeds) // 4
        lost, rise = speeds[first][0] - speeds[-1][0], speeds[-1][1] - speeds[first][1]
        weight = gravity * (len(speeds) - 1 - first) * step
        return lost / (weight + rise) if weight + rise > 0.5 * weight else None

    # --- motion ------------------------------------------------------------------------------

    def motion(self) -> Iterator[Law]:
        """Compare steps without contact with the equations of motion, parameter by parameter."""
        self.mechanics, self.start = Mechanics(self.bodies), self.state()[self.places]
        runs: list[tuple[Run, ...]] = []
        changes: list[Floats] = []
        for draw in range(DRAWS if self.bodies.joints else 0):
            tried = self.runs(0.95**draw)
            found: list[Floats] = []
            for run in tried:
                change = self.measured(run)
                if change is None:
                    break
                found.append(change)
            else:
                runs.append(tried)
                changes.append(self.combined(found))
            if len(runs) == STATES:
                break
        if not runs:
            reason = f"no state without contact in {DRAWS} draws"
            yield from (self.silent(name, "motion", reason) for name in self.keys)
            return
        n, parts = len(self.mechanics.speeds), 4
        free = [self.untied(five[0].state) for five in runs]
        measured = np.concatenate(
            [(c.reshape(parts, n) @ f).ravel() for c, f in zip(changes, free, strict=True)]
        )

        def predicted(mechanics: Mechanics, implicit: int) -> Floats:
            found = []
            for five, left in zip(runs, free, strict=True):
                one = self.combined([mechanics.change(run, implicit) for run in five])
                found.append((one.reshape(parts, n) @ left).ravel())
            return np.concatenate(found)

        tried_ = [predicted(self.mechanics, implicit) for implicit in range(8)]
        scale = np.abs(tried_[2]).reshape(-1, n).max(axis=0)
        scale = np.tile(np.where(scale > 0.0, scale, np.inf), len(measured) // n)
        implicit = int(np.argmin([np.linalg.norm((measured - t) / scale) for t in tried_]))
        rest = (measured - tried_[implicit]) / scale
        worst = float(np.abs(rest).max())
        if not any(joint.friction for joint in self.bodies.joints):
            yield Law(
                variable="equations of motion",
                law="motion",
                error=worst,
                passed=worst <= RESIDUE,
                reason=f"{len(runs)} states, {n} degrees of freedom: off by up to {worst:.2g}",
            )
        for name, key in self.keys.items():
            value, errors = np.array(self.world[name]), list[float]()
            declared, acts = list[float](), list[float]()
            reason = self.refused.get(name, "")
            for place in range(value.size):
                here = float(value.flat[place])
                size = here or float(np.abs(value).max()) or 1.0
                shifted = value.copy()
                shifted.flat[place] += SHIFT * size
                try:
                    described = self.described({key: shifted})
                    moved = predicted(Mechanics(described, self.mechanics.known), implicit)
                except (ScmWorldError, ValueError, np.linalg.LinAlgError):
                    continue  # no body can have it
                slope = (moved - tried_[implicit]) / scale / SHIFT
                if float(np.abs(slope).max()) <= NOISE:
                    continue
                share = float(rest @ slope) / float(slope @ slope)
                rms = float(np.sqrt(np.mean((rest - share * slope) ** 2)))
                clear = abs(share) * float(np.abs(slope).max()) > NOISE
                clear &= abs(share) * float(np.linalg.norm(slope)) > CLEAR * rms
                declared.append(here)
                acts.append(here + share * size)
                errors.append(abs(share))
                if clear and abs(share) > TOLERANCE:
                    reason = f"declared {here:.4g}, acts as {acts[-1]:.4g}"
            if declared:
                passed, error = not reason, max(errors)
                yield Law(
                    variable=name, law="motion", declared=tuple(declared), found=tuple(acts),
                    error=error, passed=passed, reason=reason,
                )  # fmt: skip
            else:
                yield self.silent(name, "motion", "moves nothing without contact")
