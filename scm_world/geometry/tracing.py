"""Compiled functions of a few numbers, read as expressions that hold for many worlds at once.

A mechanism is written once, for the numbers of one world, and numba compiles it. Here its Python
source runs once with symbols in place of numbers. What it does to them is kept as a list of
operations, which any library of arrays can do on columns: the value of each symbol in all worlds.

Where the source asks whether a comparison holds, it runs once with each answer, and the results are
joined: both are computed in all worlds, and each world takes its own. So a loop whose length, or a
list whose size, depends on numbers cannot be traced; nor can a function with many such questions.
"""

from __future__ import annotations

import builtins
import math
import operator
from collections.abc import Callable, Iterable
from functools import cache, partial
from itertools import combinations
from types import FunctionType, SimpleNamespace
from typing import Any, final

import numpy as np

MOST_QUESTIONS, MOST_RUNS = 12, 300
"""How many comparisons may decide one path, and how often a function may run."""
_PACKAGE = __name__.partition(".")[0]


class Untraceable(Exception):
    """A function does more with its arguments than arithmetic and a few decisions."""


class _Open(BaseException):
    """A comparison was asked for that has no answer yet."""

    def __init__(self, node: int) -> None:
        self.node = node


def _binary(name: str, *, swapped: bool = False) -> Callable[[Any, Any], Any]:
    def apply(self: Symbol, other: Any) -> Any:
        if isinstance(other, np.ndarray):
            return NotImplemented
        return self.trace.add(name, *((other, self) if swapped else (self, other)))

    return apply


def _unary(name: str) -> Callable[[Any], Any]:
    return lambda self: self.trace.add(name, self)


@final
class Symbol:
    """A number, or the truth of a comparison, that differs between worlds.

    Attributes:
        trace: Where its operations are kept.
        node: The number of the operation that computes it.
    """

    __slots__ = ("node", "trace")
    __hash__ = None  # type: ignore[assignment] # == makes another symbol

    def __init__(self, trace: Trace, node: int) -> None:
        self.trace, self.node = trace, node

    __add__, __radd__ = _binary("add"), _binary("add", swapped=True)
    __sub__, __rsub__ = _binary("sub"), _binary("sub", swapped=True)
    __mul__, __rmul__ = _binary("mul"), _binary("mul", swapped=True)
    __truediv__, __rtruediv__ = _binary("truediv"), _binary("truediv", swapped=True)
    __lt__, __le__, __gt__, __ge__ = map(_binary, ("lt", "le", "gt", "ge"))
    __eq__, __ne__ = _binary("eq"), _binary("ne")
    __neg__, __abs__, sqrt, sin, cos, exp = map(_unary, ("neg", "abs", "sqrt", "sin", "cos", "exp"))
    arctan2 = _binary("atan2")

    def __pow__(self, power: Any) -> Any:
        if power != 2:
            raise Untraceable(f"a power of {power}")
        return self * self

    def __bool__(self) -> bool:
        known = self.trace.answers.get(self.node)
        if known is None:
            raise _Open(self.node)
        return known


@final
class Trace:
    """Operations on columns.

    Attributes:
        nodes: Of each operation its name and its arguments, numbers of other operations or, in a
            tuple, constants; ``("column", place)`` is a value that is given.
        answers: Those to comparisons in the present run, by number.
    """

    def __init__(self) -> None:
        self.nodes: list[tuple[Any, ...]] = []
        self.answers: dict[int, bool] = {}
        self._known: dict[tuple[Any, ...], int] = {}
        self._runs = 0

    def add(self, name: str, *arguments: Any) -> Symbol:
        """Return the symbol of an operation; the same one for the same arguments."""
        taken = [one.node if isinstance(one, Symbol) else (float(one),) for one in arguments]
        return self._node((name, *taken))

    def column(self, place: int) -> Symbol:
        """Return the symbol of a column."""
        return self._node(("column", (place,)))

    def _node(self, node: tuple[Any, ...]) -> Symbol:
        number = self._known.setdefault(node, len(self.nodes))
        if number == len(self.nodes):
            self.nodes.append(node)
        return Symbol(self, number)

    def call(self, function: Any, arguments: Iterable[Any]) -> Any:
        """Return what a function makes of numbers and symbols, and of arrays of them.

        Arrays that it writes to are changed.

        Raises:
            Untraceable: It cannot be traced.
        """
        self._runs = 0
        return self.inner(_over_symbols(function), [*arguments])

    def inner(self, function: Any, arguments: list[Any]) -> Any:
        """Call a function within the one that is traced: its decisions are joined at its end."""
        before, arrays = self.answers, [one for one in arguments if isinstance(one, np.ndarray)]
        if any(np.may_share_memory(*pair) for pair in combinations(arrays, 2)):
            raise Untraceable("two of its arguments are parts of one array")  # copied below
        found, *written = self._explored(function, arguments, before)
        self.answers = before
        for array, after in zip(arguments, written, strict=True):
            if isinstance(array, np.ndarray):
                try:
                    array[...] = after
                except TypeError as error:
                    raise Untraceable(str(error)) from None
        return found

    def _explored(
        self, function: Any, arguments: list[Any], answers: dict[int, bool]
    ) -> tuple[Any, ...]:
        """Return the result of a function, and its arguments afterwards."""
        self.answers, self._runs = answers, self._runs + 1
        if len(answers) > MOST_QUESTIONS or self._runs > MOST_RUNS:
            raise Untraceable("it decides too often")
        given = [one.copy() if isinstance(one, np.ndarray) else one for one in arguments]
        try:
            return function(*given), *given
        except _Open as asked:
            node = asked.node
        except Exception as error:  # of any kind: the source does what symbols cannot
            raise Untraceable(str(error)) from None
        both = [
            self._explored(function, arguments, {**answers, node: is_so}) for is_so in (True, False)
        ]
        return tuple(self._joined(node, *pair) for pair in zip(*both, strict=True))

    def _joined(self, node: int, yes: Any, no: Any) -> Any:
        """Return what a world has with the answer of its own to a comparison."""
        if yes is no:
            return yes
        here, there = (np.asarray(one, dtype=object) for one in (yes, no))
        if here.shape != there.shape:
            raise Untraceable("its result has several shapes")
        found = np.empty(here.shape, dtype=object)
        for place in np.ndindex(here.shape):
            pair = here[place], there[place]
            alike = isinstance(pair[0], Symbol) is isinstance(pair[1], Symbol) and (
                pair[0].node == pair[1].node if isinstance(pair[0], Symbol) else pair[0] == pair[1]
            )
            found[place] = pair[0] if alike else self.add("where", Symbol(self, node), *pair)
        return found if found.shape else found[()]


# --- what the source calls ------------------------------------------------------------------------


def _either(name: str, plain: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that adds an operation if an argument is a symbol."""

    def apply(*arguments: Any) -> Any:
        symbols = [one for one in arguments if isinstance(one, Symbol)]
        return symbols[0].trace.add(name, *arguments) if symbols else plain(*arguments)

    return apply


def _least(name: str, plain: Callable[..., Any]) -> Callable[..., Any]:
    pair = _either(name, plain)

    def apply(first: Any, *others: Any) -> Any:
        for other in others:
            first = pair(first, other)
        return first

    return apply


def _as_it_is(value: Any) -> Any:
    return value if isinstance(value, Symbol) else float(value)


def _asked_for_kind(value: Any, *others: Any) -> Any:
    if isinstance(value, Symbol):
        raise Untraceable("it asks what kind a value is of")
    return isinstance(value, *others)


def _whole(value: Any) -> Any:
    if not isinstance(value, Symbol):
        return int(value)
    if value.trace.nodes[value.node][0] not in ("lt", "le", "gt", "ge", "eq", "ne"):
        raise Untraceable("it takes a whole number of a value")
    return value.trace.add("where", value, 1.0, 0.0)


class _Numpy:
    """NumPy, whose new arrays take symbols."""

    sign = staticmethod(_either("sign", np.sign))

    def __getattr__(self, name: str) -> Any:
        found = getattr(np, name)
        if name not in ("empty", "zeros", "ones"):
            return found
        return lambda shape, **_: found(shape).astype(object)


_MATH = SimpleNamespace(**vars(math))
for _name in ("sqrt", "sin", "cos", "exp", "atan2"):
    setattr(_MATH, _name, _either(_name, getattr(math, _name)))
_BUILTINS = {
    "min": _least("minimum", min),
    "max": _least("maximum", max),
    "float": _as_it_is,
    "int": _whole,
    "isinstance": _asked_for_kind,
}


@cache
def _over_symbols(function: Any) -> Any:
    """Return a function of the same source that computes with symbols, and so do those it calls."""
    source = getattr(function, "py_func", function)
    if not isinstance(source, FunctionType):
        raise Untraceable(f"{function!r} has no source")
    scope: dict[str, Any] = {"__builtins__": {**vars(builtins), **_BUILTINS}}
    made = FunctionType(source.__code__, scope, source.__name__, source.__defaults__)
    if source.__closure__:
        raise Untraceable(f"{source.__name__} has values of its own")
    for name in source.__code__.co_names:
        if name in source.__globals__:
            scope[name] = _for_symbols(source.__globals__[name])
    return made


def _for_symbols(one: Any) -> Any:
    if one is math:
        return _MATH
    if one is np:
        return _Numpy()
    own = str(getattr(one, "__module__", "")).partition(".")[0] == _PACKAGE
    if hasattr(one, "py_func") or (own and isinstance(one, FunctionType)):
        return partial(_called, one)
    return one


def _called(function: Any, *arguments: Any) -> Any:
    """Call a function with symbols, or with numbers alone."""
    parts = [part for one in arguments for part in np.asarray(one, dtype=object).reshape(-1)]
    symbol = next((part for part in parts if isinstance(part, Symbol)), None)
    made = _over_symbols(function)
    return made(*arguments) if symbol is None else symbol.trace.inner(made, [*arguments])


# --- on columns -----------------------------------------------------------------------------------


@final
class Expressions:
    """Operations of a trace that write some columns.

    Args:
        trace: The operations.
        results: What is written, by column: symbols and numbers.
        torch: The library.
    """

    def __init__(self, trace: Trace, results: dict[int, Any], torch: Any) -> None:
        used, stack = set[int](), [one.node for one in results.values() if type(one) is Symbol]
        while stack:
            node = stack.pop()
            if node not in used:
                used.add(node)
                stack += [one for one in trace.nodes[node][1:] if type(one) is int]
        self._torch = torch
        self._given = [
            (number, int(node[1][0]))
            for number, node in enumerate(trace.nodes)
            if number in used and node[0] == "column"
        ]
        self._steps = [
            (number, _operation(torch, node[0]), node[1:])
            for number, node in enumerate(trace.nodes)
            if number in used and node[0] != "column"
        ]
        self._to = [*results]
        self._from: list[Any] = [
            one.node if type(one) is Symbol else (float(one),) for one in results.values()
        ]
        self._size = len(trace.nodes)

    def __call__(self, table: Any) -> None:
        """Compute columns of a table, shape (width, n), and write them."""
        values: list[Any] = [None] * self._size
        for number, place in self._given:
            values[number] = table[place]
        for number, operation, given in self._steps:
            arguments = [values[one] if type(one) is int else one[0] for one in given]
            values[number] = operation(*arguments)
        found = [
            values[one] if type(one) is int else table.new_full(table.shape[1:], one[0])
            for one in self._from
        ]
        if found:
            table[self._to] = self._torch.stack(found).to(table.dtype)


def _operation(torch: Any, name: str) -> Callable[..., Any]:
    """Return an operation on tensors and numbers, in which a truth counts as 0 or 1.

    For torch, truths have no difference, and a truth times a number has 32 bits.
    """
    function: Callable[..., Any] = getattr(operator, name, None) or getattr(torch, name)
    takes_numbers = name not in ("minimum", "maximum", "atan2", "where")

    def of_tensors(*given: Any) -> Any:
        like = next(one for one in given if torch.is_tensor(one))
        wide = [one.double() if torch.is_tensor(one) else one for one in given]
        if not takes_numbers:
            full = partial(torch.full, (), dtype=torch.float64, device=like.device)
            wide = [one if torch.is_tensor(one) else full(one) for one in wide]
        if name == "where":
            wide[0] = wide[0] != 0.0
        return function(*wide)

    return of_tensors
