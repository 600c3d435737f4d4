"""Datasets as other libraries take them, and back."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from scm_world._arguments import load, typed
from scm_world._types import Floats
from scm_world.discovery.data.dataset import (
    Column,
    Dataset,
    Ints,
    Regime,
    check_commands,
    check_names,
    numbers,
)
from scm_world.errors import ModelError, ScmWorldError, UnknownOption, in_one_line
from scm_world.queries.observations import NUMBERS, RECORDED, TARGETS, names_in, whole_numbers
from scm_world.queries.plans import FORMAT, Plan

if TYPE_CHECKING:
    import pandas

KEY = "scm_world"


@typed
def as_gies(dataset: Dataset) -> tuple[list[Floats], list[list[int]]]:
    """Return a dataset as ``gies.fit_bic(data, I)`` takes it.

    GIES takes every column that is not a target for one with its own mechanism. So rows in which a
    variable was set that has no column are left out.

    Returns:
        For each set of targets its rows, shape (n_k, p), and the numbers of the columns that were
        intervened on, in the order in which they first occur. Of a vector all columns are.

    Raises:
        ModelError: In every row a variable was set that has no column.

    Example:
        >>> table = Dataset.of([[0.0], [1.0], [2.0]], ["x"], targets=[(), ("x",), ()])
        >>> data, targets = as_gies(table)
        >>> [rows.tolist() for rows in data], targets
        ([[[0.0], [2.0]], [[1.0]]], [[], [0]])
    """
    if len(dataset) and dataset.hidden_targets.all():
        raise ModelError(["in every row a variable was set that has no column: GIES needs others"])
    known = dataset.rows(~dataset.hidden_targets)
    kind = _target_sets(known)
    groups = [np.flatnonzero(kind == number) for number in range(kind.max(initial=-1) + 1)]
    targets = [np.flatnonzero(known.targeted[rows[0]]).tolist() for rows in groups]
    return [known.values[rows] for rows in groups], targets


def _target_sets(dataset: Dataset, first: Sequence[tuple[str, ...]] = ()) -> Ints:
    """Number the sets of targets of the rows, hidden ones among them, in order; shape (n,)."""
    names, number = dataset.target_names, {targets: i for i, targets in enumerate(first)}
    kinds = (number.setdefault(names[kind], len(number)) for kind in dataset.regime.tolist())
    return np.fromiter(kinds, np.int64, len(dataset))


@typed
def as_dcdi(dataset: Dataset, folder: Path | str, number: int = 1) -> Path:
    """Write a dataset as DCDI reads it: ``--data-path folder --i-dataset number``.

    Observational rows are regime 0, and ``data<number>.npy``. Each other set of targets is a
    regime; variables that have no column are among its targets, though its mask cannot name them:
    such regimes are for ``--intervention-knowledge unknown``, or for ``regimes_to_ignore`` of its
    loader. Its perfect interventions are hard: a dataset with soft ones is for
    ``--intervention-type imperfect``; ``soft<number>.csv`` has which they are.

    Args:
        dataset: Rows that are episodes, of a known graph without lags.
        folder: It is made if need be; files of the same number are replaced.
        number: Number of the dataset in the folder.

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
    np.save(target / f"DAG{number}.npy", adjacency)
    np.save(target / f"data{number}.npy", dataset.observational.values)
    np.save(target / f"data_interv{number}.npy", dataset.values)
    for name, table in (("intervention", dataset.targeted), ("soft", dataset.soft)):
        lines = (",".join(map(str, np.flatnonzero(row).tolist())) for row in table)
        (target / f"{name}{number}.csv").write_text("\n".join(lines) + "\n", "utf-8", newline="\n")
    np.savetxt(target / f"regime{number}.csv", _target_sets(dataset, [()]), "%d")
    return target


@typed
def as_tigramite(dataset: Dataset) -> Any:
    """Return time series as a ``tigramite.data_processing.DataFrame``.

    Each episode is a data set of its own (``analysis_mode="multiple"``), so that nothing is carried
    from one to the next. Categories and whole numbers are marked as discrete.

    Raises:
        MissingExtra: tigramite is not installed.
        ModelError: An episode has one row only, or misses a control step.
    """
    if not dataset.is_temporal:
        raise ModelError(
            ["every episode is one row, which is not a series: collect with every_step=True"]
        )
    processing = load("tigramite.data_processing", "tigramite", "learn")
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


class CausalLearn(NamedTuple):
    """The arguments of functions of causal-learn.

    Attributes:
        data: Shape (n, p).
        node_names: Names of the p columns.
        c_indx: For ``cdnod``: number of the set of targets of each row, shape (n, 1). Variables
            that have no column are among the targets: CD-NOD looks for what changes itself.
    """

    data: Floats
    node_names: list[str]
    c_indx: Ints


@typed
def as_causal_learn(dataset: Dataset) -> CausalLearn:
    """Return a dataset as causal-learn takes it: ``pc(data)``, ``cdnod(data, c_indx)``.

    It has all rows; ``pc`` and others without regimes take those of ``dataset.observational``.

    Example:
        >>> table = Dataset.of([[0.0], [1.0], [2.0]], ["x"], targets=[(), ("x",), ()])
        >>> as_causal_learn(table).c_indx.ravel().tolist()
        [0, 1, 0]
    """
    index = _target_sets(dataset).reshape(-1, 1)
    return CausalLearn(dataset.values.copy(), list(dataset.names), index)


# --- pandas -----------------------------------------------------------------------------------


def regimes_as_dict(regimes: Iterable[Regime]) -> dict[str, Any]:
    """Return regimes as plain data; many share interventions, each of which is written once."""
    acts: dict[str, int] = {}
    found = []
    for regime in regimes:
        done = (json.dumps(act) for act in regime.plan.as_dict()["do"].items())
        found.append([[acts.setdefault(act, len(acts)) for act in done], list(regime.targets)])
    return {"acts": [json.loads(act) for act in acts], "regimes": found}


def regimes_from_dict(data: Mapping[str, Any], trusted: Sequence[str]) -> tuple[Regime, ...]:
    """Read the data of ``regimes_as_dict``."""
    acts = [
        (name, Plan.from_dict({"format": FORMAT, "do": {name: parts}}, trusted=trusted)[name])
        for name, parts in data["acts"]
    ]
    return tuple(
        Regime(Plan(dict(acts[number] for number in numbers)), tuple(targets))
        for numbers, targets in data["regimes"]
    )


@typed
def as_frame(dataset: Dataset) -> Any:
    """Return a dataset as a ``pandas.DataFrame``.

    Returns:
        The columns ``episode``, ``step``, ``regime`` and ``intervention_targets``, then those of
        the dataset. The targets of a row are a tuple of names of columns, None in an observational
        one, as proposed in https://github.com/pgmpy/pgmpy/issues/2117. A variable that was set and
        has no column is named after them. All the rest is in ``frame.attrs``, so that
        ``from_frame`` returns the same dataset.

    Raises:
        ModelError: A column has the name of one of the four, or ``about`` is not plain data.
    """
    import pandas

    check_names(dataset.columns)
    data = pandas.DataFrame(dataset.values.copy(), columns=list(dataset.names))
    names = dataset.target_names
    targets = [names[kind] or None for kind in dataset.regime.tolist()]
    data.insert(0, TARGETS, pandas.Series(targets, dtype=object))
    for name in reversed(NUMBERS):
        data.insert(0, name, getattr(dataset, name).copy())
    about = {
        "columns": [asdict(column) for column in dataset.columns],
        "about": dataset.about,
        **regimes_as_dict(dataset.regimes),
    }
    try:
        data.attrs[KEY] = json.dumps(about)  # one text: pandas copies it at every step
    except TypeError as error:
        raise ModelError([f"the dataset's 'about' is not plain data: {error}"]) from None
    return data


@typed
def from_frame(frame: pandas.DataFrame, *, trusted: tuple[str, ...] = ()) -> Dataset:
    """Read a frame that ``as_frame`` returned, or any with a column ``intervention_targets``.

    Args:
        frame: Rows of whole instants and columns may have been taken away, columns reordered. In a
            frame without ``attrs``, such as one from a CSV file, the targets may be a text: names
            with semicolons, as in the files of ``collect``, or a tuple as Python writes it.
        trusted: Packages whose functions may be mechanisms of its plans.

    Raises:
        UnknownOption: It is not a ``pandas.DataFrame``.
        ModelError: It has no column ``intervention_targets``, or other columns than numbers; a
            target is not a column any more; or rows of an episode do not stand together.
        UnknownVariable: The frame has no ``attrs``, and a target is not a column.
    """
    if not hasattr(frame, "columns") or not hasattr(frame, "attrs"):
        raise UnknownOption("frame", type(frame).__name__, ("a pandas.DataFrame",))
    if TARGETS not in frame:
        raise ModelError([f"the frame has no column {TARGETS!r}: None, or a tuple of names, each"])
    names = [name for name in frame.columns if name not in RECORDED]
    if "Unnamed: 0" in names:
        advice = "write it with to_csv(…, index=False), or read it with index_col=0"
        raise ModelError([f"the column 'Unnamed: 0' is the index of a CSV file: {advice}"])
    values = numbers(frame, names)
    cells = frame[TARGETS]
    if KEY not in frame.attrs:
        given = [*map(names_in, cells)]
        rows = {n: frame[n].to_numpy() for n in ("episode", "step") if n in frame}
        return Dataset.of(values, names, targets=given, **rows)
    lost = [f"the frame has no column {name!r} any more" for name in NUMBERS if name not in frame]
    if lost:
        raise ModelError(lost)
    try:
        about = json.loads(frame.attrs[KEY])
        columns = {column["name"]: Column(**column) for column in about["columns"]}
        hidden = {name for _, targets in about["regimes"] for name in targets}
        regimes = regimes_from_dict(about, trusted)
        origin = dict(about["about"])
        check_commands(origin, columns.values())
    except ScmWorldError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        advice = f"`del frame.attrs[{KEY!r}]` to read the columns alone"
        said = f"frame.attrs[{KEY!r}] was not written by as_frame: {in_one_line(error)}"
        raise ModelError([f"{said}; {advice}"]) from None
    with suppress(TypeError):  # lists have no hash
        cells = cells.drop_duplicates()
    known, targets = {*columns, *hidden}, {n for cell in cells for n in names_in(cell)}
    new = [name for name in names if name not in known]
    if targets & {*new} or targets - ({*names} if new else known):
        raise ModelError(
            [
                f"the columns were renamed or added to ({', '.join(map(str, new)) or 'no new ones'}"
                f"), and the targets are {', '.join(sorted(targets))}: rename both, and then "
                f"`del frame.attrs[{KEY!r}]`, or neither"
            ]
        )
    return Dataset(
        values=values,
        columns=tuple(columns.get(name, Column(name, name)) for name in names),
        regimes=regimes,
        about=origin,
        **{name: whole_numbers(name, frame[name]) for name in NUMBERS},
    )
