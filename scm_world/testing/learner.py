"""A conformance suite for learners of causal graphs.

Subclass it in a test file, name the learner, and pytest runs the rest::

    class TestMine(LearnerConformance):
        learner = "my_package.my_module:my_learner"
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from scm_world.discovery.data import Dataset, Design, collect
from scm_world.discovery.learners import EstimatedGraph, Learner, learn, learner
from scm_world.discovery.problems import DONE
from scm_world.graph import SCM
from scm_world.variables import Derived, Linear
from scm_world.variables.distributions import Normal

ROWS = 1500


@cache
def collider() -> SCM:
    """Make a small model whose graph follows from watching alone: a → c ← b, c → d."""
    noise = Normal(mean=0.0, std=1.0)

    def of(name: str, parents: tuple[str, ...], weights: tuple[float, ...]) -> Derived:
        return Derived(name=name, parents=parents, mechanism=Linear(weights=weights), noise=noise)

    a, b = of("a", (), ()), of("b", (), ())
    return SCM([a, b, of("c", ("a", "b"), (1.5, -1.0)), of("d", ("c",), (1.0,))])


@cache
def table(kind: str) -> Dataset:
    """Collect ``"observational"`` or ``"interventional"`` rows of that model."""
    targets = tuple(collider())
    design = (
        Design()
        if kind == "observational"
        else Design("single", targets, DONE, observational_fraction=0.3)
    )
    return collect(collider(), design, ROWS, seed=6)


def _numpys() -> Any:
    """Read the global generator of numpy, which must not be touched."""
    state: Any = np.random.get_state()  # noqa: NPY002 # is watched, not used
    return np.array(state[1])


class LearnerConformance:
    """What benchmarks rely on, as tests: for learners that are given a dataset.

    Attributes:
        learner: The learner, or its name.
        settings: Of the learner.
        searches: Whether it is a search that may end elsewhere if it begins with another order of
            the columns.
    """

    learner: Learner | str
    settings: Mapping[str, Any] = MappingProxyType({})
    searches: bool = False

    @property
    def data(self) -> Dataset:
        """The rows that the learner can use best."""
        chosen = learner(self.learner) if isinstance(self.learner, str) else self.learner
        return table("interventional" if "interventional" in chosen.takes else "observational")

    def found(self, data: Dataset) -> EstimatedGraph:
        """Estimate the graph."""
        return learn(self.learner, data, seed=3, **self.settings)

    def test_it_finds_a_collider(self) -> None:
        """All four edges have their direction: even watching alone tells it."""
        edges = {(cause, effect) for cause, effect, _ in self.found(self.data).directed}
        assert edges == {("a", "c"), ("b", "c"), ("c", "d")}

    def test_it_is_deterministic(self) -> None:
        """The same data and seed give the same graph and edge_scores, bit for bit."""
        one, two = self.found(self.data), self.found(self.data)
        assert one.edges.tobytes() == two.edges.tobytes()
        assert one.edge_scores.tobytes() == two.edge_scores.tobytes()

    def test_it_leaves_the_data_alone(self) -> None:
        """Data are shared between learners: none may write into them."""
        before = self.data.values.copy()
        self.found(self.data)
        assert self.data.values.tobytes() == before.tobytes()

    def test_it_leaves_global_generators_alone(self) -> None:
        """It draws from its own generators only."""
        theirs, pythons = _numpys(), random.getstate()
        self.found(self.data)
        assert np.array_equal(theirs, _numpys())
        assert random.getstate() == pythons

    def test_names_and_their_order_mean_nothing(self) -> None:
        """Other names in another order give the same graph."""
        if self.searches:
            pytest.skip("its search depends on the order of the columns")
        data = self.data
        order = [2, 0, 3, 1]
        renamed = {"a": "y", "b": "x", "c": "w", "d": "v"}
        columns = tuple(
            replace(data.columns[i], name=renamed[data.names[i]], variable=renamed[data.names[i]])
            for i in order
        )
        regimes = tuple(
            replace(r, targets=tuple(sorted(renamed[t] for t in r.targets))) for r in data.regimes
        )
        other = replace(data, values=data.values[:, order], columns=columns, regimes=regimes)
        expected = {(renamed[c], renamed[e]) for c, e, _ in self.found(data).directed}
        assert {(c, e) for c, e, _ in self.found(other).directed} == expected

    def test_what_never_varies_has_no_edges(self) -> None:
        """A constant column neither stops it nor gets edges."""
        data = self.data
        still = replace(data.columns[0], name="still", variable="still")
        wide = np.concatenate([data.values, np.full((len(data), 1), 7.0)], axis=1)
        found = self.found(replace(data, values=wide, columns=(*data.columns, still)))
        touched = {name for c, e, _ in found.directed for name in (c, e)}
        assert "still" in found.names
        assert "still" not in touched

    def test_edge_scores_tell_edges_from_others(self) -> None:
        """What it is sure of is what it found: the mean over edges exceeds that over others."""
        found = self.found(self.data)
        edges = found.edges.any(axis=0)
        sure = found.edge_scores.max(axis=0)
        off = ~np.eye(len(found.names), dtype=bool)
        assert sure[edges & off].mean() > sure[~edges & off].mean()
