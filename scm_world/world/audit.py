"""What an intervention did, variable by variable."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from scm_world._types import Value
from scm_world.models import Parameters
from scm_world.variables import Hard
from scm_world.world.compiled_task import StepBase
from scm_world.world.interventions import Transaction, same
from scm_world.world.mechanisms import Rows


@final
@dataclass(frozen=True)
class Applied:
    """What became of one target.

    Attributes:
        variable: The name that was asked for.
        requested: The intervention, as it was given.
        applied: The value that the model now has; None for actions that are shifted, scaled or
            drawn, since each is known only when its step comes.
        read_back: The value that the engine reports, or None where the engine does not know the
            variable (goals, counters).
    """

    variable: str
    requested: Any
    applied: Value | None
    read_back: Value | None


@final
class Audit:
    """The result of a successful ``do``; it is made when it is first read.

    Args:
        report: Returns the attributes, in their order.

    Attributes:
        targets: One entry for each target, by name.
        followed: Parameters and states that changed at lag 0 because a target did: values before
            and after. Other coordinates of them, and readouts, are not listed.
        engine: Quantities that the engine derives: the principal moments of inertia of each body
            whose mass or size changed [kg m²], before and after.
        came: Blocks and obstacles that were not there before.
        went: Those that are not there any more.
        remarks: What has no effect although it was set, and why.
    """

    targets: Mapping[str, Applied]
    followed: Mapping[str, tuple[Value, Value]]
    engine: Mapping[str, tuple[Value, Value]]
    came: tuple[str, ...]
    went: tuple[str, ...]
    remarks: tuple[str, ...]

    def __init__(self, report: Callable[[], tuple[Any, ...]]) -> None:
        self._report = report

    def __getattr__(self, name: str) -> Any:
        if name not in Audit.__annotations__:
            raise AttributeError(name)
        vars(self).update(zip(Audit.__annotations__, self._report(), strict=True))
        del self._report
        return vars(self)[name]

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in Audit.__annotations__}

    def __str__(self) -> str:
        lines = []
        for name, entry in self.targets.items():
            if entry.applied is None:
                lines.append(f"{name}: {entry.requested!r} at every step")
                continue
            engine = "" if entry.read_back is None else f", engine reports {_show(entry.read_back)}"
            lines.append(f"{name} = {_show(entry.applied)}{engine}")
        for title, changes in (("follows", self.followed), ("engine", self.engine)):
            for name, (before, after) in changes.items():
                lines.append(f"  {title}: {name} {_show(before)} → {_show(after)}")
        lines += [f"  new: {name}" for name in self.came]
        lines += [f"  gone: {name}" for name in self.went]
        lines += [f"  note: {remark}" for remark in self.remarks]
        return "\n".join(lines)


def _show(value: Value) -> str:
    return np.array2string(np.asarray(value), precision=6, separator=", ")


def report(
    request: Mapping[str, Any],
    done: Transaction,
    before: StepBase,
    now: Rows,
    inertia: Parameters,
    reported: Parameters,
    remarks: tuple[str, ...],
) -> tuple[Any, ...]:
    """Return what a committed intervention did; see ``Audit``.

    Args:
        request: As it was given, with dotted names.
        done: What became of it.
        before: The world before.
        now: The values after.
        inertia: Principal moments of bodies whose mass or size changed, before.
        reported: Parameters that were read back.
        remarks: Of the backend.
    """
    compiled, old, bundles = done.compiled, before.row, done.compiled.bundles
    targets = {
        name: Applied(name, request[name], *_values(done, now, reported, name))
        for name in done.asked
    }
    known = {*targets, *(part for name in targets for part in bundles.get(name, ()))}
    names = [name for name in done.changed if name not in known]
    if done.change is not None and done.change.state is not None:
        states = (n for n in before.compiled.slices if n in compiled.slices and n not in bundles)
        names += [n for n in states if n not in known and not same(old[n], now[n])]
    followed = {name: (np.array(old[name]), np.array(now[name])) for name in names}
    engine = {".".join(key): (was, reported[key]) for key, was in inertia.items()}
    there, were = ({*one.composition.bodies} for one in (compiled, before.compiled))
    return targets, followed, engine, (*sorted(there - were),), (*sorted(were - there),), remarks


def _values(
    done: Transaction, now: Rows, reported: Parameters, name: str
) -> tuple[Value | None, Value | None]:
    """Return the value that a target has now, and what the backend reports of it.

    None of an action that is known only at its step, and of what the backend does not know.
    """
    compiled = done.compiled
    targets = compiled.model.targets(name)
    values, backs = list[Value](), list[Value]()
    for target in targets:
        if target in compiled.actions:
            act = done.acts[target][1]
            values += [np.array(act.value)] if isinstance(act, Hard) else []
            continue
        values.append(np.array(now[target]))
        key = compiled.parameter_keys.get(target)
        if key is not None:
            backs.append(np.array(reported[key]))
        elif target in compiled.set_by_hand:
            backs.append(values[-1].copy())
    if len(values) < len(targets):
        return None, None
    if targets == (name,):
        return values[0], backs[0] if backs else None
    applied = compiled.in_coordinates(name, *values)
    if len(backs) < len(targets):
        return applied, None
    exact = all(map(same, backs, values))
    return applied, applied if exact else compiled.in_coordinates(name, *backs)
