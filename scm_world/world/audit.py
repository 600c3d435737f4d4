"""What an intervention did, variable by variable."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from scm_world._types import Value


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
        followed: Parameters and states that changed at once because a target did: values before
            and after. Other coordinates of them, and readouts, are not listed.
        engine: Quantities that the engine derives: the principal moments of inertia of each body
            whose mass or size changed [kg m²], before and after.
        came: Blocks and obstacles that were not there before.
        went: Those that are not there any more.
    """

    targets: Mapping[str, Applied]
    followed: Mapping[str, tuple[Value, Value]]
    engine: Mapping[str, tuple[Value, Value]]
    came: tuple[str, ...] = ()
    went: tuple[str, ...] = ()

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
        return "\n".join(lines)


def _show(value: Value) -> str:
    return np.array2string(np.asarray(value), precision=6, separator=", ")
