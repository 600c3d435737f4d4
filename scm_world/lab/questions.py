"""Questions about a world, with the answers that its simulation gives."""

from __future__ import annotations

import hashlib
import hmac
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple, final

import networkx as nx
import numpy as np

from scm_world._arguments import one_of, real_number, typed, whole_number
from scm_world._types import Floats
from scm_world.discovery.metrics import evaluate as evaluate_graph
from scm_world.errors import ModelError, UnknownOption
from scm_world.lab.expressions import FORM, evaluate
from scm_world.lab.worlds import RIGS, WORLDS, Knobs, Testbed, acted, testbed
from scm_world.queries import Episode, Laboratory, Plan
from scm_world.variables import Box, Draw, Hard, Linear, Mechanism

LEVELS: Mapping[str, str] = {
    "L1": "names, units and a description",
    "L2": "names",
    "L3": "masked names",
    "L4": "masked names, rescaled and shuffled",
}
PASSED, FAILED = 0.95, 0.2
"""A solver has at least the first score, and no trivial answer more than the second one."""
DRAWS, PILOT = 40, 40
"""How many draws of a seed are tried, and units whose spread is that of a reading."""
RUNS, CAUSES = 16, 5
"""How many runs of a draw are tried, and the fewest causes of which one is an answer."""
SHORTEST = 16
"""The fewest characters of a key."""


class Unusable(ModelError):
    """A draw, or a seed, that makes no question."""


# --- what an agent sees ---------------------------------------------------------------------------


@final
class LevelView:
    """A testbed under the names and scales of a level, with noise of its readings.

    Args:
        testbed: What can be set and read.
        level: A name of ``LEVELS``.
        knobs: Noise and selection.
        entropy: What all random numbers follow from.
        lot: A number in [0, 1), the same for all draws of a seed: it decides answers that are
            names.
    """

    def __init__(
        self, testbed: Testbed, level: str, knobs: Knobs, entropy: int, lot: float = 0.0
    ) -> None:
        self.testbed, self.level, self.knobs, self.entropy = testbed, level, knobs, entropy
        self.lot = lot
        rng = np.random.default_rng([entropy, 1])
        n, masked = len(testbed.quantities), level in ("L3", "L4")
        order = rng.permutation(n) if level == "L4" else np.arange(n)
        scale, shift = np.ones(n), np.zeros(n)
        if level == "L4":
            scale, shift = rng.uniform(0.3, 3.0, n) * rng.choice([-1.0, 1.0], n), rng.normal(size=n)
        self.quantities = {
            f"v{place + 1}" if masked else testbed.quantities[i].name: testbed.quantities[i]
            for place, i in enumerate(order)
        }
        self.names = {one.name: shown for shown, one in self.quantities.items()}
        self._affine = {
            shown: (float(scale[i]), float(shift[i]))
            for shown, i in zip(self.quantities, order, strict=True)
        }
        self.readable = [shown for shown, one in self.quantities.items() if one.reads]
        self._worlds = dict[bool, Laboratory]()
        pilot = self._table(self._room(True).see(PILOT))
        self._units = PILOT
        self.spread = {name: float(np.std(column)) for name, column in pilot.items()}
        self.middle = {name: float(np.median(column)) for name, column in pilot.items()}

    def _room(self, is_truth: bool) -> Laboratory:
        """Return the world with units of its own: those of answers, or those of an agent."""
        if is_truth not in self._worlds:
            self._worlds[is_truth] = Laboratory(
                self.testbed.world,
                outcomes=[self.quantities[name].reads for name in self.readable],
                seed=(self.entropy + is_truth) % 2**62,
                **self.testbed.setting,
            )
        return self._worlds[is_truth]

    def fresh(self) -> LevelView:
        """Return the same with no unit used."""
        other = object.__new__(LevelView)
        vars(other).update(vars(self), _worlds={})
        return other

    # --- scales ---------------------------------------------------------------------------------

    def shown(self, name: str, value: Any) -> Any:
        """Return a value on the scale of the level."""
        scale, shift = self._affine[name]
        return scale * value + shift

    def inner(self, name: str, value: Any) -> Any:
        """Return a shown value in the unit of the quantity."""
        scale, shift = self._affine[name]
        return (value - shift) / scale

    def ends(self, name: str) -> tuple[float, float]:
        """Return the lowest and the highest value that may be set."""
        one = self.quantities[name]
        low, high = sorted((self.shown(name, one.low), self.shown(name, one.high)))
        return low, high

    def plan(self, do: Mapping[str, Any], at: int = 0) -> dict[str, Any]:
        """Return the intervention on the world; a pair of numbers is drawn between them."""
        found = {}
        for name, value in do.items():
            one, many = self.quantities[name], np.ravel(value)
            ends = sorted((one.factor * self.inner(name, many)).tolist())
            times: dict[str, Any] = {"at": at} if at else {}
            act: Any = Hard(ends[0], **times)
            if len(ends) == 2 and one.aim:  # a command would be drawn in each step
                slope = (ends[1] - ends[0]) / (one.high - one.low)
                law = Linear(weights=(slope,), intercept=ends[0] - slope * one.low)
                act = Mechanism(law, parents=(one.aim,), **times)
            elif len(ends) == 2:
                act = Draw(Box(*ends), **times)
            found[str(one.sets)] = act
        return found

    def _table(self, samples: Mapping[str, Floats]) -> dict[str, Floats]:
        columns = samples.values()
        return {
            name: np.asarray(self.shown(name, np.ravel(column)))
            for name, column in zip(self.readable, columns, strict=True)
        }

    # --- experiments ----------------------------------------------------------------------------

    def run(self, do: Mapping[str, Any], n: int, at: int = 0) -> dict[str, Floats]:
        """Run episodes of the agent; return readings, whose noise depends on the episode only."""
        room = self._room(False)
        rngs = [np.random.default_rng([self.entropy, 2, room.spent + i]) for i in range(n)]
        table = self._table(room.do(self.plan(do, at), n) if do else room.see(n))
        drawn = self.knobs.noise * np.array([rng.normal(size=len(table)) for rng in rngs])
        return {
            name: column + self.spread[name] * drawn[:, i]
            for i, (name, column) in enumerate(table.items())
        }

    def episode(self, do: Mapping[str, Any], at: int, unit: int) -> Episode:
        """Repeat an episode of the agent, by its number."""
        setting = dict(self.testbed.setting)
        plan = Plan(self.plan(do, at)).over(setting.pop("nature", None), "nature")
        seed = self.entropy % 2**62
        return self.testbed.world.rollout(do=plan, seed=seed, episode=unit, **setting)

    # --- answers --------------------------------------------------------------------------------

    def held_out(self, do: Mapping[str, Any], n: int) -> dict[str, Floats]:
        """Return readings of units that no agent has; the same at each intervention."""
        wanted, seed = [self.quantities[name].reads for name in self.readable], self.entropy + 2
        how: dict[str, Any] = {"outcomes": wanted, "seed": seed % 2**62, **self.testbed.setting}
        return self._table(self.testbed.world.sample(n, self.plan(do), **how))

    def means(self, do: Mapping[str, Any]) -> dict[str, float]:
        """Return the mean of each reading under an intervention, over held-out units."""
        fixed = {n for n, one in self.quantities.items() if one.sets} <= {*do}
        n = 1 if fixed and self.testbed.independent else self.testbed.truth
        return {name: float(column.mean()) for name, column in self.held_out(do, n).items()}

    def unit(
        self, do: Mapping[str, Any]
    ) -> tuple[dict[str, float], Callable[..., dict[str, float]]]:
        """Return the readings of a new unit of the answers, and its counterfactuals."""
        room = self._room(True)
        number, self._units = self._units, self._units + 1
        seen = self._table(room.do(self.plan(do), 1) if do else room.see(1))

        def other(change: Mapping[str, Any]) -> dict[str, float]:
            found = self._table(room.counterfactual(number, self.plan(change)))
            return {name: float(column[0]) for name, column in found.items()}

        return {name: float(column[0]) for name, column in seen.items()}, other


# --- kinds ----------------------------------------------------------------------------------------


class Query(NamedTuple):
    """A query as the agent gets it, its answer, and what grades need."""

    text: str
    query: dict[str, Any]
    answer: Any
    scale: Any = None


class Kind(NamedTuple):
    """A kind of question.

    Attributes:
        doc: A sentence.
        form: The form of an answer.
        make: Draws a query.
        grade: Returns the score of an answer, in [0, 1].
        late: Whether the query is shown only when the budget is spent.
    """

    doc: str
    form: str
    make: Callable[[LevelView, np.random.Generator], Query]
    grade: Callable[[Any, Question], float]
    late: bool = False


def near(error: float, scale: float) -> float:
    """Return 1 for an error up to the scale, 0 from three times the scale on."""
    return float(np.clip(1.5 - 0.5 * error / scale, 0.0, 1.0))


def _pair(view: LevelView, rng: np.random.Generator) -> tuple[str, str]:
    """Draw a settable cause, and an outcome that descends from it; confounded pairs, if any."""
    made = view.testbed
    graph, outcomes = nx.DiGraph([*made.edges, *made.own]), {one.name for one in made.outcomes}
    unseen = [(f"hidden {i}", name) for i, pair in enumerate(made.confounded) for name in pair]
    every = nx.DiGraph([*graph.edges, *unseen])
    pairs = [
        (one.name, effect)
        for one in made.settable
        if one.name in graph
        for effect in sorted(nx.descendants(graph, one.name) & outcomes)
    ]
    if not pairs:
        raise Unusable(["nothing acts on an outcome"])

    def confounded(cause: str, effect: str) -> bool:
        cut = every.copy()
        cut.remove_edges_from([*every.out_edges(cause)])
        return not nx.ancestors(cut, cause).isdisjoint(nx.ancestors(cut, effect))

    pairs = [pair for pair in pairs if confounded(*pair)] or pairs
    cause, outcome = pairs[int(rng.integers(len(pairs)))]
    return view.names[cause], view.names[outcome]


def _inside(view: LevelView, name: str, share: float) -> float:
    one = view.quantities[name]
    return round(float(view.shown(name, one.low + share * (one.high - one.low))), 6)


def _graph(view: LevelView, rng: np.random.Generator) -> Query:
    made, shown = view.testbed, view.names
    text = "Which variables act directly on which, and which pairs have a hidden common cause?"
    true, query = made.edges, dict[str, Any]()
    if made.local:
        drawn = {name: _inside(view, name, rng.uniform(0.05, 0.95)) for name in _usual(view)}
        true, query = acted(made, view.plan(drawn)), {"set": drawn}
        for name, step in ((n, s) for n in drawn for s in (-0.04, 0.04)):
            apart = {**drawn, name: drawn[name] + step * float(np.diff(view.ends(name))[0])}
            if acted(made, view.plan(apart)) != true:
                raise Unusable(["a small change makes or breaks a touch"])
        text = (
            "In a run all variables are set as below. Which of them acted on which outcomes in "
            "this very run, so that an outcome were another if a variable was set slightly apart?"
        )
    edges = sorted([shown[c], shown[e]] for c, e in true)
    hidden = sorted(sorted((shown[a], shown[b])) for a, b in made.confounded)
    own = sorted([shown[c], shown[e]] for c, e in made.own)
    if not edges:
        raise Unusable(["no edge"])
    return Query(text, {**query, "known": own}, {"edges": edges, "hidden": hidden})


def _grade_graph(answer: Any, question: Question) -> float:
    names, truth = list(question.view.quantities), question.answer
    given = graph_pairs(answer, "edges", names), graph_pairs(answer, "hidden", names)
    own = {tuple(edge) for edge in question.query["known"]}
    edges = [(c, e, 0) for c, e in given[0] if (c, e) not in own]
    true = [(c, e, 0) for c, e in truth["edges"]]
    wrong = evaluate_graph(edges, true, names=names).shd
    pairs = {frozenset(pair) for pair in given[1]}
    wrong += len(pairs ^ {frozenset(pair) for pair in truth["hidden"]})
    return max(0.0, 1.0 - 2.0 * wrong / len(true))


def graph_pairs(answer: Any, part: str, names: Sequence[str]) -> list[tuple[str, str]]:
    """Return the pairs of one part of a graph that an agent gave; refuse another form."""
    found: Any = answer.get(part, ()) if isinstance(answer, Mapping) else None
    right = isinstance(found, list | tuple) and len(found) <= len(names) ** 2
    if not right or not {*answer} <= {"edges", "hidden"}:
        raise UnknownOption("answer", answer, (KINDS["graph"].form,))
    for pair in found:
        if not (
            isinstance(pair, list | tuple) and len(pair) == 2 and {*map(str, pair)} <= {*names}
        ):
            raise UnknownOption(f"pair of {part}", pair, (KINDS["graph"].form, *names))
    return [(str(a), str(b)) for a, b in found if a != b]


def _effect(view: LevelView, rng: np.random.Generator) -> Query:
    cause, outcome = _pair(view, rng)
    ends = [_inside(view, cause, share) for share in (0.2, 0.8)]
    low, high = (view.means({cause: end})[outcome] for end in ends)
    answer = high - low
    if abs(answer) < 0.3 * view.spread[outcome]:
        raise Unusable(["the effect is within the noise"])
    text = (
        f"By how much does the mean of {outcome} change if {cause} is set to {ends[1]:g} "
        f"instead of {ends[0]:g}?"
    )
    return Query(
        text,
        {"cause": cause, "outcome": outcome, "from": ends[0], "to": ends[1]},
        answer,
        0.12 * abs(answer),
    )


def _along(view: LevelView, cause: str, outcome: str) -> tuple[Any, dict[str, float], str]:
    """Return the outcome's mean by share of the cause's range, and what is held meanwhile.

    All others are held, if none acts on another.
    """
    held, words = dict[str, float](), ""
    if view.testbed.independent:
        held = {name: value for name, value in _usual(view).items() if name != cause}
        words = ", all others at their usual value"

    def reached(share: float) -> float:
        return view.means({**held, cause: _inside(view, cause, share)})[outcome]

    return reached, held, words


def _law(view: LevelView, rng: np.random.Generator) -> Query:
    cause, outcome = _pair(view, rng)
    reached, held, words = _along(view, cause, outcome)
    shares = np.linspace(0.03, 0.97, 13)
    found, places = [*map(reached, shares)], [_inside(view, cause, share) for share in shares]
    if np.std(found) < 0.2 * view.spread[outcome]:
        raise Unusable(["the law is within the noise"])
    text = (
        f"How does the mean of {outcome} depend on {cause}, if {cause} is set{words}? An "
        f"expression in {cause}, for {places[0]:g} to {places[-1]:g}."
    )
    query = {"cause": cause, "outcome": outcome, "held": held}
    return Query(text, query, {"values": places, "means": found}, 0.12 * float(np.std(found)))


def _grade_law(answer: Any, question: Question) -> float:
    if not isinstance(answer, str):
        raise UnknownOption("answer", answer, (FORM,))
    truth = question.answer
    found = evaluate(answer, {question.query["cause"]: truth["values"]})
    with np.errstate(all="ignore"):
        error = float(np.sqrt(np.mean((found - truth["means"]) ** 2)))
    return near(error, question.scale) if np.isfinite(error) else 0.0


def _prediction(view: LevelView, rng: np.random.Generator) -> Query:
    _, outcome = _pair(view, rng)
    causes = [name for name in _usual(view) if name != outcome]
    dos = [{n: _inside(view, n, rng.uniform(0.1, 0.9)) for n in causes} for _ in range(4)]
    found = [view.means(do)[outcome] for do in dos]
    drawn = view.held_out({name: view.ends(name) for name in causes}, PILOT)[outcome]
    size = float(np.std(drawn))
    if np.ptp(found) < 0.8 * size:
        raise Unusable(["all answers are alike"])
    return Query(
        f"What is the mean of {outcome} under each of these interventions?",
        {"outcome": outcome, "dos": dos},
        found,
        0.12 * size,
    )


def _grade_prediction(answer: Any, question: Question) -> float:
    n = len(question.answer)
    if not isinstance(answer, list | tuple) or len(answer) != n:
        raise UnknownOption("answer", answer, (f"a list of {n} numbers",))
    errors = np.array([real_number("answer", one) for one in answer]) - question.answer
    return near(float(np.abs(errors).max()), question.scale)


def _counterfactual(view: LevelView, rng: np.random.Generator) -> Query:
    cause, outcome = _pair(view, rng)
    run, other = view.unit({})
    one = view.quantities[cause]
    is_low = view.inner(cause, run[cause]) < 0.5 * (one.low + one.high)
    value = _inside(view, cause, 0.9 if is_low else 0.1)
    answer = other({cause: value})[outcome]
    size = abs(answer - run[outcome])
    if size < 0.3 * view.spread[outcome]:
        raise Unusable(["the effect on this unit is within the noise"])
    seen = {name: float(one) for name, one in run.items()}
    text = (
        f"In the run below {cause} was {run[cause]:.6g}. What would {outcome} have been in this "
        f"very run, had {cause} been set to {value:g} from the beginning?"
    )
    return Query(
        text, {"cause": cause, "outcome": outcome, "value": value, "run": seen}, answer, 0.12 * size
    )


def _grade_number(answer: Any, question: Question) -> float:
    return near(abs(real_number("answer", answer) - question.answer), question.scale)


def _control(view: LevelView, rng: np.random.Generator) -> Query:
    """Draw a target that is uniform in the outcome's range, so that no constant value is likely."""
    cause, outcome = _pair(view, rng)
    reached, held, words = _along(view, cause, outcome)
    if np.ptp([reached(share) for share in (0.02, 0.5, 0.98)]) < 0.4 * view.spread[outcome]:
        raise Unusable(["the outcome hardly follows"])
    shares, fine = np.linspace(0.02, 0.98, 13), np.linspace(0.02, 0.98, 1001)
    found = np.array([reached(share) for share in shares])
    inner = view.inner(outcome, found)  # the same target at every level
    wanted = inner.min() + rng.uniform(0.05, 0.95) * np.ptp(inner)
    hidden = float(fine[np.argmin(np.abs(np.interp(fine, shares, inner) - wanted))])
    target = reached(hidden)
    text = f"Which value of {cause} gives {outcome} the mean {target:.6g}{words}?"
    query = {"cause": cause, "outcome": outcome, "target": target, "held": held}
    return Query(text, query, {cause: _inside(view, cause, hidden)}, 0.03 * float(np.ptp(found)))


def _grade_control(answer: Any, question: Question) -> float:
    cause = question.query["cause"]
    if not isinstance(answer, Mapping) or {*answer} != {cause}:
        raise UnknownOption("answer", answer, (f"{{{cause!r}: a number}}",))
    low, high = question.view.ends(cause)
    value = real_number(f"answer for {cause}", answer[cause], least=low, most=high)
    do = {**question.query["held"], cause: value}
    reached = question.view.means(do)[question.query["outcome"]]
    return near(abs(reached - question.query["target"]), question.scale)


def _usual(view: LevelView) -> dict[str, float]:
    return {
        view.names[one.name]: _inside(view, view.names[one.name], 0.5)
        for one in view.testbed.settable
    }


def _target(view: LevelView) -> str:
    """Return the answer that is a name; a seed draws it, before all else, from all causes alike."""
    if len(view.testbed.causes) < CAUSES:
        said = f"names would be guessed: there are fewer than {CAUSES} causes"
        raise ModelError([f"{said}; give a world that has more, or another kind"])
    return view.names[view.testbed.causes[int(view.lot * len(view.testbed.causes))]]


def _explanation(view: LevelView, rng: np.random.Generator) -> Query:
    """Draw runs until the target decides an outcome, and nothing else does."""
    cause, usual = _target(view), _usual(view)
    for _ in range(RUNS):
        far = rng.uniform(0.2, 0.45)  # the same for all, so that distances tell nothing
        drawn = {name: _inside(view, name, 0.5 + far * rng.choice([-1, 1])) for name in usual}
        run, other = view.unit(drawn)
        without = {name: other({name: usual[name]}) for name in usual}
        for i in rng.permutation(len(view.testbed.outcomes)):
            outcome = view.names[view.testbed.outcomes[i].name]
            apart = {name: run[outcome] - seen[outcome] for name, seen in without.items()}
            sign, most = np.sign(apart[cause]), abs(apart.pop(cause))
            second = max(0.0, *(sign * one for one in apart.values()))
            if most - second > 0.3 * view.spread[outcome]:
                limit = float(run[outcome] - 0.5 * sign * (most + second))
                word = "above" if sign > 0 else "below"
                query = {"outcome": outcome, "limit": limit, "fails": word, "set": drawn}
                seen = {name: run[name] for name in run if not view.quantities[name].sets}
                text = (
                    f"In the run below {outcome} ended {word} {limit:.6g}: it failed. Which one of "
                    "the variables decided that: had it been set to its usual value, the run would "
                    "not have failed?"
                )
                return Query(text, {**query, "usual": usual, "run": seen}, cause)
    raise Unusable([f"in none of {RUNS} runs the cause that was drawn decides"])


def _diagnosis(view: LevelView, rng: np.random.Generator) -> Query:
    """Draw usual values until a deviation of the target is seen."""
    cause = _target(view)
    for _ in range(RUNS):
        usual = {name: _inside(view, name, rng.uniform(0.3, 0.7)) for name in _usual(view)}
        value = _inside(view, cause, float(rng.choice([0.08, 0.92])))
        (run, _), (still, _) = view.unit({**usual, cause: value}), view.unit(usual)
        seen = {name: one for name, one in run.items() if not view.quantities[name].sets}
        moved = [abs(seen[n] - still[n]) / view.spread[n] for n in seen if view.spread[n]]
        if max(moved) >= 0.5:
            text = (
                "In the recording below one of the variables was not at its usual value. Which one?"
            )
            return Query(text, {"usual": usual, "run": seen}, cause)
    raise Unusable([f"in none of {RUNS} recordings the deviation is seen"])


def _grade_name(answer: Any, question: Question) -> float:
    one_of("answer", answer, tuple(question.query["usual"]))
    return float(answer == question.answer)


KINDS: Mapping[str, Kind] = {
    "graph": Kind(
        "The edges, their directions, and pairs with a hidden common cause.",
        '{"edges": [[cause, effect], …], "hidden": [[name, name], …]}',
        _graph,
        _grade_graph,
    ),
    "effect": Kind("Sign and size of an average effect.", "a number", _effect, _grade_number),
    "law": Kind("How an outcome depends on a cause.", f"an expression: {FORM}", _law, _grade_law),
    "prediction": Kind(
        "An outcome under interventions that were never tried.",
        "a list of numbers",
        _prediction,
        _grade_prediction,
        late=True,
    ),
    "counterfactual": Kind(
        "An outcome of a given run, had a cause been another.",
        "a number",
        _counterfactual,
        _grade_number,
    ),
    "explanation": Kind("The variable that made a run fail.", "a name", _explanation, _grade_name),
    "control": Kind(
        "A value that brings an outcome to a target.", '{"name": number}', _control, _grade_control
    ),
    "diagnosis": Kind(
        "The variable that deviates in a recording.", "a name", _diagnosis, _grade_name
    ),
}
FILES = (".xml", ".urdf", ".mjcf")
SPEC = ("kind", "world", "seed", "level", "knobs", "draw")
"""The parts of a ``Question.spec``."""


def offers(kind: str) -> tuple[str, ...]:
    """Return the worlds that have questions of a kind; model files have all but ``"graph"``."""
    one_of("kind", kind, tuple(KINDS))
    if kind == "graph":
        return "equations", "servo", "network", "row"
    if kind in ("explanation", "diagnosis"):
        return tuple(RIGS)
    without = ("network", "row", *(("boxes",) if kind == "law" else ()))  # a touch is no expression
    return tuple(world for world in WORLDS if world not in without)


# --- questions ------------------------------------------------------------------------------------


@final
@dataclass(frozen=True)
class Question:
    """A question to a laboratory, with its answer.

    Attributes:
        kind: A name of ``KINDS``.
        world: A name of ``WORLDS``.
        seed: Number of the question.
        level: A name of ``LEVELS``: what an agent knows beforehand.
        knobs: What makes it harder.
        draw: How many draws of this seed were not used.
        view: The world, as the agent meets it.
        text: The question in words.
        query: The same as data.
        answer: The answer of the simulation; means have a sampling error.
        scale: The error up to which an answer has score 1.
        seal: The key of ``digest``: of a private question, nobody can try answers against it.
        certificate: Scores of the solver and of trivial answers, and why draws were rejected.
    """

    kind: str
    world: str
    seed: int
    level: str
    knobs: Knobs
    draw: int
    view: LevelView = field(repr=False)
    text: str
    query: Mapping[str, Any] = field(repr=False)
    answer: Any = field(repr=False)
    scale: Any = field(repr=False)
    seal: bytes = field(repr=False)
    certificate: Mapping[str, Any] | None = field(default=None, repr=False)

    @classmethod
    def of(cls, spec: Mapping[str, Any], key: str | None = None) -> Question:
        """Return the question of a ``spec``, which was certified before.

        Raises:
            UnknownOption: A part of it does not exist.
            ModelError: The draw makes no question.
        """
        if not isinstance(spec, Mapping) or {*spec} != {*SPEC}:
            raise UnknownOption("spec", spec, SPEC)
        return build(**{**spec, "knobs": Knobs(**spec["knobs"])}, key=key)

    @property
    def spec(self) -> dict[str, Any]:
        """What the question is made of again, without its key."""
        return {name: getattr(self, name) for name in SPEC} | {"knobs": asdict(self.knobs)}

    @property
    def late(self) -> bool:
        """Whether the query is shown only when the budget is spent."""
        return KINDS[self.kind].late

    @property
    def budget(self) -> int:
        """How many episodes an agent may run."""
        return self.view.testbed.budget

    def describe(self) -> dict[str, Any]:
        """Return what an agent may know."""
        view, testbed, first = self.view, self.view.testbed, self.level == "L1"
        variables = []
        for name, one in view.quantities.items():
            about: dict[str, Any] = {"name": name, "readable": one.reads is not None}
            about["settable"] = list(view.ends(name)) if one.sets else False
            variables.append(about | ({"unit": one.unit, "doc": one.doc} if first else {}))
        return {
            "kind": self.kind,
            "about": testbed.doc if first else KINDS[self.kind].doc,
            "variables": variables,
            "settable_variables_act_on_one_another": not testbed.independent,
            "noise": self.knobs.noise,
            "steps": testbed.setting.get("steps", 1),
            "budget": self.budget,
            "answer": KINDS[self.kind].form,
            "question": self.text,
            "query": dict(self.query),
        }

    @property
    def digest(self) -> str:
        """HMAC-SHA256 of the description and the answer."""
        text = json.dumps([self.describe(), self.answer], sort_keys=True)
        return hmac.new(self.seal, text.encode(), hashlib.sha256).hexdigest()

    def grade(self, answer: Any) -> float:
        """Return the score of an answer, in [0, 1].

        Raises:
            UnknownOption: The answer has another form.
        """
        return KINDS[self.kind].grade(answer, self)


def check_key(key: object) -> None:
    """Refuse a key that can be guessed and then tried on the description of a question."""
    if key is not None and not (isinstance(key, str) and len(key) >= SHORTEST):
        allowed = (f"a secret text of at least {SHORTEST} characters", "None for public questions")
        raise UnknownOption("key", type(key), allowed)


def build(
    kind: str, world: str, seed: int, level: str, knobs: Knobs, draw: int, key: str | None
) -> Question:
    """Build a draw of a question, which is not certified.

    Its random numbers follow from an HMAC-SHA256 of kind, world, seed, draw and knobs under the
    key, so that nobody without the key can make it.
    """
    is_file = kind != "graph" and isinstance(world, str) and world.endswith(FILES)
    if not is_file:
        one_of("world", world, offers(kind))
    one_of("level", level, tuple(LEVELS))
    seed, draw = whole_number("seed", seed, least=0), whole_number("draw", draw, least=0)
    check_key(key)
    secret, same, hard = (key or "").encode(), (kind, world, seed), asdict(knobs)

    def hashed(*parts: Any) -> int:
        found = hmac.new(secret, json.dumps(parts).encode(), hashlib.sha256)
        return int.from_bytes(found.digest()[:7], "big")

    entropy, lot = hashed(*same, draw, hard), hashed(*same, hard) / 256**7
    rng = np.random.default_rng([entropy, 0])
    view = LevelView(testbed(world, rng, knobs), level, knobs, entropy, lot)
    seal = hmac.new(secret, b"digest", hashlib.sha256).digest()
    return Question(kind, world, seed, level, knobs, draw, view, *KINDS[kind].make(view, rng), seal)


@typed
def question(
    kind: str,
    world: str = "equations",
    seed: int = 0,
    level: str = "L2",
    key: str | None = None,
    **knobs: Any,
) -> Question:
    """Return a certified question.

    Draws of the seed are tried in turn. The first is used that a scripted solver answers within
    the budget, with the same tools, and that no trivial answer answers.

    Args:
        kind: ``"graph"``, ``"effect"``, ``"law"``, ``"prediction"``, ``"counterfactual"``,
            ``"explanation"``, ``"control"`` or ``"diagnosis"``.
        world: A name of ``WORLDS``.
        seed: Number of the question.
        level: What an agent knows beforehand: ``"L1"`` to ``"L4"``. The world of a seed is the same
            at each level.
        key: A secret of at least 16 characters; its questions cannot be made without it.
        knobs: Values of ``Knobs``.

    Raises:
        UnknownOption: An argument does not exist.
        Unusable: No draw of the seed can be certified.
    """
    from scm_world.lab.agents import certify

    for name in knobs:
        one_of("knob", name, tuple(Knobs.__dataclass_fields__))
    settings, rejected = Knobs(**knobs), list[str]()
    for draw in range(DRAWS):
        try:
            plain = build(kind, world, seed, "L2", settings, draw, key)
        except Unusable as error:
            rejected.append(str(error))
            continue
        scores = certify(plain)
        best = max(scores["trivial"].values(), default=None)
        if best is not None and best <= FAILED:
            found = plain if level == "L2" else build(kind, world, seed, level, settings, draw, key)
            certificate = {**scores, "rejected": rejected}
            return Question(**{**vars(found), "certificate": certificate})
        why = f"the solver has {scores['solver']:.2f}"
        rejected.append(why if best is None else f"a trivial answer has {best:.2f}")
    raise Unusable([f"none of {DRAWS} draws of seed {seed} is a question: {rejected[-1]}"])
