"""Plans: interventions on several variables, each with its time, as one value."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, final

import numpy as np
from pydantic import TypeAdapter

from scm_world.errors import DAMAGED, InterventionError, ModelError
from scm_world.graph import SCM, flatten
from scm_world.queries.equations import System
from scm_world.queries.timed import ACTS, TIMED, At, Clamp, On, Timed, as_act
from scm_world.variables import (
    Categories,
    Draw,
    Function,
    Hard,
    Intervention,
    Mechanism,
    Natural,
    Scale,
    Shift,
)
from scm_world.variables.mechanisms import check_portable, check_trusted

FORMAT = "scm_world/plan/1"
PACKAGE = "scm_world"

_PARTS: TypeAdapter[dict[str, tuple[Any, ...]]] = TypeAdapter(dict[str, tuple[Timed, ...]])


@final
class Plan(Mapping[str, tuple[Any, ...]]):
    """What is done to which variable, and when. A plan is a value: nothing changes it.

    Later wins: ``do(a).do(b) == do({**a, **b})``. What is given without a time takes place at the
    beginning: of the episode, or at the instant from which a counterfactual continues.

    Args:
        request: By variable, dotted or nested: a value, an intervention, or one with a time
            (``At``, ``Clamp``, ``On``); a tuple or list of timed ones where there are several.

    Raises:
        UnknownOption: Something is no intervention.

    Example:
        >>> plan = Plan({"tool_block": {"mass": 0.05}, "floor_friction": At(10, 0.2)})
        >>> plan.do({"tool_block.mass": 0.08}) == Plan(
        ...     {"tool_block.mass": 0.08, "floor_friction": At(10, 0.2)}
        ... )
        True
        >>> Plan.from_json(plan.to_json()) == plan
        True
    """

    __slots__ = ("_parts",)

    def __init__(self, request: Mapping[str, Any] | None = None) -> None:
        if isinstance(request, Plan):
            self._parts: dict[str, tuple[Any, ...]] = dict(request._parts)
        else:
            flat = flatten({} if request is None else request)
            self._parts = {name: _parts(value) for name, value in flat.items()}

    def __getitem__(self, name: str) -> tuple[Any, ...]:
        return self._parts[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._parts)

    def __len__(self) -> int:
        return len(self._parts)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Plan) and self._parts == other._parts

    def __hash__(self) -> int:
        return hash(frozenset(self._parts))

    def __repr__(self) -> str:
        return f"Plan({self._parts})"

    def __str__(self) -> str:
        if not self._parts:
            return "nothing done"
        acts = (f"{name} = {_short(part)}" for name, parts in self._parts.items() for part in parts)
        return f"do({', '.join(acts)})"

    def do(self, request: Mapping[str, Any]) -> Plan:
        """Give the plan that does this too; where both set a variable, this one counts."""
        both = Plan()
        both._parts = {**self._parts, **Plan(request)._parts}
        return both

    def at_start(self) -> dict[str, Intervention]:
        """Return the interventions at the beginning, by variable."""
        return {
            name: part
            for name, parts in self._parts.items()
            for part in parts
            if isinstance(part, ACTS)
        }

    def at_first(self) -> dict[str, Intervention]:
        """Return the interventions at the first instant, with or without a time, by variable."""
        found = self.at_start()
        for name, part in self.timed():
            if (isinstance(part, At) and part.step == 0) or (
                isinstance(part, Clamp) and part.start == 0
            ):
                found[name] = part.act
        return found

    def timed(self) -> Iterator[tuple[str, Any]]:
        """List the interventions at later instants or on events."""
        for name, parts in self._parts.items():
            yield from ((name, part) for part in parts if isinstance(part, TIMED))

    def acts(self) -> Iterator[tuple[str, Intervention]]:
        """List all interventions, without their times."""
        for name, parts in self._parts.items():
            yield from ((name, part.act if isinstance(part, TIMED) else part) for part in parts)

    # --- files --------------------------------------------------------------------------------

    def as_dict(self) -> dict[str, Any]:
        """Write the plan as plain data.

        Raises:
            ModelError: It has a function that cannot be found again under its name.
        """
        check_portable(self._functions())
        return {"format": FORMAT, "do": _PARTS.dump_python(self._parts, mode="json")}

    def to_json(self) -> str:
        """Write the plan as JSON, without loss; errors as in ``as_dict``."""
        return json.dumps(self.as_dict(), allow_nan=False)

    @classmethod
    def from_dict(cls, data: Any, *, trusted: Sequence[str] = ()) -> Plan:
        """Read a plan that ``as_dict`` wrote.

        Args:
            data: Plain data.
            trusted: Packages other than this one whose functions may serve as mechanisms.

        Raises:
            ModelError: It is no plan, or it names a function outside of the trusted packages.
        """
        if not isinstance(data, dict) or data.get("format") != FORMAT:
            raise ModelError([f"not a plan: expected the format {FORMAT!r}"])
        plan = cls()
        try:
            plan._parts = _PARTS.validate_json(json.dumps(data["do"]))
        except DAMAGED as error:
            raise ModelError([f"not a plan: {error}"]) from None
        check_trusted(plan._functions(), trusted)
        return plan

    @classmethod
    def from_json(cls, text: str, *, trusted: Sequence[str] = ()) -> Plan:
        """Read a plan that ``to_json`` wrote; see ``from_dict``."""
        try:
            data = json.loads(text)
        except DAMAGED as error:
            raise ModelError([f"not a plan: {error}"]) from None
        return cls.from_dict(data, trusted=trusted)

    def _functions(self) -> Iterable[Function]:
        for _, act in self.acts():
            if isinstance(act, Mechanism) and isinstance(act.function, Function):
                yield act.function


def _short(part: Any) -> str:
    """Write an intervention down in few words."""
    match part:
        case Hard(value=value):
            return np.array2string(np.asarray(value), precision=4, separator=", ", threshold=9)
        case At(step=step, act=act):
            return f"{_short(act)} at {step}"
        case Clamp(act=act, start=start, stop=stop):
            return f"{_short(act)} from {start} to {'the end' if stop is None else stop}"
        case Shift(by=by) | Scale(by=by):
            return f"{type(part).__name__}({by})"
        case Draw(source=source):
            return f"Draw({source!r})"
        case Mechanism(parents=parents):
            return f"a function of {', '.join(p.name for p in parents) or 'nothing'}"
    return f"{type(part).__name__}()"


def _parts(value: Any) -> tuple[Any, ...]:
    if isinstance(value, TIMED):
        return (value,)
    several = isinstance(value, list | tuple) and len(value) > 0
    if several and all(isinstance(part, (*TIMED, *ACTS)) for part in value):
        return tuple(value)
    return (as_act(value),)


def do(request: Mapping[str, Any]) -> Plan:
    """Give the plan that does this; see ``Plan``.

    Example:
        >>> do({"floor_friction": 0.3}).do({"floor_friction": 0.4})
        Plan({'floor_friction': (Hard(kind='hard', value=0.4),)})
    """
    return Plan(request)


def numbered(model: SCM, request: Mapping[str, Any]) -> dict[str, Any]:
    """Put the numbers of categories in the place of their labels, under dotted names."""
    found = flatten(request)
    for name, value in found.items():
        bounds = model.declared(name).bounds if isinstance(value, str) and name in model else None
        if isinstance(bounds, Categories) and value in bounds.labels:
            found[name] = int(bounds.numbers(value))
    return found


__all__ = ["At", "Clamp", "On", "Plan", "do"]


# --- which interventions are due when -----------------------------------------------------------

Layer = tuple[int, Plan]
"""The control step from which a plan counts, and the plan."""
Key = tuple[int, str, int]
"""Layer, variable and number of an intervention that waits for an event."""


@final
class Schedule:
    """Plans over one another: from its first step on, a later one counts for what it names.

    Args:
        layers: In the order of their making.

    Raises:
        InterventionError: An intervention is due before its plan begins, or a state is to be
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
            fired: When events happened; those of now are added.
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
class GroupedSchedules:
    """Schedules of groups of episodes that ``Equations`` solve together.

    Args:
        schedules: Of each group.
    """

    def __init__(self, schedules: Iterable[Schedule]) -> None:
        self._schedules = tuple(schedules)

    def due(self, world: System, step: int, fired: dict[Key, int]) -> dict[int, Any]:
        """Return the interventions of each group in which some are due."""
        dues = (schedule.due(world, step, fired) for schedule in self._schedules)
        return {group: due for group, due in enumerate(dues) if due}


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
