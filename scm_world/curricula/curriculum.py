"""Curricula as values, with files."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar, final

from pydantic import BeforeValidator

from scm_world.curricula.parts import AnyPart, Part, Progress, Situation, nested
from scm_world.errors import DAMAGED, ModelError, UnknownOption, UnknownVariable, UnreadableFile
from scm_world.queries.plans import Plan, targets
from scm_world.runs.files import read_text
from scm_world.tasks.rewards import SUCCESS
from scm_world.variables import Function, Noise, Subset
from scm_world.variables.checks import check_subset
from scm_world.variables.mechanisms import check_portable, check_trusted
from scm_world.variables.spaces import Frozen
from scm_world.variables.subsets import as_region
from scm_world.world import Simulation

FORMAT = "scm_world/curriculum/1"

Made = TypeVar("Made", bound=Frozen)


def read_from(kind: type[Made], data: Any, *, form: str, trusted: Sequence[str]) -> Made:
    """Read a value of a class that was written as plain data, with its ``"format"``.

    Raises:
        ModelError: It is something else, or it calls a function outside of the trusted packages.
    """
    what = kind.__name__.lower()
    if not isinstance(data, Mapping) or data.get("format") != form:
        raise ModelError([f"not a {what}: expected the format {form!r}"])
    build: Any = kind
    try:
        made: Made = build(**{k: v for k, v in data.items() if k != "format"})
    except (TypeError, ValueError) as error:
        said = error.problems if isinstance(error, ModelError) else (str(error),)
        raise ModelError([f"not a {what}: {one}" for one in said]) from None
    check_trusted(nested(made, Function), trusted)
    return made


def _subset(space: Any) -> Subset | None:
    found = as_region("space", space)
    return Subset(found) if isinstance(found, str) else found


@final
class Curriculum(Frozen):
    """An intervention curriculum: immutable, hashable and JSON-serialisable.

    It is made of a part, an intervention, a plan, a function of the ``Situation``, plain data, or
    another curriculum.

    Attributes:
        part: The rule that returns the interventions of an episode.
        space: The part of the parameter space in which every intervention has to lie, if any.

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
    space: Annotated[Subset | None, BeforeValidator(_subset)] = None

    def __init__(self, part: Any = None, **fields: Any) -> None:
        if isinstance(part, Mapping) and part.get("format") == FORMAT:
            part = read_from(Curriculum, part, form=FORMAT, trusted=())
        if isinstance(part, Curriculum):
            part, fields = part.part, {"space": part.space, **fields}
        super().__init__(part={} if part is None else part, **fields)

    def as_dict(self) -> dict[str, Any]:
        """Write it as plain data, of which ``Curriculum`` makes it again.

        Raises:
            ModelError: It calls a function that cannot be found again under its name, or has a
                number that is not finite.
        """
        check_portable(nested(self, Function))
        for part in nested(self, Part):
            Plan(getattr(part, "request", None)).as_dict()
        return {"format": FORMAT, **self.model_dump(mode="json")}

    def to_json(self, *, indent: int | None = None) -> str:
        """Write it as JSON; errors as in ``as_dict``."""
        return json.dumps(self.as_dict(), indent=indent, allow_nan=False)

    @classmethod
    def from_json(cls, text: str, *, trusted: Sequence[str] = ()) -> Curriculum:
        """Read what ``to_json`` wrote.

        Args:
            text: The JSON.
            trusted: Packages other than this one whose functions may be called.

        Raises:
            ModelError: It is not a curriculum, or it calls a function outside of those packages.
        """
        try:
            data = json.loads(text)
        except DAMAGED as error:
            raise ModelError([f"not a curriculum: {error}"]) from None
        return read_from(cls, data, form=FORMAT, trusted=trusted)

    @classmethod
    def load(cls, path: Path | str, *, trusted: Sequence[str] = ()) -> Curriculum:
        """Read a file with the JSON of a curriculum; ``UnreadableFile`` if it is something else."""
        try:
            return cls.from_json(read_text(path), trusted=trusted)
        except DAMAGED as error:
            said = "; ".join(getattr(error, "problems", (str(error),)))
            advice = "give a file with the text of Curriculum.to_json()"
            raise UnreadableFile(str(path), said, advice) from None

    def check(self, world: Simulation) -> None:
        """Refuse names that do not exist and regions that are impossible.

        Where variables decide which bodies exist, names are looked up at each reset: they may
        be those of bodies that come.

        Args:
            world: The world whose structure episodes begin with.

        Raises:
            InterventionError: A name or a region does not fit.
            UnknownOption: The task does not say what success is, or has no goals.
        """
        parts = [*nested(self.part, Part)]
        if SUCCESS not in world.model and any(part.kind == "stages" for part in parts):
            allowed = (f"a task with {SUCCESS!r}, as success=(function, 'hinge.position', …)",)
            raise UnknownOption("task for a curriculum with stages", world.task.name, allowed)
        may_come = bool(len(world.structures.head))
        known = [part for part in parts if part.kind in ("do", "resample", "goal", "interpolate")]
        for part, episode in ((part, episode) for part in known for episode in (0, 2**62)):
            try:
                plan = part.plan(Situation(episode, {}, world.compiled, Noise(0), 0))
                for name, act in plan.acts():
                    if name not in world.compiled.entity_names:
                        world.model.accept(name, act)
            except UnknownVariable:
                if not may_come:
                    raise
        if self.space is not None:
            check_subset(self.space, world.model.variables, may_come=may_come)

    def plan(self, situation: Situation, besides: Iterable[str] = ()) -> Plan:
        """Return the interventions of an episode.

        Args:
            situation: The episode that begins.
            besides: Variables that are left as they are, in any coordinates.
        """
        model, first = situation.model, situation.first
        taken = {target for name in besides for target in targets(model, name)}
        return Plan.of(
            {
                name: acts
                for name, acts in self.part.plan(situation).items()
                if taken.isdisjoint(targets(model, name)) and (first is None or name in first)
            }
        )

    def counted(
        self, stages: Mapping[str, Progress], episodes: Iterable[tuple[Iterable[str], bool]]
    ) -> dict[str, Progress]:
        """Return the progress after more episodes.

        Args:
            stages: The progress before.
            episodes: For each the keys of the parts with stages that acted in it, and its success.
        """
        found = dict(stages)
        parts: dict[str, Any] = {part.key: part for part in nested(self.part, Part)}
        for key, success in ((key, success) for staged, success in episodes for key in staged):
            part, (level, recent) = parts[key], found.get(key, Progress())
            recent = (*recent, success)[-part.window :]
            share = sum(recent) / part.window
            is_down = part.down is not None and share <= part.down
            step = 1 if share >= part.up else -1 if is_down else 0
            after = min(max(level + step, 0), len(part.of) - 1)
            is_kept = len(recent) < part.window or after == level
            found[key] = Progress(level, recent) if is_kept else Progress(after)
        return found
