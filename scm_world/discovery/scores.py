"""How near a found graph comes to the declared one."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, final

from scm_world.queries.experiments.effects import EdgeKey


@final
@dataclass(frozen=True)
class Score:
    """A comparison of two sets of lagged edges.

    Attributes:
        shd: Structural Hamming distance: edges to add, remove or turn around.
        precision: Found edges that are declared, as a fraction; 1 if none was found.
        recall: Declared edges that were found, as a fraction; 1 if none is declared.
        f1: Harmonic mean of the two.
        undeclared: Found but not declared.
        missed: Declared but not found.

    Source:
        Tsamardinos, Brown and Aliferis, *The max-min hill-climbing Bayesian network structure
        learning algorithm*, Machine Learning 2006, for the distance.
    """

    shd: int
    precision: float
    recall: float
    f1: float
    undeclared: tuple[EdgeKey, ...]
    missed: tuple[EdgeKey, ...]

    def as_dict(self) -> dict[str, Any]:
        """Write the score as plain data."""
        return asdict(self)


def score(found: Iterable[EdgeKey], declared: Iterable[EdgeKey]) -> Score:
    """Compare found edges with declared ones.

    Example:
        >>> score([("a", "b", 0), ("c", "b", 1)], [("b", "a", 0), ("c", "b", 1)]).shd
        1
    """
    found_set, declared_set = set(found), set(declared)
    common = found_set & declared_set
    undeclared, missed = found_set - declared_set, declared_set - found_set
    reversed_ = {
        (cause, effect, lag)
        for cause, effect, lag in undeclared
        if lag == 0 and (effect, cause, lag) in missed
    }
    precision = len(common) / len(found_set) if found_set else 1.0
    recall = len(common) / len(declared_set) if declared_set else 1.0
    both = precision + recall
    return Score(
        shd=len(undeclared) + len(missed) - len(reversed_),
        precision=precision,
        recall=recall,
        f1=2 * precision * recall / both if both else 0.0,
        undeclared=tuple(sorted(undeclared)),
        missed=tuple(sorted(missed)),
    )
