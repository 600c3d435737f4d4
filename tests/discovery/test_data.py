"""Tables with regimes, and their views for other libraries."""

from __future__ import annotations

import io

import numpy as np
import pytest

from scm_world import SCM, Box, Derived, Exogenous, Linear
from scm_world.discovery.data import (
    Dataset,
    Design,
    as_causal_learn,
    as_frame,
    as_gies,
    as_tigramite,
    collect,
    from_frame,
)
from scm_world.errors import ModelError, UnknownVariable
from scm_world.queries import World
from scm_world.variables import Categories, Parent

TWICE = Linear(weights=(2.0,))


def chain() -> SCM:
    """A vector that moves a number that moves another."""
    return SCM(
        [
            Exogenous(
                name="x", shape=(2,), default=(0.0, 0.0), distribution=Box(0.0, 1.0), a=Box(2, 3)
            ),
            Derived(name="y", parents=("x",), mechanism=_total, noise=Box(0.0, 1.0), a=Box(5, 6)),
            Derived(name="z", parents=("y",), mechanism=TWICE, noise=Box(0.0, 1.0), a=Box(-2, -1)),
        ]
    )


def _total(x: object, noise: object) -> object:
    return np.asarray(x).sum(axis=-1) + noise


def drifting() -> SCM:
    """A number that follows itself, and a category."""
    return SCM(
        [
            Derived(
                name="level",
                parents=(Parent("level", 1),),
                mechanism=Linear(weights=(0.5,)),
                noise=Box(0.0, 1.0),
                a=Box(7, 8),
            ),
            Exogenous(
                name="kind",
                dtype="categorical",
                bounds=Categories((0, 1)),
                distribution=Categories((0, 1)),
            ),
        ]
    )


@pytest.fixture(scope="module")
def table() -> Dataset:
    """Rows of the chain, with interventions on each of its variables."""
    return collect(
        chain(), Design("single", ("x", "y", "z"), observational_fraction=0.25), 40, seed=3
    )


@pytest.fixture(scope="module")
def series() -> Dataset:
    """Time series with a category in them."""
    return collect(
        drifting(), Design("single", ("level",), observational_fraction=0.5), 6, seed=3, steps=5
    )


def test_a_joined_table_is_the_whole_again(table: Dataset) -> None:
    """Cut into pieces with other numbers of regimes and put together, it is the same."""
    pieces = [table.rows(slice(20, 40)), table.rows(slice(0, 20))]
    assert Dataset.joined(pieces).rows(np.r_[20:40, 0:20]) == table
    assert Dataset.joined(pieces) != table


def test_tables_from_elsewhere_are_not_joined(table: Dataset, series: Dataset) -> None:
    """What has other columns is refused."""
    with pytest.raises(ModelError, match="cannot be joined"):
        Dataset.joined([table, series])


@pytest.mark.parametrize(
    ("episode", "step", "message"),
    [
        ([3, 5, 3], [0, 0, 1], "rows of episode 3 do not stand together.*sort"),
        ([5, 3, 3], [0, 1, 0], "rows of episode 3 do not stand together.*sort"),
        ([3, 5, 3], [0, 0, 0], "step 0 of episode 3: if two tables have the same episode numbers"),
    ],
)
def test_rows_of_an_episode_stand_together(
    episode: list[int], step: list[int], message: str
) -> None:
    """With rising steps; else the episode is named, and what to do."""
    pandas = pytest.importorskip("pandas")
    with pytest.raises(ModelError, match=message):
        Dataset.of([[0.0]] * 3, ["x"], episode=episode, step=step)
    frame = pandas.DataFrame({"episode": episode, "step": step, "x": 0.0})
    frame["intervention_targets"] = None
    with pytest.raises(ModelError, match=message):
        from_frame(frame)


def test_tables_with_the_same_episodes_are_not_joined(series: Dataset) -> None:
    """Which rows follow which would be lost."""
    with pytest.raises(ModelError, match="two tables have the same episode numbers"):
        Dataset.joined([series, series])


@pytest.mark.parametrize("size", [1e-310, 1e-15, 1.0, 1e200, 1e308])
def test_standardising_does_not_depend_on_units(size: float) -> None:
    """Columns of any size have variance 1; one is constant in relation to its own size."""
    rows = np.array([[0.25, 1.0], [-0.5, 1.0], [1.0, 1.0 + 4e-16]])
    even = Dataset.of(rows * size, ["x", "still"]).standardised()
    np.testing.assert_allclose(even.values.std(axis=0), [1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(even.values.mean(axis=0), 0.0, atol=1e-12)
    assert not even["still"].any()


def test_changed_tables_say_so(series: Dataset) -> None:
    """Standardised or lagged, it is told; the original is told nothing."""
    before = dict(series.about)
    assert series.standardised().about == {**before, "standardised": True}
    assert series.lagged(2).about == {**before, "lags": 2}
    assert series.about == before


def test_gies_gets_each_row_once_with_its_targets(table: Dataset) -> None:
    """The groups hold all rows, and all components of a vector are targets."""
    data, targets = as_gies(table)
    assert targets == [[], [0, 1], [2], [3]]
    assert sorted(np.concatenate(data).tolist()) == sorted(table.values.tolist())
    for rows, chosen in zip(data, targets, strict=True):
        mask = np.isin(np.arange(4), chosen)
        np.testing.assert_array_equal(rows, table.values[(table.targeted == mask).all(axis=1)])


def test_gies_learns_from_it(table: Dataset) -> None:
    """``gies.fit_bic`` takes it as it is, and finds the last edge."""
    gies = pytest.importorskip("gies")
    graph, _ = gies.fit_bic(*as_gies(table.select(["y", "z"])))
    assert graph.tolist() == [[0, 1], [0, 0]]


def test_a_frame_comes_back_the_same(table: Dataset, series: Dataset) -> None:
    """Through pandas and back nothing is lost, negative zeros included."""
    pytest.importorskip("pandas")
    table.values[0, 0] = -0.0
    for data in (table, series):
        back = from_frame(as_frame(data))
        assert back == data
        assert back.values.tobytes() == data.values.tobytes()


def test_a_frame_names_the_columns_that_were_set(table: Dataset) -> None:
    """None where nothing was done, else a tuple with every component."""
    pytest.importorskip("pandas")
    frame = as_frame(table)
    assert set(frame["intervention_targets"]) == {None, ("x[0]", "x[1]"), ("y",), ("z",)}
    assert list(frame["episode"]) == list(range(40))


def test_a_frame_may_lose_rows_and_columns(table: Dataset) -> None:
    """What remains keeps its regimes."""
    pytest.importorskip("pandas")
    frame = as_frame(table)
    some = frame[frame["y"] > 5.0].drop(columns=["z"])
    back = from_frame(some)
    assert back == table.select(["x", "y"]).rows(table["y"] > 5.0)


def test_frames_of_others_are_read() -> None:
    """Targets may be a text with semicolons, a tuple, or missing."""
    pandas = pytest.importorskip("pandas")
    cells = [None, "a", "a; b", ("b",), float("nan")]
    frame = pandas.DataFrame({"a": [0.0] * 5, "b": [1.0] * 5})
    frame["intervention_targets"] = pandas.Series(cells, dtype=object)
    back = from_frame(frame)
    told = [back.regimes[number].targets for number in back.regime]
    assert told == [(), ("a",), ("a", "b"), ("b",), ()]
    with pytest.raises(UnknownVariable):
        from_frame(frame.drop(columns="b"))
    with pytest.raises(ModelError, match="intervention_targets"):
        from_frame(frame[["a"]])


def test_targets_do_not_vanish_when_columns_are_renamed(table: Dataset) -> None:
    """Renamed columns are refused while the targets have the old names."""
    pytest.importorskip("pandas")
    frame = as_frame(table)
    with pytest.raises(ModelError, match=r"renamed .*\(why\).*the targets are .*y"):
        from_frame(frame.rename(columns={"y": "why"}))
    again = {("y",): ("why",)}
    frame["intervention_targets"] = [again.get(c, c) for c in frame["intervention_targets"]]
    renamed = frame.rename(columns={"y": "why"})
    with pytest.raises(ModelError, match=r"del frame\.attrs"):
        from_frame(renamed)
    del renamed.attrs["scm_world"]
    np.testing.assert_array_equal(from_frame(renamed).targeted, table.targeted)
    with pytest.raises(ModelError, match="no column 'step' any more"):
        from_frame(as_frame(table).drop(columns="step"))


def test_a_frame_survives_csv(table: Dataset) -> None:
    """Targets are read from the text of a tuple; the numbers of the rows are no variable."""
    pandas = pytest.importorskip("pandas")
    frame = as_frame(table)
    back = from_frame(
        pandas.read_csv(io.StringIO(frame.to_csv(index=False))).drop(columns="regime")
    )
    np.testing.assert_array_equal(back.targeted, table.targeted)
    with pytest.raises(ModelError, match="index=False"):
        from_frame(pandas.read_csv(io.StringIO(frame.to_csv())))
    for cell, message in ((1, r"intervention_targets has 1"), ("q", "'q'")):
        frame = pandas.DataFrame({"x": [0.0], "intervention_targets": [cell]})
        with pytest.raises((ModelError, UnknownVariable), match=message):
            from_frame(frame)
    words = pandas.DataFrame({"x": ["red"], "intervention_targets": [None]})
    with pytest.raises(ModelError, match="have to be numbers"):
        from_frame(words)


def test_a_frame_has_room_for_its_own_columns() -> None:
    """A variable that is named like one of them is refused by name."""
    pytest.importorskip("pandas")
    with pytest.raises(ModelError, match="'step'"):
        as_frame(Dataset.of([[0.0]], ["step"]))


def test_tigramite_gets_one_series_per_episode(series: Dataset) -> None:
    """Nothing is carried from one episode to the next, and categories are marked."""
    pytest.importorskip("tigramite")
    frame = as_tigramite(series)
    assert frame.analysis_mode == "multiple"
    assert list(frame.T.values()) == [5] * 6
    assert frame.var_names == ["level", "kind"]
    np.testing.assert_array_equal(frame.data_type[0][0], [0, 1])


def test_tigramite_is_not_given_what_is_no_series(table: Dataset, series: Dataset) -> None:
    """Rows that are episodes, and episodes with holes, are refused."""
    pytest.importorskip("tigramite")
    with pytest.raises(ModelError, match="every_step=True"):
        as_tigramite(table)
    with pytest.raises(ModelError, match="misses a control step"):
        as_tigramite(series.rows(series.step != 2))


def test_causal_learn_gets_the_regimes_as_index(table: Dataset) -> None:
    """Rows with the same targets have one number, from 0 on."""
    given = as_causal_learn(table)
    np.testing.assert_array_equal(given.data, table.values)
    assert given.node_names == ["x[0]", "x[1]", "y", "z"]
    for index in range(4):
        assert len(np.unique(table.targeted[given.c_indx[:, 0] == index], axis=0)) == 1
    assert given.c_indx.shape == (40, 1)


def test_states_are_told_apart_from_their_ends() -> None:
    """An intervention on where a block begins does not make its end a target."""
    world = World("pushing", backend="fake")
    name = "tool_block.cartesian_position"
    design = Design("all", (name,), values=[0.02, 0.03, 0.0325], observational_fraction=0.0)
    found = collect(world, design, 2, causes=[name], steps=2)
    assert found.columns[0].variable == f"first {name}"
    np.testing.assert_array_equal(found[f"first {name}"][0], [0.02, 0.03, 0.0325])
    assert found.targeted[0].tolist() == [True] * 3 + [False] * (len(found.columns) - 3)
