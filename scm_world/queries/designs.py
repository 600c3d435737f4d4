"""Experiments that would determine what a recording does not: commands and starts within limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import Floats
from scm_world.errors import InterventionError, UnknownOption
from scm_world.queries.recordings import (
    TIME,
    MeasuredNumber,
    RecordedRun,
    columns_of,
    commands_of,
    limits_of,
)
from scm_world.queries.shooting import Shooting, Target, windows_of
from scm_world.queries.twins import twins_of

if TYPE_CHECKING:
    import pandas as pd

CANDIDATES = 24  # experiments that are tried for each one that is suggested
CLOSER = 6  # of these are tried with fitted start states
SHARES = (0.25, 0.5, 1.0)  # of the range of a command
HOLDS = (5, 10, 25)  # control steps of one command
SLACK = 0.01  # share of a range by which joints yield at its ends
WITHIN = 0.8  # share of a range in which starts lie
TURN = 1.0  # [rad] largest distance of a start from the default, without a range


@final
@dataclass(frozen=True, eq=False)
class Experiment:
    """A suggested experiment.

    Attributes:
        commands: The commands, shape (steps, n_actions).
        start: Where it begins: values of states; empty for the default.
        names: Names of the columns of the commands.
        control_dt: Length of a control step [s].
        before: Smallest singular value of the sensitivities without it.
        after: The same with it, and with those suggested before it.
        errors: Standard errors of the scaled parameters after it, by name.
    """

    commands: Floats
    start: Mapping[str, float]
    names: tuple[str, ...]
    control_dt: float
    before: float
    after: float
    errors: Mapping[str, float]

    def frame(self) -> pd.DataFrame:
        """Return a row for each control step: the time [s] and the commands."""
        import pandas as pd

        time = self.control_dt * np.arange(len(self.commands))
        return pd.DataFrame({TIME: time, **dict(zip(self.names, self.commands.T, strict=True))})

    def __str__(self) -> str:
        start = ", ".join(f"{name} = {value:.3g}" for name, value in self.start.items())
        errors = ", ".join(f"{name} {100.0 * error:.2g} %" for name, error in self.errors.items())
        return (
            f"{len(self.commands)} control steps from {start or 'the default start'}: smallest "
            f"singular value {self.before:.3g} → {self.after:.3g}; standard errors {errors}"
        )


def suggested(
    world: Any,
    columns: Sequence[MeasuredNumber],
    targets: Sequence[Target],
    scaled: Floats,
    noise: Floats,
    known: Floats,
    prior: float,
    window: int | None,
    n: int,
    *,
    steps: int,
    limits: Mapping[str, Any] | None,
    seed: int,
) -> tuple[Experiment, ...]:
    """Choose experiments after which the parameters have the least variance; see ``Fit.suggest``.

    Args:
        world: The world.
        columns: What is measured.
        targets: The fitted numbers.
        scaled: Their values, scaled.
        noise: Standard deviation of each column.
        known: Sensitivities of the recording, shape (m, p).
        prior: Standard deviation of the scaled parameters before anything was recorded.
        window: Number of rows of a window.
        n: Number of experiments.
        steps: Control steps of an experiment.
        limits: Ranges of columns in addition to those of commands and joints.
        seed: Seed of the candidates.

    Source:
        Chaloner and Verdinelli, *Bayesian experimental design: a review*, Statistical Science
        1995: A-optimality.
    """
    n, steps = whole_number("n", n, least=1), whole_number("steps", steps, least=2)
    chosen: list[Experiment] = []
    with twins_of(world).twin() as twin:
        twin.reset(seed=0)
        allowed, measurable = limits_of(twin, limits), columns_of(twin)
        names, dt = tuple(commands_of(twin)), twin.options.control_period
        for number in range(n):
            rng = np.random.default_rng((seed, number))
            made = [_candidate(twin, rng, steps, allowed, i) for i in range(CANDIDATES)]
            tried = [one for one in made if one is not None]
            best = _best(
                world,
                (*columns, *(measurable[c] for c in allowed if c in measurable)),
                targets,
                scaled,
                np.concatenate([noise, np.full(sum(c in measurable for c in allowed), np.inf)]),
                known,
                prior,
                window,
                tried,
                allowed,
            )
            if best is None:
                problem = (
                    f"{len(made)} sequences of {steps} control steps, which all leave the limits"
                )
                raise UnknownOption("limits", problem, ("wider limits", "fewer steps"))
            place, along = best
            before: float = _smallest(known)
            known = np.vstack([known, along])
            spread = np.linalg.inv(known.T @ known + np.eye(len(scaled)) / prior**2)
            errors = dict(zip((t.name for t in targets), np.sqrt(np.diag(spread)), strict=True))
            sent, start, _ = tried[place]
            chosen.append(Experiment(sent, start, names, dt, before, _smallest(known), errors))
    return tuple(chosen)


def _candidate(
    twin: Any, rng: Any, steps: int, limits: Mapping[str, tuple[float, float]], number: int
) -> tuple[Floats, dict[str, float], Floats] | None:
    """Return commands, a start, and its state vector; None if the world refuses the start.

    Commands are held, or sums of sines about the idle action; every other candidate has a start of
    its own.
    """
    twin.reset(seed=0)
    start: dict[str, float] = {}
    if number % 2 or not twin.compiled.n_actions:
        for name in twin.compiled.slices:
            variable = twin.model.declared(name)
            if variable.shape != () or not name.endswith(".position"):
                continue
            low, high = limits.get(name, (-np.inf, np.inf))
            here = float(twin[name])
            if np.isfinite([low, high]).all():
                middle, half = 0.5 * (low + high), 0.5 * WITHIN * (high - low)
                start[name] = float(rng.uniform(middle - half, middle + half))
            elif variable.unit == "rad":
                start[name] = float(np.clip(here + rng.uniform(-TURN, TURN), low, high))
        try:
            twin.do(start)
        except InterventionError:
            return None
    ends = np.array([limits[name] for name in commands_of(twin)]).reshape(-1, 2)
    lowest, highest = ends.T
    idle = np.clip(np.ravel(twin.task.idle(twin)), lowest, highest)
    share = SHARES[number // 2 % len(SHARES)]
    if number // 6 % 2:
        times = np.arange(steps) / steps
        waves = rng.uniform(0.5, max(steps / 16.0, 1.0), (3, len(ends)))
        phases = rng.uniform(0.0, 2.0 * np.pi, (3, len(ends)))
        signal = np.sin(2.0 * np.pi * times[:, None, None] * waves + phases).mean(axis=1)
        signal /= np.maximum(np.abs(signal).max(axis=0, initial=0.0), 1e-9)
    else:
        hold = HOLDS[number % len(HOLDS)]
        signal = np.repeat(rng.uniform(-1.0, 1.0, (-(-steps // hold), len(ends))), hold, axis=0)[
            :steps
        ]
    reach: Floats = np.where(signal > 0.0, highest - idle, idle - lowest)
    return np.clip(idle + share * reach * signal, lowest, highest), start, twin.vector.copy()


def _best(
    world: Any,
    columns: Sequence[MeasuredNumber],
    targets: Sequence[Target],
    scaled: Floats,
    noise: Floats,
    known: Floats,
    prior: float,
    window: int | None,
    tried: Sequence[tuple[Floats, dict[str, float], Floats]],
    limits: Mapping[str, tuple[float, float]],
) -> tuple[int, Floats] | None:
    """Return the number and sensitivities of the best candidate within limits; None if none is."""
    runs = [
        RecordedRun(sent, np.arange(len(sent) + 1), np.zeros((len(sent) + 1, len(columns))))
        for sent, _, _ in tried
    ]
    if not runs:
        return None
    with Shooting(world, runs, columns, targets) as shooting:
        windows = windows_of(runs, window)
        begin = [vector for _, _, vector in tried]
        starts, seen = shooting.paths(windows, scaled, begin)
        parts = [[w for w, one in enumerate(windows) if one.run == i] for i in range(len(runs))]

        def inside(number: int) -> bool:
            path = np.concatenate([seen[w] for w in parts[number]])
            for column, values in zip(columns, path.T, strict=True):
                low, high = limits.get(column.name, (-np.inf, np.inf))
                slack = SLACK * (high - low) if np.isfinite(high - low) else 0.0
                if values.min() < low - slack or values.max() > high + slack:
                    return False
            return bool(np.isfinite(path).all())

        def left(along: Floats) -> float:
            both = known.T @ known + along.T @ along + np.eye(len(scaled)) / prior**2
            return float(np.trace(np.linalg.inv(both)))

        def sensitivities(numbers: Sequence[int], *, follow: bool) -> list[Floats]:
            which = [w for number in numbers for w in parts[number]]
            groups, begin = [[windows[w]] for w in which], [starts[w] for w in which]
            active = range(len(targets))
            made = shooting.linear(groups, scaled, begin, noise, active, follow=follow)
            along = np.concatenate([one.projected[1] for one in made])
            return np.split(along, len(numbers))

        numbers = [i for i in range(len(runs)) if inside(i)]
        if not numbers:
            return None
        rough = dict(zip(numbers, sensitivities(numbers, follow=False), strict=True))
        closer = sorted(numbers, key=lambda i: left(rough[i]))[:CLOSER]
        final = dict(zip(closer, sensitivities(closer, follow=True), strict=True))
        best = min(closer, key=lambda i: left(final[i]))
        return best, final[best]


def _smallest(along: Floats) -> float:
    return float(np.linalg.svd(along, compute_uv=False)[-1]) if len(along) else 0.0
