"""Facts about declarations, and about the values that are given to them."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from scm_world.errors import (
    ModelError,
    OutOfBounds,
    UnknownOption,
    WrongValue,
)
from scm_world.variables import (
    Action,
    Affine,
    Bernoulli,
    Box,
    Categories,
    Continuous,
    Derived,
    Discrete,
    Draw,
    Either,
    Exogenous,
    Fixed,
    Function,
    Hard,
    Integers,
    Intervention,
    Linear,
    Measured,
    Mechanism,
    Normal,
    Parent,
    Rotations,
    Scale,
    Shift,
    Table,
    Variable,
    names,
)
from scm_world.variables.checks import check_bounds, check_space, coerce


def double(x: Any, *, by: Any = 2.0) -> Any:
    """Multiply."""
    return by * x


VARIABLES = [
    Exogenous(name="free", bounds=Box(-math.inf, math.inf), doc="Any number."),
    Exogenous(
        name="place",
        unit="m",
        shape=(3,),
        a=Box((0.0, 0.0, Affine(parent="free", scale=0.5)), (1.0, math.inf, 0.1)),
        b=Box(-1.0, 0.0),
        default=(0.1, 0.2, 0.3),
        distribution=Normal(0.1, 0.2),
    ),
    Exogenous(name="count", dtype="integer", bounds=Integers(0, 9), default=3),
    Exogenous(name="kind", dtype="categorical", bounds=Categories((1, 20)), default=20),
    Exogenous(name="turn", shape=(4,), bounds=Rotations(), default=(0.0, 0.0, 0.0, 1.0)),
    Exogenous(name="gap", distribution=Either(Box(0.0, 1.0), Box(2.0, 3.0)), default=0.5),
    Exogenous(name="matrix", shape=(2, 2), default=(1.0, 2.0, 3.0, 4.0)),
    Derived(
        name="sum",
        parents=("free", Parent("gap", 1)),
        mechanism=Linear(weights=(1.0, -0.1), intercept=0.3),
        noise=Normal(0.0, 0.1),
        start=0.7,
    ),
    Derived(
        name="twice",
        parents=("free",),
        mechanism=Function(double, constants={"by": 3.0}),
        inverse=double,
    ),
    Measured(
        name="state",
        parents=(Parent("free", 1, "contact"), Parent("gap", 0, "set")),
        settable_state=True,
        start=double,
        carry=Function(double, constants={"by": (1.0, 2.0)}),
    ),
    Measured(name="readout", parents=("free",), mechanism=double),
    Action(name="action", shape=(9,), bounds=Box(-1.0, 1.0)),
    Fixed(name="constant", value=(1.0, 2.0), shape=(2,), intervenable=True),
]


@pytest.mark.parametrize("variable", VARIABLES, ids=lambda v: v.name)
def test_every_kind_of_variable_survives_json(variable: Any) -> None:
    """Written and read again, a declaration is equal and of the same kind."""
    adapter: TypeAdapter[Any] = TypeAdapter(Variable)
    plain = adapter.dump_python(variable, mode="json")
    again = adapter.validate_python(json.loads(json.dumps(plain)))
    assert again == variable
    assert type(again) is type(variable)


@pytest.mark.parametrize(
    "act",
    [
        Hard(0.1),
        Hard((1.0, 2.0)),
        Hard(np.array([[1.0, 2.0], [3.0, 4.0]])),
        Shift(-0.1),
        Scale([2.0, 3.0]),
        Draw("A|B"),
        Draw(Normal(0.1, 0.2)),
        Draw(Box(0.0, Affine(parent="x"))),
    ],
    ids=repr,
)
def test_every_intervention_survives_json(act: Any) -> None:
    """Written and read again, an intervention is equal."""
    adapter: TypeAdapter[Any] = TypeAdapter(Intervention)
    assert adapter.validate_json(adapter.dump_json(act)) == act


def test_declarations_are_frozen() -> None:
    """Nothing can be changed."""
    with pytest.raises(ValidationError):
        VARIABLES[0].name = "other"


@pytest.mark.parametrize(
    ("make", "kind", "said"),
    [
        (lambda: Exogenous(name="x", defualt=1.0), UnknownOption, "'defualt'; did you mean 'defa"),
        (lambda: Box(0.0, 1.0, hihg=2.0), UnknownOption, "field of Box is named 'hihg'"),
        (lambda: Draw("A", strem="x"), UnknownOption, "did you mean 'stream'"),
        (lambda: Exogenous(default=1.0), ModelError, r"Exogenous\.name: Field required"),
        (lambda: Exogenous(name="x", default="much"), ModelError, r"Exogenous\.default = 'much'"),
        (lambda: Box(1.0, 0.0), ModelError, "a box is empty where low > high"),
        (lambda: Box((0.0, math.nan), 1.0), ModelError, "an end of a box is not a number"),
        (lambda: Linear(weights=(math.nan,)), ModelError, "Linear.weights = nan: .* finite"),
        (lambda: Linear(weights=(1.0,), intercept=math.inf), ModelError, "finite"),
        (lambda: Table([[math.nan, 1.0]]), ModelError, "finite"),
        (lambda: Normal(0.0, math.inf), ModelError, "finite"),
        (lambda: Continuous("laplace", loc=math.nan), ModelError, "finite"),
        (lambda: Discrete((1.0, math.nan)), ModelError, "finite"),
        (lambda: Bernoulli(math.nan), ModelError, "finite"),
        (lambda: Affine(parent="x", scale=math.inf), ModelError, "finite"),
        (lambda: Exogenous(name="x", default=math.nan), ModelError, "finite"),
        (lambda: Fixed(name="x", value=(0.0, math.inf), shape=(2,)), ModelError, "finite"),
        (lambda: Exogenous(name="x", distribution=Box(0.0, math.inf)), UnknownOption, "finite"),
        (lambda: Draw(Box(-math.inf, 0.0)), UnknownOption, "a box with finite ends"),
        (lambda: Box((0.0, 1.0), (1.0, 0.0)), ModelError, "a box is empty"),
        (lambda: Box((0.0, 0.0), (1.0, 1.0, 1.0)), ModelError, "corners of one shape"),
        (lambda: Integers(3, 1), ModelError, "no whole numbers from 3 to 1"),
    ],
)
def test_wrong_fields_are_errors_of_this_package(make: Any, kind: type, said: str) -> None:
    """They name the field, what is wrong with it, and the nearest one that there is."""
    with pytest.raises(kind, match=said):
        make()


@pytest.mark.parametrize(
    "make",
    [
        lambda: Exogenous(name=""),
        lambda: Exogenous(name="x", shape=(3,)),
        lambda: Exogenous(name="x", shape=(3,), default=(1.0, 2.0)),
        lambda: Exogenous(name="x", dtype="categorical"),
        lambda: Derived(name="x", parents="parent", mechanism=double),
        lambda: Derived(name="x", parents=("a", "b"), mechanism=Linear(weights=(1.0,))),
        lambda: Derived(name="x", parents=("a", "b"), mechanism=double, inverse=double),
        lambda: Normal(0.0, -1.0),
        lambda: Categories(()),
        lambda: Parent("x", -1),
        lambda: Draw("C"),
    ],
)
def test_a_declaration_that_makes_no_sense_is_refused(make: Any) -> None:
    """Missing components, wrong numbers of weights and the like are found at once."""
    with pytest.raises(ValueError):  # noqa: PT011 pydantic words it
        make()


def test_roles_follow_from_the_kind() -> None:
    """Parameters hold, states are set at an instant, readouts are not set."""
    roles = {v.name: (v.role, v.settable) for v in VARIABLES}
    assert roles["free"] == ("parameter", True)
    assert roles["twice"] == ("parameter", True)
    assert roles["state"] == ("state", True)
    assert roles["readout"] == ("readout", False)
    assert roles["action"] == ("action", True)
    assert roles["constant"] == ("parameter", True)
    assert not Fixed(name="fact", value=1.0).settable


def test_the_union_of_equal_spaces_is_the_space() -> None:
    """A|B of a variable with one space, or with two equal ones, is that space."""
    box = Box(0.0, 1.0)
    assert Exogenous(name="x", a=box, b=box).space("A|B") == box
    assert Exogenous(name="x", b=box).space("A|B") == box
    assert Exogenous(name="x").space("A|B") is None


def test_a_lambda_works_and_is_equal_to_itself_only() -> None:
    """Functions without a name are told apart by identity."""
    first, second = Function(lambda x: x), Function(lambda x: x)
    assert first.bind()(3.0) == 3.0
    assert first == first
    assert first != second
    assert not first.is_portable()
    assert Function(double).is_portable()


def test_a_name_that_is_no_function_is_an_error() -> None:
    """A constant of a module cannot be called."""
    with pytest.raises(ModelError, match="is not a function"):
        Function("math:pi").resolve()


@pytest.mark.parametrize(
    ("value", "error"),
    [
        ("heavy", WrongValue),
        (None, WrongValue),
        (True, WrongValue),
        (1j, WrongValue),
        ({1.0}, WrongValue),
        ([[1.0], [1.0, 2.0]], WrongValue),
        (10**400, WrongValue),
        (Box(0.0, 1.0), WrongValue),
        (1.0, WrongValue),
        ([1.0, 2.0], WrongValue),
        ([[1.0, 2.0, 3.0]], WrongValue),
        ([1.0, 2.0, math.nan], WrongValue),
        ([1.0, -math.inf, 3.0], WrongValue),
    ],
    ids=repr,
)
def test_what_is_no_vector_of_numbers_is_refused(value: Any, error: type[Exception]) -> None:
    """Type, shape and finiteness are told apart."""
    with pytest.raises(error):
        coerce(VARIABLES[1], value)


@pytest.mark.parametrize("value", [[1, 2, 3], (1.0, 2, 3), np.float32([1, 2, 3])], ids=repr)
def test_numbers_of_any_kind_are_taken(value: Any) -> None:
    """Lists, tuples and arrays of any number type become 64-bit floats."""
    taken = coerce(VARIABLES[1], value)
    assert taken.dtype == np.float64
    np.testing.assert_array_equal(taken, [1.0, 2.0, 3.0])


@pytest.mark.parametrize("value", [2.5, 1e300, 2**60, "2"], ids=repr)
def test_an_integer_takes_whole_numbers_only(value: Any) -> None:
    """Halves, and numbers that a file could not hold, are refused; 2.0 is 2."""
    with pytest.raises(WrongValue):
        coerce(VARIABLES[2], value)
    assert coerce(VARIABLES[2], 2.0).dtype == np.int64


def test_the_nearest_value_inside_the_bounds_is_offered() -> None:
    """An error about bounds carries what is allowed and what is nearest."""
    mass = Exogenous(name="mass", unit="kg", bounds=Box(0.1, 2.0))
    with pytest.raises(OutOfBounds) as caught:
        check_bounds(mass, np.array(3.0), {})
    assert (caught.value.variable, caught.value.value, caught.value.nearest) == ("mass", 3.0, 2.0)
    with pytest.raises(WrongValue):
        check_bounds(mass, np.array(math.inf), {})


@pytest.mark.parametrize("space", ["A", "B", "A|B"])
def test_a_variable_without_spaces_lies_in_none(space: Any) -> None:
    """Asking for a space that is not declared is an error, not a pass."""
    with pytest.raises(OutOfBounds, match="none is declared"):
        check_space(Exogenous(name="x"), np.array(0.0), space, {})


def test_an_error_about_b_offers_a_value_of_b() -> None:
    """The nearest value of B is one that B accepts, though its border belongs to A."""
    mass = Exogenous(name="mass", unit="kg", a=Box(0.015, 0.045), b=Box(0.045, 0.1))
    with pytest.raises(OutOfBounds, match="without A") as caught:
        check_space(mass, np.array(0.03), "B", {})
    check_space(mass, np.array(caught.value.nearest), "B", {})


class Difference:
    """A callable object, and a method."""

    def __call__(self, c: Any, b: Any) -> Any:
        """Subtract."""
        return c - b

    def of(self, c: Any, b: Any) -> Any:
        """Subtract."""
        return c - b


@pytest.mark.parametrize(
    ("function", "parents"),
    [
        (lambda c, b: c - b, ("b", "c")),
        (lambda c, b, noise: c - b + noise, ("b", "c")),
        (lambda b, c, a: c - b, ("a", "b", "c")),
        (lambda c, b, k: c - b, ("b", "c", "d")),
        (lambda position, velocity: position, ("cart.velocity", "cart.position")),
        (lambda cart_position, cart_velocity: 0.0, ("cart.velocity", "cart.position")),
        (Difference(), ("b", "c")),
        (Difference().of, ("b", "c")),
        (Function(lambda c, b: c - b), (Parent("b", 1), "c")),
    ],
)
def test_arguments_named_as_parents_stand_in_their_order(function: Any, parents: Any) -> None:
    """Parents bind by position, so a permutation of their names would be exchanged in silence."""
    for declare in (
        lambda: Derived(name="y", parents=parents, mechanism=function, noise=Normal()),
        lambda: Measured(name="y", parents=parents, mechanism=function),
        lambda: Mechanism(function, parents),
    ):
        with pytest.raises(ModelError, match="the function takes its parents in the order"):
            declare()


@pytest.mark.parametrize(
    ("function", "parents"),
    [
        (lambda b, c: c - b, ("b", "c")),
        (lambda one, other: one - other, ("b", "c")),
        (lambda x, y: x - y, ("y", "z")),
        (lambda mass, friction: mass, ("a.mass", "b.mass")),
        (lambda x, before: x - before, (Parent("x", 1), "x")),
        (np.maximum, ("b", "c")),
    ],
)
def test_other_names_of_arguments_say_nothing(function: Any, parents: Any) -> None:
    """A function for any variables binds by position."""
    made = Derived(name="w", parents=parents, mechanism=function)
    assert names(made.parents) == tuple(p if isinstance(p, str) else p.name for p in parents)


def test_the_inverse_of_noise_takes_the_parents_in_their_order() -> None:
    """After the value of the variable."""
    with pytest.raises(ModelError, match=r"y: .* in the order \(c, b\)"):
        Derived(
            name="y",
            parents=("b", "c"),
            mechanism=lambda b, c, noise: b - c + noise,
            noise=Normal(),
            inverse_noise=lambda value, c, b: value - b + c,
        )
