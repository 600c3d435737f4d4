"""Which interventions are due at which control step."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, final

from scm_world.errors import InterventionError
from scm_world.queries.equations import System
from scm_world.queries.plans import Plan
from scm_world.queries.timed import ACTS, At, Clamp, On
from scm_world.variables import Hard, Intervention, Mechanism, Natural

Layer = tuple[int, Plan]
"""The control step from which a plan counts, and the plan."""
Key = tuple[int, str, int]
"""Layer, variable and number of an intervention that waits for an event."""


@final
class Course:
    """Plans over one another: from its first step on, a later one counts for what it names.

    Args:
        layers: In the order of their making.

    Raises:
        InterventionError: Something should happen before its plan begins, or a state is to be
            held at what is no value.
    """

    def __init__(self, layers: Iterable[Layer]) -> None:
        self.layers = tuple((start, plan) for start, plan in layers if len(plan))
        for start, plan in self.layers:
            for name, part in plan.timed():
                step = part.step if isinstance(part, At) else start
                step = part.start if isinstance(part, Clamp) else step
                if step < start:
                    raise InterventionError(
                        f"do({name}): control step {step} is over; the plan begins at {start}",
                        variable=name,
                        value=part,
                    )
        self._is_simple = not any(True for _, plan in self.layers for _ in plan.timed())
        self._starts = frozenset(start for start, _ in self.layers)

    def due(self, world: System, step: int, fired: dict[Key, int]) -> dict[str, Intervention]:
        """Give what is to be done at the beginning of a control step.

        Args:
            world: As it is then; events are looked for in it.
            step: Number of the control step.
            fired: When events happened; those that happen now are added.
        """
        if self._is_simple and step not in self._starts:
            return {}
        found: dict[str, Intervention] = {}
        for number, name, start, parts in self._owners(step, world):
            released = False
            for index, part in enumerate(parts):
                act = _due(part, step, start, name, world, fired, (number, name, index))
                if isinstance(part, Clamp) and isinstance(act, Natural) and step == part.stop:
                    released = True
                elif act is not None:
                    found[name] = act
            if released and name not in found:
                found[name] = _still_held(parts, step)
        return found

    def concerns(self, world: System, step: int, fired: Mapping[Key, int]) -> bool:
        """Tell whether anything may be due at a control step, without a look at the present.

        Args:
            world: In the structure that there is then.
            step: Number of the control step.
            fired: When events happened.
        """
        if self._is_simple or step in self._starts:
            return step in self._starts
        return any(
            _concerns(part, step, start, world, name, fired, (number, name, index))
            for number, (start, plan) in enumerate(self.layers)
            if start <= step
            for name, parts in plan.items()
            for index, part in enumerate(parts)
        )

    def _owners(self, step: int, world: System) -> Iterator[tuple[int, str, int, tuple[Any, ...]]]:
        """List what counts at a step: of each quantity the last plan that names it."""
        last: dict[str, tuple[int, dict[str, None]]] = {}
        for number, (start, plan) in enumerate(self.layers):
            for name in plan if start <= step else ():
                for target in world.model.targets(name) if name in world.model else (name,):
                    if last.get(target, (-1, {}))[0] != number:
                        last[target] = (number, {})
                    last[target][1][name] = None
        owners = dict.fromkeys((number, name) for number, names in last.values() for name in names)
        for number, name in owners:
            start, plan = self.layers[number]
            yield number, name, start, plan[name]


@final
class Courses:
    """Courses of groups of episodes that are run together.

    Args:
        courses: Of each group.
    """

    def __init__(self, courses: Iterable[Course]) -> None:
        self._courses = tuple(courses)

    def due(self, world: System, step: int, fired: dict[Key, int]) -> dict[int, Any]:
        """Give what is to be done in each group where something is."""
        found = ((g, course.due(world, step, fired)) for g, course in enumerate(self._courses))
        return {group: due for group, due in found if due}


def _still_held(parts: tuple[Any, ...], step: int) -> Intervention:
    """Say what holds where a window ends: a window around it, or the variable's own mechanism."""
    for part in parts:
        is_open = isinstance(part, Clamp) and part.start <= step
        if is_open and (part.stop is None or step < part.stop):
            held: Intervention = part.act
            return held
    return Natural()


def _concerns(
    part: Any,
    step: int,
    start: int,
    world: System,
    name: str,
    fired: Mapping[Key, int],
    key: Key,
) -> bool:
    """Tell whether a part may be due at a control step."""
    match part:
        case At():
            return part.step == step
        case Clamp():
            if step < part.start or (part.stop is not None and step > part.stop):
                return False
            is_held = name not in world.model or _is_state(name, world)
            return is_held or step in (part.start, part.stop)
        case On():
            return step > start and fired.get(key, step) == step
    return False


def _due(
    part: Any, step: int, start: int, name: str, world: System, fired: dict[Key, int], key: Key
) -> Intervention | None:
    act: Intervention | None = None
    match part:
        case At():
            act = part.act if part.step == step else None
        case Clamp():
            act = _held(part, step, name, world)
        case On():
            if step > start and key not in fired and part.event.happens(world):
                fired[key] = step
            act = part.act if fired.get(key) == step else None
        case _ if isinstance(part, ACTS):
            act = part if step == start else None
    return act


def _held(part: Clamp, step: int, name: str, world: System) -> Intervention | None:
    """Say what a clamp does: a state is put back at every step, a parameter is set and released."""
    if step < part.start or (part.stop is not None and step > part.stop):
        return None
    if not _is_state(name, world):
        return {part.start: part.act, part.stop: Natural()}.get(step)
    if not isinstance(part.act, Hard | Mechanism):
        raise InterventionError(
            f"do({name}): a state is held at a value or by a Mechanism, not by {part.act!r}",
            variable=name,
            value=part.act,
        )
    return part.act if step != part.stop else None


def _is_state(name: str, world: System) -> bool:
    role: str = world.model.declared(world.model.target(name)).role
    return role == "state"
