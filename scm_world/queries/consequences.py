"""What an intervention changes: a system with it, and the same system without it."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict, dataclass
from typing import Any, final

from scm_world._arguments import one_of, whole_number
from scm_world._types import Value
from scm_world.errors import UnknownOption
from scm_world.queries.experiments.effects import gap
from scm_world.queries.questions import SCM, Questions
from scm_world.queries.world import World
from scm_world.variables.kinds import SPACES, SpaceName


@final
@dataclass(frozen=True)
class Consequence:
    """What became of a variable.

    Attributes:
        unit: Of the variable.
        descendant: Whether it is a descendant of a target.
        moved: Whether it differs from before, or from what it would have been.
        before: Its value before the intervention.
        right_after: Right after it.
        after: At the end.
        without: At the end, without the intervention.
        difference: Largest difference of a component between these two; of categories 0 or 1.
    """

    unit: str
    descendant: bool
    moved: bool
    before: Value
    right_after: Value
    after: Value
    without: Value
    difference: float


@final
@dataclass(frozen=True)
class Consequences:
    """What an intervention changed.

    Attributes:
        audit: What was done.
        steps: Control steps since then.
        variables: All that are there with and without it, but for targets without descendants.
        scenes: Of a world: at the beginning and at the end, with the intervention.
        engine: Version of the physics engine; empty without one.
    """

    audit: Any
    steps: int
    variables: Mapping[str, Consequence]
    scenes: tuple[Any, ...]
    engine: str

    @property
    def astray(self) -> tuple[str, ...]:
        """Variables that moved and are no descendants of a target: the graph is wrong."""
        return tuple(n for n, one in self.variables.items() if one.moved and not one.descendant)

    def as_dict(self) -> dict[str, Any]:
        """Return all but the scenes by name; values stay arrays."""

        def changes(pairs: Mapping[str, tuple[Value, Value]]) -> dict[str, Any]:
            return {name: {"before": old, "after": new} for name, (old, new) in pairs.items()}

        audit = self.audit
        return {
            "steps": self.steps,
            "audit": {
                name: {part: getattr(one, part) for part in ("requested", "applied", "read_back")}
                for name, one in audit.targets.items()
            },
            "followed": changes(audit.followed),
            "engine": changes(audit.engine),
            "came": audit.came,
            "went": audit.went,
            "variables": {name: asdict(one) for name, one in self.variables.items()},
            "moved_without_a_path": list(self.astray),
        }


def consequences(
    system: World | SCM,
    request: Mapping[str, Any],
    *,
    steps: int = 25,
    seed: int = 0,
    space: SpaceName | None = None,
) -> Consequences:
    """Intervene at the start of an episode, and compare it with the same one without that.

    The idle action is taken in both; noise is the same. The system itself is left alone.

    Args:
        system: A world, or equations.
        request: The intervention.
        steps: Control steps afterwards; none where nothing depends on time.
        seed: Of the noise.
        space: Of a world: in which all values must lie.

    Raises:
        UnknownOption: There is no such space.
        InterventionError: The intervention is refused.

    Example:
        >>> found = consequences(World("pushing", backend="fake"), {"tool_block.mass": 0.05})
        >>> found.astray, found.variables["tool_block.linear_velocity"].descendant
        ((), True)
    """
    one_of("space", space, (None, *SPACES))
    if not isinstance(system, Questions):
        raise UnknownOption("system", system, ("a World", "an SCM"))
    given: Any = system
    steps = whole_number("steps", steps, least=0) if given.graph.is_temporal else 0
    with closing(given.live(seed=seed)) as plain, closing(plain.split()) as other:
        world, before = other.world, plain.world.values()
        is_world = isinstance(given, World)
        scenes = [world.scene()] if is_world else []
        audit = world.do(request, **({"space": space} if is_world else {}))
        right_after, model = world.values(), plain.world.model
        for _ in range(steps):
            other.step(plain.step())
        after, without = world.values(), plain.world.values()
        scenes += [world.scene()] if is_world else []
        engine = world.engine if is_world else ""
    targets = {model.target(name) for name in audit.targets}
    follow = {
        name
        for one in (model, world.model)  # the intervention may change which bodies there are
        for target in targets & {*one}
        for name in one.descendants(target)
    }
    rows: dict[str, Consequence] = {}
    for name in model:
        if any(name not in found for found in (right_after, after)):
            continue
        if name in targets and name not in follow:
            continue
        difference = gap(after[name], without[name])
        moved = difference > 0.0 or gap(right_after[name], before[name]) > 0.0
        variable = model.declared(name)
        if variable.dtype == "categorical":
            difference = float(difference > 0.0)
        values = before[name], right_after[name], after[name], without[name]
        rows[name] = Consequence(variable.unit, name in follow, moved, *values, difference)
    return Consequences(audit, steps, rows, tuple(scenes), engine)
