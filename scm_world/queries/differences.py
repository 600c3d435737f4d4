"""How two episodes differ, and which of several causes made the difference."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any, final

import numpy as np

from scm_world._arguments import real_number, whole_number
from scm_world._types import Floats
from scm_world.errors import UnknownOption
from scm_world.queries.episodes import Episode, as_names
from scm_world.queries.outcomes import Outcome, as_outcome, is_category, read
from scm_world.variables import Natural


@final
@dataclass(frozen=True)
class Divergence:
    """How a variable differs between two episodes.

    Attributes:
        first: The first instant at which it does.
        largest: The largest difference of a component; 1 where categories differ.
        at: The instant of that.
        final: The difference at the end, shape of the variable.
    """

    first: int
    largest: float
    at: int
    final: Floats


@final
@dataclass(frozen=True)
class EpisodeDifference:
    """How two episodes differ.

    Attributes:
        variables: Those that do, by name, the earliest first.
        contacts: Pairs of bodies that touch in one of the two only: instant, pair, and 0 or 1 for
            the episode in which they do.
    """

    variables: Mapping[str, Divergence]
    contacts: tuple[tuple[int, tuple[str, str], int], ...]

    @property
    def first(self) -> int | None:
        """The first instant at which anything differs; None if nothing does."""
        return min((found.first for found in self.variables.values()), default=None)

    def __str__(self) -> str:
        if not self.variables:
            return "no difference"
        lines = [
            f"{name}: from {d.first} on, at most {d.largest:.4g} (at {d.at})"
            for name, d in self.variables.items()
        ]
        if self.contacts:
            at, pair, one = self.contacts[0]
            lines.append(
                f"{len(self.contacts)} contacts in one only, first {pair[0]}–{pair[1]} in "
                f"{'ab'[one]} at {at}"
            )
        return "\n".join(lines)


def compare(
    one: Episode, other: Episode, names: Iterable[str] | None = None, *, tolerance: float = 0.0
) -> EpisodeDifference:
    """Find out where two episodes differ.

    Args:
        one: An episode.
        other: One of as many steps.
        names: Variables to look at; all that both have if None.
        tolerance: Differences up to this do not count.

    Raises:
        UnknownOption: They are not equally long, or no episodes.
    """
    for given in (one, other):
        _check_episode(given)
    real_number("tolerance", tolerance, least=0.0)
    if one.steps != other.steps:
        raise UnknownOption("episode", other, (f"one of {one.steps} steps",))
    both = [name for name in one.names if name in set(other.names)]
    wanted = both if names is None else as_names(names)
    touching = zip(one.replay().touching, other.replay().touching, strict=True)
    found = {name: _divergence(one, other, name, tolerance) for name in wanted}
    apart = [(name, d) for name, d in found.items() if d is not None]
    contacts = tuple(
        (step, pair, which)
        for step, sets in enumerate(touching)
        for which in (0, 1)
        for pair in sorted(sets[which] - sets[1 - which])
    )
    return EpisodeDifference(dict(sorted(apart, key=lambda item: item[1].first)), contacts)


def _check_episode(given: Any) -> None:
    if not isinstance(given, Episode):
        raise UnknownOption("episode", given, ("what rollout or counterfactual gave",))


def _divergence(first: Episode, second: Episode, name: str, tolerance: float) -> Divergence | None:
    one, other = np.asarray(first[name], float), np.asarray(second[name], float)
    if one.shape != other.shape:
        return Divergence(0, float("inf"), 0, np.asarray(np.inf))
    if any(is_category(world, Outcome(name)) for _, world in first.declarations):
        one, other = (one != other).astype(float), np.zeros_like(one)
    sizes = np.abs(one - other).reshape(len(one), -1).max(axis=1, initial=0.0)
    differs, at = sizes > tolerance, int(np.argmax(sizes))
    if not differs.any():
        return None
    final = np.asarray(one[-1] - other[-1])
    return Divergence(int(np.argmax(differs)), float(sizes[at]), at, final)


@final
@dataclass(frozen=True)
class ButFor:
    """What an outcome would have been without a cause.

    Attributes:
        causes: Variables whose values were other ones.
        outcome: What it is.
        without: What it would have been.
    """

    causes: tuple[str, ...]
    outcome: Floats
    without: Floats

    @property
    def mattered(self) -> bool:
        """Whether the outcome would have been another one."""
        return not np.array_equal(self.outcome, self.without)

    @property
    def size(self) -> float:
        """By how much, at most, over the components."""
        return float(np.abs(self.outcome - self.without).max(initial=0.0))

    def __str__(self) -> str:
        verb = "mattered" if self.mattered else "did not matter"
        return f"{' and '.join(self.causes)} {verb}: {self.outcome} instead of {self.without}"


def but_for(
    episode: Episode,
    outcome: Any,
    over: Iterable[str] | Mapping[str, Any] | None = None,
    *,
    at: int = 0,
    most: int = 1,
    workers: int | None = None,
) -> tuple[ButFor, ...]:
    """Ask, for each cause, whether the outcome would have been the same without it.

    Args:
        episode: What happened.
        outcome: The name of a variable (its final value), an ``Outcome``, or a function.
        over: Causes, each with the value that it would have had instead; names alone stand for
            what they would have been by themselves, which only makes sense for what the episode
            intervened on. All of those if None.
        at: The control step from which the causes are other ones.
        most: How many causes are taken away together, at most. A set counts only where no part of
            it matters by itself.
        workers: Threads, see ``Setting``.

    Returns:
        One entry for each set of causes, those that matter first, the largest first.

    Raises:
        UnknownOption: A cause without another value was not intervened on, or an argument is none.
    """
    _check_episode(episode)
    most, at = whole_number("most", most, least=1), whole_number("at", at, least=0)
    if isinstance(over, Mapping):
        contrasts = dict(over)
    else:
        done = episode.plan
        contrasts = dict.fromkeys(done if over is None else as_names(over), Natural())
        for name in contrasts:
            if name not in done:
                allowed = (*done, f"{{{name!r}: the value that it would have had instead}}")
                raise UnknownOption("cause", name, allowed)
    wanted = as_outcome(outcome)
    actual = read(wanted, episode)
    found: list[ButFor] = []
    for size in range(1, most + 1):
        decisive = [set(entry.causes) for entry in found if entry.mattered]
        groups = [
            group
            for group in combinations(contrasts, size)
            if not any(known <= set(group) for known in decisive)
        ]
        dos = [{name: contrasts[name] for name in group} for group in groups]
        others = episode.worlds(dos, at=at, workers=workers)
        found += [
            ButFor(group, actual, read(wanted, other))
            for group, other in zip(groups, others, strict=True)
        ]
    return tuple(sorted(found, key=lambda entry: (-entry.size, len(entry.causes))))
