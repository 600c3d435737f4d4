"""Experiments for parameters that a recording leaves open: commands and starts within limits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple, TypeAlias, final

import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import Floats
from scm_world.errors import EngineFailure, InterventionError, UnknownOption
from scm_world.fit.problem import FitProblem, LeastSquares, projected, spread_of, windows_of
from scm_world.fit.recordings import (
    DO,
    TIME,
    Limits,
    Measurements,
    RecordedRun,
    columns_of,
    commands_of,
    labels,
    limits_of,
    setup_of,
)
from scm_world.fit.shooting import Shooting
from scm_world.fit.targets import twin_of, values_of
from scm_world.fit.thinning import thinned
from scm_world.queries.experiments.probes import touching_pairs
from scm_world.variables import Rotations
from scm_world.world import Simulation

if TYPE_CHECKING:
    import pandas as pd

    from scm_world.fit.result import Fit

CANDIDATES = 24  # experiments that are tried for each one that is suggested
PROBES = 8  # experiments that may show a parameter which the recording does not
CLOSER = 6  # of these are tried with fitted start states
SHARES = (0.25, 0.5, 1.0)  # of the range of a command
SMALLER = 3  # times commands are halved until the limits are kept
HOLDS = (5, 10, 25)  # control steps of one command
SAME = 1e-6  # distance of a state that is left at its default
SLACK = 0.01  # share of a range by which joints yield at its ends
WITHIN = 0.8  # share of a range in which starts and commands lie
SETTLING = 50  # control steps in which drawn commands lead to a start
IMPACT = 4.0  # times the variance that an experiment with impacts leaves: these are hard to fit
TURN = 1.0  # [rad] largest distance of a start from the default, without a range

Start: TypeAlias = float | tuple[float, ...]
"""Value of a state at the start; nested tuples for an array."""


@final
@dataclass(frozen=True, eq=False)
class Experiment:
    """A suggested experiment.

    Attributes:
        commands: The commands, shape (steps, n_actions).
        start: Where it begins: values of states, a tuple for a vector; empty for the default.
        names: Names of the columns of the commands.
        control_dt: Length of a control step [s].
        before: Smallest singular value of the sensitivities without this experiment.
        after: The same with this experiment, and with those suggested before it.
        errors: Standard errors of the scaled parameters before and after it, by name.
        unseen: Parameters that no experiment seems to determine.
        do: Its set-up: values of parameters that are set for it, by columns.
    """

    commands: Floats
    start: Mapping[str, Start]
    names: tuple[str, ...]
    control_dt: float
    before: float
    after: float
    errors: Mapping[str, tuple[float, float]]
    unseen: tuple[str, ...] = ()
    do: Mapping[str, float] = field(default_factory=dict)

    def frame(self) -> pd.DataFrame:
        """Return a row for each control step: the time [s], the commands and the set-up."""
        import pandas as pd

        time = self.control_dt * np.arange(len(self.commands))
        frame = pd.DataFrame({TIME: time, **dict(zip(self.names, self.commands.T, strict=True))})
        return frame.assign(**{f"{DO}{name}": value for name, value in self.do.items()})

    def __str__(self) -> str:
        start = ", ".join(
            f"{n} = {np.array2string(np.array(v), precision=3)}" for n, v in self.start.items()
        )
        errors = ", ".join(
            f"{name} {100.0 * before:.2g} → {100.0 * after:.2g} %"
            for name, (before, after) in self.errors.items()
            if name not in self.unseen
        )
        nothing = f"; no experiment seems to determine {', '.join(self.unseen)}" * bool(self.unseen)
        steps = len(self.commands)
        setup = ", ".join(f"{name} = {value:g}" for name, value in self.do.items())
        return (
            f"with {setup}: "
            * bool(setup)
            + f"{steps} control steps ({steps * self.control_dt:.3g} s) from "
            f"{start or 'the default start'}: standard errors {errors}; smallest singular value "
            f"{self.before:.3g} → {self.after:.3g}{nothing}"
        )


class Candidate(NamedTuple):
    """Commands, a start with its state vector, and how many kinds of impacts follow."""

    commands: Floats
    start: dict[str, Start]
    vector: Floats
    impacts: int
    do: Mapping[str, float]


def suggested(
    fit: Fit,
    known: Floats,
    n: int,
    *,
    steps: int,
    limits: Limits | None,
    seed: int,
    setups: Sequence[Mapping[str, object]],
) -> tuple[Experiment, ...]:
    """Choose experiments after which the parameters have the least variance; see ``Fit.suggest``.

    ``known`` are the sensitivities of the recording to the numbers that are reported, shape (m, p).

    Source:
        Chaloner and Verdinelli, *Bayesian experimental design: a review*, Statistical Science
        1995: A-optimality.
    """
    n, steps = whole_number("n", n, least=1), whole_number("steps", steps, least=2)
    seed = whole_number("seed", seed, least=0)
    do = {**fit.asked.plan.at_start(), **values_of(fit.targets, fit.scaled)}
    every: list[Mapping[str, object]] = [{}, *setups]
    chosen = list[Experiment]()
    with twin_of(fit.asked) as twin:
        allowed, names = limits_of(twin, limits), tuple(commands_of(twin))
        for number in range(n):
            for setup in setups:
                twin.reset(seed=0)
                twin.do({**do, **setup})  # refused here, and not in each experiment
            made = list[Candidate | str]()
            for setup in every:
                rng, how = np.random.default_rng((seed, number)), (steps, allowed, setup)
                made += [_candidate(twin, do, rng, *how, i) for i in range(CANDIDATES)]
            tried = [one for one in made if isinstance(one, Candidate)]
            if not tried:
                worst = Counter(map(str, made)).most_common(1)[0][0]
                problem = f"{len(made)} sequences of {steps} control steps, which all leave the "
                problem += f"limits, most of them those of {worst}"
                raise UnknownOption("limits", problem, ("wider limits", "fewer steps"))
            best, along = _best(fit, known, tried)
            both = np.vstack([known, along])
            errors = (np.sqrt(np.diag(spread_of(one))) for one in (known, both))
            named = zip((t.name for t in fit.targets), zip(*errors, strict=True), strict=True)
            about = names, twin.options.control_period, _smallest(known), _smallest(both)
            rest = dict(named), fit.unseen, best.do
            chosen.append(Experiment(best.commands, best.start, *about, *rest))
            known = both
    return tuple(chosen)


def _candidate(
    twin: Simulation,
    do: Mapping[str, object],
    rng: np.random.Generator,
    steps: int,
    limits: Limits,
    setup: Mapping[str, object],
    number: int,
) -> Candidate | str:
    """Return an experiment that keeps the limits, or the name of a column that leaves them.

    Commands are held, or sums of sines. Of four experiments two begin at the default, one at a
    drawn start, and one at the end of drawn commands, around which its commands vary.
    """
    n_actions = twin.compiled.n_actions
    ends = np.array([limits[name] for name in commands_of(twin)]).reshape(-1, 2)
    low, high = ends.mean(axis=1) + 0.5 * WITHIN * np.diff(ends, axis=1).T * [[-1.0], [1.0]]
    signal = _signal(rng, steps, n_actions, number)
    start, left, do = dict[str, Start](), "", {**do, **setup}
    try:
        twin.reset(seed=0)
        twin.do(do)
        middle, first = np.clip(np.ravel(twin.task.idle(twin)), *ends.T), twin.values()
        if number % 4 == 3 and n_actions:
            middle = rng.uniform(low, high)
            for _ in range(SETTLING):
                twin.advance(middle)
        for name in _poses(twin) if number % 2 or not n_actions else ():
            here = np.array(twin[name], dtype=float)
            if number % 4 != 3:
                _draw(twin, name, here, rng, limits)
            if np.abs(here - first[name]).max() > SAME:
                start[name] = tuple(here.tolist()) if here.shape else float(here)
        reach = np.where(
            signal > 0.0, np.maximum(high - middle, 0.0), np.minimum(low - middle, 0.0)
        )
        for halved in range(1 + SMALLER if n_actions else 1):
            share = SHARES[number // 2 % len(SHARES)] * 0.5**halved
            twin.reset(seed=0)
            twin.do({**do, **start})
            commands, vector = middle + share * np.abs(signal) * reach, twin.vector.copy()
            left, impacts = _followed(twin, commands, limits)
            if not left:
                return Candidate(commands, start, vector, impacts, setup_of(twin, setup))
    except InterventionError:
        return "the start"
    except EngineFailure:
        return "finite numbers"
    return left


def _poses(twin: Simulation) -> list[str]:
    """Return the names of the poses of joints; bodies that move freely stay where they lie."""
    names = [name for name in twin.compiled.slices if name not in twin.compiled.bundles]
    free = {n.rpartition(".")[0] for n in names if n.endswith(".cartesian_position")}
    kept = [name for name in names if name.rpartition(".")[0] not in free or "." not in name]
    return [name for name in kept if name.endswith(("position", "positions", ".orientation"))]


def _draw(
    twin: Simulation, name: str, values: Floats, rng: np.random.Generator, limits: Limits
) -> None:
    """Draw a pose of joints in place."""
    from scipy.spatial.transform import Rotation

    variable = twin.model.declared(name)
    if isinstance(variable.bounds, Rotations):
        turned = Rotation.from_quat(values) * Rotation.from_rotvec(rng.uniform(-TURN, TURN, 3))
        values[:] = turned.as_quat()
        return
    flat = values.reshape(-1)
    for i, label in enumerate(labels(name, variable.shape)):
        least, most = limits.get(label, (-np.inf, np.inf))
        if np.isfinite([least, most]).all():
            half = 0.5 * WITHIN * (most - least)
            flat[i] = 0.5 * (least + most) + rng.uniform(-half, half)
        elif variable.unit == "rad":
            flat[i] = np.clip(flat[i] + rng.uniform(-TURN, TURN), least, most)


def _signal(rng: np.random.Generator, steps: int, n: int, number: int) -> Floats:
    """Draw n signals between -1 and 1, which are held or sums of sines, shape (steps, n)."""
    if not number // 6 % 2:
        hold = HOLDS[number % len(HOLDS)]
        drawn = rng.uniform(-1.0, 1.0, (-(-steps // hold), n))
        return np.asarray(np.repeat(drawn, hold, axis=0)[:steps])
    times = np.arange(steps) / steps
    waves = rng.uniform(0.5, max(steps / 16.0, 1.0), (3, n))
    phases = rng.uniform(0.0, 2.0 * np.pi, (3, n))
    found = np.sin(2.0 * np.pi * times[:, None, None] * waves + phases).mean(axis=1)
    return np.asarray(found / np.maximum(np.abs(found).max(axis=0, initial=0.0), 1e-9))


def _followed(twin: Simulation, commands: Floats, limits: Limits) -> tuple[str, int]:
    """Return which column leaves its limits under some commands, and how many kinds of impacts.

    The two kinds are: a state reaches an end of its range, or bodies come to press on one another.
    """
    limited = [column for name, column in columns_of(twin).items() if name in limits]
    ends = touches = False
    pressing = set[tuple[str, str]]()
    for step, command in enumerate((None, *commands)):
        if command is not None:
            twin.advance(command)
            now = touching_pairs(twin)
            touches |= step > 1 and not now <= pressing
            pressing |= now if step == 1 else set()
        for name, variable, component, _ in limited:
            low, high = limits[name]
            slack = SLACK * (high - low) if np.isfinite(high - low) else 0.0
            value = np.ravel(twin[variable])[component]
            if not low - slack <= value <= high + slack:
                return f"{name} ({low:g} to {high:g})", 0
            ends |= bool(slack and min(value - low, high - value) < slack)
    return "", int(ends) + int(touches)


def _planned(fit: Fit, tried: Sequence[Candidate]) -> Measurements:
    """Return a recording of some candidates, without values."""
    steps, size = len(tried[0].commands) + 1, len(fit.columns)
    values = np.zeros((steps, size))
    values[1:, len(fit.measured.recorded) :] = np.nan
    runs = [RecordedRun(one.commands, np.arange(steps), values, do=one.do) for one in tried]
    return thinned(replace(fit.measured, runs=tuple(runs)), fit.measured.every)


def unseen(fit: Fit, names: Sequence[str]) -> tuple[str, ...]:
    """Return the parameters that change no measurement in any of some experiments."""
    rng, do = np.random.default_rng(0), fit.asked.plan.at_start()
    with twin_of(fit.asked) as twin:
        limits = limits_of(twin, None)
        made = [_candidate(twin, do, rng, SETTLING, limits, {}, i) for i in range(PROBES)]
    tried = [one for one in made if isinstance(one, Candidate)]
    if not tried:
        return ()
    planned, found = _planned(fit, tried), list[str]()
    with Shooting(fit.asked, planned, fit.targets) as shooting:
        problem = FitProblem(shooting, planned, fit.targets, fit.noise)
        windows, vectors = windows_of(planned.runs, None), [one.vector for one in tried]
        plain = shooting.simulate(
            [(w, fit.scaled, v) for w, v in zip(windows, vectors, strict=True)]
        )
        for i in (i for i, target in enumerate(fit.targets) if target.name in names):
            changed = False
            for step in (1.0, -1.0):
                scaled = problem.within(fit.scaled + step * np.eye(len(fit.scaled))[i])
                scaled = problem.allowed(fit.scaled, scaled)
                tasks = [(w, scaled, v) for w, v in zip(windows, vectors, strict=True)]
                both = zip(shooting.simulate(tasks), plain, strict=True)
                changed |= any(not np.array_equal(a.values, b.values) for a, b in both)
            found += [fit.targets[i].name] * (not changed)
    return tuple(found)


def _best(fit: Fit, known: Floats, tried: Sequence[Candidate]) -> tuple[Candidate, Floats]:
    """Return the best candidate and its sensitivities."""
    planned, runs = _planned(fit, tried), range(len(tried))
    with Shooting(fit.asked, planned, fit.targets) as shooting:
        problem = FitProblem(shooting, planned, fit.targets, fit.noise, fit.window)
        windows = [window for (window,) in problem.windows]
        begin = np.array([tried[one.run].vector for one in windows])
        starts = shooting.carried(windows, fit.scaled, begin, np.zeros(begin.shape, np.bool_))

        def sensitivities(numbers: Sequence[int], *, follow: bool) -> dict[int, Floats]:
            which = [w for i in numbers for w, one in enumerate(windows) if one.run == i]
            groups, begin = [[windows[w]] for w in which], [starts[w] for w in which]
            squares = LeastSquares(problem, groups, fit.noise, range(len(fit.targets)))
            made = squares.linear(fit.scaled, begin, follow=follow)
            parts = np.split(projected(made)[1] @ fit.into, len(numbers))
            return dict(zip(numbers, parts, strict=True))

        def left(found: Mapping[int, Floats], i: int) -> float:
            size = float(np.trace(spread_of(np.vstack([known, found[i]]))))
            return size * IMPACT ** tried[i].impacts

        rough = sensitivities(runs, follow=False)
        closer = sorted(rough, key=lambda i: left(rough, i))[:CLOSER]
        final = sensitivities(closer, follow=True)
    best = min(closer, key=lambda i: left(final, i))
    return tried[best], final[best]


def _smallest(along: Floats) -> float:
    return float(np.linalg.svd(along, compute_uv=False)[-1]) if len(along) else 0.0
