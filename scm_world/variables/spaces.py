"""Sets of values: hard bounds, the training space A and the held-out space B.

The bounds of a space may follow the present values of other variables: the height of a block that
lies on the floor is half its size.
"""
# ruff: noqa: D102 # the base classes describe the methods

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property, lru_cache, wraps
from math import isnan, prod
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, final

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PlainValidator,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
)

from scm_world._arguments import plain
from scm_world._types import Floats, Value, Values
from scm_world.errors import ModelError, ScmWorldError, UnknownOption, in_one_line, is_of_user

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)

TOLERANCE = 1e-9
"""How far outside a closed interval a number still counts as inside, as a share of the end, so that
a value computed from a parent, or read from a file, is not refused for its last digit. An end at 0,
beyond which many quantities mean nothing, is exact."""


class Checked(ModelMetaclass):
    """Turn the errors of wrong arguments into one of ours; keep what there is much of small."""

    def __call__(self, *given: object, **fields: object) -> Any:
        """Make a declaration, or raise an error that names all wrong and missing fields."""
        try:
            try:
                made = super().__call__(*given, **fields)
            except ValidationError:  # of NumPy's numbers pydantic knows 64-bit floats only
                made = super().__call__(*plain(given), **plain(fields))
        except ScmWorldError:
            raise
        except ValidationError as error:
            raise _refused_fields(self, error) from None
        except (TypeError, ValueError, AttributeError) as error:
            if is_of_user(error):
                raise
            raise ModelError([f"{self.__name__}: {in_one_line(error)}"]) from error
        if not made.kept:
            return made
        # Pydantic gives each a dictionary and a set; attributes that are set share their names.
        kind: Any = self
        packed, put, said = object.__new__(kind), object.__setattr__, made.__pydantic_fields_set__
        for name, value in vars(made).items():
            put(packed, name, value)
        put(packed, "__pydantic_fields_set__", _GIVEN.setdefault(frozenset(said), said))
        put(packed, "__pydantic_extra__", None)
        put(packed, "__pydantic_private__", None)
        return packed


_GIVEN: dict[Any, Any] = {}
"""The fields that were given; declarations with the same ones share their set."""


def problems_of(error: ValidationError) -> list[str]:
    """List the problems that pydantic finds in data, each with its place, without its advice."""
    found = []
    for one in error.errors():
        cause, where = one.get("ctx", {}).get("error"), ".".join(map(str, one["loc"]))
        said = getattr(cause, "problems", (one["msg"].removeprefix("Value error, "),))
        found += [f"{where}: {each}".removeprefix(": ") for each in said]
    return found


def _refused_fields(kind: Any, error: ValidationError) -> ScmWorldError:
    """Return the problems that pydantic finds in a declaration as an error of this package."""
    said: dict[str, list[str]] = {}
    for one in error.errors():
        cause, place = one.get("ctx", {}).get("error"), one["loc"]
        if isinstance(cause, ScmWorldError):
            return cause
        name = str(place[0]) if place else ""
        if one["type"] == "extra_forbidden" and len(place) == 1:
            return UnknownOption(f"field of {kind.__name__}", name, kind.model_fields)
        field = f"{kind.__name__}.{name}" if name else ""
        if name and one["type"] != "missing" and len(place) < 3:
            field += f" = {one['input']!r}"
        said.setdefault(field, []).append(one["msg"].removeprefix("Value error, "))
    found = {field: ", or ".join(dict.fromkeys(words)) for field, words in said.items()}
    return ModelError([f"{field}: {words}".removeprefix(": ") for field, words in found.items()])


def _make_strict(schema: object) -> None:
    """Make the numbers and switches of a schema strict, wherever they stand in it."""
    if isinstance(schema, dict):
        if schema.get("type") in ("bool", "int", "float"):
            schema["strict"] = True
        schema = [*schema.values()]
    for part in schema if isinstance(schema, list | tuple) else ():
        _make_strict(part)


class Frozen(BaseModel, metaclass=Checked):
    """A declaration: immutable, strict about its fields, and the same after a JSON round trip.

    Its numbers are finite, and may be those of NumPy. Texts and switches are not taken for numbers,
    nor texts and numbers for switches.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    kept: ClassVar[bool] = False
    """Whether models consist of many of them."""

    if TYPE_CHECKING:  # subclasses that take other arguments pass their fields on

        def __init__(self, **fields: object) -> None: ...

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> Any:
        """Return pydantic's schema, in which numbers and switches are taken as such only."""
        schema = handler(source)
        _make_strict(schema)
        return schema


@final
class Affine(Frozen):
    """A bound that follows another variable: ``offset + scale * parent[index]``.

    Attributes:
        parent: Name of the variable.
        index: Which component of it, or None for a scalar.
        scale: Factor.
        offset: Summand.
    """

    parent: str
    index: int | None = None
    scale: float = 1.0
    offset: float = 0.0

    def evaluate(self, values: Values) -> Floats:
        """Compute the bound from the values of all variables."""
        parent = np.asarray(values[self.parent], dtype=np.float64)
        component = parent if self.index is None else parent[..., self.index]
        return np.asarray(self.offset + self.scale * component)


@final
class Switch(Frozen):
    """A bound that is one of two numbers, as another variable decides.

    Attributes:
        parent: Name of the variable, a scalar.
        below: The bound while the variable is less than ``at``.
        above: The bound from there on.
        at: Where it changes.
    """

    parent: str
    below: float
    above: float
    at: float = 0.5

    def evaluate(self, values: Values) -> Floats:
        """Compute the bound from the values of all variables."""
        return np.where(np.asarray(values[self.parent]) < self.at, self.below, self.above)


def _infinite(text: object) -> float:
    """Read an infinite end, which is a text in a file."""
    if not (isinstance(text, str) and text in ("Infinity", "-Infinity")):
        raise ValueError("Input should be a valid number")
    return float(text)


Bound = float | Affine | Switch | Annotated[float, PlainValidator(_infinite)]
Bounds = Bound | tuple[Bound, ...]


def listed(bounds: Bounds) -> tuple[Bound, ...]:
    """Return the ends of a box as a tuple, if there is one for each component or one for all."""
    return bounds if isinstance(bounds, tuple) else (bounds,)


@lru_cache(maxsize=1024)
def _broadcast(bound: float | tuple[float, ...], shape: tuple[int, ...]) -> Floats:
    numbers = np.asarray(bound, dtype=np.float64)
    return np.broadcast_to(numbers.reshape(shape) if numbers.ndim else numbers, shape)


def _evaluate(bound: Bounds, shape: tuple[int, ...], values: Values) -> Floats:
    """Return a corner of shape ``(..., *shape)``."""
    parts = [
        part.evaluate(values) if isinstance(part, Affine | Switch) else np.float64(part)
        for part in listed(bound)
    ]
    if isinstance(bound, tuple):
        stacked: Floats = np.stack(np.broadcast_arrays(*parts), axis=-1)
        return stacked.reshape(*stacked.shape[:-1], *shape)
    number = np.asarray(parts[0])
    return np.broadcast_to(number[(..., *(None,) * len(shape))], (*number.shape, *shape))


def _widened(low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Move two ends apart by the tolerance."""
    return low - TOLERANCE * np.abs(low), high + TOLERANCE * np.abs(high)


class Sampler(Frozen):
    """Base class of spaces, which stand for their uniform distribution, and of distributions.

    ``shape`` is that of one value, and ``values`` those of the variables that bounds follow.
    """

    if TYPE_CHECKING:  # as in ``Frozen``

        def __init__(self, **fields: object) -> None: ...

    def parents(self) -> frozenset[str]:
        """Return the names of the variables that it follows."""
        return frozenset()

    def n_uniforms(self, shape: tuple[int, ...]) -> int:
        """Return how many uniform numbers one draw takes: one for each component."""
        return prod(shape)

    @abstractmethod
    def transform(self, uniforms: Floats, shape: tuple[int, ...], values: Values) -> Value:
        """Turn uniform numbers in [0, 1), shape ``(..., n)``, into draws, ``(..., *shape)``."""

    @abstractmethod
    def describe(self) -> str:
        """Write it in words, with the names of the variables that it follows."""


def _of_numbers(method: Callable[..., Any]) -> Callable[..., Any]:
    """Refuse what a space cannot compare with its members, in words."""

    @wraps(method)
    def asked(space: Set, value: Value, values: Values | None = None) -> Any:
        try:
            return method(space, value, values)
        except ScmWorldError:
            raise
        except (TypeError, ValueError, KeyError) as error:
            also = "".join(f" and the value of {name}" for name in sorted(space.parents()))
            what = f"{method.__name__} takes numbers of its shape{also}, got {value!r:.60}"
            raise ModelError([f"the space {space.describe()}: {what}"]) from error

    return asked


class Set(Sampler):
    """Base class of spaces."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        for name in ("contains", "nearest"):
            if name in vars(cls):
                setattr(cls, name, _of_numbers(vars(cls)[name]))

    if TYPE_CHECKING:  # as in ``Frozen``

        def __init__(self, **fields: object) -> None: ...

    def contains(self, value: Value, values: Values | None = None) -> bool:
        """Return whether a value lies inside, borders included."""
        return bool(np.all(self.nearest(value, values) == value))

    @abstractmethod
    def nearest(self, value: Value, values: Values | None = None) -> Value:
        """Find the point that is nearest to a value."""

    @abstractmethod
    def volume(self, shape: tuple[int, ...], values: Values) -> Floats:
        """Return the volume, or the number of values, shape ``(...)``."""


@final
class Box(Set):
    """All points between two corners, both included.

    Attributes:
        low: One number for all components, or one for each, or a function of a parent.
        high: Likewise. An end may be infinite where nothing is drawn from the box.

    Example:
        >>> Box(0.015, 0.045).contains(np.array(0.02))
        True
        >>> floor_level = Box((0.0, Affine(parent="size", scale=0.5)), (0.1, 0.3))
        >>> floor_level.bounds((2,), {"size": np.array(0.06)})[0]
        array([0.  , 0.03])
    """

    model_config = ConfigDict(allow_inf_nan=True)

    kind: Literal["box"] = "box"
    low: Bounds
    high: Bounds

    def __init__(self, low: object, high: object, **fields: object) -> None:
        super().__init__(low=low, high=high, **fields)

    def model_post_init(self, context: object) -> None:
        """Refuse an empty box; a validator would do so again in every declaration that has it."""
        low, high = listed(self.low), listed(self.high)
        if any(isinstance(part, float) and isnan(part) for part in (*low, *high)):
            raise ValueError(f"an end of a box is not a number: {self.low} and {self.high}")
        if len(low) != len(high) and min(len(low), len(high)) != 1:
            raise ValueError(f"a box has corners of one shape; these have {len(low)}, {len(high)}")
        n = max(len(low), len(high))
        corners = (end if len(end) == n else n * end for end in (low, high))
        pairs = zip(*corners, strict=True)
        if any(isinstance(a, float) and isinstance(b, float) and a > b for a, b in pairs):
            raise ValueError(f"a box is empty where low > high: {self.low} and {self.high}")

    @cached_property
    def _followed(self) -> frozenset[str]:
        ends = (*listed(self.low), *listed(self.high))
        return frozenset(end.parent for end in ends if isinstance(end, Affine | Switch))

    def parents(self) -> frozenset[str]:
        return self._followed

    def bounds(self, shape: tuple[int, ...], values: Values) -> tuple[Floats, Floats]:
        """Evaluate both corners, each of shape ``(..., *shape)``."""
        low, high = (
            _evaluate(end, shape, values) if self._followed else _broadcast(end, shape)
            for end in (self.low, self.high)
        )
        return low, high

    @cached_property
    def _constant(self) -> tuple[Any, Any] | None:
        """Both corners, the tolerance included, where they follow no variable."""
        if self._followed:
            return None
        low, high = _widened(*(np.asarray(end, dtype=float) for end in (self.low, self.high)))
        return (low, high) if np.ndim(low) or np.ndim(high) else (float(low), float(high))

    def contains(self, value: Value, values: Values | None = None) -> bool:
        if self._constant is not None and np.ndim(value) < 2:
            low, high = self._constant
            number: Any = value if np.ndim(value) else float(value)
            inside = (number >= low) & (number <= high)
            return inside if isinstance(inside, bool) else bool(inside.all())
        low, high = _widened(*self.bounds(np.shape(value), values or {}))
        return bool(np.all(value >= low) and np.all(value <= high))

    def nearest(self, value: Value, values: Values | None = None) -> Value:
        low, high = self.bounds(np.shape(value), values or {})
        return np.asarray(np.clip(value, low, high))

    def nearest_inside(self, value: Value, values: Values | None = None) -> Value:
        """Find a nearest point that is not on the border, along edges that have a length."""
        low, high = self.bounds(np.shape(value), values or {})
        half = 0.5 * np.maximum(high - low, 0.0)
        first, last = (
            np.minimum(2.0 * TOLERANCE * np.maximum(1.0, np.abs(np.nan_to_num(end))), half)
            for end in (low, high)
        )
        return np.asarray(np.clip(value, low + first, high - last))

    def volume(self, shape: tuple[int, ...], values: Values) -> Floats:
        low, high = self.bounds(shape, values)
        edges = np.where(high > low, high - low, 1.0)
        return np.asarray(np.prod(edges, axis=tuple(range(-len(shape), 0))))

    def transform(self, uniforms: Floats, shape: tuple[int, ...], values: Values) -> Value:
        low, high = self.bounds(shape, values)
        unit = uniforms.reshape(*uniforms.shape[:-1], *shape)
        return low + (high - low) * unit

    def describe(self) -> str:
        lows, highs = ([*map(_end, listed(end))] for end in (self.low, self.high))
        size = max(len(lows), len(highs))
        ends = zip(*(end * size if len(end) == 1 else end for end in (lows, highs)), strict=True)
        parts = [low if low == high else f"{low} to {high}" for low, high in ends]
        for period in (1, 3):  # alike for all components, or for all fingers
            if parts == parts[:period] * (size // period):
                return ", ".join(parts[:period])
        return ", ".join(parts)


def _end(end: Bound) -> str:
    match end:
        case Affine(parent=parent, index=index, scale=scale, offset=offset):
            which = "" if index is None else f"[{index}]"
            factor = "" if scale == 1.0 else f"{scale:g} "
            summand = "" if offset == 0.0 else f"{offset:g} + "
            return f"{summand}{factor}{parent}{which}"
        case Switch(parent=parent, below=below, above=above, at=at):
            return f"({below:g} if {parent} < {at:g} else {above:g})"
    return f"{end:g}"


def refuse_infinite(option: str, region: object) -> Any:
    """Return a region; refuse a box that cannot be drawn from: with an end that is not finite."""
    if isinstance(region, Box):
        ends = (*listed(region.low), *listed(region.high))
        if any(isinstance(end, float | int) and not np.isfinite(end) for end in ends):
            raise UnknownOption(option, region, ("a box with finite ends",))
    return region


@final
class Integers(Set):
    """All whole numbers between two ends, both included; each is equally likely in a draw.

    Example:
        >>> Integers(1, 4).contains(np.array(4)), Integers(1, 4).contains(np.array(5))
        (True, False)
    """

    kind: Literal["integers"] = "integers"
    low: int
    high: int

    def __init__(self, low: int, high: int, **fields: object) -> None:
        super().__init__(low=low, high=high, **fields)

    def model_post_init(self, context: object) -> None:
        if self.low > self.high:
            raise ValueError(f"there are no whole numbers from {self.low} to {self.high}")

    def bounds(self, shape: tuple[int, ...], values: Values) -> tuple[Floats, Floats]:
        """Return the least and the greatest number, each of shape ``(*shape)``."""
        return np.full(shape, float(self.low)), np.full(shape, float(self.high))

    def nearest(self, value: Value, values: Values | None = None) -> Value:
        whole: Value = np.clip(np.rint(value), self.low, self.high).astype(np.int64)
        return whole

    def volume(self, shape: tuple[int, ...], values: Values) -> Floats:
        return np.asarray(float(self.high - self.low + 1) ** int(np.prod(shape)))

    def transform(self, uniforms: Floats, shape: tuple[int, ...], values: Values) -> Value:
        unit = uniforms.reshape(*uniforms.shape[:-1], *shape)
        whole: Value = (self.low + np.floor(unit * (self.high - self.low + 1))).astype(np.int64)
        return whole

    def describe(self) -> str:
        return f"{{{self.low}, …, {self.high}}}"


@final
class Categories(Set):
    """A few whole numbers without an order, which may have labels.

    The nearest value of another number is the first member.

    Attributes:
        members: The numbers.
        labels: A name for each number, which ``do`` takes as well; or none.

    Example:
        >>> Categories((1, 20)).contains(np.array(20))
        True
        >>> Categories(labels=("dry", "wet")).members
        (0, 1)
    """

    kind: Literal["categories"] = "categories"
    members: tuple[int, ...] = Field(min_length=1)
    labels: tuple[str, ...] = ()

    def __init__(
        self,
        members: Iterable[int] | None = None,
        labels: Sequence[str] = (),
        **fields: object,
    ) -> None:
        found = range(len(labels)) if members is None else members
        super().__init__(members=tuple(found), labels=tuple(labels), **fields)

    def model_post_init(self, context: object) -> None:
        if self.labels and len({*self.labels}) != len(self.members):
            raise ValueError(f"{len(self.members)} categories need as many different labels")

    @model_serializer(mode="wrap")
    def _without_no_labels(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        data: dict[str, Any] = handler(self)
        return data if self.labels else {k: v for k, v in data.items() if k != "labels"}

    def numbers(self, labels: Any) -> Value:
        """Return the numbers of labels, of any shape.

        Raises:
            KeyError: There is no such label.
        """
        known = dict(zip(self.labels, self.members, strict=True))
        found = np.array([known[label] for label in np.ravel(labels).tolist()], dtype=np.int64)
        return found.reshape(np.shape(labels))

    def nearest(self, value: Value, values: Values | None = None) -> Value:
        kept: Value = np.where(np.isin(value, self.members), value, self.members[0])
        return kept.astype(np.int64)

    def volume(self, shape: tuple[int, ...], values: Values) -> Floats:
        return np.asarray(float(len(self.members)) ** int(np.prod(shape)))

    def transform(self, uniforms: Floats, shape: tuple[int, ...], values: Values) -> Value:
        unit = uniforms.reshape(*uniforms.shape[:-1], *shape)
        index = np.floor(unit * len(self.members)).astype(np.int64)
        return np.asarray(self.members, dtype=np.int64)[index]

    def describe(self) -> str:
        if not self.labels:
            return "{" + ", ".join(map(str, self.members)) + "}"
        pairs = zip(self.members, self.labels, strict=True)
        return "{" + ", ".join(f"{member}: {label}" for member, label in pairs) + "}"


_Part = Annotated[Box | Integers | Categories, Field(discriminator="kind")]


@final
class Either(Set):
    """The union of two spaces, not their hull.

    A draw chooses one of them in proportion to its volume, by its first uniform number.

    Example:
        >>> gap = Either(Box(0.0, 1.0), Box(2.0, 3.0))
        >>> gap.contains(np.array(1.5)), gap.nearest(np.array(1.7))
        (False, array(2.))
    """

    kind: Literal["either"] = "either"
    first: _Part
    second: _Part

    def __init__(self, first: object, second: object, **fields: object) -> None:
        super().__init__(first=first, second=second, **fields)

    def parents(self) -> frozenset[str]:
        return self.first.parents() | self.second.parents()

    def contains(self, value: Value, values: Values | None = None) -> bool:
        return self.first.contains(value, values) or self.second.contains(value, values)

    def nearest(self, value: Value, values: Values | None = None) -> Value:
        candidates = [self.first.nearest(value, values), self.second.nearest(value, values)]
        return min(candidates, key=lambda point: float(np.sum((point - value) ** 2)))

    def volume(self, shape: tuple[int, ...], values: Values) -> Floats:
        return self.first.volume(shape, values) + self.second.volume(shape, values)

    def n_uniforms(self, shape: tuple[int, ...]) -> int:
        return 1 + max(self.first.n_uniforms(shape), self.second.n_uniforms(shape))

    def transform(self, uniforms: Floats, shape: tuple[int, ...], values: Values) -> Value:
        share = self.first.volume(shape, values) / self.volume(shape, values)
        draws = [
            space.transform(uniforms[..., 1 : 1 + space.n_uniforms(shape)], shape, values)
            for space in (self.first, self.second)
        ]
        which = uniforms[..., 0] < share
        chosen: Value = np.where(which[(..., *(None,) * len(shape))], *draws)
        return chosen

    def describe(self) -> str:
        return f"{self.first.describe()} or {self.second.describe()}"


@final
class Rotations(Set):
    """All unit quaternions (x, y, z, w); q and -q are one rotation, written with w >= 0.

    A value belongs to it if its norm is 1 to six digits; the nearest one of zero is the identity.
    The volume of the group is π²: half of the unit sphere in four dimensions.

    Attributes:
        keeps_sign: Whether q and -q are distinguished, for backends that keep the given sign.

    Example:
        >>> Rotations().nearest(np.array([0.0, 0.0, 0.0, -2.0]))
        array([0., 0., 0., 1.])
    """

    kind: Literal["rotations"] = "rotations"
    keeps_sign: bool = False

    def contains(self, value: Value, values: Values | None = None) -> bool:
        return bool(np.all(np.abs(np.linalg.norm(value, axis=-1) - 1.0) < 1e-6))

    def nearest(self, value: Value, values: Values | None = None) -> Value:
        norm = np.linalg.norm(value, axis=-1, keepdims=True)
        whole = np.where(norm < 1e-12, (0.0, 0.0, 0.0, 1.0), value)
        length = np.where(norm < 1e-12, 1.0, norm)
        exact = np.where(np.abs(length - 1.0) < 1e-15, 1.0, length)
        turned = (whole[..., 3:] < 0) & (not self.keeps_sign)
        unit: Value = whole / exact * np.where(turned, -1.0, 1.0)
        return unit + 0.0

    def volume(self, shape: tuple[int, ...], values: Values) -> Floats:
        return np.asarray(float(np.pi**2))

    def n_uniforms(self, shape: tuple[int, ...]) -> int:
        return 3

    def transform(self, uniforms: Floats, shape: tuple[int, ...], values: Values) -> Value:
        """Turn three uniform numbers into a uniformly distributed rotation.

        Source:
            Shoemake, *Uniform random rotations*, Graphics Gems III, 1992.
        """
        u, v, w = (uniforms[..., i] for i in range(3))
        a, b = np.sqrt(1.0 - u), np.sqrt(u)
        angle, turn = 2.0 * np.pi * v, 2.0 * np.pi * w
        parts = (a * np.sin(angle), a * np.cos(angle), b * np.sin(turn), b * np.cos(turn))
        return self.nearest(np.stack(parts, axis=-1))

    def describe(self) -> str:
        return "the unit quaternions"


Space = Annotated[Box | Integers | Categories | Either | Rotations, Field(discriminator="kind")]
"""A set that can tell whether a value is in it, and from which one can draw."""
