"""Facts about the sets that values come from."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scm_world.errors import ModelError
from scm_world.variables import (
    Affine,
    Box,
    Categories,
    Either,
    Exogenous,
    Integers,
    Noise,
    Normal,
    Rotations,
    Space,
)
from scm_world.variables.spaces import TOLERANCE

SIZE = {"size": np.array([0.06, 0.07, 0.08])}
ON_THE_FLOOR = Box((0.0, Affine(parent="size", index=2, scale=0.5)), (0.1, 0.3))

CASES: list[tuple[Space, tuple[int, ...]]] = [
    (Box(-1.0, 2.0), ()),
    (Box((0.0, -1.0, 5.0), (1.0, -1.0, 6.0)), (3,)),
    (ON_THE_FLOOR, (2,)),
    (Integers(-2, 3), ()),
    (Integers(0, 1), (4,)),
    (Categories((1, 20, 23)), (2,)),
    (Either(Box(0.0, 1.0), Box(2.0, 4.0)), ()),
    (Either(Box(0.0, 0.1), ON_THE_FLOOR), (2,)),
    (Either(Integers(0, 3), Integers(8, 9)), ()),
    (Rotations(), (4,)),
]


def draws(space: Space, shape: tuple[int, ...], count: int = 500) -> np.ndarray:
    """Draw many values."""
    return Noise(3).draw(space, "x", shape, SIZE, count=count)


@pytest.mark.parametrize(("space", "shape"), CASES, ids=repr)
def test_draws_lie_inside(space: Space, shape: tuple[int, ...]) -> None:
    """Every draw is a member, of the declared shape."""
    values = draws(space, shape)
    assert values.shape == (500, *shape)
    assert all(space.contains(value, SIZE) for value in values)


@pytest.mark.parametrize(("space", "shape"), CASES, ids=repr)
def test_the_nearest_value_is_a_member_and_members_are_their_own(
    space: Space, shape: tuple[int, ...]
) -> None:
    """The nearest value lies inside, and does not move when asked again."""
    generator = np.random.default_rng(0)
    for _ in range(50):
        near = space.nearest(generator.normal(scale=5.0, size=shape), SIZE)
        assert np.shape(near) == shape
        assert space.contains(near, SIZE)
        np.testing.assert_array_equal(space.nearest(near, SIZE), near)


@pytest.mark.parametrize(("space", "shape"), CASES, ids=repr)
def test_spaces_describe_themselves(space: Space, shape: tuple[int, ...]) -> None:
    """A description never fails and is never empty."""
    assert space.describe()


def test_borders_belong_to_a_box() -> None:
    """Both ends are inside, up to the last digit and no further."""
    box = Box(0.1, 0.3)
    assert box.contains(np.array(0.1))
    assert box.contains(np.array(0.1 + 0.2))  # 0.30000000000000004
    assert box.contains(np.array(0.3 * (1.0 + 0.9 * TOLERANCE)))
    assert not box.contains(np.array(0.3 * (1.0 + 2.0 * TOLERANCE)))
    assert not box.contains(np.array(np.nan))


def test_nothing_beyond_zero_belongs_to_a_box_that_ends_there() -> None:
    """However small it is; nor is a tiny interval left by an absolute tolerance."""
    for box in (Box(0.0, np.inf), Box((0.0, 0.0), 1.0)):
        shape = np.shape(box.low)
        assert box.contains(np.zeros(shape))
        assert not box.contains(np.full(shape, -1e-300))
    assert not Box(1e-9, np.inf).contains(np.array(1e-10))
    assert not Box(-1e-6, 1e-6).contains(np.array(1.0005e-6))


def test_uniform_draws_fill_a_box_evenly() -> None:
    """Mean and spread are those of the uniform distribution."""
    values = draws(Box(2.0, 4.0), (), count=20_000)
    assert values.mean() == pytest.approx(3.0, abs=0.02)
    assert values.std() == pytest.approx(2.0 / np.sqrt(12.0), abs=0.01)


def test_integers_are_integers() -> None:
    """Draws and nearest values are whole and equally likely; halves are no members."""
    values = draws(Integers(1, 4), (), count=8_000)
    assert values.dtype == np.int64
    assert set(values.tolist()) == {1, 2, 3, 4}
    assert np.bincount(values)[1:].min() > 1_800
    assert not Integers(1, 4).contains(np.array(1.5))
    assert Integers(1, 4).nearest(np.array(2.6)).dtype == np.int64


def test_categories_have_no_values_in_between() -> None:
    """Two is not a member of one and three."""
    assert not Categories((1, 3)).contains(np.array(2))
    assert set(draws(Categories((1, 3)), ()).tolist()) == {1, 3}


def test_a_union_is_not_a_hull() -> None:
    """The gap between two sets is outside, and nothing is drawn from it."""
    gap = Either(Box(0.0, 1.0), Box(2.0, 4.0))
    values = draws(gap, (), count=6_000)
    assert not ((values > 1.0) & (values < 2.0)).any()
    assert (values <= 1.0).mean() == pytest.approx(1 / 3, abs=0.03)  # in proportion to length
    assert gap.nearest(np.array(1.4)) == 1.0


def test_bounds_follow_their_parents_when_asked() -> None:
    """The same space holds another interval when its parent has another value."""
    assert ON_THE_FLOOR.parents() == {"size"}
    low = np.array([0.05, 0.05])
    assert ON_THE_FLOOR.contains(low, SIZE)
    assert not ON_THE_FLOOR.contains(low, {"size": np.array([0.06, 0.06, 0.12])})


def test_bounds_follow_each_row_of_a_batch() -> None:
    """A union whose bounds follow a parent is drawn row by row, whatever the other rows are."""
    union = Either(Box(0.0, Affine(parent="w")), Box(5.0, 6.0))
    widths = np.linspace(0.1, 4.0, 40)
    together = Noise(1).draw(union, "x", (), {"w": widths}, count=40)
    alone = [
        Noise(1).draw(union, "x", (), {"w": width}, episode=i)[0] for i, width in enumerate(widths)
    ]
    np.testing.assert_array_equal(together, alone)


def test_where_a_and_b_touch_the_point_belongs_to_a() -> None:
    """A common border is in A, not in B, and in the union."""
    mass = Exogenous(name="mass", a=Box(0.015, 0.045), b=Box(0.045, 0.1))
    border = np.array(0.045)
    assert mass.in_space(border, "A", {})
    assert not mass.in_space(border, "B", {})
    assert mass.in_space(border, "A|B", {})
    assert mass.in_space(np.array(0.0450001), "B", {})


def test_equal_spaces_hold_nothing_out() -> None:
    """Where A and B are the same space, B accepts what it draws."""
    turn = Exogenous(name="turn", a=Box(-1.0, 1.0), b=Box(-1.0, 1.0))
    assert turn.in_space(np.array(0.3), "B", {})


def test_whole_numbers_of_a_are_never_drawn_from_b() -> None:
    """A number that both sets have belongs to A alone."""
    count = Exogenous(name="n", dtype="integer", a=Integers(1, 4), b=Integers(4, 6))
    kind = Exogenous(
        name="k",
        dtype="categorical",
        bounds=Categories((1, 2, 3)),
        a=Categories((1, 2)),
        b=Categories((2, 3)),
        default=1,
    )
    assert count.space("B") == Integers(5, 6)
    assert kind.space("B") == Categories((3,))
    assert not count.in_space(np.array(4), "B", {})


@pytest.mark.parametrize("value", ["x", [None, "y"], {}, np.zeros((3, 5, 7))])
@pytest.mark.parametrize("space", [Box((0.0, 0.0), 1.0), ON_THE_FLOOR, Rotations()])
def test_what_is_not_a_point_of_a_space_is_refused(space: Space, value: object) -> None:
    """Text, objects and other shapes end in an error that names the space."""
    with pytest.raises(ModelError, match="nearest takes numbers of its shape"):
        space.nearest(value, SIZE)  # type: ignore[arg-type] # it is refused
    if not (isinstance(value, np.ndarray) and space == Rotations()):  # (…, 7) is no quaternion
        with pytest.raises(ModelError, match="contains takes numbers") as caught:
            space.contains(value, SIZE)  # type: ignore[arg-type]
        assert space.describe() in str(caught.value)
    with pytest.raises(ModelError, match="and the value of size"):
        ON_THE_FLOOR.contains([0.1, 0.2])  # it follows a value that is not given


@given(st.floats(-1.0, 1.0))
def test_the_nearest_value_of_b_is_in_b(value: float) -> None:
    """What an error offers as the nearest value of B is not on the border to A."""
    mass = Exogenous(name="mass", a=Box(0.015, 0.045), b=Box(0.045, 0.1))
    near = mass.nearest_in_space(np.array(value), "B", {})
    assert near is not None
    assert mass.in_space(near, "B", {})


def test_a_variable_of_whole_numbers_has_whole_spaces() -> None:
    """An integer cannot be drawn from an interval of reals."""
    with pytest.raises(ValueError, match="Integers or Categories"):
        Exogenous(name="n", dtype="integer", a=Box(0.0, 3.0))


def test_rotations_are_uniform_and_written_with_positive_w() -> None:
    """The rotated x axis of random rotations points nowhere in particular."""
    x, y, z, w = draws(Rotations(), (4,), count=20_000).T
    assert (w >= 0.0).all()
    axis = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    assert np.abs(axis.mean(axis=1)).max() < 0.02
    np.testing.assert_allclose(axis @ axis.T / axis.shape[1], np.eye(3) / 3, atol=0.01)


def test_normal_draws_have_the_moments_of_the_normal_distribution() -> None:
    """Mean, spread, skewness and kurtosis agree, and components are independent."""
    values = Noise(5).draw(Normal(2.0, 3.0), "x", (2,), {}, count=50_000)
    standard = (values - 2.0) / 3.0
    for power, moment in ((1, 0.0), (2, 1.0), (3, 0.0), (4, 3.0)):
        np.testing.assert_allclose((standard**power).mean(axis=0), moment, atol=0.1)
    assert abs(np.corrcoef(standard.T)[0, 1]) < 0.02
    assert Normal(0.5, 0.0).transform(np.full((3, 2), 0.3), (), {}).tolist() == [0.5] * 3
