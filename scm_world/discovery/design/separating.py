"""Experiments that tell any two variables apart, without knowing anything of the graph."""

from __future__ import annotations

import math
from itertools import combinations, count, islice
from typing import Literal

import numpy as np

from scm_world.discovery.design import bounds
from scm_world.discovery.design.plan import Design, design_of
from scm_world.errors import UnknownOption
from scm_world.graph.equivalence import Bools

Kind = Literal["ordered", "unordered"]
KINDS: tuple[Kind, ...] = ("ordered", "unordered")


def separating_system(n: int, kind: Kind = "ordered", max_size: int | None = None) -> Design:
    """Plan experiments that separate every pair of variables.

    Each variable gets its own set of experiments, which set it: its label.

    Args:
        n: Number of variables.
        kind: ``"ordered"``: for any x and y, some experiment sets x and not y. It finds any graph,
            with unobserved causes and cycles too. ``"unordered"``: some experiment sets one of the
            two; enough where the essential graph is known.
        max_size: Most variables that one experiment sets; any number if None.

    Returns:
        A design with the fewest experiments there can be; only with ``"ordered"`` and
        ``max_size`` it can be more than the bound.

    Raises:
        UnknownOption: There is no such kind.
        ModelError: n or ``max_size`` is too small.

    Source:
        As in ``bounds.ordered_separating`` and ``bounds.unordered_separating``. That the places
        can be shared out evenly follows from exchanging one experiment of a label at a time.

    Example:
        >>> print(separating_system(20))
        ordered: 6 experiments on 20 variables, at least 6 are needed
        >>> separating_system(4, "unordered").targets
        ((1, 3), (2, 3))
    """
    if kind not in KINDS:
        raise UnknownOption("kind of separating system", kind, KINDS)
    if kind == "unordered":
        least = bounds.unordered_separating(n, max_size)
        labels = _smallest_labels(n, least)
    else:
        least = bounds.ordered_separating(n, max_size)
        labels = _labels_of_one_size(n, least, max_size)
    return design_of(kind, _shared_out(labels).T, least)


def separates(design: Design, kind: Kind = "ordered") -> bool:
    """Check that every pair of variables is separated.

    Example:
        >>> separates(separating_system(9, max_size=2)), separates(Design("", 2, ((0,),), 1))
        (True, False)
    """
    label = design.matrix.T.astype(np.float64)
    first_only = label @ (1.0 - label.T) > 0
    done = first_only if kind == "ordered" else first_only | first_only.T
    return bool((done | np.eye(design.n, dtype=bool)).all())


def _smallest_labels(n: int, m: int) -> Bools:
    """Take the n smallest subsets of m experiments, shape (n, m)."""
    subsets = (chosen for weight in range(m + 1) for chosen in combinations(range(m), weight))
    return _written(list(islice(subsets, n)), m)


def _labels_of_one_size(n: int, least: int, max_size: int | None) -> Bools:
    """Take n subsets of one size, of as few experiments as have room for them, shape (n, m)."""
    if n < 2:
        return np.zeros((n, 0), dtype=bool)
    size = n if max_size is None else max_size
    sizes = ((m, min(m // 2, m * size // n)) for m in count(least))
    # It ends: in n experiments there is room for one variable each.
    m, weight = next((m, weight) for m, weight in sizes if math.comb(m, weight) >= n)
    return _written(list(islice(combinations(range(m), weight), n)), m)


def _written(subsets: list[tuple[int, ...]], m: int) -> Bools:
    labels = np.zeros((len(subsets), m), dtype=bool)
    for label, chosen in zip(labels, subsets, strict=True):
        label[list(chosen)] = True
    return labels


def _shared_out(labels: Bools) -> Bools:
    """Make all experiments equally large, plus or minus one, with labels of the same sizes.

    While one experiment sets two variables more than another, some label has the large one and not
    the small one, and exchanging them gives a label that nobody has.
    """
    labels = labels.copy()
    taken = {label.tobytes() for label in labels}
    while labels.shape[1]:
        sizes = labels.sum(axis=0)
        large, small = int(sizes.argmax()), int(sizes.argmin())
        if sizes[large] - sizes[small] < 2:
            break
        for label in labels[labels[:, large] & ~labels[:, small]]:
            changed = label.copy()
            changed[large], changed[small] = False, True
            if changed.tobytes() not in taken:
                taken = (taken - {label.tobytes()}) | {changed.tobytes()}
                labels[(labels == label).all(axis=1)] = changed
                break
    return labels


__all__ = ["KINDS", "Kind", "separates", "separating_system"]
