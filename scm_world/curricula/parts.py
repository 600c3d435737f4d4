"""Parts of curricula that draw."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, final
from weakref import WeakKeyDictionary

from scm_world.curricula.base import Acts, AnyPart, Do, Part, as_part, words
from scm_world.curricula.situations import STREAM, Situation
from scm_world.curricula.targets import matching
from scm_world.errors import InterventionError, UnknownOption, UnknownVariable
from scm_world.variables import Box, Cylinder, Distribution, Draw, Normal, Subset, Variable
from scm_world.variables.checks import check_draw, check_region
from scm_world.variables.kinds import SPACES, SpaceName
from scm_world.variables.spaces import Frozen
from scm_world.variables.subsets import refuse_infinite
from scm_world.world.compiled_task import CompiledTask

__all__ = ["Acts", "AnyPart", "Do", "Goal", "Part", "Resample", "as_part"]


@final
class Resample(Part):
    """Draw variables anew.

    Attributes:
        what: Names of variables, patterns, or groups such as ``@goals``.
        space: Where they are drawn from: a declared space, a distribution, or a part of the
            parameter space, which may have another region for each of them.
        besides: Patterns of what is left as it is.
        exclusive: Whether a fair coin decides if sizes or positions of blocks are drawn, as the
            predecessor has it, instead of both.

    Raises:
        UnknownOption: A name is no word, or there is no such space.

    Example:
        >>> Resample("*.mass", space="B").what
        ('*.mass',)
    """

    kind: Literal["resample"] = "resample"
    what: tuple[str, ...]
    space: SpaceName | Subset | Distribution = "A"
    besides: tuple[str, ...] = ()
    exclusive: bool = False

    def __init__(self, what: Any, **fields: Any) -> None:
        fields["besides"] = words("besides", fields.get("besides", ()))
        space = fields.get("space", "A")
        if not (isinstance(space, Frozen | dict) or space in SPACES):
            raise UnknownOption("space", space, (*SPACES, "a Subset", "a distribution"))
        refuse_infinite("space", space)
        super().__init__(what=words("what", what), **fields)  # type: ignore[call-arg]

    def acts(self, situation: Situation) -> Acts:
        """Draw, where it is due."""
        if not situation.due:
            return {}
        drawn = self._draws(situation.compiled, situation.first)
        if self.exclusive:
            without = _SIZES if situation.uniform(self.key) < 0.5 else _POSITIONS
            return {name: act for name, act in drawn.items() if not name.endswith(without)}
        return dict(drawn)

    def _draws(self, declaration: CompiledTask, first: frozenset[str] | None) -> Acts:
        """Give the draws, which are the same whenever a structure comes again."""
        kept = _DRAWS.setdefault(declaration, {})
        word = (self.key, first is None)
        if word not in kept:
            stream = f"{STREAM}/{self.key}"
            targets = self.targets(declaration, first).items()
            kept[word] = {name: Draw(region, stream=stream) for name, region in targets}
        return kept[word]

    def names(self) -> Iterator[str]:
        """List what it sets."""
        yield from self.what

    def declared(self, declaration: CompiledTask) -> None:
        """Look for names that do not exist and regions that are impossible."""
        self.targets(declaration)

    def targets(
        self, declaration: CompiledTask, among: frozenset[str] | None = None
    ) -> dict[str, SpaceName | Distribution]:
        """Name the variables, each with the region that it is drawn from.

        A variable that a pattern names has to have the region; of a group, those are left out
        that have none.

        Args:
            declaration: Of the structure.
            among: Look for these only, and do without patterns that name none; for all if None.

        Raises:
            UnknownVariable: A pattern names nothing.
            InterventionError: A variable does not have the space, or the region is impossible.
        """
        left_out = set(self._matching(declaration, self.besides, among))
        found: dict[str, SpaceName | Distribution] = {}
        for pattern in self.what:
            for name in self._matching(declaration, (pattern,), among):
                variable = declaration.model.declared(name)
                region = self._region(name)
                missing = isinstance(region, str) and variable.space(region) is None
                if name in left_out or region is None or (missing and pattern.startswith("@")):
                    continue
                _check(variable, region)
                found[name] = region
        return found

    def _matching(
        self, declaration: CompiledTask, patterns: tuple[str, ...], among: frozenset[str] | None
    ) -> tuple[str, ...]:
        if among is None:
            return matching(declaration, patterns)
        found: list[str] = []
        for pattern in patterns:
            try:
                found += matching(declaration, (pattern,))
            except UnknownVariable:  # perhaps it names what is there afterwards
                continue
        return tuple(name for name in found if name in among)

    def _region(self, name: str) -> SpaceName | Distribution | None:
        return self.space.region(name) if isinstance(self.space, Subset) else self.space


_SIZES = (".size", "block_size", "_dims")
_POSITIONS = (".cylindrical_position",)
_DRAWS: WeakKeyDictionary[CompiledTask, dict[tuple[str, bool], Acts]] = WeakKeyDictionary()


def _check(variable: Variable, region: SpaceName | Distribution) -> None:
    """Refuse a region in which a variable cannot lie."""
    if variable.dtype != "real" and isinstance(region, Box | Cylinder | Normal):
        raise InterventionError(
            f"{variable.name!r} is a whole number, and {region!r} has others; draw it from "
            "Integers(low, high), Categories([…]) or a declared space",
            variable=variable.name,
            value=region,
        )
    if isinstance(region, Normal | Cylinder):
        check_draw(variable, Draw(region))
    else:
        check_region(variable, region)


@final
class Goal(Part):
    """Draw a new goal, as the task draws goals.

    Attributes:
        space: Where from.
        besides: Causes of the goal that are left as they are.

    Raises:
        UnknownOption: There is no such space.
    """

    kind: Literal["goal"] = "goal"
    space: SpaceName = "A"
    besides: tuple[str, ...] = ()

    def __init__(self, space: Any = "A", **fields: Any) -> None:
        if space not in SPACES:
            raise UnknownOption("space", space, SPACES)
        fields["besides"] = words("besides", fields.get("besides", ()))
        super().__init__(space=space, **fields)  # type: ignore[call-arg]

    def acts(self, situation: Situation) -> Acts:
        """Draw, where it is due."""
        if not situation.due:
            return {}
        stream = f"{STREAM}/{self.key}"
        drawn = situation.compiled.task.sample_goal(self.space)
        return {
            name: act.model_copy(update={"stream": stream}) if isinstance(act, Draw) else act
            for name, act in drawn.items()
            if name not in self.besides
        }

    def names(self) -> Iterator[str]:
        """List what it sets."""
        yield "@goals"

    def declared(self, declaration: CompiledTask) -> None:
        """Look for causes that the goal does not have."""
        causes = declaration.task.sample_goal(self.space)
        for name in self.besides:
            if name not in causes:
                raise UnknownVariable(name, causes)
