"""Protocols: what varies in the episodes of an evaluation, and where it is drawn from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from typing import Any, final

from scm_world._arguments import whole_number
from scm_world.curricula import Curriculum, as_curriculum, at_step
from scm_world.curricula.base import read_from, words
from scm_world.curricula.parts import AnyPart, Part, Resample, as_part
from scm_world.errors import UnknownOption
from scm_world.variables import Distribution, Subset
from scm_world.variables.kinds import SPACES, SpaceName
from scm_world.variables.spaces import Frozen

FORMAT = "scm_world/protocol/1"
LONGEST = 80
"""Letters of a name; it stands in the names of files."""


@final
class Protocol(Frozen):
    """What is done in each episode of an evaluation.

    Attributes:
        name: Of the protocol.
        varies: Names, patterns or groups of the variables that are drawn; see ``resample``.
        space: Where they are drawn from.
        step: The control step at which that is done; 0 is the reset.
        act: What is done instead, for a protocol that says more than that: a part of a curriculum.
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
    doc: str = ""

    def __init__(self, name: str, varies: Any = (), space: Any = "A", **fields: Any) -> None:
        named("name of a protocol", name)
        if not isinstance(varies, Iterable):
            names = ("names and patterns of variables",)
            raise UnknownOption(f"varies of protocol {name}", varies, names)
        several = words(f"varies of protocol {name}", varies)
        if not (isinstance(space, Frozen | dict) or (isinstance(space, str) and space in SPACES)):
            allowed = (*SPACES, "a Subset", "a distribution")
            raise UnknownOption(f"space of protocol {name}", space, allowed)
        act = fields.pop("act", None)
        if act is not None and several:
            raise UnknownOption(f"varies of protocol {name}", varies, ("nothing, beside act",))
        step = whole_number("step", fields.pop("step", 0), least=0)
        given: dict[str, Any] = {"name": name, "varies": several, "space": space, "step": step}
        if act is not None:
            given["act"] = as_part(act)
        super().__init__(**given, **fields)

    @property
    def part(self) -> Part:
        """What is done, as a part of a curriculum."""
        if self.act is not None:
            return self.act if self.step == 0 else at_step(self.step, self.act)
        drawn = Resample(self.varies, space=self.space) if self.varies else as_part({})
        return at_step(self.step, drawn)

    def curriculum(self) -> Curriculum:
        """Give it as a curriculum, for an environment."""
        return as_curriculum(self.part)

    def at(self, step: int) -> Protocol:
        """Give the protocol that does the same within the episodes, after so many steps."""
        step = whole_number("step", step, least=0)
        return self.model_copy(update={"name": f"{self.name}@{step}", "step": step})

    def as_dict(self) -> dict[str, Any]:
        """Write it as plain data.

        Raises:
            ModelError: It calls a function that cannot be found again under its name.
        """
        self.curriculum().as_dict()  # it checks the functions
        return {"format": FORMAT, **self.model_dump(mode="json")}

    @classmethod
    def from_dict(cls, data: Any, *, trusted: Sequence[str] = ()) -> Protocol:
        """Read what ``as_dict`` wrote.

        Raises:
            ModelError: It is none, or it calls a function outside of the trusted packages.
        """
        return read_from(cls, data, form=FORMAT, trusted=trusted)


def named(what: str, name: Any) -> str:
    """Check that something can stand in tables, in lists with commas, and in the names of files.

    Raises:
        UnknownOption: It cannot.
    """
    is_word = isinstance(name, str) and name.isprintable() and name.strip() == name != ""
    if not is_word or len(name) > LONGEST or any(letter in name for letter in "/\\,"):
        allowed = f"a word or several, up to {LONGEST} letters, without slashes and commas"
        raise UnknownOption(what, name, (allowed,))
    return str(name)


def chosen(given: Any, known: Sequence[Protocol]) -> tuple[Protocol, ...]:
    """Read which protocols are meant.

    Args:
        given: None for all; a protocol, a name, a pattern, or several, in a list or with commas
            between them. ``P2@100`` is P2 within the episodes, after 100 control steps.
        known: Those of the task.

    Raises:
        UnknownOption: There is none of a name, or two have one name.

    Example:
        >>> known = [Protocol("P0"), Protocol("P1", "*.mass")]
        >>> [protocol.name for protocol in chosen("P1,P1@50", known)]
        ['P1', 'P1@50']
    """
    if given is None:
        return tuple(known)
    if isinstance(given, str):
        given = [word.strip() for word in given.split(",")]
    listed = [given] if isinstance(given, Protocol) else list(given)
    found = [protocol for one in listed for protocol in _meant(one, known)]
    names = [protocol.name for protocol in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise UnknownOption("protocols", ",".join(names), (f"{twice[0]!r} once",))
    if not found:
        raise UnknownOption("protocols", given, [protocol.name for protocol in known])
    return tuple(found)


def _meant(given: Any, known: Sequence[Protocol]) -> Iterable[Protocol]:
    if isinstance(given, Protocol):
        return [given]
    names = [protocol.name for protocol in known]
    if not isinstance(given, str):
        raise UnknownOption("protocol", given, (*names, "a Protocol"))
    name, at, step = given.partition("@")
    found = [protocol for protocol in known if fnmatchcase(protocol.name, name)]
    if not found:
        raise UnknownOption("protocol", given, names)
    if not at:
        return found
    if not (step.isascii() and step.isdecimal()):
        raise UnknownOption("control step of a protocol", given, (f"{name}@100",))
    return [protocol.at(int(step)) for protocol in found]
