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
from scm_world.variables.reserved import CONTROL_INDEX
from scm_world.world.feasibility import Present
from scm_world.world.plan import InterventionPlan
from scm_world.world.solver import same


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
    plan: InterventionPlan,
    change: Difference,
    before: Present,
    now: Present,
    inertia: Parameters,
    reported: Parameters,
    backend: Backend,
) -> Audit:
    """Return what a committed intervention did.

    Args:
        request: As it was given, with dotted names.
        plan: That was applied.
        change: What the backend had to change.
        before: What the backend had before; its values are not overwritten.
        now: What it has now.
        inertia: Principal moments of bodies whose mass or size changed, before.
        reported: Parameters that were read back already.
        backend: That took over the plan.
    """
    model, keys = plan.compiled.model, plan.compiled.parameter_keys
    wanted = {keys[t] for name in plan.asked for t in model.targets(name) if t in keys}
    reported = {**reported, **backend.parameters([*(wanted - reported.keys()), *inertia])}
    targets = {}
    for name in plan.asked:
        applied, read_back = _asked(plan, now, reported, name)
        targets[name] = Applied(name, request[name], applied, read_back)
    bundles = plan.compiled.bundles
    known = {*targets, *(part for name in targets for part in bundles.get(name, ()))}
    followed = {
        name: (np.array(before.values[name]), np.array(value))
        for name, value in plan.static.items()
        if value is not before.values.get(name, value)
        and name not in known
        and not (
            np.shape(value) == np.shape(before.values[name]) and same(value, before.values[name])
        )
    }
    moved = (n for n in before.compiled.slices if n not in before.compiled.bundles)
    for name in moved if change.state is not None else ():
        if name in now.values and name not in known:
            old, new = before.compiled.view(name, before.state), now.values[name]
            if not same(old, new):
                followed[name] = (_typed(old, new), np.array(new))
    engine = {".".join(key): (old, reported[key]) for key, old in inertia.items()}
    there, were = ({*one.compiled.composition.bodies} for one in (now, before))
    came, went = sorted(there - were), sorted(were - there)
    remarks: tuple[str, ...] = ()
    if change.structure is None and any(what.endswith("friction") for _, what in change.parameters):
        known_keys = before.compiled.parameter_keys.items()
        changed = {key: before.values[name] for name, key in known_keys if key in change.parameters}
        remarks = backend.capabilities.remarks(backend, changed)
    return Audit(targets, followed, engine, tuple(came), tuple(went), remarks)


def _typed(old: Value, new: Value) -> Value:
    return old.astype(np.asarray(new).dtype)


def _asked(
    plan: InterventionPlan, now: Present, reported: Parameters, name: str
) -> tuple[Value | None, Value | None]:
    """Give what was applied and read back of what was asked for: also coordinates, or a bundle."""
    compiled = plan.compiled
    targets = compiled.model.targets(name)
    outcomes = [_outcome(plan, now, reported, target) for target in targets]
    if targets == (name,):
        return outcomes[0]
    values = [applied for applied, _ in outcomes if applied is not None]
    backs = [back for _, back in outcomes if back is not None]
    if len(values) < len(targets):
        return None, None
    applied = compiled.in_coordinates(name, *values)
    if len(backs) < len(targets):
        return applied, None
    exact = all(map(same, backs, values))
    return applied, applied if exact else compiled.in_coordinates(name, *backs)


def _outcome(
    plan: InterventionPlan, now: Present, reported: Parameters, target: str
) -> tuple[Value | None, Value | None]:
    """Give the value that a target has now, and what the backend reports; None if unknown."""
    compiled = plan.compiled
    if target in compiled.actions:
        act = plan.pending[target][1]
        return (np.array(act.value) if isinstance(act, Hard) else None), None
    applied = np.array(now.values[target])
    if target == CONTROL_INDEX:
        return applied, np.array(applied)
    if target in compiled.slices:
        return applied, np.array(compiled.view(target, now.state))
    key = compiled.parameter_keys.get(target)
    return applied, None if key is None else np.array(reported[key])
