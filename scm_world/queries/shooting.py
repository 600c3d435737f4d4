"""Multiple shooting: recorded windows, simulated from start states that are fitted, too."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple, Self, final

import numpy as np

from scm_world._patterns import as_names, fitting
from scm_world._types import Floats, Integers
from scm_world.errors import EngineFailure, InterventionError, NotIntervenable
from scm_world.models import Difference
from scm_world.queries.recordings import (
    MeasuredNumber,
    RecordedRun,
    aligned,
    labels,
    rotations_of,
)
from scm_world.queries.twins import twins_of
from scm_world.runs.processes import cores
from scm_world.variables import Box, Exogenous, Rotations
from scm_world.world import Simulation

DELAY = "delay"
"""Name of the delay of all commands [s], which can be fitted like a parameter."""

LONGEST_DELAY = 20.0  # [control steps]
ROWS = 32  # worlds that are stepped together
STEP = 1e-4  # of finite differences, in scaled units
WIDE = 1e-2
"""The same for intervals. Over such a step, an impact that comes or goes is no longer infinite."""

LOST = b"lost"  # in place of the parameters of a world whose state was lost
RANK = 1e-9  # smaller singular values of start states are zero, relative to the largest
SPREAD = 1e-3  # least scale of a start state
SLOPE = 4  # rows over which a velocity is guessed from positions
DAMPINGS = (0.0, 0.1, 10.0)  # of the steps of start states
FAR = 12.0  # largest logarithm of a positive parameter, relative to its default


@final
@dataclass(frozen=True)
class Target:
    """A fitted number: a component of a parameter, or the delay of the commands.

    Attributes:
        name: ``"upper_arm.mass"``, or ``"pole.inertia[1]"`` for a component of a vector.
        variable: Name of the variable.
        component: Which of its numbers.
        unit: Unit of the variable.
        default: Its value in the world.
        scale: What a scaled unit stands for, if ``log`` is false.
        log: Whether the scaled number is the logarithm of value : default.
        low: Lower end of its range, scaled.
        high: Upper end, scaled.
        whole: Whether all components keep their proportions to this one: those of an inertia.
    """

    name: str
    variable: str
    component: int
    unit: str
    default: float
    scale: float
    log: bool
    low: float
    high: float
    whole: bool = False

    def value(self, scaled: Any) -> Any:
        """Return the value of a scaled number, or of an array of them."""
        if self.log:
            return self.default * np.exp(scaled)
        return self.default + self.scale * scaled

    def write(self, values: Floats, scaled: float) -> None:
        """Write the value of a scaled number into the values of the variable."""
        value, flat = self.value(scaled), values.reshape(-1)
        if self.whole:
            flat *= value / flat[self.component]
        else:
            flat[self.component] = value


class Window(NamedTuple):
    """Some rows of a run, which are simulated from the instant of the first one.

    Attributes:
        run: Number of the run.
        first: The first row.
        last: The row after the last one.
    """

    run: int
    first: int
    last: int


class Derivatives(NamedTuple):
    """Residuals of what was measured and their derivatives, by windows, rows and columns.

    Attributes:
        residual: MeasuredNumber minus simulated, in standard deviations of the noise, shape (n,).
        parameters: Derivatives by scaled parameters, start states following, shape (n, p).
        slopes: How the start state of each window follows the parameters, shape (w, k, p).
        states: Derivatives by the scaled start state of each window, shape (n_w, k).
    """

    residual: Floats
    parameters: Floats
    slopes: Floats
    states: list[Floats]


def targets_of(world: Simulation, patterns: Any) -> tuple[Target, ...]:
    """Return the fitted numbers that some patterns of parameters name.

    A parameter that cannot be negative is scaled by its logarithm, any other one by its default;
    one whose default is zero by the median size of the same quantity of other elements, or 0.1. An
    inertia keeps the proportions of its components, unless these are named.

    Args:
        world: A twin of the world, at the beginning of an episode.
        patterns: Patterns of names of parameters, or of their components.

    Raises:
        UnknownVariable: A pattern fits no parameter.
        NotIntervenable: It fits something else, or a parameter that cannot be changed.
    """
    model, given = world.model, as_names(patterns)
    known = {n: n for n in world.compiled.static_names if can_be_fitted(world, n)}
    parts = {label: n for n in known for label in labels(n, model.declared(n).shape)}
    names = dict[str, None]()
    refused = dict(world.composition.system.refused)
    delayed = world.compiled.n_actions > 0 and DELAY not in known
    for pattern in given:
        if pattern in refused:
            raise NotIntervenable(pattern, str(refused[pattern]))
        if pattern in model and pattern not in known:
            raise NotIntervenable(pattern, "is not a parameter of real numbers that can be set")
        if pattern == DELAY and delayed:
            names[DELAY] = None
            continue
        found = fitting(pattern, known if pattern in known else {**known, **parts})
        for name in found:
            joint = name not in known or _kind(world, name) == "inertia"
            parts_of_it = (name,) if joint else labels(name, model.declared(name).shape)
            names |= dict.fromkeys(parts_of_it)
    targets = []
    for name in names:
        if name == DELAY and name not in parts:
            dt = world.options.control_period
            targets.append(Target(name, name, 0, "s", 0.0, dt, False, 0.0, LONGEST_DELAY))
            continue
        whole = name in known and _kind(world, name) == "inertia"
        variable: Any = model.declared(known.get(name) or parts[name])
        vector = np.ravel(np.asarray(world[variable.name], dtype=float))
        place = int(vector.argmax()) if whole else labels(variable.name, variable.shape).index(name)
        default, low, high = float(vector[place]), -np.inf, np.inf
        if isinstance(variable.bounds, Box):
            ends = variable.bounds.bounds(variable.shape, world.evaluate(()))
            low, high = (float(np.ravel(end)[place]) for end in ends)
        scale = abs(default) or float(np.abs(vector).max()) or _usual(world, variable.name)
        log = low >= 0.0 and default > 0.0
        if log:
            least, most = (math.log(max(end, 1e-300) / default) for end in (low, high))
            low, high = max(least, -FAR), min(most, FAR)
        else:
            low, high = (low - default) / scale, (high - default) / scale
        about = (name, variable.name, place, variable.unit, default, scale)
        targets.append(Target(*about, log, low, high, whole))
    return tuple(targets)


def can_be_fitted(world: Simulation, name: str) -> bool:
    """Return whether a variable is a parameter of real numbers that can be set."""
    variable = world.model.declared(name)
    return isinstance(variable, Exogenous) and variable.settable and variable.dtype == "real"


def _kind(world: Simulation, name: str) -> str:
    """Return the kind of a parameter of a model; an empty text for those of a step function."""
    rows = getattr(world.composition.system, "rows", {})
    element, _, attribute = name.rpartition(".")
    return getattr(rows.get((element, attribute)), "kind", "")


def _usual(world: Simulation, name: str) -> float:
    """Return the median size of the same quantity of other elements; 0.1 if all are zero."""
    ending = name.rpartition(".")[2]
    alike = [n for n in world.compiled.static_names if n.rpartition(".")[2] == ending]
    sizes = np.concatenate([np.abs(np.ravel(np.asarray(world[n], dtype=float))) for n in alike])
    return float(np.median(sizes[sizes > 0.0])) if (sizes > 0.0).any() else 0.1


@final
class Shooting:
    """The windows of some runs, and a batch of twins that simulates them.

    Args:
        world: The world; it is not changed.
        runs: The recorded runs.
        columns: What was measured in them.
        targets: The fitted numbers.
        window: Number of rows of a window; a whole run if None.
        begin: If nothing was measured: scaled parameters, and the first state of each run; start
            states are then simulated, else they are guessed from the measurements.

    Attributes:
        windows: The windows.
        starts: Guessed start state of each window, shape (w, size).
        spans: What a scaled unit of each free number of a start state stands for, shape (k,).
        free: Places of these numbers in a state.
    """

    def __init__(
        self,
        world: Simulation,
        runs: Sequence[RecordedRun],
        columns: Sequence[MeasuredNumber],
        targets: Sequence[Target],
        window: int | None,
        begin: tuple[Floats, Floats] | None = None,
    ) -> None:
        self.runs, self.columns, self.targets = tuple(runs), tuple(columns), tuple(targets)
        self.windows = [
            Window(number, first, last)
            for number, run in enumerate(runs)
            for first, last in pairwise(_borders(len(run.instants), window))
        ]
        self._names = tuple(dict.fromkeys(c.variable for c in columns))
        self._open = ExitStack()
        n = min(ROWS, len(self.windows) * (2 + len(targets)))
        twins = twins_of(world)
        self._batch = self._open.enter_context(twins.together(n, self._names, cores()))
        self._set: list[bytes] = [b""] * n
        self._ready = False
        self._prepare()
        first = self._batch.world(0)
        layout = first.structure.layout
        self.free: Integers = np.flatnonzero(layout.can_be_set)
        self._turned = [
            where
            for name, where in first.compiled.slices.items()
            if isinstance(first.model.declared(name).bounds, Rotations)
        ]
        places = first.row.mechanisms.where
        self._places = np.array([places[c.variable].start + c.component for c in columns])
        self.rotations = rotations_of(first, columns)
        self._values = {
            target.variable: np.array(first[target.variable], dtype=float)
            for target in targets
            if target.variable in first.model
        }
        self.starts, self.spans = self._guessed(first, begin)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    # --- start states -------------------------------------------------------------------------

    def _guessed(self, world: Any, begin: tuple[Floats, Floats] | None) -> tuple[Floats, Floats]:
        """Guess the start states: what was measured, slopes of positions, or what a run led to."""
        where, starts, paths = world.compiled.slices, [], []
        at = {c.name: i for i, c in enumerate(self.columns)}
        known = [
            (where[c.variable].start + c.component, i)
            for i, c in enumerate(self.columns)
            if c.variable in where and begin is None
        ]
        moving = []  # velocities of measured positions that were not measured
        for name in where:
            stem, _, quantity = name.rpartition(".")
            other = {"position": "velocity", "cartesian_position": "linear_velocity"}.get(quantity)
            speed = f"{stem}.{other}"
            if other is not None and speed in where and speed not in self._names:
                shape = world.model.declared(name).shape
                moving += [
                    (where[speed].start + i, at[label])
                    for i, label in enumerate(labels(name, shape))
                    if label in at
                ]
        turning = []  # angular velocities of measured orientations
        frames = {
            row.name: getattr(row, "frame", "body") for row in world.composition.system.states
        }
        for places in self.rotations:
            name = self.columns[places[0]].variable
            speed = f"{name.removesuffix('orientation')}angular_velocity"
            if name in where and speed in where and speed not in self._names:
                turning.append((where[speed], places, frames.get(speed, "body")))
        dt = world.options.control_period
        for number, run in enumerate(self.runs):
            world.reset(seed=0)
            if begin is not None:
                world.do(self.request(begin[0]))
            windows = [w for w in self.windows if w.run == number]
            seen = run.filled  # a column that this run lacks is NaN
            own = [(place, i) for place, i in known if np.isfinite(seen[0, i])]
            slopes = [(place, i) for place, i in moving if np.isfinite(seen[0, i])]
            for window, after in zip(windows, [*windows[1:], None], strict=True):
                vector = world.vector.copy()
                if begin is not None and window.first == 0:
                    vector = begin[1][number].copy()
                vector[[place for place, _ in own]] = seen[window.first, [i for _, i in own]]
                rows = slice(window.first, min(window.first + SLOPE, len(run.instants)))
                if begin is None and slopes and rows.stop - rows.start > 1:
                    time = dt * run.instants[rows]
                    which = [i for _, i in slopes]
                    vector[[place for place, _ in slopes]] = np.polyfit(
                        time - time[0], seen[rows][:, which], 1
                    )[0]
                if begin is None and turning and rows.stop - rows.start > 1:
                    from scipy.spatial.transform import Rotation

                    time = dt * run.instants[rows]
                    for speed, places, frame in turning:
                        if np.isnan(seen[0, places]).any():
                            continue
                        turned = Rotation.from_quat(seen[rows, places])
                        first = turned[0].inv()
                        turns = first * turned if frame == "body" else turned * first
                        vector[speed] = np.polyfit(time - time[0], turns.as_rotvec(), 1)[0]
                starts.append(self._place(world, vector))
                end = run.instants[after.first] if after else run.instants[window.last - 1]
                for command in run.commands[run.instants[window.first] : end]:
                    paths.append(world.vector.copy())
                    world.advance(command)
        self._ready = False
        spread = np.std([*paths, *starts], axis=0)[self.free]
        return np.array(starts), np.maximum(spread, SPREAD)

    def start(self, window: int, scaled: Floats) -> Floats:
        """Return a start state from its scaled distances to the guess, shape (size,)."""
        vector: Floats = self.starts[window].copy()
        vector[self.free] += self.spans * scaled
        return vector

    def _place(self, world: Any, vector: Floats) -> Floats:
        """Put a twin into a state, which measurements with noise may put out of its bounds."""
        for where in self._turned:
            vector[where] /= max(float(np.linalg.norm(vector[where])), 1e-9)
        world.backend.apply(Difference(state=world.compiled.empty_state(vector)))
        world.backend.read(world.state)
        world.version += 1
        return vector

    def adopt(self, other: Shooting, scaled: Floats) -> None:
        """Begin each window where another partition, which begins there, too, was fitted."""
        known = {window[:2]: w for w, window in enumerate(other.windows)}
        places = [known[window[:2]] for window in self.windows]
        self.starts = np.array([other.start(w, scaled[w]) for w in places])

    # --- simulation ---------------------------------------------------------------------------

    def _prepare(self) -> None:
        if not self._ready:
            for row in range(len(self._batch)):
                self._batch.world(row).reset(seed=0)
            self._set, self._ready = [b""] * len(self._batch), True

    def request(self, scaled: Floats) -> dict[str, Floats]:
        """Return the values of the parameters, by variable."""
        found = {name: value.copy() for name, value in self._values.items()}
        for target, number in zip(self.targets, scaled, strict=True):
            if target.variable in found:
                target.write(found[target.variable], number)
        return found

    def _commands(self, run: RecordedRun, scaled: Floats, steps: Integers) -> Floats:
        """Return the commands of some control steps, after their delay.

        A command that comes within a control step acts in proportion to its share of the step.
        """
        late = next(
            (u for t, u in zip(self.targets, scaled, strict=True) if t.variable == DELAY), 0.0
        )
        if not late or not len(run.commands):
            return run.commands[steps]
        before = np.floor(steps - late).astype(int)
        share = ((steps - late) - before)[:, None]
        last = len(run.commands) - 1
        one, other = (run.commands[np.clip(before + i, 0, last)] for i in (0, 1))
        return np.asarray((1.0 - share) * one + share * other)

    def simulate(self, tasks: Sequence[tuple[int, Floats, Floats]]) -> list[Floats]:
        """Simulate windows.

        Args:
            tasks: Number of a window, scaled parameters (p,) and start state (size,) of each.

        Returns:
            The simulated measurements of each task, shape (rows, columns); NaN after the backend
            has lost the state.

        Raises:
            InterventionError: The backend refuses a value of a parameter.
        """
        self._prepare()
        order = sorted(range(len(tasks)), key=lambda i: (tasks[i][1].tobytes(), i))
        n = min(len(self._batch), len(tasks))
        shares = [part.tolist() for part in np.array_split(np.array(order), n)]
        found: list[Floats] = [np.empty(0)] * len(tasks)
        self._ends: dict[int, Floats] = {}
        try:
            for turn in range(max(map(len, shares))):
                active = {row: share[turn] for row, share in enumerate(shares) if turn < len(share)}
                for task, values in self._survivors(tasks, active):
                    found[task] = values
        except BaseException:
            self._ready = False
            raise
        return found

    def _survivors(
        self, tasks: Sequence[tuple[int, Floats, Floats]], active: Mapping[int, int]
    ) -> Iterable[tuple[int, Floats]]:
        """Simulate one task in each row of the batch; fewer at a time if a state is lost."""
        try:
            return [*self._together(tasks, active)]
        except EngineFailure:
            for row in active:
                self._set[row] = LOST
            if len(active) > 1:
                rows = [*active.items()]
                halves = dict(rows[: len(rows) // 2]), dict(rows[len(rows) // 2 :])
                return [one for half in halves for one in self._survivors(tasks, half)]
            ((_, task),) = active.items()
            _, first, last = self.windows[tasks[task][0]]
            return [(task, np.full((last - first, len(self.columns)), np.nan))]

    def _together(
        self, tasks: Sequence[tuple[int, Floats, Floats]], active: Mapping[int, int]
    ) -> Iterable[tuple[int, Floats]]:
        """Simulate one task in each row of the batch."""
        n, size = len(self._batch), self._batch.world(0).compiled.n_actions
        steps, commands = np.zeros(n, dtype=np.int64), dict[int, Floats]()
        for row, task in active.items():
            number, scaled, vector = tasks[task]
            world, window = self._batch.world(row), self.windows[number]
            if self._set[row] == LOST:
                world.reset(seed=0)
            if self._set[row] != scaled.tobytes():
                self._set[row] = b"?"
                world.do(self.request(scaled))
                self._set[row] = scaled.tobytes()
            self._place(world, vector.copy())
            run = self.runs[window.run]
            begin = run.instants[window.first]
            end = run.instants[min(window.last, len(run.instants) - 1)]  # where the next one begins
            steps[row] = end - begin
            commands[row] = self._commands(run, scaled, np.arange(begin, end))
        longest = int(steps.max())
        seen = np.empty((longest + 1, n, len(self.columns)))
        steps[[row for row in range(n) if row not in active]] = -1
        for step in range(longest + 1):
            going = steps >= step
            if step:
                sent = np.zeros((n, size))
                for row in np.flatnonzero(going).tolist():
                    sent[row] = commands[row][step - 1]
                self._batch.advance(sent, going)
            for table, rows in self._batch.tables(np.flatnonzero(going)):
                seen[step, rows] = table.numbers[np.ix_(rows, self._places)]
        for row, task in active.items():
            window = self.windows[tasks[task][0]]
            instants = self.runs[window.run].instants[window.first : window.last]
            self._ends[task] = self._batch.world(row).vector.copy()
            yield task, seen[instants - instants[0], row].copy()

    def _steps(self, scaled: Floats, size: float) -> Floats:
        """Return the steps of finite differences: down where the range or the world ends."""
        self._prepare()
        world, steps = self._batch.world(0), np.full(len(scaled), size)
        self._set[0] = b"?"
        for i, target in enumerate(self.targets):
            for step in (size, -size):
                steps[i] = step
                try:
                    if target.low <= scaled[i] + step <= target.high:
                        world.do(self.request(scaled + step * np.eye(len(scaled))[i]))
                        break
                except InterventionError:
                    if step != size:
                        raise
        return steps

    def replay(
        self,
        run: int,
        scaled: Floats,
        starts: Floats,
        do: Mapping[str, Any],
        at: int,
    ) -> tuple[Floats, Floats]:
        """Simulate a whole run with and without an intervention, under several parameters.

        Where a window begins, the fitted state differs from the simulated one; this difference is
        what the world does not know of, and is added with the intervention, too.

        Args:
            run: Number of the run.
            scaled: Scaled parameters, shape (n, p).
            starts: Scaled start states of the windows, shape (n, w, k).
            do: The intervention.
            at: Its control step.

        Returns:
            The measurements of each row without and with the intervention, shape (n, rows,
            columns).

        Raises:
            InterventionError: The intervention was refused.
        """
        recorded, size = self.runs[run], len(self._batch) // 2
        windows = {
            int(recorded.instants[window.first]): number
            for number, window in enumerate(self.windows)
            if window.run == run
        }
        found = []
        for first in range(0, len(scaled), size):
            chunk = scaled[first : first + size]
            self._ready, count = False, len(chunk)
            self._prepare()
            rows, going = range(2 * count), np.arange(len(self._batch)) < 2 * count
            worlds: list[Any] = [self._batch.world(row) for row in rows]
            steps = np.arange(len(recorded.commands))
            sent = [self._commands(recorded, one, steps) for one in chunk] * 2
            for row, world in enumerate(worlds):
                world.do(self.request(chunk[row % count]))
                world.advance(sent[row][0])  # at the beginning, do() would begin the episode again
            seen = np.empty((len(steps) + 1, 2 * count, len(self.columns)))
            for step in range(len(steps) + 1):
                if step in windows:
                    for row in range(count):
                        number = windows[step]
                        start = self.start(number, starts[first + row, number])
                        start = aligned(start, worlds[row].vector, self._turned)
                        gap = start - worlds[row].vector
                        self._place(worlds[row], start)
                        other = (
                            worlds[row].vector if step == 0 else worlds[count + row].vector + gap
                        )
                        self._place(worlds[count + row], other.copy())
                if step == at:
                    for world in worlds[count:]:
                        world.do(do)
                for table, which in self._batch.tables(np.array(rows)):
                    seen[step, which] = table.numbers[np.ix_(which, self._places)]
                if step < len(steps):
                    commands = np.zeros((len(self._batch), worlds[0].compiled.n_actions))
                    commands[: 2 * count] = [one[step] for one in sent]
                    self._batch.advance(commands, going)
            self._ready = False
            found.append(
                seen[recorded.instants].swapaxes(0, 1).reshape(2, count, -1, len(self.columns))
            )
        plain, other = np.concatenate(found, axis=1)
        return plain, other

    # --- residuals ----------------------------------------------------------------------------

    def residual(self, window: int, simulated: Floats, noise: Floats) -> Floats:
        """Return measured minus simulated values in standard deviations, where measured, (n,)."""
        run, first, last = self.windows[window]
        measured = self.runs[run].values[first:last]
        simulated = aligned(simulated, measured, self.rotations)
        return np.asarray(((measured - simulated) / noise)[~np.isnan(measured)])

    def residuals(self, scaled: Floats, starts: Floats, noise: Floats) -> list[Floats]:
        """Return the residuals of each window."""
        tasks = [(w, scaled, self.start(w, starts[w])) for w in range(len(self.windows))]
        return [self.residual(w, one, noise) for w, one in enumerate(self.simulate(tasks))]

    def derivatives(
        self,
        scaled: Floats,
        starts: Floats,
        noise: Floats,
        which: Sequence[int] | None = None,
        *,
        follow: bool = True,
        step: float = STEP,
    ) -> Derivatives:
        """Compute derivatives by finite differences of paired rollouts.

        Args:
            scaled: Scaled parameters, shape (p,).
            starts: Scaled start states, shape (w, k).
            noise: Standard deviation of each column, shape (columns,).
            which: Numbers of the windows; all if None.
            follow: Whether start states are fitted, too, so that they follow the parameters.
            step: Step of the differences, in scaled units.

        Source:
            Kaufman, *A variable projection method for solving separable nonlinear least squares
            problems*, BIT 1975: parameters are fitted with all start states at their best.
        """
        p, k = len(scaled), len(self.free) * follow
        windows = range(len(self.windows)) if which is None else which
        steps = self._steps(scaled, step)
        tasks = []
        for w in windows:
            vector = self.start(w, starts[w])
            tasks.append((w, scaled, vector))
            tasks += [(w, scaled + steps[i] * np.eye(p)[i], vector) for i in range(p)]
            tasks += [(w, scaled, self.start(w, starts[w] + step * np.eye(k)[i])) for i in range(k)]
        simulated = self.simulate(tasks)
        residuals, along, slopes, states = list[Floats](), list[Floats](), [], list[Floats]()
        for place, w in enumerate(windows):
            rows = simulated[place * (1 + p + k) : (place + 1) * (1 + p + k)]
            base, *moved = (self.residual(w, one, noise) for one in rows)
            slope = np.array([*moved]).reshape(p + k, -1).T - base[:, None]
            slope[:, :p] /= steps
            slope[:, p:] /= step
            follows = -np.linalg.pinv(slope[:, p:], rcond=RANK) @ slope[:, :p]
            residuals.append(base)
            along.append(slope[:, :p] + slope[:, p:] @ follows)
            slopes.append(follows)
            states.append(slope[:, p:])
        parts = np.concatenate(residuals), np.concatenate(along), np.array(slopes)
        return Derivatives(*parts, states)

    def improved(
        self, scaled: Floats, starts: Floats, noise: Floats, states: Sequence[Floats]
    ) -> tuple[Floats, list[Floats]]:
        """Move each start state to the best of some places, and return the residuals there.

        These are damped steps, and where the window before it ends.

        Source:
            Marquardt, *An algorithm for least-squares estimation of nonlinear parameters*, 1963.
        """
        parts, tried = self.residuals(scaled, starts, noise), [starts.copy()]
        for w, end in self._ends.items():
            follows = w + 1 < len(starts) and self.windows[w + 1].run == self.windows[w].run
            if follows and np.isfinite(end).all():
                tried[0][w + 1] = (end - self.starts[w + 1])[self.free] / self.spans
        for damping in DAMPINGS:
            other = starts.copy()
            for w, (part, slope) in enumerate(zip(parts, states, strict=True)):
                if np.isfinite(part).all():
                    normal = slope.T @ slope
                    normal += damping * np.diag(np.diag(normal))
                    other[w] -= (
                        np.linalg.pinv(normal, rcond=RANK**2, hermitian=True) @ slope.T @ part
                    )
            tried.append(other)
        best, found = starts.copy(), list(parts)
        tasks = [
            (w, scaled, self.start(w, other[w])) for other in tried for w in range(len(starts))
        ]
        for place, values in enumerate(self.simulate(tasks)):
            trial, w = divmod(place, len(starts))
            part = self.residual(w, values, noise)
            if part @ part < found[w] @ found[w] or not np.isfinite(found[w]).all():
                best[w], found[w] = tried[trial][w], part
        return best, found


def _borders(n: int, window: int | None) -> list[int]:
    """Return where the windows of n rows begin, and n; a short rest belongs to the last one."""
    size = n if window is None else window
    firsts = [*range(0, n, size)]
    if len(firsts) > 1 and 2 * (n - firsts[-1]) < size:
        del firsts[-1]
    return [*firsts, n]
