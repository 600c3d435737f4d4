"""Rows of values, one for each world of a structure, and the mechanisms that compute them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from inspect import signature
from math import isfinite, prod
from typing import Any, final

import numpy as np
from numba.core.errors import NumbaError
from numba.extending import is_jitted

from scm_world._types import ArrayLike, Floats, Integers, Value
from scm_world.errors import FunctionFailure, ScmWorldError, in_one_line
from scm_world.graph import SCM
from scm_world.variables import Integers as WholeNumbers
from scm_world.variables import Linear, Parent
from scm_world.variables.mechanisms import PACKAGE, Stacked, Unboxed
from scm_world.variables.reserved import CONTROL_INDEX
from scm_world.world.kernels import (
    NUMBER,
    VECTOR,
    WHOLE,
    addresses,
    begin_step,
    run,
    weighted_sum,
)

_NO_PROGRAM: tuple[Any, list[Any]] = (..., [])

FIRST = np.zeros(1, dtype=np.int64)
"""The row index of a single world."""


@final
class Mechanisms:
    """The mechanisms of a structure, and the columns of its variables.

    Args:
        model: The model that declares the variables.
        computed: Variables that are computed from states, causes before effects.
        static: Variables that only interventions change.
        states: Columns of the states, which come first.
        actions: Place of each action in the vector of all actions.
        sizes: Number of components of all states and of all actions.

    Attributes:
        where: Columns of each variable.
        earlier: Columns of values of one control step ago.
        actions: Columns of all actions.
        start: A row before anything is written into it, shape (width,).
        computed: The computed variables, causes before effects.
        whole: Integer variables.
        reading: Columns and shape of each variable, and whether it is an integer.
        static: Variables that only interventions change.
        decided: The same variables, unordered.
        owners: Index of the static variable of each column, -1 of others, shape (width,).
        clock: Column of the number of control steps.
        stepped: Columns that a control step writes; see ``begin_step``.
        fresh: Column that is 1 if the values to remember are up to date.
    """

    def __init__(
        self,
        model: SCM,
        computed: Iterable[str],
        static: Iterable[str],
        states: Mapping[str, slice],
        actions: Mapping[str, slice],
        sizes: tuple[int, int],
    ) -> None:
        self._model = model
        self._width = self.state_size = sizes[0]
        self._constants: list[tuple[slice, Any]] = []
        self.actions = self._take(sizes[1])
        first = self.actions.start
        self.where = dict(states)
        self.where |= {n: slice(first + at.start, first + at.stop) for n, at in actions.items()}
        self.computed = tuple(name for name in computed if name not in self.where)
        for name in (CONTROL_INDEX, *model):
            if name not in self.where:
                self.where[name] = self._take(prod(model.declared(name).shape))
        parents = [p for name in self.computed for p in model.declared(name).all_parents]
        lagged = dict.fromkeys(p.name for p in parents if p.lag)
        self.earlier = {n: self._take(prod(model.declared(n).shape)) for n in lagged}
        self.whole = frozenset(n for n in model if model.declared(n).dtype != "real")
        self.reading = {
            name: (place, model.declared(name).shape, name in self.whole)
            for name, place in self.where.items()
        }
        self.static = tuple(static)
        self.decided = frozenset(self.static)
        followed = {*self.computed}
        given = [place for name, place in self.where.items() if name not in followed]
        self.kept = places([slice(0, self.state_size), *given, *self.earlier.values()])
        self._steps = {name: self._bound(name) for name in self.computed}
        self.clock, self.fresh = self.where[CONTROL_INDEX].start, self._take(1).start
        one = self._take(1)
        self._constants.append((one, 1.0))
        self._mark = _copy([one], [slice(self.fresh, self.fresh + 1)]) if self.earlier else None
        remembered = [self.where[name] for name in self.earlier]
        memory = np.stack([places(remembered), places(self.earlier.values())], axis=1)
        first = [(self.clock, self.fresh), (self.actions.start, self.actions.start)]
        self.stepped = np.concatenate([first, memory])
        self._programs: dict[tuple[str, ...] | None, list[Any]] = {}
        self.owners = np.full(self._width, -1)
        for number, name in enumerate(self.static):
            self.owners[self.where[name]] = number
        self.start = np.zeros(self._width)
        for place, value in self._constants:
            self.start[place] = value

    def _take(self, size: int) -> slice:
        first, self._width = self._width, self._width + size
        return slice(first, self._width)

    def needed(self, names: Iterable[str]) -> tuple[str, ...]:
        """List the computed variables on which some names and the memory depend, causes first."""
        wanted: set[str] = set()
        stack = [*names, *self.earlier]
        while stack:
            name = stack.pop()
            if name in self._steps and name not in wanted:
                wanted.add(name)
                stack.extend(p.name for p in self._model.declared(name).all_parents if not p.lag)
        return tuple(name for name in self.computed if name in wanted)

    def program(self, names: tuple[str, ...] | None) -> list[Any]:
        """Return what computes variables, their causes and the inputs of the memory in a row."""
        found = self._programs.get(names)
        if found is None:
            wanted = self.computed if names is None else names
            steps = [step for name in self.needed(wanted) for step in self._steps[name]]
            steps += [self._mark] if self._mark is not None else []
            found = self._programs[names] = _program(steps)
        return found

    # --- binding ------------------------------------------------------------------------------

    def _bound(self, name: str) -> list[_Step]:
        """Bind a mechanism to columns, as compiled steps if possible, else as a Python step."""
        variable: Any = self._model.declared(name)
        parents: tuple[Parent, ...] = tuple(variable.all_parents)
        columns = [(self.earlier if p.lag else self.where)[p.name] for p in parents]
        if variable.parts:
            return [_copy(columns, [self.where[name]])]
        function, constants = _positional(variable.mechanism, len(parents))
        called: Any = function.kernel if isinstance(function, Stacked | Unboxed) else function
        if not is_jitted(called):
            return [_Python(self, name, variable, parents, columns)]
        shapes = [self._model.declared(p.name).shape for p in parents]
        numbers = [self._model.declared(p.name).dtype == "real" for p in parents]
        scalars = [WHOLE if not real else NUMBER for real in numbers]
        kinds = [VECTOR if shape else kind for shape, kind in zip(shapes, scalars, strict=True)]
        flat = all(len(shape) <= 1 for shape in shapes)
        if isinstance(function, Stacked):
            kinds, flat = [VECTOR], True
        elif not all(real or not shape for real, shape in zip(numbers, shapes, strict=True)):
            flat = False
        if isinstance(variable.mechanism, Linear) and any(shapes):
            flat = False
        kinds += [VECTOR if np.shape(value) else NUMBER for value in constants]
        is_vector = variable.shape != ()
        found = None
        if parents and flat and len(variable.shape) < 2:
            found = addresses(called, tuple(kinds), is_vector=is_vector)
        if found is None:
            return [_Python(self, name, variable, parents, columns)]
        steps: list[_Step] = []
        if isinstance(function, Stacked):
            whole = self._take(sum(at.stop - at.start for at in columns))
            steps, columns = [_copy(columns, [whole])], [whole]
        for value in constants:
            columns.append(self._take(np.size(value)))
            self._constants.append((columns[-1], value))
        where = [(at.start, at.stop) for at in (*columns, self.where[name])]
        return [*steps, _Compiled(found, np.array(where), called)]


@final
class Rows(Mapping[str, Value]):
    """The values of one or several worlds by name: views of numbers, integers as copies.

    Each world is a row of numbers: its state, its actions, its clock, all other variables and the
    values of one control step ago. The same program computes one row or many, with equal bits.

    Args:
        mechanisms: The mechanisms, with the columns.
        numbers: Shape (width,) for one world; or (n, width): then values have a leading axis.
        unknown: Variables without values yet.

    Attributes:
        matrix: The numbers, shape (n, width); of one world None before ``evaluate``.
    """

    __slots__ = ("_program", "_views", "matrix", "mechanisms", "numbers", "unknown")

    def __init__(
        self, mechanisms: Mechanisms, numbers: Floats, unknown: Iterable[str] = ()
    ) -> None:
        self.mechanisms, self.numbers, self.unknown = mechanisms, numbers, {*unknown}
        self._program: tuple[Any, list[Any]] = _NO_PROGRAM  # the last names, and what computes them
        self.matrix: Any = numbers if numbers.ndim == 2 else None  # most copies do without
        self._views: dict[str, Value] = {}

    def __getitem__(self, name: str) -> Value:
        view = self._views.get(name)
        if view is None:
            place, shape, is_whole = self.mechanisms.reading[name]
            view = self.numbers[..., place].reshape(self.numbers.shape[:-1] + shape)
            if is_whole:
                return view.astype(np.int64)
            self._views[name] = view
        return view

    def __setitem__(self, name: str, value: ArrayLike) -> None:
        if isinstance(value, np.ndarray) and value.ndim > 1:
            value = value.ravel()
        self.numbers[self.mechanisms.where[name]] = value
        self.unknown.discard(name)

    def __contains__(self, name: object) -> bool:
        return name in self.mechanisms.where and name not in self.unknown

    def __iter__(self) -> Iterator[str]:
        return iter(self.mechanisms.where)

    def __len__(self) -> int:
        return len(self.mechanisms.where)

    def copy(self) -> Rows:
        """Return an independent copy."""
        return Rows(self.mechanisms, self.numbers.copy())

    def row(self, index: int) -> Rows:
        """Return one of several worlds, as a view."""
        return Rows(self.mechanisms, self.numbers[index])

    @property
    def actions(self) -> Floats:
        """All actions, shape (..., n_actions), as a view."""
        return self.numbers[..., self.mechanisms.actions]

    def earlier(self) -> dict[str, Value]:
        """Return the kept values of one control step ago, as views."""
        lead, reading = self.numbers.shape[:-1], self.mechanisms.reading
        return {
            name: self.numbers[..., place].reshape(lead + reading[name][1])
            for name, place in self.mechanisms.earlier.items()
        }

    def evaluate(self, names: tuple[str, ...] | None = None, which: Integers = FIRST) -> None:
        """Compute variables, and the inputs of the memory.

        Args:
            names: Names of the variables; all if None.
            which: Indices of the worlds, shape (m,).

        Raises:
            FunctionFailure: A function fails, or returns an invalid value.
        """
        if self._program[0] is not names:
            self._program = names, self.mechanisms.program(names)
            if self.matrix is None:
                self.matrix = self.numbers[None]
        for step in self._program[1]:
            if type(step) is _Python:
                step(self.matrix, which)
            else:
                run(self.matrix, which, step)

    def prepare(self, which: Integers = FIRST) -> None:
        """Compute the values that the next control step remembers."""
        if self.mechanisms.earlier:
            stale = which[self.numbers[..., self.mechanisms.fresh].reshape(-1)[which] == 0.0]
            if stale.size:
                self.evaluate((), stale)

    def advance(self, commands: Floats, which: Integers = FIRST) -> None:
        """Begin a control step of prepared rows: remember, take the actions, move the clock.

        Args:
            commands: All actions of every world, shape (n_actions,) or (n, n_actions).
            which: Indices of the worlds, shape (m,).
        """
        matrix = self.numbers[None] if self.matrix is None else self.matrix
        given = commands if commands.ndim == 1 else commands.reshape(-1)
        begin_step(matrix, which, given, self.mechanisms.stepped)

    def remember(self) -> None:
        """Make the present values of one world those of one control step ago."""
        self.prepare()
        memory = self.mechanisms.stepped[2:]
        self.numbers[memory[:, 1]] = self.numbers[memory[:, 0]]
        self.numbers[self.mechanisms.fresh] = 0.0

    def take(self, other: Rows) -> None:
        """Copy the values of another row, whose computed values may be outdated."""
        self.numbers[...] = other.numbers
        self.numbers[self.mechanisms.fresh] = 0.0

    def differing(self, other: Rows) -> list[str]:
        """List the static variables of both rows whose values differ."""
        here, there = self.mechanisms, other.mechanisms
        if here is not there:
            both = (name for name in there.static if name in here.decided)
            return [name for name in both if not np.array_equal(self[name], other[name])]
        owners = {*here.owners[self.numbers != other.numbers].tolist()}
        return [here.static[number] for number in sorted(owners) if number >= 0]

    def following(self, last: Rows) -> Rows:
        """Copy the clock, the actions and the memory of a row of another structure."""
        self[CONTROL_INDEX] = last[CONTROL_INDEX]
        if self.actions.shape == last.actions.shape:
            self.actions[:] = last.actions
        self.recall(last)
        return self

    def recall(self, last: Rows) -> None:
        """Copy the values of one control step ago that a row of another structure has, too."""
        kept, before = self.earlier(), last.earlier()
        for name in kept.keys() & before.keys():
            kept[name][...] = before[name]


@final
@dataclass(frozen=True, eq=False)
class _Compiled:
    """A step of a program; see ``run``. It keeps a reference to the function of its address."""

    addresses: tuple[int, int]
    where: Integers
    function: Any = None


@final
class _Python:
    """A Python function, called row by row with views of the values of its parents."""

    def __init__(
        self,
        mechanisms: Mechanisms,
        name: str,
        variable: Any,
        parents: tuple[Parent, ...],
        columns: list[slice],
    ) -> None:
        self._variable, self._place = variable, mechanisms.where[name]
        self._is_number = variable.shape == () and not variable.bounds
        self._clock = mechanisms.where[CONTROL_INDEX].start
        home = getattr(variable.mechanism, "reference", PACKAGE).partition(":")[0]
        self._is_users = home.partition(".")[0] != PACKAGE
        self._function: Callable[..., Any] = variable.mechanism.bind()
        names = [parent.name for parent in parents]
        shapes = [mechanisms.reading[name][1] for name in names]
        self._parents = [*zip(columns, shapes, strict=True)]
        self._whole = [index for index, n in enumerate(names) if n in mechanisms.whole]
        self._last: tuple[Floats | None, dict[int, list[Floats]]] = None, {}  # a matrix, its views

    def __call__(self, matrix: Floats, rows: Integers) -> None:
        last = self._last
        if last[0] is not matrix:
            last = self._last = matrix, {}
        for row in rows.tolist():
            given = last[1].get(row)
            if given is None:
                given = [matrix[row, at].reshape(shape) for at, shape in self._parents]
                last[1][row] = given
            if self._whole:
                given = [*given]
                for index in self._whole:
                    given[index] = given[index].astype(np.int64)
            try:
                value = self._function(*given)
            except ScmWorldError:
                raise
            except Exception as error:
                why = str(error).strip().splitlines()[-1:] if isinstance(error, NumbaError) else ()
                text = f"cannot be compiled: {why[0]}" if why else f"raised {in_one_line(error)}"
                raise self._failure(matrix, row, text) from error
            if type(value) is float and self._is_number and isfinite(value):
                matrix[row, self._place.start] = value
                continue
            problem = wrong_value(self._variable, value) if self._is_users else ""
            if problem:
                raise self._failure(matrix, row, problem)
            matrix[row, self._place] = np.asarray(value, dtype=np.float64).ravel()

    def _failure(self, matrix: Floats, row: int, text: str) -> FunctionFailure:
        step, name = matrix[row, self._clock], self._variable.name
        found = FunctionFailure(f"in control step {step:.0f}, the function of {name!r} {text}")
        found.row = row
        return found


def wrong_value(variable: Any, value: Any) -> str:
    """Return the error in a value that the function of a variable returned, or an empty text."""
    if type(value) is float and isfinite(value) and variable.shape == () and not variable.bounds:
        return ""
    try:
        numbers = np.asarray(value)
    except ValueError:  # a ragged list
        numbers = np.asarray(None)
    is_number = numbers.dtype.kind in "biuf" and numbers.shape == variable.shape
    if not is_number or not np.isfinite(numbers).all():
        wanted = (
            f"finite numbers of shape {variable.shape}" if variable.shape else "a finite number"
        )
        return f"gives {value!r}, not {wanted}"
    if isinstance(variable.bounds, WholeNumbers) and not variable.bounds.contains(numbers):
        return f"gives {value!r}, not in {variable.bounds.describe()}"
    return ""


_Step = _Compiled | _Python


def _copy(sources: Iterable[slice], targets: Iterable[slice]) -> _Compiled:
    return _Compiled((0, 0), np.stack([places(sources), places(targets)], axis=1))


def _program(steps: Iterable[_Step]) -> list[Any]:
    """Build a program: arrays for ``run``, and Python functions between them.

    The functions of addresses are kept by the steps of ``Mechanisms``.
    """
    program: list[Any] = []
    compiled: list[_Compiled] = []
    for step in (*steps, None):
        if isinstance(step, _Compiled):
            compiled.append(step)
            continue
        if compiled:
            lines: list[Any] = []
            for one in compiled:
                lines += [[one.addresses, (len(one.where), 0)], one.where]
            program.append(np.concatenate(lines, dtype=np.int64))
            compiled = []
        if step is not None:
            program.append(step)
    return program


def places(slices: Iterable[slice]) -> Integers:
    """List the columns of slices, shape (n,)."""
    parts = [np.arange(where.start, where.stop) for where in slices]
    return np.concatenate([np.empty(0, dtype=np.int64), *parts])


def _positional(mechanism: Any, count: int) -> tuple[Any, tuple[Any, ...]]:
    """Split the function of a mechanism into a function without constants, and the constants."""
    if isinstance(mechanism, Linear):
        return Stacked(weighted_sum), (np.array(mechanism.weights), mechanism.intercept)
    function = mechanism.bind()
    if not isinstance(function, partial):
        return function, ()
    inner: Any = function.func
    kernel = inner.kernel if isinstance(inner, Stacked | Unboxed) else inner
    count = 1 if isinstance(inner, Stacked) else count
    compiled = getattr(kernel, "py_func", None)
    names = () if compiled is None else tuple(signature(compiled).parameters)[count:]
    if set(names) != set(function.keywords):
        return function, ()
    return inner, tuple(function.keywords[name] for name in names)
