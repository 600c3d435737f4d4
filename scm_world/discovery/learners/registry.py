"""Learners under one call, ours and others', and how to add one's own."""

from __future__ import annotations

import importlib.metadata
import inspect
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal, final

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import one_of, typed, whole_number
from scm_world._plugins import Plugins
from scm_world.discovery.data.dataset import Dataset, block
from scm_world.discovery.learners.found import EstimatedGraph
from scm_world.errors import MissingExtra, ModelError, UnknownOption, blamed
from scm_world.graph.ancestral import CIRCLE
from scm_world.tasks.sources import load_named
from scm_world.variables import Noise

if TYPE_CHECKING:
    from scm_world.discovery.learners.paired import PairedSimulator

Source = Literal["observational", "interventional", "paired"]
SOURCES: tuple[Source, ...] = ("observational", "interventional", "paired")


@typed
@final
@dataclass(frozen=True)
class Learner:
    """Something that turns data into a graph.

    Attributes:
        name: To call it by.
        learn: ``learn(data, seed=0, **settings)`` gives an ``EstimatedGraph``, or a matrix of shape
            (p, p) over the columns of the data: not zero at [i, j] where i acts on j; both ways for
            an edge without direction; or a networkx graph of columns, or of variables. ``data`` is
            a ``Dataset``, or a ``PairedSimulator`` for ``"paired"``.
        takes: The kinds of data it can use: ``"observational"``, ``"interventional"`` (known
            targets), ``"paired"`` (it does its own experiments, with the same noise).
        temporal: Whether it uses the order of the rows by itself. Others are handed earlier control
            steps as further columns.
        extra: The optional dependency it needs; empty if none.
        package: Whose version is recorded, and whose absence is reported.
        doc: In one line; the first one of the function's docstring if empty.
        baseline: Whether it is a trivial one, to compare others with.
        marked: Whether it allows for hidden causes: its graphs have edge ``marks``, and are
            compared with a partial ancestral graph.
    """

    name: str
    learn: Callable[..., Any]
    takes: tuple[Source, ...] = ("observational", "interventional")
    temporal: bool = False
    extra: str = ""
    package: str = ""
    doc: str = ""
    baseline: bool = False
    marked: bool = False

    def __post_init__(self) -> None:
        if not self.doc:
            said = (inspect.getdoc(self.learn) or "").partition("\n")[0]
            object.__setattr__(self, "doc", said)

    @property
    def version(self) -> str | None:
        """Version of its package; None if that is not installed, or if it needs none."""
        try:
            return importlib.metadata.version(self.package) if self.package else None
        except importlib.metadata.PackageNotFoundError:
            return None

    @property
    def is_installed(self) -> bool:
        """Whether its package is installed."""
        return not self.package or self.version is not None


_KNOWN: dict[str, Learner] = {}


@typed
def register(learner: Learner) -> Learner:
    """Make a learner known by its name.

    What an installed package declares as an entry point of the group ``scm_world.learners``, a
    ``Learner`` or a function, is known everywhere by the name of the entry point.

    Raises:
        UnknownOption: Another one has this name.
    """
    old = _KNOWN.get(learner.name)
    if old is not None and old.learn is not learner.learn:
        raise UnknownOption("name of a learner", learner.name, ("a name that is not taken",))
    _KNOWN[learner.name] = learner
    return learner


def learners() -> Plugins[Learner]:
    """Return all learners that are known, by name."""
    import_module(f"{__package__}.known")
    return Plugins("learners", dict(_KNOWN), lambda name, f: replace(_made(name, f), name=name))


def _made(name: str, found: Any) -> Learner:
    """Return a learner, or that of a function, which is called ``name``."""
    if not (isinstance(found, Learner) or callable(found)):
        raise UnknownOption("learner", name, ("a Learner or a function",))
    return found if isinstance(found, Learner) else Learner(name, found)


def baselines() -> tuple[str, ...]:
    """Return the names of the trivial learners that belong beside every score.

    Those of other packages are baselines if they are registered.

    Example:
        >>> baselines()
        ('empty', 'complete', 'bipartite', 'roles', 'all_or_nothing', 'correlation',
         'sort_regress')
    """
    return tuple(name for name, known in learners().known.items() if known.baseline)


@typed
def learner(name: str) -> Learner:
    """Find a learner by its name, or by where a ``Learner`` or a function is.

    A function is taken for one that uses observational and interventional data.

    Args:
        name: Name of a known one, ``"module:attribute"``, or ``"path/file.py:attribute"``.

    Raises:
        UnknownOption: No learner has this name.
        ModelError: The module raised an error.
    """
    if ":" not in name:
        known = learners()
        if name not in known:
            raise UnknownOption("learner", name, (*known, "module:attribute", "file.py:attribute"))
        return known[name]
    return _made(name, load_named(name, "learner"))


@typed
def learn(
    given: Learner | str,
    data: Dataset | PairedSimulator,
    *,
    seed: int = 0,
    shuffle: bool = True,
    **settings: object,
) -> EstimatedGraph:
    """Estimate a graph with a learner.

    A table has its columns in the order in which variables were declared, causes before effects,
    and the result of many searches depends on it. So the learner is given them in an order that
    is drawn from the seed; the graph has them in the order of the table.

    Args:
        given: A learner, or its name.
        data: A ``Dataset``, or a ``PairedSimulator`` for a learner that does its own experiments.
            Earlier control steps are put beside each row of a dataset with several rows per
            episode, if the learner does not use time by itself. Where they stand there already
            (``lagged``), the graph is one among these columns, as is the truth of such a table.
        seed: Seed of the learner, and of the order of the columns.
        shuffle: Whether the order of the columns is drawn; False to keep that of the table.
        settings: Settings of the learner.

    Raises:
        UnknownOption: Learner or setting is unknown, or the seed is not a number from 0.
        MissingExtra: Its library is not installed.
        ModelError: It cannot use such data, or did not return a graph of these columns.

    Source:
        https://github.com/felixleopoldo/benchpress/issues/129: results of a benchmark whose columns
        were in causal order.
    """
    whole_number("seed", seed, least=0)
    chosen = given if isinstance(given, Learner) else learner(given)
    whole = table = _table(chosen, settings, data)
    has_past = table is not None and any(column.lag for column in table.columns)
    if table is not None:
        if shuffle:
            drawn = Noise(seed).uniforms("order of columns", n=len(table.names))[0]
            table = table.select([table.names[i] for i in np.argsort(drawn).tolist()])
        if table.is_temporal and not (chosen.temporal or has_past):
            table = table.lagged()
    started = time.perf_counter()
    with blamed(f"the learner {chosen.name!r}"):
        found = chosen.learn(data if table is None else table, seed=int(seed), **settings)
    seconds = time.perf_counter() - started
    if table is None and not isinstance(found, EstimatedGraph):
        raise ModelError([f"the learner {chosen.name!r} has to give an EstimatedGraph"])
    if whole is not None and table is not None:
        try:
            if not isinstance(found, EstimatedGraph):
                of_variables = isinstance(found, nx.Graph) and {*map(str, found)} <= {*table.blocks}
                found = EstimatedGraph.of(
                    tuple(table.blocks) if of_variables else table.names, found
                )
            found = _folded(found, table, past=not has_past)
        except ModelError as error:
            said = f"the learner {chosen.name!r} returned no graph: "
            raise ModelError([said + each for each in error.problems]) from error
        place: dict[str, int] = {}
        for i, column in enumerate(whole.columns):
            for name in (column.name, block(column), column.variable, column.name.split("@-")[0]):
                place.setdefault(name, i)
        found = found.restricted(sorted(found.names, key=place.__getitem__))
    version = {chosen.package: chosen.version or ""} if chosen.package else {}
    made: EstimatedGraph = found
    return replace(
        made,
        learner=chosen.name,
        settings={**made.settings, **settings},
        seconds=seconds,
        experiments=made.experiments if whole is None else len(whole),
        versions={**made.versions, **version},
    )


def _table(chosen: Learner, settings: Mapping[str, object], data: object) -> Dataset | None:
    """Return the table that is learned from; refuse settings, data, and a missing library."""
    parameters: list[inspect.Parameter] = []
    with suppress(TypeError, ValueError):  # a function that is not of Python
        parameters = [*inspect.signature(chosen.learn).parameters.values()][1:]
    if parameters and all(each.kind != each.VAR_KEYWORD for each in parameters):
        for name in settings:
            one_of(f"setting of {chosen.name!r}", name, [each.name for each in parameters])
    if not chosen.is_installed:
        raise MissingExtra(chosen.package, chosen.extra)
    if not isinstance(data, Dataset):
        if "paired" in chosen.takes:
            return None
        raise ModelError([f"{chosen.name} learns from a Dataset, not from {type(data).__name__}"])
    if not data.values.size:
        size = f"{len(data)} rows and {len(data.columns)} columns"
        raise ModelError([f"there is nothing to learn from: the table has {size}"])
    if chosen.takes == ("paired",):
        raise ModelError([f"{chosen.name} does its own experiments: it cannot use a Dataset"])
    if chosen.temporal and any(column.lag for column in data.columns):
        raise ModelError([f"{chosen.name} uses time by itself: give the table without lagged()"])
    return data


def _folded(found: EstimatedGraph, table: Dataset, *, past: bool) -> EstimatedGraph:
    """Take the columns of a variable together, and with ``past`` earlier columns as lags."""
    columns = {column.name: column for column in table.columns}
    unknown = [name for name in found.names if name not in columns]
    if unknown and set(found.names) <= set(table.blocks):
        return found  # it speaks of variables already
    if unknown:
        what = f"a learner found a graph of {unknown[0]!r}, which is not in the data"
        raise ModelError([f"{what}; there are: {', '.join(table.names)}"])
    base = [block(columns[n]) for n in found.names]
    steps_back = np.array([columns[n].lag for n in found.names])
    lag_of = steps_back * past
    if past:
        base = [name.removesuffix(f"@-{lag}") for name, lag in zip(base, lag_of, strict=True)]
    names = tuple(dict.fromkeys(base))
    at = np.array([names.index(name) for name in base])
    lags = max(int(lag_of.max(initial=0)), len(found.edges) - 1)
    shape = (lags + 1, len(names), len(names))
    lag, i, j = np.indices(found.edges.shape).reshape(3, -1)

    def placed(i: NDArray[np.int64], j: NDArray[np.int64]) -> tuple[Any, Any]:
        """Return which entries are about the present, and their places among the variables."""
        total = lag + lag_of[i]
        kept = (lag_of[j] == 0) & (total <= lags) & ((total > 0) | (at[i] != at[j]))
        return kept, (total[kept], at[i[kept]], at[j[kept]])

    back = (lag == 0) & (steps_back[i] < steps_back[j])  # into the past: these edges are turned
    kept, places = placed(np.where(back, j, i), np.where(back, i, j))
    edges, scores = np.zeros(shape, bool), np.zeros(shape)
    np.logical_or.at(edges, places, found.edges.ravel()[kept])
    np.maximum.at(scores, places, found.edge_scores.ravel()[kept])
    if found.marks is None:
        return replace(found, names=names, edges=edges, edge_scores=scores)
    # Edges between the same two variables have one mark at each end: a circle if they differ.
    kept, places = placed(i, j)
    given = found.marks.ravel()[kept]
    there = given != 0
    places = tuple(place[there] for place in places)
    low, high = np.full(shape, 9, np.int8), np.full(shape, -9, np.int8)
    np.minimum.at(low, places, given[there])
    np.maximum.at(high, places, given[there])
    marks = np.where(low == high, low, np.where(low > high, 0, CIRCLE))
    return replace(
        EstimatedGraph.of_marks(names, marks, edge_scores=np.where(marks, scores, 0.0)),
        **{k: getattr(found, k) for k in ("settings", "notes", "experiments", "bound", "versions")},
    )
