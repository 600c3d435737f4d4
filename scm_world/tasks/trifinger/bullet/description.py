"""The robot as URDF text, generated from the constants of ``hardware``.

Every link has at most one collision shape, so that the engine's saved states are exact; the
fingertip is therefore a link of its own. A finger is the links base, upper, middle, lower, tip.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.hardware import Capsule, Inertial

LINKS_IN_ENGINE = 5  # of each finger, the tip included; link k of finger f has index 5 f + k

JOINTS = tuple(LINKS_IN_ENGINE * finger + link for finger in range(3) for link in (1, 2, 3))
"""Indices of the nine hinges."""

PARTS = ("upper", "middle", "lower", "tip")
"""The colliding links of a finger; part k has index 5 f + k + 1."""

_UNIT = Inertial((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), (1.0, 1.0, 1.0))


def link_index(finger: int, link: int) -> int:
    """Give the engine's index of a link; the tip is link 4."""
    return LINKS_IN_ENGINE * finger + link


def robot_urdf(meshes: Mapping[str, str] | None = None) -> str:
    """Describe the whole robot.

    Args:
        meshes: Files with the collision shapes of the parts that have one; capsules if None.
    """
    forms = meshes or {part: _capsule(shape) for part, shape in hardware.COLLISION.items()}
    lines = ['<robot name="trifinger">', _link("base", 1.0, _UNIT, None)]
    for finger in range(3):
        lines.extend(_finger(finger, forms))
    lines.append("</robot>")
    return "\n".join(lines)


def _finger(finger: int, forms: Mapping[str, str]) -> Iterator[str]:
    """Describe the five links of a finger and the joints above them."""
    names = [hardware.link_name(hardware.FINGERS[finger], link) for link in range(4)]
    names.append(f"{names[3]}_tip")
    tip = tuple(moment / hardware.TIP_MASS for moment in hardware.TIP_INERTIA)
    inertials = (*hardware.INERTIAL, Inertial(_UNIT.center, _UNIT.orientation, tip))  # type: ignore[arg-type]
    masses = (*hardware.LINK_MASS, hardware.TIP_MASS)
    for link, name in enumerate(names):
        form = forms.get(PARTS[link - 1]) if link else None
        yield _link(name, masses[link], inertials[link], form)
    offset, yaw = hardware.FINGER_OFFSET[finger], hardware.FINGER_YAW[finger]
    yield _joint("base", names[0], offset, yaw=yaw)
    for joint in range(3):
        yield _joint(names[joint], names[joint + 1], hardware.JOINT_ORIGINS[joint], hinge=joint)
    yield _joint(names[3], names[4], hardware.TIP_ORIGIN)


def _link(name: str, mass: float, inertial: Inertial, form: str | None) -> str:
    moments = zip(("ixx", "iyy", "izz"), inertial.per_mass, strict=True)
    inertia = " ".join(f'{axis}="{mass * moment!r}"' for axis, moment in moments)
    return (
        f'<link name="{name}"><inertial>{_origin(inertial.center, _rpy(inertial.orientation))}'
        f'<mass value="{mass!r}"/><inertia {inertia} ixy="0" ixz="0" iyz="0"/></inertial>'
        f"{_shapes(form)}</link>"
    )


def _shapes(form: str | None) -> str:
    """Describe a collision shape and its picture. A link without the former has a picture only."""
    if form is None:
        return '<visual><geometry><box size="0.02 0.02 0.02"/></geometry></visual>'
    return f"<visual>{form}</visual><collision>{form}</collision>"


def _capsule(shape: Capsule) -> str:
    x, y, z = (end - start for start, end in zip(shape.start, shape.end, strict=True))
    middle = tuple((start + end) / 2 for start, end in zip(shape.start, shape.end, strict=True))
    tilt = (0.0, math.atan2(math.hypot(x, y), abs(z)), math.atan2(y, x))  # from the z axis
    capsule = f'<capsule radius="{shape.radius!r}" length="{math.hypot(x, y, z)!r}"/>'
    return f"{_origin(middle, tilt)}<geometry>{capsule}</geometry>"


def _joint(
    parent: str,
    child: str,
    origin: tuple[float, ...],
    *,
    yaw: float = 0.0,
    hinge: int | None = None,
) -> str:
    kind, axis = "fixed", ""
    if hinge is not None:
        limit = hardware.ENGINE_LIMITS[hinge]
        kind = "revolute"
        axis = (
            f'<axis xyz="{_numbers(hardware.JOINT_AXES[hinge])}"/>'
            f'<limit lower="{-limit!r}" upper="{limit!r}" effort="1000" velocity="1000"/>'
        )
    return (
        f'<joint name="to_{child}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f"{_origin(origin, (0.0, 0.0, yaw))}{axis}</joint>"
    )


def _origin(xyz: tuple[float, ...], rpy: tuple[float, ...]) -> str:
    return f'<origin xyz="{_numbers(xyz)}" rpy="{_numbers(rpy)}"/>'


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(map(repr, values))


def _rpy(quaternion: tuple[float, float, float, float]) -> tuple[float, float, float]:
    """Turn (x, y, z, w) into roll, pitch and yaw about fixed axes [rad]."""
    x, y, z, w = quaternion
    return (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )
