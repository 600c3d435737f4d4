"""What of a model the engine can honour, and what it cannot."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Literal

from scm_world.models.bodies import Joint, ModelBodies
from scm_world.models.model import Model
from scm_world.models.scene import ParameterKey


def shares(bodies: ModelBodies, usual: float) -> list[float]:
    """Give each shape a number, so that a contact has the product of two as its friction.

    A model says the larger of two coefficients. The product is that wherever a moving shape
    touches fixed ones that are all alike, and wherever one of two moving shapes has the usual
    coefficient and the other at least that, if the floor has no more than it. The number of a
    moving shape depends on its own coefficient and on that of the first fixed shape alone, so
    that shapes which never touch leave one another alone to the last bit.

    Args:
        bodies: All of them, with the coefficients in force.
        usual: See ``usual_friction``.
    """
    fixed = [not bodies.roots[geom.body] for geom in bodies.geoms]
    coefficients = [0.0 if geom.slippery else geom.friction for geom in bodies.geoms]
    measure = next((c for c, still in zip(coefficients, fixed, strict=True) if still), None)
    if not measure:  # nothing is fixed, or it is smooth: the other shape decides
        scale = math.sqrt(usual) if measure is None and usual else 1.0
        return [
            (c or 1.0) if still else c / scale for c, still in zip(coefficients, fixed, strict=True)
        ]
    scale = math.sqrt(max(measure, usual))
    return [
        c / measure * scale if still else max(c, measure) / scale
        for c, still in zip(coefficients, fixed, strict=True)
    ]


def usual_friction(bodies: ModelBodies) -> float:
    """Give the coefficient in the middle of those of the moving shapes, as in the model's file."""
    moving = [geom for geom in bodies.geoms if bodies.roots[geom.body]]
    return statistics.median_low([0.0 if g.slippery else g.friction for g in moving] or [0.0])


MOST_LINKS = 127
"""The engine has room for no more of them in a multibody."""

REBUILT = {
    "bodies": ("position", "orientation", "center"),
    "joints": ("position", "axis", "reference", "armature"),
    "geoms": ("position", "orientation", "size"),
}
"""What only new bodies can take on, by table of ``ModelBodies``."""

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
    """List everything in a model that the engine cannot honour."""
    bodies, roots = model.bodies, model.bodies.roots
    found = [*bodies.missing, *_of_joints(bodies)]
    for coupling in bodies.couplings:
        one, other = bodies.joints[coupling.joint], bodies.joints[coupling.leader]
        if roots[one.body] != roots[other.body]:
            found.append(
                f"the equality constraint {coupling.name!r}, which joins {one.name!r} and "
                f"{other.name!r} of two trees"
            )
    for root in sorted(set(roots) - {0}):
        links = _links(bodies, [n for n, other in enumerate(roots) if other == root])
        if links > MOST_LINKS:
            found.append(
                f"the {links} links that {bodies.bodies[root].name!r} and all that hangs on it "
                f"need: there is room for {MOST_LINKS}"
            )
    return tuple(found)


def _of_joints(bodies: ModelBodies) -> Iterator[str]:
    """List what joints ask for in vain."""
    for joint in bodies.joints:
        scalar = joint.kind in ("hinge", "slide")
        if joint.armature and not takes_armature(bodies, joint.body):
            yield (
                f"armature of the joint {joint.name!r}, which is not a hinge that alone carries a "
                "body on the world"
            )
        if joint.range is not None and not scalar:
            yield f"limits of the {joint.kind} joint {joint.name!r}"
        if joint.stiffness and not scalar:
            yield f"stiffness of the {joint.kind} joint {joint.name!r}"
        if joint.friction and not scalar:
            yield f"frictionloss of the {joint.kind} joint {joint.name!r}"
        if joint.damping and joint.kind == "free":
            yield f"damping of the free joint {joint.name!r}"


def takes_armature(bodies: ModelBodies, body: int) -> bool:
    """Tell whether the armature of the joint of a body is as if the body had more inertia."""
    joints = [bodies.joints[joint] for joint in bodies.joints_of(body)]
    fixed = not bodies.roots[bodies.bodies[body].parent]
    return fixed and len(joints) == 1 and joints[0].kind == "hinge"


def _links(bodies: ModelBodies, members: list[int]) -> int:
    """Count the links of a multibody."""
    links = sum(geom.body in members for geom in bodies.geoms)
    for member in members:
        joints = [bodies.joints[joint].kind for joint in bodies.joints_of(member)]
        links += 0 if "free" in joints else max(1, len(joints))
    return links


def supports(model: Model, key: ParameterKey) -> bool:
    """Tell whether a parameter of a model can be set: the engine has it, or only pictures do."""
    return key in changes(model.bodies) or any(
        row.key == key and row.visual for row in model.parameters
    )


@lru_cache(maxsize=64)
def changes(bodies: ModelBodies) -> Mapping[ParameterKey, Literal["live", "rebuilt"]]:
    """Map the parameters that the engine has to what a change of them takes."""
    found: dict[ParameterKey, Literal["live", "rebuilt"]] = {}
    for key, place in bodies.places.items():
        fields = {part.field for part in place.parts}
        if fields <= set(REBUILT.get(place.table, ())):
            found[key] = "rebuilt"
        elif fields <= set(LIVE.get(place.table, ())):
            turns = place.table == "bodies" and "inertia" in fields
            solid = turns and takes_armature(bodies, place.row)  # armature is part of its inertia
            found[key] = "rebuilt" if solid else "live"
        if place.table == "joints" and not _is_of(bodies, bodies.joints[place.row], fields):
            found.pop(key, None)
    return found


def _is_of(bodies: ModelBodies, joint: Joint, fields: set[str]) -> bool:
    """Tell whether a joint can have something."""
    if "armature" in fields:
        return takes_armature(bodies, joint.body)
    if fields & {"stiffness", "friction"}:
        return joint.kind in ("hinge", "slide")
    return "damping" not in fields or joint.kind != "free"
