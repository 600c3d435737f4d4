"""Multiple shooting: recorded windows, simulated in a batch of twins from any start states."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Self, final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats, Integers
from scm_world.errors import EngineFailure, InterventionError
from scm_world.fit.problem import SHORT, STEP, Simulated, Simulator, Window
from scm_world.fit.recordings import (
    LEAST,
    Measurements,
    RecordedRun,
    labels,
    rotations_of,
    settable_of,
)
from scm_world.fit.targets import (
    Target,
    begin,
    channels_of,
    delays_of,
    free_states,
    remembered,
    values_of,
)
from scm_world.geometry.rotations import aligned
from scm_world.models import Difference
from scm_world.models.model import HELD
from scm_world.models.scene import SURFACES
from scm_world.queries.twins import twins_of
from scm_world.queries.world import World
from scm_world.runs.processes import cores
from scm_world.tasks.channels import switched
from scm_world.variables import Rotations
from scm_world.world import Simulation

ROWS = 32  # worlds that are stepped together
MOST_ROWS = 128  # the same of a long recording
LOST = b"lost"  # in place of the parameters of a world whose state was lost
LIFT = 10.0  # [m] between free bodies while their shapes change
TINY = 1e-9  # change of the measurements by a scaled unit that is none, in their spread
SPREAD = 0.02  # least scale of a start state
SLOPE = 4  # rows over which a velocity is guessed from positions
TURNS = {"orientation": "angular_velocity"}
SPEEDS = {"position": "velocity", "cartesian_position": "linear_velocity"} | TURNS


@final
@dataclass(frozen=True)
class Law:
    """A command that follows from the present state, and from the other commands.

    Attributes:
        command: Name of the action.
        parents: Names of numbers of the world that it follows from.
        function: Of the commands, shape (n, n_actions), and of these numbers, (n,) each.
    """

    command: str
    parents: tuple[str, ...]
    function: Callable[..., Floats]


@final
class Shooting(Simulator):
    """Simulates windows of some runs in a batch of twins, from any start states.

    Args:
        world: The world; it is not changed.
        measured: The recording.
        targets: The fitted numbers.
        law: A command that no recording has, in each control step.
    """

    def __init__(
        self,
        world: World,
        measured: Measurements,
        targets: Sequence[Target],
        law: Law | None = None,
    ) -> None:
        what = "a fit, whose sensitivities are differences of paired runs,"
        world.require_exact(what, independent=True)
        self.world, self.runs, self.columns = world, measured.runs, measured.columns
        self.targets, self._open, self._law = tuple(targets), ExitStack(), law
        self._names = tuple(dict.fromkeys(c.variable for c in measured.recorded))
        segments = sum(-(-len(run.instants) // SHORT) for run in self.runs)
        tasks = segments * (2 + len(targets))  # of a linearisation, about
        n = min(MOST_ROWS, max(ROWS, tasks // 2), 2 * tasks)
        together = twins_of(world).together(n, self._names, cores())
        self._batch = self._open.enter_context(together)
        self._known: list[dict[str, Floats]] = [{} for _ in range(len(self._batch))]
        self._reset()
        first = self._batch.world(0)
        self.free = free_states(first)
        held = (row for row in first.composition.system.states if getattr(row, "array", "") == HELD)
        layout = first.structure.layout.slices  # of what the world keeps by itself
        self._held = [
            i for row in held for i in range(layout[row.name].start, layout[row.name].stop)
        ]
        self.turned = [
            where
            for name, where in first.compiled.slices.items()
            if isinstance(first.model.declared(name).bounds, Rotations)
        ]
        places = first.compiled.where
        self._places = np.array([places[c.variable].start + c.component for c in self.columns])
        self._begins = range(len(measured.recorded), len(self.columns))
        self.rotations = rotations_of(first, measured.recorded)
        begin(first, world)
        self._places_of = {
            label: (name, i)
            for name, variable in settable_of(first).items()
            for i, label in enumerate(labels(name, variable.shape))
        }
        self._setups = [*dict.fromkeys(tuple(run.do.items()) for run in self.runs)]
        names = {self._places_of[label][0] for setup in self._setups for label, _ in setup}
        self._usual = {name: np.array(first[name], float) for name in names}
        written = names.union(*(t.written for t in targets))
        acting = written.union(*map(first.model.descendants, written))
        follow = [name for name in first.compiled.static_names if name in acting]
        keys = first.compiled.parameter_keys
        self._keys = [keys[name] for name in follow if name in keys]
        self._written = [i for name in follow for i in range(places[name].start, places[name].stop)]
        self._apart = self._parted(first, written)
        self.spans = np.ones(len(self.free))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def guess(self, windows: Sequence[Window]) -> Floats:
        """Guess start states from the measurements, and their spans; see ``Simulator``.

        These are measured numbers and slopes of measured positions, and how a run is known to
        begin; the rest is simulated from the window before, or the default.
        """
        world = self._begin(0)
        where, default = world.compiled.slices, world.vector.copy()
        known, moving = [], []  # measured numbers, and velocities of measured positions
        sensed = {one.name("reading"): one.of.name for one in channels_of(world) if not one.acts}
        measured = {sensed.get(name, name) for name in self._names}
        begun = [(self._places[i], i) for i in self._begins]
        for i, (_, column, component, _) in enumerate(self.columns[: self._begins.start]):
            name = sensed.get(column, column)
            if name in where:
                known.append((where[name].start + component, i))
                stem, _, quantity = name.rpartition(".")
                speed = f"{stem}.{SPEEDS.get(quantity)}"
                if quantity not in TURNS and speed in where and speed not in measured:
                    moving.append((where[speed].start + component, i))
        turning, states = [], world.composition.system.states  # angular velocities
        frames = {row.name: getattr(row, "frame", "body") for row in states}
        for places in self.rotations:
            name = self.columns[places[0]].variable
            speed = f"{name.removesuffix('orientation')}angular_velocity"
            if name in where and speed in where and speed not in measured:
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
            slopes = [(place, i) for place, i in sorted(moving) if np.isfinite(seen[0, i])]
            if len(time) > 1 and slopes:
                there, which = map(list, zip(*slopes, strict=True))
                vector[there] = np.polyfit(time - time[0], seen[rows][:, which], 1)[0]
                mine[there] = True
            for speed, places, frame in turning if len(time) > 1 else ():
                from scipy.spatial.transform import Rotation

                if np.isfinite(seen[0, places]).all():
                    turned = Rotation.from_quat(seen[rows, places])
                    back = turned[0].inv()
                    turns = back * turned if frame == "body" else turned * back
                    vector[speed] = np.polyfit(time - time[0], turns.as_rotvec(), 1)[0]
                    mine[speed] = True
            for i, past in remembered(world).items() if len(run.commands) else ():
                sent = run.instants[first] - 1 - np.arange(past.stop - past.start)
                vector[past], mine[past] = run.late(sent)[:, i], True
            for place, i in begun if not first and run.whole else ():
                vector[place], mine[place] = run.values[0, i], True
            for turned_places in self.turned:
                norm = float(np.linalg.norm(vector[turned_places]))
                vector[turned_places] /= max(norm, 1e-9)
        self._set[0] = LOST
        return self.carried(windows, np.zeros(len(self.targets)), starts, kept)

    def seen(self, windows: Sequence[Window]) -> tuple[Target, ...]:
        """Return the targets, those that are zero scaled by what the measurements see of them.

        A scaled unit changes the measurements of short windows by as much as these vary.
        """
        starts, none = self.guess(windows), np.zeros(len(self.targets))
        spread = np.maximum(np.nanstd(np.concatenate([r.values for r in self.runs]), axis=0), LEAST)
        found = list[Target]()
        for target, unit in zip(self.targets, np.eye(len(none)), strict=True):
            size = 0.0
            if not target.log and target.values is not None and not target.values.any():
                by = (STEP if target.high > STEP else -STEP) * unit
                pairs = zip(windows, starts, strict=True)
                tasks = [(one, scaled, s) for one, s in pairs for scaled in (none, by)]
                made = [one.values for one in self.simulate(tasks)]
                change = (np.concatenate(made[1::2]) - np.concatenate(made[::2])) / spread
                size = float(np.sqrt(np.nanmean(change**2))) / STEP
            size = size if np.isfinite(size) and size > TINY else 1.0
            low, high, scale = target.low * size, target.high * size, target.scale / size
            found.append(dataclasses.replace(target, low=low, high=high, scale=scale))
        return tuple(found)

    def carried(
        self, windows: Sequence[Window], scaled: Floats, starts: Floats, kept: NDArray[np.bool_]
    ) -> Floats:
        """Simulate runs, window by window; start states take the rest from the end before.

        The spread of all these states is the scale of start states from then on.

        Args:
            windows: The windows, in the order of the runs.
            scaled: Scaled parameters, shape (p,).
            starts: Start states, shape (w, size).
            kept: Numbers that stay, shape (w, size); those of the first window of a run always do.
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

    def _parted(self, world: Simulation, written: set[str]) -> Floats | None:
        """Return a state with all free bodies apart, where a fitted parameter is one of shapes.

        A body that grows overlaps the body below, which the world would refuse; fitted start
        states lift the larger body.
        """
        rows = getattr(world.composition.system, "rows", {})
        shapes = {row.name for row in rows.values() if getattr(row, "key", ("", ""))[1] in SURFACES}
        if shapes.isdisjoint(written):
            return None
        vector: Floats = world.vector.copy()
        free = [name for name in world.compiled.slices if name.endswith(".cartesian_position")]
        for i, name in enumerate(free):
            vector[world.compiled.slices[name].start + 2] += LIFT * (1 + i)
        return vector

    def _write(self, row: int, scaled: Floats, setup: Iterable[tuple[str, float]]) -> None:
        """Set the parameters of a twin for a set-up; it is in any state afterwards.

        Those that it has from an earlier call are left as they are.

        Raises:
            InterventionError: The world refuses a value, or its engine takes another one, such as
                an axis of unit length.
        """
        world, known = self._batch.world(row), self._known[row]
        if self._apart is not None:
            self._place(world, self._apart)
        usual = {name: values.copy() for name, values in self._usual.items()}
        values = usual | values_of(self.targets, scaled)
        for label, value in setup:
            name, place = self._places_of[label]
            values[name].reshape(-1)[place] = value
        new = {n: v for n, v in values.items() if n not in known or (v != known[n]).any()}
        if new:
            try:
                world.do(new)
            except EngineFailure as error:
                said, name = f"{error}", ", ".join(new)
                raise InterventionError(said, variable=name) from error
        self._known[row] = values

    def _key(self, run: int, scaled: Floats) -> bytes:
        """Return what tells the parameters of a run from others."""
        setup = tuple(self.runs[run].do.items())
        return scaled.tobytes() + (b"%d" % self._setups.index(setup)) * bool(self._usual)

    def _copy(self, row: int, alike: int) -> None:
        """Set the parameters of a twin to those of another one."""
        world, other = self._batch.world(row), self._batch.world(alike)
        world.backend.apply(Difference(parameters=other.backend.parameters(self._keys)))
        world.row.numbers[self._written] = other.row.numbers[self._written]
        self._known[row] = self._known[alike] if self._known[row] else {}

    def _place(self, world: Simulation, vector: Floats) -> None:
        """Put a twin into a state, which measurements with noise may put out of its bounds."""
        world.backend.apply(Difference(state=world.compiled.empty_state(vector.copy())))
        world.backend.read(world.state)
        world.state.vector[self._held] = vector[self._held]
        world.version += 1

    def _begin(self, row: int) -> Simulation:
        """Return a twin at the beginning of an episode, with the parameters of the world."""
        begin(self._batch.world(row), self.world)
        self._known[row] = {}
        return self._batch.world(row)

    def _reset(self) -> None:
        for row in range(len(self._batch)):
            self._begin(row)
        self._set = [b""] * len(self._batch)  # the parameters of each row

    def _commands(self, run: RecordedRun, scaled: Floats, steps: Integers) -> Floats:
        """Return what acts in each physics step of some control steps; see ``switched``.

        Shape (n, substeps, n_actions), or (n, n_actions) with one physics step, and where commands
        change where control steps begin.
        """
        world = self._batch.world(0)
        delays = delays_of(world, self.targets, scaled)
        if run.sent is not None:
            acting = run.acting(delays, steps, world.substeps)
            return acting if world.substeps > 1 else acting[:, 0]
        if not delays.any() or not len(run.commands):
            return run.commands[steps]
        acting = np.empty((len(steps), world.substeps, len(delays)))
        for i, delay in enumerate(delays.tolist()):
            whole, shares = switched(delay, world.substeps)
            new, old = (run.late(steps - whole - late)[:, i, None] for late in (0, 1))
            acting[..., i] = new + np.array(shares or (0.0,)) * (old - new)
        return acting if world.substeps > 1 else acting[:, 0]

    def simulate(self, tasks: Sequence[tuple[Window, Floats, Floats]]) -> list[Simulated]:
        """Simulate windows; see ``Simulator``."""
        order = sorted(
            range(len(tasks)), key=lambda i: (self._key(tasks[i][0].run, tasks[i][1]), i)
        )
        turns = -(-len(tasks) // len(self._batch))
        n = -(-len(tasks) // turns)  # parameters are written to no more twins than needed
        shares = [part.tolist() for part in np.array_split(np.array(order, int), n)]
        found: dict[int, Simulated] = {}
        try:
            for turn in range(max(map(len, shares))):
                active = {row: share[turn] for row, share in enumerate(shares) if turn < len(share)}
                found |= self._survivors(tasks, active)
        except BaseException:
            self._reset()
            raise
        return [found[task] for task in range(len(tasks))]

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
        commands = dict[int, Floats]()
        for row, task in active.items():
            window, scaled, vector = tasks[task]
            world = self._batch.world(row)
            if self._set[row] == LOST:
                self._begin(row)
            run, key = self.runs[window.run], self._key(window.run, scaled)
            if self._set[row] != key:
                alike = self._set.index(key) if key in self._set else None
                self._set[row] = b"?"
                if alike is None:
                    self._write(row, scaled, run.do.items())
                else:
                    self._copy(row, alike)
                self._set[row] = key
            self._place(world, vector)
            since = run.instants[window.first]
            end = run.instants[min(window.last, len(run.instants) - 1)]  # where the next one begins
            commands[row] = self._commands(run, scaled, np.arange(since, end))
        seen = self._followed(commands)
        for row, task in active.items():
            window = tasks[task][0]
            instants = self.runs[window.run].instants[window.first : window.last]
            values = seen[instants - instants[0], row].copy()
            yield task, Simulated(values, self._batch.world(row).vector.copy())

    def _followed(
        self, commands: Mapping[int, Floats], before: Callable[[int], None] | None = None
    ) -> Floats:
        """Step rows under ``_commands`` of each; return measurements, (steps, rows, c).

        Before the measurements of a step, ``before`` is called with the number of the step.
        """
        compiled, law = self._batch.world(0).compiled, self._law
        where, actions, size = compiled.where, compiled.actions, compiled.n_actions
        steps = np.full(len(self._batch), -1)
        given = np.zeros((max(map(len, commands.values())), len(self._batch), size))
        for row, sent in commands.items():
            steps[row] = len(sent)
            given[: len(sent), row] = sent if sent.ndim == 2 else sent[:, -1]
        parted = {row: sent for row, sent in commands.items() if sent.ndim > 2}
        seen = np.empty((len(given) + 1, len(self._batch), len(self.columns)))
        for step in range(len(seen)):
            going = steps >= step
            if step:
                now = given[step - 1]
                within = {row: sent[step - 1] for row, sent in parted.items() if going[row]}
                if law is not None:
                    for table, rows in self._batch.by_structure(np.flatnonzero(going)):
                        of = (table.numbers[rows, where[name].start] for name in law.parents)
                        now[rows, actions[law.command].start] = law.function(now[rows], *of)
                self._batch.advance(now, going, within)
            if before is not None:
                before(step)
            for table, rows in self._batch.by_structure(np.flatnonzero(going)):
                seen[step, rows] = table.numbers[np.ix_(rows, self._places)]
        return seen

    def check(self, scaled: Floats) -> None:
        """Raise an ``InterventionError`` if the world refuses scaled parameters."""
        if self._set[0] == LOST:
            self._begin(0)
        self._set[0] = b"?"
        for setup in self._setups:
            self._write(0, scaled, setup)

    def replay(
        self,
        windows: Sequence[Window],
        scaled: Floats,
        starts: Floats,
        do: Mapping[str, object],
        at: int,
    ) -> tuple[Floats, Floats]:
        """Simulate a whole run with and without an intervention, under several parameters.

        Where a window begins, the fitted state differs from the simulated one. The world lacks the
        causes of this difference, so the difference is added under the intervention, too.

        Args:
            windows: The windows of the run.
            scaled: Scaled parameters, shape (n, p).
            starts: Start states of the windows, shape (n, w, size).
            do: The intervention.
            at: Its control step.

        Returns:
            The measurements without and with the intervention, shape (n, rows, columns) each.

        Raises:
            InterventionError: The intervention was refused.
        """
        run, k, found = self.runs[windows[0].run], len(windows), list[Floats]()
        steps = np.arange(len(run.commands))
        begins = {int(run.instants[one.first]): w for w, one in enumerate(windows)}
        each = [zip(windows, states, strict=True) for states in starts]
        tasks = [(w, one, s) for one, pairs in zip(scaled, each, strict=True) for w, s in pairs]
        plain = self.simulate(tasks)
        for first in range(0, len(scaled), len(self._batch)):
            self._reset()
            chunk = scaled[first : first + len(self._batch)]
            sent = {row: self._commands(run, one, steps) for row, one in enumerate(chunk)}
            for row, one in enumerate(chunk):
                self._write(row, one, run.do.items())
                # do() would begin the episode again
                self._batch.world(row).advance(run.commands[0])

            def before(step: int, first: int = first, sent: Mapping[int, Floats] = sent) -> None:
                for i, world in ((first + row, self._batch.world(row)) for row in sent):
                    if step in begins:
                        w, there = begins[step], starts[i, begins[step]]
                        if w:
                            end = plain[i * k + w - 1].end
                            there = world.vector + aligned(there, end, self.turned) - end
                        self._place(world, self.moved(there, np.zeros(len(self.free))))
                    if step == at:
                        world.do(do)

            found.append(self._followed(sent, before)[run.instants, : len(sent)])
            self._set = [LOST] * len(self._batch)
        values = np.concatenate([one.values for one in plain])
        other = np.concatenate(found, axis=1).swapaxes(0, 1)
        return values.reshape(other.shape), other
