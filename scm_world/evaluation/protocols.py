"""Protocols: which variables are drawn in the episodes of an evaluation, and from where.

Source:
    CausalWorld 1.2, ``benchmark/benchmarks.py``, for P0 to P11 of reaching, pushing, picking,
    pick_and_place and stacking2: names, variables and spaces are the published ones. The published
    patterns name the size of the block; here block and goal share it as ``block.size``. Where the
    predecessor has no protocol (P1 to P4 and P6 to P11 of reaching, P3 of stacking2, and the four
    tasks that build larger shapes), the row follows the same pattern with the variables that play
    the part.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, final

from scm_world._arguments import whole_number
from scm_world._patterns import as_names, fits
from scm_world.curricula import Curriculum, at_step, goals, resample, together
from scm_world.curricula.curriculum import AnyPart, as_curriculum, read_from
from scm_world.curricula.targets import regions
from scm_world.errors import UnknownOption
from scm_world.queries.world import World
from scm_world.tasks import AnySource, Task, make_task, tasks
from scm_world.variables import Distribution, Subset
from scm_world.variables.kinds import SPACES, SpaceName
from scm_world.variables.spaces import Frozen

FORMAT = "scm_world/protocol/1"
LONGEST = 80
"""Letters of a name; it stands in the names of files."""


@final
class Protocol(Frozen):
    """Which variables are drawn in each episode of an evaluation, and from where.

    Attributes:
        name: Name of the protocol.
        varies: Names, patterns or groups of the variables that are drawn; see ``resample``.
        space: Where they are drawn from.
        step: The control step at which that is done; 0 is the reset.
        act: A part of a curriculum, instead of ``varies`` and ``space``.
        repeats: For how many episodes in a row a draw holds; see ``World.reset(draws=…)``. Episode
            i has draw ``i // repeats``. An agent may remember the earlier ones, see ``Agent``.
        doc: In a few words.

    Example:
        >>> heavy = Protocol("heavy", "*.mass", "B")
        >>> heavy.at(100).name, heavy.at(100).step
        ('heavy@100', 100)
        >>> Protocol.from_dict(heavy.as_dict()) == heavy
        True
    """

    name: str
    varies: tuple[str, ...] = ()
    space: SpaceName | Subset | Distribution = "A"
    step: int = 0
    act: AnyPart | None = None
    repeats: int = 1
    doc: str = ""

    def __init__(
        self, name: str, varies: object = (), space: object = "A", **fields: object
    ) -> None:
        named("name of a protocol", name)
        if not isinstance(varies, Iterable):
            names = ("names and patterns of variables",)
            raise UnknownOption(f"varies of protocol {name}", varies, names)
        several = as_names(varies)
        if not (isinstance(space, Frozen | dict) or (isinstance(space, str) and space in SPACES)):
            allowed = (*SPACES, "a Subset", "a distribution")
            raise UnknownOption(f"space of protocol {name}", space, allowed)
        act = fields.pop("act", None)
        if act is not None and several:
            raise UnknownOption(f"varies of protocol {name}", varies, ("nothing, beside act",))
        step = whole_number("step", fields.pop("step", 0), least=0)
        repeats = whole_number("repeats", fields.pop("repeats", 1), least=1)
        given: dict[str, Any] = {"name": name, "varies": several, "space": space, "step": step}
        given["repeats"] = repeats
        if act is not None:
            given["act"] = as_curriculum(act)
        super().__init__(**given, **fields)

    def curriculum(self) -> Curriculum:
        """Return it as a curriculum, for an environment."""
        if self.act is not None:
            return self.act if self.step == 0 else at_step(self.step, self.act)
        drawn = resample(self.varies, space=self.space) if self.varies else as_curriculum(None)
        return at_step(self.step, drawn)

    def at(self, step: int) -> Protocol:
        """Return the protocol that does the same within the episodes, after so many steps."""
        step = whole_number("step", step, least=0)
        return self.model_copy(update={"name": f"{self.name}@{step}", "step": step})

    def as_dict(self) -> dict[str, Any]:
        """Write it as plain data.

        Raises:
            ModelError: It calls a function that cannot be found again under its name.
        """
        self.curriculum().as_dict()  # it checks the functions
        once = {"repeats"} if self.repeats == 1 else None
        return {"format": FORMAT, **self.model_dump(mode="json", exclude=once)}

    @classmethod
    def from_dict(cls, data: object, *, trusted: Sequence[str] = ()) -> Protocol:
        """Read the data of ``as_dict``.

        Raises:
            ModelError: It is not a protocol, or calls a function outside of the trusted packages.
        """
        return read_from(cls, data, form=FORMAT, trusted=trusted)


def named(what: str, name: object) -> str:
    """Check that something can stand in tables, in lists with commas, and in the names of files."""
    text = name if isinstance(name, str) and name.isprintable() else ""
    if not 0 < len(text) <= LONGEST or text.strip() != text or {*text} & {*"/\\,"}:
        allowed = f"a word or several, up to {LONGEST} letters, without slashes and commas"
        raise UnknownOption(what, name, (allowed,))
    return str(text)


def chosen(given: object, known: Sequence[Protocol]) -> tuple[Protocol, ...]:
    """Return those of the known protocols that are meant, all if None; see ``evaluate``."""
    if given is None:
        return tuple(known)
    if isinstance(given, str):
        given = [word.strip() for word in given.split(",")]
    if not isinstance(given, Iterable):
        raise UnknownOption("protocols", given, [protocol.name for protocol in known])
    listed = [given] if isinstance(given, Protocol) else list(given)
    found = [protocol for one in listed for protocol in _meant(one, known)]
    names = [protocol.name for protocol in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise UnknownOption("protocols", ",".join(names), (f"{twice[0]!r} once",))
    if not found:
        raise UnknownOption("protocols", given, [protocol.name for protocol in known])
    return tuple(found)


def _meant(given: object, known: Sequence[Protocol]) -> Iterable[Protocol]:
    if isinstance(given, Protocol):
        return [given]
    names = [protocol.name for protocol in known]
    if not isinstance(given, str):
        raise UnknownOption("protocol", given, (*names, "a Protocol"))
    name, at, step = given.partition("@")
    found = [protocol for protocol in known if fits(protocol.name, (name,))]
    if not found:
        raise UnknownOption("protocol", given, names)
    if not at:
        return found
    if not (step.isascii() and step.isdecimal()):
        raise UnknownOption("control step of a protocol", given, (f"{name}@100",))
    return [protocol.at(int(step)) for protocol in found]


FRICTION = "floor_friction"


WORDS = {"mass": "mass", "size": "size", "tool": "start", "goal": "goal", "friction": "friction"}
"""Words for the parts."""

REACHED = {"mass": "masses of the fingers", "size": "obstacles", "tool": "joints"}
"""Other words for those of reaching."""

_BLOCK = {
    "mass": "tool_block.mass",
    "size": "block.size",
    "tool": "tool_block.cylindrical_position",
    "goal": "goal_block.cylindrical_position",
}
_WALL = {
    "mass": "blocks_mass",
    "size": "blocks_min_size",
    "tool": "tool_level_0_num_0.cylindrical_position",
}

ROLES: Mapping[str, Mapping[str, str]] = {
    "reaching": {
        "mass": "robot_finger_*.mass",
        "size": "number_of_obstacles",
        "tool": "joint_positions",
        "goal": "goal_*.cylindrical_position",
    },
    "pushing": _BLOCK,
    "picking": _BLOCK,
    "pick_and_place": _BLOCK,
    "stacking2": {
        "mass": "tool_block_*.mass",
        "size": "block.size",
        "tool": "tool_block_*.cylindrical_position",
        "goal": "goal_tower.cylindrical_position",
    },
    "towers": {
        "mass": "blocks_mass",
        "size": "tower_dims",
        "tool": "tool_*.cylindrical_position",
        "goal": "tower_center",
    },
    "stacked_blocks": _WALL,
    "creative_stacked_blocks": _WALL,
    "general": {
        "mass": "blocks_mass",
        "size": "tool_block_size",
        "tool": "tool_*.cylindrical_position",
    },
}
"""Of each task, which variables play which part: the mass of the moved bodies, how large they are,
where they begin, and where they should be. Without a goal, the goals are a shape that the task
draws; its causes ``mass``, ``size`` and ``KEPT`` are not varied with it."""

KEPT = {"general": ("nums_objects",)}

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
"""Name, varied parts, and the space."""

REACHING: tuple[str, str, SpaceName] = ("P12", "goal", "B")
"""Reaching has one more."""


def protocols_of(task: AnySource, backend: str | None = None) -> tuple[Protocol, ...]:
    """Return the protocols of a task.

    The tasks of this package have those of the table. P10 and P11 draw everything that the
    predecessor draws, the joints excepted; a fair coin decides in each episode whether sizes or
    positions are drawn, as published. Any other task, whether it is registered or named by a file
    or a function, has those that follow from its spaces: see ``general``.

    Args:
        task: A task or its source; see ``make_task``.
        backend: As in ``general``.

    Raises:
        UnknownOption: The task is unknown.

    Example:
        >>> [(p.name, p.space) for p in protocols_of("pushing")[1:3]]
        [('P1', 'A'), ('P2', 'B')]
    """
    made = make_task(task)
    if made.name in ROLES and isinstance(made, tasks()[made.name]):
        rows = (*ROWS, REACHING) if made.name == "reaching" else ROWS
        return tuple(_protocol(made.name, *row) for row in rows)
    return general(made, backend)


def general(task: Task, backend: str | None = None) -> tuple[Protocol, ...]:
    """Return the protocols that follow from the spaces of any task.

    In ``P0`` nothing varies. In ``A`` every variable with a space A is drawn from it, and in
    ``A:pole.mass`` only the mass of the pole; likewise ``B``. Where variables decide which bodies
    exist, there is only P0: the others would change the observations of a policy.

    Args:
        task: The task.
        backend: Whose parameters count; that of the task if None.
    """
    world = World(task, backend=backend)
    declaration = world.compiled
    found = [Protocol("P0", doc="nothing varies")]
    spaces: tuple[SpaceName, ...] = () if len(world.structures.head) else ("A", "B")
    for space in spaces:
        names = regions(declaration, ["@everything"], space)
        if names:
            doc = f"everything that has a space {space}"
            found.append(Protocol(space, tuple(names), space, doc=doc))
        for name in names:  # the protocol's name can stand in the name of a file
            plain = "".join("_" if letter in "/\\," else letter for letter in name)
            found.append(Protocol(f"{space}:{plain}"[:LONGEST], name, space, doc=name))
    return tuple(found)


def _protocol(task: str, name: str, what: str, space: SpaceName) -> Protocol:
    words = what.split()
    if not words:
        return Protocol(name, space=space, doc="the default task")
    if words == ["all"]:
        act = resample("@published", space, exclusive=True)
        return Protocol(name, space=space, act=act, doc=f"everything from {space}")
    roles, called = ROLES[task], {**WORDS, **(REACHED if task == "reaching" else {})}
    doc = f"{', '.join(called[word] for word in words)} from {space}"
    others = [FRICTION if w == "friction" else roles[w] for w in words if w in {*roles, "friction"}]
    if len(others) == len(words):
        return Protocol(name, others, space, doc=doc)
    kept = (roles["mass"], roles["size"], *KEPT.get(task, ()))
    shape = goals(space, besides=kept)
    act_: Curriculum = together(shape, resample(others, space)) if others else shape
    return Protocol(name, space=space, act=act_, doc=doc)
