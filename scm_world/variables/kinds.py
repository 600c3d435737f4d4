"""The kinds of variable. One declaration per variable; it reads like a row of a table."""
# ruff: noqa: D102 # ``Variable`` describes the properties

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, final, get_args

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, WrapValidator, model_validator

from scm_world._arguments import typed, whole_number
from scm_world._types import ArrayLike, Value, Values
from scm_world.errors import FunctionFailure, ModelError, ScmWorldError, in_one_line
from scm_world.variables.distributions import Distribution
from scm_world.variables.mechanisms import (
    EQUATIONS,
    Concatenation,
    Equation,
    Function,
    Linear,
    Table,
    check_order,
)
from scm_world.variables.open_kinds import OpenKinds
from scm_world.variables.spaces import (
    Box,
    Categories,
    Either,
    Frozen,
    Integers,
    Rotations,
    Space,
)

if TYPE_CHECKING:
    from scm_world.variables.moments import Moment

Role = Literal["parameter", "state", "readout", "action"]
SpaceName = Literal["A", "B", "A|B"]
SPACES: tuple[SpaceName, ...] = get_args(SpaceName)


def _as_number(value: ArrayLike) -> object:
    try:
        given = np.asarray(value)
    except ValueError:  # a ragged list
        given = np.asarray("")
    if given.dtype.kind not in "iufb":
        raise ValueError("it can be a number or an array of numbers")
    return tuple(given.ravel().tolist()) if given.ndim else given.item()


def _as_mechanism(value: object) -> object:
    return Function(value) if callable(value) and not isinstance(value, EQUATIONS) else value


def _as_name(name: str) -> str:
    if _CONTROL(name):
        raise ValueError(f"a name has no control characters, such as a new line: {name!r}")
    return name


_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]").search
AsNumber = Annotated[float | tuple[float, ...], BeforeValidator(_as_number)]
AsMechanism = Annotated[Equation, BeforeValidator(_as_mechanism)]
InverseNoise = Literal["additive", "monotone"] | AsMechanism


@final
class Parent(Frozen):
    """An edge into a variable.

    Attributes:
        name: The cause.
        lag: 0 where the cause acts within the instant, 1 where it acts one control step later; more
            in models without a backend.
        when: Under which condition the edge holds, None for always: ``"contact"`` while the
            bodies are in one contact island, ``"set"`` at the start of an episode and at the
            instant of an intervention.
    """

    kept = True
    name: str
    lag: Annotated[int, BeforeValidator(partial(whole_number, "lag", least=0))] = 0
    when: Literal["contact", "set"] | None = None

    def __init__(self, name: object = None, lag: int = 0, when: str | None = None) -> None:
        super().__init__(name=name, lag=lag, when=when)


class Coupled(tuple[Parent, ...]):
    """The edges into a state, checked: where many bodies can touch there are very many."""

    __slots__ = ()


def coupled(
    before: Iterable[Parent], shared: Mapping[str, Parent], after: Iterable[Parent] = ()
) -> Coupled:
    """Join edges into a state: its own, and between them those of lag 1 that many states share.

    An own edge with lag, from the same cause, replaces a shared one.
    """
    lagged = {parent.name for parent in (*before, *after) if parent.lag}
    rest = (parent for name, parent in shared.items() if name not in lagged)
    return Coupled((*before, *rest, *after))


def _without(space: Space | None, other: Space | None) -> Space | None:
    """Remove from a set of whole numbers those of another one."""
    match space, other:
        case Integers(low=low, high=high), Integers() if low <= other.high and other.low <= high:
            if other.low <= low and other.high < high:
                return Integers(other.high + 1, high)
            if low < other.low and high <= other.high:
                return Integers(low, other.low - 1)
        case Categories(members=members), Categories():
            rest = tuple(member for member in members if member not in other.members)
            return Categories(rest) if rest else space
    return space


def _as_parents(value: object, validate: Callable[[Any], Any]) -> Any:
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise ValueError(f"parents must be a sequence of names, got {value!r}")
    if isinstance(value, Coupled) or (isinstance(value, tuple) and {*map(type, value)} <= {Parent}):
        return value  # variables with the same parents share one tuple of them
    return validate(tuple(parent_of(p) if isinstance(p, str) else p for p in value))


@lru_cache(maxsize=2**10)
def parent_of(name: str, lag: int = 0, when: str | None = None) -> Parent:
    """Return an edge; equal ones of many variables are one object."""
    return Parent(name, lag, when)


AsParents = Annotated[tuple[Parent, ...], WrapValidator(_as_parents)]


class Variable(OpenKinds):
    """The base class of all kinds of variables; a subclass with a ``kind`` of its own is a kind.

    A kind that is computed answers with ``all_parents`` and ``equation``; see
    ``docs/extending.md``.

    Attributes:
        name: ``"<entity>.<quantity>"``.
        unit: SI unit; ``"1"`` for a pure number.
        shape: Shape of one value.
        dtype: ``"real"``, ``"integer"`` or ``"categorical"``.
        bounds: The physically possible values, or None for anything finite.
        a: The training space, or None.
        b: The held-out space, or None. A point that lies in both belongs to A, unless the two are
            the same space: then nothing is held out.
        a_or_b: The space ``A|B``, where it is not the union of the two.
        doc: One sentence.
    """

    kept = True
    kinds: ClassVar[dict[str, type[Any]]] = {}
    is_root: ClassVar[bool] = False
    """Whether nature sets it: it has no causes but the bounds of its distribution."""
    is_constant: ClassVar[bool] = False

    name: Annotated[str, AfterValidator(_as_name)] = Field(min_length=1)
    unit: str = "1"
    shape: tuple[int, ...] = ()
    dtype: Literal["real", "integer", "categorical"] = "real"
    bounds: Space | None = None
    a: Space | None = None
    b: Space | None = None
    a_or_b: Space | None = None
    doc: str = ""

    @property
    def all_parents(self) -> tuple[Parent, ...]:
        """The edges into this variable."""
        return ()

    @property
    def equation(self) -> Equation | None:
        """The function that computes it from its parents, in their order; None if there is none."""
        return None

    @property
    def own_noise(self) -> Distribution | None:
        """The distribution of a root, or that of the noise of a computed variable."""
        return None

    @property
    def shape_of_noise(self) -> tuple[int, ...]:
        """The shape of the noise."""
        return self.shape

    @property
    def noise_inverse(self) -> InverseNoise | None:
        """How the noise follows from a value; see ``Derived.inverse_noise``."""
        return None

    @property
    def per_episode(self) -> bool:
        """Whether it is drawn once for an episode, not in every step."""
        return False

    @property
    def coordinates_of(self) -> str | None:
        """The quantity of which these are other coordinates; None for a quantity of its own."""
        return None

    @property
    def first(self) -> Value:
        """The value that its lagged children see before the first step."""
        return np.zeros(self.shape, np.float64 if self.dtype == "real" else np.int64)

    def set_parents(self) -> tuple[str, ...]:
        """Name the parents that act when a state is set."""
        return ()

    def with_parents(self, parents: tuple[Parent, ...]) -> Variable:
        """Return it with other edges, of the same causes.

        Raises:
            ModelError: The edges of its kind are no field.
        """
        if "parents" not in type(self).model_fields:
            text = f"{self.name!r} follows a command, which is not chosen yet in an instant"
            raise ModelError([f"{text}: its class has to give this cause a lag of 1"])
        return self.model_copy(update={"parents": parents})

    @property
    def parts(self) -> tuple[str, ...]:
        """The variables that a bundle joins, in order; none for other variables."""
        return ()

    def split(self, value: Value) -> tuple[Value, ...]:
        """Return the values of the parts of a bundle; its numbers are the last axis."""
        equation = self.equation
        if not isinstance(equation, Concatenation):
            raise ModelError([f"{self.name!r} is not a bundle"])
        return equation.split(value)

    @property
    def role(self) -> Role:
        """The meaning of an intervention on it; see ``docs/variables.md``."""
        return "parameter"

    @property
    def is_measured(self) -> bool:
        """Whether it moves by itself from instant to instant: a state, or a readout of states."""
        return self.role in ("state", "readout")

    @property
    def is_simulated(self) -> bool:
        """Whether an engine computes it."""
        return self.is_measured and self.equation is None

    @property
    def settable(self) -> bool:
        """Whether ``do`` accepts it."""
        return True

    def array(self, value: ArrayLike) -> Value:
        """Return a number, or a flat tuple, as a value of the declared dtype and shape."""
        kind = np.float64 if self.dtype == "real" else np.int64
        return np.asarray(value, dtype=kind).reshape(self.shape)

    def full(self, value: ArrayLike) -> Value:
        """Return a value; one number stands for all components."""
        return self.array(np.broadcast_to(value, self.shape) if np.ndim(value) == 0 else value)

    def value_of(self, at: Moment) -> Value:
        """Compute the value without intervention, or take a known one if it has no function.

        Raises:
            FunctionFailure: Its function raises, or gives what is no value of this variable.
            ModelError: It has no function, and its value is not known.
        """
        equation = self.equation
        if equation is None:
            if self.name not in at.values:
                raise ModelError([f"{self.name!r} is not computed by the model: give its value"])
            return at.values[self.name]
        arguments, noise = at.arguments(self.all_parents), at.noise(self, self.own_noise)
        try:
            value = np.asarray(equation.bind()(*arguments, **noise))
        except ScmWorldError:
            raise
        except Exception as error:
            problem = f"the function of {self.name!r} raised {in_one_line(error)}"
            raise FunctionFailure(problem) from error
        if self.role != "parameter":  # worlds check readouts themselves
            return value
        shape = value.shape[value.ndim - len(self.shape) :]
        if value.dtype.kind not in "biuf" or shape != self.shape:
            wanted = f"numbers of shape {self.shape}" if self.shape else "a number"
            raise FunctionFailure(f"the function of {self.name!r} gives {value!r}, not {wanted}")
        self.refuse_wrong(value)
        return value

    def refuse_wrong(self, value: Value) -> None:
        """Refuse what a function gives that is NaN, no whole number, or none of the categories."""
        bounds, said = self.bounds, ""
        if value.dtype.kind == "f" and np.isnan(value).any():
            rows = f" in {int(np.isnan(value).sum())} of {value.size} numbers" if value.ndim else ""
            said = f"NaN{rows}"
        elif self.dtype == "integer" and value.dtype.kind == "f":
            wrong = value[np.rint(value) != value].ravel().tolist()[:3]
            more = "and the variable is an integer: round them in the function"
            said = f"{wrong}, {more}" if wrong else ""
        elif isinstance(bounds, Categories) and not bounds.contains(value):
            wrong = np.setdiff1d(value, bounds.members).tolist()[:3]
            said = f"{wrong}, which are none of {bounds.describe()}"
        if said:
            raise FunctionFailure(f"the function of {self.name!r} gives {said}")

    def space(self, name: SpaceName) -> Space | None:
        """Return one of the declared spaces, or their union; None where it is not declared.

        Whole numbers that lie in both are left out of B; of a continuum, the border stays in the
        set and is distinguished by ``in_space``.
        """
        match name:
            case "A":
                return self.a
            case "B":
                return _without(self.b, self.a)
            case _:
                if self.a_or_b is not None:
                    return self.a_or_b
                both = self.a is not None and self.b is not None and self.a != self.b
                return Either(self.a, self.space("B")) if both else (self.a or self.b)

    def in_space(self, value: Value, name: SpaceName, values: Values) -> bool:
        """Return whether a value lies in a space, given the values of the other variables."""
        space = self.space(name)
        if space is None or not space.contains(value, values):
            return False
        if name != "B" or self.a is None or self.a == self.b:
            return True
        return not self.a.contains(value, values)

    def nearest_in_space(self, value: Value, name: SpaceName, values: Values) -> Value | None:
        """Find the nearest value that lies in a space; None where none is found."""
        space = self.space(name)
        if space is None:
            return None
        candidates: list[Value] = [np.asarray(space.nearest(value, values))]
        if isinstance(space, Box):
            candidates.append(space.nearest_inside(value, values))
        return next((c for c in candidates if self.in_space(c, name, values)), None)

    @model_validator(mode="after")
    def _spaces_and_parts_fit(self) -> Variable:
        for space in (self.bounds, self.a, self.b):
            if self.dtype != "real" and isinstance(space, Box | Rotations):
                raise ValueError(f"{self.name}: {self.dtype} values need Integers or Categories")
        if self.dtype == "categorical" and self.bounds is None:
            raise ValueError(f"{self.name}: a categorical variable needs bounds=Categories(…)")
        mechanism, parents = self.equation, self.all_parents
        if isinstance(mechanism, Concatenation):
            n = mechanism.slices[-1].stop if mechanism.slices else 0
            if len(mechanism.shapes) != len(parents) or self.shape != (n,):
                raise ValueError(
                    f"{self.name}: a bundle has one shape for each part, and their numbers in one "
                    f"row: {len(parents)} parts, {mechanism.shapes}, {self.shape}"
                )
            if any(parent.lag or parent.when for parent in parents):
                raise ValueError(f"{self.name}: the parts of a bundle are present values")
        return self


@final
class Exogenous(Variable):
    """A root of the graph: its default, or a draw from its distribution.

    Attributes:
        default: The value without a draw.
        distribution: The distribution for ``sample``; None for the default.
        per: When it is drawn in a model with lagged edges: once for an ``"episode"``, as a
            parameter is, or anew in every ``"step"``.
    """

    is_root = True
    kind: Literal["exogenous"] = "exogenous"
    default: AsNumber = 0.0
    distribution: Distribution | None = None
    per: Literal["episode", "step"] = "episode"

    @property
    def all_parents(self) -> tuple[Parent, ...]:
        """The variables that the bounds of its distribution follow."""
        followed = () if self.distribution is None else sorted(self.distribution.parents())
        return tuple(Parent(name) for name in followed)

    @property
    def own_noise(self) -> Distribution | None:
        return self.distribution

    @property
    def per_episode(self) -> bool:
        return self.per == "episode"

    @property
    def first(self) -> Value:
        return self.full(self.default)

    def value_of(self, at: Moment) -> Value:
        if self.name in at.values:
            return at.values[self.name]
        if at.key is None or self.distribution is None:
            return self.array(self.default)
        key = at.key.of(self)
        return key.natural(self.distribution, self.name, self.shape, at.values)

    @model_validator(mode="after")
    def _default_fits(self) -> Exogenous:
        broadcasts = np.ndim(self.default) == 0 and self.shape != ()
        if broadcasts or np.size(self.default) != int(np.prod(self.shape)):
            raise ValueError(f"{self.name}: the default does not have the shape {self.shape}")
        return self


@final
class Derived(Variable):
    """A variable that a Python function computes from its parents.

    Attributes:
        parents: Its causes, in the order in which the mechanism takes them. A function whose
            arguments have their names in another order is refused.
        mechanism: The function.
        noise: Distribution of its own noise, or None. The mechanism takes it as ``noise=``.
        noise_shape: Shape of the noise; that of the variable if None.
        inverse_noise: How the noise follows from a value of this variable and those of the parents,
            for ``SCM.counterfactual``: ``"additive"`` where the function adds it, ``"monotone"``
            where each component rises or falls with its own noise, or a function of the value and
            the parents. It is known of ``Linear``, of a ``Table``, and of a discrete noise.
        start: The value that lagged children see before the first step.
        inverse: For other coordinates of one quantity (cylindrical for Cartesian): the function
            from a value of this variable to that of its only parent. An intervention on this
            variable is then one on the parent.
    """

    kind: Literal["derived"] = "derived"
    parents: AsParents
    mechanism: AsMechanism
    noise: Distribution | None = None
    noise_shape: tuple[int, ...] | None = None
    start: AsNumber = 0.0
    inverse: AsMechanism | None = None
    inverse_noise: InverseNoise | None = None

    @property
    def all_parents(self) -> tuple[Parent, ...]:
        return self.parents

    @property
    def equation(self) -> Equation | None:
        return self.mechanism

    @property
    def parts(self) -> tuple[str, ...]:
        return names(self.parents) if isinstance(self.mechanism, Concatenation) else ()

    @property
    def own_noise(self) -> Distribution | None:
        return self.noise

    @property
    def shape_of_noise(self) -> tuple[int, ...]:
        return self.shape if self.noise_shape is None else self.noise_shape

    @property
    def noise_inverse(self) -> InverseNoise | None:
        return self.inverse_noise

    @property
    def coordinates_of(self) -> str | None:
        return None if self.inverse is None else self.parents[0].name

    @property
    def first(self) -> Value:
        return self.full(self.start)

    @model_validator(mode="before")
    @classmethod
    def _tables_have_uniform_noise(cls, data: object) -> Any:
        if isinstance(data, dict) and isinstance(data.get("mechanism"), Table):
            return {"noise": Box(0.0, 1.0), **data}
        return data

    @model_validator(mode="after")
    def _fits(self) -> Derived:
        if self.inverse is not None and len(self.parents) != 1:
            raise ValueError(f"{self.name}: coordinates have exactly one parent")
        expected: Any = self.parents
        match self.mechanism:
            case Linear(weights=weights):
                expected = weights
            case Table(shape=shape):
                expected = shape[:-1]
        if len(expected) != len(self.parents):
            raise ValueError(
                f"{self.name}: {len(expected)} weights for {len(self.parents)} parents"
            )
        check_order(self.name, self.mechanism, names(self.parents))
        check_order(self.name, self.inverse_noise, names(self.parents), before=1)
        if self.noise is None and (self.noise_shape is not None or self.inverse_noise is not None):
            raise ValueError(f"{self.name}: noise_shape and inverse_noise need a noise")
        alike = self.noise_shape in (None, self.shape)
        if isinstance(self.inverse_noise, str) and not alike:
            raise ValueError(f"{self.name}: {self.inverse_noise} noise has the shape of the value")
        return self


@final
class Measured(Variable):
    """A state of the physics, or a readout of it.

    A state, or a bundle of states (``settable_state=True``), can be set at an instant; physics
    carries it on. A readout cannot be set.

    Attributes:
        parents: Its causes.
        mechanism: The function of the parents, for a readout that is computed; None where the
            backend itself is the mechanism.
        settable_state: Whether ``do`` may set it at an instant.
        default: The value at the start of an episode, for a state without ``start``.
        start: The value at the start as a function of the parents with ``when="set"``.
        carry: How an intervention on a parent with ``when="set"`` moves a state at lag 0:
            a function of (the present value, those parents before, those parents after).
        restart: Those parents with ``when="set"`` that, when set, give it the value of ``start``.
    """

    kind: Literal["measured"] = "measured"
    parents: AsParents = ()
    mechanism: AsMechanism | None = None
    settable_state: bool = False
    default: AsNumber | None = None
    start: AsMechanism | None = None
    carry: AsMechanism | None = None
    restart: tuple[str, ...] = ()

    @property
    def all_parents(self) -> tuple[Parent, ...]:
        return self.parents

    @property
    def equation(self) -> Equation | None:
        return self.mechanism

    @property
    def parts(self) -> tuple[str, ...]:
        return names(self.parents) if isinstance(self.mechanism, Concatenation) else ()

    @property
    def role(self) -> Role:
        return "state" if self.settable_state else "readout"

    @property
    def settable(self) -> bool:
        return self.settable_state

    @model_validator(mode="after")
    def _arguments_are_in_order(self) -> Measured:
        if self.mechanism is not None:
            check_order(self.name, self.mechanism, names(self.parents))
        if self.start is not None:
            check_order(self.name, self.start, self.set_parents())
        return self

    def set_parents(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parents if p.when == "set")


@final
class Action(Variable):
    """A command of the policy at every control step."""

    kind: Literal["action"] = "action"

    @property
    def role(self) -> Role:
        return "action"


@final
class Fixed(Variable):
    """A constant: a variable that ``do`` has set, or a fact that cannot change.

    Attributes:
        value: The constant.
        intervenable: Whether ``do`` may put another one there.
    """

    is_constant = True
    kind: Literal["fixed"] = "fixed"
    value: AsNumber
    intervenable: bool = False

    @property
    def settable(self) -> bool:
        return self.intervenable

    @property
    def first(self) -> Value:
        return self.full(self.value)

    def value_of(self, at: Moment) -> Value:
        return self.array(self.value)


@typed
def names(parents: Sequence[Parent]) -> tuple[str, ...]:
    """Return the names of parents, of all lags."""
    return tuple(parent.name for parent in parents)
