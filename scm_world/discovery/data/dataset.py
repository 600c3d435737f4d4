"""Observations under several regimes, as one typed table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import real_numbers, typed, whole_number
from scm_world._types import ArrayLike, Floats
from scm_world.errors import ModelError, UnknownOption, UnknownVariable
from scm_world.queries.observations import RECORDED, whole_numbers
from scm_world.queries.plans import Plan

if TYPE_CHECKING:
    from scm_world.discovery.data.truth import GroundTruth

CHOSEN = "a row has the command that is chosen there"
"""Says of rows that are control steps where the commands stand."""

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


@typed
@final
@dataclass(frozen=True)
class Column:
    """One number of a row.

    Attributes:
        name: ``"tool_block.mass"``, or ``"gravity[2]"`` for a number of a vector; ``@-1`` at the
            end means one control step before the row.
        variable: Name of its variable, without component and lag.
        component: Which number of the variable it is; None for a scalar.
        unit: Unit of the variable.
        kind: ``"exogenous"``, ``"derived"``, ``"measured"`` or ``"action"``; ``"unknown"`` in a
            table from elsewhere.
        role: ``"parameter"``, ``"state"``, ``"readout"``, ``"action"`` or ``"unknown"``.
        dtype: ``"real"``, ``"integer"`` or ``"categorical"``.
        lag: How many control steps before the row it was measured.
        how: The summary of an episode: ``"final"``, ``"mean"``, …; ``"value"`` of an instant.
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
    """The interventions in some rows.

    Attributes:
        plan: The interventions; empty in observational rows.
        targets: Variables whose own mechanism was replaced, sorted.
    """

    plan: Plan = field(default_factory=Plan)
    targets: tuple[str, ...] = ()

    @property
    def softly(self) -> frozenset[str]:
        """The targets that still follow their causes: shifted, scaled, or with another noise."""
        return frozenset(name for name, act in self.plan.at_start().items() if act.keeps_function())


EpisodePart = tuple[int, Regime, Regime, Floats]
"""Number, regime of the first row and of the others, and values, shape (rows, p)."""


@final
@typed
@dataclass(frozen=True, eq=False)
class Dataset:
    """Rows of numbers, each with the regime, the episode and the control step it comes from.

    Attributes:
        values: Shape (n, p).
        columns: The meaning of each column.
        regimes: The interventions; rows refer to them by number.
        regime: Number of the regime of each row, shape (n,).
        episode: Number of the episode of each row, shape (n,). Rows of one episode stand together,
            in time.
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
        if self.values.dtype.kind not in "biuf":
            raise ModelError([f"values are not real numbers, but of type {self.values.dtype}"])
        n, p = self.values.shape if self.values.ndim == 2 else (-1, -1)
        problems = []
        if p != len(self.columns):
            problems.append(
                f"values have shape {self.values.shape}, of {len(self.columns)} columns"
            )
        for what in ("regime", "episode", "step"):
            shape = getattr(self, what).shape
            if shape != (n,):
                problems.append(f"{what} has shape {shape}, not ({n},)")
        if not np.isfinite(self.values).all():
            row, column = np.argwhere(~np.isfinite(self.values))[0]
            problems.append(f"row {row} of {self.columns[column].name!r} is not finite")
        if len({column.name for column in self.columns}) != len(self.columns):
            problems.append("two columns have one name")
        if n > 0 and not problems:
            if not 0 <= self.regime.min() <= self.regime.max() < len(self.regimes):
                problems.append(f"a row refers to a regime that is not among {len(self.regimes)}")
            problems += _disorder(self.episode, self.step)
        if problems:
            raise ModelError(problems)

    @classmethod
    def of(
        cls,
        values: object,
        names: Sequence[str],
        *,
        targets: Sequence[Iterable[str] | None] | None = None,
        episode: ArrayLike | None = None,
        step: ArrayLike | None = None,
        **about: object,
    ) -> Dataset:
        """Build a table of numbers from elsewhere.

        Args:
            values: Shape (n, p); of a data frame, or of columns by name, those with these names.
            names: Names of the p columns, which are scalars.
            targets: The columns that were intervened on in each row; nowhere if None.
            episode: Episode of each row; each row is an episode if None.
            step: Control step of each row; 0 if None.
            about: Where the rows come from.

        Raises:
            ModelError: A column has no numbers, a name is not a text, or shapes do not fit
                together.
            UnknownVariable: A target, or a name in a data frame, is not a column.
        """
        table = numbers(values, names)
        n = len(table)
        given = [()] * n if targets is None else targets
        if not isinstance(given, Iterable) or not all(
            isinstance(t, Iterable | None) and not isinstance(t, np.ndarray) for t in given
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
    def _of_episodes(
        cls, columns: tuple[Column, ...], episodes: Iterable[EpisodePart], about: dict[str, Any]
    ) -> Dataset:
        """Build a table of whole episodes, sorted by their numbers."""
        regimes: dict[Regime, int] = {}
        known: dict[int, int] = {}  # numbers of regimes by their ids, which are faster to find
        kinds, steps, numbers = list[int](), list[int](), list[int]()
        parts = [np.empty((0, len(columns)))]
        for number, first, other, values in sorted(episodes, key=lambda episode: episode[0]):
            for regime in (first, other):
                if id(regime) not in known:
                    known[id(regime)] = regimes.setdefault(regime, len(regimes))
            at = known[id(first)], known[id(other)]
            kinds += [at[0], *[at[1]] * (len(values) - 1)]
            steps += range(len(values))
            numbers += [number] * len(values)
            parts.append(values)
        regime, episode, step = np.array([kinds, numbers, steps], dtype=np.int64)
        return cls(np.concatenate(parts), columns, tuple(regimes), regime, episode, step, about)

    # --- reading ------------------------------------------------------------------------------

    def __len__(self) -> int:
        return len(self.values)

    @typed
    def __getitem__(self, name: str) -> Floats:
        """Return a column, shape (n,), or all columns of a vector, shape (n, k)."""
        where = self._places([name])
        return self.values[:, where[0] if name in self.names else where]

    def __eq__(self, other: object) -> bool:
        """Return whether two tables hold the same, bit for bit."""
        return (
            isinstance(other, Dataset)
            and self.columns == other.columns
            and self.about == other.about
            and self.values.tobytes() == other.values.tobytes()
            and np.array_equal(self.episode, other.episode)
            and np.array_equal(self.step, other.step)
            and [self.regimes[i] for i in self.regime] == [other.regimes[i] for i in other.regime]
        )

    __hash__ = None  # type: ignore[assignment] # compared by content

    def __repr__(self) -> str:
        done = len({self.regimes[i].targets for i in np.unique(self.regime)})
        return f"Dataset({len(self)} rows, {len(self.columns)} columns, {done} regimes)"

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        return tuple(column.name for column in self.columns)

    @cached_property
    def blocks(self) -> dict[str, Ints]:
        """Numbers of the columns of each variable."""
        found: dict[str, list[int]] = {}
        for i, column in enumerate(self.columns):
            found.setdefault(block(column), []).append(i)
        return {name: np.array(where, dtype=np.int64) for name, where in found.items()}

    @property
    def variables(self) -> tuple[str, ...]:
        """The variables of the columns, in their order; with ``@-1`` for an earlier instant."""
        return tuple(self.blocks)

    @cached_property
    def targeted(self) -> Bools:
        """Which numbers were set from outside, shape (n, p)."""
        names = [block(column) for column in self.columns]
        return self._by_row([[name in r.targets for name in names] for r in self.regimes])

    @cached_property
    def soft(self) -> Bools:
        """Which of the ``targeted`` numbers still follow their causes, shape (n, p).

        These are shifted or scaled, or have another noise; all others were set, drawn, or follow
        other causes.
        """
        kinds = [[c.variable in r for c in self.columns] for r in (r.softly for r in self.regimes)]
        return self._by_row(kinds) & self.targeted

    def _by_row(self, kinds: list[list[bool]]) -> Bools:
        """Return for each row, shape (n, p), the marks of its regime."""
        return np.array(kinds, dtype=bool).reshape(len(kinds), len(self.columns))[self.regime]

    @property
    def targets(self) -> tuple[tuple[str, ...], ...]:
        """The variables that were intervened on in each row."""
        return tuple(self.regimes[kind].targets for kind in self.regime.tolist())

    @cached_property
    def target_names(self) -> tuple[tuple[str, ...], ...]:
        """Names of the columns set in each regime, then of the variables that have no column."""
        return tuple(
            (
                *(column.name for column in self.columns if block(column) in regime.targets),
                *(name for name in regime.targets if name not in self.blocks),
            )
            for regime in self.regimes
        )

    @cached_property
    def intervened(self) -> Bools:
        """The rows in which something was set, with or without a column, shape (n,)."""
        return np.array([bool(r.targets) for r in self.regimes], dtype=bool)[self.regime]

    @cached_property
    def hidden_targets(self) -> Bools:
        """The rows in which a variable that has no column was set, shape (n,)."""
        hidden = [not self.blocks.keys() >= {*r.targets} for r in self.regimes]
        return np.array(hidden, dtype=bool)[self.regime]

    @property
    def is_temporal(self) -> bool:
        """Whether an episode has several rows."""
        return bool(len(self)) and len(np.unique(self.episode)) < len(self)

    # --- the true graph -----------------------------------------------------------------------

    @cached_property
    def truth(self) -> GroundTruth | None:
        """The true graph over exactly these variables; None where it is not known.

        Variables without a column are hidden: they confound, and effects through them are direct
        ones. Where rows are episodes of a world, it is the graph from their beginning to their end.
        Of a table with ``lagged`` columns it is the graph among these.
        """
        from scm_world.discovery.data.truth import truth_of

        return truth_of(self)

    def acting(self) -> Dataset:
        """Leave out of ``truth`` the edges whose condition held in none of the rows.

        Edges by contact stay where their bodies touched, directly or through others, in a control
        step that led to a row; edges of initialisation where a row can be a first one.

        Raises:
            ModelError: The graph is not known, or the table was collected without contacts.
        """
        from scm_world.discovery.data.truth import acting_edges

        edges = acting_edges(self)
        return replace(self, about={**self.about, "truth": {**self.about["truth"], "edges": edges}})

    @property
    def contacts(self) -> dict[tuple[str, str], float]:
        """In which share of the control steps behind the rows each pair of bodies touched.

        Raises:
            ModelError: The table was collected without contacts.
        """
        from scm_world.discovery.data.truth import touches

        steps = {at: touch for row in touches(self) for at, touch in row.items()}
        counts = Counter(pair for touch in steps.values() for pair in touch)
        return {pair: counts[pair] / len(steps) for pair in sorted(counts)}

    def touching(self, *bodies: str) -> Bools:
        """Return the rows behind which bodies touched, shape (n,).

        Args:
            bodies: One body, which touched another; two bodies, which touched each other; nothing
                for the rows in which an edge by contact could act, other than one among the states
                of one body.

        Raises:
            ModelError: The table was collected without contacts, or does not know its graph.
            UnknownOption: More than two bodies are given.
        """
        from scm_world.discovery.data.truth import contact_edges, touches

        if not bodies:
            acting = contact_edges(self, between=True) if self._known else []
            return np.array([bool(edges) for edges in acting], dtype=bool)
        if len(bodies) > 2:
            raise UnknownOption("bodies", bodies, ("one body", "two bodies", "nothing"))
        pairs = [{pair for touch in row.values() for pair in touch} for row in touches(self)]
        found = [any({*bodies} <= {*pair} for pair in each) for each in pairs]
        return np.array(found, dtype=bool)

    @typed
    def adjacency(self, lag: int = 0) -> Bools:
        """Return the true edges of a lag between columns, shape (p, p): row causes column.

        Raises:
            ModelError: The graph is not known.
        """
        at = [self._known.names.index(block(column)) for column in self.columns]
        return self._known.adjacency(lag)[np.ix_(at, at)]

    @typed
    def weights(self, lag: int = 0) -> Floats:
        """Return the weights of true edges between columns, shape (p, p): row causes column.

        Zero without an edge (an edge can also have weight zero: see ``adjacency``), NaN
        where a mechanism on the way is not linear. Vectors of one size act number by number.
        Hidden variables between the two count; those that act on both do not, so that a regression
        gives another number for a confounded pair.

        Raises:
            ModelError: The graph is not known.
        """
        found, lag = np.zeros((len(self.columns),) * 2), whole_number("lag", lag, least=0)
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

    # --- other tables -------------------------------------------------------------------------

    def rows(self, chosen: Bools | Ints | Sequence[int] | slice | int) -> Dataset:
        """Return some rows: a mask, numbers or a slice.

        Raises:
            UnknownOption: It is something else, or too long.
        """
        try:
            if chosen is None or isinstance(chosen, bool):  # which NumPy takes for a new axis
                raise IndexError
            taken = np.arange(len(self))[chosen].reshape(-1)
        except IndexError:
            allowed = (f"a mask of {len(self)} rows", "whole numbers of rows", "a slice")
            raise UnknownOption("rows", chosen, allowed) from None
        parts = {
            name: getattr(self, name)[taken] for name in ("values", "regime", "episode", "step")
        }
        return replace(self, **parts)

    def _places(self, names: Iterable[str]) -> list[int]:
        """Return the numbers of the columns of some names, of columns or of variables."""
        where: list[int] = []
        for name in names:
            if name in self.names:
                where.append(self.names.index(name))
            elif name in self.blocks:
                where += self.blocks[name].tolist()
            else:
                raise UnknownVariable(name, (*self.names, *self.variables))
        return where

    @typed
    def select(self, names: Iterable[str]) -> Dataset:
        """Return some columns or variables, in the order given; the others are hidden then.

        Raises:
            UnknownVariable: Nothing has this name.
        """
        where = self._places(names)
        columns = tuple(self.columns[i] for i in where)
        return replace(self, values=self.values[:, where], columns=columns)

    @typed
    def hide(self, names: Iterable[str]) -> Dataset:
        """Leave out columns or variables; ``truth`` then has them as hidden causes.

        Raises:
            UnknownVariable: Nothing has this name.
        """
        gone = {*self._places(names)}
        return self.select([name for i, name in enumerate(self.names) if i not in gone])

    @property
    def observational(self) -> Dataset:
        """The rows without an intervention, on a column or on a variable that has none."""
        return self.rows(~self.intervened)

    @typed
    def first(self, episodes: int) -> Dataset:
        """Return the rows of the first episodes, in their order."""
        number = whole_number("episodes", episodes, least=0)
        return self.rows(np.isin(self.episode, np.unique(self.episode)[:number]))

    def standardised(self) -> Dataset:
        """Scale every column to mean 0 and variance 1 over all rows; constant ones become 0."""
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
        A variable that was set at an earlier step is a target at that step: ``x@-1``. The graph of
        the table is that among its columns, all of them at lag 0.

        Raises:
            ModelError: It has such columns already.

        Example:
            >>> table = Dataset.of([[1.0], [2.0], [3.0]], ["x"], episode=[0, 0, 1], step=[0, 1, 0])
            >>> table.lagged().names, table.lagged().values.tolist()
            (('x', 'x@-1'), [[2.0, 1.0]])
        """
        whole_number("lags", lags, least=0, most=len(self))
        if any(column.lag for column in self.columns):
            said = "the table has earlier control steps already: take lagged(2) at once"
            raise ModelError([said])
        back = range(lags + 1)
        rows = np.arange(lags, len(self))
        whole = rows[
            (self.episode[rows - lags] == self.episode[rows])
            & (self.step[rows] - self.step[rows - lags] == lags)
        ]
        earlier = (
            replace(column, name=f"{column.name}@-{lag}", lag=lag)
            for lag in back[1:]
            for column in self.columns
        )
        regimes: dict[Regime, int] = {}
        kinds, number = np.unique(
            np.stack([self.regime[whole - lag] for lag in back]), axis=1, return_inverse=True
        )
        at = []
        for kind in kinds.T.tolist():
            done = zip(back, (self.regimes[k].targets for k in kind), strict=True)
            targets = {f"{n}@-{lag}" if lag else n for lag, names in done for n in names}
            made = replace(self.regimes[kind[0]], targets=tuple(sorted(targets)))
            at.append(regimes.setdefault(made, len(regimes)))
        return replace(
            self.rows(whole),
            values=np.concatenate([self.values[whole - lag] for lag in back], axis=1),
            columns=(*self.columns, *earlier),
            regimes=tuple(regimes),
            regime=np.array(at, dtype=np.int64)[number.reshape(-1)],
            about={**self.about, "lags": lags},
        )

    @classmethod
    @typed
    def joined(cls, parts: Sequence[Dataset]) -> Dataset:
        """Put tables of one kind below one another.

        Raises:
            ModelError: They differ in columns or in where they come from, two have the same
                episodes, or the list is empty.
        """
        if not len(parts):
            raise ModelError(["the list of tables to join is empty"])
        first = parts[0]
        for part in parts[1:]:
            if part.columns != first.columns or part.about != first.about:
                raise ModelError(["tables with other columns or from elsewhere cannot be joined"])
        regimes: dict[Regime, int] = {}
        kinds: list[Ints] = []
        for part in parts:
            at = [regimes.setdefault(regime, len(regimes)) for regime in part.regimes]
            kinds.append(np.array(at, dtype=np.int64)[part.regime])
        return replace(
            first,
            regimes=tuple(regimes),
            regime=np.concatenate(kinds),
            values=np.concatenate([part.values for part in parts]),
            episode=np.concatenate([part.episode for part in parts]),
            step=np.concatenate([part.step for part in parts]),
        )


def numbers(values: Any, names: Sequence[str]) -> Floats:
    """Return columns of real numbers of an array, a data frame or a mapping, shape (n, p)."""
    import pandas

    if not isinstance(names, Iterable):
        raise UnknownOption("names", names, ("a list of the names of the columns",))
    labels = [*names]
    advice = "names of columns are text: frame.rename(columns=str), and in the targets, too"
    wrong = [f"a column is named {n!r}; {advice}" for n in labels if not isinstance(n, str)]
    if wrong:
        raise ModelError(wrong)
    try:
        named = isinstance(values, pandas.DataFrame | Mapping)
        frame = pandas.DataFrame(values, columns=None if named else labels)
    except (TypeError, ValueError) as error:
        raise ModelError(
            [f"the values are not a table of {len(labels)} columns: {error}"]
        ) from None
    for name in labels:
        if name not in frame:
            raise UnknownVariable(name, map(str, frame))
    frame, columns = frame[labels], []
    if not frame.columns.is_unique:
        raise ModelError([f"two of the columns {', '.join(map(str, frame))} have one name"])
    for name in labels:
        try:
            columns.append(real_numbers(frame[name]))
        except TypeError as error:
            wrong.append(f"the column {name!r}: {error}")
    if wrong:
        raise ModelError(wrong)
    return np.array(columns).reshape(len(labels), len(frame)).T


def check_commands(about: Mapping[str, Any], columns: Iterable[Column]) -> None:
    """Refuse rows of equations as versions before 0.3 wrote them, out of step with the graph."""
    commands = [column.name for column in columns if column.role == "action"]
    steps = about.get("steps") if about.get("system") == "model" else 0
    if commands and steps and "commands" not in about:
        said = f"the rows have the command of the step before in {', '.join(commands)}"
        raise ModelError([f"{said}, and the graph that of the step: collect it again"])


def check_names(columns: Iterable[Column]) -> None:
    """Refuse columns that are named like the further ones of frames and files."""
    taken = [column.name for column in columns if column.name in RECORDED]
    if taken:
        raise ModelError([f"a column cannot be named {name!r} in a file" for name in taken])


def _disorder(episode: Ints, step: Ints) -> list[str]:
    """Name the first row that does not stand with its episode, at a later step."""
    begins = np.flatnonzero(np.diff(episode, prepend=episode[:1] - 1))
    _, first = np.unique(episode[begins], return_index=True)
    back = np.flatnonzero((np.diff(episode) == 0) & (np.diff(step) <= 0)) + 1
    wrong = [*np.delete(begins, first), *back]
    if not wrong:
        return []
    row = min(wrong)
    number, instant = episode[row], step[row]
    if ((episode[:row] == number) & (step[:row] == instant)).any():
        return [
            f"two rows are step {instant} of episode {number}: if two tables have the same episode "
            "numbers, give one of them others; if not, give each row of an episode its own step"
        ]
    return [
        f"the rows of episode {number} do not stand together in time: sort the rows by episode "
        "and step"
    ]


def block(column: Column) -> str:
    """Return the name of the variable of a column, with ``@-1`` for an earlier instant."""
    return f"{column.variable}@-{column.lag}" if column.lag else column.variable
