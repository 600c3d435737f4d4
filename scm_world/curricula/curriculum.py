"""Curricula as values, with files."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, final

from pydantic import ValidationError

from scm_world.curricula.base import AnyPart, Situation, as_part
from scm_world.curricula.combinations import Stages
from scm_world.errors import (
    DAMAGED,
    ModelError,
    UnknownOption,
    UnknownVariable,
    UnreadableFile,
    blamed,
)
from scm_world.output.reading import read_text
from scm_world.queries.plans import Plan, targets
from scm_world.tasks.rewards import SUCCESS
from scm_world.variables import Subset
from scm_world.variables.checks import check_subset
from scm_world.variables.mechanisms import check_portable, check_trusted
from scm_world.variables.spaces import Frozen, problems_of
from scm_world.world import Simulation

FORMAT = "scm_world/curriculum/1"


Made = TypeVar("Made", bound=Frozen)


def read_from(kind: type[Made], data: Any, *, form: str, trusted: Sequence[str]) -> Made:
    """Read a value that was written down as plain data.

    Args:
        kind: Of the value.
        data: Plain data.
        form: What its ``"format"`` has to be.
        trusted: Packages other than this one whose functions may be called.

    Raises:
        ModelError: It is something else, or it calls a function outside of those packages.
    """
    what = kind.__name__.lower()
    if not isinstance(data, Mapping) or data.get("format") != form:
        raise ModelError([f"not a {what}: expected the format {form!r}"])
    validate: Any = kind
    try:
        made: Made = validate.model_validate({k: v for k, v in data.items() if k != "format"})
    except ValidationError as error:
        raise ModelError([f"not a {what}: {said}" for said in problems_of(error)]) from None
    except (TypeError, ValueError) as error:
        said_ = error.problems if isinstance(error, ModelError) else (str(error),)
        raise ModelError([f"not a {what}: {one}" for one in said_]) from None
    part: Any = getattr(made, "part")  # noqa: B009 # of a curriculum or a protocol
    check_trusted((f for one in part.walk() for f in one.functions()), trusted)
    return made


@final
class Curriculum(Frozen):
    """An intervention curriculum: immutable and JSON-serialisable.

    Attributes:
        part: What is done in which situation.
        space: A part of the parameter space that every intervention has to lie in, if any.

    Example:
        >>> from scm_world.curricula import during, resample, together
        >>> curriculum = Curriculum(
        ...     together(
        ...         resample("goal_block.polar"),
        ...         during(range(1_000, 5_000), resample("*.mass", "B")),
        ...     )
        ... )
        >>> Curriculum.from_json(curriculum.to_json()) == curriculum
        True
    """

    part: AnyPart
    space: Subset | None = None

    def __init__(self, part: Any = None, **fields: Any) -> None:
        given = as_part({} if part is None else part)
        super().__init__(part=given, **fields)

    def as_dict(self) -> dict[str, Any]:
        """Write it as plain data.

        Raises:
            ModelError: It calls a function that cannot be found again under its name.
        """
        check_portable(function for part in self.part.walk() for function in part.functions())
        return {"format": FORMAT, **self.model_dump(mode="json")}

    def to_json(self, *, indent: int | None = None) -> str:
        """Write it as JSON; errors as in ``as_dict``."""
        return json.dumps(self.as_dict(), indent=indent, allow_nan=False)

    @classmethod
    def from_dict(cls, data: Any, *, trusted: Sequence[str] = ()) -> Curriculum:
        """Read what ``as_dict`` wrote.

        Args:
            data: Plain data.
            trusted: Packages other than this one whose functions may be called.

        Raises:
            ModelError: It is no curriculum, or it calls a function outside of those packages.
        """
        return read_from(cls, data, form=FORMAT, trusted=trusted)

    @classmethod
    def from_json(cls, text: str, *, trusted: Sequence[str] = ()) -> Curriculum:
        """Read what ``to_json`` wrote; see ``from_dict``."""
        try:
            data = json.loads(text)
        except DAMAGED as error:
            raise ModelError([f"not a curriculum: {error}"]) from None
        return cls.from_dict(data, trusted=trusted)

    @classmethod
    def load(cls, path: Path | str, *, trusted: Sequence[str] = ()) -> Curriculum:
        """Read a file with the JSON of a curriculum.

        Raises:
            UnreadableFile: There is none, or it is something else.
        """
        advice = "give a file with the text of Curriculum.to_json()"
        try:
            return cls.from_json(read_text(path), trusted=trusted)
        except ModelError as error:
            raise UnreadableFile(str(path), "; ".join(error.problems), advice) from None
        except DAMAGED as error:
            raise UnreadableFile(str(path), str(error), advice) from None

    def check(self, world: Simulation) -> None:
        """Look for names that do not exist and regions that are impossible.

        Where variables decide which bodies there are, names are looked up at each reset: they may
        be those of bodies that are not there yet.

        Args:
            world: Whose episodes begin with the structure that its declaration has.

        Raises:
            InterventionError: With the name.
            UnknownOption: It has stages, and the task does not say what success is.
        """
        has_stages = any(isinstance(part, Stages) for part in self.part.walk())
        if has_stages and SUCCESS not in world.model:
            allowed = (f"a task with {SUCCESS!r}, as success=(function, 'hinge.position', …)",)
            raise UnknownOption("task for a curriculum with stages", world.task.name, allowed)
        may_come = bool(len(world.structures.head))
        for part in self.part.walk():
            try:
                part.check(world.compiled)
            except UnknownVariable:
                if not may_come:
                    raise
        if self.space is not None:
            check_subset(self.space, world.model.variables, may_come=may_come)

    def plan(self, situation: Situation, besides: Iterable[str] = ()) -> Plan:
        """Return what is done in an episode.

        Args:
            situation: The episode that begins.
            besides: Variables that are left as they are, in any coordinates.
        """
        model, first = situation.model, situation.first
        with blamed(f"the curriculum, in episode {situation.episode},"):
            plan = self.part.plan(situation)
        taken = {target for name in besides for target in targets(model, name)}
        return Plan.of(
            {
                name: acts
                for name, acts in plan.items()
                if not (taken and taken.intersection(targets(model, name)))
                and (first is None or name in first)
            }
        )


def as_curriculum(given: Any) -> Curriculum:
    """Take a curriculum, or make one of a part, of plain data, or of an intervention.

    Raises:
        UnknownOption: It is none of these.
        ModelError: The data is none of a curriculum.

    Example:
        >>> as_curriculum({"floor_friction": 0.4}).part.kind
        'do'
    """
    if isinstance(given, Curriculum):
        return given
    if isinstance(given, Mapping) and given.get("format") == FORMAT:
        return Curriculum.from_dict(given)
    return Curriculum(as_part(given))
