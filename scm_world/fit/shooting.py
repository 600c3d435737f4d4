"""Multiple shooting: recorded windows, simulated from start states that are fitted, too."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple, Self, final

import numpy as np

from scm_world._patterns import as_names, fitting
from scm_world._types import Floats, Integers
from scm_world.errors import EngineFailure, InterventionError, NotIntervenable
from scm_world.fit.recordings import (
    MeasuredNumber,
    RecordedRun,
    labels,
    rotations_of,
)
from scm_world.geometry.rotations import aligned
from scm_world.models import Difference
from scm_world.models.scene import SURFACES
from scm_world.queries.twins import twins_of
from scm_world.runs.processes import cores
from scm_world.variables import Box, Exogenous, Rotations
from scm_world.world import Simulation

DELAY = "delay"
"""Name of the delay of all commands [s], which can be fitted like a parameter."""

LONGEST_DELAY = 20.0  # [control steps]
ROWS = 32  # worlds that are stepped together
STEP = 1e-4  # of finite differences, in scaled units

LOST = b"lost"  # in place of the parameters of a world whose state was lost
LIFT = 10.0  # [m] between free bodies while their shapes change
SEEN = 0.1  # least change of the measurements by a scaled unit of a start state that is fitted
SPREAD = 0.02  # least scale of a start state
SHORT = 10  # rows of a segment
MOST_RESIDUAL = 1e6  # in place of residuals after a lost state
SLOPE = 4  # rows over which a velocity is guessed from positions
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
    """Rows of a run, from the first one to that before the last one, which are simulated."""

    run: int
    first: int
    last: int


class Simulated(NamedTuple):
    """Simulated measurements (rows, columns), NaN after a lost state, and the state after them."""

    values: Floats
    end: Floats


@final
@dataclass(frozen=True, eq=False)
class LinearWindow:
    """Residuals of a window, linearised in its start state and the parameters.

    A window consists of segments with start states of their own. They follow those of the first
    segment and the parameters in such a way that the linearised segments are joined.

    Attributes:
        residual: Measured minus simulated, in standard deviations of the noise, with the gaps
            between segments closed, shape (n,).
        states: Derivatives by the scaled start state, shape (n, k).
        parameters: Derivatives by scaled parameters, shape (n, p).
        moves: How the start state of each segment moves: a constant (k,), its derivatives by the
            first start state (k, k) and by the parameters (k, p).
    """

    residual: Floats
    states: Floats
    parameters: Floats
    moves: list[tuple[Floats, Floats, Floats]]

    @cached_property
    def fitted(self) -> tuple[Floats, Floats, Floats]:
        """Singular vectors and values of the states, without directions that were not seen."""
        left, sizes, right = np.linalg.svd(self.states, full_matrices=False)
        seen = sizes > SEEN
        return left[:, seen], sizes[seen], right[seen]

    @property
    def slopes(self) -> Floats:
        """How the best start state follows the parameters, shape (k, p)."""
        left, sizes, right = self.fitted
        return np.asarray(-right.T @ ((left.T @ self.parameters) / sizes[:, None]))

    @cached_property
    def projected(self) -> tuple[Floats, Floats]:
        """Residuals (n,) and derivatives by parameters (n, p), with the best start state."""
        left = self.fitted[0]
        residual = self.residual - left @ (left.T @ self.residual)
        return residual, self.parameters - left @ (left.T @ self.parameters)

    def moved(self, by: Floats, damping: float) -> list[Floats]:
        """Return the step of the start state of each segment after one of the parameters."""
        near = np.sqrt(damping * (self.states**2).sum(axis=0) + SEEN**2)
        left = np.append(self.residual + self.parameters @ by, np.zeros(len(near)))
        first = -np.linalg.lstsq(np.vstack([self.states, np.diag(near)]), left, rcond=None)[0]
        return [base + state @ first + along @ by for base, state, along in self.moves]


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
        if not isinstance(pattern, str):
            raise UnknownVariable(pattern, known)
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
    """Simulates windows of some runs in a batch of twins, from any start states.

    Args:
        world: The world; it is not changed.
        runs: The recorded runs.
        columns: Their measured columns.
        targets: The fitted numbers.

    Attributes:
        free: Places of the numbers of a state that can be set, shape (k,).
        spans: What a scaled unit of each of them stands for, shape (k,).
    """

    def __init__(
        self,
        world: Simulation,
        runs: Sequence[RecordedRun],
        columns: Sequence[MeasuredNumber],
        targets: Sequence[Target],
    ) -> None:
        self.runs, self.columns, self.targets = tuple(runs), tuple(columns), tuple(targets)
        self._names = tuple(dict.fromkeys(c.variable for c in columns))
        self._open = ExitStack()
        n = min(ROWS, 2 * sum(-(-len(run.instants) // SHORT) for run in runs) * (2 + len(targets)))
        twins = twins_of(world)
        self._batch = self._open.enter_context(twins.together(n, self._names, cores()))
        self._reset()
        first = self._batch.world(0)
        self.free: Integers = np.flatnonzero(first.structure.layout.can_be_set)
        self._turned = [
            where
            for name, where in first.compiled.slices.items()
            if isinstance(first.model.declared(name).bounds, Rotations)
        ]
        places = first.compiled.where
        self._places = np.array([places[c.variable].start + c.component for c in columns])
        self.rotations = rotations_of(first, columns)
        self._values = {
            target.variable: np.array(first[target.variable], dtype=float)
            for target in targets
            if target.variable in first.model
        }
        acting = {*self._values}.union(*map(first.model.descendants, self._values))
        follow = [name for name in first.compiled.static_names if name in acting]
        keys = first.compiled.parameter_keys
        self._keys = [keys[name] for name in follow if name in keys]
        self._written = [i for name in follow for i in range(places[name].start, places[name].stop)]
        self._apart = self._parted(first)
        self.spans = np.ones(len(self.free))
        self._last: tuple[Any, Any, Any] = (None, None, None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    # --- start states -------------------------------------------------------------------------

    def guess(self, windows: Sequence[Window]) -> Floats:
        """Guess start states from the measurements, and their spans; shape (w, size).

        These are measured numbers and slopes of measured positions; the rest is simulated from the
        window before, or the default.
        """
        world = self._batch.world(0)
        world.reset(seed=0)
        where, default = world.compiled.slices, world.vector.copy()
        at = {c.name: i for i, c in enumerate(self.columns)}
        known = [
            (where[c.variable].start + c.component, i)
            for i, c in enumerate(self.columns)
            if c.variable in where
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
        starts = np.repeat(default[None], len(windows), axis=0)
        kept = np.zeros(starts.shape, dtype=np.bool_)
        for vector, mine, (number, first, _) in zip(starts, kept, windows, strict=True):
            run = self.runs[number]
            seen = run.filled  # a column that this run lacks is NaN
            for place, i in known:
                if np.isfinite(seen[0, i]):
                    vector[place], mine[place] = seen[first, i], True
            rows = slice(first, min(first + SLOPE, len(run.instants)))
            time = world.options.control_period * run.instants[rows]
            slopes = [(place, i) for place, i in moving if np.isfinite(seen[0, i])]
            if len(time) > 1 and slopes:
                fits = np.polyfit(time - time[0], seen[rows][:, [i for _, i in slopes]], 1)[0]
                vector[[place for place, _ in slopes]] = fits
                mine[[place for place, _ in slopes]] = True
            for speed, places, frame in turning if len(time) > 1 else ():
                from scipy.spatial.transform import Rotation

                if np.isfinite(seen[0, places]).all():
                    turned = Rotation.from_quat(seen[rows, places])
                    back = turned[0].inv()
                    turns = back * turned if frame == "body" else turned * back
                    vector[speed] = np.polyfit(time - time[0], turns.as_rotvec(), 1)[0]
                    mine[speed] = True
            for places in self._turned:
                vector[places] /= max(float(np.linalg.norm(vector[places])), 1e-9)
        self._set[0] = LOST
        return self.carried(windows, np.zeros(len(self.targets)), starts, kept)

    def carried(
        self, windows: Sequence[Window], scaled: Floats, starts: Floats, kept: Any
    ) -> Floats:
        """Simulate runs, window by window; start states take the rest from the end before.

        The spread of all these states is the scale of start states from then on.

        Args:
            windows: The windows, in the order of the runs.
            scaled: Scaled parameters, shape (p,).
            starts: Start states, shape (w, size).
            kept: Which of their numbers stay, shape (w, size); the first of a run always do.
        """
        starts, ends = starts.copy(), np.empty(starts.shape)
        now = [w for w, one in enumerate(windows) if not one.first]
        while now:
            made = self.simulate([(windows[w], scaled, starts[w]) for w in now])
            for w, one in zip(now, made, strict=True):
                ends[w] = np.where(np.isfinite(one.end), one.end, starts[w])
            now = [w + 1 for w in now if w + 1 < len(windows) and windows[w + 1].first]
            for w in now:
                starts[w] = np.where(kept[w], starts[w], ends[w - 1])
        self.spans = np.maximum(np.std([*starts, *ends], axis=0)[self.free], SPREAD)
        return starts

    def moved(self, vector: Floats, by: Floats) -> Floats:
        """Return a state after a scaled step, shape (size,)."""
        found: Floats = vector.copy()
        found[self.free] += self.spans * np.clip(by, -2.0, 2.0)
        for where in self._turned:
            found[where] /= max(float(np.linalg.norm(found[where])), 1e-9)
        return found

    def gap(self, end: Floats, start: Floats) -> Floats:
        """Return the scaled distance from a start state to where the segment before it ends."""
        gap = (aligned(end, start, self._turned) - start)[self.free] / self.spans
        return np.asarray(np.nan_to_num(gap, nan=FAR, posinf=FAR, neginf=-FAR))

    def _parted(self, world: Any) -> Floats | None:
        """Return a state with all free bodies apart, where a fitted parameter is one of shapes.

        A larger body overlaps the one below it, which would be refused; fitted start states lift
        it.
        """
        rows = getattr(world.composition.system, "rows", {})
        shapes = {row.name for row in rows.values() if getattr(row, "key", ("", ""))[1] in SURFACES}
        if shapes.isdisjoint(self._values):
            return None
        vector: Floats = world.vector.copy()
        free = [name for name in world.compiled.slices if name.endswith(".cartesian_position")]
        for i, name in enumerate(free):
            vector[world.compiled.slices[name].start + 2] += LIFT * (1 + i)
        return vector

    def _write(self, world: Any, scaled: Floats) -> None:
        """Set the parameters of a twin, which is in any state afterwards."""
        if self._apart is not None:
            self._place(world, self._apart)
        world.do(self.request(scaled))

    def _copy(self, world: Any, other: Any) -> None:
        """Set the parameters of a twin to those of another one."""
        world.backend.apply(Difference(parameters=other.backend.parameters(self._keys)))
        world.row.numbers[self._written] = other.row.numbers[self._written]

    def _place(self, world: Any, vector: Floats) -> None:
        """Put a twin into a state, which measurements with noise may put out of its bounds."""
        world.backend.apply(Difference(state=world.compiled.empty_state(vector.copy())))
        world.backend.read(world.state)
        world.version += 1

    # --- simulation ---------------------------------------------------------------------------

    def _reset(self) -> None:
        for row in range(len(self._batch)):
            self._batch.world(row).reset(seed=0)
        self._set = [b""] * len(self._batch)  # the parameters of each row

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

    def simulate(self, tasks: Sequence[tuple[Window, Floats, Floats]]) -> list[Simulated]:
        """Simulate windows.

        Args:
            tasks: A window, scaled parameters (p,) and start state (size,) of each.

        Raises:
            InterventionError: The backend refuses a value of a parameter.
        """
        order = sorted(range(len(tasks)), key=lambda i: (tasks[i][1].tobytes(), i))
        turns = -(-len(tasks) // len(self._batch))
        n = -(-len(tasks) // turns)  # parameters are written to no more twins than needed
        shares = [part.tolist() for part in np.array_split(np.array(order, int), n)]
        found: list[Any] = [None] * len(tasks)
        try:
            for turn in range(max(map(len, shares))):
                active = {row: share[turn] for row, share in enumerate(shares) if turn < len(share)}
                for task, simulated in self._survivors(tasks, active):
                    found[task] = simulated
        except BaseException:
            self._reset()
            raise
        return found

    def _survivors(
        self, tasks: Sequence[tuple[Window, Floats, Floats]], active: Mapping[int, int]
    ) -> Iterable[tuple[int, Simulated]]:
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
            (_, first, last), _, vector = tasks[task]
            lost = np.full((last - first, len(self.columns)), np.nan)
            return [(task, Simulated(lost, np.full(len(vector), np.nan)))]

    def _together(
        self, tasks: Sequence[tuple[Window, Floats, Floats]], active: Mapping[int, int]
    ) -> Iterable[tuple[int, Simulated]]:
        """Simulate one task in each row of the batch."""
        n, size = len(self._batch), self._batch.world(0).compiled.n_actions
        steps, commands = np.full(n, -1, dtype=np.int64), dict[int, Floats]()
        for row, task in active.items():
            window, scaled, vector = tasks[task]
            world = self._batch.world(row)
            if self._set[row] == LOST:
                world.reset(seed=0)
            if self._set[row] != scaled.tobytes():
                alike = self._set.index(scaled.tobytes()) if scaled.tobytes() in self._set else None
                self._set[row] = b"?"
                if alike is None:
                    self._write(world, scaled)
                else:
                    self._copy(world, self._batch.world(alike))
                self._set[row] = scaled.tobytes()
            self._place(world, vector)
            run = self.runs[window.run]
            begin = run.instants[window.first]
            end = run.instants[min(window.last, len(run.instants) - 1)]  # where the next one begins
            steps[row] = end - begin
            commands[row] = self._commands(run, scaled, np.arange(begin, end))
        longest = int(steps.max())
        seen = np.empty((longest + 1, n, len(self.columns)))
        for step in range(longest + 1):
            going = steps >= step
            if step:
                sent = np.zeros((n, size))
                for row in np.flatnonzero(going).tolist():
                    sent[row] = commands[row][step - 1]
                self._batch.advance(sent, going)
            for table, rows in self._batch._by_structure(np.flatnonzero(going)):
                seen[step, rows] = table.numbers[np.ix_(rows, self._places)]
        for row, task in active.items():
            window = tasks[task][0]
            instants = self.runs[window.run].instants[window.first : window.last]
            values = seen[instants - instants[0], row].copy()
            yield task, Simulated(values, self._batch.world(row).vector.copy())

    def steps(self, scaled: Floats, size: float, active: Sequence[int]) -> Floats:
        """Return the steps of finite differences: down, or small, where a range ends."""
        world, steps = self._batch.world(0), np.full(len(scaled), size)
        if self._set[0] == LOST:
            world.reset(seed=0)
        self._set[0] = b"?"
        for i in active:
            for step in (size, -size, STEP, -STEP):
                steps[i], target = step, self.targets[i]
                try:
                    if target.low <= scaled[i] + step <= target.high:
                        self._write(world, scaled + step * np.eye(len(scaled))[i])
                        break
                except InterventionError:
                    if step == -STEP:
                        raise
        return steps

    def replay(
        self,
        windows: Sequence[Window],
        scaled: Floats,
        starts: Floats,
        do: Mapping[str, Any],
        at: int,
    ) -> tuple[Floats, Floats]:
        """Simulate a whole run with and without an intervention, under several parameters.

        Where a window begins, the fitted state differs from the simulated one; this difference is
        what the world does not know of, and is added with the intervention, too.

        Args:
            windows: The windows of the run.
            scaled: Scaled parameters, shape (n, p).
            starts: Start states of the windows, shape (n, w, size).
            do: The intervention.
            at: Its control step.

        Returns:
            The measurements of each row without and with the intervention, shape (n, rows,
            columns).

        Raises:
            InterventionError: The intervention was refused.
        """
        run, size = self.runs[windows[0].run], len(self._batch) // 2
        begins = {int(run.instants[one.first]): number for number, one in enumerate(windows)}
        steps, found = np.arange(len(run.commands)), []
        for first in range(0, len(scaled), size):
            chunk = scaled[first : first + size]
            self._reset()
            count = len(chunk)
            rows, going = range(2 * count), np.arange(len(self._batch)) < 2 * count
            worlds: list[Any] = [self._batch.world(row) for row in rows]
            sent = [self._commands(run, one, steps) for one in chunk] * 2
            for row, world in enumerate(worlds):
                self._write(world, chunk[row % count])
                world.advance(sent[row][0])  # at the beginning, do() would begin the episode again
            seen = np.empty((len(steps) + 1, 2 * count, len(self.columns)))
            for step in range(len(steps) + 1):
                for row in range(count) if step in begins else ():
                    plain, other = worlds[row], worlds[count + row]
                    start = starts[first + row, begins[step]]
                    start = aligned(start, plain.vector, self._turned)
                    moved = other.vector + start - plain.vector if step else start
                    self._place(plain, start)
                    self._place(other, self.moved(moved, np.zeros(len(self.free))))
                if step == at:
                    for world in worlds[count:]:
                        world.do(do)
                for table, which in self._batch._by_structure(np.array(rows)):
                    seen[step, which] = table.numbers[np.ix_(which, self._places)]
                if step < len(steps):
                    commands = np.zeros((len(self._batch), worlds[0].compiled.n_actions))
                    commands[: 2 * count] = [one[step] for one in sent]
                    self._batch.advance(commands, going)
            self._set = [LOST] * len(self._batch)
            found.append(seen[run.instants].swapaxes(0, 1).reshape(2, count, -1, seen.shape[-1]))
        plain, other = np.concatenate(found, axis=1)
        return plain, other

    # --- residuals ----------------------------------------------------------------------------

    def measured(self, window: Window) -> tuple[Integers, Integers]:
        """Return the row in the window, and the column, of each measured number."""
        row, column = np.nonzero(
            np.isfinite(self.runs[window.run].values[window.first : window.last])
        )
        return row, column

    def residual(self, window: Window, values: Floats, noise: Floats) -> Floats:
        """Return measured minus simulated values in standard deviations, where measured, (n,)."""
        run, first, last = window
        seen = self.runs[run].values[first:last]
        found = (seen - aligned(values, seen, self.rotations)) / noise
        found = found[np.isfinite(seen)]
        return np.asarray(np.where(np.isfinite(found), found, MOST_RESIDUAL))

    def linear(
        self,
        groups: Sequence[Sequence[Window]],
        scaled: Floats,
        starts: Sequence[Floats],
        noise: Floats,
        active: Sequence[int],
        *,
        follow: bool = True,
        step: float = STEP,
        of_states: float = STEP,
    ) -> list[LinearWindow]:
        """Linearise windows by finite differences of paired rollouts.

        Args:
            groups: The segments of each window.
            scaled: Scaled parameters, shape (p,).
            starts: Start state of each segment, in one list.
            noise: Standard deviation of each column, shape (columns,).
            active: Numbers of the parameters that are fitted.
            follow: Whether start states are fitted, too.
            step: Step of the differences by parameters, in scaled units.
            of_states: Step of those by start states.

        Source:
            Bock and Plitt, *A multiple shooting algorithm for direct solution of optimal control
            problems*, IFAC 1984: segments are joined by the linearised conditions.
        """
        segments = [segment for group in groups for segment in group]
        p, k = len(active), len(self.free) * follow
        how = (*active,), k, step, of_states
        asked = (tuple(segments), scaled.tobytes(), np.array(starts).tobytes(), how)
        if self._last[0] != asked:  # it does not depend on what is joined, nor on the noise
            steps, unit = self.steps(scaled, step, active), np.eye(len(scaled))
            tasks = []
            for segment, start in zip(segments, starts, strict=True):
                tasks.append((segment, scaled, start))
                tasks += [(segment, scaled + steps[i] * unit[i], start) for i in active]
                tasks += [(segment, scaled, self.moved(start, of_states * e)) for e in np.eye(k)]
            sizes = np.concatenate([steps[list(active)], np.full(k, of_states)])
            self._last = asked, self.simulate(tasks), sizes
        _, tried, sizes = self._last
        simulated = iter(tried)
        found, number = [], 0
        for group in groups:
            constant, state, along = np.zeros(k), np.eye(k), np.zeros((k, p))
            parts, moves = [], []
            for place, segment in enumerate(group):
                made = [next(simulated) for _ in range(1 + p + k)]
                base, *rest = (self.residual(segment, one.values, noise) for one in made)
                slope = (np.array(rest).reshape(p + k, -1) - base).T / sizes
                moves.append((constant, state, along))
                by, of = slope[:, :p], slope[:, p:]
                parts.append((base + of @ constant, of @ state, of @ along + by))
                if place + 1 < len(group):
                    ends = [self.gap(one.end, starts[number + 1]) for one in made]
                    slope = (np.array(ends[1:]).reshape(p + k, -1) - ends[0]).T / sizes
                    constant = slope[:, p:] @ constant + ends[0]
                    along = slope[:, p:] @ along + slope[:, :p]
                    state = slope[:, p:] @ state
                number += 1
            residual, states, parameters = map(np.concatenate, zip(*parts, strict=True))
            found.append(LinearWindow(residual, states, parameters, moves))
        return found


def windows_of(runs: Sequence[RecordedRun], window: int | None) -> list[Window]:
    """Cut runs into windows; a short rest belongs to the last one of a run."""
    found = []
    for number, run in enumerate(runs):
        n = len(run.instants)
        firsts = [*range(0, n, window or n)]
        if len(firsts) > 1 and 2 * (n - firsts[-1]) < (window or n):
            del firsts[-1]
        found += [Window(number, first, last) for first, last in pairwise([*firsts, n])]
    return found


def segments_of(window: Window) -> list[Window]:
    """Cut a window into segments of about ten rows, in which residuals are nearly linear."""
    number = max(1, round((window.last - window.first) / SHORT))
    ends = np.linspace(window.first, window.last, number + 1).astype(int).tolist()
    return [Window(window.run, first, last) for first, last in pairwise(ends)]
