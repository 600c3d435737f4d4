"""A small benchmark with every kind of mistake, for the tests of what is written about it."""

from itertools import product
from typing import Any

import numpy as np

from scm_world.discovery.benchmarks import BenchmarkResult, BenchmarkRun
from scm_world.discovery.learners import EstimatedGraph
from scm_world.discovery.metrics import evaluate
from scm_world.discovery.problems import GroundTruth

CHAIN = GroundTruth(
    name="chain",
    names=("a", "b", "c", "d"),
    edges=(("a", "b", 0), ("b", "c", 0), ("c", "d", 0), ("d", "d", 1), ("a", "d", 1)),
    unscored=(("b", "d"),),
    about={"kind": "synthetic"},
)
PUSHING = GroundTruth(
    name="pushing",
    names=("tool_block.mass", "tool_block.position", "goal_block.position", "reward", "floor"),
    edges=(
        ("tool_block.mass", "tool_block.position", 1),
        ("tool_block.position", "tool_block.position", 1),
        ("tool_block.position", "reward", 0),
        ("goal_block.position", "reward", 0),
        ("floor", "tool_block.position", 0),
        ("floor", "tool_block.position", 1),
    ),
    unscored=(("floor", "tool_block.position"),),
)
INERT = GroundTruth(
    name="<script>alert(1)</script>",
    names=("<script>", 'x"&', "z"),
    edges=(("<script>", 'x"&', 0),),
)
TRUTHS = (CHAIN, PUSHING, INERT)
WAYS = (
    ("ours", "interventional"),
    ("oracle", "paired"),
    ("gies", "interventional"),
    ("pc", "observational"),
    ("mine:learner", "interventional"),
)


def found_of(truth: GroundTruth, learner: str, budget: int) -> EstimatedGraph:
    """Make a graph with each kind of mistake; more of the truth for a larger budget."""
    edges = list(truth.edges)
    if learner in ("ours", "oracle"):
        return EstimatedGraph.of_edges(truth.names, edges)
    if learner == "pc":
        cause, effect, _ = next(edge for edge in edges if edge[2] == 0)
        return EstimatedGraph.of_edges(
            truth.names, [(cause, effect, 0), (effect, cause, 0), *edges[3:]]
        )
    cause, effect, lag = edges[0]
    turned = [(effect, cause, lag)] if budget < 1000 else [(cause, effect, lag)]
    extra = (truth.names[0], truth.names[-1], 0)
    return EstimatedGraph.of_edges(truth.names, [*turned, extra, *edges[2:]])


def run(truth: GroundTruth, learner: str, data: str, budget: int, seed: int) -> BenchmarkRun:
    """Make a run; the scores get better with the budget, and differ by seed."""
    about: dict[str, Any] = {
        "problem": truth.name,
        "learner": learner,
        "data": data,
        "budget": budget,
    }
    if learner == "gies" and seed == 2 and budget == 1000:
        return BenchmarkRun(
            **about, seed=seed, status="timeout", message="more than 60 s", seconds=60.0
        )
    found = found_of(truth, learner, budget)
    known = evaluate(found, truth.edges)
    numbers: dict[str, Any] = {
        "shd": known.shd + seed,
        "f1": known.f1,
        "precision": known.precision,
        "recall": known.recall,
        "sid": None if learner == "pc" else np.int64(3),
        "fdp": 1.0 - known.precision,
    }
    return BenchmarkRun(
        **about,
        seed=seed,
        found=found,
        scores=numbers,
        seconds=0.5 * budget,
        experiments=budget,
        bound=12 if data == "paired" else None,
    )


def sample_result() -> BenchmarkResult:
    """Three problems, five learners, three budgets, three seeds; one learner runs out of time."""
    runs = tuple(
        run(truth, learner, data, budget, seed)
        for truth, (learner, data), budget, seed in product(TRUTHS, WAYS, (10, 100, 1000), range(3))
    )
    return BenchmarkResult(
        {truth.name: truth for truth in TRUTHS}, runs, {"versions": {"gies": "0.0.3"}}
    )
