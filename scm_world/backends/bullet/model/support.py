"""What of a model the engine can honour, and what it cannot."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

from scm_world.backends.bullet.model.friction import worst_pairs
from scm_world.models.bodies import Bodies, Place
from scm_world.models.model import Model
from scm_world.models.scene import ParameterKey

MOST_LINKS = 127
"""The engine has room for no more of them in a multibody."""

REBUILT = {
    "bodies": ("position", "orientation", "center"),
    "joints": ("position", "axis", "reference", "armature"),
    "geoms": ("position", "orientation", "size"),
}
"""What only new bodies can take on, by table of ``Bodies``."""

LIVE = {
    "bodies": ("mass", "inertia"),
    "joints": ("damping", "stiffness", "rest", "friction", "range", "effort"),
    "geoms": ("friction",),
    "actuators": ("gear", "gain", "bias", "control_range", "force_range"),
    "": ("gravity", "timestep"),
}
"""What live bodies can take on."""


@lru_cache(maxsize=64)
def unsupported(model: Model) -> tuple[str, ...]:
    """List everything in a model that the engine cannot honour, one sentence each."""
    bodies = model.bodies
    found = [f"{what} has no counterpart" for what in bodies.missing]
    found += _of_joints(bodies)
    roots = bodies.roots
    for coupling in bodies.couplings:
        one, other = bodies.joints[coupling.joint], bodies.joints[coupling.leader]
        if roots[one.body] != roots[other.body]:
            found.append(
                f"the equality constraint {coupling.name!r} joins two trees, {one.name!r} and "
                f"{other.name!r}: couplings work within one"
            )
    for root in sorted(set(roots) - {0}):
        links = _links(bodies, [n for n, other in enumerate(roots) if other == root])
        if links > MOST_LINKS:
            found.append(
                f"the tree of {bodies.bodies[root].name!r} needs {links} links; there is room "
                f"for {MOST_LINKS}"
            )
    return tuple(found)


def _of_joints(bodies: Bodies) -> Iterator[str]:
    """List what joints ask for in vain."""
    for joint in bodies.joints:
        scalar = joint.kind in ("hinge", "slide")
        if joint.armature and not takes_armature(bodies, joint.body):
            yield (
                f"armature of the joint {joint.name!r}: only a hinge that alone carries a body on "
                "the world can have it"
            )
        if joint.range is not None and not scalar:
            yield f"limits of the {joint.kind} joint {joint.name!r}"
        if joint.stiffness and not scalar:
            yield f"stiffness of the {joint.kind} joint {joint.name!r}"
        if joint.friction and not scalar:
            yield f"frictionloss of the {joint.kind} joint {joint.name!r}"
        if joint.damping and joint.kind == "free":
            yield f"damping of the free joint {joint.name!r}"


def takes_armature(bodies: Bodies, body: int) -> bool:
    """Tell whether the armature of the joint of a body is as if the body had more inertia."""
    joints = [bodies.joints[joint] for joint in bodies.joints_of(body)]
    fixed = not bodies.roots[bodies.bodies[body].parent]
    return fixed and len(joints) == 1 and joints[0].kind == "hinge"


def _links(bodies: Bodies, members: list[int]) -> int:
    """Count the links of a multibody."""
    links = sum(geom.body in members for geom in bodies.geoms)
    for member in members:
        joints = [bodies.joints[joint].kind for joint in bodies.joints_of(member)]
        links += 0 if "free" in joints else max(1, len(joints))
    return links


@lru_cache(maxsize=64)
def deviations(model: Model) -> tuple[str, ...]:
    """List what the engine does in another way than the file says, one sentence each."""
    bodies = model.bodies
    found = list(bodies.notes)
    if any(joint.range is not None for joint in bodies.joints):
        found.append("Limits of joints are stiff.")
    if bodies.touching:
        found.append("Contacts are stiff: solref and solimp have no meaning.")
    if any(joint.friction for joint in bodies.joints):
        found.append("Dry friction of joints is a motor that holds still.")
    off = worst_pairs(bodies)
    if off:
        first, second, has, wanted = max(off, key=lambda pair: abs(pair[2] - pair[3]))
        names = bodies.geoms[first].name, bodies.geoms[second].name
        found.append(
            f"The friction of {len(off)} of {len(bodies.touching)} pairs of shapes is not the "
            f"larger of two coefficients: that of {names[0]!r} and {names[1]!r} is {has:.3g} "
            f"instead of {wanted:.3g}."
        )
    return tuple(found)


def supports(model: Model, key: ParameterKey) -> bool:
    """Tell whether a parameter of a model can be set."""
    return key not in _lacking(model)


def parameters_without(model: Model) -> tuple[ParameterKey, ...]:
    """List the parameters of a model that the engine lacks: they keep their defaults."""
    return tuple(_lacking(model))


@lru_cache(maxsize=64)
def _lacking(model: Model) -> dict[ParameterKey, None]:
    bodies = model.bodies
    return {
        row.key: None
        for row in model.parameters
        if not row.visual and not _is_known(bodies, bodies.places.get(row.key))
    }


def _is_known(bodies: Bodies, place: Place | None) -> bool:
    """Tell whether the engine has something at a place of the description."""
    if place is None:
        return False
    names = (*LIVE.get(place.table, ()), *REBUILT.get(place.table, ()))
    if any(part.field not in names for part in place.parts):
        return False
    if place.table != "joints":
        return True
    joint, field = bodies.joints[place.row], place.parts[0].field
    if field == "armature":
        return takes_armature(bodies, joint.body)
    if field in ("stiffness", "friction"):
        return joint.kind in ("hinge", "slide")
    return field != "damping" or joint.kind != "free"


@lru_cache(maxsize=64)
def rebuilt(model: Model) -> tuple[ParameterKey, ...]:
    """List the parameters that need new bodies."""
    bodies = model.bodies
    found = []
    for row in model.parameters:
        place = bodies.places.get(row.key)
        if place is None or not supports(model, row.key):
            continue
        field = place.parts[0].field
        turns = field == "inertia" and takes_armature(bodies, place.row)
        if turns or field in REBUILT.get(place.table, ()):
            found.append(row.key)
    return tuple(found)
