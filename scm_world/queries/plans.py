"""Plans: interventions on several variables, each with its time, as one value."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
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
"""Variable, event that is waited for, and the control step from which it is."""

_PARTS: TypeAdapter[dict[str, tuple[Any, ...]]] = TypeAdapter(dict[str, tuple[Intervention, ...]])


def as_act(value: Any) -> Any:
    """Make a plain value a hard intervention, and the name of a space a draw from it."""
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
        UnknownOption: Something is no intervention, or a name is not text.

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

    # --- in an episode ------------------------------------------------------------------------

    def then(
        self, request: Mapping[str, Any] | None, model: SCM, *, at: int, done: bool = False
    ) -> Plan:
        """Return the plan that does this too, from a control step on.

        From then on it alone counts for the quantities that it names. What has no time is done at
        that step, events are waited for from there on, and windows of before end there.

        Args:
            request: Interventions; their times count from the beginning of the episode.
            model: Knows which names are coordinates of one quantity.
            at: The control step.
            done: Whether this plan has acted at that step already: then what it did stands where
                the request has nothing for that step.

        Raises:
            InterventionError: An intervention is due before that step.
        """
        more = {n: tuple(_since(n, act, at) for act in acts) for n, acts in Plan(request).items()}
        mine = {target for name in more for target in targets(model, name)}
        now = {
            target
            for name, acts in more.items()
            if any(act.time is None or act.time.start == at for act in acts)
            for target in targets(model, name)
        }
        parts: dict[str, tuple[Any, ...]] = {}
        for name, acts in self._parts.items():
            its, kept = targets(model, name), acts
            if mine.issuperset(its):
                end = at + 1 if done and not now.issuperset(its) else at
                kept = tuple(part for act in acts for part in _until(act, end))
            if kept:
                parts[name] = kept
        return Plan.of(parts | {n: (*parts.get(n, ()), *acts) for n, acts in more.items()})

    @property
    def waits(self) -> bool:
        """Whether anything waits for an event."""
        return any(act.time.when is not None for _, act in self.timed())

    def due(self, world: System, step: int, fired: dict[Key, int]) -> dict[str, Intervention]:
        """Return what is to be done at the beginning of a control step, without times.

        Events are looked for in the world; those of now are added to ``fired``. Where names of one
        quantity meet at a step by different times, the last of them counts, and each of them more
        than the end of a window.
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
                    ended[name] = at_once(next(held, Natural()))  # a window around it, or nothing
                    continue
            found[name] = act
        by_time: dict[Any, dict[str, Intervention]] = {}
        for name, act in found.items():
            by_time.setdefault(act.time, {})[name] = at_once(act)
        return merged(world.model, ended, *by_time.values())

    def concerns(self, world: System, step: int, fired: Mapping[Key, int]) -> bool:
        """Return whether anything may be due at a control step, without a look at the present."""
        return any(True for _ in self._possible(world, step, fired))

    def _possible(
        self, world: System, step: int, fired: Mapping[Key, int]
    ) -> Iterator[tuple[str, Any]]:
        """List what is due at a control step, or waits for an event."""
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
                    at_end = step in time.during  # a state is put there at every step between
                    is_possible = time.holds(step) if _is_state(name, world) else at_end
                elif time.every is not None:
                    is_possible = step >= time.start and (step - time.start) % time.every == 0
                else:
                    is_possible = step == time.at
                if is_possible:
                    yield name, act

    # --- files --------------------------------------------------------------------------------

    def as_dict(self) -> dict[str, Any]:
        """Write the plan as plain data.

        Raises:
            ModelError: It has a function that cannot be found again under its name, or a number
                that is not finite.
        """
        check_portable(self._functions())
        infinite = [(name, act) for name, act in self.acts() if not _is_finite(act)]
        if infinite:
            said = "has a number that is not finite, which JSON does not have"
            raise ModelError([f"do({name}): {act!r} {said}" for name, act in infinite])
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
    if isinstance(value, list | tuple) and any(isinstance(act, ACTS) for act in value):
        return tuple(map(as_act, value))
    return (as_act(value),)


def _is_finite(act: Any) -> bool:
    return bool(np.isfinite(getattr(act, "value", getattr(act, "by", 0.0))).all())


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


def check_names(world: Simulation, plan: Plan) -> None:
    """Refuse names of a plan that nothing in a world will ever have.

    Where variables decide which bodies there are, a name may come within the episode.

    Raises:
        UnknownVariable: With the names that there are.
    """
    compiled = world.compiled
    refused = dict(compiled.composition.system.refused)
    for name in dict.fromkeys(name for name, _ in plan.timed()):
        known = name in world.model or name in compiled.entity_names or name in refused
        if not known and not world.structures.deciding:
            raise UnknownVariable(name, tuple(world.model))


def targets(model: SCM, name: str) -> tuple[str, ...]:
    """Return the quantities that a name sets; itself where the model does not have it."""
    return model.targets(name) if name in model else (name,)


def _key(name: str, time: Any) -> Key:
    return name, time.when, 0 if time.during is None else time.during[0]


def _until(act: Any, end: int) -> list[Any]:
    """Return what an intervention has done before another one replaces it at a control step."""
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
    """Return an intervention of a request that begins at a control step; refuse an earlier one."""
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
    """Return whether an event is there now; refuse unknown bodies and components."""
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
