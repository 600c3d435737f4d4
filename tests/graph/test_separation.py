"""D-separation of lagged models against covariances of what they draw."""

from __future__ import annotations

from itertools import product
from typing import Any

import networkx as nx
import numpy as np
import pytest

from scm_world.graph import SCM, from_json, to_dag, to_digraph, to_json, unrolled
from scm_world.queries import identify
from scm_world.variables import (
    Affine,
    Box,
    Derived,
    Draw,
    Exogenous,
    Linear,
    Mechanism,
    Normal,
    Parent,
    Shift,
)

STEPS = 30
"""Enough: the weights are small, and what is older is below the tolerance."""

KINDS = ("episode", "step", "noise", "drawn", "lagged", "follows", "cut")


class Process:
    """A random linear model through time, and the covariance of what it draws, by hand."""

    def __init__(self, seed: int) -> None:
        """Choose kinds of variables, edges and weights."""
        rng = np.random.default_rng(seed)
        self.names = "abcde"[: rng.integers(3, 6)]
        self.kinds = {name: str(rng.choice(KINDS)) for name in self.names}
        self.parents: dict[str, list[tuple[str, int, float]]] = {}
        for i, name in enumerate(self.names):
            kind, found = self.kinds[name], []
            for j, cause in enumerate(self.names):
                lags = (lag for lag in (0, 1) if lag or j < i)
                found += [(cause, lag, rng.uniform(0.2, 0.5)) for lag in lags if rng.random() < 0.4]
            if kind == "follows":  # the ends of a box follow one earlier variable
                found = [(str(rng.choice(list(self.names[:i]))), 0, 0.5)] if i else []
            self.parents[name] = found if kind in ("lagged", "follows", "cut") else []
        both = [n for n in self.names if self.kinds[n] in ("step", "noise", "lagged")]
        self.together = both if rng.random() < 0.4 else []

    def model(self) -> SCM:
        """Declare the model, and intervene on it."""
        variables: list[Any] = []
        acts: dict[str, Any] = {}
        for name in self.names:
            kind, parents = self.kinds[name], self.parents[name]
            causes = tuple(Parent(cause, lag) for cause, lag, _ in parents)
            equation = Linear(weights=tuple(weight for *_, weight in parents))
            if kind == "follows" and parents:
                end = Affine(parent=parents[0][0], scale=0.5)
                low, high = end, end.model_copy(update={"offset": 1.0})
                variables.append(Exogenous(name=name, distribution=Box(low, high)))
            elif kind in ("episode", "step", "follows"):
                per = "step" if kind == "step" else "episode"
                variables.append(Exogenous(name=name, distribution=Normal(), per=per))
            elif kind == "cut":  # an intervention brings its causes
                variables.append(Exogenous(name=name, per="step"))
                acts[name] = Mechanism(equation, causes, noise=Normal())
            else:
                own = (Parent(name, 1),) if kind == "drawn" else causes
                weights = Linear(weights=(0.5,)) if kind == "drawn" else equation
                made = Derived(name=name, parents=own, mechanism=weights, noise=Normal())
                variables.append(made)
                acts |= {name: Draw(Normal())} if kind == "drawn" else {}
        acts |= {name: Shift(Draw(Normal()), shared="both") for name in self.together}
        return SCM(variables).do(acts)

    def lasts(self, name: str) -> bool:
        """Return whether the own noise of a variable is one number for the episode."""
        return self.kinds[name] in ("episode", "follows")

    def is_constant(self, name: str) -> bool:
        """Return whether a variable is one number for the episode, with all its causes."""
        return self.lasts(name) and all(self.is_constant(cause) for cause, *_ in self.parents[name])

    def covariance(self, drift: float = 0.0) -> Any:
        """Compute the covariance of the noise of an episode, then all variables step by step.

        Weights that drift a little from step to step show every edge: equal ones can cancel.
        """
        n, rng = len(self.names), np.random.default_rng(0)
        at = {name: i for i, name in enumerate(self.names)}
        total = np.eye(n * STEPS)
        noise = np.zeros((n * STEPS, n + n * STEPS + STEPS))  # for an episode, for a step, shared
        for step, (name, i) in product(range(STEPS), at.items()):
            row = step * n + i
            uniform = self.kinds[name] == "follows" and self.parents[name]
            size = 1.0 / np.sqrt(12.0) if uniform else 1.0  # a box of width 1
            noise[row, i if self.lasts(name) else n + row] = size
            noise[row, n + n * STEPS + step] = name in self.together
            for cause, lag, weight in self.parents[name]:
                if step >= lag:
                    other = weight * (1.0 + drift * rng.uniform(-1.0, 1.0))
                    total[row, (step - lag) * n + at[cause]] -= other
        spread = np.vstack([np.eye(n, noise.shape[1]), np.linalg.solve(total, noise)])
        return spread @ spread.T


def rest_of(covariance: Any, ends: list[int], given: list[int]) -> Any:
    """Return the covariance of some variables that is left when others are known."""
    across = covariance[np.ix_(ends, given)]
    known = np.linalg.pinv(covariance[np.ix_(given, given)], 1e-9)
    return covariance[np.ix_(ends, ends)] - across @ known @ across.T


def test_the_covariance_is_that_of_draws() -> None:
    """Of twenty models, in the last two of twelve steps, within the error of 4,000 draws."""
    for seed in range(20):
        process = Process(seed)
        drawn = process.model().draw(4000, seed=seed, steps=12)
        rows = [drawn[name][:, step] for step in (-2, -1) for name in process.names]
        expected = process.covariance()[-len(rows) :, -len(rows) :]
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        assert np.allclose(np.cov(rows) / scale, expected / scale, atol=0.12), seed


@pytest.mark.parametrize("first", range(0, 80, 40))
def test_slices_separate_what_is_independent(first: int) -> None:
    """Of variables that are drawn once, in every step, together, or under interventions."""
    compared = 0
    for seed in range(first, first + 40):
        process = Process(seed)
        model, covariance = process.model(), process.covariance(drift=0.3)
        rng = np.random.default_rng(seed)
        past = max((lag for *_, lag in to_digraph(model).edges(keys=True)), default=0)
        names, n = process.names, len(process.names)
        held = {a for a in names if process.lasts(a) and not process.parents[a]}
        own = [names.index(a) for a in names if process.lasts(a) and a not in held]
        nodes = [(a, back) for back in range(past + 1) for a in names]
        named = {(a, t): f"{a}@{'=' * (a in held)}-{t}" if t else a for a, t in nodes}
        row = {(a, t): (STEPS - t) * n + names.index(a) for a, t in nodes}
        dag, long = to_dag(model), unrolled(model, 12)
        for _ in range(20):
            x, y, *rest = (nodes[i] for i in rng.permutation(len(nodes)))
            given = rest[: rng.integers(0, min(len(rest), 3) + 1)]
            known = [row[node] for node in given]
            left = rest_of(covariance, [row[x], row[y]], known)
            if np.diag(left).min() < 1e-6 or x[0] == y[0] in held:
                continue  # known from another step
            size = abs(left[0, 1]) / np.sqrt(left[0, 0] * left[1, 1])
            assert size < 1e-8 or size > 1e-6
            separated = nx.is_d_separator(dag, {named[x]}, {named[y]}, {named[g] for g in given})
            assert not separated or size < 1e-8, (seed, x, y, given)
            far = [{(a, -t) for a, t in some} for some in ([x], [y], given)]
            assert not nx.is_d_separator(long, *far) or size < 1e-3, (seed, x, y, given)
            determined = (np.diag(rest_of(covariance, own, known)) < 1e-6).any()
            if not determined and not any(process.is_constant(a) for a, _ in given):
                assert separated == (size < 1e-8), (seed, x, y, given)
                compared += 1
    assert compared > 300


def test_a_root_that_is_drawn_in_every_step_is_not_held() -> None:
    """Not by its role, nor under an intervention: its past says nothing about it."""
    two = Linear(weights=(1.0, 1.0))
    model = SCM(
        [
            Derived(name="shock", parents=(), mechanism=Linear(weights=()), noise=Normal()),
            Exogenous(name="trait", distribution=Normal()),
            Derived(
                name="z",
                parents=(Parent("z", 1),),
                mechanism=Linear(weights=(0.5,)),
                noise=Normal(),
            ),
            Derived(name="y", parents=("shock", "z"), mechanism=two, noise=Normal()),
            Derived(name="w", parents=("y", Parent("trait", 1)), mechanism=two, noise=Normal()),
        ]
    )
    drawn = model.draw(4000, seed=0, steps=2)
    assert abs(np.corrcoef(drawn["shock"].T)[0, 1]) < 0.05
    dag = to_dag(model)
    assert nx.is_d_separator(dag, {"shock@-1"}, {"shock"}, set())
    assert not nx.is_d_separator(dag, {"trait@=-1"}, {"trait"}, set())
    assert identify(model, "shock", "y").instruments == ()
    assert (("shock", -1), ("shock", 0)) not in unrolled(model, 2).edges
    assert (("trait", -1), ("trait", 0)) in unrolled(model, 2).edges
    done = model.do({name: Draw(Normal()) for name in ("z", "trait")})
    drawn = done.draw(4000, seed=0, steps=2)
    assert abs(np.corrcoef(drawn["z"].T)[0, 1]) < 0.05
    assert (drawn["trait"][:, 0] == drawn["trait"][:, 1]).all()
    assert not to_dag(done).in_degree("z")
    assert [*to_dag(done).predecessors("trait")] == ["trait@=-1"]


def test_what_is_written_and_read_has_the_separations_of_the_model() -> None:
    """Of models under interventions, but for draws that variables share: no edge has them."""
    for seed in range(40):
        process = Process(seed)
        process.together = []
        model = process.model()
        text = "\n".join(nx.generate_graphml(to_digraph(model)))
        assert set(to_dag(nx.parse_graphml(text)).edges) == set(to_dag(model).edges)
        assert set(to_dag(from_json(to_json(model))).edges) == set(to_dag(model).edges)
        again = to_digraph(nx.parse_graphml(text))
        assert {edge.key for edge in model.edges} == set(again.edges(keys=True))
