"""Structural equations: how a variable follows from its parents.

A mechanism is called with the values of the parents, in their order, and, where the variable has
noise, with ``noise=``. Values carry leading batch axes; write ``size[..., 2] / 2``, not
``size[2] / 2``.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence, Set
from functools import cached_property, partial, update_wrapper
from itertools import pairwise
from math import prod
from pkgutil import resolve_name
from typing import Annotated, Any, ClassVar, Literal, Self, final

import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from scm_world._types import Value
from scm_world.errors import ModelError, UnknownOption
from scm_world.variables.spaces import Frozen

Constant = float | tuple[float, ...]
PACKAGE = __name__.partition(".")[0]

OWN_MECHANISMS = (
    "scm_world.geometry",
    "scm_world.tasks.composition",
    "scm_world.tasks.rewards",
    "scm_world.tasks.trifinger",
)
"""Modules of this package whose functions a file may name as mechanisms. They compute numbers."""


@final
class Stacked:
    """A function of any number of parents that computes from all their numbers in one vector.

    A loop that has the numbers in one vector already calls ``kernel`` with it instead.

    Attributes:
        kernel: Takes the numbers of the parents one after another, shape (n,), and the constants.

    Example:
        >>> total = Stacked(lambda numbers, scale: scale * numbers.sum())
        >>> total(np.array([1.0, 2.0]), np.array(3.0), scale=2.0)
        np.float64(12.0)
    """

    def __init__(self, kernel: Callable[..., Any]) -> None:
        self.kernel = kernel
        self.__qualname__ = ""
        update_wrapper(self, kernel)

    def __reduce__(self) -> str:
        """Copy and pickle it by its name."""
        return str(self.__qualname__)

    def __call__(self, *parents: Value, **constants: object) -> Any:
        """Compute from values of the parents."""
        return self.kernel(np.concatenate([np.ravel(parent) for parent in parents]), **constants)


@final
class Unboxed:
    """A user's ``kernel``, compiled with numba: it takes numbers for arrays of no dimension."""

    def __init__(self, kernel: Callable[..., Any]) -> None:
        self.kernel = kernel

    def __call__(self, *parents: Value, **constants: object) -> Any:
        """Compute from values of the parents."""
        return self.kernel(*map(_number, parents), **{k: _number(v) for k, v in constants.items()})


def _number(value: object) -> Any:
    return value.item() if isinstance(value, np.ndarray) and value.ndim == 0 else value


def _lies_in(module: str, packages: Iterable[str]) -> bool:
    return any(module == package or module.startswith(f"{package}.") for package in packages)


@final
class Function(Frozen):
    """A Python function of the parents.

    Args:
        function: The function itself, or ``"module:name"``. Only a function that can be found
            under its name survives a JSON round trip; a lambda works until then.
        constants: Passed to it by keyword.

    From a file, a name is looked up in modules of this package only, unless the reader names
    further ones (``from_json(text, trusted=("my_package",))``): reading runs no other code.
    """

    kind: Literal["function"] = "function"
    reference: str
    constants: dict[str, Constant] = Field(default_factory=dict)
    _function: Callable[..., Any] | None = PrivateAttr(default=None)

    def __init__(self, function: object = None, **fields: object) -> None:
        if callable(function):
            named = function if hasattr(function, "__qualname__") else type(function)
            fields["reference"] = f"{named.__module__}:{named.__qualname__}"
            if named is np.ufunc:  # of NumPy 1, where these do not say in which module they lie
                fields["reference"] = f"numpy:{getattr(function, '__name__', '')}"
        elif function is not None:
            fields["reference"] = function
        super().__init__(**fields)
        if callable(function):
            self._function = function

    @model_validator(mode="before")
    @classmethod
    def _from_callable(cls, data: object) -> Any:
        return data if isinstance(data, dict) else {"reference": data}

    def is_defined_in(self, packages: Iterable[str]) -> bool:
        """Return whether some packages or modules define the function, importing no other one.

        A function that a module imports (``"my_package.module:os.system"``) is not its own.
        """
        packages = tuple(packages)
        if not _lies_in(self.reference.partition(":")[0], packages):
            return False
        found = self._named()
        home = getattr(found, "__module__", None)
        if home is None and isinstance(found, np.ufunc):
            home = np.ufunc.__module__
        return _lies_in(home or "", packages)

    def is_portable(self) -> bool:
        """Return whether the function can be found again under its name."""
        found = self._named()
        return found is not None and found is self.resolve()

    def _named(self) -> Any:
        try:
            return resolve_name(self.reference)
        except (ValueError, AttributeError, ImportError):
            return None

    def resolve(self) -> Callable[..., Any]:
        """Return the function, importing its module if need be."""
        if self._function is None:
            found: Any = resolve_name(self.reference)
            if not callable(found):
                raise ModelError([f"{self.reference!r} is not a function"])
            self._function = found
        return self._function

    def __copy__(self) -> Self:
        """Copy it without the bound function: the copy may get other constants."""
        copied = super().__copy__()
        copied.__dict__.pop("_bound", None)
        return copied

    def bind(self) -> Callable[..., Any]:
        """Return a callable with the constants filled in; always the same one."""
        return self._bound

    @property
    def takes_noise(self) -> bool:
        """Whether the function has an argument ``noise``."""
        try:
            return "noise" in inspect.signature(self.resolve()).parameters
        except (TypeError, ValueError):  # a function in C says nothing
            return False

    @cached_property
    def _bound(self) -> Callable[..., Any]:
        function = self.resolve()
        if hasattr(function, "py_func") and function.__module__.partition(".")[0] != PACKAGE:
            function = Unboxed(function)
        if not self.constants:
            return function
        constants = {
            key: np.asarray(value, float) if isinstance(value, tuple) else value
            for key, value in self.constants.items()
        }
        return partial(function, **constants)

    def __fingerprint__(self) -> tuple[Any, ...]:
        return self.constants, self.resolve()

    def __eq__(self, other: object) -> bool:
        is_object = self._function is not None and not hasattr(self._function, "__qualname__")
        is_unique = "<" not in self.reference and not is_object  # nor a lambda
        return (
            isinstance(other, Function)
            and (self.reference, self.constants) == (other.reference, other.constants)
            and (is_unique or self._function == other._function)
        )

    def __hash__(self) -> int:
        return hash((self.reference, tuple(sorted(self.constants))))


def check_order(of: str, equation: object, parents: Sequence[str], *, before: int = 0) -> None:
    """Refuse a function whose arguments have the names of its parents in another order.

    Arguments are given by position, so each of these would get the value of another parent. An
    argument has the name of a parent if it is that name, the name with ``_`` for ``.``, or the part
    after the last dot. Arguments with other names say nothing, nor do the first ``before`` ones.
    """
    function = equation._function if isinstance(equation, Function) else None
    if len(parents) < 2 or function is None:
        return
    meant: dict[str, list[int]] = {}
    for place, name in enumerate(parents):
        for spelled in {name, name.replace(".", "_"), name.rpartition(".")[2]}:
            meant.setdefault(spelled, []).append(place)
    called: Any = getattr(function, "py_func", function)
    called = called if hasattr(called, "__code__") else type(called).__call__
    code = getattr(called, "__code__", None)  # some fifty times faster than ``inspect.signature``
    named = () if code is None else code.co_varnames[: code.co_argcount]
    arguments = [name for name in named if name not in ("self", "noise")]
    taken = enumerate(arguments[before : before + len(parents)])
    known = {at: meant[name][0] for at, name in taken if len(meant.get(name, ())) == 1}
    if {*known} == {*known.values()} and any(at != place for at, place in known.items()):
        order = ", ".join(parents[known.get(at, at)] for at in range(len(parents)))
        said = f"the function takes its parents in the order ({order}), not ({', '.join(parents)})"
        raise ValueError(f"{of}: {said}: declare them in one order, or rename the arguments")


def check_portable(functions: Iterable[Function]) -> None:
    """Refuse to write functions that could not be found again, such as a lambda."""
    problems = [
        f"the function {function.reference!r} cannot be found under this name; define it at the "
        "top level of a module"
        for function in functions
        if not function.is_portable()
    ]
    if problems:
        raise ModelError(problems)


def check_trusted(functions: Iterable[Function], trusted: Iterable[str]) -> None:
    """Refuse functions of a file, before anything is imported, unless their package is trusted."""
    if not isinstance(trusted, Sequence | Set) or not all(isinstance(one, str) for one in trusted):
        raise UnknownOption("trusted", trusted, ("names of packages, such as ('mine',)",))
    allowed = (*OWN_MECHANISMS, *trusted)
    problems = [
        f"the function {function.reference!r} lies outside the trusted packages "
        f"{', '.join(allowed)}; pass trusted=(…) to read it"
        for function in functions
        if not function.is_defined_in(allowed)
    ]
    if problems:
        raise ModelError(problems)


class _Formula(Frozen):
    """A mechanism that is called itself."""

    takes_noise: ClassVar[bool] = True

    def bind(self) -> Any:
        """Return the function of the parents, as ``Function.bind`` does."""
        return self


@final
class Linear(_Formula):
    """A weighted sum of the parents, plus an intercept, plus the noise.

    Attributes:
        weights: One for each parent.
        intercept: Summand.
    """

    kind: Literal["linear"] = "linear"
    weights: tuple[float, ...]
    intercept: float = 0.0

    def __call__(self, *parents: Value, noise: Value | float = 0.0) -> Any:
        """Compute the sum."""
        total = noise + self.intercept
        for weight, parent in zip(self.weights, parents):  # noqa: B905 # every step needs it
            total = total + weight * parent  # ``sum`` rounds otherwise from Python 3.12 on
        return total


@final
class Concatenation(_Formula):
    """The numbers of the parents one after another: the mechanism of a bundle.

    Attributes:
        shapes: Shapes of the parents.

    Example:
        >>> both = Concatenation(shapes=((2,), ()))
        >>> both(np.array([1.0, 2.0]), np.array(3.0))
        array([1., 2., 3.])
        >>> both.split(np.array([1.0, 2.0, 3.0]))
        (array([1., 2.]), array(3.))
    """

    kind: Literal["concatenation"] = "concatenation"
    shapes: tuple[tuple[int, ...], ...]
    takes_noise: ClassVar[bool] = False

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """The places of the numbers of each parent."""
        ends = np.cumsum([0, *(int(np.prod(shape)) for shape in self.shapes)]).tolist()
        return tuple(slice(first, last) for first, last in pairwise(ends))

    def __call__(self, *parts: Value) -> Value:
        """Join values, shape ``(..., n)``; leading axes broadcast."""
        both = [*zip(map(np.asarray, parts), self.shapes, strict=True)]
        lead = np.broadcast_shapes(*(part.shape[: part.ndim - len(s)] for part, s in both))
        full = (np.broadcast_to(part, (*lead, *s)).reshape(*lead, prod(s)) for part, s in both)
        return np.concatenate([*full], axis=-1)

    def split(self, value: Value) -> tuple[Value, ...]:
        """Return the values of the parents; the numbers are the last axis of the value."""
        lead = np.shape(value)[:-1]
        both = zip(self.shapes, self.slices, strict=True)
        return tuple(np.asarray(value[..., at]).reshape((*lead, *shape)) for shape, at in both)


@final
class Table(_Formula):
    """A table of conditional probabilities: a category, given those of the parents.

    The noise is uniform on [0, 1]; a variable with a table has it if it declares no other.

    Attributes:
        probabilities: One after another, the values of the last parent changing fastest.
        shape: How many values each parent has, and last how many the variable has.
        given: The values of each parent in the order of the table; 0, 1, … if empty.
        values: Those of the variable in this order; 0, 1, … if empty.

    Example:
        >>> grass = Table([[0.9, 0.1], [0.2, 0.8]])  # wet (1) or dry (0), given rain
        >>> grass(np.array([0, 1]), noise=np.array([0.5, 0.5]))
        array([0, 1])
    """

    kind: Literal["table"] = "table"
    probabilities: tuple[float, ...]
    shape: tuple[int, ...] = ()
    given: tuple[tuple[int, ...], ...] = ()
    values: tuple[int, ...] = ()

    def __init__(self, probabilities: object, **fields: object) -> None:
        table = np.asarray(probabilities, dtype=float)
        fields.setdefault("shape", table.shape)
        fields["probabilities"] = tuple(table.ravel().tolist())
        super().__init__(**fields)

    @model_validator(mode="after")
    def _holds_probabilities(self) -> Self:
        sizes = [len(values) for values in self.given]
        if len(self.probabilities) != int(np.prod(self.shape)) or not self.shape:
            raise ValueError(f"{len(self.probabilities)} probabilities for a table {self.shape}")
        if (sizes and sizes != [*self.shape[:-1]]) or len(self.values) not in (0, self.shape[-1]):
            raise ValueError(f"values of parents, or of the variable, do not fit {self.shape}")
        sums = self.table.sum(axis=-1)
        if (self.table < 0.0).any() or not np.allclose(sums, 1.0, rtol=0.0, atol=1e-9):
            raise ValueError("each row of probabilities is not negative and sums to 1")
        return self

    @property
    def table(self) -> Any:
        """The probabilities, as an array of the shape."""
        return np.reshape(self.probabilities, self.shape)

    def row(self, *parents: Value) -> Any:
        """Return the probabilities given the parents, shape (..., number of values)."""
        places = []
        for axis, parent in enumerate(parents):
            known = np.asarray(self.given[axis] if self.given else range(self.shape[axis]))
            found = np.asarray(parent)[..., None] == known
            if not found.any(axis=-1).all():
                raise ModelError([f"parent {axis} of a table is {parent}, not in {known.tolist()}"])
            places.append(found.argmax(axis=-1))
        return self.table[tuple(places)]

    def __call__(self, *parents: Value, noise: Value | float = 0.0) -> Any:
        """Return the category whose share of [0, 1] the uniform noise lies in."""
        values = np.asarray(self.values or range(self.shape[-1]))
        ends = np.cumsum(self.row(*parents), axis=-1)[..., :-1]
        return values[(ends <= np.asarray(noise)[..., None]).sum(axis=-1)]


EQUATIONS = (Function, Linear, Concatenation, Table)
Equation = Annotated[Function | Linear | Concatenation | Table, Field(discriminator="kind")]
