"""Tables with regimes, and their views for other libraries."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world import SCM, Box, Derived, Exogenous, Linear
from scm_world.discovery import learn, learners
from scm_world.discovery.data import (
    Dataset,
    Design,
    as_causal_learn,
    as_frame,
    as_gies,
    as_tigramite,
    collect,
    from_frame,
    load,
    save,
)
from scm_world.errors import ModelError, UnknownOption, UnknownVariable
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


@pytest.fixture(scope="module")
def hidden(table: Dataset) -> Dataset:
    """The rows of the chain without x, which was set in some of them."""
    return table.hide(["x"])


def test_where_a_hidden_column_was_set_something_was_done(table: Dataset, hidden: Dataset) -> None:
    """These rows are no observational ones, and have no number that was set."""
    assert hidden.observational.values.tolist() == table.observational.values[:, 2:].tolist()
    assert hidden.hidden_targets.tolist() == [targets == ("x",) for targets in table.targets]
    assert not hidden.targeted[hidden.hidden_targets].any()
    assert not table.hidden_targets.any()
    assert (~hidden.intervened).tolist() == [targets == () for targets in table.targets]


def test_gies_gets_no_rows_in_which_a_hidden_column_was_set(
    table: Dataset, hidden: Dataset
) -> None:
    """It has no word for them."""
    data, targets = as_gies(hidden)
    assert targets == [[], [0], [1]]
    assert data[0].tolist() == table.observational.values[:, 2:].tolist()
    with pytest.raises(ModelError, match="in every row"):
        as_gies(hidden.rows(hidden.hidden_targets))


def test_a_frame_names_hidden_columns_that_were_set(table: Dataset, hidden: Dataset) -> None:
    """None is for rows in which nothing was done; the frame comes back the same."""
    pytest.importorskip("pandas")
    frame = as_frame(hidden)
    cells = {(): None, ("x",): ("x",), ("y",): ("y",), ("z",): ("z",)}
    assert list(frame["intervention_targets"]) == [cells[targets] for targets in table.targets]
    assert from_frame(frame) == hidden


def test_hidden_targets_are_a_domain_of_their_own(table: Dataset, hidden: Dataset) -> None:
    """CD-NOD and DCDI number the sets of targets, with the hidden ones."""
    assert as_causal_learn(hidden).c_indx.tolist() == as_causal_learn(table).c_indx.tolist()


def test_a_file_names_hidden_columns_that_were_set(hidden: Dataset, tmp_path: Path) -> None:
    """A reader of the Parquet file alone tells observational rows from others."""
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    save(hidden, tmp_path)
    frame = pandas.read_parquet(tmp_path / "shard-00000.parquet")
    assert list(frame["intervention_targets"]) == [";".join(names) for names in hidden.targets]
    assert load(tmp_path) == hidden


def test_learners_with_known_targets_leave_hidden_ones_out() -> None:
    """Rows in which a hidden cause was set say so in the notes, and do not count."""
    model = SCM(
        [
            Exogenous(name="u", distribution=Box(0.0, 1.0), a=Box(9.0, 10.0)),
            *(
                Derived(
                    name=name, parents=("u",), mechanism=TWICE, noise=Box(0.0, 1.0), a=Box(5, 6)
                )
                for name in ("a", "b")
            ),
        ]
    )
    table = collect(model, Design("single", ("u", "a", "b")), 400, seed=0).hide(["u"])
    for name in ("gies", "do_order", "do_gp"):
        if learners.learners()[name].is_installed:
            mine = learn(name, table)
            assert any("a variable that is in no column was set" in note for note in mine.notes)
            other = learn(name, table.rows(~table.hidden_targets))
            assert (mine.edges == other.edges).all()


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


def test_a_frame_comes_back_from_a_csv_file(table: Dataset, series: Dataset) -> None:
    """With the targets of each row, also of vectors and of names with commas and quotes."""
    pandas = pytest.importorskip("pandas")
    names, targets = ["a, b", "it's", "c;d"], [(), ("a, b",), ("c;d", "it's"), ("it's",)]
    odd = Dataset.of(np.arange(12.0).reshape(4, 3) / 7.0, names, targets=targets)
    for data in (table, series, odd, odd.rows([0])):
        text = as_frame(data).to_csv(index=False)
        back = from_frame(pandas.read_csv(io.StringIO(text)))
        np.testing.assert_allclose(back.values, data.values, rtol=1e-15)
        np.testing.assert_array_equal(back.targeted, data.targeted)
        np.testing.assert_array_equal(back.episode, data.episode)
        np.testing.assert_array_equal(back.step, data.step)
    with pytest.raises(ModelError, match=r"index of a CSV file: .*index=False"):
        from_frame(pandas.read_csv(io.StringIO(as_frame(odd).to_csv())))


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


@pytest.mark.parametrize(
    ("cell", "message"), [(1, "intervention_targets has 1"), ("q", "'q'"), (("q",), "'q'")]
)
def test_targets_that_are_no_names_of_columns_are_refused(cell: object, message: str) -> None:
    """A number, and a name that the frame does not have, are named."""
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"x": [0.0], "intervention_targets": [cell]})
    with pytest.raises((ModelError, UnknownVariable), match=message):
        from_frame(frame)


@pytest.mark.parametrize(
    ("cells", "kind"),
    [
        (np.array(["2020-01-01", "2020-01-02"], "M8[D]"), "datetime64"),
        (np.array([1, 2], "m8[s]"), "timedelta"),
        (np.array([1.0 + 2.0j, 3.0]), "complex"),
        (["1", "2"], "string"),
        ([[1.0], [2.0]], "mixed"),
    ],
)
def test_a_column_without_real_numbers_is_refused(cells: Any, kind: str) -> None:
    """The column and its kind are named, in a frame and in a table of columns."""
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"x": [0.0, 1.0], "intervention_targets": None})
    frame["y"] = pandas.Series(list(cells) if isinstance(cells, list) else cells)
    message = f"the column 'y': it holds .*{kind}.*: give"
    for call in (lambda: from_frame(frame), lambda: Dataset.of(frame, ["x", "y"])):
        with pytest.raises(ModelError, match=message):
            call()
    if isinstance(cells, np.ndarray):
        with pytest.raises(ModelError, match=message):
            Dataset.of(cells[:, None], ["y"])


def test_numbers_of_pandas_and_python_are_read() -> None:
    """Nullable whole numbers, yes and no, and numbers as objects; a missing one is named."""
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"x": pandas.array([1, 2], dtype="Int64"), "y": [True, False]})
    frame["z"] = np.array([1, 2.5], dtype=object)
    assert Dataset.of(frame, ["z", "y", "x"]).values.tolist() == [[1, 1, 1], [2.5, 0, 2]]
    frame["x"] = pandas.array([1, None], dtype="Int64")
    with pytest.raises(ModelError, match="row 1 of 'x' is not finite"):
        Dataset.of(frame, ["x"])


def test_columns_of_a_frame_are_taken_by_name() -> None:
    """The order of the names does not relabel them; a name that is not there is refused."""
    pandas = pytest.importorskip("pandas")
    for frame in (pandas.DataFrame({"x": [1.0], "y": [10.0]}), {"x": [1.0], "y": [10.0]}):
        assert Dataset.of(frame, ["y", "x"]).values.tolist() == [[10.0, 1.0]]
        with pytest.raises(UnknownVariable, match="'z'"):
            Dataset.of(frame, ["x", "z"])


@pytest.mark.parametrize("attrs", ["[]", "{", '{"columns": 1}', 3])
def test_attributes_of_something_else_are_refused(attrs: Any) -> None:
    """A frame whose ``attrs`` another program wrote says what to do."""
    frame = as_frame(Dataset.of([[1.0]], ["x"]))
    frame.attrs["scm_world"] = attrs
    with pytest.raises(ModelError, match=r"was not written by as_frame.*`del frame\.attrs"):
        from_frame(frame)


def test_names_of_columns_are_text() -> None:
    """Whole numbers as names are refused, with what to do; so are numbers as targets."""
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(np.ones((2, 2))).assign(intervention_targets=[None, (0,)])
    with pytest.raises(ModelError, match=r"a column is named 0; .*rename\(columns=str\)"):
        from_frame(frame)
    with pytest.raises(ModelError, match="a column is named 0"):
        Dataset.of([[1.0]], [0])  # type: ignore[list-item] # it is refused
    with pytest.raises(UnknownOption, match="targets"):
        Dataset.of([[1.0]], ["x"], targets=[0])  # type: ignore[list-item] # it is refused
    assert Dataset.of([[1.0], [2.0]], ["ab"], targets=["ab", None]).targets == (("ab",), ())


@pytest.mark.parametrize("episode", [[0.5, 1.0], [float("nan"), 1.0], ["a", "b"]])
def test_episodes_have_whole_numbers(episode: list[Any]) -> None:
    """Others are refused, not cut off."""
    with pytest.raises(
        ModelError, match=r"'episode' holds numbers of dtype .*: give whole numbers"
    ):
        Dataset.of([[1.0], [2.0]], ["x"], episode=episode)


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
