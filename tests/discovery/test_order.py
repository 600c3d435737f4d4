"""``do_order``: a graph from unpaired interventions with known targets."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from scm_world.discovery.data import Column, Dataset, Design, collect
from scm_world.discovery.learners import EstimatedGraph, learn
from scm_world.discovery.problems import problem
from scm_world.errors import ModelError, UnknownOption
from scm_world.graph import SCM
from scm_world.tasks.families import DONE, random_model
from scm_world.variables import Derived, Linear, Parent
from scm_world.variables.distributions import Normal

Edges = set[tuple[str, str, int]]
UNIT = Normal(mean=0.0, std=1.0)


def drawn(scm: SCM, n: int, seed: int, *, design: str = "single", seen: float = 2 / 22) -> Dataset:
    """Collect rows of a model without physics."""
    return collect(scm, Design(design, tuple(scm), DONE, seen), n, seed=seed)


def true_edges(scm: SCM) -> Edges:
    """List what the model declares."""
    return {edge.key for edge in scm.edges}


def wrong(scm: SCM, data: Dataset, **settings: Any) -> int:
    """Count missing and false edges."""
    return len(set(learn("do_order", data, **settings).directed) ^ true_edges(scm))


def chain(n: int = 800, seed: int = 0) -> tuple[np.ndarray[Any, Any], list[tuple[str, ...]]]:
    """Draw rows of a → b → c, with nothing or one of them set."""
    rng = np.random.default_rng(seed)
    targets = [((), ("a",), ("b",), ("c",))[i % 4] for i in range(n)]
    rows = np.zeros((n, 3))
    for row, done in zip(rows, targets, strict=True):
        for place, name in enumerate("abc"):
            caused = row[place - 1] if place else 0.0
            row[place] = rng.normal() + (2.0 if name in done else caused)
    return rows, targets


CHAIN: Edges = {("a", "b", 0), ("b", "c", 0)}


@pytest.mark.parametrize("seed", [0, 1])
def test_it_finds_every_edge_and_no_other(seed: int) -> None:
    """With 500 rows for each target the graph is exact."""
    scm = random_model("er2:20", seed)
    assert wrong(scm, drawn(scm, 11_000, seed)) == 0


@pytest.mark.parametrize("family", ["er2:20", "sf2:20"])
def test_a_tenth_of_the_rows_is_mostly_enough(family: str) -> None:
    """With 50 rows for each target, 5 of 6 graphs are exact and no one is far off."""
    found = []
    for seed in range(6):
        scm = random_model(family, seed)
        found.append(wrong(scm, drawn(scm, 1_100, seed)))
    assert sum(count == 0 for count in found) >= 5
    assert max(found) <= 3


@pytest.mark.parametrize("seed", [0, 1])
def test_half_of_the_variables_may_be_set_at_once(seed: int) -> None:
    """Random halves of the variables as targets tell the graph, too."""
    scm = random_model("er2:12", seed)
    assert wrong(scm, drawn(scm, 2_000, seed, design="half", seen=0.3)) <= 1


def projected(scm: SCM, targets: set[str]) -> Edges:
    """List pairs of a target and what it acts on directly or through variables that are none."""
    children: dict[str, list[str]] = {}
    for edge in scm.edges:
        children.setdefault(edge.cause, []).append(edge.effect)
    found: Edges = set()
    for cause in targets:
        left = list(children.get(cause, []))
        while left:
            effect = left.pop()
            if (cause, effect, 0) not in found:
                found.add((cause, effect, 0))
                left += [] if effect in targets else children.get(effect, [])
    return found


@pytest.mark.parametrize("share", [0.5, 0.75, 0.9])
def test_what_was_never_set_may_be_a_hidden_cause(share: float) -> None:
    """Edges are those of the latent projection: at most one in twenty is false, most are found."""
    false = found = there = 0
    for seed in range(4):
        scm = random_model("er2:16", seed)
        order = np.random.default_rng(seed).permutation(list(scm)).tolist()
        targets = tuple(order[: round(share * len(order))])
        data = collect(scm, Design("single", targets, DONE, 0.1), 2_400, seed=seed)
        edges = set(learn("do_order", data).directed)
        truth = projected(scm, set(targets))
        false, found, there = false + len(edges - truth), found + len(edges), there + len(truth)
    assert false <= 0.05 * found
    assert found - false >= 0.6 * there


def test_a_hidden_common_cause_makes_no_edge() -> None:
    """Of two effects of a hidden cause one is set: the other one does not follow it."""
    rng = np.random.default_rng(0)
    targets = [((), ("a",))[i % 2] for i in range(600)]
    u, noise = rng.normal(size=600), rng.normal(size=(600, 3))
    a = np.where([bool(t) for t in targets], noise[:, 0], 2.0 * u + noise[:, 0])
    b, m = 2.0 * u + noise[:, 1], a + 0.5 * noise[:, 2]
    data = Dataset.of(np.column_stack([a, b, m]), ["a", "b", "m"], targets=targets)
    found = learn("do_order", data)
    assert found.directed == (("a", "m", 0),)
    assert any("latent projection" in note for note in found.notes)


def test_what_is_always_set_together_is_not_told_apart() -> None:
    """If all are set or none is, no edge between them is claimed, and a note says why."""
    scm = random_model("er2:8")
    found = learn("do_order", drawn(scm, 1_000, 0, design="all", seen=0.3))
    assert found.directed == found.undirected == ()
    assert any("edges are not identified: " in note and "x0" in note for note in found.notes)


def test_what_is_always_set_together_still_has_effects() -> None:
    """Two causes that are set in the same rows both act on what is only watched."""
    rng = np.random.default_rng(0)
    causes = rng.normal(size=(400, 2))
    rows = np.column_stack([causes, causes.sum(axis=1) + rng.normal(size=400)])
    data = Dataset.of(rows, ["a", "b", "c"], targets=[("a", "b")] * 400)
    assert set(learn("do_order", data).directed) == {("a", "c", 0), ("b", "c", 0)}


def test_scales_do_not_matter() -> None:
    """Raw, standardised and stretched columns give the same edges."""
    scm = random_model("er2:12", 3)
    data = drawn(scm, 600, 3, seen=0.2)
    factors = 10.0 ** np.random.default_rng(0).uniform(-4.0, 4.0, len(data.names))
    stretched = replace(data, values=data.values * factors + 5.0 * factors)
    edges = learn("do_order", data).edges
    assert edges.any()
    for same in (data.standardised(), stretched):
        np.testing.assert_array_equal(learn("do_order", same).edges, edges)


def test_the_order_of_rows_does_not_matter() -> None:
    """Shuffled rows give the same graph, and the table is left as it was."""
    scm = random_model("er2:12", 4)
    data = drawn(scm, 600, 4, seen=0.2)
    before = data.values.copy()
    shuffled = data.rows(np.random.default_rng(1).permutation(len(data)))
    one, other = learn("do_order", data), learn("do_order", shuffled)
    np.testing.assert_array_equal(one.edges, other.edges)
    np.testing.assert_allclose(one.edge_scores, other.edge_scores, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(data.values, before)


def test_noise_has_no_edges() -> None:
    """In 50 tables of independent columns at most one edge is found, of 2,800 pairs."""
    names = [f"x{i}" for i in range(8)]
    targets = [() if i % 9 == 8 else (names[i % 9],) for i in range(300)]
    found = 0
    for seed in range(50):
        rows = np.random.default_rng(seed).normal(size=(300, 8))
        found += len(learn("do_order", Dataset.of(rows, names, targets=targets)).directed)
    assert found <= 1


def test_q_bounds_the_share_of_false_edges() -> None:
    """A generous q finds more false edges than a strict one, and few enough."""
    false, every = {0.001: 0, 0.3: 0}, {0.001: 0, 0.3: 0}
    for seed in range(12):
        scm = random_model("er2:12", seed)
        data = drawn(scm, 1_200, seed, seen=0.2)
        for q in false:
            found = set(learn("do_order", data, q=q).directed)
            false[q] += len(found - true_edges(scm))
            every[q] += len(found)
    assert false[0.001] < false[0.3] < 0.3 * every[0.3]
    assert false[0.001] <= 0.01 * every[0.001]


def test_what_is_only_watched_is_an_effect_only() -> None:
    """A column that is never a target causes nothing, though it does in truth."""
    rows, targets = chain()
    watched = [() if done == ("b",) else done for done in targets]
    free = rows[[done != ("b",) for done in targets]]
    kept = [done for done, given in zip(watched, targets, strict=True) if given != ("b",)]
    found = learn("do_order", Dataset.of(free, "abc", targets=kept))
    assert all(cause != "b" for cause, *_ in found.directed)
    assert ("a", "b", 0) in found.directed
    assert any("1 columns were never intervened on" in note for note in found.notes)


# --- time -----------------------------------------------------------------------------------------


def test_time_gives_lagged_edges() -> None:
    """Of a linear model through time every edge has its lag, whether something is set or not."""
    lines = {"a": (Parent("a", 1), 0.5), "b": (Parent("a", 1), 1.0), "c": ("b", -1.0)}
    scm = SCM(
        Derived(name=name, parents=(parent,), mechanism=Linear(weights=(weight,)), noise=UNIT)
        for name, (parent, weight) in lines.items()
    )
    design = Design("single", ("a", "b", "c"), DONE, 0.5)
    found = learn("do_order", collect(scm, design, 200, seed=0, steps=8))
    assert found.names == ("a", "b", "c")
    assert set(found.directed) == {("a", "a", 1), ("a", "b", 1), ("b", "c", 0)}
    seen = learn("do_order", collect(scm, Design(), 200, seed=0, steps=8))
    assert {("a", "a", 1), ("a", "b", 1)} <= set(seen.directed)


def test_saturating_mechanisms_through_time_are_mostly_found() -> None:
    """Watched only, nearly all lagged edges of a nonlinear model are found."""
    scm = random_model("tanh4:20")
    found = learn("do_order", collect(scm, Design(), 100, seed=0, steps=10))
    assert {lag for *_, lag in found.directed} == {1}
    assert len(set(found.directed) & true_edges(scm)) >= 0.9 * len(true_edges(scm))


# --- vectors --------------------------------------------------------------------------------------


def vectors(n: int = 400) -> Dataset:
    """Draw rows in which the second number of a vector v acts on y."""
    rng = np.random.default_rng(0)
    v, noise = rng.normal(size=(n, 3)), rng.normal(size=n)
    free = np.arange(n) % 2
    flat = Dataset.of(
        np.column_stack([v, free * v[:, 1] + noise]),
        ["v[0]", "v[1]", "v[2]", "y"],
        targets=[("v[0]", "v[1]", "v[2]") if is_free else ("y",) for is_free in free],
    )
    columns = [Column(f"v[{i}]", "v", i) for i in range(3)]
    regimes = tuple(
        replace(regime, targets=("v",) if "y" not in regime.targets else ("y",))
        for regime in flat.regimes[1:]
    )
    kept = (flat.regime - 1).astype(np.int64)
    return replace(flat, columns=(*columns, Column("y", "y")), regimes=regimes, regime=kept)


def test_a_vector_is_one_cause() -> None:
    """Its numbers are tested together."""
    data = vectors()
    found = learn("do_order", data)
    assert found.names == ("v", "y")
    assert found.directed == (("v", "y", 0),)
    assert not any("not identified" in note for note in found.notes)


# --- tables with faults ---------------------------------------------------------------------------


def of_chain(extra: Any, name: str = "d", also: str | None = None) -> EstimatedGraph:
    """Learn from the chain with a further column, set where another one is."""
    rows, targets = chain()
    if also is not None:
        targets = [(*done, name) if also in done else done for done in targets]
    table = np.column_stack([rows, extra])
    return learn("do_order", Dataset.of(table, [*"abc", name], targets=targets))


def test_a_constant_has_no_edges() -> None:
    """What never varies is noted, and does not disturb the rest."""
    found = of_chain(np.full(800, 3.0))
    assert set(found.directed) == CHAIN
    assert found.notes[0] == "never varied, no edges: d"


def test_an_exact_copy_that_is_watched_is_an_effect() -> None:
    """A copy of a column is its effect: nothing divides by zero."""
    found = of_chain(chain()[0][:, 0])
    assert set(found.directed) == {*CHAIN, ("a", "d", 0)}


def test_exact_copies_that_are_both_set_share_what_they_do() -> None:
    """Two equal columns cannot be told apart: neither edge between them, no other is made up."""
    found = of_chain(chain()[0][:, 0], also="a")
    assert set(found.directed) <= {*CHAIN, ("d", "b", 0)}
    assert ("b", "c", 0) in found.directed
    assert np.isfinite(found.edge_scores).all()


@pytest.mark.parametrize("n", [10, 31])
def test_fewer_rows_than_columns_prove_nothing(n: int) -> None:
    """Nothing is found, and a note says that there are too few rows."""
    names = [f"x{i}" for i in range(30)]
    rows = np.random.default_rng(0).normal(size=(n, 30))
    found = learn("do_order", Dataset.of(rows, names, targets=[(names[i % 30],) for i in range(n)]))
    assert found.directed == ()
    assert any("too few rows" in note for note in found.notes)


def test_a_single_column_has_no_edges() -> None:
    """One variable is a graph of one node."""
    found = learn("do_order", Dataset.of([[0.0], [1.0], [2.0], [4.0]], ["x"], targets=[("x",)] * 4))
    assert (found.names, found.directed) == (("x",), ())


@pytest.mark.parametrize("targets", [None, [("d",)] * 800])
def test_without_interventions_it_says_so(targets: Any) -> None:
    """Watching alone, or setting only what is constant, is refused."""
    table = Dataset.of(np.column_stack([chain()[0], np.ones(800)]), "abcd", targets=targets)
    with pytest.raises(ModelError, match="no variable that varies is a target"):
        learn("do_order", table)


@pytest.mark.parametrize("n", [0, 2])
def test_hardly_any_rows_are_refused(n: int) -> None:
    """It says how many there are."""
    rows, targets = chain()
    with pytest.raises(ModelError, match=f"needs some rows, got {n}|the table has {n} rows"):
        learn("do_order", Dataset.of(rows[:n], "abc", targets=targets[:n]))


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("q", 0.0), ("q", 1.0), ("q", float("nan")), ("q", -1),
    ],
)  # fmt: skip
def test_settings_are_checked(setting: str, value: Any) -> None:
    """A setting that is not allowed is named."""
    rows, targets = chain(8)
    with pytest.raises(UnknownOption, match=f"{setting} cannot be"):
        learn("do_order", Dataset.of(rows, "abc", targets=targets), **{setting: value})


def test_do_order_says_where_its_bound_does_not_hold() -> None:
    """On straight lines there is no note; on curves there is one."""
    notes: dict[str, Any] = {
        name: learn("do_order", problem(name).data("interventional", 3000, 0)).notes
        for name in ("er2:10", "tanh4:8")
    }
    assert not any("adds up" in note or "add up" in note for note in notes["er2:10"])
    assert any("add up to" in note for note in notes["tanh4:8"])
