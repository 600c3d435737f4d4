"""Compiled functions of a few variables, called on rows of a matrix of values.

Each row is a world, and each variable has some of the columns. A step of a program is one compiled
function with its columns; a whole program runs in one compiled call. The code between a row and
a function depends on the types of the function only, and is kept on disk.
"""

from __future__ import annotations

import logging
import multiprocessing
from functools import cache
from typing import Any, final

from numba import types
from numba.core import cgutils, event
from numba.core.errors import NumbaError
from numba.extending import intrinsic

from scm_world._types import Floats, Integers
from scm_world.geometry.numbers import UNCACHED, njit
from scm_world.variables.mechanisms import PACKAGE

_types: Any = types  # numba is untyped
_cgutils: Any = cgutils
VECTOR, NUMBER, WHOLE = types.float64[::1], types.float64, types.int64
_WHERE = types.int64[:, ::1]
_HEAD = (types.int64, VECTOR, _WHERE)


def _read_number(row: Floats, where: Integers, i: int) -> Any:
    return row[where[i, 0]]


LONG = 40
"""Number of functions that are compiled before a warning is logged; it takes seconds."""


@final
class _Compiling(event.Listener):
    """Logs once that this package is being compiled.

    Numba caches compiled functions on disk, so only the first start takes long.
    """

    count = 0

    def on_start(self, one: event.Event) -> None:
        home = str(one.data["dispatcher"].py_func.__module__).partition(".")[0]
        self.count += home == PACKAGE
        if self.count == LONG and multiprocessing.parent_process() is None:
            self.count += 1
            later = "the first start; later ones find them in the cache of numba"
            if UNCACHED:
                later = "every start: set NUMBA_CACHE_DIR to a folder that can be written"
            said = f"scm_world compiles its functions, which takes about 20 seconds at {later}"
            logging.getLogger("scm_world").warning(said)

    def on_end(self, one: event.Event) -> None:
        pass


_events: Any = event  # numba is untyped
COMPILING = _Compiling()
_events.register("numba:compile", COMPILING)


def _read_vector(row: Floats, where: Integers, i: int) -> Any:
    return row[where[i, 0] : where[i, 1]]


def _write_number(row: Floats, where: Integers, i: int, value: float) -> None:
    row[where[i, 0]] = value


def _write_vector(row: Floats, where: Integers, i: int, value: Floats) -> None:
    first, length = where[i, 0], where[i, 1] - where[i, 0]
    if len(value) != length:
        raise ValueError("a compiled mechanism gave a vector of another length than declared")
    for k in range(length):  # numba compiles an assignment of slices for seconds
        row[first + k] = value[k]


def _called(typing: Any, address: Any, row: Any, where: Any, kinds: Any, result: Any) -> Any:
    """Call the function at an address with values of a row, and write its result there."""
    arguments, found = kinds.instance_type.types, result.instance_type

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        place, values = given[1:3], []
        for i, kind in enumerate(arguments):
            is_vector = isinstance(kind, types.Array)
            read, raw = (_read_vector, VECTOR) if is_vector else (_read_number, NUMBER)
            at = context.get_constant(types.intp, i)
            typed = raw(VECTOR, _WHERE, types.intp)
            value = context.compile_internal(builder, read, typed, [*place, at])
            values.append(context.cast(builder, value, raw, kind))
        calls = context.call_conv
        kind = calls.get_function_type(found, arguments).as_pointer()
        function = builder.inttoptr(given[0], kind)
        status, value = calls.call_function(builder, function, found, arguments, values)
        with _cgutils.if_unlikely(builder, status.is_error):
            calls.return_status_propagate(builder, status)
        write = _write_vector if isinstance(found, types.Array) else _write_number
        at = context.get_constant(types.intp, len(arguments))
        typed = types.void(VECTOR, _WHERE, types.intp, found)
        context.compile_internal(builder, write, typed, [*place, at, value])
        for kind, held in (*zip(arguments, values, strict=True), (found, value)):
            context.nrt.decref(builder, kind, held)
        return context.get_dummy_value()

    return types.void(address, row, where, kinds, result), generate


_call: Any = intrinsic(_called)


def _adapter(address: int, row: Floats, where: Integers, kinds: object, result: object) -> None:
    _call(address, row, where, kinds, result)


_LIKE = _types.TypeRef(_types.Tuple((NUMBER,))), _types.TypeRef(NUMBER)
"""Types have no value at run time, so the adapters of all signatures are called alike."""


def _adapted(
    typing: object, adapter: types.Type, address: object, row: object, where: object
) -> Any:
    """Call an adapter at its address."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        calls, kinds = context.call_conv, (*_HEAD, *_LIKE)
        kind = calls.get_function_type(types.void, kinds).as_pointer()
        function = builder.inttoptr(given[0], kind)
        none = context.get_dummy_value()
        values = [*given[1:], none, none]
        status, _ = calls.call_function(builder, function, types.void, kinds, values)
        with _cgutils.if_unlikely(builder, status.is_error):
            calls.return_status_propagate(builder, status)
        return context.get_dummy_value()

    return types.void(adapter, *_HEAD), generate


_call_adapter: Any = intrinsic(_adapted)


def _address(function: Any, signature: Any) -> int:
    compiled = function.get_compile_result(signature)
    found: int = compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name)
    return found


@cache
def _adapter_of(signature: Any) -> tuple[Any, int]:
    kinds = _types.TypeRef(_types.Tuple(signature.args)), _types.TypeRef(signature.return_type)
    signature = types.void(*_HEAD, *kinds)
    compiled = njit(signature, cache=True)(_adapter)
    return compiled, _address(compiled, signature)  # the code is freed with the function


def addresses(function: Any, kinds: tuple[Any, ...], *, is_vector: bool) -> tuple[int, int] | None:
    """Return the addresses of the adapter that calls a compiled function on a row, and of this.

    None if it cannot be compiled for arguments of the ``kinds`` (``NUMBER``, ``WHOLE``, ``VECTOR``)
    with a vector, or a number, as its result. The caller keeps a reference to the function.
    """
    try:
        function.compile(kinds)
        overload: Any = function.overloads[kinds]
    except (NumbaError, KeyError, RuntimeError):
        return None
    result = _types.unliteral(overload.signature.return_type)
    one = isinstance(result, types.Float | types.Integer | types.Boolean)
    if not (result == VECTOR if is_vector else one):
        return None
    signature = result(*kinds)
    return _adapter_of(signature)[1], _address(function, signature)


@njit(cache=True)
def run(matrix: Floats, rows: Integers, program: Integers) -> None:
    """Run the steps of a program on some rows.

    Args:
        matrix: The values, shape (n, width).
        rows: Indices of the rows, shape (m,).
        program: The steps one after another, shape (l, 2). Each begins with the addresses of its
            adapter and its function, and with the number of lines that follow. These are the first
            and last column of each argument and, at the end, of the result. Adapter 0 copies
            columns: its lines are pairs of source and target.
    """
    step = 0
    while step < program.shape[0]:
        adapter, function = program[step, 0], program[step, 1]
        where = program[step + 2 : step + 2 + program[step + 1, 0]]
        for row in rows:
            if adapter == 0:
                for j in range(where.shape[0]):
                    matrix[row, where[j, 1]] = matrix[row, where[j, 0]]
            else:
                _call_adapter(adapter, function, matrix[row], where)
        step += 2 + where.shape[0]


@njit(cache=True)
def begin_step(matrix: Floats, rows: Integers, commands: Floats, columns: Integers) -> None:
    """Remember the present of some rows, write their actions, and count a control step.

    Args:
        matrix: The values, shape (n, width).
        rows: Indices of the rows, shape (m,).
        commands: The actions of all rows, one after another, shape (n * n_actions,).
        columns: Pairs of columns, shape (2 + k, 2): of the clock and of what says whether the
            values to remember are up to date; of the first action, twice; and of each value to
            remember and where it is kept.
    """
    size = commands.size // matrix.shape[0]
    for row in rows:
        for i in range(2, columns.shape[0]):
            matrix[row, columns[i, 1]] = matrix[row, columns[i, 0]]
        for i in range(size):
            matrix[row, columns[1, 0] + i] = commands[row * size + i]
        matrix[row, columns[0, 0]] += 1.0
        matrix[row, columns[0, 1]] = 0.0


@njit(cache=True)
def weighted_sum(numbers: Floats, weights: Floats, intercept: float) -> float:
    """Compute a weighted sum in the order, and with the rounding, of ``Linear``."""
    total = 0.0 + intercept
    for i in range(numbers.size):
        total = total + weights[i] * numbers[i]
    return total
