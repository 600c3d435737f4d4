"""Learners of other libraries: their settings, their names, and what the documents say of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from inspect import signature
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world import SCM, Derived, Linear
from scm_world.discovery.data import Column, Design, collect
from scm_world.discovery.data.dataset import Dataset
from scm_world.discovery.learners import EstimatedGraph, learn, learners, registry
from scm_world.discovery.learners.known import OTHERS
from scm_world.errors import MissingExtra, UnknownOption
from scm_world.variables import Normal

DEFAULTS = {
    each.name: {
        setting: what.default
        for setting, what in signature(each.learn).parameters.items()
        if setting not in ("data", "seed")
    }
    for each in OTHERS
}
DATA = Dataset.of(np.random.default_rng(0).normal(size=(50, 3)).cumsum(axis=1), list("xyz"))


@pytest.mark.parametrize("name", [*DEFAULTS, "do_order", "paired"])
def test_settings_are_checked(name: str) -> None:
    """An unknown setting is refused with those there are, before the data are looked at."""
    with pytest.raises(UnknownOption, match=r"no setting of .* is named 'alhpa'") as caught:
        learn(name, DATA, alhpa=1)
    assert set(DEFAULTS.get(name, ())) <= set(caught.value.choices)


@pytest.mark.parametrize(
    ("name", "settings", "said"),
    [
        ("pc", {"alpha": 1.5}, "alpha of 'pc' cannot be 1.5; it can be: a number between 0 and 1"),
        ("pc", {"alpha": True}, "any finite number"),
        ("ges", {"penalty": 0}, "a number above 0"),
        ("grasp", {"penalty": None}, "any finite number"),
        ("gies", {"intercept": "none"}, "regime, shared"),
        ("pcmci+", {"tau_max": 0}, "any whole number from 1 to"),
    ],
)
def test_values_of_settings_are_checked(name: str, settings: dict[str, Any], said: str) -> None:
    """A value that is not allowed is told with what is."""
    run = learners()[name].learn
    with pytest.raises(UnknownOption, match=said):
        run(DATA, **settings)


def test_settings_are_used_and_noted() -> None:
    """A heavy penalty leaves no edge, and the result says what it was made with."""
    pytest.importorskip("gies")
    found = learn("gies", DATA, penalty=1000.0)
    assert not found.edges.any()
    assert found.settings == {"penalty": 1000.0, "intercept": "regime"}
    assert EstimatedGraph.from_dict(found.as_dict()).settings == found.settings


@pytest.mark.parametrize("each", OTHERS, ids=lambda each: each.name)
def test_what_is_missing_is_named(each: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the library, the message says how to install it."""
    monkeypatch.setattr(registry.Learner, "version", None)
    with pytest.raises(MissingExtra, match=rf"pip install 'scm-world\[{each.extra}\]'"):
        learn(each.name, DATA)


def own(data: Dataset, *, seed: int = 0, factor: float = 1.0) -> Sequence[Sequence[float]]:
    """Learn nothing: the first column acts on the second."""
    return [[0.0, factor, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]


def test_a_learner_of_ones_own() -> None:
    """A function somewhere is a learner, by the name of its module and its own."""
    found = learn(f"{__name__}:own", DATA, shuffle=False, factor=2.0)
    assert found.directed == (("x", "y", 0),)
    assert found.settings == {"factor": 2.0}


def seen(data: Dataset, *, seed: int = 0) -> Any:
    """Return a graph whose note lists the columns in the order in which they are seen."""
    matrix = np.triu(np.ones((len(data.names),) * 2), 1)
    return EstimatedGraph.of(data.names, matrix, notes=(" ".join(data.names),))


def test_learners_see_columns_in_an_order_drawn_from_the_seed() -> None:
    """The graph has them in the order of the table, which ``shuffle=False`` keeps."""
    table = Dataset.of(np.random.default_rng(0).normal(size=(9, 6)), "abcdef")
    found = [learn(f"{__name__}:seen", table, seed=seed) for seed in (0, 0, 1, 2, 3)]
    orders = [graph.notes[0].split() for graph in found]
    assert orders[0] == orders[1]
    assert len({*map(tuple, orders)}) == 4
    for graph, order in zip(found, orders, strict=True):
        assert graph.names == table.names
        assert {(c, e) for c, e, _ in graph.directed} == {*combinations(order, 2)}
    kept = learn(f"{__name__}:seen", table, shuffle=False)
    assert kept.notes[0] == "a b c d e f"
    with pytest.raises(UnknownOption, match="seed"):
        learn("empty", table, seed=-1)


def test_an_order_of_columns_in_time_is_drawn_too() -> None:
    """Earlier columns follow; vectors and lags are taken together as without."""
    values = np.random.default_rng(0).normal(size=(40, 3))
    columns = (Column("v[0]", "v", 0), Column("v[1]", "v", 1), Column("y", "y"))
    table = replace(
        Dataset.of(values, "abc", episode=np.repeat([0, 1], 20), step=[*range(20)] * 2),
        columns=columns,
    )
    assert learn("bipartite", table).names == ("v", "y")
    drawn = learn("do_order", table).edges
    assert (drawn == learn("do_order", table, shuffle=False).edges).all()


def test_declaration_is_no_hint() -> None:
    """A baseline that looks at no data does not read the causal order off the columns."""
    one = Linear(weights=(1.0,))
    line = [Derived(name="a", parents=(), mechanism=Linear(weights=()), noise=Normal())]
    line += [
        Derived(name=effect, parents=(cause,), mechanism=one, noise=Normal())
        for cause, effect in pairwise("abcdef")
    ]
    table = collect(SCM(line), Design(), 30)
    true = {(cause, effect, 0) for cause, effect in pairwise("abcdef")}
    found = [{*learn("bipartite", table, seed=seed).directed} for seed in range(20)]
    assert 1.0 < np.mean([len(true & edges) for edges in found]) < 4.0
    assert true <= {*learn("bipartite", table, shuffle=False).directed}


def test_the_document_lists_them() -> None:
    """``docs/learners.md`` has a row for each, with all its settings and their defaults."""
    text = (Path(__file__).parents[2] / "docs" / "learners.md").read_text()
    rows = {line.split("`")[1]: line for line in text.splitlines() if line.startswith("| `")}
    assert set(DEFAULTS) <= set(rows)
    assert set(DEFAULTS) <= set(learners())
    for name, settings in DEFAULTS.items():
        for setting, value in settings.items():
            default = list(value) if isinstance(value, tuple) else value
            assert f"`{setting}` {default}" in rows[name], (name, setting)
