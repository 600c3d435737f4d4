"""Groups of variables of the robot's tasks, by the words of curricula."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from scm_world._patterns import fits
from scm_world.graph import SCM
from scm_world.variables import Variable

PLACES = ("obstacle_places", "drop_*", "number_of_*", "nums_objects", "stack_levels", "wall_side")
"""What decides where things are, or how many."""

QUANTITIES = ("color", "cylindrical_position", "euler_orientation", "mass", "size")
"""What the predecessor draws of a body."""
OURS = (
    "*gains",
    "*noise",
    "camera_*",
    "drop_*",
    "finger_friction",
    "gravity",
    "joint_*",
    "light_*",
    "obstacle_places",
    "restitution",
    "robot_height",
    "safety_damping",
    "spinning_friction",
    "torque_limit",
)
"""Options that it does not have."""

POSE = ("cylindrical_position", "euler_orientation")
"""The coordinates in which the spaces of poses are declared."""


def grouped(
    model: SCM, spaced: Sequence[Variable], bodies: Collection[str], *, placed: bool
) -> dict[str, list[str]]:
    """Return the variables of ``joints``, ``poses`` and ``published``, and those of no physics.

    ``published`` is what the predecessor's random actor draws: never the joints. There a size that
    follows another variable is drawn by drawing the other, so that block and goal stay alike; so
    are masses.

    Args:
        model: The variables of the structure.
        spaced: The roots and states that have a space.
        bodies: Names of the bodies that move.
        placed: Whether variables decide how many blocks there are. They begin where the task puts
            them then: dozens of them are never drawn apart.
    """
    poses = [
        v.name
        for v in spaced
        if v.name.partition(".")[0] in bodies and v.name.partition(".")[2] in POSE
    ]
    published = []
    for v in spaced:
        entity, _, quantity = v.name.rpartition(".")
        is_ours = fits(v.name, OURS) or (entity == "" and v.role == "state")
        if is_ours or (placed and v.name in poses):
            continue
        if quantity in QUANTITIES or not entity:
            published.append(v.name)
    for name in model:
        is_goal = fits(name, ("goal_*.cylindrical_position",))
        if is_goal and model.declared(name).a and model.declared(model.target(name)).settable:
            published.append(name)
    still = (*PLACES, "*euler_orientation", "goal_*", "sensor_noise", "joint_positions")
    return {
        "joints": ["joint_positions"],
        "poses": poses,
        "published": [*dict.fromkeys(published)],
        "unphysical": [v.name for v in spaced if fits(v.name, still)],
    }
