"""Curricula as values, and what runs them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, final

from pydantic import ValidationError

from scm_world.curricula.choices import Stages
from scm_world.curricula.parts import Acts, AnyPart, as_part, check_names
from scm_world.curricula.situations import Memory, Situation
from scm_world.errors import ModelError, UnreadableFile
from scm_world.queries.plans import PACKAGE
from scm_world.variables import Subset
from scm_world.variables.checks import check_region
from scm_world.variables.spaces import Frozen
from scm_world.world import World

FORMAT = "scm_world/curriculum/1"


@final
class Curriculum(Frozen):
    """Who intervenes, and when: a value with JSON without loss.

    Attributes:
        part: What is done in which situation.
        space: A part of the parameter space that every intervention is held against, if any.

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
        super().__init__(part=given, **fields)  # type: ignore[call-arg]

    def as_dict(self) -> dict[str, Any]:
        """Write it as plain data.

        Raises:
            ModelError: It calls a function that cannot be found again under its name.
        """
        problems = [
            f"the function {function.reference!r} cannot be found under this name; define it at "
            "the top level of a module"
            for part in self.part.walk()
            for function in part.functions()
            if not function.is_portable()
        ]
        if problems:
            raise ModelError(problems)
        return {"format": FORMAT, **self.model_dump(mode="json")}

    def to_json(self, *, indent: int | None = None) -> str:
        """Write it as JSON; errors as in ``as_dict``."""
        return json.dumps(self.as_dict(), indent=indent, allow_nan=False)

    @classmethod
    def from_dict(cls, data: Any, *, trusted: Sequence[str] = ()) -> Curriculum:
        """Read what ``as_dict`` wrote.

        Args:
            data: Plain data.
            trusted: Packages, besides this one, whose functions may be called.

        Raises:
            ModelError: It is no curriculum, or it names a function outside of those packages.
        """
        if not isinstance(data, Mapping) or data.get("format") != FORMAT:
            raise ModelError([f"not a curriculum: expected the format {FORMAT!r}"])
        try:
            made = cls.model_validate({k: v for k, v in data.items() if k != "format"})
        except (ValidationError, TypeError, ValueError) as error:
            raise ModelError([f"not a curriculum: {error}"]) from None
        problems = [
            f"it calls {function.reference!r}; pass trusted=(…) to read it"
            for part in made.part.walk()
            for function in part.functions()
            if not function.is_defined_in((PACKAGE, *trusted))
        ]
        if problems:
            raise ModelError(problems)
        return made

    @classmethod
    def from_json(cls, text: str, *, trusted: Sequence[str] = ()) -> Curriculum:
        """Read what ``to_json`` wrote; see ``from_dict``."""
        try:
            data = json.loads(text)
        except json.JSONDecodeError as error:
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
            return cls.from_json(Path(path).read_text(encoding="utf-8"), trusted=trusted)
        except (OSError, UnicodeDecodeError, ModelError) as error:
            raise UnreadableFile(str(path), str(error), advice) from None

    def check(self, world: World) -> None:
        """Look for names that do not exist and regions that are impossible.

        Raises:
            InterventionError: With the name.
        """
        check_names(self.part.walk(), world.declaration)
        for pattern, region in () if self.space is None else self.space.parts:
            if region is not None and pattern in world.model:
                check_region(world.model.declared(pattern), region)

    @property
    def steps_matter(self) -> bool:
        """Whether it may act after the reset."""
        return any(part.kind in _IN_EPISODES for part in self.part.walk())


_IN_EPISODES = ("at_step", "every")


class Doable(Protocol):
    """An environment that can be intervened on."""

    world: World

    def do(self, request: Mapping[str, Any], *, space: Any = None) -> Any:
        """Intervene now."""

    def snapshot(self) -> Any:
        """Save this instant."""

    def restore(self, snapshot: Any) -> None:
        """Go back to it."""


@final
class Turn:
    """A curriculum at work: it counts episodes, remembers successes, and intervenes.

    Args:
        curriculum: What is done.
        memory: Where it goes on; at the beginning if None.

    Attributes:
        memory: The state that decides how it goes on.
    """

    def __init__(self, curriculum: Any, memory: Memory | None = None) -> None:
        self.curriculum = as_curriculum(curriculum)
        self.memory = Memory() if memory is None else memory
        self._stages = [p for p in self.curriculum.part.walk() if isinstance(p, Stages)]
        self._waits = self.curriculum.steps_matter

    def begin(self, env: Doable, episode: int | None = None) -> bool:
        """Do what is due at a reset, just after it.

        Args:
            env: At the beginning of an episode.
            episode: Its number; as many as have begun if None.

        Returns:
            Whether anything was done.
        """
        if episode is not None:
            self.memory.episode = episode
        return self._act(env, 0)

    def step(self, env: Doable) -> bool:
        """Do what is due after a control step; tell whether that was anything."""
        return self._waits and self._act(env, env.world.index)

    def ended(self, *, success: bool) -> None:
        """Take an episode into account that has ended, and count it."""
        for part in self._stages:
            part.ended(self.memory, success=success)
        self.memory.episode += 1

    def _act(self, env: Doable, step: int) -> bool:
        """Intervene; first on what decides which bodies there are, for others have their names."""
        acts = self._asked(env.world, step)
        head = env.world.family.head
        first = {name: act for name, act in acts.items() if name in head}
        if not acts:
            return False
        if not first:
            env.do(acts, space=self.curriculum.space)
            return True
        before = env.snapshot()
        env.do(first, space=self.curriculum.space)
        rest = {n: a for n, a in self._asked(env.world, step).items() if n not in first}
        if rest:
            try:
                env.do(rest, space=self.curriculum.space)
            except BaseException:
                env.restore(before)
                raise
        return True

    def _asked(self, world: World, step: int) -> Acts:
        memory = self.memory
        situation = Situation(world, memory.episode, step, memory, due=step == 0)
        return self.curriculum.part.acts(situation)


def as_curriculum(given: Any) -> Curriculum:
    """Take a curriculum, or make one of a part, or of an intervention.

    Example:
        >>> as_curriculum({"floor_friction": 0.4}).part.kind
        'do'
    """
    if isinstance(given, Curriculum):
        return given
    if isinstance(given, Mapping) and given.get("format") == FORMAT:
        return Curriculum.from_dict(given)
    return Curriculum(as_part(given))
