"""Scripted agents, which use the tools only, and the certificate of a question."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from itertools import combinations, pairwise
from typing import Any

import numpy as np

from scm_world._arguments import one_of
from scm_world._types import Floats
from scm_world.lab.expressions import evaluate
from scm_world.lab.laboratory import ROWS, Laboratory
from scm_world.lab.questions import Question

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
    return {"edges": edges, "hidden": _confounded(known, edges, tables)}


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


def _confounded(known: _Known, edges: list[list[str]], tables: Mapping[str, Columns]) -> Any:
    """Return pairs whose parts without a cause are correlated in observations."""
    seen = _experiment(known.room, {}, known.room.remaining)
    left = {}
    for outcome, table in tables.items():
        causes = [c for c, e in edges if e == outcome]
        left[outcome] = seen[outcome] - _model(table, causes, table[outcome])(seen)
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
    places = np.linspace(low, high, 32 if known.query["held"] else 16)
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
    n = known.budget // (4 * len(known.ends) + 2)

    def readings(do: Mapping[str, Any], many: int) -> Floats:
        table = _experiment(known.room, do, many)
        return np.array([table[o].mean() for o in outcomes])

    usual = readings(q["usual"], 2 * n)
    run, errors = np.array([q["run"][o] for o in outcomes]), dict[str, float]()
    places: dict[str, list[Floats]] = {}
    for name, (low, high) in known.ends.items():
        shares = (0.08, 0.3, 0.7, 0.92)
        places[name] = [
            readings({**q["usual"], name: low + share * (high - low)}, n) for share in shares
        ]
    size = np.std([one for many in places.values() for one in many], axis=0) + 1e-12
    for name, many in places.items():
        line = [*many[:2], usual, *many[2:]]
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
    """Return the scores of the solver and of the trivial answers."""
    room = Laboratory(question)
    ideal(room)
    assert room.score is not None  # noqa: S101 # it has submitted
    found = {name: question.grade(answer) for name, answer in trivial(question).items()}
    if not found:
        found = {"guess": 1.0 / len(question.query["usual"])}
    return {"solver": room.score["score"], "trivial": found}


# --- further agents -------------------------------------------------------------------------------


def guess(room: Laboratory) -> None:
    """Set one variable at random, five times, and answer at random."""
    known = _Known(room)
    seed = hashlib.sha256(json.dumps(known.about, sort_keys=True).encode()).digest()
    rng = np.random.default_rng(int.from_bytes(seed[:8]))
    for _ in range(5):
        name = str(rng.choice([*known.ends]))
        room.experiment({name: float(rng.uniform(*known.ends[name]))})
    if known.query is None:  # it is asked when the budget is spent
        while room.remaining:
            room.observe(min(ROWS, room.remaining))
    q = room.describe()["query"]
    name = str(rng.choice([*known.ends]))
    edges = [[a, b] for a in known.ends for b in known.readable if a != b and rng.random() < 0.3]
    answers: dict[str, Any] = {
        "graph": {"edges": edges},
        "law": "0",
        "prediction": [0.0] * len(q.get("dos", ())),
        "control": {q.get("cause"): float(rng.uniform(*known.ends.get(q.get("cause"), (0, 1))))},
        "explanation": name,
        "diagnosis": name,
    }
    room.submit(answers.get(known.kind, float(rng.normal())), 0.2)


AGENTS: Mapping[str, Callable[[Laboratory], None]] = {"random": guess, "ideal": ideal}


def play(agent: str, question: Question) -> Laboratory:
    """Let a scripted agent answer a question, and return its laboratory.

    Raises:
        UnknownOption: There is no such agent.
    """
    one_of("agent", agent, tuple(AGENTS))
    room = Laboratory(question)
    AGENTS[agent](room)
    return room
