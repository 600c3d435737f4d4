"""How few experiments can do: lower bounds, each with its source.

They count experiments, not samples: every experiment is taken to tell without error what it can.
"""

from __future__ import annotations

import math
from itertools import count

import numpy as np

from scm_world.errors import ModelError
from scm_world.graph.equivalence import Bools, covered_edges


def unordered_separating(n: int, max_size: int | None = None) -> int:
    """Set exactly one of any two variables in some experiment, of at most ``max_size`` each.

    Each variable needs its own set of experiments. The n smallest such sets must not take more
    places than there are.

    Source:
        Katona, *On separating systems of a finite set*, Journal of Combinatorial Theory 1966;
        Shanmugam, Kocaoglu, Dimakis and Vishwanath, *Learning causal graphs with small
        interventions*, NeurIPS 2015.
    """
    size = _size(n, max_size)
    return next(m for m in count() if 2**m >= n and _least_places(n, m) <= m * size)


def _least_places(n: int, m: int) -> int:
    """Add up the sizes of the n smallest subsets of m experiments."""
    places = 0
    for weight in range(m + 1):
        taken = min(n, math.comb(m, weight))
        places, n = places + taken * weight, n - taken
    return places


def ordered_separating(n: int, max_size: int | None = None) -> int:
    """Set the first but not the second of any two variables, in both orders, in some experiment.

    This is needed without faithfulness, with unobserved causes or with cycles. No set of
    experiments of a variable may contain that of another: ``C(m, m // 2) >= n``.

    Source:
        Spencer, *Minimal completely separating systems*, Journal of Combinatorial Theory 1970;
        Hyttinen, Eberhardt and Hoyer, *Experiment selection for causal discovery*, JMLR 2013. With
        ``max_size``: the inequality of Lubell, Yamamoto and Meshalkin, in which 1 / C(m, w) is
        convex in the size w, at the largest mean size that has room.
    """
    size = _size(n, max_size)
    if n < 2:
        return 0
    return next(m for m in count(2) if _has_room(n, m, size))


def _size(n: int, max_size: int | None) -> int:
    if n < 0 or (max_size is not None and max_size < 1):
        given = f"n={n}, max_size={max_size}"
        raise ModelError([f"n has to be 0 or more, max_size 1 or more; got {given}"])
    return n if max_size is None else min(max_size, n)


def _has_room(n: int, m: int, size: int) -> bool:
    mean = min(m * size / n, m // 2)
    low = math.floor(mean)
    shares = [1.0 / math.comb(m, weight) for weight in (low, min(low + 1, m))]
    share = shares[0] + (mean - low) * (shares[1] - shares[0])
    return n * share <= 1.0 + 1e-9


def verification(dag: Bools, max_size: int = 1) -> int:
    """Confirm a claimed graph, shape (p, p), given its essential graph.

    Returns:
        The size of the least vertex cover of the covered edges, called nu, over ``max_size``.

    Source:
        Choo, Shiragur and Bhattacharyya, *Verification and search algorithms for causal DAGs*,
        NeurIPS 2022, arXiv 2206.15374, theorems 11 and 12.
    """
    return math.ceil(len(forest_cover(covered_edges(dag))) / max_size)


def forest_cover(edges: Bools) -> tuple[int, ...]:
    """Return the fewest nodes that touch every edge of a forest.

    The only neighbor of a leaf can always be taken: it touches what the leaf does, and more.

    Raises:
        ModelError: The edges have a ring.
    """
    left = edges | edges.T
    cover = []
    while left.any():
        leaves = np.flatnonzero(left.sum(axis=1) == 1)
        if not len(leaves):
            raise ModelError(["the edges have a ring, so they are no forest"])
        node = int(left[leaves[0]].argmax())
        cover.append(node)
        left[node], left[:, node] = False, False
    return tuple(sorted(cover))


def pooled(n: int, degree: int) -> int:
    """Find the causes of an effect among n by yes-or-no answers, if there are ``degree`` of them.

    With answers that are numbers, 2 * degree measurements could do in principle.

    Raises:
        ModelError: There are more causes than variables.

    Source:
        Du and Hwang, *Combinatorial group testing and its applications*, 2000, chapter 1: each
        answer halves the possible sets at best.
    """
    if not 0 <= degree <= n:
        raise ModelError([f"degree has to be 0 to n; got n={n}, degree={degree}"])
    return math.ceil(math.log2(math.comb(n, degree)))


def coloring(parents: Bools) -> int:
    """Move all causes such that no effect has two of its declared causes moved at once.

    ``parents`` are causes by effects, shape (p, q).

    Source:
        Curtis, Powell and Reid, *On the estimation of sparse Jacobian matrices*, IMA Journal of
        Applied Mathematics 1974: the causes of one effect need as many colors as there are.

    Example:
        >>> coloring(np.array([[1, 0], [1, 1], [0, 1]], bool))
        2
    """
    return int(parents.sum(axis=0).max(initial=0))
