"""The protocols P0 to P11 of the robot's tasks, as rows of a table; and those of any other task.

Source:
    CausalWorld 1.2, ``benchmark/benchmarks.py``, for reaching, pushing, picking, pick_and_place
    and stacking2: names, variables and spaces are the published ones. The published patterns name
    the size of the block; here block and goal share it as ``block.size``. Where the predecessor
    has no protocol (P1 to P4 and P6 to P11 of reaching, P3 of stacking2, and the four tasks that
    build larger shapes), the row follows the same pattern with the variables that play the part.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import final

from scm_world.curricula import together
from scm_world.curricula.parts import Goal, Part, Resample
from scm_world.evaluation.protocols import LONGEST, Protocol
from scm_world.tasks import Task, tasks
from scm_world.variables.kinds import SpaceName
from scm_world.world import World
from scm_world.world.structures import as_task

FRICTION = "floor_friction"


@final
@dataclass(frozen=True)
class Roles:
    """Which variables of a task play which part.

    Attributes:
        mass: What is moved, how heavy it is.
        size: How large it is.
        tool: Where it begins.
        goal: Where it should be. None: the goals are a shape that the task draws.
        kept: Causes of the shape that are not varied with it.
        words: What the parts are called, where that is not what they are mostly called.
    """

    mass: str
    size: str
    tool: str
    goal: str | None
    kept: tuple[str, ...] = ()
    words: Mapping[str, str] = field(default_factory=dict)


WORDS = {"mass": "mass", "size": "size", "tool": "start", "goal": "goal", "friction": "friction"}
"""What the parts are mostly called."""

_WALL = Roles(
    "blocks_mass",
    "blocks_min_size",
    "tool_level_0_num_0.cylindrical_position",
    None,
    ("blocks_mass", "blocks_min_size"),
)
_BLOCK = Roles(
    "tool_block.mass",
    "block.size",
    "tool_block.cylindrical_position",
    "goal_block.cylindrical_position",
)

ROLES: Mapping[str, Roles] = {
    "reaching": Roles(
        "robot_finger_*.mass",
        "number_of_obstacles",
        "joint_positions",
        "goal_*.cylindrical_position",
        words={"mass": "masses of the fingers", "size": "obstacles", "tool": "joints"},
    ),
    "pushing": _BLOCK,
    "picking": _BLOCK,
    "pick_and_place": _BLOCK,
    "stacking2": Roles(
        "tool_block_*.mass",
        "block.size",
        "tool_block_*.cylindrical_position",
        "goal_tower.cylindrical_position",
    ),
    "towers": Roles("blocks_mass", "tower_dims", "tool_*.cylindrical_position", "tower_center"),
    "stacked_blocks": _WALL,
    "creative_stacked_blocks": _WALL,
    "general": Roles(
        "blocks_mass",
        "tool_block_size",
        "tool_*.cylindrical_position",
        None,
        ("blocks_mass", "tool_block_size", "nums_objects"),
    ),
}
"""Of each task."""

ROWS: tuple[tuple[str, str, SpaceName], ...] = (
    ("P0", "", "A|B"),
    ("P1", "mass", "A"),
    ("P2", "mass", "B"),
    ("P3", "size", "A"),
    ("P4", "tool", "A"),
    ("P5", "goal", "A"),
    ("P6", "goal tool", "B"),
    ("P7", "goal tool mass", "A"),
    ("P8", "goal tool mass", "B"),
    ("P9", "goal tool mass friction", "B"),
    ("P10", "all", "A"),
    ("P11", "all", "B"),
)
"""Name, what varies, and the space."""

REACHING: tuple[str, str, SpaceName] = ("P12", "goal", "B")
"""Reaching has one more."""


def protocols_of(task: Task | str, backend: str | None = None) -> tuple[Protocol, ...]:
    """Give the protocols of a task.

    The tasks of this package have those of the table. P10 and P11 draw everything that the
    predecessor draws, the joints excepted; a fair coin decides in each episode whether sizes or
    positions are drawn, as published. A task registered by a user has P0 alone. Any other task, of
    a model or of a step function, has those that follow from its spaces: see ``general``.

    Args:
        task: Name of a registered task, a file or function that names one, or a task.
        backend: As in ``general``.

    Raises:
        UnknownOption: There is no such task.

    Example:
        >>> [(p.name, p.space) for p in protocols_of("pushing")[1:3]]
        [('P1', 'A'), ('P2', 'B')]
    """
    name = task.name if isinstance(task, Task) else task
    if name in tasks() and isinstance(task, str | tasks()[name]):
        if name not in ROLES:
            return (_protocol(_BLOCK, *ROWS[0]),)  # nothing varies in it
        rows = (*ROWS, REACHING) if name == "reaching" else ROWS
        return tuple(_protocol(ROLES[name], *row) for row in rows)
    return general(as_task(task), backend)


def general(task: Task, backend: str | None = None) -> tuple[Protocol, ...]:
    """Give the protocols that follow from the spaces of any task.

    In ``P0`` nothing varies. In ``A`` every variable with a space A is drawn from it, and in
    ``A:pole.mass`` only that one; likewise ``B``.

    Args:
        task: Of a model or a step function.
        backend: Whose parameters count; that of the task if None.
    """
    declaration = World(task, backend=backend).compiled
    found = [Protocol("P0", doc="nothing varies")]
    spaces: tuple[SpaceName, ...] = ("A", "B")
    for space in spaces:
        names = Resample("@everything", space=space).targets(declaration)
        if names:
            doc = f"everything that has a space {space}"
            found.append(Protocol(space, tuple(names), space, doc=doc))
        found += [Protocol(_label(space, name), name, space, doc=name) for name in names]
    return tuple(found)


def _label(space: str, name: str) -> str:
    """Name the protocol that draws one variable, as it can stand in the name of a file."""
    plain = "".join("_" if letter in "/\\," else letter for letter in name)
    return f"{space}:{plain}"[:LONGEST]


def _protocol(roles: Roles, name: str, what: str, space: SpaceName) -> Protocol:
    words = what.split()
    if not words:
        return Protocol(name, space=space, doc="the default task")
    if words == ["all"]:
        act = Resample("@published", space=space, exclusive=True)
        return Protocol(name, space=space, act=act, doc=f"everything from {space}")
    called = {**WORDS, **roles.words}
    doc = f"{', '.join(called[word] for word in words)} from {space}"
    named = [FRICTION if w == "friction" else getattr(roles, w) for w in words]
    if None not in named:
        return Protocol(name, named, space, doc=doc)
    shape = Goal(space=space, besides=roles.kept)
    others = [pattern for pattern in named if pattern is not None]
    act_: Part = together(shape, Resample(others, space=space)) if others else shape
    return Protocol(name, space=space, act=act_, doc=doc)
