"""Trivial baselines: what each one finds, and that they stand beside every learner from data."""

import numpy as np
import pytest

from scm_world.discovery.benchmark_summary import summary
from scm_world.discovery.benchmarks import benchmark
from scm_world.discovery.data import Column, Dataset, Design, collect
from scm_world.discovery.learners import baselines, learn
from scm_world.discovery.metrics import evaluate
from scm_world.discovery.problems import problem
from scm_world.tasks.families import random_model


def physics(seed: int = 0) -> Dataset:
    """Return rows in which a mass acts on a speed, a color and a friction on nothing."""
    rng = np.random.default_rng(seed)
    kinds = {"block.mass": "exogenous", "block.color": "exogenous", "floor.friction": "exogenous"}
    kinds |= {"block.speed": "measured", "arm.angle": "measured"}
    values = rng.normal(size=(400, 5))
    values[:, 3] += 2.0 * values[:, 0]
    table = Dataset.of(values, list(kinds))
    columns = tuple(Column(name, name, kind=kind) for name, kind in kinds.items())
    return Dataset(table.values, columns, table.regimes, table.regime, table.episode, table.step)


def test_those_without_data_look_at_names_only() -> None:
    """Every cause on every outcome; colors on nothing in one of them."""
    causes, outcomes = ("block.color", "block.mass", "floor.friction"), ("arm.angle", "block.speed")
    table = physics()
    assert learn("empty", table).directed == ()
    found = {(cause, effect) for cause, effect, _ in learn("bipartite", table).directed}
    assert found == {(cause, effect) for cause in causes for effect in outcomes}
    by_role = {(cause, effect) for cause, effect, _ in learn("roles", table).directed}
    assert by_role == {pair for pair in found if pair[0] != "block.color"}


def test_those_with_data_see_one_edge() -> None:
    """A cause acts on all outcomes or none; correlation and regression find the pair."""
    table = physics()
    whole = {("block.mass", "arm.angle", 0), ("block.mass", "block.speed", 0)}
    assert set(learn("all_or_nothing", table).directed) == whole
    assert learn("correlation", table).directed == (("block.mass", "block.speed", 0),)
    assert learn("sort_regress", table).directed == (("block.mass", "block.speed", 0),)


@pytest.mark.parametrize("set_rows", [(60, 0), (60, 900), (900, 60), (200, 200)])
def test_how_many_rows_there_are_turns_no_edge(set_rows: tuple[int, int]) -> None:
    """Correlation points from the column that was set, however often, to the one that follows."""
    first, second = set_rows
    targets: list[tuple[str, ...]] = [("x",)] * first + [("y",)] * second + [()] * 400
    rng = np.random.default_rng(0)
    x = rng.normal(size=len(targets))
    y = np.where([t == ("y",) for t in targets], 0.0, x) + rng.normal(size=len(targets))
    for names, values in (("xy", [x, y]), ("yx", [y, x])):
        table = Dataset.of(np.stack(values, axis=1), names, targets=targets)
        assert learn("correlation", table).directed == (("x", "y", 0),)
        assert learn("correlation", table, shuffle=False).undirected == ()


def test_correlation_without_interventions_has_no_direction() -> None:
    """The same where both columns are set in too few rows to show anything."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=300)
    for few in (0, 9):
        targets = [("x",)] * few + [("y",)] * few + [()] * (300 - 2 * few)
        table = Dataset.of(np.stack([x, x + rng.normal(size=300)], 1), "xy", targets=targets)
        found = learn("correlation", table)
        assert (found.directed, found.undirected) == ((), (("x", "y"),))


def test_a_table_from_elsewhere_does_not_say_what_has_causes() -> None:
    """Its columns are causes where they were set, and outcomes otherwise."""
    table = Dataset.of(np.ones((2, 3)), "xyz", targets=[(), ("y",)])
    assert {c for c, *_ in learn("bipartite", table).directed} == {"y"}
    assert {column.kind for column in table.columns} == {"unknown"}


def test_variance_gives_the_order_away_unless_it_is_taken_away() -> None:
    """Sorting by variance nearly solves er2 and fails on iscm2 (Reisach et al. 2021)."""

    def f1(name: str) -> float:
        scores = []
        for seed in range(5):
            scm = random_model(name, seed)
            table = collect(scm, Design(), 1000, seed=seed)
            scores.append(evaluate(learn("sort_regress", table), [e.key for e in scm.edges]).f1)
        return float(np.mean(scores))

    assert f1("er2:10") > 0.8
    assert f1("iscm2:10") < 0.5


def test_every_cause_on_every_outcome_is_good_on_pushing() -> None:
    """The graph of an episode of pushing is nearly complete: SHD 50 without any data."""
    pushing = problem("pushing")
    table = pushing.data("interventional", 20, 0)
    found = evaluate(learn("bipartite", table), pushing.truth.edges, names=pushing.truth.names)
    pushing.close()
    assert found.shd == 50
    assert found.f1 > 0.85


@pytest.mark.parametrize("name", baselines())
def test_they_work_on_any_table(name: str) -> None:
    """One row, constants, all columns set, vectors, huge numbers, several steps of an episode."""
    rng = np.random.default_rng(1)
    few = Dataset.of([[1.0, 2.0]], ["x", "y"])
    still = Dataset.of(np.ones((30, 2)), ["x", "y"], targets=[("x",)] * 30)
    same = np.repeat(rng.normal(size=(60, 1)), 2, axis=1) * [1e150, 1e-150]
    steps = Dataset.of(rng.normal(size=(60, 2)), ["x", "y"], step=range(60), episode=[0] * 60)
    for table in (few, still, Dataset.of(same, ["x", "y"]), steps):
        found = learn(name, table)
        assert found.names == ("x", "y")
        assert np.isfinite(found.edge_scores).all()
        again = learn(name, table)
        assert np.array_equal(found.edges, again.edges)


@pytest.mark.usefixtures("in_this_process")
def test_they_use_the_data_of_the_learners_beside_them() -> None:
    """Rows of the kind that the others use; in tables they come last."""
    asked = {"problems": ["er2:4"], "budgets": [60, 80], "seeds": 1, "standardised": False}
    result = benchmark(["do_gp", *baselines()], data=["observational"], **asked)
    assert {run.data for run in result.runs} == {"observational"}
    result = benchmark(["empty", "do_order", "correlation"], **asked)
    assert {run.data for run in result.runs} == {"interventional"}
    rows = summary(result)[::2]
    assert rows.learner.tolist() == ["do_order", "correlation", "empty"]
    assert rows.baseline.tolist() == [False, True, True]
