"""In what two backends agree, as data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal, final

import numpy as np

from scm_world.queries.experiments.effects import (
    FACTOR,
    RESOLUTION,
    EdgeKey,
    Response,
    Series,
    gap,
)
from scm_world.queries.experiments.paired import Paired
from scm_world.queries.experiments.probes import probes as probe_states
from scm_world.queries.progress import Progress, part
from scm_world.queries.verification import (
    Outcome,
    Report,
    Row,
    Verification,
    arrow,
    listed,
    named,
    outcome,
    written,
)
from scm_world.tasks import Task
from scm_world.variables import Measured
from scm_world.world import Simulation

SEEDS = 10
"""How many seeds signs are compared with, the given one and those after it."""

SAME = 0.95
"""Share of the comparable edges whose sign must be the same, over all seeds."""

SURE = 0.9
"""What this share must exceed with a confidence of 95 % if other seeds were taken."""

FACTORS = (0.0, 1.0, 3.0, FACTOR)
"""Multiples of the noise floor between the backends, for which shares are reported."""


@final
class Sign(Report):
    """One comparison of an effect on two engines.

    Attributes:
        cause: The variable that was changed.
        effect: The variable that answered.
        lag: 0 or 1.
        probe: Number of the probe state.
        seed: Of the state and of the values.
        component: Of the effect, flattened: the one that answered most.
        moves: Whether the backend decides the effect; else it is computed, alike on both.
        answers: Difference of this component on each backend, for an increase of the cause.
        apart: By how much the backends differ in this effect without any change: their noise floor.
    """

    cause: str
    effect: str
    lag: int
    probe: int
    seed: int = 0
    component: int
    moves: bool
    answers: tuple[float, float]
    apart: float

    @property
    def key(self) -> EdgeKey:
        """Cause, effect and lag."""
        return self.cause, self.effect, self.lag

    @property
    def equal(self) -> bool:
        """Whether both answers have one sign."""
        return (self.answers[0] > 0) == (self.answers[1] > 0)

    def clear(self, factor: float = FACTOR) -> bool:
        """Tell whether both answers lie well above what the backends differ by anyway."""
        return min(map(abs, self.answers)) > factor * self.apart


@final
class EdgeSigns(Report):
    """The comparisons of one edge.

    Attributes:
        cause: The variable that was changed.
        effect: The variable that answered.
        lag: 0 or 1.
        compared: In how many probe states it was seen on both engines.
        clear: In how many of them both effects lie well above the floor between the engines.
        equal: In how many of the clear ones both have one sign.
    """

    cause: str
    effect: str
    lag: int
    compared: int
    clear: int
    equal: int

    @property
    def same(self) -> bool | None:
        """Whether the sign is the same in most of the clear comparisons; None if none is."""
        return 2 * self.equal > self.clear if self.clear else None


@final
class Magnitude(Report):
    """How large the clear effects of one cause are on the second engine, by those on the first.

    Attributes:
        cause: The variable that was changed.
        compared: How many effects there are, one per edge and probe state, with one sign on both.
        ratio: Median of the second effect by the first.
        low: Quantile of 10 % of this ratio.
        high: Quantile of 90 %.
    """

    cause: str
    compared: int
    ratio: float
    low: float
    high: float


@final
class Share(Report):
    """Equal signs of what the backend decides, among effects of some clarity.

    Attributes:
        factor: How far above the noise floor between the backends both effects lie.
        compared: Comparisons, one per edge and probe state.
        equal: Those with one sign.
        edges: Edges with such a comparison.
        edges_equal: Edges whose sign is the same in most of them.
    """

    factor: float
    compared: int
    equal: int
    edges: int
    edges_equal: int


@final
class Agreement(Report):
    """Two verifications of one task, and the signs of its effects on both engines.

    Attributes:
        format: Of the file.
        task: Name of the task.
        backends: Names of the engines.
        verifications: Of each backend that was reached: both, unless it was interrupted.
        interrupted: Whether it was stopped (Ctrl-C) before it was through.
        probes: In how many probe states signs were compared, of all seeds.
        seeds: With how many seeds.
        signs: Every comparison.
        seconds: Wall time, of the verifications too.
    """

    format: Literal["scm_world/agreement/1"] = "scm_world/agreement/1"
    task: str
    backends: tuple[str, str]
    verifications: tuple[Verification, ...]
    interrupted: bool
    probes: int
    seeds: int = 1
    signs: tuple[Sign, ...]
    seconds: float

    @property
    def only(self) -> dict[str, tuple[EdgeKey, ...]]:
        """List edges that were seen on one backend only, by its name."""
        if len(self.verifications) < 2:
            return {}
        one, other = (set(found.found) for found in self.verifications)
        first, second = self.backends
        return {first: tuple(sorted(one - other)), second: tuple(sorted(other - one))}

    def edges(self, factor: float = FACTOR, *, moving: bool = False) -> tuple[EdgeSigns, ...]:
        """Make the table of edges.

        Args:
            factor: How far above the noise floor between the backends an effect is clear.
            moving: Whether to leave out effects that are computed, alike on both engines.
        """
        by_edge: dict[EdgeKey, list[Sign]] = {}
        for sign in self.signs:
            if sign.moves or not moving:
                by_edge.setdefault(sign.key, []).append(sign)
        edges = []
        for key, found in sorted(by_edge.items()):
            clear = [sign.equal for sign in found if sign.clear(factor)]
            counts = {"compared": len(found), "clear": len(clear), "equal": sum(clear)}
            edges.append(EdgeSigns(**named(key), **counts))
        return tuple(edges)

    def at(self, factor: float) -> Share:
        """Count equal signs of what the backend decides, among effects of some clarity."""
        clear = [edge for edge in self.edges(factor, moving=True) if edge.clear]
        return Share(
            factor=factor,
            compared=sum(edge.clear for edge in clear),
            equal=sum(edge.equal for edge in clear),
            edges=len(clear),
            edges_equal=sum(bool(edge.same) for edge in clear),
        )

    @property
    def share(self) -> float:
        """Comparable edges into what the backend decides with the same sign; 1 if there is none."""
        found = self.at(FACTOR)
        return found.edges_equal / found.edges if found.edges else 1.0

    @property
    def surely(self) -> float:
        """Lower bound of this share among other seeds, with a confidence of 95 %; 0 if unknown.

        Edges are counted seed by seed, and those of one seed are not taken as independent: the
        bound of a binomial distribution has the effective number of edges that the variance
        between seeds leaves.

        Source:
            Korn and Graubard, *Confidence intervals for proportions with small expected number of
            positive counts estimated from survey data*, Survey Methodology 24, 1998.
        """
        from scipy.stats import beta, t

        counts = np.array(
            [
                (found.edges_equal, found.edges)
                for seed in sorted({sign.seed for sign in self.signs})
                for found in (self._of_seed(seed).at(FACTOR),)
                if found.edges
            ],
            dtype=float,
        ).reshape(-1, 2)
        seeds, (equal, edges) = len(counts), counts.sum(axis=0)
        if seeds < 2:
            return 0.0
        share, effective = equal / edges, edges
        apart = counts[:, 0] - share * counts[:, 1]
        variance = seeds / (seeds - 1) * float((apart**2).sum()) / edges**2
        if variance > 0.0:
            narrower = (t.ppf(0.95, edges - 1) / t.ppf(0.95, seeds - 1)) ** 2
            effective = min(edges, share * (1.0 - share) / variance * narrower)
        if equal == 0.0:
            return 0.0
        return float(beta.ppf(0.05, share * effective, (1.0 - share) * effective + 1.0))

    def _of_seed(self, seed: int) -> Agreement:
        signs = tuple(sign for sign in self.signs if sign.seed == seed)
        return self.model_copy(update={"signs": signs})

    def magnitudes(self, factor: float = FACTOR) -> tuple[Magnitude, ...]:
        """Compare how large effects are on both engines, cause by cause.

        Only what the backend decides is compared, where both effects lie well above what the
        engines differ by anyway, and have one sign.

        Args:
            factor: How far above.
        """
        ratios: dict[str, list[float]] = {}
        for sign in self.signs:
            if sign.moves and sign.equal and sign.clear(factor):
                ratios.setdefault(sign.cause, []).append(sign.answers[1] / sign.answers[0])
        found = []
        for cause, each in sorted(ratios.items()):
            low, ratio, high = np.quantile(each, (0.1, 0.5, 0.9)).tolist()
            found.append(
                Magnitude(cause=cause, compared=len(each), ratio=ratio, low=low, high=high)
            )
        return tuple(found)

    @property
    def opposite(self) -> tuple[EdgeKey, ...]:
        """List edges whose clear effects do not have the same sign in most probe states."""
        return tuple((e.cause, e.effect, e.lag) for e in self.edges() if e.same is False)

    @property
    def outcome(self) -> Outcome:
        """The verdict on both backends.

        ``"refuted"`` if one verification is, or fewer than ``SAME`` of the signs agree;
        ``"confirmed"`` if both verifications are and ``SURE`` of the signs agree surely.
        """
        both = [found.outcome for found in self.verifications]
        unseen = "not refuted" in both or self.surely < SURE or self.interrupted
        return outcome(wrong="refuted" in both or self.share < SAME, unseen=unseen)

    @property
    def title(self) -> str:
        """The first line of the report."""
        return f"Agreement of {' and '.join(self.backends)} on {self.task}: {self.outcome}"

    def rows(self) -> tuple[Row, ...]:
        """List the numbers, what they mean, and whether they are good."""
        only = [
            (f"edges on {name} only", listed(map(arrow, edges)), not edges)
            for name, edges in self.only.items()
        ]
        shares = [_row(self.at(factor), self.share >= SAME) for factor in FACTORS]
        sizes = [
            f"{m.cause}: {m.ratio:.2f} (80 % within {m.low:.2f} to {m.high:.2f}, n = {m.compared})"
            for m in sorted(self.magnitudes(), key=lambda m: -abs(np.log(m.ratio)))
        ]
        first, second = self.backends
        return (
            *only,
            ("probe states with signs", f"{self.probes}, of {self.seeds} seeds", None),
            *shares,
            (
                f"at least, if seeds were others (95 %, goal {SURE:g})",
                f"{100 * self.surely:.1f} % of edges",
                self.surely >= SURE,
            ),
            ("sign not the same", listed(map(arrow, self.opposite)), None),
            (f"effects on {second} by those on {first}, causes", listed(sizes), None),
            *([("interrupted", "yes", False)] if self.interrupted else []),
            ("seconds", f"{self.seconds:.1f}", None),
        )

    def __str__(self) -> str:
        return "\n\n".join([*map(str, self.verifications), written(self.title, self.rows())])


def _row(share: Share, good: bool) -> Row:
    name = f"same sign, effects > {share.factor:g} x engines' gap"
    edges = (
        f"{share.edges_equal} of {share.edges} edges ({_percent(share.edges_equal, share.edges)})"
    )
    each = (
        f"{share.equal} of {share.compared} comparisons ({_percent(share.equal, share.compared)})"
    )
    return name, f"{edges}, {each}", good if share.factor == FACTOR else None


def _percent(part: int, whole: int) -> str:
    return f"{100 * part / whole:.1f} %" if whole else "none"


# --- the experiments ------------------------------------------------------------------------------

SAME_CHANGE = 1e-9
"""Two changes that differ by less are the same one, as far as ``do`` and reading back can tell."""

Responses = Mapping[tuple[EdgeKey, int], Response]


def compare_signs(
    task: Task | str,
    backends: tuple[str, str],
    probes: int,
    seeds: range,
    progress: Progress | None,
    options: Mapping[str, Any],
) -> tuple[Sign, ...]:
    """Experiment on two backends from the same numbers, and compare how effects answer.

    Args:
        task: A task, or the name of one.
        backends: Names of the engines.
        probes: How many states to experiment in with each seed.
        seeds: Of states and values.
        progress: Called with (finished, planned) after each probe state of each engine.
        options: Arguments of ``World``, without ``backend``.

    Raises:
        KeyboardInterrupt: It was interrupted.
    """
    found: list[list[Responses]] = []
    for number, backend in enumerate(backends):
        world = Simulation(task, backend=backend, **options)
        measured = [v for v in world.model.variables if isinstance(v, Measured)]
        found.append([])
        try:
            for turn, seed in enumerate(seeds):
                first, last = turn * probes, (turn + 1) * probes
                many = len(seeds) * probes
                share = part(progress, number * many, len(backends) * many)
                paired = Paired(world, seed, responses=True)
                series = Series(paired, many, share, done=first)
                series.run(probe_states(world, last, seed, settled=False, first=first))
                if series.done < last:
                    raise KeyboardInterrupt
                found[-1].append(series.effects.responses or {})
        finally:
            world.close()
    moves = frozenset(v.name for v in measured if v.mechanism is None)
    return tuple(
        sign
        for seed, one, other in zip(seeds, *found, strict=True)
        for sign in _signs(one, other, moves, seed)
    )


def _signs(one: Responses, other: Responses, moves: frozenset[str], seed: int) -> Iterator[Sign]:
    for key in sorted(one.keys() & other.keys()):
        edge, probe = key
        first, second = one[key], other[key]
        if first.change.shape != second.change.shape:
            continue
        if np.abs(first.change - second.change).max() > SAME_CHANGE:
            continue
        component = int(np.argmax(np.abs(first.answer) + np.abs(second.answer)))
        answers = first.answer[component], second.answer[component]
        if not RESOLUTION < min(map(abs, answers)) < np.inf:
            continue
        most = first.change[np.argmax(np.abs(first.change))]
        yield Sign(
            **named(edge),
            probe=probe,
            seed=seed,
            component=component,
            moves=edge[1] in moves and edge[2] == 1,
            answers=(float(np.sign(most) * answers[0]), float(np.sign(most) * answers[1])),
            apart=gap(first.base, second.base),
        )
