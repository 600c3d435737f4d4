"""What learners are examined on: models, and tasks with their physics."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world.discovery.exam.families import FAMILIES, is_family, model
from scm_world.discovery.exam.subjects import Subject, TaskView, subject
from scm_world.discovery.learners import Found, learn
from scm_world.errors import UnknownOption, UnknownVariable, UnreadableFile
from scm_world.graph import to_json
from scm_world.variables import Linear

ENGINES = ["mujoco"] + (["bullet"] if importlib.util.find_spec("pybullet") else [])
BLOCK = ("cartesian_position", "orientation", "linear_velocity", "angular_velocity")
ENDS = tuple(f"tool_block.{measure}" for measure in BLOCK)


@pytest.fixture(scope="module")
def pushing() -> Subject:
    """Make the task in which a block is pushed, looked at by its outcomes."""
    return subject("pushing", view=TaskView(options={"backend": "mujoco"}))


def wrong(found: Found, made: Subject) -> tuple[set[Any], set[Any]]:
    """List false and missing edges."""
    edges, known = set(found.directed), set(made.truth.edges)
    return edges - known, known - edges


# --- families -------------------------------------------------------------------------------------


@pytest.mark.parametrize("family", FAMILIES)
def test_a_family_is_drawn_by_size_and_seed(family: str) -> None:
    """One name and seed is one model; another seed is another one; weights are not small."""
    one, again, other = model(f"{family}:12"), model(f"{family}:12"), model(f"{family}:12", 1)
    assert to_json(one) == to_json(again)
    assert set(one.edges) != set(other.edges)
    assert len(list(one)) == 12
    for variable in one.variables:
        mechanism: Any = getattr(variable, "mechanism", None)
        linear = isinstance(mechanism, Linear)
        weights = mechanism.weights if linear else mechanism.constants["weights"]
        assert all(0.5 <= abs(weight) <= 2.0 for weight in weights)


def test_families_have_the_density_that_they_say() -> None:
    """Two edges per node on average; at most four causes through time."""
    assert 30 <= np.mean([len(model("er2:20", seed).edges) for seed in range(20)]) <= 50
    assert len(model("sf2:20").edges) == 2 * 18
    causes = [len(model("tanh4:20").parents(name)) for name in model("tanh4:20")]
    assert 1 <= min(causes) <= max(causes) <= 4
    assert {edge.lag for edge in model("tanh4:20").edges} == {1}


@pytest.mark.parametrize("name", ["er2", "er2:", "er2:1", "er2:1001", "er2:x", "er2:-5", "er9:20"])
def test_families_that_do_not_exist(name: str) -> None:
    """The message lists those there are."""
    with pytest.raises(UnknownOption, match="er2:N"):
        model(name)
    assert is_family(name) == name.startswith("er2")


# --- models ---------------------------------------------------------------------------------------


def test_a_model_has_rows_and_experiments() -> None:
    """The first rows are the same for any budget, a third of two targets' share is watched."""
    made = subject("er2:6", seed=2)
    small, large = made.data("do", 80, 5), made.data("do", 200, 5)
    np.testing.assert_array_equal(small.values, large.first(80).values)
    assert small.names == made.truth.names
    assert (~large.targeted.any(axis=1)).mean() == pytest.approx(2 / 8, abs=0.01)
    np.testing.assert_allclose(large.targeted.mean(axis=0), 1 / 8, atol=0.01)
    assert not made.data("see", 50, 5).targeted.any()
    assert wrong(learn("paired", made.apparatus(0), budget=16), made) == (set(), set())


def test_a_test_is_what_no_learner_sees() -> None:
    """Every row of it has one variable at 2, and other noise."""
    made = subject("er2:6")
    test = made.test(0)
    assert test is not None
    assert (test.targeted.sum(axis=1) == 1).all()
    assert (test.values[test.targeted] == 2.0).all()
    assert not np.isin(test.values[~test.targeted], made.data("do", 500, 0).values).any()
    assert subject("tanh4:6").test(0) is None


def test_a_model_through_time_counts_rows() -> None:
    """Ten control steps are an episode; the budget is rows, rounded up to whole episodes."""
    data = subject("tanh4:6").data("do", 95, 0)
    assert len(data) == 100
    assert len(np.unique(data.episode)) == 10


def test_files_and_names_that_are_no_subject(tmp_path: Path) -> None:
    """A model from a file has the name of the file; all else is refused."""
    path = tmp_path / "mine.json"
    path.write_text(to_json(model("sf2:5")))
    assert subject(str(path)).truth.name == "mine"
    path.write_text("[]")
    for place in (path, tmp_path / "none.json"):
        with pytest.raises(UnreadableFile, match=place.name):
            subject(str(place))
    with pytest.raises(UnknownOption, match=r"pushing.*er2:N.*FILE\.json"):
        subject("mars")


# --- tasks: what is declared ----------------------------------------------------------------------


def test_ends_of_an_episode_do_not_act_on_one_another(pushing: Subject) -> None:
    """No edge leads from an outcome, and pairs of them are not scored."""
    truth = pushing.truth
    ends = {end for pair in truth.left_out for end in pair}
    assert set(ENDS) | {"fractional_success"} <= ends
    assert not {cause for cause, *_ in truth.edges} & ends
    assert len(truth.left_out) == len(ends) * (len(ends) - 1) // 2
    assert {lag for *_, lag in truth.edges} == {0}


def test_the_declared_graph_of_pushing(pushing: Subject) -> None:
    """Mass, friction and the beginning move the block; its color moves nothing."""
    edges = set(pushing.truth.edges)
    start = "first tool_block.cartesian_position"
    for cause in ("tool_block.mass", "floor_friction", "gravity", "tool_block.size", start):
        assert {(cause, end, 0) for end in ENDS} <= edges
    assert "tool_block.color" in pushing.truth.names
    assert not any("tool_block.color" in (cause, effect) for cause, effect, _ in edges)
    assert ("goal_block.polar", "fractional_success", 0) in edges
    assert ("goal_block.polar", ENDS[0], 0) not in edges
    assert ("block.size", "tool_block.size", 0) in edges


def test_control_steps_have_the_edges_of_the_model() -> None:
    """By step, the graph is that of the model among what is written down."""
    made = subject("pushing", view=TaskView("step", options={"backend": "mujoco"}))
    truth, data = made.truth, made.data("do", 60, 0)
    assert set(data.variables) == set(truth.names)
    assert len(data) == 75
    assert (ENDS[2], ENDS[0], 1) in truth.edges
    assert ("action", "joint_positions", 1) in truth.edges
    found = learn("paired", made.apparatus(0), budget=250).restricted(truth.names)
    false, missing = wrong(found, made)
    assert false == set()
    assert len(missing) < 0.2 * len(truth.edges)
    made.close()


def test_views_are_checked() -> None:
    """An unknown view, pattern or outcome is told."""
    with pytest.raises(UnknownOption, match="outcome, step"):
        subject("pushing", view=TaskView("sideways"))
    with pytest.raises(UnknownVariable, match="no_such_"):
        subject("pushing", view=TaskView(causes=("no_such_*",)))
    with pytest.raises((UnknownOption, UnknownVariable)):
        subject("pushing", view=TaskView(outcomes=("no_such_thing",)))


# --- tasks: data ----------------------------------------------------------------------------------


def test_rows_of_a_task(pushing: Subject) -> None:
    """Half of the causes are set at a time; columns and graph have the same names."""
    small, large = pushing.data("do", 20, 3), pushing.data("do", 40, 3)
    np.testing.assert_array_equal(small.values, large.first(20).values)
    assert set(large.variables) == set(pushing.truth.names)
    assert not large.about.get("refused")
    first = np.array([where[0] for where in large.blocks.values()])
    targeted = large.targeted[:, first]
    causes = targeted.any(axis=0)
    assert not {n for n, is_one in zip(large.blocks, causes, strict=True) if is_one} & set(ENDS)
    done = targeted.any(axis=1)
    np.testing.assert_allclose(targeted[done].sum(axis=1) / causes.sum(), 0.5, atol=0.06)
    assert 0.6 < done.mean() < 0.8
    watched = pushing.data("see", 10, 3)
    assert not watched.targeted.any()


def test_sensors_disturb_only_what_is_measured() -> None:
    """With noise the states differ, and parameters are the same bit for bit."""
    options = {"backend": "mujoco"}
    parts = []
    for noise in (0.0, 0.005):
        made = subject("pushing", view=TaskView(sensor_noise=noise, options=options))
        parts.append(made.data("do", 12, 0))
        made.close()
    quiet, noisy = parts
    for place, column in enumerate(quiet.columns):
        same = np.array_equal(quiet.values[:, place], noisy.values[:, place])
        assert same == (column.role == "parameter") or column.kind == "measured", column.name
        if column.role == "state" and column.kind == "measured":
            assert not same, column.name


def test_the_learner_for_curves_finds_nothing_false_in_few_episodes(pushing: Subject) -> None:
    """From 200 noisy episodes most of what it finds is true, and colors cause nothing."""
    data = pushing.data("do", 200, 1)
    found = learn("do_order_ranks", data)
    assert set(found.names) == set(pushing.truth.names)
    assert found.directed
    false, _ = wrong(found, pushing)
    assert len(false) <= 0.2 * len(found.directed)
    assert not any(cause == "tool_block.color" for cause, *_ in found.directed)


# --- tasks: paired experiments --------------------------------------------------------------------


@pytest.mark.parametrize("backend", ENGINES)
def test_paired_experiments_find_nothing_false(backend: str) -> None:
    """A few units show nearly all edges of pushing and no other; without any noise."""
    made = subject("pushing", view=TaskView(options={"backend": backend}))
    found = learn("paired", made.apparatus(0), budget=250)
    assert found.names == made.truth.names
    assert 250 <= found.experiments < 350
    assert found.notes[0].startswith("floor 0,")
    false, missing = wrong(found, made)
    assert false == set()
    assert len(missing) < 0.1 * len(made.truth.edges)
    assert not any(cause == "tool_block.color" for cause, *_ in found.directed)
    made.close()


@pytest.mark.slow
@pytest.mark.parametrize("backend", ENGINES)
@pytest.mark.parametrize("task", ["pushing", "stacking2"])
def test_paired_experiments_find_the_whole_graph(task: str, backend: str) -> None:
    """After 4,000 experiments hardly an edge is missing, and none is false.

    The friction of the wall acts on success only where a block that touched it ends in its goal;
    the mass of a link acts on final velocities only where a block still moves.
    """
    made = subject(task, view=TaskView(options={"backend": backend}))
    found = learn("paired", made.apparatus(0), budget=4_000)
    false, missing = wrong(found, made)
    assert false == set()
    rare = {cause for cause, *_ in missing if cause == "stage_friction" or "_link_" in cause}
    assert {cause for cause, *_ in missing} == rare
    assert len(missing) <= (1 if task == "pushing" else 0.03 * len(made.truth.edges))
    made.close()
