"""Problem families of physics: what the engine does is the graph, and baselines do not find it."""

from itertools import product

import numpy as np
import pytest

import scm_world as sw
from scm_world.discovery.benchmarks import benchmark
from scm_world.discovery.learners import baselines, learn
from scm_world.discovery.metrics import evaluate
from scm_world.discovery.problems import problem, servo_problem
from scm_world.errors import UnknownOption
from scm_world.tasks.families import Springs, servo

RULE = 0.6
"""Mean F1 above which a baseline solves a family, so that it is not published."""


@pytest.mark.parametrize("name", ["servo:6", "servo:6:2"])
def test_paired_interventions_find_the_edges_of_servos_and_no_others(name: str) -> None:
    """All arms but one are held; the free one answers to its causes only, to the last bit."""
    made = problem(name, seed=1)
    found = learn("paired", made.simulator(0), budget=40)
    assert set(found.directed) == set(made.truth.edges)
    assert found.notes == ("floor 0",)
    made.close()


def test_the_graph_of_servos_is_the_one_that_was_drawn() -> None:
    """A chain through all, and further edges from 8 arms on; another one for each seed."""
    small, large = servo(6, 0), servo(20, 0)
    assert len(small.edges) == 5
    assert 19 < len(large.edges) < 30
    assert {servo(6, seed).edges for seed in range(4)} != {small.edges}
    assert servo(6, 0).edges == small.edges


def test_a_hidden_force_confounds_two_arms() -> None:
    """It is in the physics and not in the table; the truth is the latent projection."""
    made = problem("servo:8:1")
    ((*_, lag),) = made.truth.confounded
    assert lag == 0
    table = made.data("observational", 400, 0)
    assert table.names == made.truth.names
    truth = table.truth
    assert truth is not None
    assert truth.edges == made.truth.edges
    assert truth.confounded == made.truth.confounded
    held = made.data("interventional", 40, 0)
    assert {name for targets in held.targets for name in targets} <= set(held.names)
    made.close()


def test_rows_repeat_and_the_first_ones_do_not_depend_on_their_number() -> None:
    """Bit for bit; an arm that is held follows nobody."""
    made = problem("servo:5", seed=3)
    short, long = made.data("interventional", 14, 1), made.data("interventional", 28, 1)
    assert np.array_equal(short.values, long.values[:14])
    again = problem("servo:5", seed=3)
    assert np.array_equal(again.data("interventional", 14, 1).values, short.values)
    made.close()
    again.close()


def test_servos_are_a_world_of_their_own() -> None:
    """A user asks for the network: the mechanisms are an intervention like any other."""
    made = servo(5, 0)
    world = sw.World(made.task)
    twin = world.rollout(None, seed=0, steps=made.steps, do=made.plan)
    cause, effect = made.edges[0]
    other = twin.counterfactual({cause.replace("arm", "servo").replace("position", "control"): 0.9})
    assert other[effect][-1] != twin[effect][-1]


def test_servos_do_the_same_on_bullet() -> None:
    """The portable subset of MJCF is enough; the angles agree to a hundredth."""
    ends = []
    for backend in ("mujoco", "bullet"):
        made = servo_problem("servo:5", servo(5, 0), {"backend": backend})
        ends.append(made.data("observational", 5, 0).values)
        made.close()
    assert np.abs(ends[0] - ends[1]).max() < 0.01


def test_verification_finds_the_graph_of_springs() -> None:
    """Every declared edge is seen, and no other one, to the last bit."""
    report = sw.verify(sw.World(Springs(6)), probes=24)
    assert report.outcome == "confirmed"
    assert report.never_fired == ()
    world = sw.World(Springs(6))
    assert len(world.model.edges) < 0.6 * len(sw.World(Springs(6).system).model.edges)


@pytest.mark.parametrize(("name", "rows"), [("servo:8", 200), ("springs:8", 320)])
def test_no_baseline_solves_a_family(name: str, rows: int) -> None:
    """The rule that was fixed before; a learner does far better."""
    scores = {learner: [] for learner in (*baselines(), "do_order")}
    for seed in range(2):
        made = problem(name, seed=seed)
        table = made.data("interventional", rows, seed)
        for learner, found in scores.items():
            truth = made.truth
            found.append(evaluate(learn(learner, table), truth.edges, names=truth.names).f1)
        made.close()
    means = {learner: np.mean(found) for learner, found in scores.items()}
    assert max(means[learner] for learner in baselines()) < RULE
    assert means["do_order"] > 0.7


@pytest.mark.usefixtures("in_this_process")
def test_they_are_problems_of_benchmarks() -> None:
    """On raw and standardised rows, and with the simulator."""
    result = benchmark(["do_order", "paired"], ["servo:5"], budgets=[60, 70], seeds=2)
    assert [run.status for run in result.runs] == ["done"] * len(result.runs)
    assert {run.data for run in result.runs} == {"interventional", "paired"}
    paired = [run.scores["shd"] for run in result.runs if run.learner == "paired"]
    assert set(paired) == {0}


@pytest.mark.parametrize(
    "name", ["servo:4", "servo:51", "springs:8:1", "servo:8:5", "servo:x", "servo"]
)
def test_sizes_that_there_are_not_are_refused(name: str) -> None:
    """With the sizes that there are."""
    with pytest.raises(UnknownOption, match=r"(servo|springs):N with N from"):
        problem(name)


def test_columns_do_not_give_the_order_away() -> None:
    """Arms are numbered at random, so that an edge leads to the right as often as to the left."""
    ways = [
        cause < effect
        for n, seed in product((10, 20), range(5))
        for cause, effect in servo(n, seed).edges
    ]
    assert 0.4 < np.mean(ways) < 0.6
