"""Learners of other libraries: what they find, and what they do with awkward data."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from scm_world.discovery.data import as_gies
from scm_world.discovery.data.dataset import Dataset
from scm_world.discovery.learners import EstimatedGraph, learn, libraries
from scm_world.discovery.learners.known import OTHERS
from scm_world.discovery.problems import problem
from scm_world.errors import ModelError
from scm_world.graph.ancestral import TAIL

MODULES = {"causal-learn": "causallearn"}
NEEDS = {each.name: MODULES.get(each.package, each.package) for each in OTHERS}
STATIC = ["pc", "ges", "boss", "grasp", "gies"]
COLLIDER = {("a", "c", 0), ("b", "c", 0), ("c", "d", 0)}


@pytest.fixture(params=STATIC)
def static(request: pytest.FixtureRequest) -> str:
    """Name each learner of static graphs that is installed."""
    pytest.importorskip(NEEDS[request.param])
    return str(request.param)


def collider(n: int = 2000, seed: int = 0) -> np.ndarray:
    """Draw a → c ← b and c → d, shape (n, 4); its equivalence class has no other member."""
    a, b, noise, other = np.random.default_rng(seed).normal(size=(4, n))
    c = a + b + noise
    return np.stack([a, b, c, 0.8 * c + other], axis=1)


def chain(target: str | None, n: int = 300, seed: int = 0) -> tuple[np.ndarray, list[tuple[str]]]:
    """Draw x → y → z, with one of them set to random values, and the targets of the rows."""
    x, y_noise, z_noise, given = np.random.default_rng(seed).normal(size=(4, n))
    x = 2.0 + given if target == "x" else x
    y = 2.0 + given if target == "y" else x + y_noise
    z = 2.0 + given if target == "z" else y + z_noise
    return np.stack([x, y, z], axis=1), [() if target is None else (target,)] * n


def chains(*targets: str | None) -> Dataset:
    """Put chains under several regimes below one another."""
    parts = [chain(target, seed=seed) for seed, target in enumerate(targets)]
    return Dataset.of(
        np.concatenate([values for values, _ in parts]),
        ["x", "y", "z"],
        targets=[target for _, rows in parts for target in rows],
    )


def series(episodes: int = 15, steps: int = 40, seed: int = 0) -> Dataset:
    """Draw episodes of x → y one step later, y → z ← w at once, and a constant k → y of each."""
    draw = np.random.default_rng(seed)
    rows, episode, step = [], [], []
    for number in range(episodes):
        k, x, y = float(draw.normal()), 0.0, 0.0
        for t in range(steps):
            noise = draw.normal(size=4)
            y = 0.8 * x + k + noise[1]
            x = 0.5 * x + noise[0]
            w = noise[3]
            rows.append([k, x, y, 0.9 * y + 0.9 * w + 0.5 * noise[2], w])
            episode.append(number)
            step.append(t)
    return Dataset.of(rows, ["k", "x", "y", "z", "w"], episode=episode, step=step)


def edges(found: EstimatedGraph) -> set[tuple[str, str, int]]:
    """Give all edges; those without direction both ways."""
    names = found.names
    return {(names[i], names[j], lag) for lag, i, j in np.argwhere(found.edges).tolist()}


def told(found: EstimatedGraph, *words: str) -> bool:
    """Tell whether some note holds all these words."""
    return any(all(word in note for word in words) for note in found.notes)


def pairs(hidden: bool, n: int = 4000) -> Dataset:
    """Draw x → a, y → b and a common cause of a and b, which is no column if it is hidden."""
    x, y, h, one, two = np.random.default_rng(3).normal(size=(5, n))
    columns = [x, x + h + one, y + h + two, y] + [h] * (not hidden)
    return Dataset.of(np.stack(columns, axis=1), list("xaby") + ["h"] * (not hidden))


# --- what they find ----------------------------------------------------------------------------


def test_a_collider_is_found(static: str) -> None:
    """Where tests or scores can tell the whole graph, it is found with all directions."""
    found = learn(static, Dataset.of(collider(), list("abcd")), shuffle=False)
    assert set(found.directed) == COLLIDER
    assert found.undirected == ()
    assert found.learner == static
    assert list(found.versions) == [next(o.package for o in OTHERS if o.name == static)]


def test_a_chain_has_no_direction_without_interventions(static: str) -> None:
    """What only an intervention could tell stays open."""
    found = learn(static, chains(None, None, None))
    assert set(found.undirected) == {("x", "y"), ("y", "z")}
    assert found.directed == ()
    np.testing.assert_array_equal(found.edge_scores, found.edge_scores.transpose(0, 2, 1))


def test_interventions_direct_a_chain() -> None:
    """GIES finds the directions that interventions tell, as its own entry point does."""
    package = pytest.importorskip("gies")
    data = chains(None, "x", "y", "z")
    found = learn("gies", data)
    assert found.directed == (("x", "y", 0), ("y", "z", 0))
    parts, targets = as_gies(data)
    graph, _ = package.fit_bic(parts, targets)
    np.testing.assert_array_equal(found.edges[0], graph != 0)


def test_a_shared_intercept_uses_means() -> None:
    """A cause that varies between regimes only is found with one intercept for all of them."""
    pytest.importorskip("gies")
    rng = np.random.default_rng(0)
    x = 0.01 * rng.normal(size=400)
    x[200:] = 3.0
    y = x + rng.normal(size=400)
    targets = [()] * 200 + [("x",)] * 200
    data = Dataset.of(np.stack([x, y], axis=1), ["x", "y"], targets=targets)
    assert not learn("gies", data).edges.any()
    assert learn("gies_shared", data).directed == (("x", "y", 0),)


def test_a_hidden_cause_is_two_heads() -> None:
    """FCI tells a <-> b from edges; with the cause in the table there is none. Marks are kept."""
    pytest.importorskip("causallearn")
    found = learn("fci", pairs(hidden=True), alpha=0.001)
    assert found.words == ("x o-> a", "a <-> b", "b <-o y")
    assert (found.directed, found.undirected) == ((("x", "a", 0), ("y", "b", 0)), ())
    assert EstimatedGraph.from_dict(found.as_dict()).words == found.words
    assert learn("fci", pairs(hidden=False), alpha=0.001).words == (
        "x o-> a", "a <-o h", "b <-o y", "b <-o h"
    )  # fmt: skip


def test_a_hidden_series_is_two_heads() -> None:
    """LPCMCI tells a series that moves two others; the later ends of lagged edges are heads."""
    pytest.importorskip("tigramite")
    draw = np.random.default_rng(1).normal(size=(5, 1500))
    rows = np.zeros((1500, 4))
    hidden = np.zeros(1500)
    for t in range(1, 1500):
        hidden[t] = 0.3 * hidden[t - 1] + draw[0, t]
        rows[t] = 0.6 * rows[t - 1] + draw[1:, t]
        rows[t, 1:3] += hidden[t]
        rows[t, 1] += 0.7 * rows[t - 1, 0]
        rows[t, 2] += 0.7 * rows[t - 1, 3]
    data = Dataset.of(rows, list("xaby"), episode=[0] * 1500, step=range(1500))
    found = learn("lpcmci", data, alpha=0.001)
    assert "a <-> b" in found.words
    assert {"x@-1 o-> a", "y@-1 o-> b"} <= set(found.words)
    assert found.marks is not None
    assert found.marks.shape == (2, 4, 4)
    assert ("a", "b", 0) not in learn("lpcmci", data).directed


def test_a_hidden_circumstance_is_told() -> None:
    """J-PCMCI+ conditions on what differs between episodes, and names what it acts on."""
    pytest.importorskip("tigramite")
    data = series(episodes=15)
    hidden = data.hide(["k"])
    found = learn("j-pcmci+", hidden)
    assert told(found, "unmeasured variable acts on y", "between episodes")
    assert ("x", "y", 1) in found.directed
    assert ("k", "y", 1) in learn("j-pcmci+", data).directed
    with pytest.raises(ModelError, match="two or more"):
        learn("j-pcmci+", hidden.rows(hidden.episode == 0))


def test_unknown_targets_are_found() -> None:
    """PermScore finds the graph and what was set, of which it is told nothing."""
    pytest.importorskip("permscore")
    made = problem("er2:6", seed=1)
    table = made.data("interventional", 600, 0)
    found = learn("permscore", table)
    assert set(found.directed) == set(made.truth.edges)
    assert found.targets == tuple(regime.targets for regime in table.regimes)
    assert EstimatedGraph.from_dict(found.as_dict()).targets == found.targets
    wrong = tuple(replace(r, targets=("x0",) * bool(r.targets)) for r in table.regimes)
    blind = learn("permscore", replace(table, regimes=wrong))
    assert (blind.targets, blind.words) == (found.targets, found.words)
    assert (blind.edge_scores == found.edge_scores).all()
    with pytest.raises(ModelError, match="at least one other regime"):
        learn("permscore", table.observational)


def test_surer_edges_explain_more() -> None:
    """An edge with ten times the weight is surer; where there is no edge, nothing is."""
    draw = np.random.default_rng(0).normal(size=(3, 1000))
    effect = 2.0 * draw[0] + 0.2 * draw[1] + draw[2]
    data = Dataset.of(np.stack([draw[0], draw[1], effect], axis=1), ["strong", "weak", "effect"])
    graph = np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]], dtype=bool)
    gain = libraries.likelihood_gain(data, graph)
    assert gain[0, 2] > gain[1, 2] > 0.0
    assert (gain[~graph] == 0.0).all()
    for kept, left in ((0, 1), (1, 0)):  # the same by two regressions
        rest = [_squares(data.values[:, which], effect) for which in ([0, 1], [kept])]
        assert gain[left, 2] == pytest.approx(500.0 * np.log(rest[1] / rest[0]))


def _squares(causes: np.ndarray, effect: np.ndarray) -> float:
    design = np.column_stack([np.ones(len(effect)), causes])
    return float(np.linalg.lstsq(design, effect, rcond=None)[1][0])


def test_time_is_used() -> None:
    """PCMCI+ finds what acts within the instant and what acts one control step later."""
    pytest.importorskip("tigramite")
    found = learn("pcmci+", series(), alpha=0.001)
    assert edges(found) == {
        ("k", "y", 1),
        ("x", "x", 1),
        ("x", "y", 1),
        ("y", "z", 0),
        ("w", "z", 0),
    }
    at = found.names.index
    assert found.edge_scores[1, at("x"), at("y")] > 10.0
    assert found.edge_scores[0, at("z"), at("y")] == 0.0


def test_rows_that_do_not_follow_one_another_are_cut() -> None:
    """A gap in time begins another run, and so does another episode."""
    data = Dataset.of(np.arange(5.0)[:, None], ["x"], episode=[0, 0, 0, 1, 1], step=[0, 1, 3, 0, 1])
    assert [part[:, 0].tolist() for part in libraries.runs(data)] == [[0, 1], [2], [3, 4]]


def test_the_past_comes_first(static: str) -> None:
    """Learners without time get earlier rows as columns, and nothing acts on the past."""
    found = learn(static, series(40))
    assert {("x", "x", 1), ("x", "y", 1), ("y", "z", 0), ("w", "z", 0), ("k", "y", 1)} <= edges(
        found
    )
    assert told(found, "other columns determine", "k")


def test_pc_knows_the_past() -> None:
    """That nothing acts on the past also directs an edge within the instant."""
    pytest.importorskip("causallearn")
    draw = np.random.default_rng(0)
    x = [0.0]
    for _ in range(2000):
        x.append(0.7 * x[-1] + draw.normal())
    values = np.stack([x, x + draw.normal(size=len(x))], axis=1)
    data = Dataset.of(values, ["x", "y"], episode=[0] * len(x), step=range(len(x)))
    assert learn("pc", data).directed == (("x", "y", 0), ("x", "x", 1))


@pytest.mark.parametrize("name", ["fci", "lpcmci"])
def test_the_order_of_time_makes_no_tail(name: str) -> None:
    """A hidden cause of x now and y later: o->, and <-> where an instrument of x tells so."""
    pytest.importorskip("causallearn" if name == "fci" else "tigramite")
    u, x, y, z = np.random.default_rng(4).normal(size=(4, 4001))
    x, y = x + u, y + np.roll(u, 1)
    for columns, word in (((x, y), "x@-1 o-> y"), ((x + 1.5 * z, y, z), "x@-1 <-> y")):
        rows = np.stack(columns, axis=1)[1:]
        table = Dataset.of(rows, list("xyz")[: len(columns)], episode=[0] * 4000, step=range(4000))
        found = learn(name, table, alpha=0.001)
        assert word in found.words
        assert found.marks is not None
        assert not (found.marks == TAIL).any()


# --- reading their graphs ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("marks", "expected"),
    [((-1, 1), ">"), ((-1, -1), "-"), ((1, 1), "-"), ((2, 1), ">"), ((2, 2), "-"), ((0, 0), "")],
)
def test_end_marks(marks: tuple[int, int], expected: str) -> None:
    """-->, ---, <->, o->, o-o and no edge of causal-learn."""
    found = libraries.edges_of_marks([[0, marks[0]], [marks[1], 0]])
    assert found.tolist() == [[False, expected != ""], [expected == "-", False]]


@pytest.mark.parametrize(
    ("words", "expected"),
    [("--> <--", ">"), ("o-o o-o", "-"), ("x-x x-x", "-"), ("<-> <->", "-"), ("o-> <-o", ">")],
)
def test_links(words: str, expected: str) -> None:
    """All links within the instant that tigramite knows."""
    there, back = words.split()
    marks = libraries.marks_of_links([[[""], [there]], [[back], [""]]])
    found = libraries.edges_of_marks(marks)
    assert found.tolist() == [[[False, True], [expected == "-", False]]]


# --- awkward data --------------------------------------------------------------------------------


def test_marks_of_vectors_and_of_the_past() -> None:
    """Columns of a variable have one mark at each end, a circle where theirs differ."""
    pytest.importorskip("causallearn")
    data = series(episodes=40, steps=30)
    found = learn("fci", data.select(["x", "y", "z", "w"]))
    assert found.marks is not None
    assert found.marks.shape == (2, 4, 4)
    assert any(word.startswith("x@-1") and word.endswith("> y") for word in found.words)
    table = pairs(hidden=True)
    both = tuple(
        replace(column, name=f"v[{i}]", variable="v", component=i)
        for i, column in enumerate(table.columns[1:3])
    )
    vector = replace(table, columns=(table.columns[0], *both, table.columns[3]))
    assert learn("fci", vector, alpha=0.001).words == ("x o-> v", "v <-o y")


@pytest.mark.parametrize("name", NEEDS)
def test_the_same_seed_gives_the_same(name: str) -> None:
    """Results are bit-equal, and the global generators of the caller are not touched."""
    pytest.importorskip(NEEDS[name])
    data = chains(None, "x", "y") if name == "permscore" else series(10)
    before = random.getstate(), np.random.get_state()[1].tolist()  # noqa: NPY002 # must not change
    found = [learn(name, data, seed=5) for _ in range(2)]
    assert found[0].edges.tobytes() == found[1].edges.tobytes()
    assert found[0].edge_scores.tobytes() == found[1].edge_scores.tobytes()
    assert (random.getstate(), np.random.get_state()[1].tolist()) == before  # noqa: NPY002


@pytest.mark.parametrize("name", ["boss", "grasp"])
def test_the_seed_is_used(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Learners that draw are seeded with what was given."""
    pytest.importorskip(NEEDS[name])
    seeds: list[int] = []
    seed = random.seed
    monkeypatch.setattr(random, "seed", lambda given: (seeds.append(given), seed(given)))
    learn(name, Dataset.of(collider(200), list("abcd")), seed=7)
    assert 7 in seeds


def test_columns_that_cannot_be_used(static: str) -> None:
    """Constant columns, and those that columns on their left determine, have no edges."""
    values = collider()
    a, b, c, d = values.T
    wide = np.stack([np.full(len(a), 3.0), a, b, c, d, -2.0 * c, a + b + 1.0], axis=1)
    table = Dataset.of(wide, ["constant", *"abcd", "copy", "sum"])
    found = learn(static, table, shuffle=False)
    assert set(found.directed) == COLLIDER
    assert found.names == ("constant", *"abcd", "copy", "sum")
    assert told(found, "do not vary", "constant")
    assert told(found, "other columns determine", "copy", "sum")


@pytest.mark.parametrize("name", sorted(NEEDS.keys() - {"permscore", "j-pcmci+"}))
def test_nothing_varies(name: str) -> None:
    """A table of constants has no edges, and neither has one with a single column."""
    pytest.importorskip(NEEDS[name])
    assert not learn(name, Dataset.of(np.ones((20, 3)), list("abc"))).edges.any()
    ramp = Dataset.of(np.arange(20.0)[:, None] % 7, ["x"], episode=[0] * 20, step=range(20))
    assert not learn(name, ramp).edges[0].any()


def test_vectors_and_integers(static: str) -> None:
    """Numbers of a vector are taken together, integers are taken as they are, with a note."""
    data = Dataset.of(collider().round(), list("abcd"))
    a, b, c, d = data.columns
    pair = tuple(
        replace(column, name=f"v[{i}]", variable="v", component=i)
        for i, column in enumerate((a, b))
    )
    typed = replace(data, columns=(*pair, c, replace(d, dtype="integer")))
    found = learn(static, typed)
    assert edges(found) == {("v", "c", 0), ("c", "d", 0)}
    assert told(found, "real numbers", "d")


def test_units_do_not_matter(static: str) -> None:
    """Columns in other units give the same graph."""
    values = collider()
    scaled = values * [1e-6, 1.0, 1e3, 1e6] + [5.0, 0.0, -1e4, 0.0]
    tables = [Dataset.of(rows, list("abcd")) for rows in (values, scaled)]
    found = [learn(static, table, shuffle=False) for table in tables]
    np.testing.assert_array_equal(found[0].edges, found[1].edges)


@pytest.mark.parametrize("name", ["pc", "ges", "boss", "grasp", "fci", "pcmci+", "lpcmci"])
def test_observational_learners_leave_interventions_out(name: str) -> None:
    """They see the rows in which nothing is done, say so, and refuse if there are none."""
    pytest.importorskip(NEEDS[name])
    data = chains(None, "x")
    if "pcmci" not in name:
        found = learn(name, data)
        assert told(found, "300 of 600 rows were left out")
        np.testing.assert_array_equal(found.edges, learn(name, data.observational).edges)
    with pytest.raises(ModelError, match="something is done, and has no other rows"):
        learn(name, chains("x", "y"))


def test_too_few_rows(static: str) -> None:
    """Fewer rows than columns are refused."""
    with pytest.raises(ModelError, match="more rows than columns; there are 4 rows and 4 columns"):
        learn(static, Dataset.of(collider(4), list("abcd")))


def test_too_short_episodes() -> None:
    """PCMCI+ needs rows that follow one another."""
    pytest.importorskip("tigramite")
    with pytest.raises(ModelError, match="needs more than 8 rows with 2 rows before them"):
        learn("pcmci+", Dataset.of(collider(100), list("abcd")))


def test_what_varies_only_where_it_is_set() -> None:
    """GIES can use a parameter at its default, though where it is set its effects may be, too."""
    pytest.importorskip("gies")
    (height, noise), zero = np.random.default_rng(0).normal(size=(2, 300)), np.zeros(300)
    mass = np.tile([-1.0, 1.0], 150)  # of mean 0, so that the default stays exactly the same
    seen = np.stack([zero, noise, noise + height], axis=1)
    alone = np.stack([mass, mass + noise, mass + noise + height], axis=1)
    both = np.stack([mass, height, height + noise], axis=1)
    targets = [[each] * 300 for each in ((), ("mass",), ("mass", "speed"))]
    for parts, mass_acts in (((0, 1, 2), True), ((0, 2), False)):
        values = np.concatenate([(seen, alone, both)[part] for part in parts])
        rows = [target for part in parts for target in targets[part]]
        found = learn("gies", Dataset.of(values, ["mass", "speed", "height"], targets=rows))
        assert found.directed[-1] == ("speed", "height", 0)
        assert (("mass", "speed", 0) in found.directed) is mass_acts
        assert found.undirected == ()


def test_a_column_that_is_always_set() -> None:
    """GIES refuses a column that is set in every row, by its name."""
    pytest.importorskip("gies")
    with pytest.raises(ModelError, match="'x' is set in every row"):
        learn("gies", chains("x"))


def test_what_a_library_refuses_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Faults of a library come as our error, with what it said."""
    package = pytest.importorskip("gies")

    def fit(*_: Any, **__: Any) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(package, "fit", fit)
    with pytest.raises(ModelError, match=r"library behind 'gies'.*Singular matrix"):
        learn("gies", chains(None))


def test_they_are_silent(static: str, capfd: pytest.CaptureFixture[str]) -> None:
    """Nothing is printed, and no warning leaks (pytest would raise it)."""
    learn(static, Dataset.of(collider(200), list("abcd")))
    assert capfd.readouterr() == ("", "")
