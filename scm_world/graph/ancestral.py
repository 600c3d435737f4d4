"""Ancestral graphs: the graphs of observed variables with hidden common causes.

A graph of p observed variables has directed edges and pairs with a hidden common cause (an ADMG).
Its maximal ancestral graph (MAG) joins the pairs that no set of observed variables separates, and
its partial ancestral graph (PAG) keeps the marks that all MAGs with these independences share.

A graph with edge marks is a matrix of shape (p, p): at [i, j] the mark at i of the edge between i
and j: ``HEAD`` if i does not cause j, ``TAIL`` if it does, ``CIRCLE`` if either can be, 0 without
an edge. These are the numbers of causal-learn. Through time a matrix has shape (lags + 1, p, p):
at [lag, i, j] the mark at i, so many control steps before j; the later end of such an edge is a
head.

Sources:
    Richardson and Spirtes, *Ancestral graph Markov models*, Annals of Statistics 2002, for MAGs.
    Zhang, *On the completeness of orientation rules for causal discovery in the presence of latent
    confounders and selection bias*, Artificial Intelligence 2008, for PAGs without selection.
    Andrews, Spirtes and Cooper, *On the completeness of causal discovery in the presence of latent
    confounding with tiered background knowledge*, AISTATS 2020, for variables in order of time.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from scm_world.errors import ModelError
from scm_world.graph.equivalence import Bools, is_acyclic, meets, reaches

Marks = NDArray[np.int8]
HEAD, TAIL, CIRCLE = 1, -1, 2
SIGNS = {HEAD: "<>", TAIL: "--", CIRCLE: "oo"}
"""The sign of a mark on the left and on the right of an edge."""


def mag(directed: Bools, confounded: Bools) -> Marks:
    """Return the maximal ancestral graph: no circles.

    Two variables are joined if there is an inducing path: all between are heads on both sides, and
    ancestors of one of the two.

    Args:
        directed: Shape (p, p): i acts on j.
        confounded: Shape (p, p), symmetric: a hidden variable acts on both.

    Raises:
        ModelError: There is a cycle.
    """
    if not is_acyclic(directed):
        raise ModelError(["an ancestral graph needs a graph without cycles within the instant"])
    above, into = reaches(directed), directed | confounded
    marks = np.zeros(directed.shape, np.int8)
    for i, j in combinations(range(len(marks)), 2):
        inside = above[:, i] | above[:, j]
        inside[[i, j]] = False
        path, more = np.zeros_like(inside), into[i] & inside
        while more.any():
            path |= more
            more = confounded[path].any(axis=0) & inside & ~path
        if into[i, j] or into[j, i] or (path & into[j]).any():
            marks[i, j] = TAIL if above[i, j] else HEAD
            marks[j, i] = TAIL if above[j, i] else HEAD
    return marks


def pag(given: Marks, tiers: Sequence[int] | None = None) -> Marks:
    """Return the partial ancestral graph of a maximal ancestral one.

    Args:
        given: A result of ``mag``.
        tiers: The tier of each variable, which acts on none of a lower tier; or None.
    """
    joined = given != 0
    apart = ~joined & ~np.eye(len(given), dtype=bool)
    marks = np.where(joined, CIRCLE, 0).astype(np.int8)
    if tiers is not None:
        later = np.array(tiers)[:, None] > np.array(tiers)
        marks[joined & later] = HEAD
    for k in range(len(given)):  # rule 0: heads that meet and whose ends are not joined
        heads = given[k] == HEAD
        marks[k, heads & (apart & heads).any(axis=1)] = HEAD
    before = np.zeros_like(marks)
    while (marks != before).any():
        before = marks.copy()
        # Rule 1: a *-> b o-* c, a and c not joined: b -> c.
        mid, end = np.nonzero((marks == CIRCLE) & meets(marks == HEAD, apart))
        marks[mid, end], marks[end, mid] = TAIL, HEAD
        # Rule 2: a -> b *-> c or a *-> b -> c, and a *-o c: a *-> c.
        arrow = marks.T == HEAD  # [a, b]: a *-> b
        out = arrow & (marks == TAIL)
        marks[(marks == CIRCLE) & (meets(out, arrow) | meets(arrow, out)).T] = HEAD
        # Rule 3: a *-> b <-* c, a *-o d o-* c, a and c not joined, d *-o b: d *-> b.
        for b, d in np.argwhere(marks == CIRCLE).tolist():
            both = np.flatnonzero((marks[b] == HEAD) & (marks[d] == CIRCLE))
            if apart[np.ix_(both, both)].any():
                marks[b, d] = HEAD
        _discriminating(marks, apart, given)
        # Rule 8: a -> b -> c and a o-> c: a -> c.
        arrow = marks.T == HEAD
        out = arrow & (marks == TAIL)
        marks[(marks == CIRCLE) & arrow & meets(out, out)] = TAIL
        _uncovered(marks, apart)
    return marks


def _discriminating(marks: Marks, apart: Bools, given: Marks) -> None:
    """Rule 4: at the end a, b, c of a discriminating path b is a head twice, or b -> c."""
    for b, c in np.argwhere(marks == CIRCLE).tolist():
        parents = (marks[:, c] == TAIL) & (marks[c] == HEAD)
        for a in np.flatnonzero(parents & (marks[:, b] == HEAD)).tolist():
            seen = np.zeros_like(parents)  # heads on both sides, parents of c all, back from a
            ahead = np.arange(len(marks)) == a
            while ahead.any():
                seen |= ahead
                twice = (marks[seen] == HEAD) & (marks[:, seen] == HEAD).T
                ahead = twice.any(axis=0) & parents & ~seen
            if not ((marks[seen] == HEAD) & apart[c]).any():
                continue
            if given[b, a] == HEAD == given[b, c]:
                marks[b, a] = marks[b, c] = marks[c, b] = HEAD
            else:
                marks[b, c], marks[c, b] = TAIL, HEAD


def _uncovered(marks: Marks, apart: Bools) -> None:
    """Rules 9 and 10: a o-> c becomes a -> c where uncovered paths that can be directed say so."""
    may = (marks != 0) & (marks != HEAD) & (marks.T != TAIL)  # [x, y]: the edge can be x -> y
    for a, c in np.argwhere((marks == CIRCLE) & (marks.T == HEAD)).tolist():
        parents = (marks[:, c] == TAIL) & (marks[c] == HEAD)
        reached = {}
        for first in np.flatnonzero(may[a] & (np.arange(len(marks)) != c)).tolist():
            steps, ahead = {(a, first)}, [(a, first)]
            while ahead:
                x, y = ahead.pop()
                new = {(y, z) for z in np.flatnonzero(may[y] & apart[x]).tolist()} - steps
                steps |= new
                ahead += new
            reached[first] = {y for _, y in steps}
        found = any(c in ends and apart[first, c] for first, ends in reached.items())
        some = [f for f, ends in reached.items() if parents[list(ends)].any()]
        if found or apart[np.ix_(some, some)].any():
            marks[a, c] = TAIL


def window(edges: Bools, confounded: Bools, lags: int) -> tuple[Bools, Bools]:
    """Unroll a graph through time over some control steps; all that was before is hidden.

    Args:
        edges: Shape (most + 1, p, p): i acts on j so many control steps later.
        confounded: The same shape: a hidden variable acts on i, and on j so many steps later.
        lags: How many control steps there are before the last one.

    Returns:
        Directed edges and confounded pairs, shape (p (lags + 1),) * 2, the earliest step first.
    """
    most, p = len(edges) - 1, edges.shape[1]
    pairs = np.argwhere(confounded)
    n, width = p + len(pairs), lags + 1
    acts = np.zeros((most + 1, n, n), dtype=bool)  # each hidden cause of a pair is a node
    acts[:, :p, :p] = edges
    for hidden, (lag, i, j) in enumerate(pairs, p):
        acts[0, hidden, i] = acts[lag, hidden, j] = True
    directed = np.zeros((width, p, width, p), dtype=bool)
    shared = np.zeros_like(directed)
    for lag in range(min(most, lags) + 1):
        both = confounded[lag] | (confounded[lag].T if lag == 0 else False)
        for start in range(width - lag):
            directed[start, :, start + lag], shared[start, :, start + lag] = edges[lag], both
            shared[start + lag, :, start] |= both.T
    # What hidden nodes reach in the window, step by step back in time. It depends on the paths of
    # as many steps as the longest lag; once these come again, so does all that lies before.
    instant = reaches(acts[0])
    within, seen = [instant], set[bytes]()  # by steps that lie between, through hidden nodes only
    reached = [np.zeros((0, width, p), dtype=bool)]
    while most:
        recent = within[: -most - 1 : -1]
        state = np.stack([*recent, *[np.zeros_like(instant)] * (most - len(recent))]).tobytes()
        if state in seen:
            break
        seen.add(state)
        ends = np.zeros((n, width, p), dtype=bool)
        for lag, paths in enumerate(recent, 1):
            for place in range(min(most - lag, lags) + 1):
                ends[:, place] |= meets(paths, acts[lag + place])[:, :p]
        reached.append(ends)
        ways = [meets(paths, acts[lag]) for lag, paths in enumerate(recent, 1)]
        within.append(meets(np.any(ways, axis=0), instant))
    stacked = np.concatenate(reached)
    flat = stacked.reshape(len(stacked), width * p)
    confounding = meets(flat.T, flat) | shared.reshape(width * p, width * p)
    np.fill_diagonal(confounding, False)
    return directed.reshape(width * p, width * p), confounding


def last_slice(marks: Marks, lags: int) -> Marks:
    """Return the marks of a window's edges to its last control step, shape (lags + 1, p, p)."""
    p = len(marks) // (lags + 1)
    return np.stack([marks[(lags - lag) * p :, lags * p :][:p] for lag in range(lags + 1)])


def edge_words(names: Sequence[str], marks: Marks) -> tuple[str, ...]:
    """Write the edges of a graph with marks, ``@-1`` for a control step before.

    Args:
        names: Names of the p variables.
        marks: Shape (p, p) or (lags + 1, p, p).

    Example:
        >>> edge_words(["x", "y"], np.array([[0, 2], [1, 0]]))
        ('x o-> y',)
    """
    layers = marks[None] if marks.ndim == 2 else marks
    found = []
    for lag, i, j in np.argwhere(layers != 0).tolist():
        if lag or i < j:
            at_j = HEAD if lag else int(layers[0, j, i])
            left, right = SIGNS[int(layers[lag, i, j])][0], SIGNS[at_j][1]
            found.append(f"{names[i]}{f'@-{lag}' * bool(lag)} {left}-{right} {names[j]}")
    return tuple(found)
