"""Rows of values, one for each world of a structure, and the mechanisms that compute them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from inspect import signature
from math import isfinite
from typing import TYPE_CHECKING, Any, final

import numpy as np
from numba.core.errors import NumbaError

from scm_world._types import ArrayLike, Floats, Integers, Value
from scm_world.errors import FunctionFailure, ScmWorldError, in_one_line
from scm_world.variables import Integers as WholeNumbers
from scm_world.variables import Linear, Variable
from scm_world.variables.mechanisms import PACKAGE, Stacked, Unboxed
from scm_world.variables.reserved import CONTROL_INDEX
from scm_world.world.kernels import begin_step, run, weighted_sum

if TYPE_CHECKING:
    from scm_world.world.compiled_task import CompiledTask

_NO_PROGRAM: tuple[Any, list[Any]] = (..., [])

FIRST = np.zeros(1, dtype=np.int64)
"""The row index of a single world."""


@final
class Rows(Mapping[str, Value]):
    """The values of one or several worlds by name: views of numbers, integers as copies.

    The same program computes one row or many, with equal bits.

    Args:
        compiled: The task, with the columns of its variables and their mechanisms.
        numbers: Shape (width,) for one world; or (n, width): then values have a leading axis.
        unknown: Variables without values yet.

    Attributes:
        matrix: The numbers, shape (n, width); of one world None before ``evaluate``.
    """

    __slots__ = ("_program", "_views", "compiled", "matrix", "numbers", "unknown")

    def __init__(
        self, compiled: CompiledTask, numbers: Floats, unknown: Iterable[str] = ()
    ) -> None:
        self.compiled, self.numbers, self.unknown = compiled, numbers, {*unknown}
        self._program: tuple[Any, list[Any]] = _NO_PROGRAM  # the last names, and what computes them
        self.matrix: Any = numbers if numbers.ndim == 2 else None  # most copies do without
        self._views: dict[str, Value] = {}

    def __getitem__(self, name: str) -> Value:
        view = self._views.get(name)
        if view is None:
            place, shape, is_whole = self.compiled.reading[name]
            view = self.numbers[..., place].reshape(self.numbers.shape[:-1] + shape)
            if is_whole:
                return view.astype(np.int64)
            self._views[name] = view
        return view

    def __setitem__(self, name: str, value: ArrayLike) -> None:
        place, shape, _ = self.compiled.reading[name]
        if shape:
            found = np.asarray(value)  # without an axis of worlds, the same in all of them
            self.numbers[..., place] = found.reshape(*found.shape[: found.ndim - len(shape)], -1)
        else:
            self.numbers[..., place.start] = value
        self.unknown.discard(name)

    def __contains__(self, name: object) -> bool:
        return name in self.compiled.where and name not in self.unknown

    def __iter__(self) -> Iterator[str]:
        return iter(self.compiled.where)

    def __len__(self) -> int:
        return len(self.compiled.where)

    def copy(self) -> Rows:
        """Return an independent copy."""
        return Rows(self.compiled, self.numbers.copy())

    def row(self, index: int) -> Rows:
        """Return one of several worlds, as a view."""
        return Rows(self.compiled, self.numbers[index])

    @property
    def actions(self) -> Floats:
        """All actions, shape (..., n_actions), as a view."""
        return self.numbers[..., self.compiled.action_columns]

    def earlier(self) -> dict[str, Value]:
        """Return the kept values of one control step ago, as views."""
        lead, reading = self.numbers.shape[:-1], self.compiled.reading
        return {
            name: self.numbers[..., place].reshape(lead + reading[name][1])
            for name, place in self.compiled.earlier.items()
        }

    def evaluate(self, names: tuple[str, ...] | None = None, which: Integers = FIRST) -> None:
        """Compute variables, all if None, and the inputs of the memory, in the worlds ``which``.

        Raises:
            FunctionFailure: A function fails, or returns an invalid value.
        """
        if self._program[0] is not names:
            self._program = names, self.compiled.program(names)
            if self.matrix is None:
                self.matrix = self.numbers[None]
        for step in self._program[1]:
            if type(step) is PythonStep:
                step(self.matrix, which)
            else:
                run(self.matrix, which, step)

    def prepare(self, which: Integers = FIRST) -> None:
        """Compute the values that the next control step remembers."""
        if self.compiled.earlier:
            stale = which[self.numbers[..., self.compiled.fresh].reshape(-1)[which] == 0.0]
            if stale.size:
                self.evaluate((), stale)

    def advance(self, commands: Floats, which: Integers = FIRST) -> None:
        """Begin a control step of prepared rows: remember, take the actions, move the clock.

        ``commands`` has the actions of every world, shape (n_actions,) or (n, n_actions).
        """
        matrix = self.numbers[None] if self.matrix is None else self.matrix
        given = commands if commands.ndim == 1 else commands.reshape(-1)
        begin_step(matrix, which, given, self.compiled.stepped)

    def remember(self, which: Integers = FIRST) -> None:
        """Make the present values those of one control step ago, in the worlds ``which``."""
        self.prepare(which)
        memory = self.compiled.stepped[2:]
        if self.numbers.ndim == 1:
            self.numbers[memory[:, 1]] = self.numbers[memory[:, 0]]
            self.numbers[self.compiled.fresh] = 0.0
        else:
            rows = which[:, None]
            self.numbers[rows, memory[:, 1]] = self.numbers[rows, memory[:, 0]]
            self.numbers[which, self.compiled.fresh] = 0.0

    def differing(self, other: Rows) -> list[str]:
        """List the static variables of both rows whose values differ."""
        here, there = self.compiled, other.compiled
        if here is not there:
            both = (name for name in there.static_names if name in here.static)
            return [name for name in both if not np.array_equal(self[name], other[name])]
        owners = {*here.owners[self.numbers != other.numbers].tolist()}
        return [here.static_names[number] for number in sorted(owners) if number >= 0]

    def recall(self, last: Rows) -> None:
        """Copy the values of one control step ago that a row of another structure has, too."""
        kept, before = self.earlier(), last.earlier()
        for name in kept.keys() & before.keys():
            kept[name][...] = before[name]


@final
@dataclass(frozen=True, eq=False)
class CompiledStep:
    """A step of a program; see ``run``. It keeps a reference to the function of its address.

    ``vectors`` says which of its arguments, and last its result, are vectors.
    """

    addresses: tuple[int, int]
    where: Integers
    function: Any = None
    vectors: tuple[bool, ...] = ()


@final
class PythonStep:
    """A Python function, called row by row with views of the values of its parents."""

    def __init__(
        self, compiled: CompiledTask, name: str, variable: Any, columns: list[slice]
    ) -> None:
        self._variable, self._place = variable, compiled.where[name]
        self.reads, self.writes = columns, self._place
        self._is_number = variable.shape == () and not variable.bounds
        self._clock = compiled.where[CONTROL_INDEX].start
        home = getattr(variable.equation, "reference", PACKAGE).partition(":")[0]
        self._is_users = home.partition(".")[0] != PACKAGE
        self._function: Callable[..., Any] = variable.equation.bind()
        readings = [compiled.reading[parent.name] for parent in variable.all_parents]
        self._parents = [(at, shape) for at, (_, shape, _) in zip(columns, readings, strict=True)]
        self._whole = [index for index, (*_, whole) in enumerate(readings) if whole]
        self._last: tuple[Floats | None, dict[int, list[Floats]]] = None, {}  # a matrix, its views

    def __call__(self, matrix: Floats, rows: Integers) -> None:
        """Write the value of some rows."""
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


def wrong_value(variable: Variable, value: object) -> str:
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


Step = CompiledStep | PythonStep


def copied(sources: Iterable[slice], targets: Iterable[slice]) -> CompiledStep:
    """Return the step that copies columns."""
    return CompiledStep((0, 0), np.stack([places(sources), places(targets)], axis=1))


def program_of(steps: Iterable[Step]) -> list[Any]:
    """Build a program: arrays for ``run``, and Python functions between them.

    The functions of addresses are kept by the steps of ``CompiledTask``.
    """
    program: list[Any] = []
    compiled: list[CompiledStep] = []
    for step in (*steps, None):
        if isinstance(step, CompiledStep):
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


def positional(mechanism: Any, count: int) -> tuple[Any, tuple[Any, ...]]:
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
