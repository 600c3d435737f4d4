"""Benchmark problems: causal models, and worlds with their physics."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import scm_world as sw
from scm_world.discovery import evaluate
from scm_world.discovery.learners import EstimatedGraph, learn
from scm_world.discovery.problems import Problem, TaskView, model_problem, problem
from scm_world.errors import ModelError, UnknownOption, UnknownVariable, UnreadableFile
from scm_world.graph import SCM, to_json
from scm_world.tasks import ModelTask
from scm_world.tasks.families import FAMILIES, random_model
from scm_world.variables import Box, Derived, Exogenous, Function, Integers, Linear
from scm_world.variables.distributions import Normal

ENGINES = ["mujoco"] + (["bullet"] if importlib.util.find_spec("pybullet") else [])
BLOCK = ("cartesian_position", "orientation", "linear_velocity", "angular_velocity")
ENDS = tuple(f"tool_block.{measure}" for measure in BLOCK)


@pytest.fixture(scope="module")
def pushing() -> Problem:
    """Make the task in which a block is pushed, looked at by its outcomes."""
    return problem("pushing", view=TaskView(options={"backend": "mujoco"}))


def first_of(v: Any, noise: Any = 0.0) -> Any:
    """Give the first number of a vector."""
    return v[..., 0] + noise


def wrong(found: EstimatedGraph, made: Problem) -> tuple[set[Any], set[Any]]:
    """List false and missing edges."""
    edges, known = set(found.directed), set(made.truth.edges)
    return edges - known, known - edges


# --- families -------------------------------------------------------------------------------------


@pytest.mark.parametrize("family", FAMILIES)
def test_a_family_is_drawn_by_size_and_seed(family: str) -> None:
    """One name and seed is one model; another seed is another one; weights are not small."""
    one, again, other = (
        random_model(f"{family}:12"),
        random_model(f"{family}:12"),
        random_model(f"{family}:12", 1),
    )
    assert to_json(one) == to_json(again)
    assert set(one.edges) != set(other.edges)
    assert len(list(one)) == 12
    for variable in one.variables:
        mechanism: Any = getattr(variable, "mechanism", None)
        linear = isinstance(mechanism, Linear)
        weights = mechanism.weights if linear else mechanism.constants.get("weights", ())
        if family != "iscm2":  # divided by a standard deviation
            assert all(0.5 <= abs(weight) <= 2.0 for weight in weights)


def test_families_have_the_density_that_they_say() -> None:
    """Two edges per node on average; at most four causes through time."""
    assert 30 <= np.mean([len(random_model("er2:20", seed).edges) for seed in range(20)]) <= 50
    assert len(random_model("sf2:20").edges) == 2 * 18
    causes = [len(random_model("tanh4:20").parents(name)) for name in random_model("tanh4:20")]
    assert 1 <= min(causes) <= max(causes) <= 4
    assert {edge.lag for edge in random_model("tanh4:20").edges} == {1}


@pytest.mark.parametrize("name", ["er2", "er2:", "er2:1", "er2:1001", "er2:x", "er2:-5", "er9:20"])
def test_families_that_do_not_exist(name: str) -> None:
    """The message lists those there are."""
    with pytest.raises(UnknownOption, match="er2:N"):
        random_model(name)


# --- models ---------------------------------------------------------------------------------------


def test_a_model_has_rows_and_experiments() -> None:
    """The first rows are the same for any budget, a third of two targets' share is watched."""
    made = problem("er2:6", seed=2)
    small, large = made.data("interventional", 80, 5), made.data("interventional", 200, 5)
    np.testing.assert_array_equal(small.values, large.first(80).values)
    assert small.names == made.truth.names
    assert (~large.targeted.any(axis=1)).mean() == pytest.approx(2 / 8, abs=0.01)
    np.testing.assert_allclose(large.targeted.mean(axis=0), 1 / 8, atol=0.01)
    assert not made.data("observational", 50, 5).targeted.any()
    assert wrong(learn("paired", made.simulator(0), budget=16), made) == (set(), set())


def test_a_model_through_time_counts_rows() -> None:
    """Ten control steps are an episode; the budget is rows, rounded up to whole episodes."""
    data = problem("tanh4:6").data("interventional", 95, 0)
    assert len(data) == 100
    assert len(np.unique(data.episode)) == 10


def test_files_and_names_that_are_no_problem(tmp_path: Path) -> None:
    """A model from a file has the name of the file; all else is refused."""
    path = tmp_path / "mine.json"
    path.write_text(to_json(random_model("sf2:5")))
    assert problem(str(path)).truth.name == "mine"
    path.write_text("[]")
    for place in (path, tmp_path / "none.json"):
        with pytest.raises(UnreadableFile, match=place.name):
            problem(str(place))
    with pytest.raises(UnknownOption, match=r"pushing.*er2:N.*FILE\.json"):
        problem("mars")


def test_models_with_bounds_vectors_and_whole_numbers() -> None:
    """What is set lies in the bounds, and is whole where it has to be."""
    model = SCM(
        [
            Exogenous(name="r", default=0.5, bounds=Box(0.0, 1.0), distribution=Box(0.0, 1.0)),
            Exogenous(name="n", dtype="integer", default=1, bounds=Integers(0, 4)),
            Exogenous(
                name="v",
                shape=(3,),
                default=(0.0, 0.0, 0.0),
                distribution=Box((-1.0,) * 3, (1.0,) * 3),
                bounds=Box((-1.0,) * 3, (1.0,) * 3),
            ),
            Derived(
                name="y",
                parents=("v",),
                mechanism=Function(first_of),
                noise=Normal(mean=0.0, std=0.1),
            ),
        ]
    )
    made = model_problem("mixed", model)
    data = made.data("interventional", 400, 0)
    targets = {name for regime in data.regimes for name in regime.targets}
    assert targets == {"r", "n", "v", "y"}
    assert 0.0 <= data["r"].min() <= data["r"].max() <= 1.0
    assert set(np.unique(data["n"])) <= {0.0, 1.0, 2.0, 3.0, 4.0}
    found = learn("do_order", data)
    assert found.directed == (("v", "y", 0),)


# --- tasks: what is declared ----------------------------------------------------------------------


def test_ends_of_an_episode_do_not_act_on_one_another(pushing: Problem) -> None:
    """No edge leads from an outcome, and pairs of them are not scored."""
    truth = pushing.truth
    ends = {end for pair in truth.unscored for end in pair}
    assert set(ENDS) | {"fractional_success"} <= ends
    assert not {cause for cause, *_ in truth.edges} & ends
    assert len(truth.unscored) == len(ends) * (len(ends) - 1) // 2
    assert {lag for *_, lag in truth.edges} == {0}


def test_the_declared_graph_of_pushing(pushing: Problem) -> None:
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
    made = problem("pushing", view=TaskView("step", options={"backend": "mujoco"}))
    truth, data = made.truth, made.data("interventional", 60, 0)
    assert set(data.variables) == set(truth.names)
    assert len(data) == 75
    assert (ENDS[2], ENDS[0], 1) in truth.edges
    assert ("action", "joint_positions", 1) in truth.edges
    found = learn("paired", made.simulator(0), budget=250).restricted(truth.names)
    false, missing = wrong(found, made)
    assert false == set()
    assert len(missing) < 0.2 * len(truth.edges)
    made.close()


def test_views_are_checked() -> None:
    """An unknown view, pattern or outcome is told."""
    with pytest.raises(UnknownOption, match="outcome, step"):
        problem("pushing", view=TaskView("sideways"))
    with pytest.raises(UnknownVariable, match="no_such_"):
        problem("pushing", view=TaskView(causes=("no_such_*",)))
    with pytest.raises((UnknownOption, UnknownVariable)):
        problem("pushing", view=TaskView(outcomes=("no_such_thing",)))


# --- tasks: data ----------------------------------------------------------------------------------


def test_rows_of_a_task(pushing: Problem) -> None:
    """Half of the causes are set at a time; columns and graph have the same names."""
    small, large = pushing.data("interventional", 20, 3), pushing.data("interventional", 40, 3)
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
    watched = pushing.data("observational", 10, 3)
    assert not watched.targeted.any()


def test_sensors_disturb_only_what_is_measured() -> None:
    """With noise the states differ, and parameters are the same bit for bit."""
    options = {"backend": "mujoco"}
    parts = []
    for noise in (0.0, 0.005):
        made = problem("pushing", view=TaskView(sensor_noise=noise, options=options))
        parts.append(made.data("interventional", 12, 0))
        made.close()
    quiet, noisy = parts
    for place, column in enumerate(quiet.columns):
        same = np.array_equal(quiet.values[:, place], noisy.values[:, place])
        assert same == (column.role == "parameter") or column.kind == "measured", column.name
        if column.role == "state" and column.kind == "measured":
            assert not same, column.name


def test_do_order_finds_nothing_false_in_few_episodes(pushing: Problem) -> None:
    """From 200 noisy episodes most of what it finds is true, and colors cause nothing."""
    data = pushing.data("interventional", 200, 1)
    found = learn("do_order", data)
    assert set(found.names) == set(pushing.truth.names)
    assert found.directed
    false, _ = wrong(found, pushing)
    assert len(false) <= 0.2 * len(found.directed)
    assert not any(cause == "tool_block.color" for cause, *_ in found.directed)


# --- tasks: paired experiments --------------------------------------------------------------------


def test_paired_experiments_find_nothing_false() -> None:
    """A few units show nearly all edges of pushing and no other; without any noise."""
    made = problem("pushing")
    found = learn("paired", made.simulator(0), budget=250)
    assert found.names == made.truth.names
    assert 250 <= found.experiments < 350
    assert found.notes == ("floor 0",)
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
    made = problem(task, view=TaskView(options={"backend": backend}))
    found = learn("paired", made.simulator(0), budget=4_000)
    false, missing = wrong(found, made)
    assert false == set()
    rare = {cause for cause, *_ in missing if cause == "stage_friction" or "_link_" in cause}
    assert {cause for cause, *_ in missing} == rare
    assert len(missing) <= (1 if task == "pushing" else 0.03 * len(made.truth.edges))
    made.close()


# --- custom worlds --------------------------------------------------------------------------------

PENDULUM = """<mujoco model="pendulum"><option timestep="0.01"/><worldbody><body name="pole">
  <joint name="hinge" axis="0 1 0" damping="0.01"/><geom type="capsule" fromto="0 0 0 0 0 1"
  size=".05" mass="1"/></body></worldbody><actuator>
  <motor name="motor" joint="hinge" gear="5" ctrlrange="-1 1"/></actuator></mujoco>"""


def light_or_heavy() -> ModelTask:
    """Declare a pendulum whose mass and motor have training support."""
    spaces = {"pole.mass": {"a": Box(0.5, 2.0)}, "motor.gear": {"a": Box(1.0, 9.0)}}
    return ModelTask(PENDULUM, spaces=spaces)


def two_numbers() -> SCM:
    """Declare a model of one edge."""
    return random_model("er2:2")


def test_a_model_file_is_a_problem_by_step(tmp_path: Path) -> None:
    """States and the control of a foreign model are its variables; its paired graph is exact."""
    path = tmp_path / "pendulum.xml"
    path.write_text(PENDULUM)
    made = problem(str(path), view=TaskView("step"))
    assert made.truth.name == "pendulum/step"
    assert made.truth.names == ("hinge.position", "hinge.velocity", "motor.control")
    found = learn("paired", made.simulator(0), budget=400).restricted(made.truth.names)
    assert wrong(found, made) == (set(), set())
    assert made.data("observational", 50, 0).names == made.truth.names
    with pytest.raises(ModelError, match="interventional rows is targeted"):  # nothing has a space
        made.data("interventional", 50, 0)
    made.close()


def test_a_model_without_training_support_has_no_causes_by_outcome(tmp_path: Path) -> None:
    """The error says what to declare."""
    path = tmp_path / "pendulum.xml"
    path.write_text(PENDULUM)
    with pytest.raises(ModelError, match="give variables a space A"):
        problem(str(path))


def test_a_function_gives_a_world_a_model_or_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    """``module:function`` is called, and what it gives is the problem."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    made = problem("test_problems:light_or_heavy")
    causes = {cause for cause, *_ in made.truth.edges}
    assert causes == {"pole.mass", "motor.gear"}
    data = made.data("interventional", 40, 0)
    assert {"pole.mass", "hinge.position"} <= set(data.names)
    assert data.targeted.any()
    made.close()
    assert problem("test_problems:two_numbers").truth.edges == problem("er2:2").truth.edges
    assert problem("test_problems:custom").truth.name == "mine"


def custom() -> Problem:
    """Make a problem."""
    return model_problem("mine", two_numbers())


def test_a_world_of_equations_is_a_problem_like_its_model() -> None:
    """It has the same graph and the same rows, and stands for its true edges."""
    model = sw.SCM(random_model("er2:5", 0).variables)
    world: Any = sw.World(model)
    made, other = problem(world), problem(model)
    assert made.truth.edges == other.truth.edges
    one, two = (each.data("interventional", 20, 0).values for each in (made, other))
    np.testing.assert_array_equal(one, two)
    assert evaluate(made.truth.edges, world).shd == 0
