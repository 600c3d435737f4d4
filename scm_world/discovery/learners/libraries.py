"""Learners of other libraries: PC, GES, BOSS, GRaSP, FCI, GIES, PermScore, PCMCI+ and its kin.

None of the libraries is imported before it is used. A setting that is not allowed raises
``UnknownOption``, data that cannot be used ``ModelError``.

Each takes a ``Dataset``, of which rows in which something is done are left out (not by ``gies`` and
``permscore``), a ``seed`` of its random draws, and settings, of which several learners have:

- ``alpha``: level of the tests;
- ``penalty``: penalty of an edge, times log(n); 0.5 is the Bayesian information criterion;
- ``tau_max``: longest lag [control steps].

Sources:
    Zheng et al., *Causal-learn: causal discovery in Python*, JMLR 2024, for PC (Spirtes, Glymour
    and Scheines, *Causation, Prediction, and Search*, 2000), GES (Chickering, *Optimal structure
    identification with greedy search*, JMLR 2002), BOSS (Andrews et al., *Fast scalable and
    accurate discovery of DAGs using the best order score search and grow-shrink trees*, NeurIPS
    2023) and GRaSP (Lam, Andrews and Ramsey, *Greedy relaxations of the sparsest permutation
    algorithm*, UAI 2022). Gamella, Taeb, Heinze-Deml and Bühlmann, *Characterization and greedy
    learning of Gaussian structural causal models under unknown interventions*, 2022, for GIES
    (Hauser and Bühlmann, JMLR 2012). Runge, *Discovering contemporaneous and lagged causal
    relations in autocorrelated nonlinear time series datasets*, UAI 2020, for PCMCI+. Spirtes,
    Meek and Richardson, *Causal inference in the presence of latent variables and selection bias*,
    UAI 1995, for FCI. Gerhardus and Runge, *High-recall causal discovery for autocorrelated time
    series with latent confounders*, NeurIPS 2020, for LPCMCI. Günther, Ninad and Runge, *Causal
    discovery for time series from multiple datasets with latent contexts*, UAI 2023, for J-PCMCI+.
"""

from __future__ import annotations

import random
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from functools import wraps
from importlib import import_module
from inspect import signature
from io import StringIO
from typing import Any

import numpy as np

from scm_world._arguments import one_of, real_number, whole_number
from scm_world._types import ArrayLike, Floats, Integers
from scm_world.discovery.data.dataset import Bools, Dataset, Regime
from scm_world.discovery.data.views import as_gies
from scm_world.discovery.learners.found import EstimatedGraph
from scm_world.errors import ModelError, ScmWorldError, UnknownOption
from scm_world.graph.ancestral import CIRCLE, HEAD, TAIL, Marks

BIC = "local_score_BIC_from_cov"
RIDGE = 1e-9
"""Added to the variances of standardised columns. Some vary only where they are set, and on a
variance of zero the search of GIES never ends."""
STILL = 1e-12
"""A standardised column that moves less than this within each episode does not change there."""
DEPENDENT = 1e-7
"""A column with this part of its spread left after regression on the earlier ones adds nothing."""
SHOWN = 10  # columns that a note names


# --- the call -------------------------------------------------------------------------------------


def library(
    learner: str, *, done: bool = False, marked: bool = False, least: int = 2
) -> Callable[[Callable[..., Any]], Callable[..., EstimatedGraph]]:
    """Make a learner of a search: ``search(table, seed=…, **settings)``.

    The search is given standardised columns that vary and are not functions of one another. It
    returns edges (booleans) or edge marks (see ``marks_of_links``), with edge scores and notes if
    it has them.

    Args:
        learner: Its name, for messages.
        done: Whether it uses rows in which something is done.
        marked: Whether the marks are the result; edges are read from them otherwise.
        least: Fewest columns that it is called for; some libraries fail where there is nothing to
            find.
    """

    def make(search: Callable[..., Any]) -> Callable[..., EstimatedGraph]:
        parameters = signature(search).parameters.values()
        usual = {p.name: p.default for p in parameters if p.name not in ("data", "seed")}

        @wraps(search)
        def run(data: Dataset, *, seed: int = 0, **given: object) -> EstimatedGraph:
            settings = {**usual, **given}
            for name, value in settings.items():
                of = f"{name} of {learner!r}"
                if name == "intercept":
                    one_of(of, value, ("regime", "shared"))
                elif name == "tau_max":
                    whole_number(of, value, least=1)
                elif not 0.0 < real_number(of, value) < (1.0 if name == "alpha" else np.inf):
                    allowed = "a number between 0 and 1" if name == "alpha" else "a number above 0"
                    raise UnknownOption(of, value, (allowed,))
            table, notes = usable(learner, data, done=done)
            found: Any = np.zeros((len(table.names),) * 2, np.int8)
            if len(found) >= least:
                with _quietly(learner, seed):
                    found = search(table, seed=seed, **settings)
            made, scores, more = found if isinstance(found, tuple) else (found, None, ())
            marks = np.asarray(made)
            edges = marks if marks.dtype == bool else edges_of_marks(marks)
            if scores is None:
                scores = likelihood_gain(table, (marks != 0) | (marks != 0).T if marked else edges)
            elif not marked and scores.ndim == 3:
                scores[0] = np.where(edges[0].T & ~edges[0], 0.0, scores[0])
            notes += tuple(note for note in more if note)
            shown = {k: list(v) if isinstance(v, tuple) else v for k, v in settings.items()}
            kind = EstimatedGraph.of_marks if marked else EstimatedGraph.of
            graph = kind(
                table.names,
                marks if marked else edges,
                edge_scores=scores,
                notes=notes,
                settings=shown,
            )
            return graph.restricted(data.names)

        return run

    return make


# --- static graphs --------------------------------------------------------------------------------


@library("pc")
def pc(data: Dataset, *, seed: int = 0, alpha: float = 0.01) -> Any:
    """Find a graph by tests of partial correlation (Fisher's z), in any order of columns."""
    result = import_module("causallearn.search.ConstraintBased.PC").pc(
        data.values, alpha, "fisherz", stable=True, background_knowledge=_past_first(data),
        show_progress=False,
    )  # fmt: skip
    marks = np.array(result.G.graph)
    contrary = int(np.sum((marks == HEAD) & (marks.T == HEAD))) // 2
    return marks, None, (_contradictions(contrary),)


@library("ges")
def ges(data: Dataset, *, seed: int = 0, penalty: float = 0.5) -> Any:
    """Find a graph by greedy search over equivalence classes."""
    search = import_module("causallearn.search.ScoreBased.GES").ges
    return search(data.values, BIC, parameters={"lambda_value": penalty})["G"].graph


@library("boss")
def boss(data: Dataset, *, seed: int = 0, penalty: float = 2.0) -> Any:
    """Find a graph by search over orders, moving one column at a time."""
    search = import_module("causallearn.search.PermutationBased.BOSS").boss
    return search(data.values, BIC, {"lambda_value": penalty}, verbose=False).graph


@library("grasp")
def grasp(data: Dataset, *, seed: int = 0, penalty: float = 2.0) -> Any:
    """Find a graph by search over orders, by tucks."""
    search = import_module("causallearn.search.PermutationBased.GRaSP").grasp
    return search(data.values, BIC, 3, {"lambda_value": penalty}, verbose=False).graph


@library("fci", marked=True)
def fci(data: Dataset, *, seed: int = 0, alpha: float = 0.01) -> Any:
    """Find a partial ancestral graph by tests of partial correlation: causes may be hidden."""
    home = import_module("causallearn.search.ConstraintBased.FCI")
    with _later_ends_are_heads(home, data):
        return home.fci(data.values, "fisherz", alpha, show_progress=False)[0].graph


@library("gies", done=True)
def gies(data: Dataset, *, seed: int = 0, penalty: float = 0.5, intercept: str = "regime") -> Any:
    """Find a graph by greedy search over interventional equivalence classes.

    The ``intercept`` is ``"regime"`` for one in each set of targets, as the package has it: means
    say nothing then; or ``"shared"`` for one in all rows in which a column was not set.
    """
    always = [
        f"{data.names[i]!r} is set in every row; 'gies' needs rows in which it is left alone"
        for i in np.flatnonzero(data.targeted.all(axis=0))
    ]
    if always:
        raise ModelError(always)
    cost = penalty * float(np.log(len(data)))
    scores = import_module("gies.scores.gauss_int_l0_pen")
    measure = scores.GaussIntL0Pen(*as_gies(data), lmbda=cost)
    if intercept == "shared":
        free = [data.values[~set_] for set_ in data.targeted.T]
        measure.part_sample_cov = np.stack([np.cov(x, rowvar=False, bias=True) for x in free])
    measure.part_sample_cov += RIDGE * np.eye(len(data.names))
    graph, _ = import_module("gies").fit(measure, iterate=True)
    return np.array(graph) != 0


def permscore(data: Dataset, *, seed: int = 0) -> EstimatedGraph:
    """Find a graph and the unknown target of each regime, or none.

    It knows which rows belong to one regime, and which are observational.
    """
    kinds = np.unique(data.regime[data.intervened]).tolist()
    if not kinds or data.intervened.all():
        needed = "rows in which nothing is done, and rows of at least one other regime"
        raise ModelError([f"'permscore' needs {needed}; there are {len(kinds)} other regimes"])
    targets: list[tuple[str, ...]] = [()] * len(data.regimes)
    groups = [~data.intervened, *(data.regime == k for k in kinds)]

    @library("permscore")
    def search(data: Dataset, *, seed: int) -> Bools:
        fitted = import_module("permscore").fit(
            [data.values[rows] for rows in groups], restarts=3, assignment=True, seed=seed
        )
        for number, kind in enumerate(kinds, 1):
            targets[kind] = tuple(data.names[i] for i in sorted(fitted.target_sets[number]))
        return np.asarray(np.array(fitted.graph) != 0)

    blind = replace(data, regimes=(Regime(),) * len(data.regimes))
    return replace(search(blind, seed=seed), targets=tuple(targets))


def edges_of_marks(marks: ArrayLike) -> Bools:
    """Return where i may act on j, by the marks at the ends of edges.

    Two heads within an instant, which PC puts where its tests contradict each other, and two
    circles are an edge without direction.

    Example:
        >>> edges_of_marks([[0, -1], [1, 0]]).tolist()
        [[False, True], [False, False]]
    """
    at = np.array(marks)
    edges: Bools = at != 0
    now, there = (edges, at) if at.ndim == 2 else (edges[0], at[0])
    now &= (there != HEAD) | (there.T == HEAD)
    return edges


def _contradictions(count: int) -> str:
    note = f"{count} edges have no direction, since tests contradict each other"
    return note if count else ""


def _past_first(data: Dataset) -> Any:
    """Return the knowledge for PC that later columns do not act on earlier ones, or None."""
    lags = [column.lag for column in data.columns]
    if len(set(lags)) < 2:
        return None
    knowledge = import_module("causallearn.utils.PCUtils.BackgroundKnowledge").BackgroundKnowledge()
    node = import_module("causallearn.graph.GraphNode").GraphNode
    for i, lag in enumerate(lags):
        knowledge.add_node_to_tier(node(f"X{i + 1}"), max(lags) - lag)  # the names PC gives
    return knowledge


@contextmanager
def _later_ends_are_heads(library: Any, data: Dataset) -> Iterator[None]:
    """Return the knowledge for FCI that later columns do not act on earlier ones.

    Its ``BackgroundKnowledge`` would make the earlier end of such an edge a tail, and refuse a head
    there (https://github.com/py-why/causal-learn/issues/266): both are false where a hidden cause
    acts on both. Instead, whenever it makes all marks circles, the later ends become heads.
    """
    lags, edge_of = [column.lag for column in data.columns], import_module("causallearn.graph.Edge")
    reset, head = library.reorientAllWith, library.Endpoint.ARROW

    def reset_all_but_heads(graph: Any, endpoint: Any) -> None:
        reset(graph, endpoint)
        lag_of = {node: lags[number] for node, number in graph.get_node_map().items()}
        for edge in graph.get_graph_edges():
            late, early = sorted((edge.get_node1(), edge.get_node2()), key=lag_of.__getitem__)
            if lag_of[late] < lag_of[early]:
                graph.remove_edge(edge)
                graph.add_edge(edge_of.Edge(early, late, endpoint, head))

    library.reorientAllWith = reset_all_but_heads
    try:
        yield
    finally:
        library.reorientAllWith = reset


def likelihood_gain(data: Dataset, edges: Bools) -> Floats:
    """Compute by how much the likelihood falls if an edge is taken away.

    Each column is regressed on all columns with an edge to it, in the rows where it was not set;
    noise is Gaussian. Taking column i away from the regression of j multiplies its sum of squares
    by 1 + b² / (v s), with b the coefficient of i, s the sum of squares and v the entry of i in the
    inverse of the matrix of the regression.

    For an edge without direction the smaller gain counts.

    Source:
        Seber and Lee, *Linear Regression Analysis*, 2003, chapter 4: the F-test of one coefficient.
    """
    gain, tiny = np.zeros(edges.shape), np.finfo(float).tiny
    for j in range(len(edges)):
        parents, rows = np.flatnonzero(edges[:, j]), ~data.targeted[:, j]
        if len(parents) and rows.sum() > len(parents) + 1:
            x, y = data.values[rows][:, parents], data.values[rows, j]
            x, y = x - x.mean(axis=0), y - y.mean()
            inverse = np.linalg.pinv(x.T @ x)
            weight = inverse @ (x.T @ y)
            left = max(float(np.sum((y - x @ weight) ** 2)), 1e-16 * float(y @ y), tiny)
            ratio = weight**2 / (np.maximum(np.diag(inverse), tiny) * left)
            gain[parents, j] = 0.5 * len(y) * np.log1p(ratio)
    return np.where(edges & edges.T, np.minimum(gain, gain.T), gain)


# --- through time ---------------------------------------------------------------------------------


@library("pcmci+", least=1)
def pcmci_plus(data: Dataset, *, seed: int = 0, alpha: float = 0.01, tau_max: int = 1) -> Any:
    """Find a graph within the instant and over time by tests of partial correlation.

    Columns that never change within an episode are the same at every lag. They act with lag 1 on
    those that do, which do not act on them. Rows in which something is done are left out, and a
    new series starts after them.
    """
    parts, still = _series("pcmci+", data, tau_max)
    links = _allowed_links(still, tau_max, "-")
    search = _tigramite("pcmci", "PCMCI", parts).run_pcmciplus
    return _read(search(link_assumptions=links, tau_max=tau_max, pc_alpha=alpha))


@library("lpcmci", marked=True, least=1)
def lpcmci(data: Dataset, *, seed: int = 0, alpha: float = 0.01, tau_max: int = 1) -> Any:
    """Find a partial ancestral graph over time by tests of partial correlation (LPCMCI).

    Causes may be hidden. Rows and columns that never change are used as in ``pcmci_plus``.
    """
    parts, still = _series("lpcmci", data, tau_max)
    result = _tigramite("lpcmci", "LPCMCI", parts).run_lpcmci(
        link_assumptions=_allowed_links(still, tau_max, "o"), tau_max=tau_max, pc_alpha=alpha,
        n_preliminary_iterations=1,
    )  # fmt: skip
    return _read(result)


@library("j-pcmci+", least=1)
def jpcmci_plus(data: Dataset, *, seed: int = 0, alpha: float = 0.01, tau_max: int = 1) -> Any:
    """Find a graph over time from episodes whose circumstances are partly hidden (J-PCMCI+).

    One further node stands for all differences between episodes that have no column; the tests
    condition on it, and a note names the columns on which it acts. Columns that never change within
    an episode are contexts: they act with lag 1 on others, and nothing acts on them. It needs two
    episodes or more.
    """
    parts, still = _series("j-pcmci+", data, tau_max)
    if len(parts) < 2:
        raise ModelError(["'j-pcmci+' compares episodes; give two or more of several rows"])
    p = len(still)
    kinds = {i: "space_context" if still[i] else "system" for i in range(p)}
    which = np.eye(len(parts))
    both = [np.hstack([part, np.tile(which[k], (len(part), 1))]) for k, part in enumerate(parts)]
    vectors = {i: [(i, 0)] for i in range(p)} | {p: [(p + k, 0) for k in range(len(parts))]}
    jpcmci = _tigramite(
        "jpcmciplus", "JPCMCIplus", both, vectors, node_classification={**kinds, p: "space_dummy"}
    )
    result = jpcmci.run_jpcmciplus(tau_max=tau_max, pc_alpha=alpha)
    graph, chances = result["graph"], result["p_matrix"]
    moved = [data.names[j] for j in np.flatnonzero(graph[p, :p, 0] == "-->").tolist()]
    note = f"an unmeasured variable acts on {', '.join(moved)} and differs between episodes"
    graph, chances = graph[:p, :p], chances[:p, :p]
    for matrix, nothing in ((graph, ""), (chances, 1.0)):
        matrix[still, :, 1] = matrix[still, :, 0]
        matrix[still, :, 0] = matrix[:, still, 0] = nothing
    return _read({"graph": graph, "p_matrix": chances}, note if moved else "")


def _series(learner: str, data: Dataset, tau_max: int) -> tuple[list[Floats], Bools]:
    """Return the parts of a table that are long enough, and which columns never change in one."""
    parts = [part for part in runs(data) if len(part) > 2 * tau_max]
    whole, least = sum(len(part) - 2 * tau_max for part in parts), len(data.names) * (tau_max + 1)
    if whole <= least:
        needed = f"more than {least} rows with {2 * tau_max} rows before them"
        raise ModelError([f"{learner!r} needs {needed}, for as many columns and lags; got {whole}"])
    return parts, np.all([np.ptp(part, axis=0) < STILL for part in parts], axis=0)


def _read(result: Mapping[str, Any], note: str = "") -> tuple[Marks, Floats, tuple[str, str]]:
    """Read the result of a search of tigramite: marks, -log10 of the chances, notes."""
    graph = result["graph"]
    scores = -np.log10(np.clip(np.moveaxis(result["p_matrix"], 2, 0), 1e-300, 1.0))
    contrary = sum("x" in word for word in np.ravel(graph[:, :, 0])) // 2
    return marks_of_links(graph), scores, (note, _contradictions(contrary))


def _tigramite(
    module: str, name: str, parts: list[Floats], vectors: object = None, **more: object
) -> Any:
    """Make a search of tigramite on series, by partial correlation."""
    several = len(parts) > 1
    frame = import_module("tigramite.data_processing").DataFrame(
        dict(enumerate(parts)) if several else parts[0],
        analysis_mode="multiple" if several else "single",
        **({} if vectors is None else {"vector_vars": vectors}),
    )
    test = import_module("tigramite.independence_tests.parcorr").ParCorr()
    if vectors is not None:
        test = import_module("tigramite.independence_tests.parcorr_mult").ParCorrMult()
    make = getattr(import_module(f"tigramite.{module}"), name)
    return make(dataframe=frame, cond_ind_test=test, verbosity=0, **more)


def _allowed_links(still: Bools, tau_max: int, end: str) -> dict[int, dict[tuple[int, int], str]]:
    """Return the allowed links: by effect; cause and negative lag; ``end`` is its mark."""
    links: dict[int, dict[tuple[int, int], str]] = {}
    for j, j_still in enumerate(still):
        links[j] = {(i, 0): "o?o" for i in np.flatnonzero(still == j_still).tolist() if i != j}
        for i, i_still in enumerate(still):
            longest = 0 if j_still else 1 if i_still else tau_max
            links[j].update({(i, -lag): f"{end}?>" for lag in range(1, longest + 1)})
    return links


def runs(data: Dataset) -> list[Floats]:
    """Cut rows where they do not follow one another; parts have shape (n, p)."""
    follows = (np.diff(data.episode) == 0) & (np.diff(data.step) == 1)
    return np.split(data.values, np.flatnonzero(~follows) + 1)


def marks_of_links(graph: ArrayLike) -> Marks:
    """Read the links of tigramite, shape (p, p, lags + 1), as marks, shape (lags + 1, p, p).

    The first sign of a word such as ``"o->"`` at [i, j, lag] is the mark at i. An ``x``, where
    tests contradict each other, is a circle.
    """
    sign = {"": 0, "<": HEAD, "-": TAIL, "o": CIRCLE, "x": CIRCLE}
    words = np.moveaxis(np.array(graph, dtype=str), 2, 0)
    return np.array([sign[word[:1]] for word in words.ravel()], np.int8).reshape(words.shape)


# --- data and calls -------------------------------------------------------------------------------


def usable(learner: str, data: Dataset, *, done: bool = False) -> tuple[Dataset, tuple[str, ...]]:
    """Return standardised rows and columns that a learner can use, and notes on the others.

    Where columns are linear functions of one another, earlier control steps are kept rather than
    later ones, then columns on the left. Without a result its causes are still seen together;
    without a cause its results would seem to be tied.

    Rows in which something is done are left out, unless it uses them (``done``). So are those in
    which a variable was set that is in no column, always.
    """
    what = "a variable that is in no column was set" if done else "something is done"
    rows = data.rows(~data.hidden_targets) if done else data.observational
    if len(rows) == 0:
        raise ModelError([f"{learner!r} uses no rows in which {what}, and has no other rows"])
    values = rows.standardised().values
    varying = np.flatnonzero(values.any(axis=0))
    if len(rows) <= len(varying):
        given = f"{len(rows)} rows and {len(varying)} columns that vary"
        raise ModelError([f"{learner!r} needs more rows than columns; there are {given}"])
    lags = np.array([rows.columns[i].lag for i in varying], dtype=np.int64)
    order = varying[np.argsort(-lags, kind="stable")]
    kept = np.sort(order[independent(values[:, order])])
    left, names = len(data) - len(rows), np.array(data.names, dtype=object)
    notes = [f"{left} of {len(data)} rows were left out: {what} in them"] * bool(left)
    constant = np.delete(np.arange(len(names)), varying)
    for what, which in (
        ("taken for real numbers", [i for i in kept if data.columns[i].dtype != "real"]),
        ("without edges, since they do not vary", constant),
        ("without edges, since other columns determine them", np.setdiff1d(varying, kept)),
    ):
        if len(which):
            more = f" and {len(which) - SHOWN} more" if len(which) > SHOWN else ""
            notes.append(f"{what}: {', '.join(names[which[:SHOWN]])}{more}")
    return rows.select([rows.names[i] for i in kept]).standardised(), tuple(notes)


def independent(values: Floats) -> Integers:
    """List the columns that are not linear functions of those before them, by number.

    ``values``, shape (n, p), have mean 0 and variance 1.
    """
    n, p = values.shape
    basis = np.zeros((n, p))
    kept: list[int] = []
    for column in range(p):
        q = basis[:, : len(kept)]
        rest = values[:, column]
        for _ in range(2):  # once is not exact enough: Parlett, The Symmetric Eigenvalue Problem
            rest = rest - q @ (q.T @ rest)
        length = float(np.linalg.norm(rest))
        if length > DEPENDENT * float(np.linalg.norm(values[:, column])):
            basis[:, len(kept)] = rest / length
            kept.append(column)
    return np.array(kept, dtype=np.int64)


@contextmanager
def _quietly(learner: str, seed: int) -> Iterator[None]:
    """Run another library seeded, silent, and with its errors as ``ModelError``."""
    python = random.getstate()  # some libraries draw from the global generators
    numpy = np.random.get_state()  # noqa: NPY002 # not ours: it is put back
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002 # the libraries draw from this one
    try:
        with (
            redirect_stdout(StringIO()),
            redirect_stderr(StringIO()),
            warnings.catch_warnings(),
            np.errstate(all="ignore"),
        ):
            warnings.simplefilter("ignore")
            yield
    except ScmWorldError:
        raise
    except (ArithmeticError, AssertionError, IndexError, ValueError) as error:
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ModelError(
            [f"the library behind {learner!r} cannot use these data: {said}; try fewer columns"]
        ) from error
    finally:
        random.setstate(python)
        np.random.set_state(numpy)  # noqa: NPY002
