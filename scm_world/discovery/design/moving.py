"""Paired experiments that move several variables at once: pooled designs and color classes."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable, Sequence
from typing import TypeVar

import networkx as nx
import numpy as np

from scm_world._types import Floats
from scm_world.discovery.design import bounds
from scm_world.discovery.design.plan import Design
from scm_world.errors import ModelError
from scm_world.graph.equivalence import Bools

Cause = TypeVar("Cause")

STRATEGIES = ("largest_first", "smallest_last", "saturation_largest_first", "independent_set")
"""Greedy colorings of networkx that are tried; the best one is kept."""


# --- pooled -----------------------------------------------------------------------------------


def pooled_experiments(n: int, degree: int) -> int:
    """Propose how many random ±1 experiments find up to ``degree`` causes among n.

    Without noise, orthogonal matching pursuit then finds the causes of one effect in 98 to 100 of
    100 draws, for n from 20 to 200 and up to 4 causes.

    Source:
        Tropp and Gilbert, *Signal recovery from random measurements via orthogonal matching
        pursuit*, IEEE Transactions on Information Theory 2007: 2 d ln n in practice.

    Example:
        >>> pooled_experiments(100, 4)
        37
    """
    return max(math.ceil(2 * degree * math.log(max(n, 2))), 1)


def pooled(n: int, experiments: int, rng: np.random.Generator) -> Floats:
    """Draw a random design in which every experiment moves all variables, up or down.

    Args:
        n: Number of variables.
        experiments: How many; see ``pooled_experiments``.
        rng: Draws the signs.

    Returns:
        Shape (experiments, n), each -1 or 1. No two variables always move together or always
        against each other, for no answer could tell them apart.

    Raises:
        ModelError: So few experiments cannot tell so many variables apart.

    Example:
        >>> signs = pooled(20, 24, np.random.default_rng(0))
        >>> signs.shape, sorted(set(signs.ravel().tolist()))
        ((24, 20), [-1.0, 1.0])
    """
    if experiments < 1 or 2 ** (experiments - 1) < n:
        least = max((n - 1).bit_length() + 1, 1)
        raise ModelError([f"{n} variables need {least} or more experiments; got {experiments}"])
    signs = np.empty((experiments, 0))
    while signs.shape[1] < n:
        drawn = rng.choice([-1.0, 1.0], size=(experiments, n - signs.shape[1]))
        signs = np.hstack([signs, drawn])
        _, first = np.unique(signs * signs[0], axis=1, return_index=True)
        signs = signs[:, np.sort(first)]
    return signs


# --- colors -----------------------------------------------------------------------------------


def coloring(parents: Bools) -> Design:
    """Plan experiments in which no effect has two of its declared causes moved at once.

    All causes of one color are moved together. An effect that answers to a color without one of
    its causes has a cause that is not declared; ``bisect`` finds it.

    Args:
        parents: Declared causes by effects, shape (p, q).

    Returns:
        One experiment for each color, beside the most causes that an effect has.

    Source:
        Curtis, Powell and Reid 1974; Coleman and Moré, *Estimation of sparse Jacobian matrices and
        graph coloring problems*, SIAM Journal on Numerical Analysis 1983: columns that share a row
        must differ in color.

    Example:
        >>> print(coloring(np.array([[1, 0], [1, 1], [0, 1]], bool)))
        coloring: 2 experiments on 3 variables, at least 2 are needed
    """
    count = parents.astype(np.int64)
    network = nx.from_numpy_array(np.where(np.eye(len(count), dtype=bool), 0, count @ count.T))
    colorings = (nx.greedy_color(network, strategy) for strategy in STRATEGIES)
    best = min(colorings, key=lambda colors: len(set(colors.values())))
    classes: dict[int, list[int]] = {}
    for cause in range(len(parents)):
        classes.setdefault(best[cause], []).append(cause)
    targets = tuple(sorted(tuple(members) for members in classes.values()))
    return Design("coloring", len(parents), targets, bounds.coloring(parents))


# --- finding who did it -----------------------------------------------------------------------


def bisect(candidates: Sequence[Cause]) -> Generator[tuple[Cause, ...], bool, Cause]:
    """Ask which of some candidates did it, by halves.

    Yields the candidates to move together; send whether the effect moved. At most
    ``ceil(log2(len(candidates)))`` questions. If several did it, one of them comes out.

    Returns:
        The culprit, given that there is one among the candidates.

    Raises:
        ModelError: There is no candidate.

    Example:
        >>> questions = bisect(["a", "b", "c"])
        >>> next(questions), questions.send(False)
        (('a',), ('b',))
    """
    if not candidates:
        raise ModelError(["there is no candidate to choose from"])
    left = tuple(candidates)
    while len(left) > 1:
        half = left[: len(left) // 2]
        left = half if (yield half) else left[len(half) :]
    return left[0]


def culprit(candidates: Sequence[Cause], moves: Callable[[tuple[Cause, ...]], bool]) -> Cause:
    """Find one candidate that moves the effect; see ``bisect``.

    Args:
        candidates: At least one of them does.
        moves: Whether the effect moves if these are moved together.

    Example:
        >>> culprit(range(100), lambda asked: 42 in asked)
        42
    """
    questions = bisect(candidates)
    answer: bool | None = None
    while True:
        try:
            asked = next(questions) if answer is None else questions.send(answer)
        except StopIteration as told:
            found: Cause = told.value
            return found
        answer = moves(asked)


def culprits(
    candidates: Iterable[Cause], moves: Callable[[tuple[Cause, ...]], bool]
) -> tuple[Cause, ...]:
    """Find all candidates that move the effect: for each one more question than ``bisect``.

    Args:
        candidates: Any number of them do.
        moves: Whether the effect moves if these are moved together.

    Source:
        Hwang, *A method for detecting all defective members in a population by group testing*,
        JASA 1972, without the split into groups.

    Example:
        >>> culprits(range(100), lambda asked: 7 in asked or 42 in asked)
        (7, 42)
    """
    left, found = list(candidates), []
    while left and moves(tuple(left)):
        found.append(culprit(left, moves))
        left.remove(found[-1])
    return tuple(found)


__all__ = [
    "STRATEGIES",
    "bisect",
    "coloring",
    "culprit",
    "culprits",
    "pooled",
    "pooled_experiments",
]
