"""Curricula as values, with files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any, final

from scm_world.curricula.base import AnyPart, as_part, read_from
from scm_world.curricula.combinations import AtStep, Every, Stages
from scm_world.errors import DAMAGED, ModelError, UnknownOption, UnknownVariable, UnreadableFile
from scm_world.output.reading import read_text
from scm_world.tasks.rewards import SUCCESS
from scm_world.variables import Subset
from scm_world.variables.checks import check_subset
from scm_world.variables.mechanisms import check_portable
from scm_world.variables.spaces import Frozen
from scm_world.world import Simulation

FORMAT = "scm_world/curriculum/1"


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

        Where it decides which bodies there are, names are looked up when it acts: they may be
        those of bodies that are not there yet.

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
        may_come = self._may_restructure(world)
        for part in self.part.walk():
            try:
                part.declared(world.compiled)
            except UnknownVariable:
                if not may_come:
                    raise
        if self.space is not None:
            check_subset(self.space, world.model.variables, may_come=may_come)

    def _may_restructure(self, world: Simulation) -> bool:
        head = tuple(world.structures.head)
        goals = world.task.goal.causes
        return any(
            any(fnmatchcase(name, pattern) for name in head)
            or pattern in ("@everything", "@published")
            or (pattern == "@goals" and not set(head).isdisjoint(goals))
            for part in self.part.walk()
            for pattern in part.names()
        )

    @cached_property
    def _times(self) -> tuple[frozenset[int], tuple[tuple[int, int], ...]]:
        """When parts act: at these steps, and from the one step on every so many."""
        timed = [p for p in self.part.walk() if isinstance(p, AtStep | Every)]
        steps = frozenset(p.step for p in timed if isinstance(p, AtStep))
        return steps, tuple({(p.first, p.steps) for p in timed if isinstance(p, Every)})

    def may_act(self, step: int) -> bool:
        """Tell whether anything may be due after so many control steps, in some episode."""
        steps, series = self._times
        return (
            step == 0
            or step in steps
            or any(step >= first and (step - first) % period == 0 for first, period in series)
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
