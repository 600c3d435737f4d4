"""Ancestral graphs against independences: all graphs of four variables, by numbers alone."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import redirect_stdout
from io import StringIO
from itertools import chain, combinations, product

import networkx as nx
import numpy as np
import pytest

from scm_world.errors import ModelError
from scm_world.graph.ancestral import (
    CIRCLE,
    HEAD,
    TAIL,
    Marks,
    edge_words,
    last_slice,
    mag,
    pag,
    window,
)
from scm_world.graph.equivalence import is_acyclic, meets, reaches

P = 4
PAIRS = tuple(combinations(range(P), 2))
Bools = np.ndarray


def independences(directed: Bools, confounded: Bools, seed: int = 0) -> tuple[bool, ...]:
    """Tell for each pair and set of others whether a random Gaussian model has it independent.

    All partial correlations come from one covariance matrix; they vanish for no other reason than
    the graph, as weights are drawn.
    """
    draw = np.random.default_rng(seed)
    p = len(directed)
    weights = np.where(directed, draw.uniform(0.5, 1.5, (p, p)), 0.0)
    noise = np.eye(p) * (p + 2.0)
    for i, j in np.argwhere(np.triu(confounded)):
        noise[i, j] = noise[j, i] = draw.uniform(0.5, 1.0)
    total = np.linalg.inv(np.eye(p) - weights.T)
    cov = total @ noise @ total.T
    found = []
    for i, j in combinations(range(p), 2):
        rest = [k for k in range(p) if k not in (i, j)]
        for given in chain.from_iterable(combinations(rest, n) for n in range(len(rest) + 1)):
            inverse = np.linalg.inv(cov[np.ix_([i, j, *given], [i, j, *given])])
            found.append(abs(inverse[0, 1]) < 1e-10)
    return tuple(found)


def four() -> Iterator[tuple[Bools, Bools]]:
    """Yield all acyclic graphs of four variables with at most one edge for each pair."""
    for kinds in product(range(4), repeat=len(PAIRS)):
        directed, confounded = np.zeros((P, P), bool), np.zeros((P, P), bool)
        for (i, j), kind in zip(PAIRS, kinds, strict=True):
            directed[i, j], directed[j, i] = kind == 1, kind == 2
            confounded[i, j] = confounded[j, i] = kind == 3
        if is_acyclic(directed):
            yield directed, confounded


def test_a_pag_has_the_marks_that_all_equivalent_graphs_share() -> None:
    """By brute force: all ancestral graphs of four variables, grouped by independences."""
    groups: dict[tuple[bool, ...], list[np.ndarray]] = {}
    for directed, confounded in four():
        found = mag(directed, confounded)
        kinds = (found == TAIL) & (found.T == HEAD), (found == HEAD) & (found.T == HEAD)
        if (kinds[0] == directed).all() and (kinds[1] == confounded).all():  # it is a MAG itself
            groups.setdefault(independences(directed, confounded), []).append(found)
    assert sum(map(len, groups.values())) > 1000
    for graphs in groups.values():
        shared = np.where((graphs == graphs[0]).all(axis=0), graphs[0], CIRCLE)
        for each in graphs:
            assert edge_words("abcd", pag(each)) == edge_words("abcd", shared)


@pytest.mark.parametrize("seed", range(40))
def test_a_mag_has_the_independences_of_its_graph(seed: int) -> None:
    """Five variables, pairs with both kinds of edges among them: joined if nothing separates."""
    draw = np.random.default_rng(seed)
    order = draw.permutation(5)
    directed = np.triu(draw.random((5, 5)) < 0.4, 1)[np.ix_(order, order)]
    confounded = np.triu(draw.random((5, 5)) < 0.3, 1)
    confounded = confounded | confounded.T
    found = mag(directed, confounded)
    said = independences(directed, confounded)
    each = len(said) // 10
    for number, (i, j) in enumerate(combinations(range(5), 2)):
        assert (found[i, j] == 0) == any(said[number * each : (number + 1) * each])
    tails, heads = (found == TAIL) & (found.T == HEAD), (found == HEAD) & (found.T == HEAD)
    assert independences(tails, heads, seed=1) == said


def test_textbook_graphs() -> None:
    """Two instruments with a hidden cause between (Zhang 2008), and a discriminating path."""
    directed, confounded = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    directed[0, 1] = directed[3, 2] = confounded[1, 2] = confounded[2, 1] = True
    assert edge_words("xaby", mag(directed, confounded)) == ("x --> a", "a <-> b", "b <-- y")
    assert edge_words("xaby", pag(mag(directed, confounded))) == ("x o-> a", "a <-> b", "b <-o y")
    # d *-> a <-> b, a -> c: whether b is a head twice shows in the independence of d and c.
    path = np.zeros((4, 4), bool)
    path[0, 1] = path[1, 3] = True
    hidden = np.zeros((4, 4), bool)
    for i, j in ((1, 2), (2, 3)):
        hidden[i, j] = hidden[j, i] = True
    assert edge_words("dabc", pag(mag(path, hidden))) == (
        "d o-> a", "a <-> b", "a --> c", "b <-> c"
    )  # fmt: skip
    loop = np.array([[False, True], [True, False]])
    with pytest.raises(ModelError, match="without cycles"):
        mag(loop, ~loop & loop)


@pytest.mark.parametrize("seed", range(12))
def test_a_window_hides_the_past(seed: int) -> None:
    """A series unrolled far back: separation in the window is that of the long series."""
    draw = np.random.default_rng([seed, 3])
    p, most, lags = 3, int(draw.integers(1, 3)), 1
    edges = draw.random((most + 1, p, p)) < 0.3
    edges[0] = np.triu(edges[0], 1)
    confounded = draw.random((most + 1, p, p)) < 0.15
    confounded[0] = np.triu(confounded[0], 1)
    confounded[0] |= confounded[0].T
    long = 14
    whole, shared = (np.zeros((long * p,) * 2, bool) for _ in range(2))
    for t in range(long):
        for lag in range(min(t, most) + 1):
            there, here = slice((t - lag) * p, (t - lag + 1) * p), slice(t * p, (t + 1) * p)
            whole[there, here] |= edges[lag]
            shared[there, here] |= confounded[lag]
            shared[here, there] |= confounded[lag].T
    kept = np.arange((long - lags - 1) * p, long * p)
    # Separated by observed ones alone: an inducing path may pass through anything hidden.
    found = mag(*window(edges, confounded, lags))
    assert (found != 0).tolist() == joined(whole, shared, kept).tolist()
    assert last_slice(found, lags).shape == (lags + 1, p, p)


def equivalent(given: Marks) -> list[Marks]:
    """List all ancestral graphs with the independences of one, by filling circles in all ways."""
    known = pag(given)
    circles = np.argwhere(known == CIRCLE)
    said = independences(given == TAIL, (given == HEAD) & (given.T == HEAD))
    found = []
    for fill in product((HEAD, TAIL), repeat=len(circles)):
        marks = known.copy()
        marks[tuple(circles.T)] = fill
        tails, heads = (marks == TAIL) & (marks.T == HEAD), (marks == HEAD) & (marks.T == HEAD)
        whole = not ((marks == TAIL) & (marks.T == TAIL)).any() and is_acyclic(tails)
        if whole and (mag(tails, heads) == marks).all() and independences(tails, heads) == said:
            found.append(marks)
    return found


def test_the_oracle_of_causal_learn_agrees_or_is_wrong() -> None:
    """Nine variables, two hidden: where its FCI has another mark, the equivalent graphs decide."""
    fci = pytest.importorskip("causallearn.search.ConstraintBased.FCI").fci
    rows, differ = np.random.default_rng(0).normal(size=(50, 7)), 0
    for seed in range(22):
        draw = np.random.default_rng(seed)
        graph = np.triu(draw.random((9, 9)) < 0.35, 1)
        order = draw.permutation(9)
        graph = graph[np.ix_(order, order)]
        model = nx.DiGraph(graph.astype(int))
        with redirect_stdout(StringIO()):
            theirs, _ = fci(rows, "d_separation", 0.05, true_dag=model, show_progress=False)
        truth = mag(*latent(graph, 7))
        ours, other = pag(truth), np.array(theirs.graph).astype(int)
        assert ((ours != 0) == (other != 0)).all()
        if (ours != other).any():
            differ += 1
            graphs = np.array(equivalent(truth))
            shared = np.where((graphs == graphs[0]).all(axis=0), graphs[0], CIRCLE)
            assert (shared == ours).all()
    assert differ <= 2


def latent(graph: Bools, kept: int) -> tuple[Bools, Bools]:
    """Project a graph on its first variables: directed edges and confounded pairs."""
    hidden = np.arange(len(graph)) >= kept
    ends = meets(reaches(graph[np.ix_(hidden, hidden)]), graph[hidden])
    directed, shared = graph | meets(graph[:, hidden], ends), meets(ends.T, ends)
    np.fill_diagonal(shared, False)
    return directed[:kept, :kept], shared[:kept, :kept]


def joined(directed: Bools, confounded: Bools, kept: np.ndarray) -> Bools:
    """Tell which of some variables no set of them separates, by numbers."""
    draw = np.random.default_rng(5)
    n = len(directed)
    weights = np.where(directed, draw.uniform(0.4, 0.9, (n, n)), 0.0)
    noise = np.eye(n) * 12.0
    for i, j in np.argwhere(np.triu(confounded)):
        noise[i, j] = noise[j, i] = draw.uniform(0.5, 1.0)
    total = np.linalg.inv(np.eye(n) - weights.T)
    cov = (total @ noise @ total.T)[np.ix_(kept, kept)]
    found = np.ones((len(kept),) * 2, bool) & ~np.eye(len(kept), dtype=bool)
    for i, j in combinations(range(len(kept)), 2):
        rest = [k for k in range(len(kept)) if k not in (i, j)]
        for given in chain.from_iterable(combinations(rest, m) for m in range(len(rest) + 1)):
            part = cov[np.ix_([i, j, *given], [i, j, *given])]
            scale = np.sqrt(np.diag(part))
            inverse = np.linalg.inv(part / np.outer(scale, scale))
            if abs(inverse[0, 1]) < 1e-9 * inverse[0, 0]:
                found[i, j] = found[j, i] = False
    return found
