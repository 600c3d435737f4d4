"""Watching and acting, held against each other."""

from __future__ import annotations

import importlib.util
from typing import Any

import networkx as nx
import pytest

from scm_world.errors import MissingExtra, ModelError, UnknownOption
from scm_world.graph import episode_outcome
from scm_world.queries import Outcome, World, check_backdoor, identify, nature_graph
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


def test_watching_tells_what_acting_does_if_the_mass_is_watched() -> None:
    """Adjusted it agrees; unadjusted it is wrong by far; without the mass it is refused."""
    world = World("pushing")
    options: dict[str, Any] = {"values": (0.2, 0.3), "nature": NATURE, "steps": 12, "policy": None}
    check = check_backdoor(world, TREATMENT, SLID, n=120, units=40, **options)
    assert check.identification.backdoor == ("tool_block.mass",)
    assert check.agrees
    assert check.is_confounded
    assert check.adjusted[0] == pytest.approx(float(check.simulated.mean), rel=0.2)
    assert "adjusted for tool_block.mass" in str(check)
    with pytest.raises(ModelError, match="cannot be told"):
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


def test_a_front_door_is_found_by_pgmpy() -> None:
    """Where the back door is closed; or the extra is asked for."""
    graph = nx.DiGraph([("u", "x"), ("u", "y"), ("x", "m"), ("m", "y")])
    watched = ["x", "m", "y"]
    if importlib.util.find_spec("pgmpy") is None:
        with pytest.raises(MissingExtra, match="pgmpy"):
            identify(graph, "x", "y", observed=watched, frontdoor=True)
        return
    found = identify(graph, "x", "y", observed=watched, frontdoor=True)
    assert found.backdoor is None
    assert found.frontdoor == (("m",),)
