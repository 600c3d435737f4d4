"""Where each parameter lives in a compiled model, and how it is written and read there.

Every write is a pure function of the values in force afterwards, so that any order of changes
ends in the same model bit for bit. Derived constants of the model (bounding radii, inverse
weights) follow with ``mj_setConst``, wherever ``constant`` says so; frictions of pairs with
``couple``.

The first nine actuators are servos, the other nine the dampers of the safety filter. What a servo
does depends on the control mode, so its gains rest in numbers that MuJoCo does not use, and
``steer`` copies them from there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import mujoco
import numba
import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.backends.mujoco.slots import Slot, first, place, turn
from scm_world.models.scene import ControlMode, ParameterKey
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.hardware import N_JOINTS
from scm_world.tasks.trifinger.mujoco.model import (
    CONTACT,
    FLOOR,
    STAGE,
    base_name,
    link_shapes,
    shape_owners,
    wall_name,
)
from scm_world.tasks.trifinger.structure import WALL_SEGMENTS, Structure

_POSITION, _VELOCITY = 1, 2  # where gains rest among the parameters of a gain that is fixed


def slots(model: mujoco.MjModel, structure: Structure) -> dict[ParameterKey, Slot]:
    """Find the place of every parameter of this structure in this model."""
    hanging = [name(f) for f in hardware.FINGERS for name in (base_name, _fixed_link)]
    heights = [model.body_pos[model.body(name).id, 2, ...] for name in hanging]
    offset = hardware.TABLE_OFFSET
    rest = model.actuator_gainprm[:N_JOINTS]
    ranges = model.actuator_forcerange[:N_JOINTS], model.jnt_actfrcrange[:N_JOINTS]
    found: dict[ParameterKey, Slot] = {
        ("world", "gravity"): place(model.opt.gravity),
        ("world", "restitution"): _restitution(model.pair_solref, CONTACT[structure.preset.name]),
        ("world", "spinning_friction"): place(model.geom_friction[:, 1], back=first),
        ("robot", "height"): place(
            *heights, to=lambda z: z - offset, back=lambda z: z + offset, constant=True
        ),
        ("robot", "joint_damping"): place(model.dof_damping[:N_JOINTS], back=first),
        ("controller", "position_gains"): _gains(rest[:, _POSITION]),
        ("controller", "velocity_gains"): _gains(rest[:, _VELOCITY]),
        ("controller", "safety_damping"): _gains(model.actuator_biasprm[N_JOINTS:, 2], -1.0),
        ("controller", "torque_limit"): place(
            *ranges, to=lambda limit: np.array([-limit, limit]), back=lambda range_: range_[0, 1]
        ),
    }
    owners = shape_owners(structure)
    links = [name for name, owner in owners.items() if owner in hardware.LINK_NAMES]
    found["robot", "friction"] = _friction(model, links)
    for finger in hardware.FINGERS:
        for index, inertial in enumerate(hardware.INERTIAL):
            link = hardware.link_name(finger, index)
            found[link, "mass"] = _scaled_mass(model, link, inertial.per_mass)
            found[link, "color"] = _color(model, link_shapes(finger, index))
    surfaces = {FLOOR: [FLOOR], STAGE: [wall_name(i) for i in range(WALL_SEGMENTS)]}
    surfaces |= {name: [name] for name in (*structure.blocks, *structure.obstacles)}
    for name, shapes in surfaces.items():
        found[name, "friction"] = _friction(model, shapes)
        found[name, "color"] = _color(model, shapes)
    for name in structure.blocks:
        hull = structure.hull(name)
        if hull is None:
            found[name, "mass"], found[name, "size"] = _box(model, name)
        else:
            found[name, "mass"] = _scaled_mass(model, name, hull.moments)
    for name in structure.obstacles:
        shape = model.geom(name).id
        found[name, "size"] = place(
            model.geom_size[shape], to=lambda v: 0.5 * v, back=lambda v: 2.0 * v, constant=True
        )
        found[name, "position"] = place(model.geom_pos[shape], constant=True)
        found[name, "orientation"] = turn(model.geom_quat[shape])
    return found


def _fixed_link(finger: str) -> str:
    return hardware.link_name(finger, 0)


def _friction(model: mujoco.MjModel, shapes: Iterable[str]) -> Slot:
    """Find the factor of one body. Contact pairs get products; the factors rest in the shapes."""
    return place(*(model.geom_friction[model.geom(name).id, 0, ...] for name in shapes))


def _color(model: mujoco.MjModel, shapes: Iterable[str]) -> Slot:
    """Find red, green, blue, shape (3,); MuJoCo keeps 32 bits of each."""
    return place(*(model.geom_rgba[model.geom(name).id, :3] for name in shapes))


def _gains(places: Floats, factor: float = 1.0) -> Slot:
    """Find a number for each joint of a finger, shape (3,); all fingers have the same."""
    fingers = len(hardware.FINGERS)
    return place(
        places,
        to=lambda value: np.tile(factor * value, fingers),
        back=lambda all_: factor * all_[: N_JOINTS // fingers],
    )


def _scaled_mass(model: mujoco.MjModel, name: str, per_mass: tuple[float, ...]) -> Slot:
    """Find the mass of a link or a hull [kg]; its moments of inertia scale with it."""
    body, moments = model.body(name).id, np.array(per_mass)
    mass, inertia = model.body_mass[body, ...], model.body_inertia[body]

    def write(value: Floats) -> None:
        mass[...] = value
        inertia[:] = value * moments

    return Slot(write, mass.copy, constant=True)


def _box(model: mujoco.MjModel, name: str) -> tuple[Slot, Slot]:
    """Find mass [kg] and full edge lengths [m] of a solid box; its inertia follows both."""
    body = model.body(name).id
    mass, inertia = model.body_mass[body, ...], model.body_inertia[body]
    half = model.geom_size[model.geom(name).id]

    def weigh(value: Floats) -> None:
        mass[...] = value
        _fill_box(float(mass), half, inertia)

    def resize(value: Floats) -> None:
        np.multiply(value, 0.5, out=half)
        _fill_box(float(mass), half, inertia)

    return Slot(weigh, mass.copy, constant=True), Slot(resize, lambda: 2.0 * half, constant=True)


@numba.njit("void(f8, f8[::1], f8[::1])", cache=True)
def _fill_box(mass: float, half: Floats, inertia: Floats) -> None:
    """Give a solid box its moments of inertia, m/12 (b² + c²)."""
    for axis in range(3):
        b, c = half[(axis + 1) % 3], half[(axis + 2) % 3]
        inertia[axis] = mass / 3.0 * (b * b + c * c)


def _restitution(references: Floats, rigid: tuple[float, float]) -> Slot:
    """Find how much of its speed a body keeps when it bounces, in [0, 1).

    A contact is a spring and a damper. A damping ratio z leaves ``exp(-pi z / sqrt(1 - z²))`` of
    the speed after half a period; the frequency stays, and with it how far a body sinks in.

    Args:
        references: Time constant [s] and damping ratio of every pair, shape (n, 2).
        rigid: Both of a contact without restitution, which is critically damped.
    """
    time, ratio = rigid

    def write(value: Floats) -> None:
        loss = -math.log(value) if value > 0.0 else math.inf
        damping = loss / math.hypot(math.pi, loss) if loss < math.inf else 1.0
        references[:, 0], references[:, 1] = time / damping, ratio * damping

    def read() -> Floats:
        damping = float(references[0, 1]) / ratio
        if damping >= 1.0:
            return np.array(0.0)
        return np.array(math.exp(-math.pi * damping / math.sqrt(1.0 - damping * damping)))

    return Slot(write, read)


SPINNING_LIMIT = 1.0
"""At most this many times its sliding friction is the spinning friction of a pair [m]. Above about
five times the solver of the engine speeds a spinning body up, tenfold and more in a step; a real
patch of contact gives two thirds of its radius."""


@numba.njit("void(f8[:, ::1], i4[::1], i4[::1], f8[:, ::1])", cache=True)
def couple(
    factors: Floats, first: NDArray[np.int32], second: NDArray[np.int32], pairs: Floats
) -> None:
    """Give every contact pair the product of its two frictions, and its friction of spinning."""
    for i in range(first.shape[0]):
        product = factors[first[i], 0] * factors[second[i], 0]
        pairs[i, 0] = product
        pairs[i, 1] = product
        pairs[i, 2] = min(factors[first[i], 1], SPINNING_LIMIT * product)


def steer(gains: Floats, biases: Floats, mode: ControlMode) -> None:
    """Make the nine servos follow positions, or pass torques on.

    Args:
        gains: ``actuator_gainprm``, shape (18, 10).
        biases: ``actuator_biasprm``, shape (18, 10).
        mode: What the command means.
    """
    gain, bias = gains[:N_JOINTS], biases[:N_JOINTS]
    if mode is ControlMode.JOINT_POSITIONS:
        gain[:, 0] = gain[:, _POSITION]
        np.negative(gain[:, _POSITION : _VELOCITY + 1], out=bias[:, 1:3])
    else:
        gain[:, 0], bias[:, 1:3] = 1.0, 0.0
