"""Mechanisms put together with their arguments, so that a control step evaluates them quickly."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from inspect import signature
from operator import is_, itemgetter
from typing import Any, final

import numpy as np

from scm_world._types import Value
from scm_world.geometry.direct import direct
from scm_world.geometry.gather import gather_into, places
from scm_world.graph import SCM
from scm_world.variables import Action, Measured, Parent
from scm_world.variables.mechanisms import Stacked

Now = dict[str, Value]

_Call = tuple[str, Callable[[], Any]]
"""A variable, and how it is computed from what is where it always is."""

_Step = tuple[str, Callable[..., Any], Callable[[Now], Iterable[Any]], tuple[Any, ...]]
"""A variable, its function, what picks the arguments, and constants that follow them."""


@final
class Bound:
    """Some mechanisms in causal order, with their arguments.

    A state is a view of the vector that physics writes, and a parameter the same object until an
    intervention: such arguments are looked up once. Only computed numbers are looked up in every
    step.

    Args:
        model: That declares the mechanisms.
        now: Present values, and those of one control step ago under the names of ``key``.
        names: What is computed, causes before effects.
    """

    def __init__(self, model: SCM, now: Now, names: Iterable[str]) -> None:
        self._model, self._now, self._names = model, now, tuple(names)
        parents = [p for name in self._names for p in _parents(model, name)]
        replaced = {*self._names, *(v.name for v in model.variables if isinstance(v, Action))}
        self._lasting = tuple({key(p): None for p in parents if key(p) not in replaced})
        self._known: list[Value] | None = None
        self._calls: list[_Call] = []
        self._steps: list[_Step] = []

    def check(self) -> None:
        """Look the arguments up again if one of them is another object now."""
        found = [self._now[name] for name in self._lasting]
        if self._known is None or not all(map(is_, found, self._known)):
            self._known, self._calls, self._steps = found, [], []
            lasting = set(self._lasting)
            for name in self._names:
                self._bind(name, lasting)

    def run(self) -> None:
        """Compute everything, into the present values."""
        now = self._now
        for name, call in self._calls:
            now[name] = call()
        for name, function, pick, constants in self._steps:
            now[name] = function(*pick(now), *constants)

    def _bind(self, name: str, lasting: set[str]) -> None:
        """Bind one mechanism; an array that is written into is where it always is from then on."""
        mechanism: Any = self._model.declared(name)
        parents = _parents(self._model, name)
        function, constants = positional(mechanism.mechanism.bind(), len(parents))
        keys = tuple(map(key, parents))
        if lasting.issuperset(keys):
            self._calls.append((name, self._call(mechanism, function, keys, constants)))
            if hasattr(function, "into"):
                lasting.add(name)
            return
        if all(_is_number(self._model.declared(p.name)) for p in parents):
            function = direct(function, *(0.0 for _ in parents), *constants)
        pick = itemgetter(*keys) if len(keys) > 1 else partial(_only, keys[0])
        self._steps.append((name, function, pick, constants))

    def _call(
        self, mechanism: Any, function: Any, keys: tuple[str, ...], constants: tuple[Any, ...]
    ) -> Callable[[], Any]:
        """Bind a function whose arguments stay the same objects."""
        given = [self._now[key] for key in keys]
        if isinstance(function, Stacked):
            states = [self._is_state(key) for key in keys]
            return _Stack(function, given, states, constants)
        if hasattr(function, "into"):
            self._now[mechanism.name] = written = np.empty(mechanism.shape)
            return _Written(function.into, (*given, *constants, written))
        return partial(direct(function, *given, *constants), *given, *constants)

    def _is_state(self, name: str) -> bool:
        """Tell whether a value that stays the same object is written into."""
        return name not in self._model or isinstance(self._model.declared(name), Measured)


@final
class _Written:
    """A function that writes into an array.

    Args:
        function: The function.
        given: Its arguments; the last one is the array.
    """

    def __init__(self, function: Callable[..., None], given: tuple[Any, ...]) -> None:
        self._call, self._into = partial(direct(function, *given), *given), given[-1]

    def __call__(self) -> Value:
        """Write, and give the array."""
        self._call()
        found: Value = self._into
        return found


@final
class _Stack:
    """A function of one vector, and where the numbers in it come from.

    Args:
        function: The function.
        given: Its arguments; they stay the same objects.
        moves: Which of them are other numbers in every step.
        constants: What else it is given.
    """

    def __init__(
        self,
        function: Stacked,
        given: list[Value],
        moves: list[bool],
        constants: tuple[Any, ...],
    ) -> None:
        self._numbers = np.concatenate([np.ravel(value) for value in given]).astype(np.float64)
        ends = np.cumsum([value.size for value in given]).tolist()
        where = [slice(end - value.size, end) for value, end in zip(given, ends, strict=True)]
        moving = [(v, at) for v, at, moved in zip(given, where, moves, strict=True) if moved]
        vector: Any = next((v.base for v, _ in moving if _is_vector(v.base)), np.empty(0))
        inside = [(value, at) for value, at in moving if value.base is vector]
        self._rest = [(value, at) for value, at in moving if value.base is not vector]
        sources = places(_place(value, vector) for value, _ in inside)
        gathered = (vector, sources, places(at for _, at in inside), self._numbers)
        self._gather = partial(direct(gather_into, *gathered), *gathered)
        computed = (self._numbers, *constants)
        self._kernel = partial(direct(function.kernel, *computed), *computed)

    def __call__(self) -> Any:
        """Collect the numbers of the present, and compute."""
        self._gather()
        for value, at in self._rest:
            self._numbers[at] = value.ravel()
        return self._kernel()


def _is_vector(base: Any) -> bool:
    return isinstance(base, np.ndarray) and base.ndim == 1 and base.dtype == np.float64


def _place(view: Any, vector: Any) -> slice:
    """Say where a view without gaps stands in its vector."""
    first = (view.ctypes.data - vector.ctypes.data) // vector.itemsize
    return slice(first, first + view.size)


def positional(function: Any, count: int) -> tuple[Any, tuple[Any, ...]]:
    """Split a bound function of some parents into the function and its constants, in order.

    Compiled functions take positional arguments faster. Others keep their constants.

    Args:
        function: As ``bind`` of a mechanism gives it.
        count: How many parents it has.
    """
    if not isinstance(function, partial):
        return function, ()
    inner = function.func
    if isinstance(inner, Stacked):
        count, inner = 1, inner.kernel
    compiled = getattr(inner, "py_func", None)
    names = () if compiled is None else tuple(signature(compiled).parameters)[count:]
    if set(names) != set(function.keywords):
        return function, ()
    return function.func, tuple(function.keywords[name] for name in names)


def key(parent: Parent) -> str:
    """Name the value of a parent: a value of one step ago stands beside the present ones."""
    return parent.name if parent.lag == 0 else f"{parent.name}, one step ago"


def _only(name: str, now: Now) -> tuple[Value]:
    return (now[name],)


def _is_number(variable: Any) -> bool:
    return bool(variable.shape == () and variable.dtype == "real")


def _parents(model: SCM, name: str) -> tuple[Parent, ...]:
    variable: Any = model.declared(name)
    return tuple(variable.all_parents)
