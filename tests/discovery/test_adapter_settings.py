"""Learners of other libraries: their settings, their names, and what the documents say of them."""

from __future__ import annotations

from collections.abc import Sequence
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world.discovery.data.dataset import Dataset
from scm_world.discovery.learners import EstimatedGraph, learn, learners, registry
from scm_world.discovery.learners.known import OTHERS
from scm_world.errors import MissingExtra, UnknownOption

DEFAULTS = {
    each.name: {
        setting: what.default
        for setting, what in signature(each.learn).parameters.items()
        if setting not in ("data", "seed")
    }
    for each in OTHERS
}
DATA = Dataset.of(np.random.default_rng(0).normal(size=(50, 3)).cumsum(axis=1), list("xyz"))


@pytest.mark.parametrize("name", [*DEFAULTS, "do_order", "pooled"])
def test_settings_are_checked(name: str) -> None:
    """An unknown setting is refused with those there are, before the data are looked at."""
    with pytest.raises(UnknownOption, match=r"no setting of .* is named 'alhpa'") as caught:
        learn(name, DATA, alhpa=1)
    assert set(DEFAULTS.get(name, ())) <= set(caught.value.choices)


@pytest.mark.parametrize(
    ("name", "settings", "said"),
    [
        ("pc", {"alpha": 1.5}, "alpha of 'pc' cannot be 1.5; it can be: a number between 0 and 1"),
        ("pc", {"alpha": True}, "between 0 and 1"),
        ("pc", {"depth": -1}, "any whole number from 0 on"),
        ("pc", {"stable": 1}, "a yes or no"),
        ("ges", {"penalty": 0}, "a number above 0"),
        ("grasp", {"depth": None}, "any whole number from 1 on"),
        ("gies", {"phases": ["sideways"]}, "a list of forward, backward, turning"),
        ("gies", {"intercept": "none"}, "regime, shared"),
        ("pcmci+", {"tau_max": 0}, "any whole number from 1 on"),
    ],
)
def test_values_of_settings_are_checked(name: str, settings: dict[str, Any], said: str) -> None:
    """A value that is not allowed is told with what is."""
    run = next(each.learn for each in OTHERS if each.name == name)
    with pytest.raises(UnknownOption, match=said):
        run(DATA, **settings)


def test_settings_are_used_and_noted() -> None:
    """A heavy penalty leaves no edge, and the result says what it was made with."""
    pytest.importorskip("gies")
    found = learn("gies", DATA, penalty=1000.0, phases=["forward"])
    assert not found.edges.any()
    assert found.settings == {
        "penalty": 1000.0,
        "phases": ["forward"],
        "iterate": True,
        "intercept": "regime",
    }
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
    found = learn(f"{__name__}:own", DATA, factor=2.0)
    assert found.directed == (("x", "y", 0),)
    assert found.settings == {"factor": 2.0}


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
