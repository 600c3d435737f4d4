"""Mechanisms put together with their arguments, so that a control step evaluates them quickly."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from inspect import signature
from operator import is_, itemgetter
from typing import Any, final

import numpy as np
from numba.core.errors import NumbaError

from scm_world._types import Value
from scm_world.errors import ModelError
from scm_world.geometry.direct import direct
from scm_world.geometry.gather import gather_into, places
from scm_world.graph import SCM
from scm_world.variables import Action, Measured, Parent
from scm_world.variables.mechanisms import Stacked, Unboxed

Now = dict[str, Value]

_Step = tuple[str, Callable[..., Any], Callable[[Now], Iterable[Any]], tuple[Any, ...]]
"""A variable, its function, what picks the arguments, and constants that follow them."""


@final
class Bound:
    """Some mechanisms in causal order, with their arguments.

    A state is a view of the vector that physics writes, an action one of what is commanded, and a
    parameter the same object until an intervention: such arguments are looked up once. Only
    computed numbers are looked up in every step.

    Args:
        model: That declares the mechanisms.
        now: Present values, and those of one control step ago under the names of ``key``.
        names: What is computed, causes before effects.
    """

    def __init__(self, model: SCM, now: Now, names: Iterable[str]) -> None:
        self._now = now
        rules = [_Rule(model, name) for name in names]
        replaced = {rule.name for rule in rules}
        self._keys = tuple({k: None for rule in rules for k in rule.keys if k not in replaced})
        lasting, self._once = set(self._keys), list[_Rule]()
        self._steps: list[_Step] = []
        self._written: dict[str, Value] = {}
        for rule in rules:
            if not lasting.issuperset(rule.keys):
                self._steps.append(rule.step())
                continue
            self._once.append(rule)
            if rule.writes:  # into an array that is where it always is from then on
                lasting.add(rule.name)
                self._written[rule.name] = np.empty(rule.shape)
        self._known: list[Value] | None = None
        self._given: dict[str, list[Any]] = {}
        self._calls: dict[str, Callable[[], Any]] = {}

    def check(self) -> None:
        """Look the arguments up again if one of them is another object now."""
        found = [self._now[name] for name in self._keys]
        if self._known is not None and all(map(is_, found, self._known)):
            return
        self._known = found
        for rule in self._once:
            given = [self._written.get(name, self._now.get(name)) for name in rule.keys]
            known = self._given.get(rule.name)
            if known is None or not all(map(is_, given, known)):
                self._given[rule.name] = given
                self._calls[rule.name] = rule.call(given, self._written.get(rule.name))

    def run(self) -> None:
        """Compute everything, into the present values."""
        now = self._now
        for name, call in self._calls.items():
            now[name] = call()
        for name, function, pick, constants in self._steps:
            now[name] = function(*pick(now), *constants)


@final
class _Rule:
    """A mechanism, and where its arguments are.

    Attributes:
        name: Of the variable.
        keys: Of the parents.
        shape: Of the value.
        writes: Whether its values are written into one array, so that what follows finds it there.
    """

    def __init__(self, model: SCM, name: str) -> None:
        variable: Any = model.declared(name)
        parents: tuple[Parent, ...] = tuple(variable.all_parents)
        self.name, self.shape = name, variable.shape
        self.keys = tuple(map(key, parents))
        self._function, self._constants = positional(variable.mechanism.bind(), len(parents))
        self._moves = [
            k not in model or isinstance(model.declared(k), Measured | Action) for k in self.keys
        ]
        self._are_numbers = [_is_number(model.declared(p.name)) for p in parents]
        self._unboxed = self._function if isinstance(self._function, Unboxed) else None
        if self._unboxed is not None:
            self._function = self._unboxed.kernel
        compiled = isinstance(self._function, Stacked) or self._unboxed is not None
        self._is_kept = compiled and variable.dtype == "real" and variable.shape != ()
        self.writes = hasattr(self._function, "into") or self._is_kept

    def step(self) -> _Step:
        """Bind it to what is looked up in every step."""
        function, keys = self._function, self.keys
        if all(self._are_numbers):
            function = direct(function, *(0.0 for _ in keys), *self._constants)
        elif self._unboxed is not None:
            function = self._unboxed
        pick = itemgetter(*keys) if len(keys) > 1 else partial(_only, keys[0])
        return self.name, function, pick, self._constants

    def call(self, given: list[Any], written: Value | None) -> Callable[[], Any]:
        """Bind it to arguments that stay the same objects."""
        function, constants = self._function, self._constants
        if hasattr(function, "into"):
            return _Written(function.into, (*given, *constants, written))
        if isinstance(function, Stacked):
            made: Callable[[], Any] = _Stack(function, given, self._moves, constants)
        else:
            made = self._compiled(given)
        return _Kept(made, written, self.name) if self._is_kept else made

    def _compiled(self, given: list[Any]) -> Callable[[], Any]:
        """Bind a function without ``into`` to its arguments.

        Raises:
            ModelError: It is the user's, and numba cannot compile it for them.
        """
        function, constants = self._function, self._constants
        like = given
        if (
            self._unboxed is not None
        ):  # it computes with numbers; ours take arrays without dimension
            pairs = zip(self._are_numbers, given, strict=True)
            like = [0.0 if is_number else value for is_number, value in pairs]
        try:
            compiled = direct(function, *like, *constants)
        except NumbaError as error:
            reason = str(error).strip().splitlines()[-1]
            problem = f"numba cannot compile the function of {self.name!r}: {reason}"
            raise ModelError([problem]) from error
        return partial(compiled, *given, *constants)


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
class _Kept:
    """A function whose values are copied into an array.

    Args:
        function: Gives them.
        into: The array.
        name: Of the variable.

    Raises:
        ModelError: They have another shape.
    """

    def __init__(self, function: Callable[[], Any], into: Any, name: str) -> None:
        self._call, self._into = function, into
        found = np.shape(function())
        if found != into.shape:
            problem = f"the function of {name!r} gives the shape {found}, not {into.shape}"
            raise ModelError([problem])

    def __call__(self) -> Value:
        """Compute, and give the array."""
        found: Value = self._into
        found[...] = self._call()
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

    Unboxed functions take positional arguments faster. Others keep their constants.

    Args:
        function: As ``bind`` of a mechanism gives it.
        count: How many parents it has.
    """
    if not isinstance(function, partial):
        return function, ()
    inner = function.func
    if isinstance(inner, Unboxed):
        inner = inner.kernel
    if isinstance(inner, Stacked):
        count, inner = 1, inner.kernel
    compiled = getattr(inner, "py_func", None)
    names = () if compiled is None else tuple(signature(compiled).parameters)[count:]
    if set(names) != set(function.keywords):
        return function, ()
    return function.func, tuple(function.keywords[name] for name in names)


def called(model: SCM, name: str) -> Callable[..., Any]:
    """Give the function of the parents of a variable, as it is called in every step."""
    rule = _Rule(model, name)
    if not rule.keys:
        return rule.call([], None)
    _, function, _, constants = rule.step()
    return (lambda *given: function(*given, *constants)) if constants else function


def key(parent: Parent) -> str:
    """Name the value of a parent: a value of one step ago stands beside the present ones."""
    return parent.name if parent.lag == 0 else f"{parent.name}, one step ago"


def _only(name: str, now: Now) -> tuple[Value]:
    return (now[name],)


def _is_number(variable: Any) -> bool:
    return bool(variable.shape == () and variable.dtype == "real")
