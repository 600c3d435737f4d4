"""``do_gp`` on nonlinear mechanisms, the families it is compared on, and how they can be sorted."""

from collections import Counter

import numpy as np
import pytest

from scm_world.discovery.data import Dataset, Design, collect
from scm_world.discovery.learners import learn, learner
from scm_world.discovery.metrics import evaluate, sortability
from scm_world.graph import from_json, to_json
from scm_world.tasks.families import DONE, FAMILIES, random_model

NONLINEAR = ("mlp2", "gp2", "sine2")


def table(name: str, seed: int, each: int) -> tuple[list[tuple[str, str, int]], Dataset]:
    """Collect rows for each variable set to N(2, 1), and twice as many with nothing done."""
    scm = random_model(name, seed)
    n = each * (len(scm) + 2)
    design = Design("single", tuple(scm), DONE, 2 * each / n)
    return [edge.key for edge in scm.edges], collect(scm, design, n, seed=seed)


@pytest.mark.parametrize("family", NONLINEAR)
def test_curves_are_found_where_lines_are_not(family: str) -> None:
    """Fewer wrong edges than with lines, over two models."""
    wrong = {"do_gp": 0, "do_order": 0}
    for seed in (1000, 1001):
        truth, data = table(f"{family}:6", seed, 40)
        for name in wrong:
            wrong[name] += evaluate(learn(name, data), truth, names=data.names).shd
    assert wrong["do_gp"] < 0.5 * wrong["do_order"]


def test_causes_that_act_only_together_are_found() -> None:
    """A product has no effect of either factor alone."""
    rng = np.random.default_rng(0)
    x, y, set_ = *rng.normal(size=(2, 600)), np.repeat(["", "x", "y"], 200)
    z = x * y + 0.3 * rng.normal(size=600)
    targets = [(name,) if name else () for name in set_]
    data = Dataset.of(np.stack([x, y, z], axis=1), ["x", "y", "z"], targets=targets)
    assert learn("do_gp", data).directed == (("x", "z", 0), ("y", "z", 0))


def test_few_rows_give_a_note_and_few_edges() -> None:
    """With five rows for each target there are not more false edges than true ones, and a note."""
    truth, data = table("mlp2:10", 1000, 5)
    found = learn("do_gp", data)
    assert any("rows are few for 10 columns" in note for note in found.notes)
    assert evaluate(found, truth, names=data.names).precision >= 0.5


def test_nothing_is_found_in_noise() -> None:
    """An edge has to bring more than what chance would."""
    rng = np.random.default_rng(1)
    targets = [()] * 100 + [("a",)] * 50 + [("b",)] * 50
    data = Dataset.of(rng.normal(size=(200, 6)), list("abcdef"), targets=targets)
    found = learn("do_gp", data)
    assert not found.edges.any()
    assert "4 columns were never set: only curvature shows their directions" in found.notes


def test_the_past_has_no_causes_in_the_present() -> None:
    """Over time, edges lead onward."""
    rng = np.random.default_rng(2)
    x = np.zeros((400, 2))
    for t in range(1, 400):
        x[t, 0] = np.sin(2.0 * x[t - 1, 1]) + 0.3 * rng.normal()
        x[t, 1] = 0.5 * x[t - 1, 1] + rng.normal()
    data = Dataset.of(x, ["x", "y"], episode=np.zeros(400, int), step=np.arange(400))
    assert set(learn("do_gp", data).directed) == {("y", "x", 1), ("y", "y", 1)}


@pytest.mark.parametrize("name", ["do_gp", "do_order", "gies", "gies_shared", "boss"])
def test_units_mean_nothing(name: str) -> None:
    """Raw and standardised rows give one graph."""
    if not learner(name).is_installed:
        pytest.skip(f"{name} is not installed")
    _, data = table("mlp2:6", 3, 30)
    scaled = Dataset.of(
        data.values * np.logspace(-3, 3, 6) + 5.0,
        data.names,
        targets=[regime.targets for regime in (data.regimes[i] for i in data.regime)],
    )
    np.testing.assert_array_equal(learn(name, data).edges, learn(name, scaled).edges)


@pytest.mark.parametrize("family", FAMILIES)
def test_families_survive_their_file(family: str) -> None:
    """A model has the same graph and the same rows after a round trip."""
    scm = random_model(f"{family}:6", 1)
    again = from_json(to_json(scm), trusted=("scm_world.tasks.families",))
    assert [edge.key for edge in again.edges] == [edge.key for edge in scm.edges]
    steps = {"steps": 2} if family == "tanh4" else {}
    rows, others = (collect(one, Design(), 20, seed=4, **steps).values for one in (scm, again))
    np.testing.assert_array_equal(rows, others)
    assert np.isfinite(rows).all()


def test_hubs_are_causes_or_effects() -> None:
    """Of scale-free graphs, the largest number of edges leaves a node, or enters one."""
    for family, end in (("sf2", 0), ("sf2in", 1)):
        edges = [edge.key for edge in random_model(f"{family}:60", 0).edges]
        most = [max(Counter(edge[k] for edge in edges).values()) for k in (0, 1)]
        assert most[end] > 2 * most[1 - end]


def test_standardised_models_cannot_be_sorted_by_variance() -> None:
    """Every variable of iSCM has variance 1; those of other linear models grow along paths."""
    found = {}
    for family in ("er2", "iscm2"):
        scm = random_model(f"{family}:20", 0)
        data = collect(scm, Design(), 4000, seed=0)
        found[family] = sortability(data, [edge.key for edge in scm.edges])["variance"]
        if family == "iscm2":
            np.testing.assert_allclose(data.values.var(axis=0), 1.0, atol=0.12)
    assert found["er2"] > 0.9
    assert 0.2 < found["iscm2"] < 0.8
