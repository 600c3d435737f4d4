"""A plan of experiments: what each of them sets, beside how few could do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from scm_world.errors import ModelError
from scm_world.graph.equivalence import Bools

FORMAT = "scm_world/design/1"


@final
@dataclass(frozen=True)
class Design:
    """Experiments on n variables, by number.

    Attributes:
        kind: What it is for, for example ``"ordered"``.
        n: Number of variables.
        targets: For each experiment the variables that it sets, sorted.
        bound: Fewest experiments that can do in theory; see ``bounds``.

    Example:
        >>> design = Design("unordered", 3, ((1,), (2,)), bound=2)
        >>> print(design)
        unordered: 2 experiments on 3 variables, at least 2 are needed
        >>> design.named(["x", "y", "z"])
        (('y',), ('z',))
    """

    kind: str
    n: int
    targets: tuple[tuple[int, ...], ...]
    bound: int

    @property
    def used(self) -> int:
        """How many experiments there are."""
        return len(self.targets)

    @property
    def matrix(self) -> Bools:
        """What each experiment sets, shape (used, n)."""
        rows = np.zeros((self.used, self.n), dtype=bool)
        for row, target in zip(rows, self.targets, strict=True):
            row[list(target)] = True
        return rows

    def __str__(self) -> str:
        what = "experiment" if self.used == 1 else "experiments"
        least = f"at least {self.bound} {'is' if self.bound == 1 else 'are'} needed"
        return f"{self.kind}: {self.used} {what} on {self.n} variables, {least}"

    def named(self, names: Sequence[str]) -> tuple[tuple[str, ...], ...]:
        """Give the targets by name.

        Raises:
            ModelError: There are not n names.
        """
        if len(names) != self.n:
            raise ModelError([f"a design of {self.n} variables was given {len(names)} names"])
        return tuple(tuple(names[i] for i in target) for target in self.targets)

    def as_dict(self) -> dict[str, Any]:
        """Write it as plain data."""
        return {
            "format": FORMAT,
            "kind": self.kind,
            "n": self.n,
            "targets": [list(target) for target in self.targets],
            "bound": self.bound,
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Design:
        """Read what ``as_dict`` wrote.

        Raises:
            ModelError: It is something else.
        """
        if data.get("format") != FORMAT:
            raise ModelError([f"not a design: expected the format {FORMAT!r}"])
        targets = tuple(tuple(map(int, target)) for target in data["targets"])
        return cls(str(data["kind"]), int(data["n"]), targets, int(data["bound"]))


def design_of(kind: str, rows: Bools, bound: int) -> Design:
    """Make a design of a matrix: experiments by variables."""
    targets = tuple(tuple(np.flatnonzero(row).tolist()) for row in rows)
    return Design(kind, rows.shape[1], targets, bound)


__all__ = ["FORMAT", "Design", "design_of"]
