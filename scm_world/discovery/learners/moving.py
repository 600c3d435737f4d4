"""Learners that do paired experiments: one variable at a time, pooled, and by color."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import networkx as nx
import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import Floats
from scm_world.discovery.learners.found import EstimatedGraph
from scm_world.discovery.learners.simulators import SMALL, PairedSimulator, SCMSimulator
from scm_world.errors import ModelError
from scm_world.graph.equivalence import Bools
from scm_world.queries.experiments.effects import EdgeKey

TOLERANCE = 1e-4  # of the answers: what a linear account may leave, since moves are small
CONFIRMED = 6  # experiments in a row that have to come out as predicted; 3 err in 1 of 200 runs
ROUNDING = 1e-9  # of the size of the answers, in the size of the moves


def paired(simulator: PairedSimulator, *, seed: int = 0, budget: int = 1000) -> EstimatedGraph:
    """Find a graph by moving one variable at a time, in paired experiments.

    Args:
        simulator: Does the experiments.
        seed: Not used: the simulator has its own.
        budget: How many experiments there are.

    Returns:
        A graph; ``edge_scores`` are the largest effects over the threshold, in powers of ten.
    """
    del seed
    whole_number("budget", budget, least=1)
    effects = simulator.effects(budget)
    names = simulator.names
    at = {name: i for i, name in enumerate(names)}
    lags = 1 + max((lag for *_, lag in effects.largest), default=0)
    size = np.zeros((lags, len(names), len(names)))
    for (cause, effect, lag), largest in effects.largest.items():
        size[lag, at[cause], at[effect]] = largest
    ratio = size / effects.threshold
    return EstimatedGraph.of(
        names,
        ratio > 1.0,
        edge_scores=np.log10(1.0 + ratio),
        experiments=effects.rollouts,
        bound=len(names),  # each is a cause of its own; edges between instants may form cycles
        notes=(f"floor {effects.floor:g}, threshold {effects.threshold:g}",),
    )


# --- pooled -------------------------------------------------------------------------------------


def sparse_pooled(
    simulator: SCMSimulator, *, seed: int = 0, budget: int = 200, unit: int = 0
) -> EstimatedGraph:
    """Find a graph with few causes each by moving all variables together, at random.

    Every experiment moves each variable a little up or down. An answer is a weighted sum of the
    moves of its causes; few causes are found from few sums. Experiments are added until some in a
    row come out as predicted.

    Args:
        simulator: Does the experiments.
        seed: Of the moves.
        budget: How many experiments there are at most.
        unit: Which unit is run again and again.

    Returns:
        A graph; ``edge_scores`` are absolute weights. Answers that the budget did not explain have
        no causes, and a note says so.

    Source:
        Orthogonal matching pursuit: Tropp and Gilbert 2007, Algorithm 3. Bound: Donoho and Elad,
        *Optimally sparse representation in general dictionaries*, PNAS 2003.
    """
    n, q = len(simulator.causes), len(simulator.watched)
    most = min(whole_number("budget", budget, least=1) - 1, 4 * n)
    if most < 1:
        raise ModelError([f"pooled experiments need a budget of 2 or more, got {budget}"])
    signs = _signs(n, max(most, n.bit_length() + 1), np.random.default_rng(seed))[:most]
    simulator.prepare(unit)
    answers = np.empty((0, q))
    weights = np.zeros((n, q))
    open_ = np.ones(q, bool)
    settled = 0
    for count in range(1, most + 1):
        moves = dict(zip(simulator.causes, SMALL * signs[count - 1], strict=True))
        answers = np.vstack([answers, simulator.answers(moves) / SMALL])
        allowed = TOLERANCE * np.abs(answers).max(axis=0) + ROUNDING
        open_ |= np.abs(signs[count - 1] @ weights - answers[-1]) > allowed
        settled = 0 if open_.any() else settled + 1
        for j in np.flatnonzero(open_).tolist():
            found = _pursued(signs[:count], answers[:, j])
            if found is not None:
                weights[:, j], open_[j] = found, False
        if settled >= CONFIRMED:
            break
    names = simulator.names
    cause = [names.index(name) for name in simulator.causes]
    effect = [names.index(name) for name in simulator.watched]
    matrix = np.zeros((simulator.lag + 1, len(names), len(names)))
    matrix[simulator.lag][np.ix_(cause, effect)] = weights
    degree = max(1, int((weights != 0).sum(axis=0).max(initial=0)))
    left = [name for name, is_open in zip(simulator.watched, open_, strict=True) if is_open]
    notes = simulator.notes
    if left:
        notes += (f"not explained within the budget: {', '.join(left)}",)
    return EstimatedGraph.of(
        names,
        matrix,
        experiments=simulator.used,
        bound=2 * degree,  # numbers that fix so few weights and their places, in principle
        notes=notes,
    )


def _signs(n: int, experiments: int, rng: np.random.Generator) -> Floats:
    """Draw experiments that move all n variables up or down, shape (experiments, n), each -1 or 1.

    No two variables always move together or always against each other, for no answer could tell
    them apart. This takes at least ``n.bit_length() + 1`` experiments.
    """
    signs = np.empty((experiments, 0))
    while signs.shape[1] < n:
        drawn = rng.choice([-1.0, 1.0], size=(experiments, n - signs.shape[1]))
        signs = np.hstack([signs, drawn])
        _, first = np.unique(signs * signs[0], axis=1, return_index=True)
        signs = signs[:, np.sort(first)]
    return signs


def _pursued(signs: Floats, answer: Floats) -> Floats | None:
    """Explain an answer by few causes; None if that takes nearly as many as experiments."""
    scale = float(np.abs(answer).max())
    n = signs.shape[1]
    weights = np.zeros(n)
    # So many more than weights, that hardly any two of n causes moved alike in all of them.
    spare = math.ceil(2.0 * math.log2(max(n, 2)))
    if scale <= ROUNDING:
        return weights if len(answer) > spare else None
    chosen: list[int] = []
    rest = answer
    while len(chosen) + spare < len(answer):
        chosen.append(int(np.argmax(np.abs(signs.T @ rest))))
        part = np.linalg.lstsq(signs[:, chosen], answer, rcond=None)[0]
        rest = answer - signs[:, chosen] @ part
        if np.abs(rest).max() <= TOLERANCE * scale:
            weights[chosen] = np.where(np.abs(part) > TOLERANCE * scale, part, 0.0)
            return weights
    return None


# --- verification -------------------------------------------------------------------------------

STRATEGIES = ("largest_first", "smallest_last", "saturation_largest_first", "independent_set")
"""Greedy colorings of networkx that are tried; the best one is kept."""


def colored(parents: Bools) -> list[tuple[int, ...]]:
    """Part causes into colors: no effect has two of its declared causes of one color.

    Args:
        parents: Declared causes by effects, shape (p, q).

    Source:
        Coleman and Moré, *Estimation of sparse Jacobian matrices and graph coloring problems*,
        SIAM Journal on Numerical Analysis 1983: columns that share a row must differ in color.

    Example:
        >>> colored(np.array([[1, 0], [1, 1], [0, 1]], bool))
        [(0, 2), (1,)]
    """
    count = parents.astype(np.int64)
    network = nx.from_numpy_array(np.where(np.eye(len(count), dtype=bool), 0, count @ count.T))
    colorings = (nx.greedy_color(network, strategy) for strategy in STRATEGIES)
    best = min(colorings, key=lambda colors: len(set(colors.values())))
    classes: dict[int, list[int]] = {}
    for cause in range(len(parents)):
        classes.setdefault(best[cause], []).append(cause)
    return sorted(tuple(members) for members in classes.values())


def culprits(candidates: Sequence[str], moves: Callable[[Sequence[str]], bool]) -> list[str]:
    """Find all candidates that move an effect, by halves: ⌈log2 n⌉ + 1 questions for each.

    Args:
        candidates: Of which some, or none, move the effect.
        moves: Moves some of them together, and tells whether the effect moved.

    Source:
        Hwang, *A method for detecting all defective members in a population by group testing*,
        JASA 1972, without the split into groups.
    """
    rest, found = list(candidates), []
    while rest and moves(rest):
        left = rest
        while len(left) > 1:
            half = left[: len(left) // 2]
            left = half if moves(half) else left[len(half) :]
        found.append(left[0])
        rest.remove(left[0])
    return found


def verified(
    simulator: SCMSimulator,
    *,
    declared: Iterable[EdgeKey],
    seed: int = 0,
    budget: int = 1000,
    units: int = 4,
    thorough: bool = True,
) -> EstimatedGraph:
    """Check a declared graph by moving all causes of one color together.

    No effect has two declared causes of one color. So an effect that answers has the one declared
    cause in the color, or one that is not declared, which bisection finds. A cause that is not
    declared may hide behind a declared one, in the colors of every order. So in the end all
    variables are moved together but those that the most effects are declared to have, until no
    pair is left unseen.

    Args:
        simulator: Does the experiments.
        declared: Edges: cause, effect, lag; those of the simulator's lag are checked.
        seed: Of the orders and of the moves.
        budget: How many experiments there are at most, but for bisections.
        units: In how many units.
        thorough: Whether pairs that hide behind declared causes are tested, too.

    Returns:
        The edges that showed. An edge counts as seen where its effect answered to the color.
    """
    whole_number("budget", budget, least=1)
    whole_number("units", units, least=1)
    names, lag = simulator.names, simulator.lag
    rng = np.random.default_rng(seed)
    wanted = {(c, e) for c, e, at in declared if at == lag}
    account = _Account(simulator, wanted)
    colors = []
    for unit in range(units):
        if simulator.used >= budget:
            break
        simulator.prepare(unit)
        order = [simulator.causes[i] for i in rng.permutation(len(simulator.causes))]
        parents = np.array([[(c, e) in account.known for e in simulator.watched] for c in order])
        classes = colored(parents)
        colors.append(len(classes))
        for together in classes:
            account.check(_moves([order[cause] for cause in together], rng))
    while thorough and simulator.used < budget and (others := account.revealing()):
        account.check(_moves(others, rng))
    showed = sorted(account.seen | account.intruders)
    made = EstimatedGraph.of_edges(names, [(c, e, lag) for c, e in showed])
    degree = max((sum(e == effect for _, e in wanted) for effect in names), default=0)
    never = len(wanted - account.seen)
    notes = [
        f"{len(colors)} units, {min(colors, default=0)} to {max(colors, default=0)} colors each",
        f"{len(account.intruders)} edges are not declared, {never} declared ones did not show",
    ]
    if not account.looked.all():
        notes.append(f"{int((~account.looked).sum())} pairs hid behind declared causes")
    return replace(made, experiments=simulator.used, bound=degree, notes=tuple(notes))


def _moves(together: Iterable[str], rng: np.random.Generator) -> dict[str, float]:
    """Draw moves of several sizes, so that two causes do not cancel each other."""
    return {n: float(rng.choice([-1.0, 1.0]) * rng.uniform(0.05, 0.1)) for n in together}


class _Account:
    """Which edges showed, and which pairs were not tested yet.

    Attributes:
        seen: Declared edges that showed.
        intruders: Others.
        looked: Shape (causes, effects): declared, or the cause was moved without a known one.
    """

    def __init__(self, simulator: SCMSimulator, wanted: set[tuple[str, str]]) -> None:
        self._simulator, self._wanted = simulator, wanted
        self.seen: set[tuple[str, str]] = set()
        self.intruders: set[tuple[str, str]] = set()
        pairs = [[(c, e) for e in simulator.watched] for c in simulator.causes]
        itself = [[c == e and not simulator.lag for c, e in row] for row in pairs]
        self._parents = np.array([[pair in wanted for pair in row] for row in pairs])
        self.looked = self._parents | np.array(itself)

    @property
    def known(self) -> set[tuple[str, str]]:
        """Edges that are declared, or showed."""
        return self._wanted | self.intruders

    def check(self, moves: Mapping[str, float]) -> None:
        """Move some causes, and record the answers."""
        simulator = self._simulator
        here = np.array([name in moves for name in simulator.causes])
        alone = ~self._parents[here].any(axis=0)
        answered = np.abs(simulator.answers(moves)) > ROUNDING
        self.looked[np.ix_(here, alone)] = True
        for j in np.flatnonzero(answered).tolist():
            if not alone[j]:
                known = {(c, simulator.watched[j]) for c in moves}
                self.seen |= known & self._wanted
                continue

            def does(asked: Sequence[str], place: int = j) -> bool:
                return bool(abs(simulator.answers({c: moves[c] for c in asked})[place]) > ROUNDING)

            for cause in culprits(list(moves), does):
                self.intruders.add((cause, simulator.watched[j]))
                self._parents[simulator.causes.index(cause), j] = True

    def revealing(self) -> tuple[str, ...]:
        """Choose causes that, moved together, test many new pairs."""
        hidden = ~self.looked
        still, most = np.zeros(len(hidden), bool), 0
        for j in np.argsort(-hidden.sum(axis=0), kind="stable").tolist():
            fewer = still | self._parents[:, j]
            alone = ~self._parents[~fewer].any(axis=0)
            shown = int(hidden[~fewer][:, alone].sum())
            if shown > most:
                still, most = fewer, shown
        return tuple(np.array(self._simulator.causes)[~still].tolist()) if most else ()
