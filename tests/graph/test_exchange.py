"""Facts about graphs in the formats of other programs."""

from __future__ import annotations

import itertools
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import networkx as nx
import numpy as np
import pytest
from graph_models import small
from hypothesis import given, settings
from hypothesis import strategies as st

from scm_world.errors import MissingExtra, ModelError, UnknownOption, UnreadableFile
from scm_world.graph import SCM, Edge, unrolled
from scm_world.graph import exchange as ex
from scm_world.graph.exchange import CausalGraph, Node, causal_graph, read_graph, write_graph
from scm_world.graph.exchange.html import CHAR, PAD, lay_out
from scm_world.tasks import TASKS
from scm_world.variables import Affine, Box, Either, Exogenous, Measured, Parent, Switch
from scm_world.world import World

RICH = ("gml", "graphml", "node-link")
SMALL: dict[str, dict[str, Any]] = {
    "stacked_blocks": {"num_of_levels": 2},
    "creative_stacked_blocks": {"num_of_levels": 2},
}


def awkward() -> CausalGraph:
    """Build a graph with everything that is hard to write down."""
    nodes = (
        Node(
            "mäss.of <b>\"&'\\x", "exogenous", "parameter", "kg", "", "0 to 2", "()", "[]", "a & b"
        ),
        Node("1.5", "derived", "parameter", "m/s²", "3", doc='says "no" \\ <yes>; #{1}'),
        Node("a@-1", "measured", "state", "1", "2x3"),
        Node("graph"),
        Node("} ->, ="),
    )
    edges = (
        Edge(nodes[0].name, "1.5", 0, "set"),
        Edge(nodes[0].name, "1.5", 1, 'contact & "more"'),
        Edge("1.5", "a@-1", 1),
        Edge("a@-1", "a@-1", 1),
        Edge("a@-1", "1.5", 1),
        Edge("graph", "} ->, =", 0),
    )
    return CausalGraph(nodes, edges)


def plain(graph: CausalGraph, *, sliced: bool) -> CausalGraph:
    """Leave what formats without attributes can hold: see the table in ``exchange``."""
    held = graph.held if sliced and graph.max_lag else frozenset()
    return CausalGraph(
        tuple(Node(n.name, role="parameter" if n.name in held else "") for n in graph.nodes),
        tuple(replace(edge, when=None) for edge in graph.edges),
    )


@pytest.fixture(scope="module", params=[*TASKS, "small", "mutilated", "awkward", "nothing"])
def graph(request: pytest.FixtureRequest) -> CausalGraph:
    """Graphs of all tasks, and some others."""
    match request.param:
        case "small":
            return causal_graph(small())
        case "mutilated":
            return causal_graph(small().do({"weight": 1.0}))
        case "awkward":
            return awkward()
        case "nothing":
            return CausalGraph((), ())
    from scm_world.tasks import make_task

    task = make_task(request.param, **SMALL.get(request.param, {}))
    return causal_graph(World(task, backend="fake").model)


# --- the graph itself ----------------------------------------------------------------------------


def test_a_graph_says_what_the_model_says() -> None:
    """Kind, role, unit, spaces and edges are those of the model."""
    model = World("pushing", backend="fake").model
    found = causal_graph(model)
    mass = next(node for node in found.nodes if node.name == "tool_block.mass")
    assert (mass.kind, mass.role, mass.unit) == ("exogenous", "parameter", "kg")
    assert (mass.bounds, mass.a, mass.b) == ("0.001 to 2", "0.015 to 0.045", "0.045 to 0.1")
    assert set(found.edges) == set(model.edges)
    assert found.names == tuple(model)


def test_spaces_are_written_as_declared() -> None:
    """Bounds that follow other variables are written with their names."""
    low = Switch(parent="up", below=0.0, above=1.0)
    either = Either(Box(0, 1), Box(low, Affine(parent="x", offset=2.0)))
    assert ex.space_lines(either) == ["0 to 1 or (0 if up < 0.5 else 1) to 2 + x"]
    assert ex.space_lines(None) == []


def test_all_problems_come_together() -> None:
    """A graph that cannot be is refused with every reason."""
    nodes = (Node("x"), Node("x"), Node(""), Node("y", doc="two\nlines"))
    edges = (Edge("x", "z"), Edge("x", "y"), Edge("x", "y", 0, "set"), Edge("y", "x", -1))
    with pytest.raises(ModelError) as error:
        CausalGraph(nodes, (*edges, Edge("y", "y", 1, "")))
    assert len(error.value.problems) == 7


# --- there and back ------------------------------------------------------------------------------


@pytest.mark.parametrize("form", RICH)
def test_formats_with_attributes_lose_nothing(graph: CausalGraph, form: str) -> None:
    """Names, lags, conditions and attributes come back."""
    assert read_graph(write_graph(graph, format=form), format=form) == graph


@pytest.mark.parametrize("form", RICH)
def test_slices_can_be_written_in_any_format(form: str) -> None:
    """Formats with attributes lose nothing in slices either."""
    first = awkward()
    text = write_graph(first, format=form, view="two_slice")
    assert read_graph(text, format=form, view="two_slice") == first


def test_csv_loses_attributes_only(graph: CausalGraph) -> None:
    """Names, lags and what is held come back."""
    assert read_graph(write_graph(graph, format="csv"), format="csv") == plain(graph, sliced=True)


def test_dagitty_gets_names_and_edges() -> None:
    """A line for each node, and one for each edge."""
    graph = CausalGraph((Node("x y"), Node("z")), (Edge("x y", "z"),))
    assert write_graph(graph, format="dagitty") == 'dag {\n"x y"\n"z"\n"x y" -> "z"\n}'


@pytest.mark.parametrize("form", ["csv", *RICH])
def test_a_summary_loses_lags(form: str) -> None:
    """One edge per pair is left, with loops; its condition only if there is always one."""
    first = awkward()
    found = read_graph(write_graph(first, format=form, view="summary"), format=form, view="summary")
    pairs = {(edge.cause, edge.effect) for edge in first.edges}
    assert {edge.key for edge in found.edges} == {(*pair, 0) for pair in pairs}
    conditions = {edge.when for edge in found.edges} - {None}
    assert conditions == (set() if form == "csv" else {'contact & "more" or set'})


def test_tigramite_keeps_names_and_lags(graph: CausalGraph) -> None:
    """The array marks the cause with an arrow, and lag 0 in both directions."""
    made = ex.to_tigramite(graph)
    at = np.argwhere(made.graph == "-->").tolist()
    found = {(made.var_names[i], made.var_names[j], lag) for i, j, lag in at}
    assert found == {edge.key for edge in graph.edges}
    instant = sum(edge.lag == 0 for edge in graph.edges)
    assert (made.graph == "<--").sum() == instant


def test_dowhy_gets_an_acyclic_networkx_graph(graph: CausalGraph) -> None:
    """Names and edges only."""
    made = ex.to_dowhy(graph)
    assert nx.is_directed_acyclic_graph(made)
    assert ex.read_as(ex.from_digraph(made), "two_slice") == plain(graph, sliced=True)


def test_causal_learn_has_the_same_edges(graph: CausalGraph) -> None:
    """causal-learn's graph has the same edges."""
    pytest.importorskip("causallearn")
    made = ex.to_causal_learn(graph)
    edges = {(e.get_node1().get_name(), e.get_node2().get_name()) for e in made.get_graph_edges()}
    assert edges == {edge.key[:2] for edge in ex.seen_as(graph, "two_slice").edges}


def test_pgmpy_has_the_same_edges(graph: CausalGraph) -> None:
    """The DAG of pgmpy has the same edges."""
    base = pytest.importorskip("pgmpy.base")
    made = ex.to_pgmpy(graph)
    assert isinstance(made, base.DAG)
    assert set(made.edges) == {edge.key[:2] for edge in ex.seen_as(graph, "two_slice").edges}


def test_the_file_is_the_text(tmp_path: Path) -> None:
    """What is written to a path is read from it."""
    path = tmp_path / "graph.graphml"
    text = write_graph(small(), path, format="graphml")
    assert path.read_text() == text + "\n"
    assert read_graph(path, format="graphml") == causal_graph(small())


def test_networkx_reads_node_link_json() -> None:
    """The text is networkx's own format."""
    data = json.loads(write_graph(awkward(), format="node-link"))
    assert ex.from_digraph(nx.node_link_graph(data, edges="edges")) == awkward()


EMPTY = ("[]", "()")  # as networkx writes an empty list and tuple in GML
NAMES = st.text(min_size=1, max_size=6).filter(lambda t: t.isprintable() and t not in EMPTY)
TEXTS = st.text(max_size=6).filter(lambda t: t.isprintable() and t not in EMPTY)


@st.composite
def graphs(draw: st.DrawFn) -> CausalGraph:
    """Draw small graphs without cycles within an instant, and with lags up to 3."""
    names = draw(st.lists(NAMES, unique=True, max_size=4))
    roles = st.sampled_from(["", "parameter", "state"])
    nodes = [Node(name, role=draw(roles), a=draw(TEXTS), doc=draw(TEXTS)) for name in names]
    conditions = st.none() | NAMES
    chosen = draw(
        st.sets(st.tuples(st.sampled_from(names), st.sampled_from(names), st.integers(0, 3)))
        if names
        else st.just(set())
    )
    order = {name: i for i, name in enumerate(names)}
    edges = [
        Edge(cause, effect, lag, draw(conditions))
        for cause, effect, lag in sorted(chosen)
        if lag or order[cause] < order[effect]
    ]
    return CausalGraph(tuple(nodes), tuple(edges))


@settings(max_examples=60, deadline=None)
@given(graphs())
def test_any_graph_comes_back(first: CausalGraph) -> None:
    """Whatever the names, texts and lags are."""
    for form, view in itertools.product(RICH, ("lagged", "two_slice")):
        assert (
            read_graph(write_graph(first, format=form, view=view), format=form, view=view) == first
        )
    assert read_graph(write_graph(first, format="csv"), format="csv") == plain(first, sliced=True)


@given(st.text(alphabet="a@=-1", min_size=1), st.integers(0, 3), st.booleans())
def test_names_in_slices_can_be_inverted(name: str, ago: int, held: bool) -> None:
    """Also those that look like slices themselves."""
    first = ex.Slice(name, ago, held and ago > 0)
    assert ex.Slice.read(str(first)) == first


def test_two_slices_are_those_of_the_model() -> None:
    """The nodes and edges are those of ``scm_world.graph.unrolled``."""
    model = SCM(
        [
            Exogenous(name="gain"),
            Measured(name="x", parents=(Parent("x", 1), Parent("gain", 1)), settable_state=True),
            Measured(name="y", parents=("x", Parent("gain", 1)), settable_state=True),
        ]
    )

    def plain_name(node: tuple[str, int]) -> str:
        return str(ex.Slice(node[0], -node[1], node[0] == "gain" and node[1] < 0))

    expected = nx.relabel_nodes(unrolled(model, 2), {n: plain_name(n) for n in unrolled(model, 2)})
    found = ex.to_dowhy(model)
    assert set(found.nodes) == set(expected.nodes)
    assert set(found.edges) == set(expected.edges)


# --- what others write ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("form", "text", "reason"),
    [
        ("csv", "cause,x@,y\nx@,0,1\ny,0,0", "'x@' is no name in a slice"),
        ("csv", "cause,y,x@-1\ny,0,1\nx@-1,0,0", "leads into the past"),
        ("csv", "cause,x@-1,y@-1\nx@-1,0,1\ny@-1,0,0", "1 steps ago, not now"),
        (
            "gml",
            'graph [directed 1 node [id 0 label "a"] edge [source 0 target 0 lag "soon"]]',
            "the lag",
        ),
        (
            "gml",
            'graph [directed 1 node [id 0 label "a"] edge [source 0 target 0 lag -1]]',
            "has the lag -1",
        ),
        ("gml", "graph [", ""),
        ("gml", 'graph [ node [ id 0 label "a" ] ]', "not directed"),
        ("graphml", "<graphml>", "no element found"),
        ("graphml", "<html></html>", ""),
        ("node-link", "[]", "'directed': true"),
        ("node-link", "{", ""),
        ("node-link", '{"directed": true, "nodes": [{}], "edges": []}', "there is no 'id'"),
        ("node-link", '{"directed": true, "nodes": []}', "there is no 'edges'"),
        (
            "node-link",
            '{"directed": true, "nodes": [], "links": [{"source": 1, "target": 2}]}',
            "unknown node '1'",
        ),
        ("csv", "", "empty"),
        ("csv", "cause,x,y\nx,0,1\n", "the same names"),
        ("csv", "cause,x\nx,0,1\n", "2 cells, not 1"),
        ("csv", "cause,x\nx,maybe\n", "column 'x': 'maybe' is not 0 or 1"),
    ],
)
def test_what_cannot_be_read_says_why(form: str, text: str, reason: str) -> None:
    """One error for all formats, with the reason."""
    with pytest.raises(UnreadableFile, match=f"it is no {form} graph") as error:
        read_graph(text, format=form)
    assert reason in str(error.value)


def test_what_a_format_cannot_hold_is_refused() -> None:
    """Cycles, names, views and formats: with what is possible."""
    loop = CausalGraph((Node("x"), Node("y")), (Edge("x", "y"), Edge("y", "x", 1)))
    with pytest.raises(ModelError, match=r"x → y → x; try view='two_slice'"):
        write_graph(loop, format="dagitty", view="summary")
    with pytest.raises(ModelError, match="acyclic"):
        ex.to_tigramite(ex.seen_as(loop, "summary"))
    with pytest.raises(ModelError, match="dagitty cannot write the name"):
        write_graph(CausalGraph((Node('a"b'),), ()), format="dagitty")
    with pytest.raises(UnknownOption, match="no view is named 'lagged'"):
        write_graph(loop, format="csv", view="lagged")
    with pytest.raises(UnknownOption, match="no view is named 'lagged'"):
        ex.to_dowhy(loop, view="lagged")
    with pytest.raises(UnknownOption, match="did you mean 'graphml'"):
        write_graph(loop, format="graphm")
    with pytest.raises(UnknownOption, match="no format to read is named 'html'"):
        read_graph("", format="html")


@pytest.mark.parametrize(
    ("module", "name", "write"),
    [
        ("causallearn", "causal-learn", ex.to_causal_learn),
        ("pgmpy", "pgmpy", ex.to_pgmpy),
    ],
)
def test_a_missing_library_is_named(
    module: str, name: str, write: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error says which extra brings it."""
    import sys

    for loaded in [key for key in sys.modules if key.partition(".")[0] == module]:
        monkeypatch.delitem(sys.modules, loaded)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtra, match=re.escape(f"scm-world[{name}]")):
        write(small())


# --- the picture ---------------------------------------------------------------------------------


def overlap(one: Any, other: Any) -> bool:
    """Tell whether two rectangles have a point in common."""
    return bool(
        one.x < other.right
        and other.x < one.right
        and one.y < other.bottom
        and other.y < one.bottom
    )


def test_nothing_overlaps_and_every_text_fits(graph: CausalGraph) -> None:
    """Boxes lie apart and in the picture, nodes in their boxes, labels in their nodes."""
    boxes, places, labels = lay_out(graph)
    assert not any(overlap(a, b) for a, b in itertools.combinations(boxes.values(), 2))
    assert all(box.x >= 0 and box.y >= 0 for box in boxes.values())
    assert set(places) == set(graph.names)
    for name, place in places.items():
        (box,) = (box for box in boxes.values() if overlap(box, place))
        assert box.x < place.x < place.right < box.right
        assert box.y < place.y < place.bottom < box.bottom
        assert CHAR * len(labels[name]) + 2 * PAD <= place.width
    for one, other in itertools.pairwise(sorted(places.values(), key=lambda p: (p.x, p.y))):
        assert not overlap(one, other)


def test_causes_stand_left_of_effects_in_other_entities() -> None:
    """A chain of entities goes from left to right."""
    nodes = tuple(Node(f"{name}.x") for name in "cab")
    boxes, _, _ = lay_out(CausalGraph(nodes, (Edge("a.x", "b.x"), Edge("b.x", "c.x", 1))))
    assert boxes["a"].right < boxes["b"].x < boxes["b"].right < boxes["c"].x


def test_the_page_needs_nothing_else(graph: CausalGraph) -> None:
    """It is well formed, has every node and edge, names no address, and escapes what it shows."""
    page = ex.to_html(graph, title="<script>")
    assert "<script></" not in page
    assert set(re.findall(r"https?://[^\"]+", page)) == {"http://www.w3.org/2000/svg"}
    picture = re.search(r"<svg.*</svg>", page, re.DOTALL)
    assert picture is not None
    root = ElementTree.fromstring(picture[0])  # noqa: S314 # our own text
    names = [group[0].text.partition("\n")[0] for group in root if group.get("class") == "n"]
    assert names == list(graph.names)
    drawn = [(int(p.get("data-c")), int(p.get("data-e"))) for p in root if p.get("data-c")]
    at = {name: i for i, name in enumerate(graph.names)}
    edges = [(at[e.cause], at[e.effect]) for e in graph.edges if e.cause != e.effect]
    assert drawn == edges


def test_a_title_says_what_is_known() -> None:
    """Kind, unit, spaces, causes and meaning stand in the title of a node."""
    page = write_graph(World("pushing", backend="fake").model, format="html")
    title = re.search(r"<title>(tool_block\.mass\n.*?)</title>", page, re.DOTALL)
    assert title is not None
    assert title[1].splitlines() == [
        "tool_block.mass",
        "exogenous · parameter",
        "unit: kg",
        "bounds: 0.001 to 2",
        "A: 0.015 to 0.045",
        "B: 0.045 to 0.1",
        "Mass; the inertia of the solid follows from it.",
    ]
    assert "causes at the same step: " in page
