"""Scripted agents, which use the tools only, and the certificate of a question."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from itertools import combinations, pairwise
from typing import Any

import networkx as nx
import numpy as np

from scm_world._arguments import one_of
from scm_world._types import Floats
from scm_world.discovery.data import Dataset
from scm_world.discovery.learners.do_order import do_order
from scm_world.lab.expressions import evaluate
from scm_world.lab.laboratory import ROWS, Laboratory
from scm_world.lab.questions import PASSED, Question

Columns = Mapping[str, Floats]


def _columns(result: Mapping[str, Any]) -> dict[str, Floats]:
    return {name: np.array(column) for name, column in result["columns"].items()}


def _experiment(room: Laboratory, do: Mapping[str, Any], n: int) -> dict[str, Floats]:
    """Run an experiment in calls of a size that is allowed."""
    parts = [min(ROWS, n - begin) for begin in range(0, n, ROWS)]
    found = [
        _columns(room.experiment(dict(do), n=part) if do else room.observe(part)) for part in parts
    ]
    return {name: np.concatenate([one[name] for one in found]) for name in found[0]}


class _Known:
    """What the description of a question says."""

    def __init__(self, room: Laboratory) -> None:
        self.room, self.about = room, (about := room.describe())
        self.kind, self.query, self.budget = about["kind"], about["query"], about["remaining"]
        self.variables = about["variables"]
        self.ends = {v["name"]: v["settable"] for v in self.variables if v["settable"]}
        self.readable = [v["name"] for v in self.variables if v["readable"]]
        self.independent = not about["settable_variables_act_on_one_another"]

    def others(self, *names: str) -> dict[str, Any]:
        """Return what is drawn at random in the range of all settable variables but these."""
        return {name: ends for name, ends in self.ends.items() if name not in names}


# --- regression -----------------------------------------------------------------------------------


def _curve(name: str, x: Floats, y: Floats) -> str:
    """Return the polynomial or broken line that predicts best what it is not fitted to."""
    middle, half = 0.5 * (x.max() + x.min()), 0.5 * np.ptp(x)
    u = f"(({name} - {middle:.6g}) / {half:.6g})"
    powers = [[f"{u} ** {k}" for k in range(degree + 1)] for degree in range(1, 6)]
    knots = [np.linspace(x[0], x[-1], k + 2)[1:-1] for k in (1, 3, 7)]
    lines = [["1", name, *(f"abs({name} - {knot:.5g})" for knot in some)] for some in knots]
    best, found = np.inf, ""
    for terms in [*powers, *lines]:
        basis = np.stack([evaluate(term, {name: x}) for term in terms], axis=1)
        inverse = np.linalg.pinv(basis)
        left = (y - basis @ (inverse @ y)) / np.maximum(1.0 - np.diag(basis @ inverse), 1e-9)
        if (error := float(np.mean(left**2))) < 0.95 * best:
            weights = zip(inverse @ y, terms, strict=True)
            best, found = error, " + ".join(f"{w:.6g} * {term}" for w, term in weights)
    return found


def _terms(columns: Columns, causes: list[str], richness: int) -> Floats:
    """Return constant and linear terms, then powers, then mixed ones, shape (n, terms)."""
    x = [columns[name] for name in causes]
    terms = [np.ones(len(next(iter(columns.values())))), *x]
    if richness > 0:
        terms += [one**power for one in x for power in (2, 3)]
    if richness > 1:
        terms += [a * b for a, b in combinations(x, 2)]
    return np.stack(terms, axis=1)


def _model(columns: Columns, causes: list[str], y: Floats) -> Callable[[Columns], Floats]:
    """Return the regression that predicts best the rows that it is not fitted to."""
    best, found, rich = np.inf, np.zeros(1), 0
    for richness in range(3):
        basis = _terms(columns, causes, richness)
        scale = np.maximum(np.abs(basis).max(axis=0), 1e-12)
        z = basis / scale
        for penalty in (1e-6, 1e-3, 1e-1):
            inverse = np.linalg.inv(z.T @ z + penalty * np.eye(z.shape[1])) @ z.T
            kept = np.maximum(1.0 - np.einsum("ij,ji->i", z, inverse), 1e-6)
            if (error := float(np.mean(((y - z @ (inverse @ y)) / kept) ** 2))) < 0.97 * best:
                best, found, rich = error, inverse @ y / scale, richness
    return lambda rows: _terms(rows, causes, rich) @ found


# --- the ideal agent ------------------------------------------------------------------------------


def ideal(room: Laboratory) -> None:
    """Answer a question with a design that knows its kind."""
    known = _Known(room)
    answer = _SOLVERS[known.kind](known)
    room.submit(answer, 0.97)


def _solve_graph(known: _Known) -> Any:
    if "set" in known.query:
        return _solve_local(known)
    outcomes = [n for n in known.readable if n not in known.ends] or known.readable
    together, tables = outcomes != known.readable, {}
    n = known.budget if together else int(0.8 * known.budget) // len(outcomes)
    if together:
        tables = dict.fromkeys(outcomes, _experiment(known.room, known.ends, n))
    else:
        tables = {o: _experiment(known.room, known.others(o), n) for o in outcomes}
    own, edges = {tuple(e) for e in known.query["known"]}, list[list[str]]()
    for outcome, table in tables.items():
        causes = [c for c in known.ends if c != outcome]
        x = np.stack([table[c] for c in causes], axis=1)
        x = (x - x.mean(axis=0)) / x.std(axis=0)
        basis = np.hstack([np.ones((len(x), 1)), x, x**2, x**3])
        weights, inverse = np.linalg.pinv(basis) @ table[outcome], np.linalg.pinv(basis.T @ basis)
        left = table[outcome] - basis @ weights
        variance = left @ left / (len(x) - basis.shape[1])
        for k, cause in enumerate(causes):
            of = [1 + k, 1 + k + len(causes), 1 + k + 2 * len(causes)]
            size = weights[of] @ np.linalg.solve(inverse[np.ix_(of, of)] * variance, weights[of])
            if size > 25.0 and (cause, outcome) not in own:  # chi squared, 3 degrees, 2e-5
                edges.append([cause, outcome])
    if together:
        return {"edges": edges, "hidden": []}
    seen = _experiment(known.room, {}, known.room.remaining)
    unexplained = dict[str, Floats]()
    for outcome, table in tables.items():
        causes = [c for c, e in edges if e == outcome]
        unexplained[outcome] = seen[outcome] - _model(table, causes, table[outcome])(seen)
    return {"edges": edges, "hidden": _confounded(unexplained)}


def _solve_local(known: _Known) -> Any:
    """Return which outcomes of a run differ when one variable is set a little lower and higher."""
    q, edges = known.query, list[list[str]]()
    n = known.budget // (2 * len(q["set"]))
    for name, value in q["set"].items():
        apart = 0.04 * (known.ends[name][1] - known.ends[name][0])
        one, other = (
            _experiment(known.room, {**q["set"], name: value + step}, n) for step in (-apart, apart)
        )
        for outcome in (o for o in known.readable if o not in known.ends):
            error = np.sqrt((np.var(one[outcome]) + np.var(other[outcome])) / (n - 1))
            far = abs(one[outcome].mean() - other[outcome].mean()) > 4.5 * error
            if far and [name, outcome] not in q["known"]:
                edges.append([name, outcome])
    return {"edges": edges, "hidden": []}


def _confounded(left: Mapping[str, Floats]) -> Any:
    """Return pairs whose parts without a cause, in observations, are correlated."""
    n = len(next(iter(left.values())))
    return [
        [a, b]
        for a, b in combinations(left, 2)
        if np.arctanh(min(abs(np.corrcoef(left[a], left[b])[0, 1]), 0.999)) * np.sqrt(n - 3) > 3.6
    ]


def _solve_effect(known: _Known) -> float:
    q, n = known.query, known.budget // 2
    cause, outcome = q["cause"], q["outcome"]
    one, other = (_experiment(known.room, {cause: q[end]}, n) for end in ("to", "from"))
    if not known.independent:
        return float(np.mean(one[outcome]) - np.mean(other[outcome]))
    rows = {name: np.concatenate([one[name], other[name]]) for name in one}
    rows[cause] = np.repeat([q["to"], q["from"]], n)
    fitted = _model(rows, [*known.ends], rows[outcome])
    ends = [fitted({**rows, cause: np.full(2 * n, q[end])}).mean() for end in ("to", "from")]
    return float(ends[0] - ends[1])


def _solve_law(known: _Known) -> Any:
    """Return the mean of an outcome as an expression of its cause."""
    cause, outcome = known.query["cause"], known.query["outcome"]
    low, high = known.ends[cause]
    places = np.linspace(low, high, min(32 if known.query["held"] else 16, known.budget))
    n = known.budget // len(places)
    dos = [{**known.query["held"], cause: float(place)} for place in places]
    y = np.array([_experiment(known.room, do, n)[outcome].mean() for do in dos])
    return _curve(cause, places, y)


def _solve_prediction(known: _Known) -> Any:
    outcomes = [n for n in known.readable if n not in known.ends]
    if outcomes:
        table = _experiment(known.room, known.ends, known.budget)
        tables = dict.fromkeys(outcomes, table)
    else:
        n = known.budget // len(known.readable)
        tables = {o: _experiment(known.room, known.others(o), n) for o in known.readable}
        if known.room.remaining:
            known.room.observe(known.room.remaining)
    query = known.room.describe()["query"]
    outcome, causes = query["outcome"], [*query["dos"][0]]
    fitted = _model(tables[outcome], causes, tables[outcome][outcome])
    return fitted({c: np.array([do[c] for do in query["dos"]]) for c in causes}).tolist()


def _solve_counterfactual(known: _Known) -> float:
    q, run = known.query, known.query["run"]
    held = (
        {c: float(np.clip(run[c], *known.ends[c])) for c in known.ends} if known.independent else {}
    )
    n, cause = (4 if known.independent else known.budget // 2), q["cause"]
    was = float(np.clip(run[cause], *known.ends[cause]))
    one = _experiment(known.room, {**held, cause: q["value"]}, n)
    other = _experiment(known.room, {**held, cause: was}, n)
    return float(run[q["outcome"]] + one[q["outcome"]].mean() - other[q["outcome"]].mean())


def _solve_control(known: _Known) -> Any:
    cause, (low, high) = known.query["cause"], known.ends[known.query["cause"]]
    grid = np.linspace(low, high, 2001)
    apart = np.abs(evaluate(_solve_law(known), {cause: grid}) - known.query["target"])
    return {cause: float(grid[np.argmin(apart)])}


def _solve_explanation(known: _Known) -> Any:
    q, sign = known.query, 1.0 if known.query["fails"] == "above" else -1.0
    n = max(1, known.budget // len(known.ends))
    gains = {}
    for name in known.ends:
        table = _experiment(known.room, {**q["set"], name: q["usual"][name]}, n)
        gains[name] = sign * (q["limit"] - table[q["outcome"]].mean())
    return max(gains, key=lambda name: gains[name])


def _solve_diagnosis(known: _Known) -> Any:
    q, outcomes = known.query, [*known.query["run"]]
    shares = (0.08, 0.3, 0.7, 0.92) if known.budget > 4 * len(known.ends) + 1 else (0.08, 0.92)
    n = known.budget // (len(shares) * len(known.ends) + 2)

    def readings(do: Mapping[str, Any], many: int) -> Floats:
        table = _experiment(known.room, do, many)
        return np.array([table[o].mean() for o in outcomes])

    usual = readings(q["usual"], 2 * n)
    run, errors = np.array([q["run"][o] for o in outcomes]), dict[str, float]()
    places: dict[str, list[Floats]] = {}
    for name, (low, high) in known.ends.items():
        places[name] = [
            readings({**q["usual"], name: low + share * (high - low)}, n) for share in shares
        ]
    size = np.std([one for many in places.values() for one in many], axis=0) + 1e-12
    for name, many in places.items():
        line = [*many[: len(many) // 2], usual, *many[len(many) // 2 :]]
        errors[name] = min(
            _distance(run / size, one / size, other / size) for one, other in pairwise(line)
        )
    return min(errors, key=lambda name: errors[name])


def _distance(point: Floats, one: Floats, other: Floats) -> float:
    """Return how far a point is from a line between two."""
    along = other - one
    share = np.clip((point - one) @ along / max(float(along @ along), 1e-30), 0.0, 1.0)
    return float(np.linalg.norm(point - one - share * along))


_SOLVERS: Mapping[str, Callable[[_Known], Any]] = {
    "graph": _solve_graph,
    "effect": _solve_effect,
    "law": _solve_law,
    "prediction": _solve_prediction,
    "counterfactual": _solve_counterfactual,
    "control": _solve_control,
    "explanation": _solve_explanation,
    "diagnosis": _solve_diagnosis,
}


# --- trivial answers ------------------------------------------------------------------------------


def trivial(question: Question) -> dict[str, Any]:
    """Return answers that need no experiment, by name; they may look at observations."""
    room = Laboratory(question)
    known = _Known(room)
    seen = _experiment(room, {}, room.remaining)
    known.query = q = room.describe()["query"]
    kind, outcome = question.kind, q.get("outcome")
    if kind == "graph":
        every = [[a, b] for a in known.ends for b in known.readable if a != b]
        strong = [e for e in every if abs(np.corrcoef(seen[e[0]], seen[e[1]])[0, 1]) > 0.3]
        forward = [e for e in every if e[0] < e[1]]
        ends = [[a, b] for a, _ in q["known"] for _, b in q["known"]] if "set" in q else every
        return {
            "no effect": {"edges": []},
            "all": {"edges": every},
            "all of one kind": {"edges": ends},
            "regression": {"edges": [e for e in strong if e in forward] or strong},
        }
    if kind in ("explanation", "diagnosis"):
        return {}
    y, mean = seen[outcome], float(np.mean(seen[outcome]))
    if kind == "prediction":
        causes = [c for c in q["dos"][0] if np.std(seen[c]) > 0]
        basis = np.stack([np.ones_like(y), *(seen[c] for c in causes)], axis=1)
        weights = np.linalg.pinv(basis) @ y
        line = [float(weights @ [1.0, *(do[c] for c in causes)]) for do in q["dos"]]
        return {"mean": [mean] * len(line), "regression": line}
    cause = q["cause"]
    slope, level = np.polyfit(seen[cause], y, 1)
    middle = float(np.mean(known.ends[cause]))
    match kind:
        case "effect":
            return {"no effect": 0.0, "regression": float(slope * (q["to"] - q["from"]))}
        case "law":
            line_of = f"{level:.9g} + {slope:.9g} * {cause}".replace("+ -", "- ")
            return {"no effect": f"{mean:.9g}", "regression": line_of}
        case "counterfactual":
            was = q["run"][outcome]
            line_at = float(was + slope * (q["value"] - q["run"][cause]))
            return {"no effect": was, "mean": mean, "regression": line_at}
        case _:
            low, high = known.ends[cause]
            line_to = float(np.clip((q["target"] - level) / slope, low, high))
            some = {"low": low, "middle": middle, "high": high, "regression": line_to}
            return {name: {cause: value} for name, value in some.items()}


def certify(question: Question) -> dict[str, Any]:
    """Return the scores of the solver and, if it passes, those of the trivial answers."""
    room = Laboratory(question)
    ideal(room)
    assert room.score is not None  # noqa: S101 # it has submitted
    if room.score["score"] < PASSED:
        return {"solver": room.score["score"], "trivial": {}}
    found = {name: question.grade(answer) for name, answer in trivial(question).items()}
    if not found:
        found = {"most frequent name": 1.0 / len(question.view.testbed.causes)}
    return {"solver": room.score["score"], "trivial": found}


# --- agents that choose one experiment after another ----------------------------------------------

ROUNDS, GRID, PRIOR = 16, 33, 0.01
"""Experiments of a run; places of a law; prior precision of a weight, in that of a reading."""


class _Seen:
    """Rows of experiments as columns of a regression, and the estimates from them.

    Where everything but the outcome is set, or nothing settable acts on anything settable, a column
    has the values of a variable. Otherwise it has them where the variable was set, and another
    column says where that was, so that an effect includes what it moves on its way.
    """

    def __init__(self, known: _Known, rng: np.random.Generator) -> None:
        self.known, self.rng, self.turn = known, rng, 0
        self.by_value = known.independent or known.kind == "prediction"
        self.outcomes = [n for n in known.readable if n not in known.ends] or known.readable
        self.rows = {name: np.zeros(0) for name in known.readable}
        self.is_set = {name: np.zeros(0, bool) for name in known.ends}

    def experiment(self, do: Mapping[str, Any], n: int) -> None:
        """Run an experiment, or observe, and keep the rows."""
        found = _experiment(self.known.room, do, n)
        n, self.turn = len(next(iter(found.values()))), self.turn + 1
        self.rows = {name: np.append(self.rows[name], found[name]) for name in self.rows}
        for name, was in self.is_set.items():
            self.is_set[name] = np.append(was, np.full(n, name in do))

    def columns(self, rows: Columns, is_set: Mapping[str, Any]) -> dict[str, Floats]:
        """Return the columns of a regression, two for a variable, or one if they are values."""
        found = dict[str, Floats]()
        for name, (low, high) in self.known.ends.items():
            if self.by_value:
                found[name] = rows[name]
            else:
                share = (2.0 * rows[name] - low - high) / (high - low)
                found[name] = np.where(is_set[name], share, 0.0)
                found[f"set {name}"] = np.where(is_set[name], np.ones_like(share), 0.0)
        return found

    def under(self, do: Mapping[str, Any], n: int) -> dict[str, Floats]:
        """Return columns of n rows under an intervention; all else is as where it was not set."""
        others = [was for name, was in self.is_set.items() if name not in do]
        every = np.arange(len(self.rows[self.outcomes[0]]))
        free = every[~np.any(others, axis=0)] if others else every
        at = np.resize(free if len(free) else every, n)
        ends = {name: np.ravel(value) for name, value in do.items()}
        drawn = {name: self.rng.uniform(end[0], end[-1], n) for name, end in ends.items()}
        rows = {name: self.rows[name][at] for name in self.known.ends} | drawn
        return self.columns(rows, {name: name in do for name in self.known.ends})

    def causes(self, outcome: str, columns: Columns) -> list[str]:
        """Return the columns that may explain an outcome."""
        return [name for name in columns if name not in (outcome, f"set {outcome}")]

    def free(self, outcome: str) -> Any:
        """Return in which rows an outcome was not set."""
        return ~self.is_set.get(outcome, np.zeros(len(self.rows[outcome]), bool))

    def predict(self, outcome: str, dos: list[dict[str, float]]) -> Floats:
        """Return the means of an outcome under interventions, by regression."""
        kept, every = self.free(outcome), self.columns(self.rows, self.is_set)
        columns = {name: column[kept] for name, column in every.items()}
        fitted = _model(columns, self.causes(outcome, every), self.rows[outcome][kept])
        return np.array([fitted(self.under(do, 40)).mean() for do in dos])

    def unexplained(self, outcome: str, causes: list[str]) -> Floats:
        """Return what causes leave of an outcome; the values that were set are instruments."""
        free, y = self.free(outcome), self.rows[outcome]
        one = np.ones((1, len(y)))
        x = np.vstack([one, *(self.rows[c] for c in causes)])
        z = np.vstack([one, *(np.where(self.is_set[c], self.rows[c], 0.0) for c in causes)])
        weights = np.linalg.lstsq(z[:, free] @ x[:, free].T, z[:, free] @ y[free], rcond=None)[0]
        return np.asarray(y - weights @ x)

    def edges(self) -> list[list[str]]:
        """Return the edges that ``do_order`` finds; none from a variable that was never set."""
        # Noise that is never set makes do_order allow for hidden causes of all variables.
        noise = self.rng.normal(size=len(self.rows[self.outcomes[0]]))
        columns = self.rows if self.outcomes != self.known.readable else {**self.rows, "": noise}
        names, table = [*columns], np.stack([*columns.values()], axis=1)
        sets = np.stack([*self.is_set.values()], axis=1)
        if len(table) < 3 or not sets.any():
            return []
        targets = [[n for n, one in zip(self.is_set, row, strict=True) if one] for row in sets]
        data = Dataset.of(table, names, targets=targets)
        # What cannot be set comes last in an episode.
        ends = [
            replace(c, how="value" if c.name in ("", *self.is_set) else "final")
            for c in data.columns
        ]
        graph = do_order(replace(data, columns=tuple(ends)))
        return [[a, b] for a, b, _ in graph.directed if b in self.outcomes]


def _asked(seen: _Seen, query: Mapping[str, Any] | None) -> list[dict[str, float]]:
    """Return the interventions under which an answer needs means of the outcome."""
    known = seen.known
    q, ends = query or {}, known.ends
    match known.kind:
        case "effect":
            return [{q["cause"]: q[end]} for end in ("to", "from")]
        case "law" | "control":
            low, high = ends[q["cause"]]
            places = np.linspace(low, high, GRID)
            return [{**q["held"], q["cause"]: float(place)} for place in places]
        case "counterfactual":
            was = {c: float(np.clip(q["run"][c], *ends[c])) for c in ends}
            was = was if known.independent else {q["cause"]: was[q["cause"]]}
            return [{**was, q["cause"]: q["value"]}, was]
        case "explanation":
            return [{**q["set"], name: q["usual"][name]} for name in ends]
        case "diagnosis":
            shares = np.linspace(0.02, 0.98, 13)
            tried = [(n, low + shares * (high - low)) for n, (low, high) in ends.items()]
            return [{**q["usual"], n: float(x)} for n, many in tried for x in many]
    points = [{n: float(seen.rng.uniform(*e)) for n, e in ends.items()} for _ in range(24)]
    return list(q.get("dos", points))


def _informative(seen: _Seen, n: int) -> dict[str, Any]:
    """Return the experiment after which the predictions that are asked for vary least.

    The surrogate is linear and Gaussian in constant, linear, square and cubic terms: with rows X,
    n new rows Z and the terms C of what is asked, the sum of variances is trace(C (X'X + Z'Z +
    r I)^-1 C') times that of a reading. An effect, or a counterfactual, asks for a difference.

    Source:
        Chaloner and Verdinelli, *Bayesian experimental design: a review*, Statistical Science
        1995, section 2.2 (c- and A-optimality). For one number, the least variance is the largest
        expected gain of information: MacKay, *Information-based objective functions for active
        data selection*, Neural Computation 1992.
    """
    known, rng = seen.known, seen.rng
    dos, names = _asked(seen, known.query), [*known.ends]
    asked = [dos[i] for i in rng.permutation(len(dos))[:8]]
    tried: list[dict[str, Any]] = [{}, *asked] if known.query else [{}]
    for name, (low, high) in known.ends.items():
        places = [[low, high], 0.8 * low + 0.2 * high, 0.2 * low + 0.8 * high]
        tried += [{name: place} for place in places] + [known.others(name)]
    tried += [{name: known.ends[name] for name in pair} for pair in combinations(names, 2)]
    tried.append(known.others())
    new = [seen.under(do, n) for do in tried]
    wanted, rows = [seen.under(do, 8) for do in dos], seen.columns(seen.rows, seen.is_set)
    outcomes = [known.query["outcome"]] if "outcome" in (known.query or {}) else seen.outcomes
    costs = np.zeros(len(tried))
    for outcome in outcomes if set(outcomes) & {*names} else outcomes[:1]:
        causes = seen.causes(outcome, rows)
        old = _terms({c: rows[c][seen.free(outcome)] for c in causes}, causes, 1)
        c = np.stack([_terms(one, causes, 1).mean(axis=0) for one in wanted])
        terms = [_terms(one, causes, 1) for one in new]
        scale = np.maximum(np.abs(np.vstack([old, c, *terms])).max(axis=0), 1e-12)
        c = c / scale - (c / scale).mean(axis=0) * (known.kind in ("effect", "counterfactual"))
        before = (old / scale).T @ (old / scale) + PRIOR * np.eye(len(scale))
        for i, (do, one) in enumerate(zip(tried, terms, strict=True)):
            z = one / scale * (outcome not in do)
            costs[i] += np.trace(c @ np.linalg.solve(before + z.T @ z, c.T))
    return tried[int(np.argmin(costs))]


def _next(design: str, seen: _Seen, n: int) -> dict[str, Any]:
    """Return the next experiment of a design; values are drawn in the whole range."""
    names, turn = [*seen.known.ends], seen.turn
    every: list[tuple[str, ...]] = [(), *((name,) for name in names)]
    match design:
        case "random":
            turn = int(seen.rng.integers(len(every))) if turn else 0
        case "pairs":
            every = [(), *combinations(names, 2)]
        case "do_order" if turn >= len(every):
            query, graph = seen.known.query or {}, nx.DiGraph(map(tuple, seen.edges()))
            ends = [query["outcome"]] if "outcome" in query else seen.outcomes
            found = {c for end in ends if end in graph for c in nx.ancestors(graph, end)}
            every = [(name,) for name in names if name in found] or every
        case "information" if seen.rows[seen.outcomes[0]].size:  # selection may leave no row
            return _informative(seen, n)
    return {name: seen.known.ends[name] for name in every[turn % len(every)]}


def _explore(design: str, room: Laboratory) -> None:
    """Observe once, choose experiments until the budget is spent, and answer by regression."""
    known = _Known(room)
    seed = hashlib.sha256(json.dumps(known.about, sort_keys=True).encode()).digest()
    seen = _Seen(known, np.random.default_rng(int.from_bytes(seed[:8])))
    n = -(-known.budget // ROUNDS)
    while room.remaining:
        now = min(n, room.remaining)
        seen.experiment(_next(design, seen, now), now)
    room.submit(_estimated(seen, room.describe()["query"]), 0.5)


def _estimated(seen: _Seen, q: Mapping[str, Any]) -> Any:
    """Return the answer from the rows; it is the same function of them for every design."""
    kind, ends = seen.known.kind, seen.known.ends
    if kind == "graph":
        edges = [edge for edge in seen.edges() if edge not in q["known"]]
        watched = ~np.any([*seen.is_set.values()], axis=0)
        if seen.outcomes != seen.known.readable or np.sum(watched) < 8:
            return {"edges": edges, "hidden": []}
        left = {o: seen.unexplained(o, [c for c, e in edges if e == o]) for o in seen.outcomes}
        return {"edges": edges, "hidden": _confounded({o: y[watched] for o, y in left.items()})}
    dos = _asked(seen, q)
    if kind == "diagnosis":
        size = {o: float(np.std(seen.rows[o])) + 1e-12 for o in q["run"]}
        apart = [(seen.predict(o, dos) - q["run"][o]) / size[o] for o in q["run"]]
        errors = np.sum(np.square(apart), axis=0).reshape(len(ends), -1).min(axis=1)
        return [*ends][int(np.argmin(errors))]
    found = seen.predict(q["outcome"], dos)
    match kind:
        case "effect":
            return float(found[0] - found[1])
        case "counterfactual":
            return float(q["run"][q["outcome"]] + found[0] - found[1])
        case "prediction":
            return found.tolist()
        case "explanation":
            sign = 1.0 if q["fails"] == "above" else -1.0
            return [*ends][int(np.argmin(sign * found))]
    low, high = ends[q["cause"]]
    places = np.linspace(low, high, GRID)
    if kind == "law":
        return _curve(q["cause"], places, found)
    grid = np.linspace(low, high, 2001)
    near = np.argmin(np.abs(np.interp(grid, places, found) - q["target"]))
    return {q["cause"]: float(grid[near])}


DESIGNS = ("random", "one-at-a-time", "pairs", "do_order", "information")
"""How agents choose experiments; the same estimator answers for all of them."""
AGENTS: Mapping[str, Callable[[Laboratory], None]] = {
    **{name: partial(_explore, name) for name in DESIGNS},
    "ideal": ideal,
}


def play(agent: str, question: Question) -> Laboratory:
    """Run a scripted agent on a question, and return its laboratory.

    Raises:
        UnknownOption: There is no such agent.
    """
    one_of("agent", agent, tuple(AGENTS))
    room = Laboratory(question)
    AGENTS[agent](room)
    return room
