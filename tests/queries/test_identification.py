"""Observational estimates, compared with simulated interventions."""

from __future__ import annotations

from typing import Any

import networkx as nx
import numpy as np
import pytest

from scm_world.errors import ModelError, UnknownOption
from scm_world.graph import episode_outcome
from scm_world.queries import Outcome, World, check_backdoor, identify, nature_graph
from scm_world.queries.identification import adjusted_effect, frontdoor_effect
from scm_world.variables import Mechanism

PLACE = "tool_block.cartesian_position"
SLID = Outcome(PLACE, "change", 0)
TREATMENT = "floor_friction"


def tie(color: Any, mass: Any) -> Any:
    """Let friction follow a color, and the mass that also decides how fast the block is."""
    return 0.2 + 0.3 * color[0] + 4.0 * (mass - 0.03)


NATURE = {
    "tool_block.mass": "A",
    "floor_color": "A",
    TREATMENT: Mechanism(tie, ["floor_color", "tool_block.mass"]),
    "tool_block.linear_velocity": Mechanism(lambda m: [0.2 + 8.0 * m, 0.0, 0.0], "tool_block.mass"),
}


def test_the_graph_of_an_episode_has_what_nature_does() -> None:
    """Parameters, the states that vary at the beginning, and the outcome."""
    world = World("pushing", backend="fake")
    graph = nature_graph(world.model, NATURE, [PLACE])
    assert nx.is_directed_acyclic_graph(graph)
    assert set(graph.predecessors(TREATMENT)) == {"floor_color", "tool_block.mass"}
    assert set(graph.predecessors("tool_block.linear_velocity@0")) == {"tool_block.mass"}
    assert graph.has_edge("tool_block.linear_velocity@0", PLACE)
    assert not graph.has_edge("floor_color", PLACE)
    assert not graph.has_edge("block.size", PLACE)
    assert graph.has_edge("tool_block.size", PLACE)
    plain = episode_outcome(world.model, [PLACE, "reward"])
    assert not plain.has_edge("floor_color", TREATMENT)
    assert set(nx.ancestors(plain, PLACE)) < set(nx.ancestors(plain, "reward"))


def test_an_adjusted_effect_agrees_with_the_experiment_if_the_mass_is_observed() -> None:
    """Adjusted it agrees; unadjusted it is wrong by far; without the mass it is refused."""
    world = World("pushing")
    options: dict[str, Any] = {"values": (0.2, 0.3), "nature": NATURE, "steps": 12, "policy": None}
    check = check_backdoor(world, TREATMENT, SLID, n=120, units=40, **options)
    assert check.identification.backdoor == ("tool_block.mass",)
    assert check.agrees
    assert check.is_confounded
    assert check.adjusted.mean == pytest.approx(float(check.simulated.mean), rel=0.2)
    assert "adjusted for tool_block.mass" in str(check)
    with pytest.raises(ModelError, match="is not identified"):
        check_backdoor(world, TREATMENT, SLID, observed=[TREATMENT, PLACE], **options)


def test_what_is_no_question_is_refused() -> None:
    """Nodes have to be there, outcomes have to be one number."""
    world = World("pushing", backend="fake")
    with pytest.raises(UnknownOption, match="node"):
        identify(nx.DiGraph([("a", "b")]), "a", "c")
    options: dict[str, Any] = {"values": (0.2, 0.3), "nature": NATURE, "steps": 2, "n": 4}
    with pytest.raises(UnknownOption, match="one number"):
        check_backdoor(world, TREATMENT, PLACE, units=2, **options)
    with pytest.raises(UnknownOption, match="name of a variable"):
        check_backdoor(world, TREATMENT, len, **options)


def test_front_doors_are_found() -> None:
    """A mediator that is confounded with neither side; two where the effect takes two ways."""
    graph = nx.DiGraph([("u", "x"), ("u", "y"), ("x", "m"), ("m", "y")])
    found = identify(graph, "x", "y", observed=["x", "m", "y"], frontdoor=True)
    assert found.backdoor is None
    assert found.frontdoor == (("m",),)
    graph.add_edges_from([("x", "k"), ("k", "y")])
    assert identify(graph, "x", "y", observed=["x", "m", "y"], frontdoor=True).frontdoor == ()
    both = identify(graph, "x", "y", observed=["x", "m", "k", "y"], frontdoor=True)
    assert both.frontdoor == (("k", "m"),)
    graph.add_edge("u", "m")
    found = identify(graph, "x", "y", observed=["x", "m", "k", "y"], frontdoor=True)
    assert found.frontdoor == ()


def test_curved_confounding_is_adjusted_for() -> None:
    """Where treatment and outcome follow a sine, intervals of the estimate contain the truth."""
    rng, hits = np.random.default_rng(0), 0
    for _ in range(40):
        z = rng.uniform(-2.0, 2.0, 150)
        x = np.sin(3.0 * z) + 0.7 * rng.normal(size=150)
        y = 2.0 * x + 3.0 * np.sin(3.0 * z) + (0.5 + np.abs(x)) * rng.normal(size=150)
        found = adjusted_effect(x, z, y, (0.0, 1.0))
        hits += found.low <= 2.0 <= found.high
    assert hits >= 34  # 0.95 of 40, less three standard errors
    naive = adjusted_effect(x, np.empty((150, 0)), y, (0.0, 1.0))
    assert naive.low > 2.0


def test_extrapolation_is_said() -> None:
    """A value that like units never have is outside; the estimate says in what share of them."""
    rng = np.random.default_rng(0)
    z = rng.normal(size=300)
    x = z + 0.1 * rng.normal(size=300)
    found = adjusted_effect(x, z, x + z, (-1.0, 1.0))
    assert found.outside > 0.9
    assert "extrapolated)" in str(found)
    free = rng.uniform(-2.0, 2.0, 300)
    assert adjusted_effect(free, z, free + z, (-1.0, 1.0)).outside < 0.05
    with pytest.raises(ModelError, match="units are too few"):
        adjusted_effect(x[:9], z[:9], z[:9], (0.0, 1.0))
    with pytest.raises(ModelError, match="does not vary"):
        adjusted_effect(np.ones(300), z, z, (0.0, 1.0))


def test_an_effect_is_estimated_through_its_front_door() -> None:
    """With a hidden common cause, the mediator tells what adjustment cannot."""
    rng = np.random.default_rng(1)
    u = rng.normal(size=400)
    x = u + rng.normal(size=400)
    m = np.tanh(x) + 0.5 * rng.normal(size=400)
    y = 2.0 * m + 2.0 * u + rng.normal(size=400)
    truth = 2.0 * np.tanh(1.0)
    found = frontdoor_effect(x, m, y, (0.0, 1.0))
    assert found.low < truth < found.high
    assert found.low > 0.0
    assert adjusted_effect(x, np.empty((400, 0)), y, (0.0, 1.0)).low > truth
    assert frontdoor_effect(x, m, y, (0.0, 1.0)) == found
