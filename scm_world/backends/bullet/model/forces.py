"""Forces on joints: actuators, springs and dampers. They are passed to the engine before each step.

What brakes in proportion to speed, dampers and the velocity gains of servos, acts with the speed
at the end of the step, as in MuJoCo's integrator ``implicitfast``: with that before the step,
light links would turn back faster than they came. That needs mass matrix and bias of the trees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scm_world._types import Floats, Integers
from scm_world.backends.bullet.model.build import matrix_of, places_of_fixed, solid
from scm_world.backends.bullet.vectors import (
    applied,
    cross,
    dot,
    minus,
    plus,
    scaled,
    turned,
    vector,
)
from scm_world.geometry.arrays import copy_rows
from scm_world.geometry.rotations import rotation_kernel
from scm_world.models.bodies import ModelBodies

HINGE, SLIDE, BALL, FREE = range(4)
KINDS = {"hinge": HINGE, "slide": SLIDE, "ball": BALL, "free": FREE}
DOFS = {"hinge": 1, "slide": 1, "ball": 3, "free": 6}
WIDTH = {"hinge": 1, "slide": 1, "ball": 4, "free": 7}
"""How many numbers of the state say where a joint is; its velocities follow."""


class Joints(NamedTuple):
    """Joints as arrays, n of them.

    Attributes:
        kinds: Shape (n,).
        starts: Where they begin in the state, shape (n,).
        dofs: Their first degree of freedom, shape (n,).
        anchors: Shape (n, 3) [m].
        axes: Shape (n, 3).
        references: Shape (n,).
        springs: Stiffness and coordinate at rest, shape (n, 2).
        damping: Shape (n,).
        efforts: Lower and upper bound of what actuators exert, shape (n, 2).
    """

    kinds: Integers
    starts: Integers
    dofs: Integers
    anchors: Floats
    axes: Floats
    references: Floats
    springs: Floats
    damping: Floats
    efforts: Floats


class Actuators(NamedTuple):
    """Actuators as arrays, n of them.

    Attributes:
        joints: Shape (n,).
        controls: Shape (n,).
        gears: Shape (n, 3).
        gains: Shape (n, 3).
        biases: Shape (n, 3).
        ranges: Bounds of the control, then of the force, shape (n, 4).
    """

    joints: Integers
    controls: Integers
    gears: Floats
    gains: Floats
    biases: Floats
    ranges: Floats


class Links(NamedTuple):
    """The bodies that move as arrays, n of them.

    Attributes:
        parents: Number of the body that carries each; -1 for the world, shape (n,).
        offsets: Of their frames in those of the parents, shape (n, 3) [m].
        turns: The same as matrices, shape (n, 3, 3).
        joints: First joint, and the one after the last, shape (n, 2).
        masses: Shape (n,) [kg].
        centers: Shape (n, 3) [m].
        inertias: About the center, in the frame of the body, shape (n, 3, 3) [kg m²].
        above: The degree of freedom before each one on the way to the world; -1 if there is
            none, shape (n_dofs,).
        owners: The body that each degree of freedom moves, shape (n_dofs,).
    """

    parents: Integers
    offsets: Floats
    turns: Floats
    joints: Integers
    masses: Floats
    centers: Floats
    inertias: Floats
    above: Integers
    owners: Integers


@final
class Forces:
    """The forces on all degrees of freedom, as a function of state and command.

    Args:
        bodies: What is driven, with the parameters in force.

    Attributes:
        driven: Numbers of the joints that may feel a force.
        constant: Whether the forces depend on the command alone.
        dofs: First degree of freedom of each joint.
    """

    def __init__(self, bodies: ModelBodies) -> None:
        joints, actuators = bodies.joints, bodies.actuators
        sizes = [DOFS[joint.kind] for joint in joints]
        self.dofs: list[int] = np.cumsum([0, *sizes])[:-1].tolist()
        moved = {actuator.joint for actuator in actuators}
        self.driven = tuple(
            number
            for number, joint in enumerate(joints)
            if number in moved or joint.stiffness or joint.damping
        )
        servos = [(*a.gain[1:], *a.bias[1:]) for a in actuators]
        self.constant = not any(any(servo) for servo in servos) and not any(
            joint.stiffness or joint.damping for joint in joints
        )
        brakes = any(joint.damping for joint in joints)
        brakes = brakes or any(servo[1] or servo[3] for servo in servos)
        infinite = (-math.inf, math.inf)
        self._joints = Joints(
            np.array([KINDS[joint.kind] for joint in joints], dtype=np.int64),
            np.array([joint.start for joint in joints], dtype=np.int64),
            np.array(self.dofs, dtype=np.int64),
            _rows([joint.position for joint in joints], 3),
            _rows([joint.axis for joint in joints], 3),
            np.array([joint.reference for joint in joints], dtype=np.float64),
            _rows([(joint.stiffness, joint.rest) for joint in joints], 2),
            np.array([joint.damping for joint in joints], dtype=np.float64),
            _rows([joint.effort or infinite for joint in joints], 2),
        )
        self._actuators = Actuators(
            np.array([actuator.joint for actuator in actuators], dtype=np.int64),
            np.array([actuator.control for actuator in actuators], dtype=np.int64),
            _rows([(*actuator.gear, 0.0, 0.0)[:3] for actuator in actuators], 3),
            _rows([actuator.gain for actuator in actuators], 3),
            _rows([actuator.bias for actuator in actuators], 3),
            _rows(
                [
                    (*(actuator.control_range or infinite), *(actuator.force_range or infinite))
                    for actuator in actuators
                ],
                4,
            ),
        )
        self._links = _links(bodies, self._joints, brakes)
        self._gravity, self._timestep = np.array(bodies.gravity), bodies.timestep

    def __call__(self, state: Sequence[float], command: Sequence[float]) -> list[float]:
        """Compute the force on every degree of freedom [N m] or [N].

        Args:
            state: All numbers of the state; what they are does not matter if ``constant``.
            command: All numbers of the command.
        """
        forces: list[float] = _forces(
            np.array(state),
            np.array(command),
            self._joints,
            self._actuators,
            self._links,
            self._gravity,
            self._timestep,
        ).tolist()
        return forces


def _rows(rows: list[tuple[float, ...]], width: int) -> Floats:
    return np.array(rows, dtype=np.float64).reshape(-1, width)


def _links(bodies: ModelBodies, joints: Joints, needed: bool) -> Links:
    """Describe what moves by arrays; none if that is not needed."""
    moving = [number for number, root in enumerate(bodies.roots) if root and needed]
    row = {number: i for i, number in enumerate(moving)}
    places = places_of_fixed(bodies)
    n_dofs = int(sum(DOFS[joint.kind] for joint in bodies.joints))
    above = np.full(n_dofs, -1, dtype=np.int64)
    owners = np.full(n_dofs, -1, dtype=np.int64)
    offsets, turns, spans, inertias = [], [], [], []
    last: dict[int, int] = {}  # degree of freedom of a body, or of the next above it that has one
    for number in moving:
        body = bodies.bodies[number]
        own = sorted(bodies.joints_of(number))
        spans.append((own[0], own[-1] + 1) if own else (0, 0))
        before = last.get(body.parent, -1)
        for joint in own:
            first = int(joints.dofs[joint])
            for dof in range(first, first + DOFS[bodies.joints[joint].kind]):
                above[dof], owners[dof], before = before, row[number], dof
        last[number] = before
        offset, turn = np.array(body.position), matrix_of(body.orientation)
        if body.parent not in row:
            position, orientation = places[body.parent]
            around = matrix_of(orientation)
            offset, turn = position + around @ offset, around @ turn
        moments, axes = solid(bodies, number)
        frame = matrix_of(axes)
        offsets.append(offset)
        turns.append(turn)
        inertias.append((frame * moments) @ frame.T)
    return Links(
        np.array([row.get(bodies.bodies[n].parent, -1) for n in moving], dtype=np.int64),
        np.array(offsets).reshape(-1, 3),
        np.array(turns).reshape(-1, 3, 3),
        np.array(spans, dtype=np.int64).reshape(-1, 2),
        np.array([bodies.bodies[n].mass for n in moving]),
        _rows([bodies.bodies[n].center for n in moving], 3),
        np.array(inertias).reshape(-1, 3, 3),
        above,
        owners,
    )


@njit(cache=True)
def _forces(
    state: Floats,
    command: Floats,
    joints: Joints,
    actuators: Actuators,
    links: Links,
    gravity: Floats,
    timestep: float,
) -> Floats:
    """Compute the forces on all degrees of freedom, shape (n_dofs,) [N m] or [N].

    With mass matrix M, bias b, forces f and slopes D, the implicit step has the acceleration
    ``a = (M + h D)^-1 (f - b)``; the engine's explicit step has the same with ``f - h D a``.
    """
    forces, slopes = np.zeros(len(links.above)), np.zeros(len(links.above))
    _act(state, command, joints, actuators, forces, slopes)
    _resist(state, joints, forces, slopes)
    if len(links.parents):
        matrix, right = _dynamics(state, joints, links, gravity)
        for dof in range(len(forces)):
            matrix[dof, dof] += timestep * slopes[dof]
            right[dof] = forces[dof] - right[dof]
        _solve(matrix, links.above, right)
        for dof in range(len(forces)):
            forces[dof] -= timestep * slopes[dof] * right[dof]
    return forces


@njit(cache=True)
def _act(
    state: Floats,
    command: Floats,
    joints: Joints,
    actuators: Actuators,
    forces: Floats,
    slopes: Floats,
) -> None:
    """Write the forces of actuators, and how much of them is lost with each unit of speed.

    Source:
        MuJoCo, *Computation, Actuation model*.
    """
    for i in range(len(actuators.joints)):
        joint = actuators.joints[i]
        start, dof = joints.starts[joint], joints.dofs[joint]
        low, high, weakest, strongest = actuators.ranges[i]
        control = min(max(command[actuators.controls[i]], low), high)
        gain, bias, gear = actuators.gains[i], actuators.biases[i], actuators.gears[i]
        force, slope = gain[0] * control + bias[0], 0.0
        if joints.kinds[joint] != BALL:
            length, rate = gear[0] * state[start], gear[0] * state[start + 1]
            slope = gain[2] * control + bias[2]
            force += (gain[1] * control + bias[1]) * length + slope * rate
        if force < weakest or force > strongest:
            force, slope = min(max(force, weakest), strongest), 0.0
        for k in range(3 if joints.kinds[joint] == BALL else 1):
            forces[dof + k] += gear[k] * force
            slopes[dof + k] -= gear[k] * gear[k] * slope


@njit(cache=True)
def _resist(state: Floats, joints: Joints, forces: Floats, slopes: Floats) -> None:
    """Cut the forces of actuators, and add those of springs and dampers.

    Source:
        MuJoCo, *Computation, Passive forces*.
    """
    for joint in range(len(joints.kinds)):
        start, dof = joints.starts[joint], joints.dofs[joint]
        kind, damping = joints.kinds[joint], joints.damping[joint]
        if kind in (HINGE, SLIDE):
            weakest, strongest = joints.efforts[joint]
            if forces[dof] < weakest or forces[dof] > strongest:
                forces[dof], slopes[dof] = min(max(forces[dof], weakest), strongest), 0.0
            stiffness, rest = joints.springs[joint]
            forces[dof] += stiffness * (rest - state[start]) - damping * state[start + 1]
            slopes[dof] = max(slopes[dof], 0.0) + damping
        elif kind == BALL:
            for k in range(3):
                forces[dof + k] -= damping * state[start + 4 + k]
                slopes[dof + k] = damping


@njit(cache=True)
def _dynamics(
    state: Floats, joints: Joints, links: Links, gravity: Floats
) -> tuple[Floats, Floats]:
    """Compute the mass matrix, shape (n_dofs, n_dofs), and the bias, shape (n_dofs,).

    The degrees of freedom of a free body are here the velocity of the point of it that is at its
    origin now, and its angular velocity in its own frame.

    Source:
        Composite rigid bodies and recursive Newton-Euler; Featherstone, *Rigid Body Dynamics
        Algorithms*, 2008, chapters 5 and 6; in the world's axes, about one point for each tree.
    """
    n, n_dofs = len(links.parents), len(links.above)
    turns, places, points = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 3))
    spins, speeds = np.zeros((n, 3)), np.zeros((n, 3))
    growths, rises = np.zeros((n, 3)), np.zeros((n, 3))
    directions, levers = np.zeros((n_dofs, 3)), np.zeros((n_dofs, 3))
    for i in range(n):
        parent = links.parents[i]
        if parent < 0:
            copy_rows(links.turns[i], turns[i])
            _put(places[i], vector(links.offsets[i]))
            _put(points[i], vector(links.offsets[i]))
            _put(rises[i], scaled(-1.0, vector(gravity)))
        else:
            copy_rows(_product(turns[parent], links.turns[i]), turns[i])
            offset = applied(turns[parent], vector(links.offsets[i]))
            _put(places[i], plus(vector(places[parent]), offset))
            for inherited in (points, spins, speeds, growths, rises):
                _put(inherited[i], vector(inherited[parent]))
        for joint in range(links.joints[i, 0], links.joints[i, 1]):
            _move(i, joint, state, joints, turns, places, points, directions, levers)
            dof, start, kind = joints.dofs[joint], joints.starts[joint], joints.kinds[joint]
            first = start + (1 if kind in (HINGE, SLIDE) else 4 if kind == BALL else 7)
            twist, shift = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
            for k in range(1 if kind in (HINGE, SLIDE) else 3 if kind == BALL else 6):
                twist = plus(twist, scaled(state[first + k], vector(directions[dof + k])))
                shift = plus(shift, scaled(state[first + k], vector(levers[dof + k])))
            spin, speed = vector(spins[i]), vector(speeds[i])
            _add(growths[i], cross(spin, twist))
            _add(rises[i], plus(cross(spin, shift), cross(speed, twist)))
            _add(spins[i], twist)
            _add(speeds[i], shift)
    return _gathered(
        links, turns, places, points, spins, speeds, growths, rises, directions, levers
    )


@njit(cache=True)
def _move(
    i: int,
    joint: int,
    state: Floats,
    joints: Joints,
    turns: Floats,
    places: Floats,
    points: Floats,
    directions: Floats,
    levers: Floats,
) -> None:
    """Let a joint move the frame of body i, and write down its axes about the point of the tree."""
    start, dof, kind = joints.starts[joint], joints.dofs[joint], joints.kinds[joint]
    if kind == FREE:
        place = vector(state[start : start + 3])
        _put(places[i], place)
        _put(points[i], place)
        rotation_kernel(state[start + 3 : start + 7], turns[i])
        for k in range(3):
            levers[dof + k, k] = 1.0
            _put(directions[dof + 3 + k], vector(turns[i, :, k]))
        return
    anchor = applied(turns[i], vector(joints.anchors[joint]))
    hold = plus(vector(places[i]), anchor)
    axis = applied(turns[i], vector(joints.axes[joint]))
    value = state[start] - joints.references[joint]
    if kind == SLIDE:
        _put(levers[dof], axis)
        _add(places[i], scaled(value, axis))
        return
    if kind == HINGE:
        for k in range(3):
            _put(turns[i, :, k], turned(axis, value, vector(turns[i, :, k])))
        _put(directions[dof], axis)
    else:
        own = np.empty((3, 3))
        rotation_kernel(state[start : start + 4], own)
        copy_rows(_product(turns[i], own), turns[i])
        for k in range(3):
            _put(directions[dof + k], vector(turns[i, :, k]))
    for k in range(1 if kind == HINGE else 3):
        arm = minus(hold, vector(points[i]))
        _put(levers[dof + k], cross(arm, vector(directions[dof + k])))
    _put(places[i], minus(hold, applied(turns[i], vector(joints.anchors[joint]))))


@njit(cache=True)
def _gathered(
    links: Links,
    turns: Floats,
    places: Floats,
    points: Floats,
    spins: Floats,
    speeds: Floats,
    growths: Floats,
    rises: Floats,
    directions: Floats,
    levers: Floats,
) -> tuple[Floats, Floats]:
    """Add up inertias and forces from the tips to the roots; give mass matrix and bias."""
    n, n_dofs = len(links.parents), len(links.above)
    masses, moments, inertias = links.masses.copy(), np.empty((n, 3)), np.empty((n, 3, 3))
    pushes, torques = np.empty((n, 3)), np.empty((n, 3))
    for i in range(n):
        spin, speed, mass = vector(spins[i]), vector(speeds[i]), masses[i]
        growth, rise = vector(growths[i]), vector(rises[i])
        own = _product(_product(turns[i], links.inertias[i]), turns[i].T)
        center = plus(vector(places[i]), applied(turns[i], vector(links.centers[i])))
        center = minus(center, vector(points[i]))
        momentum = scaled(mass, plus(speed, cross(spin, center)))
        whirl = plus(applied(own, spin), cross(center, momentum))
        push = scaled(mass, plus(rise, cross(growth, center)))
        torque = plus(applied(own, growth), cross(center, push))
        _put(pushes[i], plus(push, cross(spin, momentum)))
        _put(torques[i], plus(torque, plus(cross(spin, whirl), cross(speed, momentum))))
        _put(moments[i], scaled(mass, center))
        square = dot(center, center)
        for j in range(3):
            for k in range(3):
                own[j, k] += mass * ((square if j == k else 0.0) - center[j] * center[k])
        copy_rows(own, inertias[i])
    for i in range(n - 1, -1, -1):
        parent = links.parents[i]
        if parent >= 0:
            masses[parent] += masses[i]
            for part in (moments, pushes, torques):
                _add(part[parent], vector(part[i]))
            for k in range(3):
                _add(inertias[parent, k], vector(inertias[i, k]))
    matrix, bias = np.zeros((n_dofs, n_dofs)), np.empty(n_dofs)
    for dof in range(n_dofs):
        i, axis, lever = links.owners[dof], vector(directions[dof]), vector(levers[dof])
        bias[dof] = dot(axis, torques[i]) + dot(lever, pushes[i])
        moment = vector(moments[i])
        momentum = plus(scaled(masses[i], lever), cross(axis, moment))
        whirl = plus(applied(inertias[i], axis), cross(moment, lever))
        other = dof
        while other >= 0:
            matrix[dof, other] = dot(directions[other], whirl) + dot(levers[other], momentum)
            other = links.above[other]
    return matrix, bias


@njit(cache=True)
def _solve(matrix: Floats, above: NDArray[np.int64], right: Floats) -> None:
    """Solve equations whose matrix couples degrees of freedom with those above them, in place.

    Args:
        matrix: Its lower triangle, shape (n, n). It is overwritten.
        above: The degree of freedom before each one; -1 if there is none, shape (n,).
        right: The right side; then the solution, shape (n,).

    Source:
        Featherstone, *Rigid Body Dynamics Algorithms*, 2008, section 6.5 (L^T D L).
    """
    n = len(right)
    for k in range(n - 1, -1, -1):
        i = above[k]
        while i >= 0:
            share = matrix[k, i] / matrix[k, k]
            j = i
            while j >= 0:
                matrix[i, j] -= share * matrix[k, j]
                j = above[j]
            matrix[k, i] = share
            i = above[i]
    for k in range(n - 1, -1, -1):
        i = above[k]
        while i >= 0:
            right[i] -= matrix[k, i] * right[k]
            i = above[i]
    for k in range(n):
        right[k] /= matrix[k, k]
        i = above[k]
        while i >= 0:
            right[k] -= matrix[k, i] * right[i]
            i = above[i]


@njit(cache=True)
def _product(first: Floats, second: Floats) -> Floats:
    """Multiply two matrices, shape (3, 3)."""
    result = np.empty((3, 3))
    for j in range(3):
        for k in range(3):
            result[j, k] = dot(first[j], second[:, k])
    return result


@njit(cache=True)
def _put(array: Floats, value: tuple[float, float, float]) -> None:
    """Write a vector."""
    array[0], array[1], array[2] = value


@njit(cache=True)
def _add(array: Floats, value: tuple[float, float, float]) -> None:
    """Add a vector."""
    array[0] += value[0]
    array[1] += value[1]
    array[2] += value[2]
