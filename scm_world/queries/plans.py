"""Plans: interventions on several variables, each with its time, as one value."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, final

from pydantic import TypeAdapter

from scm_world.errors import DAMAGED, ModelError
from scm_world.graph import flatten
from scm_world.queries.timed import ACTS, TIMED, At, Clamp, On, Timed, as_act
from scm_world.variables import Function, Intervention, Mechanism
from scm_world.variables.mechanisms import OWN_MECHANISMS

FORMAT = "scm_world/plan/1"
PACKAGE = "scm_world"

_PARTS: TypeAdapter[dict[str, tuple[Any, ...]]] = TypeAdapter(dict[str, tuple[Timed, ...]])


@final
class Plan(Mapping[str, tuple[Any, ...]]):
    """What is done to which variable, and when. A plan is a value: nothing changes it.

    Later wins: ``do(a).do(b) == do({**a, **b})``. What is given without a time happens at the
    beginning: of the episode, or at the instant from which a counterfactual goes on.

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
            flat = flatten(request or {})
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

    def do(self, request: Mapping[str, Any]) -> Plan:
        """Give the plan that does this too; where both set a variable, this one counts."""
        both = Plan()
        both._parts = {**self._parts, **Plan(request)._parts}
        return both

    def at_start(self) -> dict[str, Intervention]:
        """Give what happens at the beginning, by variable."""
        return {
            name: part
            for name, parts in self._parts.items()
            for part in parts
            if isinstance(part, ACTS)
        }

    def at_first(self) -> dict[str, Intervention]:
        """Give what happens at the first instant, with or without a time, by variable."""
        found = self.at_start()
        for name, part in self.timed():
            if (isinstance(part, At) and part.step == 0) or (
                isinstance(part, Clamp) and part.start == 0
            ):
                found[name] = part.act
        return found

    def timed(self) -> Iterator[tuple[str, Any]]:
        """List what happens later, or on an event."""
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
        problems = [
            f"the mechanism of {name!r} is {function.reference!r}, which cannot be found under "
            "this name; define it at the top level of a module"
            for name, function in self._functions()
            if not function.is_portable()
        ]
        if problems:
            raise ModelError(problems)
        return {"format": FORMAT, "do": _PARTS.dump_python(self._parts, mode="json")}

    def to_json(self) -> str:
        """Write the plan as JSON, without loss; errors as in ``as_dict``."""
        return json.dumps(self.as_dict(), allow_nan=False)

    @classmethod
    def from_dict(cls, data: Any, *, trusted: Sequence[str] = ()) -> Plan:
        """Read a plan that ``as_dict`` wrote.

        Args:
            data: Plain data.
            trusted: Packages, besides this one, whose functions may serve as mechanisms.

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
        problems = [
            f"the mechanism of {name!r} is {function.reference!r}; pass trusted=(…) to read it"
            for name, function in plan._functions()
            if not function.is_defined_in((*OWN_MECHANISMS, *trusted))
        ]
        if problems:
            raise ModelError(problems)
        return plan

    @classmethod
    def from_json(cls, text: str, *, trusted: Sequence[str] = ()) -> Plan:
        """Read a plan that ``to_json`` wrote; see ``from_dict``."""
        try:
            data = json.loads(text)
        except DAMAGED as error:
            raise ModelError([f"not a plan: {error}"]) from None
        return cls.from_dict(data, trusted=trusted)

    def _functions(self) -> Iterable[tuple[str, Function]]:
        for name, act in self.acts():
            if isinstance(act, Mechanism) and isinstance(act.function, Function):
                yield name, act.function


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


__all__ = ["At", "Clamp", "On", "Plan", "do"]
