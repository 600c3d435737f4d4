"""Comparison of two backends: the gap of each state, sign and size of the effect of parameters."""

from __future__ import annotations

import copy
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from typing import TYPE_CHECKING, Literal, final

import numpy as np

from scm_world._arguments import MANY, whole_number
from scm_world._types import Floats, Values
from scm_world.backends import require_backend
from scm_world.errors import EngineFailure, InterventionError
from scm_world.geometry.rotations import aligned
from scm_world.policies.planning import action_range
from scm_world.queries.experiments.effects import FACTOR, RESOLUTION
from scm_world.queries.experiments.paired import engine_decided, settable
from scm_world.queries.experiments.probes import another, touching_pairs
from scm_world.queries.experiments.probes import probes as probe_states
from scm_world.queries.progress import Progress
from scm_world.queries.twins import twins_of
from scm_world.queries.verification import Outcome, Report, Row, listed, outcome
from scm_world.runs.processes import cores
from scm_world.variables import Rotations
from scm_world.world import Batch, Simulation

if TYPE_CHECKING:
    import pandas as pd

SAME = 0.95
"""Share of the clear effects whose sign must be the same."""

SCALE = 0.1
"""Fraction by which a parameter is moved towards another value."""

HORIZONS = (1, 10, 50, 200)
"""Control steps after which the gaps of states are measured."""

HELD = 10
"""Control steps for which an action is held meanwhile."""


@dataclass(frozen=True)
class ParameterEffects:
    """The effects of one parameter that are clear on both backends.

    Attributes:
        parameter: Name of the parameter.
        clear: Number of effects compared, one for each state variable and probe state.
        same: Number of effects with the same sign on both.
        low: Quantile of 10 % of the size on the second backend by that on the first.
        ratio: Median of this ratio.
        high: Quantile of 90 %.
    """

    parameter: str
    clear: int
    same: int
    low: float
    ratio: float
    high: float

    def __str__(self) -> str:
        size = f"{self.ratio:.2f} (80 % within {self.low:.2f} to {self.high:.2f})"
        return f"{self.parameter}: {self.same} of {self.clear} with the same sign, size {size}"


@dataclass(frozen=True)
class Gap:
    """The distance of a state on the two backends, some control steps after equal states.

    Attributes:
        variable: Name of the state.
        unit: Its unit, also of the gaps.
        steps: Number of control steps.
        median: Median over the probe states of the largest difference of a component.
        largest: The largest difference.
    """

    variable: str
    unit: str
    steps: int
    median: float
    largest: float

    def __str__(self) -> str:
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.variable}: median {self.median:.3g}, largest {self.largest:.3g}{unit}"


@final
class Comparison(Report):
    """Agreement of the effects of parameters on two ``backends``; ``effects`` has the clear ones.

    ``gaps`` has the distances of states without a change, ``skipped`` the number of probe states
    that are infeasible on one of the backends, and ``lost`` the number of those from which one of
    them lost its state, which count until then. ``one_sided`` has the contacts of the start pose on
    one backend only, as (backend, body, body): then agreement is not confirmed.
    """

    format: Literal["scm_world/comparison/3"] = "scm_world/comparison/3"
    task: str
    backends: tuple[str, str]
    seed: int
    probes: int
    skipped: int = 0
    lost: int = 0
    effects: tuple[ParameterEffects, ...]
    gaps: tuple[Gap, ...] = ()
    one_sided: tuple[tuple[str, str, str], ...] = ()
    seconds: float

    @property
    def share(self) -> float:
        """The share of the clear effects with the same sign; 1 if no effect is clear."""
        clear = sum(one.clear for one in self.effects)
        return sum(one.same for one in self.effects) / clear if clear else 1.0

    @property
    def outcome(self) -> Outcome:
        """``"confirmed"`` if 95 % of the clear effects have the same sign, else ``"refuted"``.

        ``"not refuted"`` without clear effects, or if bodies touch at the start on one backend.
        """
        return outcome(wrong=self.share < SAME, unseen=not self.effects or self.one_sided)

    @property
    def title(self) -> str:
        """The first line of the report."""
        return f"Comparison of {' and '.join(self.backends)} on {self.task}: {self.outcome}"

    @property
    def table(self) -> pd.DataFrame:
        """The gaps, a row for each state and number of control steps."""
        import pandas as pd

        columns = [field.name for field in fields(Gap)]
        return pd.DataFrame([asdict(one) for one in self.gaps], columns=columns)

    def rows(self) -> tuple[Row, ...]:
        """List the numbers with their meanings."""
        same = f"{100 * self.share:.1f} %" if self.effects else "none is clear"
        pairs = [f"{one} and {other} on {backend}" for backend, one, other in self.one_sided]
        touching = "in contact at the start, on one backend only", listed(pairs)
        return (
            ("probe states, seed", f"{self.probes}, {self.seed}"),
            ("states infeasible on one backend", str(self.skipped)),
            ("states lost on one backend", str(self.lost)),
            *(
                (
                    f"gap after control step {steps}",
                    listed([g for g in self.gaps if g.steps == steps]),
                )
                for steps in sorted({gap.steps for gap in self.gaps})
            ),
            *((touching,) if pairs else ()),
            ("clear effects with the same sign", same),
            *((f"effects on {self.backends[1]}", str(one)) for one in self.effects),
            ("seconds", f"{self.seconds:.1f}"),
        )


def compare_backends(
    world: Simulation,
    backend: str,
    probes: int,
    seed: int,
    steps: Sequence[int],
    progress: Progress | None,
) -> Comparison:
    """Change each parameter alike on two backends; see ``World.compare``."""
    probes = whole_number("number of probes", probes, least=1)
    require_backend(backend)
    horizons = sorted({whole_number("steps", number, least=1, most=MANY) for number in steps})
    started, task = time.perf_counter(), copy.copy(world.structures.task)
    options = {**world.made_with, "backend": backend}
    names = world.backend.name, backend
    found: dict[str, list[tuple[float, float]]] = {}
    starts = list[tuple[Values, Floats]]()
    with (
        twins_of(world).together(probes, (), cores()) as mine,
        closing(Batch._of(Simulation, probes, task, **options)) as theirs,
    ):
        one, other = mine.world(0), theirs.world(0)
        pairs = [_start_contacts(each, seed) for each in (one, other)]
        for number, probe in enumerate(probe_states(one, probes, seed)):
            one.restore(probe.snapshot)
            values = {name: one[name] for name in settable(one.model) if name in other.model}
            try:
                worlds = one, other
                for name, answers in _answers(worlds, values, probe.action, number, seed):
                    found.setdefault(name, []).extend(answers)
                starts.append((values, probe.action))
            except (InterventionError, EngineFailure):  # a state that is infeasible on one of them
                pass
            if progress is not None:
                progress(number + 1, 2 * probes)
        gaps, lost = _gaps((mine, theirs), starts, horizons, seed)
        if progress is not None:
            progress(2 * probes, 2 * probes)
    effects = []
    for name, answers in sorted(found.items()):
        first, second = np.array(answers).T
        sizes = np.quantile(np.abs(second / first), (0.1, 0.5, 0.9)).tolist()
        same = int((first * second > 0.0).sum())
        effects.append(ParameterEffects(name, len(answers), same, *sizes))
    return Comparison(
        task=world.task.name,
        backends=names,
        seed=seed,
        probes=len(starts),
        skipped=probes - len(starts),
        lost=lost,
        effects=tuple(effects),
        gaps=gaps,
        one_sided=tuple(
            (backend, *pair)
            for backend, here, there in zip(names, pairs, reversed(pairs), strict=True)
            for pair in sorted(here - there)
        ),
        seconds=time.perf_counter() - started,
    )


def _start_contacts(world: Simulation, seed: int) -> set[tuple[str, str]]:
    """Return the pairs of bodies that press on each other after an idle step from the start."""
    world.reset(seed=seed)
    world.step(world.task.idle(world))
    return touching_pairs(world)


def _common(pair: tuple[Simulation, Simulation]) -> list[str]:
    """Return the states that both have."""
    return [name for name in engine_decided(pair[0].model) if name in pair[1].model]


def _both(pair: tuple[Simulation, Simulation], names: Iterable[str]) -> Iterator[Floats]:
    """Yield variables of both, shape (2, *shape); q and -q are the same rotation."""
    for name in names:
        here, there = (np.asarray(world[name], float) for world in pair)
        if isinstance(pair[0].model.declared(name).bounds, Rotations):
            there = aligned(there, here, [slice(None)])
        yield np.array([here, there])


def _gaps(
    pair: tuple[Batch, Batch],
    starts: Sequence[tuple[Values, Floats]],
    horizons: Sequence[int],
    seed: int,
) -> tuple[tuple[Gap, ...], int]:
    """Continue both from the same numbers, with the same actions.

    The action of a start is held for ``HELD`` control steps, then random ones are.

    Returns:
        The gaps, and how many starts lost their state meanwhile.
    """
    rng, n = np.random.default_rng(seed), len(pair[0])
    goes_on, found = np.arange(n) < len(starts), list[Gap]()
    for row, (values, _) in enumerate(starts):
        for world in (batch.world(row) for batch in pair):
            world.reset(seed=seed)
            world.do(values)
    ends = action_range(pair[0].world(0))
    actions = np.array([*(action for _, action in starts), *[ends[0]] * (n - len(starts))])
    for step in range(1, horizons[-1] + 1 if starts else 0):
        if step > 1 and step % HELD == 1:
            actions = rng.uniform(*ends, actions.shape)
        for batch in pair:
            if goes_on.any():
                try:
                    batch.step(actions, where=goes_on)
                except EngineFailure as error:
                    goes_on[[*error.lost, *error.unmoved]] = False
        sizes: dict[str, list[float]] = {}
        for row in np.flatnonzero(goes_on).tolist() if step in horizons else ():
            worlds = pair[0].world(row), pair[1].world(row)
            names = _common(worlds)
            for name, (here, there) in zip(names, _both(worlds, names), strict=True):
                apart = float(np.abs(here - there).max(initial=0.0))
                sizes.setdefault(name, []).append(apart)
        for name, all_of in sizes.items():
            unit = pair[0].world(0).model.declared(name).unit
            found.append(Gap(name, unit, step, float(np.median(all_of)), max(all_of)))
    return tuple(found), len(starts) - int(goes_on.sum())


def _answers(
    pair: tuple[Simulation, Simulation],
    values: Values,
    action: Floats,
    number: int,
    seed: int,
) -> Iterator[tuple[str, list[tuple[float, float]]]]:
    """Yield the clear effects of each parameter in one state, for the same component on both.

    Two backends differ after one step even without a change, since they solve contacts
    differently. An effect is clear if it is ten times this difference on both.
    """
    model, rng = pair[0].model, np.random.default_rng((seed, number))
    states = _common(pair)
    starts = np.cumsum([0, *(np.size(pair[0][name]) for name in states)])

    def ends(change: Mapping[str, object]) -> Floats:
        """Take a step from the same numbers on both, shape (2, n)."""
        for world in pair:
            world.reset(seed=seed)
            world.do({**values, **change})
            world.step(action)
        return np.concatenate([np.reshape(both, (2, -1)) for both in _both(pair, states)], axis=1)

    base = ends({})
    apart = np.abs(base[0] - base[1])
    least = np.maximum(FACTOR * apart, RESOLUTION)
    for name in values:
        parameter = model.declared(name).role == "parameter"
        value = another(model.declared(name), values, rng, SCALE) if parameter else None
        if value is None:
            continue
        try:
            moved = ends({name: value}) - base
        except InterventionError:
            continue
        clear = np.abs(moved).min(axis=0) > least
        parts = (range(first, last) for first, last in pairwise(starts))
        best = [max(part, key=lambda at: np.abs(moved[:, at]).sum()) for part in parts]
        if found := [(moved[0, at], moved[1, at]) for at in best if clear[at]]:
            yield name, found
