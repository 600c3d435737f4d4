"""A conformance suite for learners of causal graphs.

Subclass it in a test file, name the learner, and pytest runs the rest::

    class TestMine(LearnerConformance):
        learner = "my_package.my_module:my_learner"
"""

from __future__ import annotations

import random
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from scm_world.discovery.data import Dataset, Design, collect
from scm_world.discovery.learners import EstimatedGraph, Learner, learn, learner
from scm_world.graph import SCM
from scm_world.tasks.families import DONE
from scm_world.variables import Derived, Linear
from scm_world.variables.distributions import Normal

__all__ = ["LearnerConformance"]

COLLIDER = {"a": {}, "b": {}, "c": {"a": 1.5, "b": -1.0}, "d": {"c": 1.0}}
"""A linear model, with the weight of each parent: observations alone determine its graph."""


@cache
def table(interventional: bool) -> Dataset:
    """Collect rows of that model."""
    noise = Normal(mean=0.0, std=1.0)
    model = SCM(
        Derived(name=n, parents=tuple(w), mechanism=Linear(weights=tuple(w.values())), noise=noise)
        for n, w in COLLIDER.items()
    )
    single = Design("single", tuple(model), DONE, observational_fraction=0.3)
    return collect(model, single if interventional else Design(), 1500, seed=6)


class LearnerConformance:
    """What benchmarks rely on, as tests: for learners that are given a dataset.

    Attributes:
        learner: The learner, or its name.
        searches: Whether the order of the columns, where a search begins, may decide its end.
    """

    learner: Learner | str
    searches: bool = False

    @property
    def data(self) -> Dataset:
        """The rows that the learner can use best."""
        chosen = learner(self.learner) if isinstance(self.learner, str) else self.learner
        return table("interventional" in chosen.takes)

    def found(self, data: Dataset) -> EstimatedGraph:
        """Estimate the graph."""
        return learn(self.learner, data, seed=3)

    def test_it_finds_a_collider(self) -> None:
        """All three edges have their direction, and higher scores than the others on average."""
        found = self.found(self.data)
        edges = {(cause, effect) for cause, effect, _ in found.directed}
        assert edges == {("a", "c"), ("b", "c"), ("c", "d")}
        there, scores = found.edges.any(axis=0), found.edge_scores.max(axis=0)
        off = ~np.eye(len(found.names), dtype=bool)
        assert scores[there & off].mean() > scores[~there & off].mean()

    def test_it_is_a_function_of_data_and_seed(self) -> None:
        """It returns the same bits again; data and global generators stay as they are."""
        before = self.data.values.copy()
        numpys, pythons = np.random.get_state(), random.getstate()  # noqa: NPY002 # is watched
        one, two = self.found(self.data), self.found(self.data)
        assert one.edges.tobytes() == two.edges.tobytes()
        assert one.edge_scores.tobytes() == two.edge_scores.tobytes()
        assert self.data.values.tobytes() == before.tobytes()
        np.testing.assert_equal(np.random.get_state(), numpys)  # noqa: NPY002 # is watched
        assert random.getstate() == pythons

    def test_names_and_their_order_mean_nothing(self) -> None:
        """Other names in another order give the same graph."""
        if self.searches:
            pytest.skip("its search depends on the order of the columns")
        new, other = {"a": "y", "b": "x", "c": "w", "d": "v"}, self.data.select([*"cadb"])
        columns = tuple(replace(c, name=new[c.name], variable=new[c.name]) for c in other.columns)
        regimes = tuple(
            replace(r, targets=tuple(sorted(new[t] for t in r.targets))) for r in other.regimes
        )
        other = replace(other, columns=columns, regimes=regimes)
        expected = {(new[c], new[e]) for c, e, _ in self.found(self.data).directed}
        assert {(c, e) for c, e, _ in self.found(other).directed} == expected

    def test_a_constant_has_no_edges(self) -> None:
        """A column that never varies neither stops it nor gets edges."""
        data = self.data
        still = replace(data.columns[0], name="still", variable="still")
        wide = np.concatenate([data.values, np.full((len(data), 1), 7.0)], axis=1)
        found = self.found(replace(data, values=wide, columns=(*data.columns, still)))
        assert "still" in found.names
        assert "still" not in {name for c, e, _ in found.directed for name in (c, e)}
