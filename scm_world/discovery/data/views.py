"""Datasets as other libraries take them, and back."""

from __future__ import annotations

import ast
import json
from collections.abc import Container, Iterable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scm_world._arguments import load
from scm_world._types import Floats
from scm_world.discovery.data.dataset import Bools, Column, Dataset, Ints, Regime
from scm_world.discovery.data.shards import NUMBERS, TARGETS, check_names
from scm_world.errors import ModelError

KEY = "scm_world"


def as_gies(dataset: Dataset) -> tuple[list[Floats], list[list[int]]]:
    """Give a dataset the way ``gies.fit_bic(data, I)`` takes it.

    Returns:
        For each set of targets its rows, shape (n_k, p), and the numbers of the columns that were
        intervened on, in the order in which they first occur. Of a vector all columns are.

    Example:
        >>> table = Dataset.of([[0.0], [1.0], [2.0]], ["x"], targets=[(), ("x",), ()])
        >>> data, targets = as_gies(table)
        >>> [rows.tolist() for rows in data], targets
        ([[[0.0], [2.0]], [[1.0]]], [[], [0]])
    """
    kinds, first, where = np.unique(
        dataset.targeted, axis=0, return_index=True, return_inverse=True
    )
    order = np.argsort(first)
    where = where.reshape(-1)
    data = [dataset.values[where == kind] for kind in order]
    return data, [np.flatnonzero(kinds[kind]).tolist() for kind in order]


class Arrays(NamedTuple):
    """A dataset as arrays.

    Attributes:
        values: Shape (n, p).
        targeted: What was intervened on, shape (n, p).
        soft: What of it still follows its causes, shape (n, p).
        regime: Number of the regime of each row, shape (n,).
        adjacency: The true edges of lag 0, row causes column, shape (p, p); None if not known.
    """

    values: Floats
    targeted: Bools
    soft: Bools
    regime: Ints
    adjacency: Bools | None


def as_numpy(dataset: Dataset) -> Arrays:
    """Give a dataset as copies of its arrays.

    Example:
        >>> table = Dataset.of([[0.0], [1.0]], ["x"], targets=[(), ("x",)])
        >>> as_numpy(table).targeted.ravel().tolist(), as_numpy(table).adjacency
        ([False, True], None)
    """
    known = None if dataset.truth is None else dataset.adjacency()
    targeted, soft = dataset.targeted.copy(), dataset.soft.copy()
    return Arrays(dataset.values.copy(), targeted, soft, dataset.regime.copy(), known)


def as_dcdi(dataset: Dataset, folder: Path | str, number: int = 1) -> Path:
    """Write a dataset the way DCDI reads it: ``--data-path folder --i-dataset number``.

    Rows without an intervention are regime 0. Its perfect interventions are hard: a dataset with
    soft ones is for ``--intervention-type imperfect``, which the file ``soft<number>.csv`` tells.

    Args:
        dataset: Rows that are episodes, of a known graph without lags.
        folder: It is made if need be; files of the same number are replaced.
        number: Of the dataset in the folder.

    Returns:
        The folder.

    Raises:
        ModelError: The graph is not known, or rows are control steps.

    Source:
        https://github.com/slachapelle/dcdi, ``dcdi/data.py``.
    """
    if dataset.is_temporal:
        raise ModelError(["DCDI takes rows that are episodes; collect without control steps"])
    adjacency, target = dataset.adjacency().astype(float), Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    kinds, where = np.unique(dataset.targeted, axis=0, return_inverse=True)
    none = ~kinds.any(axis=1)
    order = np.argsort(~none, kind="stable")  # without intervention first
    rank = np.argsort(order) + (0 if none.any() else 1)
    seen = dataset.values[~dataset.targeted.any(axis=1)]
    np.save(target / f"DAG{number}.npy", adjacency)
    np.save(target / f"data{number}.npy", seen)
    np.save(target / f"data_interv{number}.npy", dataset.values)
    for name, table in (("intervention", dataset.targeted), ("soft", dataset.soft)):
        lines = (",".join(map(str, np.flatnonzero(row).tolist())) for row in table)
        (target / f"{name}{number}.csv").write_text("\n".join(lines) + "\n")
    regimes = rank[where.reshape(-1)].tolist()
    (target / f"regime{number}.csv").write_text("\n".join(map(str, regimes)) + "\n")
    return target


# --- pandas -----------------------------------------------------------------------------------


def as_frame(dataset: Dataset) -> Any:
    """Give a dataset as a ``pandas.DataFrame``.

    Returns:
        The columns ``episode``, ``step``, ``regime`` and ``intervention_targets``, then those of
        the dataset. The targets of a row are a tuple of names of columns, None where nothing was
        done, as proposed in https://github.com/pgmpy/pgmpy/issues/2117. All the rest is in
        ``frame.attrs``, so that ``from_frame`` gives the same dataset.

    Raises:
        MissingExtra: pandas is not installed.
        ModelError: A column has the name of one of the four, or something is no plain data.
    """
    pandas = load("pandas", "pandas", "data")
    check_names(dataset.columns)
    numbers = {name: getattr(dataset, name).copy() for name in NUMBERS}
    data = pandas.DataFrame(dataset.values.copy(), columns=list(dataset.names))
    names = np.array(dataset.names, dtype=object)
    targets = [tuple(names[row]) or None for row in dataset.targeted]
    column = pandas.Series(targets, dtype=object, name=TARGETS)
    frame = pandas.concat([pandas.DataFrame(numbers), column, data], axis=1)
    about = {
        "columns": [asdict(column) for column in dataset.columns],
        "regimes": [regime.as_dict() for regime in dataset.regimes],
        "about": dataset.about,
    }
    try:
        frame.attrs[KEY] = json.dumps(about)  # one text: pandas copies it at every step
    except TypeError as error:
        raise ModelError(
            [f"what the dataset says about itself is no plain data: {error}"]
        ) from None
    return frame


def from_frame(frame: Any, *, trusted: tuple[str, ...] = ()) -> Dataset:
    """Read a frame that ``as_frame`` wrote, or any with a column ``intervention_targets``.

    Args:
        frame: Rows of whole instants and columns may have been taken away, columns reordered. Of a
            frame without ``attrs`` (read from a CSV file, say) the targets may be a text: names
            with semicolons, or a tuple as Python writes it.
        trusted: Packages whose functions may be mechanisms of its plans.

    Raises:
        ModelError: It has no column ``intervention_targets``, or other columns than numbers; a
            target is no column any more; or rows of an episode do not stand together.
        UnknownVariable: The frame has no ``attrs``, and a target is no column.
    """
    if TARGETS not in frame:
        raise ModelError([f"the frame has no column {TARGETS!r}: None, or a tuple of names, each"])
    names = [name for name in frame.columns if name not in (*NUMBERS, TARGETS)]
    values = _values(frame, names)
    empty = frame[TARGETS].isna()
    given = [() if none else _names_in(c) for c, none in zip(frame[TARGETS], empty, strict=True)]
    if KEY not in frame.attrs:
        rows = {n: frame[n].to_numpy() for n in ("episode", "step") if n in frame}
        return Dataset.of(values, names, targets=given, **rows)
    about = json.loads(frame.attrs[KEY])
    columns = {column["name"]: Column(**column) for column in about["columns"]}
    _check_targets(names, columns, {name for cell in given for name in cell})
    numbers = {name: frame[name].to_numpy(dtype=np.int64) for name in NUMBERS}
    return Dataset(
        values=values,
        columns=tuple(columns.get(name, Column(name, name)) for name in names),
        regimes=tuple(Regime.from_dict(regime, trusted=trusted) for regime in about["regimes"]),
        about=about["about"],
        **numbers,
    )


def _values(frame: Any, names: list[Any]) -> Floats:
    missing = [name for name in NUMBERS if name not in frame and KEY in frame.attrs]
    problems = [f"the frame has no column {name!r} any more" for name in missing]
    if any(str(name).startswith("Unnamed: ") for name in names):
        problems.append("a column holds the numbers of the rows: write CSV with index=False")
    if problems:
        raise ModelError(problems)
    try:
        return np.asarray(frame[names].to_numpy(dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise ModelError([f"the columns of a frame have to be numbers: {error}"]) from None


def _check_targets(names: list[Any], known: Container[str], targets: set[str]) -> None:
    """Refuse columns that were renamed while the targets were not, or the other way round."""
    new = [name for name in names if name not in known]
    lost = sorted(targets - set(names)) if new else sorted(t for t in targets if t not in known)
    if lost or targets & set(new):
        raise ModelError(
            [
                f"the columns were renamed or added to ({', '.join(map(str, new)) or 'no new ones'}"
                f"), and the targets are {', '.join(sorted(targets))}: rename both, and then "
                f"`del frame.attrs[{KEY!r}]`, or neither"
            ]
        )


def _names_in(cell: Any) -> tuple[str, ...]:
    """Read a cell: names with semicolons, or in a sequence or the text of one.

    Example:
        >>> [_names_in(cell) for cell in ("a; b", "('a', 'b')", ["a", "b"])]
        [('a', 'b'), ('a', 'b'), ('a', 'b')]
    """
    if isinstance(cell, str) and cell.startswith(("(", "[")):
        with suppress(ValueError, SyntaxError):  # else it is a name like that
            cell = ast.literal_eval(cell)
    if isinstance(cell, str):
        return tuple(name.strip() for name in cell.split(";") if name.strip())
    if isinstance(cell, Iterable):
        return tuple(map(str, cell))
    raise ModelError([f"{TARGETS} has {cell!r}: it can be None, names with ';', or a tuple"])


# --- tigramite --------------------------------------------------------------------------------


def as_tigramite(dataset: Dataset) -> Any:
    """Give time series as a ``tigramite.data_processing.DataFrame``.

    Each episode is a data set of its own (``analysis_mode="multiple"``), so that nothing is carried
    from one to the next. Categories and whole numbers are marked as discrete.

    Raises:
        MissingExtra: tigramite is not installed.
        ModelError: An episode has one row only, or misses a control step.
    """
    if not dataset.is_temporal:
        raise ModelError(
            ["every episode is one row, which is no time series: collect with every_step=True"]
        )
    processing = load("tigramite.data_processing", "tigramite")
    starts = np.flatnonzero(np.diff(dataset.episode, prepend=dataset.episode[0] - 1))
    pieces = np.split(np.arange(len(dataset)), starts[1:])
    gaps = [p[0] for p in pieces if np.any(np.diff(dataset.step[p]) != 1)]
    if gaps:
        raise ModelError([f"episode {dataset.episode[gaps[0]]} misses a control step"])
    discrete = np.array([column.dtype != "real" for column in dataset.columns])
    kinds = {i: np.tile(discrete, (len(p), 1)).astype(int) for i, p in enumerate(pieces)}
    return processing.DataFrame(
        {i: dataset.values[p] for i, p in enumerate(pieces)},
        data_type=kinds,
        var_names=list(dataset.names),
        analysis_mode="multiple",
    )


# --- causal-learn -----------------------------------------------------------------------------


class CausalLearn(NamedTuple):
    """What functions of causal-learn take.

    Attributes:
        data: Shape (n, p).
        node_names: Of the p columns.
        c_indx: For ``cdnod``: number of the set of targets of each row, shape (n, 1).
    """

    data: Floats
    node_names: list[str]
    c_indx: Ints


def as_causal_learn(dataset: Dataset) -> CausalLearn:
    """Give a dataset the way causal-learn takes it: ``pc(data)``, ``cdnod(data, c_indx)``.

    Example:
        >>> table = Dataset.of([[0.0], [1.0], [2.0]], ["x"], targets=[(), ("x",), ()])
        >>> as_causal_learn(table).c_indx.ravel().tolist()
        [0, 1, 0]
    """
    _, first, where = np.unique(dataset.targeted, axis=0, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first))
    return CausalLearn(
        dataset.values.copy(), list(dataset.names), rank[where.reshape(-1)].reshape(-1, 1)
    )
