"""The audit of an intervention: its result, variable by variable."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, final

import numpy as np

from scm_world._types import Integers, Value
from scm_world.errors import InterventionError, some
from scm_world.models import Parameters
from scm_world.variables import Intervention
from scm_world.world.interventions import ROUNDING, Transaction, fixed_action, same
from scm_world.world.mechanisms import Rows
from scm_world.world.snapshot import Base

if TYPE_CHECKING:
    import pandas


@final
@dataclass(frozen=True)
class Applied:
    """The result of an intervention on one target.

    Attributes:
        variable: Name of the target in the request.
        requested: The intervention as given.
        applied: The value in the model now; None for actions that are shifted, scaled or drawn,
            since these are computed at every step.
        read_back: The value that the engine reports; None for variables that the engine does not
            have, such as counters.
    """

    variable: str
    requested: Any
    applied: Value | None
    read_back: Value | None


@final
class Audit:
    """The result of a successful ``do``; it is computed when it is first read.

    Args:
        report: Returns the attributes, in their order.

    Attributes:
        targets: One entry for each target, by name.
        followed: Parameters and states that changed at lag 0 as effects of a target: values before
            and after. Their other coordinates and readouts are not listed.
        engine: Quantities that the engine derives: the principal moments of inertia of each body
            whose mass or size changed [kg m²], before and after.
        came: Bodies that were added.
        went: Bodies that were removed.
        remarks: Changes without effect on the physics, with the reason, moments of inertia that
            stay where a mass is set, and equality constraints that are violated after the
            intervention has moved something, by how much.
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
        return "\n".join(lines) or "no intervention was requested, and nothing has changed"


@final
class Audits(Mapping[int, Audit]):
    """The audits of one intervention in many worlds, by number of the world.

    Args:
        audits: By number of the world.
        refused: The errors of the worlds that refused it, by number; these are unchanged.
        together: Further worlds: their numbers, ascending, and what makes the audit of the one at
            a place among them, when it is first read.

    Attributes:
        refused: As given.

    Example:
        >>> from scm_world import World
        >>> worlds = World("pushing", backend="fake", num_worlds=3)
        >>> _ = worlds.reset(seed=0)
        >>> audits = worlds.do({"tool_block.mass": [0.02, -1.0, 0.08]}, on_refusal="skip")
        >>> print(str(audits).partition(":")[0], [*audits], [*audits.refused])
        tool_block.mass [0, 2] [1]
        >>> audits.table()["world"].tolist()
        [0, 2]
    """

    def __init__(
        self,
        audits: Mapping[int, Audit],
        refused: Mapping[int, InterventionError],
        together: Sequence[tuple[Integers, Callable[[int], Audit]]] = (),
    ) -> None:
        self._audits, self.refused, self._together = audits, refused, together
        self._made: dict[int, Audit] = {}

    @cached_property
    def _worlds(self) -> list[int]:
        together = (number for numbers, _ in self._together for number in numbers.tolist())
        return sorted([*self._audits, *together])

    def __getitem__(self, world: int) -> Audit:
        if world in self._made:
            return self._made[world]
        for numbers, made in self._together:
            at = np.flatnonzero(numbers == world)
            if len(at):
                return self._made.setdefault(world, made(int(at[0])))
        return self._audits[world]

    def __iter__(self) -> Iterator[int]:
        return iter(self._worlds)

    def __len__(self) -> int:
        return len(self._worlds)

    def __reduce__(self) -> tuple[Any, ...]:
        return Audits, (dict(self), self.refused)

    def table(self) -> pandas.DataFrame:
        """Return a row for each target in each world.

        Returns:
            Columns ``world``, ``variable``, ``requested``, ``applied`` and ``reported``, as in
            ``Applied``, and ``follows``: names of parameters and states that changed as effects.
        """
        import pandas

        rows = [
            (world, name, one.requested, one.applied, one.read_back, tuple(audit.followed))
            for world, audit in self.items()
            for name, one in audit.targets.items()
        ]
        columns = ["world", "variable", "requested", "applied", "reported", "follows"]
        return pandas.DataFrame(rows, columns=columns)

    def __str__(self) -> str:
        entries: dict[str, list[Applied]] = {}
        for audit in self.values():
            for name, one in audit.targets.items():
                entries.setdefault(name, []).append(one)
        lines = []
        for name, found in entries.items():
            line = f"{name}: {_range([one.applied for one in found])} in {_worlds(len(found))}"
            back = [one.read_back for one in found if one.read_back is not None]
            lines.append(line + (f", engine reports {_range(back)}" if back else ""))
        for said, of in (("follows", "followed"), ("new", "came"), ("gone", "went")):
            each = [name for audit in self.values() for name in getattr(audit, of)]
            lines += [
                f"  {said}: {what} in {_worlds(n)}" for what, n in sorted(Counter(each).items())
            ]
        for remark in sorted({one for audit in self.values() for one in audit.remarks}):
            count = sum(remark in audit.remarks for audit in self.values())
            lines.append(f"  note in {_worlds(count)}: {remark}")
        if self.refused:
            world, error = next(iter(self.refused.items()))
            lines.append(f"refused in {_worlds(len(self.refused))}: {world} ({error}) ...")
        return "\n".join(lines) or "no intervention was requested, and nothing has changed"


def _worlds(count: int) -> str:
    return f"{count:,} world{'s' if count != 1 else ''}"


def _range(values: Sequence[Value | None]) -> str:
    if any(value is None for value in values):
        return "a value at every step"
    low, high = np.min(np.array(values), axis=0), np.max(np.array(values), axis=0)
    return _show(low) if same(low, high) else f"{_show(low)} to {_show(high)}"


def _show(value: Value) -> str:
    return np.array2string(np.asarray(value), precision=6, separator=", ")


def report(
    request: Mapping[str, Any],
    done: Transaction,
    before: Base,
    inertia: Parameters,
    reported: Parameters,
    remarks: tuple[str, ...],
) -> tuple[Any, ...]:
    """Return the attributes of an ``Audit``; ``inertia`` is that before, ``reported`` after."""
    compiled, old, now, bundles = done.compiled, before.row, done.row, done.compiled.bundles
    back = now.copy()  # as the backend reports it
    for name, key in compiled.parameter_keys.items():
        if key in reported:
            back[name] = reported[key]
    done_with = {**request, **done.relative}.items()
    given = {n: act.on(None) if isinstance(act, Intervention) else act for n, act in done_with}
    asked = {
        name: Applied(name, given[name], *_values(done, name, now, back)) for name in done.asked
    }
    known = {*asked, *(part for name in asked for part in bundles.get(name, ()))}
    names = [name for name in done.changed if name not in known]
    if done.change is not None and done.change.state is not None:
        states = (n for n in old.compiled.slices if n in compiled.slices and n not in bundles)
        names += [n for n in states if n not in known and not same(old[n], now[n])]
    followed = {name: (np.array(old[name]), np.array(now[name])) for name in names}
    engine = {".".join(key): (was, reported[key]) for key, was in inertia.items()}
    there, were = ({*one.composition.bodies} for one in (compiled, old.compiled))
    parameters = {*compiled.parameter_keys} & {*old.compiled.parameter_keys}
    pairs = ((n, n.removesuffix("mass") + "inertia") for n in asked if n.endswith(".mass"))
    pairs = (pair for pair in pairs if parameters.issuperset(pair) and pair[1] not in asked)
    if kept := [i for n, i in pairs if not same(old[n], now[n]) and same(old[i], now[i])]:
        remarks += (f"{some(kept)} as before, not in proportion to the mass",)
    if done.change is not None:
        remarks += (*_pulled(before, done),)
    return asked, followed, engine, (*sorted(there - were),), (*sorted(were - there),), remarks


def _pulled(before: Base, done: Transaction) -> Iterator[str]:
    """List the equality constraints that are violated now, and not as much as before."""
    now, then = (
        {(what, unit): size for _, what, size, unit in one.compiled.composition.violated(scene)}
        for one in (before.row, done.row)
        for scene in [one.compiled.scene(one)]
    )
    for (what, unit), size in then.items():
        if abs(size - now.get((what, unit), 0.0)) > ROUNDING:
            yield (
                f"{what}: {size:.3g} {unit} from where the constraint holds, so that physics pulls "
                "on both sides; set states that agree, or only those that others follow (in loops "
                "with follow=True)"
            )


def _values(
    done: Transaction, name: str, now: Rows, back: Rows
) -> tuple[Value | None, Value | None]:
    """Return the value of a target and the value that the backend reports, None if unknown."""
    compiled = done.compiled
    targets = compiled.model.targets(name)
    if targets[0] in compiled.actions:
        with suppress(InterventionError):  # it is known only at its step
            return fixed_action(name, [done.acts[target][1] for target in targets]), None
        return None, None
    known = compiled.set_by_hand | compiled.parameter_keys.keys()
    applied, reported = (np.array(compiled.coordinates(name, row)) for row in (now, back))
    return applied, reported if known.issuperset(targets) else None
