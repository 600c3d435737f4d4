"""What an intervention did, variable by variable."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from scm_world._types import Value
from scm_world.backends import Backend
from scm_world.models import Difference, Parameters
from scm_world.variables import Hard
from scm_world.world.compiled_task import StepBase
from scm_world.world.interventions import Solution, same
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
@dataclass(frozen=True)
class Audit:
    """The result of a successful ``do``.

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
    came: tuple[str, ...] = ()
    went: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

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
    solution: Solution,
    change: Difference | None,
    before: StepBase,
    now: Rows,
    inertia: Parameters,
    reported: Parameters,
    backend: Backend,
) -> Audit:
    """Return what a committed intervention did.

    Args:
        request: As it was given, with dotted names.
        solution: That was applied.
        change: What the backend had to change.
        before: The world before.
        now: The values that the world has now.
        inertia: Principal moments of bodies whose mass or size changed, before.
        reported: Parameters that were read back already.
        backend: That took over the change.
    """
    compiled, old, changed = solution.compiled, before.row, solution.changed
    keys, bundles, model = compiled.parameter_keys, compiled.bundles, compiled.model
    wanted = {keys[t] for name in solution.asked for t in model.targets(name) if t in keys}
    missing = [*(wanted - reported.keys()), *inertia]
    reported = {**reported, **backend.parameters(missing)} if missing else reported
    targets = {
        name: Applied(name, request[name], *_asked(solution, now, reported, name))
        for name in solution.asked
    }
    known = {*targets, *(part for name in targets for part in bundles.get(name, ()))}
    followed = {
        name: (np.array(old[name]), np.array(now[name])) for name in changed if name not in known
    }
    if change is not None and change.state is not None:
        for name in before.compiled.slices:
            if name in bundles or name in known or name not in compiled.slices:
                continue
            if not same(old[name], now[name]):
                followed[name] = (np.array(old[name]), np.array(now[name]))
    engine = {".".join(key): (was, reported[key]) for key, was in inertia.items()}
    came: list[str] = []
    went: list[str] = []
    if compiled is not before.compiled:
        there, were = ({*one.composition.bodies} for one in (compiled, before.compiled))
        came, went = sorted(there - were), sorted(were - there)
    remarks: tuple[str, ...] = ()
    set_here = change.parameters if change is not None and change.structure is None else {}
    if any(what.endswith("friction") for _, what in set_here):
        frictions = {keys[name]: old[name] for name in changed if name in keys}
        remarks = backend.capabilities.remarks(backend, frictions)
    return Audit(targets, followed, engine, tuple(came), tuple(went), remarks)


def _asked(
    solution: Solution, now: Rows, reported: Parameters, name: str
) -> tuple[Value | None, Value | None]:
    """Return the value that something asked for has now, and what the backend reports of it.

    None of an action that is known only at its step, and of what the backend does not know.
    """
    compiled = solution.compiled
    targets = compiled.model.targets(name)
    values, backs = list[Value](), list[Value]()
    for target in targets:
        if target in compiled.actions:
            act = solution.checked.acts[target][1]
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
