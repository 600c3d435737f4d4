"""The predecessor's intervention actors.

Source:
    CausalWorld 1.2, ``intervention_actors``.
"""

from __future__ import annotations

from scm_world._arguments import one_of
from scm_world.curricula.base import Part, as_part
from scm_world.curricula.parts import goals, resample
from scm_world.variables.kinds import SPACES, SpaceName

PROPERTIES = {
    "floor": "floor_friction",
    "robot": "robot_finger_*.mass",
    "stage": "stage_friction",
    "tool": "tool_*.mass",
}
"""The variables of each group of physical properties."""
POSITIONS, ORIENTATIONS = ("tool_*.cylindrical_position",), ("tool_*.euler_orientation",)
DRAWN: dict[str, str | tuple[str, ...]] = {
    "base_actor": (),
    "goal_actor": (),
    "joints_actor": "@joints",
    "physical_properties_actor": (),
    "random_actor": "@published",
    "rigid_pose_actor": (),
    "visual_actor": "*color",
}
"""What each actor draws, by its name in files of the predecessor; nothing where options decide."""
ACTORS = tuple(DRAWN)


def published_actor(
    name: str,
    *,
    space: SpaceName = "A|B",
    group: str = "tool",
    positions: bool = True,
    orientations: bool = True,
) -> Part:
    """Return the part that does what an actor of the predecessor does.

    Args:
        name: One of ``ACTORS``. ``random_actor`` draws everything, and a coin decides whether
            sizes or positions are drawn; ``joints_actor`` draws the joints from their space
            (there from anywhere, so that most draws were refused).
        space: The active space; ``"A|B"`` is the default there.
        group: The physical properties: ``"robot"``, ``"stage"``, ``"floor"`` or ``"tool"``.
        positions: Whether the pose actor draws positions.
        orientations: Whether it draws orientations.

    Raises:
        UnknownOption: There is no such actor, group or space.

    Example:
        >>> published_actor("visual_actor", space="A").what
        ('*color',)
    """
    one_of("actor", name, ACTORS)
    one_of("group", group, PROPERTIES)
    one_of("space", space, SPACES)
    if name == "goal_actor":
        return goals(space)
    what = DRAWN[name]
    if name == "physical_properties_actor":
        what = PROPERTIES[group]
    elif name == "rigid_pose_actor":
        pairs = (
            (positions, "tool_*.cylindrical_position"),
            (orientations, "tool_*.euler_orientation"),
        )
        what = tuple(pattern for wanted, pattern in pairs if wanted)
    exclusive = name == "random_actor"
    return resample(what, space, exclusive=exclusive) if what else as_part({})
