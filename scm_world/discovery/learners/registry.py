"""Learners under one call, ours and others', and how to add one's own."""

from __future__ import annotations

import importlib.metadata
import inspect
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal, final

import numpy as np
from numpy.typing import NDArray

from scm_world.discovery.data.dataset import Dataset, Level
from scm_world.discovery.learners.found import Found
from scm_world.errors import MissingExtra, ModelError, UnknownOption

Source = Literal["observational", "interventional", "paired"]
SOURCES: tuple[Source, ...] = ("observational", "interventional", "paired")


@final
@dataclass(frozen=True)
class Learner:
    """Something that turns data into a graph.

    Attributes:
        name: To call it by.
        learn: ``learn(data, seed=0, **settings)`` gives a ``Found``, or a matrix of shape (p, p)
            over the columns of the data: not zero at [i, j] where i acts on j; both ways for an
            edge without direction. ``data`` is a ``Dataset``, or a ``PairedSimulator`` for
            ``"paired"``.
        takes: The kinds of data it can use: ``"observational"``, ``"interventional"`` (known
            targets), ``"paired"`` (it does its own experiments, with the same noise).
        claims: Whether it is given the true graph, to check it; it cannot be benchmarked.
        on: What its own experiments are done on: ``"any"`` simulator, ``"models"`` whose variables
            are numbers, or ``"worlds"`` for a graph of their bodies.
        temporal: Whether it uses the order of the rows by itself. Others are handed earlier control
            steps as further columns.
        extra: The optional dependency it needs; empty if none.
        package: Whose version is noted, and whose absence is told.
        doc: In one line.
    """

    name: str
    learn: Callable[..., Any]
    takes: tuple[Source, ...] = ("observational", "interventional")
    on: Literal["any", "models", "worlds"] = "any"
    claims: bool = False
    temporal: bool = False
    extra: str = ""
    package: str = ""
    doc: str = ""

    @property
    def version(self) -> str | None:
        """Of the package that it needs; None if that is not installed, or if it needs none."""
        return _version(self.package) if self.package else None

    @property
    def is_installed(self) -> bool:
        """Whether what it needs is there."""
        return not self.package or self.version is not None


_KNOWN: dict[str, Learner] = {}

HOMES = ("ours", "others")
"""Modules of this package that register learners when they are imported."""


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
    """Give all learners that are known, by name."""
    for home in HOMES:
        import_module(f"{__package__}.{home}")
    return dict(_KNOWN)


def learner(name: str) -> Learner:
    """Find a learner.

    Args:
        name: One that is known, or ``"module:attribute"``: a ``Learner``, or a function that is
            taken for one that uses observational and interventional data.

    Raises:
        UnknownOption: There is none.
    """
    if ":" in name:
        return _imported(name)
    known = learners()
    if name not in known:
        raise UnknownOption("learner", name, (*known, "module:attribute"))
    return known[name]


def _imported(name: str) -> Learner:
    module, _, attribute = name.partition(":")
    try:
        found = getattr(import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        allowed = (f"module:attribute of a module that can be imported ({error})",)
        raise UnknownOption("learner", name, allowed) from None
    if isinstance(found, Learner):
        return found
    if not callable(found):
        raise UnknownOption("learner", name, ("a Learner or a function",))
    return Learner(name, found)


def learn(
    given: Learner | str, data: Any, *, seed: int = 0, level: Level = "variable", **settings: Any
) -> Found:
    """Let a learner find a graph.

    Args:
        given: A learner, or its name.
        data: A ``Dataset``, or a ``PairedSimulator`` for a learner that does its own experiments.
            Earlier control steps are put beside each row of a dataset with several rows per
            episode, if the learner does not use time by itself.
        seed: Of what the learner draws.
        level: ``"variable"`` for one node per variable, its components taken together;
            ``"component"`` for one per column.
        settings: Of the learner.

    Raises:
        UnknownOption: There is no such learner.
        MissingExtra: What it needs is not installed.
        ModelError: It gave something that is no graph of these columns.
    """
    chosen = learner(given) if isinstance(given, str) else given
    if not chosen.is_installed:
        raise MissingExtra(chosen.package, chosen.extra)
    _refuse_other(chosen, data)
    table = data
    if isinstance(data, Dataset) and data.is_temporal and not chosen.temporal:
        table = data.lagged()
    if "blocks" in _settings_of(chosen):  # what is told apart has to be tested apart
        settings = {"blocks": level == "variable", **settings}
    started = time.perf_counter()
    result = chosen.learn(table, seed=seed, **settings)
    seconds = time.perf_counter() - started
    found = result if isinstance(result, Found) else _of_columns(chosen, table, result)
    if isinstance(table, Dataset):
        found = _folded(found, table, level)
    version = {chosen.package: chosen.version or ""} if chosen.package else {}
    return found.told(
        learner=chosen.name,
        settings={**found.settings, **settings},
        seconds=seconds,
        experiments=len(data) if isinstance(data, Dataset) else found.experiments,
        versions={**found.versions, **version},
    )


def _refuse_other(chosen: Learner, data: Any) -> None:
    """Refuse what a learner cannot use.

    Raises:
        ModelError: It needs data, or something to experiment on, of another kind.
    """
    if isinstance(data, Dataset):
        if chosen.takes == ("paired",):
            raise ModelError([f"{chosen.name} does its own experiments: it cannot use a Dataset"])
    elif "paired" not in chosen.takes:
        raise ModelError([f"{chosen.name} learns from a Dataset, not from {type(data).__name__}"])
    elif chosen.on == "models" and not hasattr(data, "answers"):
        what = type(data).__name__
        raise ModelError([f"{chosen.name} moves several numbers at once, on models; not on {what}"])


def _settings_of(chosen: Learner) -> tuple[str, ...]:
    try:
        return tuple(inspect.signature(chosen.learn).parameters)
    except (TypeError, ValueError):  # a function that is not of Python
        return ()


def _of_columns(chosen: Learner, table: Any, matrix: Any) -> Found:
    if not isinstance(table, Dataset):
        raise ModelError([f"the learner {chosen.name!r} has to give a Found"])
    return Found.of(table.names, matrix)


def _folded(found: Found, table: Dataset, level: Level) -> Found:
    """Take the columns of a variable together, and earlier columns as lags."""
    columns = {column.name: column for column in table.columns}
    unknown = [name for name in found.names if name not in columns]
    if unknown and set(found.names) <= set(table.blocks):
        return found  # it speaks of variables already
    if unknown:
        what = f"a learner found a graph of {unknown[0]!r}, which is not in the data"
        raise ModelError([f"{what}; there are: {', '.join(table.names)}"])
    base = [columns[n].variable if level == "variable" else n.split("@-")[0] for n in found.names]
    lag_of = np.array([columns[n].lag for n in found.names])
    names = tuple(dict.fromkeys(base))
    at = np.array([names.index(name) for name in base])
    lags = max(int(lag_of.max(initial=0)), len(found.edges) - 1)
    edges = np.zeros((lags + 1, len(names), len(names)), bool)
    sureness = np.zeros(edges.shape)
    now = np.flatnonzero(lag_of == 0)
    found = _forward(found, lag_of)
    for lag, row in ((k, i) for k in range(len(found.edges)) for i in range(len(at))):
        total = lag + int(lag_of[row])
        if total > lags:
            continue
        np.logical_or.at(edges[total, at[row]], at[now], found.edges[lag, row, now])
        np.maximum.at(sureness[total, at[row]], at[now], found.sureness[lag, row, now])
    np.fill_diagonal(edges[0], False)
    np.fill_diagonal(sureness[0], 0.0)
    return found.told(names=names, edges=edges, sureness=sureness)


def _forward(found: Found, lag_of: NDArray[np.int64]) -> Found:
    """Turn edges within the rows that would lead into the past."""
    back = lag_of[:, None] < lag_of[None, :]
    edges, sureness = found.edges.copy(), found.sureness.copy()
    edges[0] |= (edges[0] & back).T
    sureness[0] = np.maximum(sureness[0], np.where(back, sureness[0], 0.0).T)
    return found.told(edges=edges, sureness=sureness)


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
