"""Learners under one call, ours and others', and how to add one's own."""

from __future__ import annotations

import importlib.metadata
import inspect
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any, Literal, final

import numpy as np

from scm_world._arguments import typed, whole_number
from scm_world.discovery.data.dataset import Dataset, Level, block
from scm_world.discovery.learners.found import EstimatedGraph
from scm_world.errors import MissingExtra, ModelError, UnknownOption, blamed
from scm_world.graph.ancestral import CIRCLE
from scm_world.tasks.factories import load_named
from scm_world.variables import Noise

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
            an edge without direction. ``data`` is a ``Dataset``, or a ``PairedSimulator`` for
            ``"paired"``.
        takes: The kinds of data it can use: ``"observational"``, ``"interventional"`` (known
            targets), ``"paired"`` (it does its own experiments, with the same noise).
        claims: Whether it is given the true graph, to check it; it cannot be benchmarked.
        on: What its own experiments are done on: ``"any"`` simulator, or ``"models"`` whose
            variables are numbers.
        temporal: Whether it uses the order of the rows by itself. Others are handed earlier control
            steps as further columns.
        extra: The optional dependency it needs; empty if none.
        package: Whose version is recorded, and whose absence is reported.
        doc: In one line.
        baseline: Whether it is a trivial one, to compare others with.
        marked: Whether it allows for hidden causes: its graphs have edge ``marks``, and are
            compared with a partial ancestral graph.
    """

    name: str
    learn: Callable[..., Any]
    takes: tuple[Source, ...] = ("observational", "interventional")
    on: Literal["any", "models"] = "any"
    claims: bool = False
    temporal: bool = False
    extra: str = ""
    package: str = ""
    doc: str = ""
    baseline: bool = False
    marked: bool = False

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

    Raises:
        UnknownOption: Another one has this name.
    """
    old = _KNOWN.get(learner.name)
    if old is not None and old.learn is not learner.learn:
        raise UnknownOption("name of a learner", learner.name, ("a name that is not taken",))
    _KNOWN[learner.name] = learner
    return learner


def learners() -> Mapping[str, Learner]:
    """Return all learners that are known, by name."""
    import_module(f"{__package__}.known")
    return dict(_KNOWN)


def baselines() -> tuple[str, ...]:
    """Return the names of the trivial learners that belong beside every score.

    Example:
        >>> baselines()
        ('empty', 'complete', 'bipartite', 'roles', 'all_or_nothing', 'correlation',
         'sort_regress')
    """
    return tuple(name for name, known in learners().items() if known.baseline)


@typed
def learner(name: str) -> Learner:
    """Find a learner by its name, or by where a ``Learner`` or a function is.

    A function is taken for one that uses observational and interventional data.

    Args:
        name: Of a known one, ``"module:attribute"``, or ``"path/file.py:attribute"``.

    Raises:
        UnknownOption: There is none.
        ModelError: The module raised an error.
    """
    if not isinstance(name, str):
        raise UnknownOption("learner", name, ("the name of a learner", "a Learner"))
    if ":" not in name:
        known = learners()
        if name not in known:
            raise UnknownOption("learner", name, (*known, "module:attribute", "file.py:attribute"))
        return known[name]
    found = load_named(name, "learner")
    if isinstance(found, Learner):
        return found
    if not callable(found):
        raise UnknownOption("learner", name, ("a Learner or a function",))
    return Learner(name, found)


@typed
def learn(
    given: Learner | str,
    data: Any,
    *,
    seed: int = 0,
    level: Level = "variable",
    shuffle: bool = True,
    **settings: Any,
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
        seed: Of what the learner draws, and of the order of the columns.
        level: ``"variable"`` for one node per variable, its components taken together;
            ``"component"`` for one per column.
        shuffle: Whether the order of the columns is drawn; False to keep that of the table.
        settings: Of the learner.

    Raises:
        UnknownOption: There is no such learner or setting, or the seed is no whole number from 0.
        MissingExtra: What it needs is not installed.
        ModelError: It cannot use such data, or gave something that is no graph of these columns.

    Source:
        https://github.com/felixleopoldo/benchpress/issues/129: results of a benchmark whose columns
        were in causal order.
    """
    whole_number("seed", seed, least=0)
    chosen = given if isinstance(given, Learner) else learner(given)
    known = _settings_of(chosen)
    _check(chosen, known, settings, data)
    table = data
    has_past = isinstance(data, Dataset) and any(column.lag for column in data.columns)
    if has_past and chosen.temporal:
        raise ModelError([f"{chosen.name} uses time by itself: give the table without lagged()"])
    if isinstance(data, Dataset):
        if shuffle:
            drawn = Noise(seed).uniforms("order of columns", n=len(data.names))[0]
            table = data.select([data.names[i] for i in np.argsort(drawn).tolist()])
        if data.is_temporal and not (chosen.temporal or has_past):
            table = table.lagged()
    if "blocks" in known:  # groups that are distinguished are tested separately
        settings = {"blocks": level == "variable", **settings}
    started = time.perf_counter()
    with blamed(f"the learner {chosen.name!r}"):
        result = chosen.learn(table, seed=whole_number("seed", seed, least=0), **settings)
    seconds = time.perf_counter() - started
    if not isinstance(result, EstimatedGraph) and not isinstance(table, Dataset):
        raise ModelError([f"the learner {chosen.name!r} has to give an EstimatedGraph"])
    try:
        found: EstimatedGraph = result
        if not isinstance(result, EstimatedGraph):
            found = EstimatedGraph.of(table.names, result)
        if isinstance(table, Dataset):
            found = _folded(found, table, level, past=not has_past)
    except ModelError as error:
        said = (f"the learner {chosen.name!r} returned no graph: {each}" for each in error.problems)
        raise ModelError([*said]) from error
    if isinstance(table, Dataset):
        place: dict[str, int] = {}
        for i, column in enumerate(data.columns):
            for name in (column.name, block(column), column.variable, column.name.split("@-")[0]):
                place.setdefault(name, i)
        found = found.restricted(sorted(found.names, key=place.__getitem__))
    version = {chosen.package: chosen.version or ""} if chosen.package else {}
    return replace(
        found,
        learner=chosen.name,
        settings={**found.settings, **settings},
        seconds=seconds,
        experiments=len(data) if isinstance(data, Dataset) else found.experiments,
        versions={**found.versions, **version},
    )


def _check(chosen: Learner, known: tuple[str, ...], settings: Iterable[str], data: Any) -> None:
    """Refuse settings that do not exist, a missing library, and data of another kind."""
    for name in settings:
        if known and name not in known:
            raise UnknownOption(f"setting of {chosen.name!r}", name, known)
    if not chosen.is_installed:
        raise MissingExtra(chosen.package, chosen.extra)
    what = type(data).__name__
    if isinstance(data, Dataset):
        if chosen.takes == ("paired",):
            raise ModelError([f"{chosen.name} does its own experiments: it cannot use a Dataset"])
    elif "paired" not in chosen.takes:
        raise ModelError([f"{chosen.name} learns from a Dataset, not from {what}"])
    elif chosen.on == "models" and not hasattr(data, "answers"):
        raise ModelError([f"{chosen.name} moves several numbers at once, on models; not on {what}"])


def _settings_of(chosen: Learner) -> tuple[str, ...]:
    """Return the names of its settings; none if it takes any."""
    try:
        parameters = inspect.signature(chosen.learn).parameters.values()
    except (TypeError, ValueError):  # a function that is not of Python
        return ()
    if any(parameter.kind == parameter.VAR_KEYWORD for parameter in parameters):
        return ()
    return tuple(parameter.name for parameter in parameters)[1:]


def _folded(
    found: EstimatedGraph, table: Dataset, level: Level, *, past: bool = True
) -> EstimatedGraph:
    """Take the columns of a variable together, and with ``past`` earlier columns as lags."""
    columns = {column.name: column for column in table.columns}
    unknown = [name for name in found.names if name not in columns]
    if unknown and set(found.names) <= set(table.blocks):
        return found  # it speaks of variables already
    if unknown:
        what = f"a learner found a graph of {unknown[0]!r}, which is not in the data"
        raise ModelError([f"{what}; there are: {', '.join(table.names)}"])
    base = [block(columns[n]) if level == "variable" else n for n in found.names]
    if past:
        lagless = zip(base, found.names, strict=True)
        base = [name.removesuffix(f"@-{columns[n].lag}") for name, n in lagless]
    lag_of = np.array([columns[n].lag if past else 0 for n in found.names])
    names = tuple(dict.fromkeys(base))
    at = np.array([names.index(name) for name in base])
    lags = max(int(lag_of.max(initial=0)), len(found.edges) - 1)
    edges = np.zeros((lags + 1, len(names), len(names)), bool)
    edge_scores = np.zeros(edges.shape)
    now = np.flatnonzero(lag_of == 0)
    # Edges within the rows that would lead into the past are turned.
    steps_back = np.array([columns[n].lag for n in found.names])
    back = steps_back[:, None] < steps_back[None, :]
    given, sure = found.edges.copy(), found.edge_scores.copy()
    given[0] |= (given[0] & back).T
    sure[0] = np.maximum(sure[0], np.where(back, sure[0], 0.0).T)
    given[0][back], sure[0][back] = False, 0.0
    for lag, row in ((k, i) for k in range(len(found.edges)) for i in range(len(at))):
        total = lag + int(lag_of[row])
        if total > lags:
            continue
        np.logical_or.at(edges[total, at[row]], at[now], given[lag, row, now])
        np.maximum.at(edge_scores[total, at[row]], at[now], sure[lag, row, now])
    np.fill_diagonal(edges[0], False)
    np.fill_diagonal(edge_scores[0], 0.0)
    made = replace(found, names=names, edges=edges, edge_scores=edge_scores, marks=None)
    if found.marks is None:
        return made
    # Edges between the same two variables have one mark at each end: a circle if they differ.
    seen: dict[tuple[int, int, int], set[int]] = {}
    for lag, i, j in np.argwhere(found.marks != 0).tolist():
        steps, one, other = lag + int(lag_of[i] - lag_of[j]), int(at[i]), int(at[j])
        if lag_of[j] == 0 and steps <= lags and (steps or one != other):
            seen.setdefault((steps, one, other), set()).add(int(found.marks[lag, i, j]))
    marks = np.zeros(edges.shape, np.int8)
    for place, each in seen.items():
        marks[place] = each.pop() if len(each) == 1 else CIRCLE
    return replace(
        EstimatedGraph.of_marks(names, marks, edge_scores=np.where(marks, edge_scores, 0.0)),
        **{k: getattr(found, k) for k in ("settings", "notes", "experiments", "bound", "versions")},
    )
