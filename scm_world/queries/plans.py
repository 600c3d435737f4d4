"""Plans: interventions on several variables, each with its time, as one value."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, final

import numpy as np
from pydantic import TypeAdapter

from scm_world.errors import (
    DAMAGED,
    InterventionError,
    ModelError,
    UnknownOption,
    UnknownVariable,
)
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
from scm_world.world.interventions import merged

FORMAT = "scm_world/plan/2"

Key = tuple[str, Contact | Reaches, int]
"""Variable, awaited event, and the control step from which it is awaited."""

_PARTS: TypeAdapter[dict[str, tuple[Any, ...]]] = TypeAdapter(dict[str, tuple[Intervention, ...]])


def as_act(value: Any) -> Any:
    """Return an intervention: ``Hard`` for a plain value, ``Draw`` for the name of a space."""
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
    """Interventions on variables, with their times. A plan is immutable.

    Later ones replace earlier ones: ``do(a).do(b) == do({**a, **b})``. An intervention without a
    time is applied at the beginning of the episode, or at the instant of a counterfactual.

    Args:
        request: Values or interventions by variable, dotted or nested. Interventions may have a
            time (``at=``, ``during=``, ``every=``, ``when=``); several form a tuple or list.

    Raises:
        UnknownOption: A value is not an intervention, or a name is not text.

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
            for name in flat:
                if not isinstance(name, str):
                    allowed = ("text, such as 'tool_block.mass'",)
                    raise UnknownOption("name of a variable", name, allowed)
            self._parts = {}
            for name, value in flat.items():
                try:
                    self._parts[name] = _several(value)
                except ModelError as error:
                    allowed = ("a number", "an array of numbers", "an intervention", *SPACES)
                    raise UnknownOption(name, value, allowed) from error

    @classmethod
    def of(cls, parts: dict[str, tuple[Any, ...]]) -> Plan:
        """Return the plan of interventions by dotted name, without checks."""
        plan = cls.__new__(cls)
        plan._parts = parts
        return plan

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
        """Return a plan with further interventions, which replace those on the same variables."""
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
        """Yield the interventions with a time."""
        for name, acts in self._parts.items():
            yield from ((name, act) for act in acts if act.time is not None)

    def acts(self) -> Iterator[tuple[str, Intervention]]:
        """Yield all interventions, without their times."""
        for name, acts in self._parts.items():
            yield from ((name, at_once(act)) for act in acts)

    def named(self, model: SCM, among: Collection[str] | None = None) -> Plan:
        """Return the plan with the variables of a model that its patterns fit.

        Args:
            model: The model.
            among: The only variables that patterns mean; all that can be set if None.

        Raises:
            InterventionError: A pattern fits nothing, or two fit one quantity.
        """
        found = model.named(self._parts, among=among)
        return self if found is self._parts else Plan.of(dict(found))

    # --- in an episode ------------------------------------------------------------------------

    def then(
        self, request: Mapping[str, Any] | None, model: SCM, *, at: int, done: bool = False
    ) -> Plan:
        """Return a plan with further interventions, from a control step on; refuse earlier ones.

        From then on they replace the others on the same quantities. Those without a time are
        applied at that step, events are awaited from there on, and earlier windows end there.
        If this plan has acted at that step already (``done``), its interventions at that step are
        kept, unless the request has one for the same quantity and step.
        """
        asked = Plan(request).named(model)
        more = {n: tuple(_since(n, act, at) for act in acts) for n, acts in asked.items()}
        replaced = {target for name in more for target in targets(model, name)}
        now = {
            target
            for name, acts in more.items()
            if any(act.time is None or act.time.start == at for act in acts)
            for target in targets(model, name)
        }
        parts: dict[str, tuple[Any, ...]] = {}
        for name, acts in self._parts.items():
            own, kept = targets(model, name), acts
            if replaced.issuperset(own):
                end = at + 1 if done and not now.issuperset(own) else at
                kept = tuple(part for act in acts for part in _until(act, end))
            if kept:
                parts[name] = kept
        return Plan.of(parts | {n: (*parts.get(n, ()), *acts) for n, acts in more.items()})

    def due(self, world: System, step: int, fired: dict[Key, int]) -> dict[str, Intervention]:
        """Return the interventions at the beginning of a control step, without times.

        Events of the present instant are added to ``fired``. If several interventions on one
        quantity are due at a step by different times, the last one is applied; each of them
        replaces the end of a window.
        """
        ended: dict[str, Intervention] = {}
        found: dict[str, Any] = {}
        for name, act in self._possible(world, step, fired):
            time = act.time
            if time is not None and time.when is not None:
                if _key(name, time) not in fired and not happens(time.when, world):
                    continue
                fired[_key(name, time)] = step
            elif time is not None and time.during is not None:
                if _is_state(name, world) and not isinstance(act, Hard | Mechanism):
                    raise InterventionError(
                        f"do({name}): a state is held at a value or by a Mechanism, not by {act!r}",
                        variable=name,
                        value=act,
                    )
                if step == time.during[1]:
                    held = (act for act in self._parts[name] if act.time and act.time.holds(step))
                    ended[name] = at_once(next(held, Natural()))  # an enclosing window, or release
                    continue
            found[name] = act
        by_time: dict[Any, dict[str, Intervention]] = {}
        for name, act in found.items():
            by_time.setdefault(act.time, {})[name] = at_once(act)
        return merged(world.model, ended, *by_time.values())

    def concerns(self, world: System, step: int, fired: Mapping[Key, int]) -> bool:
        """Return whether an intervention may be due at a control step, whatever the state."""
        return any(True for _ in self._possible(world, step, fired))

    def _possible(
        self, world: System, step: int, fired: Mapping[Key, int]
    ) -> Iterator[tuple[str, Any]]:
        """Yield the interventions that are due at a control step, or wait for an event."""
        for name, acts in self._parts.items():
            for act in acts:
                time = act.time
                if time is None:
                    is_possible = step == 0
                elif time.when is not None:
                    start, stop = time.during or (0, None)
                    is_open = start < step and (stop is None or step < stop)
                    is_possible = is_open and fired.get(_key(name, time), step) == step
                elif time.during is not None:
                    at_end = step in time.during  # a state is set at every step of the window
                    is_possible = time.holds(step) if _is_state(name, world) else at_end
                elif time.every is not None:
                    is_possible = step >= time.start and (step - time.start) % time.every == 0
                else:
                    is_possible = step == time.at
                if is_possible:
                    yield name, act

    # --- files --------------------------------------------------------------------------------

    def as_dict(self) -> dict[str, Any]:
        """Return the plan as plain data.

        Raises:
            ModelError: A function cannot be imported by its name, or a number is not finite.
        """
        check_portable(self._functions())
        problems = list[str]()
        for name, act in self.acts():
            number = getattr(act, "value", getattr(act, "by", 0.0))
            if not isinstance(number, Draw) and not np.isfinite(number).all():
                text = "has a number that is not finite, which JSON does not have"
                problems.append(f"do({name}): {act!r} {text}")
        if problems:
            raise ModelError(problems)
        return {"format": FORMAT, "do": _PARTS.dump_python(self._parts, mode="json")}

    def to_json(self) -> str:
        """Return the plan as JSON, without loss; errors as in ``as_dict``."""
        return json.dumps(self.as_dict(), allow_nan=False)

    @classmethod
    def from_dict(cls, data: Any, *, trusted: Sequence[str] = ()) -> Plan:
        """Read a plan that ``as_dict`` wrote.

        Args:
            data: Plain data.
            trusted: Further packages whose functions may be mechanisms.

        Raises:
            ModelError: The data is not a plan, or has a function outside of the trusted packages.
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
    match act:
        case Hard(value=value):
            text = np.array2string(np.asarray(value), precision=4, separator=", ", threshold=9)
        case Shift(by=by, shared=shared) | Scale(by=by, shared=shared):
            said = _short(by) if isinstance(by, Draw) else by
            text = f"{type(act).__name__}({said}{', shared' if shared else ''})"
        case Draw(source=source):
            text = f"Draw({source!r})"
        case Mechanism(parents=parents):
            text = f"a function of {', '.join(p.name for p in parents) or 'nothing'}"
        case _:
            text = f"{type(act).__name__}()"
    return text if act.time is None else f"{text} {act.time}"


def _several(value: Any) -> tuple[Any, ...]:
    if isinstance(value, list | tuple) and any(isinstance(act, ACTS) for act in value):
        return tuple(map(as_act, value))
    return (as_act(value),)


def has_times(request: Any) -> bool:
    """Return whether a request contains times, or plain data that may contain them."""
    if isinstance(request, Mapping):
        return "kind" in request or any(map(has_times, request.values()))
    if isinstance(request, list | tuple):
        return len(request) > 0 and isinstance(request[0], ACTS) and any(map(has_times, request))
    return isinstance(request, ACTS) and request.time is not None


def do(request: Mapping[str, Any]) -> Plan:
    """Return a plan of interventions; see ``Plan``.

    Example:
        >>> do({"floor_friction": 0.3}).do({"floor_friction": 0.4})
        Plan({'floor_friction': (Hard(kind='hard', value=0.4),)})
    """
    return Plan(request)


def numbered(model: SCM, request: Mapping[str, Any]) -> dict[str, Any]:
    """Return a request under dotted names, with labels of categories as numbers."""
    found = dict(model.named(flatten(request)))
    for name, value in found.items():
        bounds = model.declared(name).bounds if isinstance(value, str) and name in model else None
        if isinstance(bounds, Categories) and value in bounds.labels:
            found[name] = int(bounds.numbers(value))
    return found


def check_names(world: Simulation, plan: Plan) -> None:
    """Refuse names of timed interventions that do not exist in a world, and never will."""
    refused = dict(world.composition.system.refused)
    entities = [entity.name for entity in world.composition.entities]
    for name in dict.fromkeys(name for name, _ in plan.timed()):
        known = name in world.model or name in entities or name in refused
        if not known and not world.structures.deciding:
            raise UnknownVariable(name, tuple(world.model))


def targets(model: SCM, name: str) -> tuple[str, ...]:
    """Return the quantities that a name sets; the name itself if it is unknown."""
    return model.targets(name) if name in model else (name,)


def _key(name: str, time: Any) -> Key:
    return name, time.when, 0 if time.during is None else time.during[0]


def _until(act: Any, end: int) -> list[Any]:
    """Return the parts of an intervention before another one replaces it at a control step."""
    time = act.time
    if time is None:
        return [act] if end else []
    start, stop = time.during or (time.at or 0, None)
    if start >= end:
        return []
    if time.when is not None or time.during is not None:
        last = end if stop is None else min(end, stop)
        return [retimed(act, when=time.when, during=(start, last))]
    return [retimed(act, at=step) for step in range(start, end, time.every or end)]


def _since(name: str, act: Any, start: int) -> Any:
    """Return the part of an intervention from a control step on; refuse an earlier one."""
    time = act.time
    if time is None:
        return retimed(act, at=start) if start else act
    if time.when is not None:
        first, stop = time.during or (0, None)
        return retimed(act, when=time.when, during=(max(first, start), stop)) if start else act
    if time.start >= start:
        return act
    if time.every is None:
        raise InterventionError(
            f"do({name}): control step {time.start} is over; the plan begins at {start}",
            variable=name,
            value=act,
        )
    return retimed(act, at=start + (time.start - start) % time.every, every=time.every)


def _is_state(name: str, world: System) -> bool:
    return name in world.model and world.model.declared(world.model.target(name)).role == "state"


def happens(event: Contact | Reaches, world: System) -> bool:
    """Return whether an event occurs now; refuse unknown bodies and components."""
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
    for body in (event.first, event.second) if known else ():
        if not any(name.startswith(body) for name in known):
            raise UnknownOption("body of a contact", body, known)
    first, second = event.first, event.second
    return any(
        contact.force > 0.0
        and any(
            one.startswith(first) and other.startswith(second)
            for one, other in (contact.bodies, contact.bodies[::-1])
        )
        for contact in world.backend.contacts()
    )
