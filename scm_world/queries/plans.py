"""Plans: interventions on several variables, each with its time, as one value."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, final

import numpy as np
from pydantic import TypeAdapter

from scm_world.errors import DAMAGED, InterventionError, ModelError, UnknownOption
from scm_world.graph import SCM, flatten
from scm_world.models import Model
from scm_world.queries.equations import System
from scm_world.variables import (
    ACTS,
    Categories,
    Contact,
    Draw,
    Function,
    Hard,
    Intervention,
    Mechanism,
    Natural,
    Reaches,
    Scale,
    Shift,
    Time,
)
from scm_world.variables.kinds import SPACES
from scm_world.variables.mechanisms import check_portable, check_trusted
from scm_world.world import Simulation

FORMAT = "scm_world/plan/2"

_PARTS: TypeAdapter[dict[str, tuple[Any, ...]]] = TypeAdapter(dict[str, tuple[Intervention, ...]])


def as_act(value: Any) -> Any:
    """Make a plain value a hard intervention, and the name of a space a draw from it.

    Raises:
        UnknownOption: It is neither numbers nor an intervention.
    """
    if isinstance(value, ACTS) or (isinstance(value, dict) and "kind" in value):  # from a file
        return value
    if isinstance(value, dict):
        allowed = "a value or an intervention: {'pole.mass': Hard(1.0, at=3)}, not Hard({…})"
        raise UnknownOption("act", value, (allowed,))
    if isinstance(value, str) and value in SPACES:
        return Draw(value)
    return Hard(value.tolist() if isinstance(value, np.ndarray) else value)


def at_once(act: Any) -> Any:
    """Return an intervention without its time."""
    return act if act.time is None else act.model_copy(update={"time": None})


def retimed(act: Any, **time: Any) -> Any:
    """Return an intervention with another time; see ``Time``."""
    return act.model_copy(update={"time": Time(**time)})


@final
class Plan(Mapping[str, tuple[Any, ...]]):
    """What is done to which variable, and when. A plan is a value: nothing changes it.

    Later wins: ``do(a).do(b) == do({**a, **b})``. What is given without a time takes place at the
    beginning: of the episode, or at the instant from which a counterfactual continues.

    Args:
        request: By variable, dotted or nested: a value, or an intervention, which may have a time
            (``at=``, ``during=``, ``every=``, ``when=``); a tuple or list where there are several.

    Raises:
        UnknownOption: Something is no intervention.

    Example:
        >>> plan = Plan({"tool_block": {"mass": 0.05}, "floor_friction": Hard(0.2, at=10)})
        >>> plan.do({"tool_block.mass": 0.08}) == Plan(
        ...     {"tool_block.mass": 0.08, "floor_friction": Hard(0.2, at=10)}
        ... )
        True
        >>> Plan.from_json(plan.to_json()) == plan
        True
    """

    __slots__ = ("_parts",)

    def __init__(self, request: Mapping[str, Any] | None = None) -> None:
        if isinstance(request, Plan):
            self._parts: dict[str, tuple[Any, ...]] = request._parts
        else:
            flat = flatten({} if request is None else request)
            self._parts = {name: _several(value) for name, value in flat.items()}

    @classmethod
    def of(cls, parts: dict[str, tuple[Any, ...]]) -> Plan:
        """Return the plan of interventions by dotted name, which are not looked at."""
        made = cls.__new__(cls)
        made._parts = parts
        return made

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
        acts = (f"{name} = {_short(act)}" for name, acts in self._parts.items() for act in acts)
        return f"do({', '.join(acts)})"

    def do(self, request: Mapping[str, Any]) -> Plan:
        """Return the plan that does this too; where both set a variable, this one counts."""
        return Plan.of({**self._parts, **Plan(request)._parts})

    def at_start(self) -> dict[str, Intervention]:
        """Return the interventions at the first instant, by variable and without times."""
        return {
            name: at_once(act)
            for name, acts in self._parts.items()
            for act in acts
            if act.time is None or act.time.start == 0
        }

    def timed(self) -> Iterator[tuple[str, Any]]:
        """List the interventions that have a time."""
        for name, acts in self._parts.items():
            yield from ((name, act) for act in acts if act.time is not None)

    def acts(self) -> Iterator[tuple[str, Intervention]]:
        """List all interventions, without their times."""
        for name, acts in self._parts.items():
            yield from ((name, at_once(act)) for act in acts)

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
            raise ModelError([f"not a plan: expected the format {FORMAT!r}; write it again"])
        try:
            plan = cls.of(_PARTS.validate_json(json.dumps(data["do"])))
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
        for acts in self._parts.values():
            for act in acts:
                if isinstance(act, Mechanism) and isinstance(act.function, Function):
                    yield act.function


def _short(act: Any) -> str:
    """Write an intervention down in few words."""
    match act:
        case Hard(value=value):
            text = np.array2string(np.asarray(value), precision=4, separator=", ", threshold=9)
        case Shift(by=by) | Scale(by=by):
            text = f"{type(act).__name__}({by})"
        case Draw(source=source):
            text = f"Draw({source!r})"
        case Mechanism(parents=parents):
            text = f"a function of {', '.join(p.name for p in parents) or 'nothing'}"
        case _:
            text = f"{type(act).__name__}()"
    return text if act.time is None else f"{text} {act.time}"


def _several(value: Any) -> tuple[Any, ...]:
    is_list = isinstance(value, list | tuple) and len(value) > 0
    if is_list and all(isinstance(act, ACTS) for act in value):
        return tuple(value)
    return (as_act(value),)


def has_times(request: Any) -> bool:
    """Return whether anything in a request has a time, or is plain data that may have one."""
    if isinstance(request, Mapping):
        return "kind" in request or any(map(has_times, request.values()))
    if isinstance(request, list | tuple):
        return len(request) > 0 and isinstance(request[0], ACTS) and any(map(has_times, request))
    return isinstance(request, ACTS) and request.time is not None


def do(request: Mapping[str, Any]) -> Plan:
    """Return the plan that does this; see ``Plan``.

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
        InterventionError: An intervention is due before its plan begins.
    """

    def __init__(self, layers: Iterable[Layer] = ()) -> None:
        self.layers = tuple(layers)
        for start, plan in self.layers:
            for name, act in plan.timed():
                time = act.time
                if time.every is None and time.when is None and time.start < start:
                    raise InterventionError(
                        f"do({name}): control step {time.start} is over; the plan begins at "
                        f"{start}",
                        variable=name,
                        value=act,
                    )
        self._starts = frozenset(start for start, plan in self.layers if len(plan))
        self._all, self._later = (
            [
                ((number, name, index), act)
                for number, (_, plan) in enumerate(self.layers)
                for name, acts in plan.items()
                for index, act in enumerate(acts)
                if act.time is not None or with_untimed
            ]
            for with_untimed in (True, False)
        )

    @property
    def waits(self) -> bool:
        """Whether anything waits for an event."""
        return any(act.time.when is not None for _, act in self._later)

    def due(self, world: System, step: int, fired: dict[Key, int]) -> dict[str, Intervention]:
        """Return what is to be done at the beginning of a control step, without times.

        Args:
            world: As it is then; events are looked for in it.
            step: Number of the control step.
            fired: When events happened; those of now are added.
        """
        found: dict[str, Intervention] = {}
        ended: dict[str, Intervention] = {}
        for key, act in self._possible(world, step, fired):
            name, time = key[1], act.time
            if time is not None and time.when is not None and key not in fired:
                if not happens(time.when, world):
                    continue
                fired[key] = step
            if time is not None and time.during is not None:
                if _is_state(name, world) and not isinstance(act, Hard | Mechanism):
                    raise InterventionError(
                        f"do({name}): a state is held at a value or by a Mechanism, not by {act!r}",
                        variable=name,
                        value=act,
                    )
                if step == time.during[1]:
                    ended[name] = self._still_held(key, step)
                    continue
            found[name] = at_once(act)
        return {**ended, **found}

    def concerns(self, world: System, step: int, fired: Mapping[Key, int]) -> bool:
        """Tell whether anything may be due at a control step, without a look at the present.

        Args:
            world: In the structure that there is then.
            step: Number of the control step.
            fired: When events happened.
        """
        return any(True for _ in self._possible(world, step, fired))

    def _possible(
        self, world: System, step: int, fired: Mapping[Key, int]
    ) -> Iterator[tuple[Key, Any]]:
        """List what is due at a control step, or waits for an event."""
        for key, act in self._all if step in self._starts else self._later:
            (number, name, _), time = key, act.time
            start = self.layers[number][0]
            if time is None:
                is_possible = step == start
            elif time.when is not None:
                is_possible = step > start and fired.get(key, step) == step
            elif time.during is not None:
                at_end = step in time.during  # a state is put there at every step between
                is_possible = time.holds(step) if _is_state(name, world) else at_end
            elif time.every is not None:
                since = step - time.start
                is_possible = step >= start and since >= 0 and since % time.every == 0
            else:
                is_possible = step == time.at
            if is_possible and self._counts(number, name, step, world):
                yield key, act

    def _counts(self, number: int, name: str, step: int, world: System) -> bool:
        """Tell whether no later plan has taken over all quantities that a name sets."""
        model = world.model
        later = [plan for start, plan in self.layers[number + 1 :] if start <= step]
        if not later or self.layers[number][0] > step:
            return self.layers[number][0] <= step
        taken = {target for plan in later for one in plan for target in targets(model, one)}
        return not taken.issuperset(targets(model, name))

    def _still_held(self, key: Key, step: int) -> Intervention:
        """Return what holds where a window ends: one around it, or the variable's mechanism."""
        for act in self.layers[key[0]][1][key[1]]:
            if act.time is not None and act.time.holds(step):
                held: Intervention = at_once(act)
                return held
        return Natural()


UNPLANNED = Schedule()


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


def targets(model: SCM, name: str) -> tuple[str, ...]:
    """Return the quantities that a name sets; itself where the model does not have it."""
    return model.targets(name) if name in model else (name,)


def _is_state(name: str, world: System) -> bool:
    return name in world.model and world.model.declared(world.model.target(name)).role == "state"


def happens(event: Contact | Reaches, world: System) -> bool:
    """Tell whether an event is there now.

    Raises:
        UnknownOption: There is no such body or number; equations have no bodies at all.
    """
    if isinstance(event, Reaches):
        numbers = np.ravel(world[event.name])
        if event.component >= len(numbers):
            allowed = (f"0 to {len(numbers) - 1}",)
            raise UnknownOption(f"component of {event.name}", event.component, allowed)
        number = float(numbers[event.component])
        return number > event.above if event.above is not None else number < (event.below or 0.0)
    if not isinstance(world, Simulation):
        raise UnknownOption("event of equations", event, ("Reaches(name, above=…)",))
    known = world.structure.body_names if isinstance(world.structure, Model) else ()
    for body in event.bodies if known else ():
        if not any(name.startswith(body) for name in known):
            raise UnknownOption("body of a contact", body, known)
    first, second = event.bodies
    return any(
        contact.force > 0.0
        and any(
            one.startswith(first) and other.startswith(second)
            for one, other in (contact.bodies, contact.bodies[::-1])
        )
        for contact in world.backend.contacts()
    )


__all__ = ["Plan", "do"]
