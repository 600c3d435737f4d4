"""Effects that are identified without an intervention."""

from __future__ import annotations

import importlib.util
from itertools import combinations
from typing import Any

import networkx as nx
import numpy as np
import pytest

from scm_world.discovery.data import sweep
from scm_world.errors import FunctionFailure, MissingExtra, ModelError, UnknownOption
from scm_world.graph import episode_outcome
from scm_world.queries import SCM, Outcome, World, estimate, identify, nature_graph
from scm_world.variables import Box, Derived, Exogenous, Linear, Mechanism, Normal, Parent

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


def test_what_is_no_question_is_refused() -> None:
    """Nodes have to be there, in a graph, with one node for each end."""
    graph = nx.DiGraph([("a", "b")])
    with pytest.raises(UnknownOption, match="no node is named 'c'"):
        identify(graph, "a", "c")
    with pytest.raises(UnknownOption, match="a model"):
        identify("pushing", "a", "b")  # type: ignore[arg-type] # that is the point
    with pytest.raises(UnknownOption, match="names"):
        identify(graph, "a", "b", observed=5)  # type: ignore[arg-type] # that is the point
    assert identify(graph, "a", "b", observed="a").backdoor == ()


def test_a_model_is_asked_as_its_graph_is() -> None:
    """With lagged edges, two slices of it and their unobserved past."""
    lines = {"z": 0.9, "x": 1.0, "y": 1.0}
    model = SCM(
        [
            Derived(
                name=name,
                parents=(Parent("z", 1),),
                mechanism=Linear(weights=(weight,)),
                noise=Normal(),
            )
            for name, weight in lines.items()
        ]
    )
    assert identify(model, "x@-1", "y").backdoor == ("z@-1",)
    assert identify(model, "x@-1", "y", observed=["x@-1", "y", "z"]).backdoor is None


@pytest.mark.parametrize("seed", range(40))
def test_no_smaller_set_blocks_every_back_door(seed: int) -> None:
    """All smaller sets of observed variables are tried."""
    rng = np.random.default_rng(seed)
    names = "abcdefg"[: rng.integers(3, 8)]
    order = rng.permutation(list(names)).tolist()
    graph = nx.DiGraph()
    graph.add_nodes_from(names)
    graph.add_edges_from(pair for pair in combinations(order, 2) if rng.random() < 0.4)
    observed = [name for name in names if name in "ab" or rng.random() < 0.8]
    found = identify(graph, "a", "b", observed=observed).backdoor
    allowed = set(observed) - {"a", "b"} - nx.descendants(graph, "a")
    behind = graph.copy()
    behind.remove_edges_from(list(graph.out_edges("a")))
    blocks = [
        given
        for size in range(len(allowed) + 1)
        for given in combinations(sorted(allowed), size)
        if nx.is_d_separator(behind, {"a"}, {"b"}, set(given))
    ]
    if found is None:
        assert not blocks
    else:
        assert found in blocks
        assert len(found) == len(blocks[0])


def test_the_smallest_set_is_found_where_a_minimal_one_is_larger() -> None:
    """Nothing can be taken from {a, b}; yet c alone is enough."""
    edges = [("a", "x"), ("b", "x"), ("c", "a"), ("c", "b"), ("c", "y"), ("x", "y")]
    assert identify(nx.DiGraph(edges), "x", "y").backdoor == ("c",)


def test_adjusting_for_what_is_identified_gives_the_effect_of_the_intervention() -> None:
    """In a regression on the treatment and the set; without the set it is wrong."""
    world = World("pushing")
    graph = nature_graph(world.model, NATURE, [PLACE])
    (mass,) = identify(graph, TREATMENT, PLACE).backdoor or ()
    assert mass == "tool_block.mass"
    assert identify(graph, TREATMENT, PLACE, observed=[TREATMENT, PLACE]).backdoor is None
    options: dict[str, Any] = {"steps": 12, "policy": None}
    wanted = [Outcome(TREATMENT, "first"), Outcome(mass, "first"), SLID]
    cause, covariate, slid = world.see(120, outcomes=wanted, nature=NATURE, **options).values()
    nature = {name: act for name, act in NATURE.items() if name != TREATMENT}
    arms = {"do": {TREATMENT: 0.3}, "versus": {TREATMENT: 0.2}}
    truth = float(world.effect(SLID, n=40, nature=nature, **arms, **options).mean)

    def estimate(rest: Any) -> float:
        """Average a regression with squares and products over the units, at both values."""

        def table(x: Any) -> Any:
            return np.c_[np.ones(len(rest)), x, x**2, rest, rest**2, x * rest]

        slopes = np.linalg.lstsq(table(cause), slid, rcond=None)[0]
        sides = (table(np.full(len(rest), value)) @ slopes for value in (0.3, 0.2))
        return float(np.mean(next(sides) - next(sides)))

    assert estimate(covariate) == pytest.approx(truth, rel=0.2)
    assert abs(estimate(np.zeros(len(cause))) - truth) > 0.5 * abs(truth)


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


def confounded() -> nx.DiGraph:
    """One with a back door, a front door and an instrument."""
    edges = [("u", "x"), ("u", "y"), ("x", "m"), ("m", "y"), ("i", "x")]
    return nx.DiGraph(edges)


def test_instruments_are_found() -> None:
    """Associated with the treatment, and with the outcome through it alone."""
    graph = confounded()
    assert identify(graph, "x", "y").instruments == ("i",)
    found = identify(graph, "x", "y", observed=["x", "y", "i"])
    assert (found.backdoor, found.variables) == (None, {"iv": ("i",)})
    graph.add_edge("i", "y")
    assert identify(graph, "x", "y").instruments == ()


def test_what_cannot_be_estimated_is_refused() -> None:
    """No criterion, no column, another criterion than the method's; and DoWhy is an extra."""
    seen = {"x": [0.0], "y": [0.0]}
    found = identify(confounded(), "x", "y", observed=["x", "y"])
    pandas = pytest.importorskip("pandas")
    table = pandas.DataFrame(seen)
    with pytest.raises(ModelError, match=r"x on y is not identified: .*a bow.*; observe more"):
        estimate(found, table, do=1.0, versus=0.0)
    backwards = identify(confounded(), "y", "x", observed=["x", "y"])
    none = estimate(backwards, table, do=1.0, versus=0.0)
    assert (none.value, none.get_confidence_intervals()) == (0.0, (0.0, 0.0))
    assert str(none).startswith("the effect is 0: y has no effect on x: no directed path")
    found = identify(confounded(), "x", "y")
    with pytest.raises(UnknownOption, match="column of the table"):
        estimate(found, table, do=1.0, versus=0.0)
    with pytest.raises(UnknownOption, match="method"):
        estimate(found, table, do=1.0, versus=0.0, method="frontdoor.two_stage_regression")


@pytest.mark.parametrize("criterion", ["backdoor", "frontdoor", "iv"])
def test_estimates_are_those_of_dowhy(criterion: str) -> None:
    """Linear ones, within a tenth of the effect that the numbers were made with."""
    pandas = pytest.importorskip("pandas")
    rng = np.random.default_rng(0)
    u, i, *noise = rng.normal(size=(5, 5000))
    x = u + i + noise[0]
    m = 2.0 * x + noise[1]
    table = pandas.DataFrame({"x": x, "m": m, "y": 1.5 * m + 3.0 * u + noise[2], "u": u, "i": i})
    seen = {"backdoor": ["u"], "frontdoor": ["m"], "iv": ["i"]}[criterion]
    found = identify(confounded(), "x", "y", observed=["x", "y", *seen], frontdoor=True)
    assert next(iter(found.variables)) == criterion
    if importlib.util.find_spec("dowhy") is None:
        with pytest.raises(MissingExtra, match=r"scm-world\[dowhy\]"):
            estimate(found, table, do=1.0, versus=0.0)
        return
    made = estimate(found, table, do=1.0, versus=0.0)
    assert made.value == pytest.approx(3.0, rel=0.1)


def test_nodes_may_have_names_of_several_kinds() -> None:
    """Numbers and texts in one graph; another method than one by name is refused."""
    edges = [(0, "a"), (2, 0), (2, "a"), (0, "b"), ("b", "a"), (0, 3), (3, "a")]
    found = identify(nx.DiGraph(edges), 0, "a", frontdoor=True)  # type: ignore[arg-type] # numbers
    assert (found.backdoor, found.frontdoor) == ((2,), ())
    pandas = pytest.importorskip("pandas")
    table = pandas.DataFrame({"x": [0.0], "y": [0.0], "z": [0.0]})
    found = identify(nx.DiGraph([("z", "x"), ("z", "y"), ("x", "y")]), "x", "y")
    with pytest.raises(UnknownOption, match="method"):
        estimate(found, table, do=1.0, versus=0.0, method=3)  # type: ignore[arg-type] # the point


def test_the_episode_of_a_lagged_model_has_the_parameters_that_last() -> None:
    """What moves in an episode is no parameter of it; without its noise its effect stays."""
    one, two = Linear(weights=(1.0,)), Linear(weights=(1.0, 1.0))
    model = SCM(
        [
            Exogenous(name="k", a=Box(0.0, 1.0), distribution=Normal()),
            Derived(name="half", parents=("k",), mechanism=Linear(weights=(0.5,))),
            Derived(name="z", parents=(Parent("z", 1), "half"), mechanism=two, noise=Normal()),
            Derived(name="y", parents=("z",), mechanism=one, noise=Normal()),
        ]
    )
    graph = nature_graph(model, {"k": "A"}, ["y"])
    assert set(graph.edges) == {("k", "half"), ("half", "y")}
    assert identify(graph, "k", "y").backdoor == ()
    table = sweep(model, {"k": [0.0, 1.0]}, ["y"], n=3, steps=4).data
    assert table.truth is not None
    assert table.truth.edges == (("k", "y", 0),)


def test_other_coordinates_have_the_causes_of_the_place() -> None:
    """They follow it within the instant, and are no parameter of the world."""
    world, names = World("pushing", backend="fake"), [PLACE, "tool_block.cylindrical_position"]
    graph = nature_graph(world.model, NATURE, names)
    causes = [{*graph.predecessors(name)} for name in names]
    assert causes[0] == causes[1]
    assert "tool_block.mass" in causes[1]


def test_a_world_is_asked_with_the_interventions_it_was_given() -> None:
    """Before its first episode and in one: nature is the rest."""
    tied = {TREATMENT: NATURE[TREATMENT]}
    world = World("pushing", backend="fake").given(tied)
    rest = {name: act for name, act in NATURE.items() if name != TREATMENT}
    graph = nature_graph(world, rest, [PLACE])
    assert {*graph.edges} == {*nature_graph(world.model, NATURE, [PLACE]).edges}
    for _ in range(2):
        found = identify(world, "floor_color", TREATMENT)
        assert found.verdict == "identified"
        assert found.graph.has_edge("floor_color", TREATMENT)
        world.reset(seed=0)
    assert identify(world.model, "floor_color", TREATMENT).verdict == "no effect"


# --- what can be identified at all ----------------------------------------------------------------


def hidden(edges: str, pairs: str = "") -> nx.DiGraph:
    """Build a graph from edges such as ``"xy"``, and pairs with a hidden cause."""
    graph = nx.DiGraph([(edge[0], edge[1]) for edge in edges.split()])
    for number, pair in enumerate(pairs.split()):
        graph.add_node(f"hidden {number}", observed="no")
        graph.add_edges_from((f"hidden {number}", end) for end in pair)
    return graph


@pytest.mark.parametrize(
    ("edges", "pairs", "verdict", "says"),
    [
        ("yx zx", "xy", "no effect", "x has no effect on y: no directed path leads there"),
        ("zx zy xy", "", "identified", "adjustment for z"),
        ("xm my", "xy", "identified", "the front door m"),
        ("xm my cx cm cy", "xy", "identified", "the conditional front door m given c"),
        ("wz zx xy", "wx wy", "identified", "the ID algorithm alone, as in the napkin graph"),
        ("xy", "xy", "not identified", "hidden causes join x, y (a bow)"),
        ("xy zx", "xy", "not identified", "(a bow); a linear one is, by the instrument z"),
        ("xm my", "xm my", "not identified", "hidden causes join m, x, y (a bow)"),
        ("xm my", "xy my", "not identified", "hidden causes join m, x, y (a hedge)"),
        # Shpitser and Pearl, AAAI 2006, and Tian and Pearl, AAAI 2002: known answers.
        ("xz zy wy", "xw wy xy", "identified", "the front door z"),
        ("xz zy", "xz", "not identified", "(a bow)"),
        ("xy zx zy", "xz zy", "not identified", "hidden causes join x, y, z (a hedge)"),
        ("xa ay xb by", "xb ab xy", "not identified", "(a bow)"),
    ],
)
def test_graphs_with_known_answers(edges: str, pairs: str, verdict: str, says: str) -> None:
    """No effect, identified and not identified are three answers, each with its reason."""
    found = identify(hidden(edges, pairs), "x", "y", frontdoor=True)
    assert found.verdict == verdict
    assert str(found).endswith(says)


def has_hedge(directed: nx.DiGraph, shared: nx.Graph) -> bool:
    """Try all pairs of sets: the larger one with the treatment a, the smaller one without.

    Both are joined by hidden causes, and inside of both every node leads to the same roots, which
    are ancestors of the outcome b without edges into a.
    """
    without = directed.copy()
    without.remove_edges_from([*directed.in_edges("a")])
    above = {"b"} | nx.ancestors(without, "b")
    sets = [
        {*some}
        for size in range(1, len(directed) + 1)
        for some in combinations(directed, size)
        if nx.is_connected(shared.subgraph(some))
    ]

    def leads(inside: set[str], roots: set[str]) -> bool:
        part = directed.subgraph(inside)
        return inside == roots.union(*(nx.ancestors(part, root) for root in roots))

    return any(
        roots and leads(small, roots) and leads(large, roots)
        for large in sets
        if "a" in large
        for small in sets
        if small < large and "a" not in small
        for roots in [small & above]
    )


@pytest.mark.parametrize("first", range(0, 200, 50))
def test_an_effect_is_identified_unless_there_is_a_hedge(first: int) -> None:
    """All pairs of sets are tried; and what a criterion finds is identified."""
    verdicts = set()
    for seed in range(first, first + 50):
        rng = np.random.default_rng(seed)
        names = list("abcde"[: rng.integers(3, 6)])
        order = rng.permutation(names).tolist()
        edges = [f"{a}{b}" for a, b in combinations(order, 2) if rng.random() < 0.5]
        pairs = [f"{a}{b}" for a, b in combinations(names, 2) if rng.random() < 0.3]
        graph = hidden(" ".join(edges), " ".join(pairs))
        graph.add_nodes_from(names)
        directed, shared = nx.DiGraph(map(tuple, edges)), nx.Graph(map(tuple, pairs))
        for made in (directed, shared):
            made.add_nodes_from(names)
        found = identify(graph, "a", "b", frontdoor=True)
        if not nx.has_path(directed, "a", "b"):
            assert found.verdict == "no effect"
        else:
            wanted = "not identified" if has_hedge(directed, shared) else "identified"
            assert found.verdict == wanted, (edges, pairs)
        verdicts.add(found.verdict)
        if found.verdict == "not identified":
            assert found.backdoor is None
            assert found.frontdoor == found.conditional_frontdoor == ()
            assert "a" in found.hedge
        assert not found.is_bow or found.verdict == "not identified"
    assert len(verdicts) == 3


@pytest.mark.parametrize("way", ["iv", "indirect", "two", "binary", "frontdoor"])
def test_a_linear_estimate_grows_with_the_difference(way: str) -> None:
    """An instrument and a front door give slope times (do - versus)."""
    pytest.importorskip("dowhy")
    pandas = pytest.importorskip("pandas")
    rng, n = np.random.default_rng(0), 20_000
    z, v, h, e, f, g = rng.normal(size=(6, n))
    z = np.where(z > 0, 3.0, 1.0) if way == "binary" else z + 5
    x = z + v * (way == "two") + h + e + 7
    m = 1.5 * x + f
    y = 2 * m + 3 * h + g + 11
    hidden = [("h", "x"), ("h", "y")]
    inner = {"iv": [("z", "x")], "binary": [("z", "x")], "indirect": [("z", "w"), ("w", "x")]}
    edges = inner.get(way, [("z", "x"), ("v", "x")] if way == "two" else [])
    graph = nx.DiGraph([*hidden, *edges, ("x", "m"), ("m", "y")])
    table = pandas.DataFrame({"x": x, "m": m, "y": y, "z": z, "v": v})
    seen = {"two": "xyzv", "frontdoor": "xym"}.get(way, "xyz")
    found = identify(graph, "x", "y", observed=list(seen), frontdoor=True)
    for do, versus in ((1, 0), (3, 1), (0, 1)):
        made = estimate(found, table, do=do, versus=versus)
        assert made.value == pytest.approx(3 * (do - versus), rel=0.05)
    assert estimate(found, table, do=1, versus=1).value == 0.0
    with pytest.raises(ModelError, match="missing values"):
        estimate(found, table.mask(table["y"] > 40), do=1, versus=0)


def with_one_confounder(n: int = 2000) -> Any:
    """Return a found back door, and a table of c, of x in {3, 5} that follows c, and y = x + 3c."""
    pandas = pytest.importorskip("pandas")
    rng = np.random.default_rng(0)
    c = rng.normal(size=n)
    x = np.where(rng.random(n) < 1 / (1 + np.exp(-c)), 5, 3)
    table = pandas.DataFrame({"c": c, "x": x, "y": x + 3 * c + rng.normal(size=n)})
    return identify(nx.DiGraph([("c", "x"), ("c", "y"), ("x", "y")]), "x", "y"), table


@pytest.mark.parametrize(
    "method",
    [f"propensity_score_{end}" for end in ("weighting", "matching", "stratification")]
    + ["distance_matching", "doubly_robust"],
)
def test_groups_are_compared_in_the_asked_direction(method: str) -> None:
    """Methods that compare two groups give 2 for one direction, and -2 for the other."""
    pytest.importorskip("dowhy")
    found, table = with_one_confounder()
    words = table.assign(x=table["x"].map({3: "low", 5: "high"}))
    for of, do, versus, effect in (
        (table, 5, 3, 2),
        (table, 3, 5, -2),
        (words, "high", "low", 2),
        (words, "low", "high", -2),
    ):
        made = estimate(found, of, do=do, versus=versus, method=f"backdoor.{method}")
        assert made.value == pytest.approx(effect, abs=0.3)
    assert estimate(found, table, do=3, versus=3, method=f"backdoor.{method}").value == 0.0
    with pytest.raises(ModelError, match="needs rows"):
        estimate(found, table, do=1, versus=0, method=f"backdoor.{method}")


def test_a_regression_takes_values_between_those_of_the_table() -> None:
    """Of whole numbers, switches and labels; the interval has its lower end first."""
    pytest.importorskip("dowhy")
    found, table = with_one_confounder()
    for of, do, versus, effect in (
        (table, 4.5, 4, 0.5),
        (table, 3, 5, -2.0),
        (table.assign(x=table["x"] == 5), False, True, -2.0),
        (table.assign(x=table["x"].map({3: "low", 5: "high"})), "low", "high", -2.0),
    ):
        made = estimate(found, of, do=do, versus=versus)
        low, high = made.get_confidence_intervals().ravel()
        assert low < made.value < high
        assert made.value == pytest.approx(effect, rel=0.1)


def test_a_generalized_model_averages_over_the_covariates() -> None:
    """Against the mean of the probabilities that the outcomes were drawn with."""
    pytest.importorskip("dowhy")
    from statsmodels.genmod.families import Binomial

    found, table = with_one_confounder(20_000)

    def chance(x: Any) -> Any:
        return 1 / (1 + np.exp(-(x - 4) - table["c"]))

    drawn = np.random.default_rng(1).random(len(table)) < chance(table["x"])
    asked: Any = {"do": 5, "versus": 3, "method": "backdoor.generalized_linear_model"}
    made = estimate(found, table.assign(y=drawn), **asked, method_params={"glm_family": Binomial()})
    assert made.value == pytest.approx((chance(5) - chance(3)).mean(), abs=0.02)
    with pytest.raises(FunctionFailure, match=r"generalized_linear_model .*glm_family.* method_pa"):
        estimate(found, table, **asked)


def test_a_table_that_cannot_show_the_effect_is_refused() -> None:
    """A treatment without variation of its own, words as numbers, values of another kind."""
    found, table = with_one_confounder(50)
    for of, says in (
        (table.assign(x=3 * table["c"] + 2), "x is determined by c"),
        (table.assign(x=1.0), "x has one value"),
        (table.assign(y="high"), "needs numbers as values of y"),
        (table.set_axis(["c", "x", "x"], axis=1).assign(y=table["y"]), "of the same name"),
    ):
        with pytest.raises(ModelError, match=says):
            estimate(found, of, do=5, versus=3)
    for do in (float("nan"), "high", [5, 3]):
        with pytest.raises(UnknownOption, match="any finite number"):
            estimate(found, table, do=do, versus=3)
    dated = table.assign(x=np.datetime64("2026-01-01"))
    with pytest.raises(UnknownOption, match="it can be: 2026-01-01"):
        estimate(found, dated, do=1, versus=0)
