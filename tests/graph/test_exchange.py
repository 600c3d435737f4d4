"""Facts about graphs in the formats of other programs."""

from __future__ import annotations

import json
from itertools import product
from typing import Any

import networkx as nx
import numpy as np
import pytest
from graph_models import small

from scm_world.errors import ModelError, UnknownOption
from scm_world.graph import SCM, to_dag, to_digraph, unrolled
from scm_world.queries import identify
from scm_world.variables import Affine, Box, Either, Exogenous, Measured, Parent, Switch
from scm_world.world import Simulation

SOME = ("reaching", "pushing", "stacking2")


def awkward() -> nx.MultiDiGraph:
    """Build a graph with everything that is hard to write down."""
    hard = "mäss.of <b>\"&'\\x"
    graph = nx.MultiDiGraph()
    graph.add_node(hard, kind="exogenous", role="parameter", unit="kg", a="0 to 2", doc="a & b")
    graph.add_node("1.5", unit="m/s²", doc='says "no" \\ <yes>; #{1}')
    graph.add_nodes_from(["graph", "} ->, ="])
    graph.add_edge(hard, "1.5", 0, lag=0, when="set")
    graph.add_edge(hard, "1.5", 1, lag=1, when='contact & "more"')
    graph.add_edge("1.5", "1.5", 1, lag=1)
    graph.add_edge("graph", "} ->, =", 0, lag=0)
    return graph


@pytest.fixture(scope="module", params=[*SOME, "small", "mutilated", "awkward", "nothing"])
def graph(request: pytest.FixtureRequest) -> nx.MultiDiGraph:
    """Graphs of some tasks, and some others."""
    match request.param:
        case "small":
            return to_digraph(small())
        case "mutilated":
            return to_digraph(small().do({"weight": 1.0}))
        case "awkward":
            return to_digraph(awkward())
        case "nothing":
            return to_digraph(nx.DiGraph())
    return to_digraph(Simulation(request.param, backend="fake").model)


# --- networkx ------------------------------------------------------------------------------------


def test_a_graph_says_what_the_model_says() -> None:
    """Kind, role, unit, spaces and edges are those of the model."""
    model = Simulation("pushing", backend="fake").model
    found = to_digraph(model)
    assert found.nodes["tool_block.mass"] == {
        "kind": "exogenous",
        "role": "parameter",
        "unit": "kg",
        "per": "episode",
        "bounds": "0.001 to 2",
        "a": "0.015 to 0.045",
        "b": "0.045 to 0.1",
        "doc": "Mass; the inertia of the solid follows from it.",
    }
    assert tuple(found) == tuple(model)
    conditions = {(c, e, lag): when for c, e, lag, when in found.edges(keys=True, data="when")}
    assert conditions == {edge.key: edge.when for edge in model.edges}


def test_spaces_are_written_as_declared() -> None:
    """Bounds that follow other variables are written with their names."""
    low = Switch(parent="up", below=0.0, above=1.0)
    either = Either(Box(0, 1), Box(low, Affine(parent="x", offset=2.0)))
    assert either.describe() == "0 to 1 or (0 if up < 0.5 else 1) to 2 + x"


def test_any_directed_graph_of_networkx_will_do() -> None:
    """Edges without a lag have lag 0; without a direction or a whole lag there is no graph."""
    found = to_digraph(nx.DiGraph([("x", "y"), ("y", "x", {"lag": 2})]))
    assert set(found.edges(keys=True)) == {("x", "y", 0), ("y", "x", 2)}
    with pytest.raises(ModelError, match="no direction"):
        to_digraph(nx.Graph([("x", "y")]))
    with pytest.raises(ModelError, match="the lag 'soon' of 'x' → 'y'"):
        to_digraph(nx.DiGraph([("x", "y", {"lag": "soon"})]))


def test_two_slices_are_those_of_the_model() -> None:
    """But for the unobserved past, they are those of ``scm_world.graph.unrolled``."""
    model = SCM(
        [
            Exogenous(name="gain"),
            Measured(name="x", parents=(Parent("x", 1), Parent("gain", 1)), settable_state=True),
            Measured(name="y", parents=("x", Parent("gain", 1)), settable_state=True),
        ]
    )
    names = {"gain": "gain@=-1", "x": "x@-1", "y": "y@-1"}
    graph = unrolled(model, 2)
    expected = nx.relabel_nodes(graph, {n: names[n[0]] if n[1] < 0 else n[0] for n in graph})
    found = to_dag(model)
    past = [name for name, seen in found.nodes(data="observed") if seen == "no"]
    assert [sorted(found.successors(name)) for name in past] == [["gain@=-1", "x@-1", "y@-1"]]
    found.remove_nodes_from(past)
    assert set(found.nodes) == set(expected.nodes)
    assert set(found.edges) == set(expected.edges)


@pytest.mark.parametrize("seed", range(6))
def test_two_slices_separate_what_a_long_past_separates(seed: int) -> None:
    """D-separation in them is that in a graph of very many slices, which can hide nothing."""
    rng = np.random.default_rng(seed)
    names, longest = "abcd"[: rng.integers(2, 5)], int(rng.integers(1, 3))
    graph = nx.MultiDiGraph()
    for name in names:
        graph.add_node(name, per="episode" if rng.random() < 0.2 else "step")
    for cause, effect, lag in product(names, names, range(longest + 1)):
        if (lag or cause < effect) and rng.random() < 0.25:
            graph.add_edge(cause, effect, lag, lag=lag)
    held = {n for n in names if graph.nodes[n]["per"] == "episode" and not graph.in_degree(n)}
    past = max((lag for *_, lag in graph.edges(keys=True)), default=0)
    window, long = to_dag(graph), unrolled(graph, 60)
    nodes = [(name, slice_) for slice_ in range(-past, 1) for name in names]
    named = {(n, t): f"{n}@{'=' * (n in held)}{t}" if t else n for n, t in nodes}
    for _ in range(30):
        x, y, *rest = (nodes[i] for i in rng.permutation(len(nodes)))
        given = set(rest[: rng.integers(0, len(rest) + 1)])
        separated = nx.is_d_separator(long, {x}, {y}, given)
        ends = {named[x]}, {named[y]}, {named[node] for node in given}
        assert nx.is_d_separator(window, *ends) == separated, ends


def test_libraries_learn_of_the_unobserved_past() -> None:
    """Two effects of one cause two steps ago have it in common, unobserved, in every format."""
    model = nx.DiGraph([("z", "z", {"lag": 1}), ("z", "x", {"lag": 1}), ("z", "y", {"lag": 1})])
    found = to_dag(model)
    assert found.nodes["past_1@-2"] == {"observed": "no"}
    assert set(found.successors("past_1@-2")) == {"x@-1", "y@-1", "z@-1"}
    assert identify(model, "x@-1", "y").backdoor == ("z@-1",)
    assert identify(model, "x@-1", "y", observed=["x@-1", "y"]).backdoor is None


def test_formats_of_networkx_lose_nothing(graph: nx.MultiDiGraph) -> None:
    """What networkx reads back has the names, lags, conditions and attributes."""

    def facts(made: nx.MultiDiGraph) -> tuple[Any, Any]:
        edges = {(c, e, data["lag"], data.get("when")) for c, e, data in made.edges(data=True)}
        return dict(made.nodes(data=True)), edges

    if len(graph):
        assert facts(nx.parse_gml("\n".join(nx.generate_gml(graph)))) == facts(graph)
    assert facts(nx.parse_graphml("\n".join(nx.generate_graphml(graph)))) == facts(graph)
    data = nx.node_link_data(graph, edges="edges")
    assert facts(nx.node_link_graph(json.loads(json.dumps(data)), edges="edges")) == facts(graph)


def test_other_libraries_get_an_acyclic_graph(graph: nx.MultiDiGraph) -> None:
    """Names of the present come first, and every edge that ends now is there."""
    made = to_dag(graph)
    assert nx.is_directed_acyclic_graph(made)
    assert list(made)[: len(graph)] == list(graph)
    assert all(set(made.predecessors(name)) for name in graph if graph.in_degree(name))


def test_what_is_no_acyclic_graph_is_refused() -> None:
    """Cycles within an instant, and what is no graph."""
    loop = nx.DiGraph([("x", "y"), ("y", "x")])
    with pytest.raises(ModelError, match=r"x → y → x; give edges their lag"):
        to_dag(loop)
    for other in ("pushing", {"x": ["y"]}, None):
        with pytest.raises(UnknownOption, match="a directed graph of networkx"):
            to_digraph(other)  # type: ignore[arg-type] # that is the point


def test_the_text_for_dagitty_has_all_nodes() -> None:
    """In the line of docs/graphs.md: a variable without edges, and a latent one."""
    dag = to_dag(nx.DiGraph([("x", "y")]))
    dag.add_node("z")
    dag.add_node("u", observed="no")
    hidden = [n for n, seen in dag.nodes(data="observed") if seen]
    nodes = " ".join(f'"{n}"' + " [latent]" * (n in hidden) for n in dag)
    made = "dag { " + nodes + " " + " ".join(f'"{a}" -> "{b}"' for a, b in dag.edges) + " }"
    assert made == 'dag { "x" "y" "z" "u" [latent] "x" -> "y" }'


def test_causal_learn_takes_the_graph(graph: nx.MultiDiGraph) -> None:
    """In the line of docs/graphs.md."""
    general = pytest.importorskip("causallearn.graph.GeneralGraph").GeneralGraph
    node = pytest.importorskip("causallearn.graph.GraphNode").GraphNode
    dag = to_dag(graph)
    nodes = {n: node(n) for n in dag}
    made = general([*nodes.values()])
    for a, b in dag.edges:
        made.add_directed_edge(nodes[a], nodes[b])
    edges = {(e.get_node1().get_name(), e.get_node2().get_name()) for e in made.get_graph_edges()}
    assert edges == set(dag.edges)
