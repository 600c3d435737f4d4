"""Copies of model files with more parts: a motor, a force range, a rotor that a joint drives."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, final

import mujoco
import numpy as np

from scm_world.backends.mujoco.sources import _complete, _specified, understood

MORE = "_more"  # after the name of a joint: the motor that acts on it, too
ROTOR = "_rotor"  # after the name of a joint: the rotor on the other side of a gear, and its joint
GEAR = "_gear"  # after the name of a joint: what is between them
SMALL = 1e-6  # mass [kg] of a rotor, and its moments of inertia [kg m^2], without the armature
SHARE = 0.2  # of the inertia that the joint moves: armature of a rotor that no one has measured
FREQUENCY = 10.0  # [Hz] of a spring between a rotor and its joint
RATIO = 0.1  # of its critical damping
UNLIMITED = 1e6  # range of a motor that is added
SOFT = 2.0  # physics steps in which the end of a backlash acts
KINDS = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


@final
@dataclass(frozen=True)
class Part:
    """A part that is added to a model.

    Attributes:
        kind: ``"motor"`` on a joint, ``"forcerange"`` of an actuator, or ``"spring"`` and
            ``"backlash"`` between a rotor, which gets the actuators of a joint, and the joint.
        of: The name of the joint or the actuator.
        size: The force at both ends of a force range, or half of a backlash.
    """

    kind: Literal["motor", "forcerange", "spring", "backlash"]
    of: str
    size: float = 0.0


@final
@dataclass(frozen=True)
class Drive:
    """An actuator, and the joint that it drives: force = gain u + bias (1, gear q, gear v).

    Attributes:
        name: Its name.
        joint: The name of the joint.
        gear: Factor from its force to that on the joint.
        gain: Force for each unit of control.
        bias: Constant, and force for each unit of length and velocity, of which it has a sum.
        plain: Whether its force follows its control at once, by this formula.
        limited: Whether its force is limited.
    """

    name: str
    joint: str
    gear: float
    gain: float
    bias: tuple[float, ...]
    plain: bool
    limited: bool


def drives_of(mj: mujoco.MjModel) -> tuple[Drive, ...]:
    """List the actuators of joints with one axis, with what they do."""
    found = list[Drive]()
    for i in range(mj.nu):
        joint = int(mj.actuator_trnid[i, 0])
        kind = mj.actuator_trntype[i]
        if kind != int(mujoco.mjtTrn.mjTRN_JOINT) or mj.jnt_type[joint] not in map(int, KINDS):
            continue
        plain = mj.actuator_dyntype[i] == int(mujoco.mjtDyn.mjDYN_NONE)
        plain &= mj.actuator_gaintype[i] == int(mujoco.mjtGain.mjGAIN_FIXED)
        affine = mj.actuator_biastype[i] == int(mujoco.mjtBias.mjBIAS_AFFINE)
        plain &= bool(affine or mj.actuator_biastype[i] == int(mujoco.mjtBias.mjBIAS_NONE))
        bias = tuple(float(b) * affine for b in mj.actuator_biasprm[i, :3])
        names = mj.actuator(i).name, mj.joint(joint).name
        gear, gain = float(mj.actuator_gear[i, 0]), float(mj.actuator_gainprm[i, 0])
        limited = bool(mj.actuator_forcelimited[i])
        found.append(Drive(*names, gear, gain, bias, bool(plain), limited))
    return tuple(found)


def with_part(source: object, part: Part, *, fixed_base: bool = True) -> mujoco.MjSpec:
    """Return a model file with another part.

    Args:
        source: A path, XML text or an ``MjSpec``.
        part: The part.
        fixed_base: See ``read_model``.

    Source:
        Spong, *Modeling and control of elastic joint robots*, Journal of Dynamic Systems,
        Measurement, and Control 1987: rotors with inertia about their own axis alone. A backlash
        is a range of the difference of both angles, which MuJoCo keeps as a soft constraint.
    """
    spec, where, _, urdf, _ = _specified(source)
    if urdf:
        _complete(spec, where, fixed_base=fixed_base)
    with understood(where):
        mj = spec.compile()
    if part.kind == "forcerange":
        actuator = spec.actuator(part.of)
        actuator.forcelimited, actuator.forcerange = 1, (-part.size, part.size)
        return spec
    if part.kind == "motor":
        motor = spec.add_actuator(name=part.of + MORE, target=part.of)
        motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
        motor.ctrllimited, motor.ctrlrange = 1, (-UNLIMITED, UNLIMITED)
        return spec
    joint, name = spec.joint(part.of), part.of + ROTOR
    body = joint.parent
    data = mujoco.MjData(mj)
    mujoco.mj_forward(mj, data)
    whole = np.zeros((mj.nv, mj.nv))
    mujoco.mj_fullM(mj, data, whole)
    dof = int(mj.joint(part.of).dofadr[0])
    moved = float(whole[dof, dof])
    rotor = body.parent.add_body(
        name=name, pos=mj.body(body.name).pos, quat=mj.body(body.name).quat
    )
    rotor.explicitinertial, rotor.mass, rotor.inertia = True, SMALL, (SMALL,) * 3
    rotor.ipos = joint.pos
    axle = rotor.add_joint(name=name, type=joint.type, axis=joint.axis, pos=joint.pos)
    axle.ref, axle.armature = joint.ref, SHARE * moved
    for actuator in spec.actuators:
        if actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT and actuator.target == part.of:
            actuator.target = name
    gear = spec.add_tendon(name=part.of + GEAR)
    gear.wrap_joint(name, 1.0)
    gear.wrap_joint(part.of, -1.0)
    if part.kind == "spring":
        reduced = moved * SHARE / (1.0 + SHARE)
        stiffness = reduced * (2.0 * math.pi * FREQUENCY) ** 2
        gear.stiffness = [stiffness, 0.0, 0.0]
        gear.damping = [2.0 * RATIO * math.sqrt(stiffness * reduced), 0.0, 0.0]
        gear.springlength = (0.0, 0.0)
    else:
        gear.limited, gear.range = 1, (-part.size, part.size)
        gear.solref_limit = (SOFT * spec.option.timestep, 1.0)
    return spec
