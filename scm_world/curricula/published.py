"""The predecessor's intervention actors.

Source:
    CausalWorld 1.2, ``intervention_actors``.
"""

from __future__ import annotations

from scm_world._arguments import one_of
from scm_world.curricula.base import Do, Part
from scm_world.curricula.parts import NewGoal, Resample
from scm_world.errors import UnknownOption
from scm_world.variables.kinds import SPACES, SpaceName

ALL = ("@published",)
ACTORS = (
    "base_actor",
    "goal_actor",
    "joints_actor",
    "physical_properties_actor",
    "random_actor",
    "rigid_pose_actor",
    "visual_actor",
)
"""Their names in files of the predecessor."""


def published_actor(
    name: str,
    *,
    space: SpaceName = "A|B",
    group: str = "tool",
    positions: bool = True,
    orientations: bool = True,
) -> Part:
    """Give what an actor of the predecessor does.

    Args:
        name: One of ``ACTORS``. ``random_actor`` draws everything, and leaves it to a coin
            whether sizes or positions are drawn; ``joints_actor`` draws the joints from their
            space (there from anywhere, so that most draws were refused).
        space: The active space; ``"A|B"`` is the default there.
        group: Of the physical properties: ``"robot"``, ``"stage"``, ``"floor"`` or ``"tool"``.
        positions: Whether the pose actor draws positions.
        orientations: Whether it draws orientations.

    Raises:
        UnknownOption: There is no such actor, group or space.

    Example:
        >>> published_actor("visual_actor", space="A").what
        ('*color',)
    """
    one_of("space", space, SPACES)
    match name:
        case "base_actor":
            return Do({})
        case "goal_actor":
            return NewGoal(space=space)
        case "joints_actor":
            return Resample("@joints", space=space)
        case "physical_properties_actor":
            one_of("group", group, _PROPERTIES)
            return Resample(_PROPERTIES[group], space=space)
        case "random_actor":
            return Resample(ALL, space=space, exclusive=True)
        case "rigid_pose_actor":
            chosen = (positions, orientations)
            pairs = zip(chosen, ("cylindrical_position", "euler_orientation"), strict=True)
            what = [f"tool_*.{one}" for wanted, one in pairs if wanted]
            return Resample(what, space=space) if what else Do({})
        case "visual_actor":
            return Resample("*color", space=space)
    raise UnknownOption("actor", name, ACTORS)


_PROPERTIES = {
    "floor": "floor_friction",
    "robot": "robot_finger_*.mass",
    "stage": "stage_friction",
    "tool": "tool_*.mass",
}
