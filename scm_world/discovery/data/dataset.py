"""Observations under several regimes, as one typed table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, final

import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import typed, whole_number
from scm_world._types import Floats
from scm_world.errors import ModelError, UnknownOption, UnknownVariable
from scm_world.queries.plans import Plan
from scm_world.variables import SOFT, Mechanism

if TYPE_CHECKING:
    from scm_world.discovery.data.truth import GroundTruth

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

SEEN = Plan()
"""The plan of a regime in which nothing is done."""


@final
@dataclass(frozen=True)
class Column:
    """One number of a row.

    Attributes:
        name: ``"tool_block.mass"``, or ``"gravity[2]"`` for a number of a vector; ``@-1`` at the
            end means one control step before the row.
        variable: Which variable it belongs to, without component and lag.
        component: Which number of it; None for a scalar.
        unit: Of the variable.
        kind: Of the variable: ``"exogenous"``, ``"derived"``, ``"measured"``, ``"action"``; or
            ``"unknown"``, in a table from elsewhere.
        role: Of the variable: ``"parameter"``, ``"state"``, ``"readout"``, ``"action"``, or
            ``"unknown"``.
        dtype: ``"real"``, ``"integer"`` or ``"categorical"``.
        lag: How many control steps before the row it was measured.
        how: What was taken of an episode: ``"final"``, ``"mean"``, …; ``"value"`` of an instant.
    """

    name: str
    variable: str
    component: int | None = None
    unit: str = "1"
    kind: str = "unknown"
    role: str = "unknown"
    dtype: str = "real"
    lag: int = 0
    how: str = "value"


@final
@dataclass(frozen=True)
class Regime:
    """What was done in some rows.

    Attributes:
        plan: The interventions; empty where nothing was done.
        targets: Variables whose own mechanism was replaced, sorted.
    """

    plan: Plan = SEEN
    targets: tuple[str, ...] = ()

    @property
    def softly(self) -> frozenset[str]:
        """The targets that still follow their causes: shifted, scaled, or with another noise."""
        return frozenset(
            name
            for name, act in self.plan.at_start().items()
            if isinstance(act, SOFT) or (isinstance(act, Mechanism) and act.function is None)
        )

    def as_dict(self) -> dict[str, Any]:
        """Write it as plain data."""
        return {"plan": self.plan.as_dict(), "targets": list(self.targets)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], *, trusted: Sequence[str] = ()) -> Regime:
        """Read what ``as_dict`` wrote."""
        plan = Plan.from_dict(data["plan"], trusted=trusted)
        return cls(plan, tuple(map(str, data["targets"])))


Row = tuple[int, int, Regime, Floats]
"""Episode, control step, regime and values, shape (p,)."""


@final
@dataclass(frozen=True, eq=False)
class Dataset:
    """Rows of numbers, each with the regime, the episode and the control step it comes from.

    Attributes:
        values: Shape (n, p).
        columns: What stands in each column.
        regimes: What was done; rows refer to them by number.
        regime: Of each row, shape (n,).
        episode: Of each row, shape (n,). Rows of one episode stand together, in time.
        step: Control step of each row, shape (n,); 0 where a row is a whole episode.
        about: Where the rows come from: system, seed, backend, versions and so on; plain data.

    Raises:
        ModelError: The shapes do not fit together, a number is not finite, or the rows of an
            episode do not stand together with rising steps.

    Example:
        >>> table = Dataset.of([[0.0, 1.0], [2.0, 5.0]], ["x", "y"], targets=[(), ("x",)])
        >>> table.names, table.targeted.tolist(), len(table)
        (('x', 'y'), [[False, False], [True, False]], 2)
    """

    values: Floats
    columns: tuple[Column, ...]
    regimes: tuple[Regime, ...]
    regime: Ints
    episode: Ints
    step: Ints
    about: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that everything fits together."""
        n, p = self.values.shape if self.values.ndim == 2 else (-1, -1)
        problems = []
        if p != len(self.columns):
            problems.append(
                f"values have shape {self.values.shape}, of {len(self.columns)} columns"
            )
        rows = {what: getattr(self, what).shape for what in ("regime", "episode", "step")}
        problems += [
            f"{what} has shape {shape}, not ({n},)" for what, shape in rows.items() if shape != (n,)
        ]
        if not np.isfinite(self.values).all():
            row, column = np.argwhere(~np.isfinite(self.values))[0]
            problems.append(f"row {row} of {self.columns[column].name!r} is not finite")
        if len({column.name for column in self.columns}) != len(self.columns):
            problems.append("two columns have one name")
        if (
            n > 0
            and not problems
            and not 0 <= self.regime.min() <= self.regime.max() < len(self.regimes)
        ):
            problems.append(f"a row refers to a regime that is not among {len(self.regimes)}")
        if not problems:
            problems += _disorder(self.episode, self.step)
        if problems:
            raise ModelError(problems)

    @classmethod
    def of(
        cls,
        values: Any,
        names: Sequence[str],
        *,
        targets: Sequence[Iterable[str] | None] | None = None,
        episode: Any = None,
        step: Any = None,
        **about: Any,
    ) -> Dataset:
        """Make a table of numbers from elsewhere.

        Args:
            values: Shape (n, p); of a data frame, or of columns by name, those with these names.
            names: Of the p columns; scalars all.
            targets: For each row the columns that were intervened on; nowhere if None.
            episode: Of each row; each row is its own if None.
            step: Of each row; 0 if None.
            about: Where it comes from.

        Raises:
            ModelError: A column has no numbers, a name is no text, or shapes do not fit together.
            UnknownVariable: A target, or a name in a data frame, is no column.
        """
        table = numbers(values, names)
        n = len(table)
        given = [()] * n if targets is None else targets
        if not isinstance(given, Iterable) or not all(
            isinstance(t, Iterable | None) for t in given
        ):
            raise UnknownOption("targets", targets, ("for each row a list of names, or None",))
        rows = [tuple(sorted({t} if isinstance(t, str) else set(t or ()))) for t in given]
        unknown = sorted({name for row in rows for name in row} - set(names))
        if unknown:
            raise UnknownVariable(unknown[0], names)
        kinds = tuple(dict.fromkeys([(), *rows]))
        number = {kind: i for i, kind in enumerate(kinds)}
        return cls(
            values=table,
            columns=tuple(Column(name, name) for name in names),
            regimes=tuple(Regime(targets=kind) for kind in kinds),
            regime=np.array([number[row] for row in rows], dtype=np.int64),
            episode=np.arange(n) if episode is None else whole_numbers("episode", episode),
            step=np.zeros(n, np.int64) if step is None else whole_numbers("step", step),
            about=dict(about),
        )

    @classmethod
    def stacked(
        cls, columns: tuple[Column, ...], rows: Sequence[Row], about: dict[str, Any]
    ) -> Dataset:
        """Put rows below one another; regimes are numbered as they occur."""
        regimes: dict[Regime, int] = {}
        numbers = [(e, s, regimes.setdefault(regime, len(regimes))) for e, s, regime, _ in rows]
        episode, step, regime = np.array(numbers, dtype=np.int64).reshape(-1, 3).T.copy()
        values = np.array([row for *_, row in rows], dtype=np.float64).reshape(-1, len(columns))
        return cls(values, columns, tuple(regimes), regime, episode, step, about)

    # --- looking ------------------------------------------------------------------------------

    def __len__(self) -> int:
        return len(self.values)

    @typed
    def __getitem__(self, name: str) -> Floats:
        """Give a column, shape (n,), or all columns of a vector, shape (n, k)."""
        if name in self.names:
            return self.values[:, self.names.index(name)]
        where = [i for i, column in enumerate(self.columns) if column.variable == name]
        if not where:
            raise UnknownVariable(name, (*self.names, *self.variables))
        return self.values[:, where]

    def __eq__(self, other: object) -> bool:
        """Tell whether two tables hold the same, bit for bit."""
        return (
            isinstance(other, Dataset)
            and self.columns == other.columns
            and self.about == other.about
            and self.values.tobytes() == other.values.tobytes()
            and all(
                np.array_equal(getattr(self, what), getattr(other, what))
                for what in ("episode", "step")
            )
            and [self.regimes[i] for i in self.regime] == [other.regimes[i] for i in other.regime]
        )

    __hash__ = None  # type: ignore[assignment] # compared by content

    def __repr__(self) -> str:
        done = len({self.regimes[i].targets for i in np.unique(self.regime)})
        return f"Dataset({len(self)} rows, {len(self.columns)} columns, {done} regimes)"

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of the columns."""
        return tuple(column.name for column in self.columns)

    @cached_property
    def variables(self) -> tuple[str, ...]:
        """That the columns belong to, in their order; with ``@-1`` for an earlier instant."""
        return tuple(dict.fromkeys(map(block, self.columns)))

    @cached_property
    def blocks(self) -> dict[str, Ints]:
        """Numbers of the columns of each variable."""
        found: dict[str, list[int]] = {name: [] for name in self.variables}
        for i, column in enumerate(self.columns):
            found[block(column)].append(i)
        return {name: np.array(where, dtype=np.int64) for name, where in found.items()}

    @cached_property
    def targeted(self) -> Bools:
        """Which numbers were set from outside, shape (n, p)."""
        kinds = np.array(
            [[block(c) in r.targets for c in self.columns] for r in self.regimes], dtype=bool
        ).reshape(len(self.regimes), len(self.columns))
        return kinds[self.regime]

    @cached_property
    def soft(self) -> Bools:
        """Which of the ``targeted`` numbers still follow their causes, shape (n, p).

        These are shifted or scaled, or have another noise; all others were set, drawn, or follow
        other causes.
        """
        kinds = np.array(
            [[c.variable in r.softly for c in self.columns] for r in self.regimes], dtype=bool
        ).reshape(len(self.regimes), len(self.columns))
        return kinds[self.regime] & self.targeted

    @property
    def targets(self) -> tuple[tuple[str, ...], ...]:
        """The variables that were intervened on in each row."""
        return tuple(self.regimes[kind].targets for kind in self.regime.tolist())

    @cached_property
    def target_names(self) -> tuple[tuple[str, ...], ...]:
        """Names of the columns set in each regime, then of the variables that are in no column."""
        return tuple(
            (
                *(column.name for column in self.columns if block(column) in regime.targets),
                *(name for name in regime.targets if name not in self.variables),
            )
            for regime in self.regimes
        )

    @cached_property
    def intervened(self) -> Bools:
        """The rows in which something was set, be it in a column or not, shape (n,)."""
        return np.array([bool(r.targets) for r in self.regimes], dtype=bool)[self.regime]

    @cached_property
    def hidden_targets(self) -> Bools:
        """The rows in which a variable that is in no column was set, shape (n,)."""
        there = set(self.variables)
        return np.array([not there.issuperset(r.targets) for r in self.regimes], bool)[self.regime]

    @cached_property
    def truth(self) -> GroundTruth | None:
        """The true graph over exactly these variables; None where it is not known.

        What is not in the table is hidden: it confounds, and effects through it are direct ones.
        Of rows that are episodes of a world, it is the graph from what they begin with to what they
        end with. Of a table with ``lagged`` columns it is the graph among these.
        """
        from scm_world.discovery.data.truth import truth_of

        return truth_of(self)

    def acting(self) -> Dataset:
        """Leave out of ``truth`` the edges whose condition held in none of the rows.

        Edges by contact stay where their bodies touched, directly or through others, in a control
        step that led to a row; edges of what is set where a row can be one in which it was.

        Raises:
            ModelError: The graph is not known, or the table does not say what touched.
        """
        from scm_world.discovery.data.truth import acting_edges

        edges = acting_edges(self)
        return replace(self, about={**self.about, "truth": {**self.about["truth"], "edges": edges}})

    @property
    def contacts(self) -> dict[tuple[str, str], float]:
        """In which share of the control steps behind the rows each pair of bodies touched.

        Raises:
            ModelError: The table does not say what touched: it was collected without contacts.
        """
        from scm_world.discovery.data.truth import steps_of

        steps = [touch for part in steps_of(self) for touch in part.values()]
        counts = Counter(pair for touch in steps for pair in touch)
        return {pair: counts[pair] / len(steps) for pair in sorted(counts)}

    @typed
    def adjacency(self, lag: int = 0) -> Bools:
        """Give the true edges of a lag between columns, shape (p, p): row causes column.

        Raises:
            ModelError: The graph is not known.
        """
        at = [self._known.names.index(block(column)) for column in self.columns]
        return self._known.adjacency(lag)[np.ix_(at, at)]

    @typed
    def weights(self, lag: int = 0) -> Floats:
        """Give the weights of true edges between columns, shape (p, p): row causes column.

        Zero where there is no edge (an edge can have weight zero, too: see ``adjacency``), NaN
        where a mechanism on the way is not linear. Vectors of one size act number by number.
        What is hidden between the two counts; what is hidden and acts on both does not, so that
        a regression gives another number for a confounded pair.

        Raises:
            ModelError: The graph is not known.
        """
        found = np.zeros((len(self.columns), len(self.columns)))
        for edge in self._known.edges:
            if edge[2] == lag:
                causes, effects = self.blocks[edge[0]], self.blocks[edge[1]]
                weight = self._known.weights.get(edge, np.nan)
                by_number = len(causes) == len(effects) and not np.isnan(weight)
                where = (causes, effects) if by_number else np.ix_(causes, effects)
                found[where] = weight
        return found

    @property
    def _known(self) -> GroundTruth:
        if self.truth is None:
            raise ModelError(["the table does not know its graph: it was not collected here"])
        return self.truth

    @typed
    def hide(self, names: Iterable[str]) -> Dataset:
        """Leave out columns or variables; ``truth`` then has them as hidden causes.

        Raises:
            UnknownVariable: There is none of this name.
        """
        gone = {column.name for column in self.select(names).columns}
        return self.select(name for name in self.names if name not in gone)

    @property
    def is_temporal(self) -> bool:
        """Whether an episode has several rows."""
        return bool(len(self)) and len(np.unique(self.episode)) < len(self)

    # --- other tables -------------------------------------------------------------------------

    def rows(self, chosen: Any) -> Dataset:
        """Take some rows: a mask, numbers or a slice.

        Raises:
            UnknownOption: It is none of these, or too long.
        """
        try:
            taken = np.arange(len(self))[chosen].reshape(-1)
        except IndexError:
            allowed = (f"a mask of {len(self)} rows", "whole numbers of rows", "a slice")
            raise UnknownOption("rows", chosen, allowed) from None
        return replace(
            self,
            values=self.values[taken],
            regime=self.regime[taken],
            episode=self.episode[taken],
            step=self.step[taken],
        )

    @typed
    def select(self, names: Iterable[str]) -> Dataset:
        """Take some columns or variables, in the order given."""
        where: list[int] = []
        for name in names:
            if name in self.names:
                where.append(self.names.index(name))
            elif name in self.blocks:
                where += self.blocks[name].tolist()
            else:
                raise UnknownVariable(name, (*self.names, *self.variables))
        return replace(
            self, values=self.values[:, where], columns=tuple(self.columns[i] for i in where)
        )

    @property
    def observational(self) -> Dataset:
        """The rows in which nothing was done, to columns or to variables that are in none."""
        return self.rows(~self.intervened)

    @typed
    def first(self, episodes: int) -> Dataset:
        """Take the rows of the first episodes, in their order."""
        kept = np.unique(self.episode)[:episodes]
        return self.rows(np.isin(self.episode, kept))

    def standardised(self) -> Dataset:
        """Give every column mean 0 and variance 1 over all rows; constant ones become 0."""
        # In units of their own size, a power of two, so that no square overflows or vanishes.
        largest = np.abs(self.values).max(axis=0, initial=0.0)
        scaled = np.ldexp(self.values, -np.frexp(largest)[1])
        mean, spread = scaled.mean(axis=0), scaled.std(axis=0)
        spread = np.where(spread > 1e-12, spread, np.inf)
        about = {**self.about, "standardised": True}
        return replace(self, values=(scaled - mean) / spread, about=about)

    @typed
    def lagged(self, lags: int = 1) -> Dataset:
        """Put earlier control steps beside each row, as further columns ``name@-1``.

        Rows without enough past are left out; nothing is carried from one episode to the next.
        What was set at an earlier step is a target at that step: ``x@-1``. The graph of the table
        is that among its columns, all of them at lag 0.

        Raises:
            ModelError: It has such columns already.

        Example:
            >>> table = Dataset.of([[1.0], [2.0], [3.0]], ["x"], episode=[0, 0, 1], step=[0, 1, 0])
            >>> table.lagged().names, table.lagged().values.tolist()
            (('x', 'x@-1'), [[2.0, 1.0]])
        """
        whole_number("lags", lags, least=0)
        if any(column.lag for column in self.columns):
            raise ModelError(
                ["the table has earlier control steps already: take lagged(2) at once"]
            )
        rows = np.arange(len(self))
        whole = rows[
            (rows >= lags)
            & (self.episode[rows - lags] == self.episode[rows])
            & (self.step[rows] - self.step[rows - lags] == lags)
        ]
        earlier = [
            replace(column, name=f"{column.name}@-{lag}", lag=lag)
            for lag in range(1, lags + 1)
            for column in self.columns
        ]
        parts = [self.values[whole - lag] for lag in range(lags + 1)]
        kinds, number = np.unique(
            np.stack([self.regime[whole - lag] for lag in range(lags + 1)]),
            axis=1,
            return_inverse=True,
        )
        names = (
            {
                f"{name}@-{lag}" if lag else name
                for lag, k in enumerate(kind)
                for name in self.regimes[k].targets
            }
            for kind in kinds.T.tolist()
        )
        regimes = (
            replace(self.regimes[now], targets=tuple(sorted(targets)))
            for now, targets in zip(kinds[0].tolist(), names, strict=True)
        )
        return replace(
            self.rows(whole),
            values=np.concatenate(parts, axis=1),
            columns=(*self.columns, *earlier),
            regimes=tuple(regimes),
            regime=number.reshape(-1).astype(np.int64),
            about={**self.about, "lags": lags},
        )

    @classmethod
    @typed
    def joined(cls, parts: Sequence[Dataset]) -> Dataset:
        """Put tables of one kind below one another.

        Raises:
            ModelError: They differ in columns or in where they come from, two have the same
                episodes, or there is none.
        """
        if not len(parts):
            raise ModelError(["there is no table to join"])
        first = parts[0]
        for part in parts[1:]:
            if part.columns != first.columns or part.about != first.about:
                raise ModelError(["tables with other columns or from elsewhere cannot be joined"])
        regimes: dict[Regime, int] = {}
        numbers: list[Ints] = []
        for part in parts:
            at = [regimes.setdefault(regime, len(regimes)) for regime in part.regimes]
            numbers.append(np.array(at, dtype=np.int64)[part.regime])
        return replace(
            first,
            values=np.concatenate([part.values for part in parts]),
            regimes=tuple(regimes),
            regime=np.concatenate(numbers),
            episode=np.concatenate([part.episode for part in parts]),
            step=np.concatenate([part.step for part in parts]),
        )


KINDS = {
    "M": ("dates", "give numbers, such as seconds since the first one"),
    "m": ("durations", "give numbers, such as .dt.total_seconds()"),
    "U": ("text", "give numbers, such as a code for each category, or pandas.to_numeric"),
    "c": ("complex numbers", "give the real and the imaginary part as two columns"),
}
"""Of dtypes that are no real numbers: their name, and what to do."""


def numbers(values: Any, names: Sequence[str]) -> Floats:
    """Read columns of real numbers, shape (n, p).

    Args:
        values: Shape (n, p), or a data frame or mapping that has columns of these names.
        names: Of the columns.

    Raises:
        ModelError: A column holds something else than numbers, a name is no text or occurs twice,
            or there is another number of columns.
        UnknownVariable: The frame has no such column.
    """
    if not isinstance(names, Iterable):
        raise UnknownOption("names", names, ("a list of the names of the columns",))
    labels = tuple(names)
    advice = "names of columns are text: frame.rename(columns=str), and in the targets, too"
    wrong = [
        f"a column is named {name!r}; {advice}" for name in labels if not isinstance(name, str)
    ]
    columns: list[Any]
    if isinstance(values, Mapping) or hasattr(values, "columns"):
        there = list(values if isinstance(values, Mapping) else values.columns)
        twice = sorted({name for name in map(str, there) if there.count(name) > 1} & {*labels})
        wrong += [f"two columns are named {name!r}" for name in twice]
        if wrong:
            raise ModelError(wrong)
        for name in labels:
            if name not in there:
                raise UnknownVariable(name, map(str, there))
        columns = [np.asarray(values[name]) for name in labels]
    else:
        table = values if isinstance(values, np.ndarray) else np.array(values, dtype=object)
        if table.ndim != 2 or table.shape[1] != len(labels):
            wrong.append(f"values have shape {table.shape}, of {len(labels)} columns")
        if wrong:
            raise ModelError(wrong)
        columns = [*table.T]
    made = []
    for name, column in zip(labels, columns, strict=True):
        array = column
        if array.dtype.kind == "O":  # numbers of Python are numbers
            with suppress(ValueError):
                array = np.array(column.tolist())
        if array.ndim != 1 or array.dtype.kind not in "biuf":
            first = type(next(iter(np.atleast_1d(array).tolist()), None)).__name__
            other = f"values of type {first}", "give one number in each row"
            what, advice = KINDS.get(array.dtype.kind, other)
            wrong.append(f"the column {name!r} holds {what}, not real numbers: {advice}")
        made.append(array)
    if wrong:
        raise ModelError(wrong)
    if len({len(array) for array in made}) > 1:
        raise ModelError([f"the columns have {[len(array) for array in made]} rows"])
    return np.stack(made, axis=1).astype(np.float64) if made else np.empty((len(values), 0))


def whole_numbers(name: str, values: Any) -> Ints:
    """Read the whole numbers of a column, shape (n,).

    Raises:
        ModelError: It holds something else.
    """
    found = np.asarray(values)
    whole = found.dtype.kind in "iu"
    if found.dtype.kind == "f":
        whole = bool(np.isfinite(found).all() and np.array_equal(found, np.rint(found)))
    if not whole and found.size:
        raise ModelError([f"{name!r} holds numbers of dtype {found.dtype}: give whole numbers"])
    return found.astype(np.int64)


def _disorder(episode: Ints, step: Ints) -> list[str]:
    """Say where rows of one episode do not stand together, with rising steps.

    Example:
        >>> _disorder(np.array([4, 4, 7]), np.array([0, 1, 0]))
        []
        >>> _disorder(np.array([4, 4, 7]), np.array([1, 0, 0]))[0]
        'the rows of episode 4 do not stand together in time: sort the rows by episode and step'
    """
    starts = np.flatnonzero(np.diff(episode, prepend=episode[:1] - 1))
    _, begun = np.unique(episode[starts], return_index=True)
    again = np.delete(starts, begun)
    back = np.flatnonzero((np.diff(episode) == 0) & (np.diff(step) <= 0)) + 1
    if not again.size and not back.size:
        return []
    pairs, times = np.unique(np.stack([episode, step]), axis=1, return_counts=True)
    if times.max() > 1:
        number, instant = pairs[:, times.argmax()]
        return [
            f"two rows are step {instant} of episode {number}: if two tables have the same episode "
            "numbers, give one of them others; if not, give each row of an episode its own step"
        ]
    number = episode[min([*again, *back])]
    return [
        f"the rows of episode {number} do not stand together in time: sort the rows by episode "
        "and step"
    ]


def block(column: Column) -> str:
    """Name the variable of a column, with ``@-1`` for an earlier instant."""
    return f"{column.variable}@-{column.lag}" if column.lag else column.variable


def columns_of(variable: Any, how: str = "value") -> tuple[Column, ...]:
    """List the columns that the numbers of a ``Variable`` fill."""
    size = int(np.prod(variable.shape))
    scalar = variable.shape == ()
    return tuple(
        Column(
            variable.name if scalar else f"{variable.name}[{i}]",
            variable.name,
            None if scalar else i,
            variable.unit,
            variable.kind,
            str(variable.role),
            variable.dtype,
            how=how,
        )
        for i in range(size)
    )


Level = Literal["variable", "component"]
