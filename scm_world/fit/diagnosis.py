"""Diagnose what kind of error of a model leaves the residuals of a fit."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast, final

import numpy as np

from scm_world._patterns import fitting
from scm_world._types import Floats, Integers
from scm_world.errors import ModelError, ScmWorldError
from scm_world.fit.problem import (
    SHORT,
    FitProblem,
    LeastSquares,
    Simulated,
    Simulator,
    Window,
    windows_of,
)
from scm_world.fit.recordings import Measurements, rotations_of, settable_of
from scm_world.fit.search import gauss_newton
from scm_world.fit.shooting import Law, Shooting
from scm_world.fit.targets import LATE, Target, free_states, targets_of, twin_of
from scm_world.queries.progress import Progress
from scm_world.queries.world import World
from scm_world.tasks.model import ModelTask
from scm_world.variables import Box, Exogenous

if TYPE_CHECKING:
    import pandas as pd

    from scm_world.backends.mujoco.parts import Drive, Part
    from scm_world.fit.result import Fit

TIE = 6.0  # difference of the BIC that is strong evidence
ROWS = 1000  # of the recording in which terms are tried, about
SLOW = 0.02  # of the usual speed, over which a friction changes its sign
LATEST = 10.0  # rows by which a column may be late or early
ROUGH = 1e-3  # precision of the squared residuals, relative
STARTS = 3  # from which a term is searched
SHORTLY, FEW, MANY = 3, 5, 15  # steps of a search: of each start, of a term, of a likely one
LIKELY = 0.3  # of the largest gain, at which a search goes on
LEAST = 3.0  # by which the logarithm of a number may be below its default, to begin with
NEAR = 0.1, -0.1  # scaled numbers to begin with
SENSORS = {"gain": NEAR, "offset": NEAR, "lag": (0.5, 2.0, -0.5)}
PLAIN = {"frictionloss": "Coulomb friction", "damping": "viscous damping"}
STRIBECK, LOAD = "Coulomb friction that falls with speed", "friction that grows with the torque"
OFFSET, SPRING, SATURATION = "torque offset", "spring", "saturation"
BACKLASH, FLEXIBLE = "backlash", "flexible joint"
IN_FILES = (STRIBECK, LOAD, OFFSET, SPRING, SATURATION, BACKLASH, FLEXIBLE)

Key = tuple[str, str]
"""What a term is, and where."""


@final
@dataclass(frozen=True, eq=False)
class Term:
    """A standard term that a model lacks.

    Attributes:
        key: What it is, and the joint, actuator or column that it belongs to.
        world: The world that has it.
        names: Its parameters in that world, beside those of the fit.
        begins: Scaled numbers by which searches begin from those of the fit, or from the defaults.
        scales: Sizes of a unit of some whose default is zero.
        law: The command of an added motor.
        renamed: Measured variables that are others in that world.
        sensor: A column, and what is fitted of it: ``"gain"``, ``"offset"`` or ``"lag"``.
    """

    key: Key
    world: World
    names: tuple[str, ...] = ()
    begins: tuple[Mapping[str, float], ...] = ({},)
    scales: Mapping[str, float] = field(default_factory=dict)
    law: Law | None = None
    renamed: Mapping[str, str] = field(default_factory=dict)
    sensor: tuple[int, str] | None = None


@final
@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis:
    """What kind of error of a model leaves the residuals of a fit.

    Attributes:
        plain: The fit, in the rows in which terms were tried.
        fits: A fit with each term, by what it is and where.
        untried: Sentences on terms that were not tried.
    """

    plain: Fit
    fits: Mapping[Key, Fit]
    untried: tuple[str, ...] = ()

    @cached_property
    def bic(self) -> dict[Key, float]:
        """The extended BIC of each term as the difference from that of the fit.

        Unexplained residuals of the best one, and their correlation in time, count as further
        noise. Start states that are fitted, too, count as parameters. Each of p terms that were
        tried has 2 log p more.

        Source:
            Chen and Chen, *Extended Bayesian information criteria for model selection with large
            model spaces*, Biometrika 2008, with γ = 1 and one term of p.
        """
        plain, fits = self.plain, self.fits
        scale = min((plain, *fits.values()), key=lambda fit: fit.squares).discount
        found, each = dict[Key, float](), np.log(len(plain.residual))
        for key, fit in fits.items():
            more = (plain.degrees - fit.degrees) * each + 2.0 * np.log(len(fits))
            found[key] = float((fit.squares - plain.squares) / scale + more)
        return found

    @cached_property
    def table(self) -> pd.DataFrame:
        """A row for each term, the best first.

        It has the ``term`` and ``where`` it is, ``bic`` (the difference of the extended BIC from
        that of the fit; a negative one is better), ``removed`` (the share of the squared residuals
        that the noise does not explain; NaN if there are none), the fitted ``values`` of the term
        with units, whether the recording is ``explained`` with it, and whether it is ``tied``: it
        is better than the fit by more than 6, and worse than the best one by less.
        """
        import pandas as pd

        bic, plain, rows = self.bic, self.plain, []
        free, known = plain.squares - plain.degrees, {target.name for target in plain.targets}
        for key in sorted(self.fits, key=bic.__getitem__):
            fit, words = self.fits[key], []
            removed = min((plain.squares - fit.squares) / free, 1.0) if free > 0.0 else np.nan
            for target in fit.targets:
                if target.name not in known:
                    unit = f" {target.unit}" * (target.unit not in ("", "1"))
                    words.append(f"{target.name} {fit.values[target.name]:.3g}{unit}")
            tied = bic[key] < min(-TIE, min(bic.values()) + TIE)
            rows.append((*key, bic[key], removed, ", ".join(words), fit.explains, tied))
        names = "term where bic removed values explained tied"
        return pd.DataFrame(rows, columns=names.split())

    @property
    def best(self) -> tuple[Key, ...]:
        """The terms that explain the residuals best, and where; several if they are tied.

        There is none if the fit explains the recording, or if no term has a BIC that is less than
        that of the fit by more than 6.
        """
        table = self.table[self.table.tied & (not self.plain.explains)]
        return tuple(zip(table["term"], table["where"], strict=True))

    def __str__(self) -> str:
        table, best = self.table, self.best
        pairs = zip(table["term"], table["where"], table.removed, strict=True)
        words = {(a, b): f"{a} in {b}: {100.0 * share:.3g} %" for a, b, share in pairs}
        if self.plain.explains:
            said = "The fit explains the recording: no term is needed"
        elif not best:
            said = f"None of the {len(table)} terms that were tried explains the residuals"
        else:
            which = " or ".join(map(words.__getitem__, best))
            tied = ", which this recording cannot tell apart" * (len(best) > 1)
            said = f"The residuals are explained best by {which} of what noise does not leave{tied}"
            said += "".join(f"; next {words[key]}" for key in [*words][len(best) :][:1])
            if not any(self.fits[key].explains for key in best):
                said += "; more than noise is left with it: something else is wrong, too"
        shown = table[: max(6, len(best))].drop(columns="tied")
        text = shown.to_string(index=False, float_format="{:.4g}".format, na_rep="none")
        return "\n".join([f"{said}.", text, *self.untried])

    __repr__ = __str__


@final
class _Termed(Simulator):
    """Simulates windows of a world with a term.

    Args:
        shooting: Simulates the world, with all numbers but that of a sensor.
        times: Factors of the scaled numbers: of delays, where control steps are shorter.
        sensor: The column, what is fitted of it, and the number.
    """

    def __init__(
        self, shooting: Shooting, times: Floats, sensor: tuple[int, str, Target] | None
    ) -> None:
        self._inner, self._times, self._sensor = shooting, times, sensor
        self.world, self.runs, self.free = shooting.world, shooting.runs, shooting.free
        self.spans, self.turned = shooting.spans, shooting.turned
        self.rotations = shooting.rotations

    def guess(self, windows: Sequence[Window]) -> Floats:
        return self._inner.guess(windows)

    def check(self, scaled: Floats) -> None:
        self._inner.check(scaled[: len(self._times)] * self._times)

    def simulate(self, tasks: Sequence[tuple[Window, Floats, Floats]]) -> list[Simulated]:
        size = len(self._times)
        found = self._inner.simulate([(w, s[:size] * self._times, start) for w, s, start in tasks])
        if self._sensor is None:
            return found
        column, kind, target = self._sensor
        for (window, scaled, _), one in zip(tasks, found, strict=True):
            values, number = one.values[:, column], float(target.value(scaled[-1]))
            if kind == "gain":
                values *= number
            elif kind == "offset":
                values += number
            elif len(values) > 1 and np.isfinite(values).all():
                from scipy.interpolate import CubicSpline

                instants = self.runs[window.run].instants[window.first : window.last]
                values[:] = CubicSpline(instants, values)(instants - number)
        return found


@final
class Diagnosing:
    """Tries terms on a fit.

    Args:
        fit: The fit.
        patterns: Names or patterns of the terms.
        progress: Called after each term.
    """

    def __init__(self, fit: Fit, patterns: Sequence[str], progress: Progress | None) -> None:
        self._fit, self._progress, self._untried = fit, progress, list[str]()
        self._patterns = patterns
        self._world, windows = fit.asked, windows_of(fit.runs, fit.window)
        share = ROWS / sum(len(run.instants) for run in fit.runs)
        count = min(len(windows), round(share * len(windows)) or 1)
        chosen = np.linspace(0, len(windows) - 1, count).round().astype(int).tolist()
        dt, runs = fit.measured.control_dt, fit.runs
        cut = [windows[w] for w in chosen]
        parts = tuple(runs[one.run].part(one.first, one.last, dt) for one in cut)
        self._measured = replace(fit.measured, runs=parts)
        self._begin = replace(fit, starts=fit.starts[chosen])
        rough = fit.noise * np.fmin(np.nan_to_num(fit.roughness, nan=1.0), 1.0)
        self._noise = np.maximum(np.where(fit.given, fit.noise, rough), fit.measured.least)
        self._spread = np.maximum(np.nanstd(self._measured.values, axis=0), 1e-9)

    def run(self) -> Diagnosis:
        """Try all terms; after Ctrl-C, those that were tried are returned."""
        fits, terms = dict[Key, Any](), [*self._terms()]
        chosen = fitting(self._patterns, {term.key[0]: None for term in terms}, "terms")
        terms = [term for term in terms if term.key[0] in chosen]
        plain = self._fitted(Term(("", ""), self._world), self._begin, MANY)
        try:
            for number, term in enumerate(terms, 1):
                try:
                    fits[term.key] = self._fitted(term, plain, FEW)
                except ScmWorldError as error:
                    self._untried.append(f"Not tried: {' in '.join(term.key)} ({error}).")
                if self._progress is not None:
                    self._progress(number, len(terms))
            bic = Diagnosis(plain, fits).bic
            for term in terms:
                if bic.get(term.key, 0.0) < min(LIKELY * min(bic.values(), default=0.0), 0.0):
                    fits[term.key] = self._fitted(term, fits[term.key], MANY)
        except KeyboardInterrupt:
            self._untried.append(f"Stopped after {len(fits)} of {len(terms)} terms.")
        return Diagnosis(plain, fits, tuple(self._untried))

    def _fitted(self, term: Term, begin: Fit, most: int) -> Fit:
        """Fit the numbers of the fit and those of a term, beginning from another fit."""
        world, fit = term.world, self._fit
        measured, times = recorded_for(self._measured, term)
        with twin_of(world) as twin:
            ranges = any(name.endswith("range") for name in term.names)
            added = targets_of(twin, term.names, symmetric=ranges) if term.names else ()
            usual = twin.vector.copy()
        inner = (*fit.targets, *added)
        if any(not t.default and t.name not in term.scales and t.values is not None for t in added):
            with Shooting(world, measured, inner, term.law) as shooting:
                added = shooting.seen(windows_of(measured.runs, SHORT))[len(fit.targets) :]
        scales = term.scales
        added = tuple(replace(t, scale=scales[t.name]) if t.name in scales else t for t in added)
        inner = own = (*fit.targets, *added)
        factors = np.array([float(times) if t.values is None else 1.0 for t in inner])
        sensor = None
        if term.sensor is not None:
            sensor = (*term.sensor, self._sensor(*term.sensor))
            own = (*inner, sensor[2])
        with Shooting(world, measured, inner, term.law) as shooting:
            starts, shooting.spans = _moved(begin, world, usual, shooting.free)
            simulator = _Termed(shooting, factors, sensor)
            problem = FitProblem(simulator, measured, own, self._noise, fit.window)
            squares = LeastSquares(problem, problem.windows, problem.noise, range(len(own)), ROUGH)
            known = {t.name: s for t, s in zip(begin.targets, begin.scaled, strict=True)}
            before = np.array([known.get(target.name, 0.0) for target in own])
            tried = [before]
            if not {target.name for target in own} <= {*known}:
                least = [-LEAST if target.log else -np.inf for target in own]
                before = np.maximum(before, least)  # at nearly 0, a logarithm changes nothing
                moves = [[by.get(target.name, 0.0) for target in own] for by in term.begins]
                tried = [problem.within(before + np.array(move)) for move in moves]
            shortly = replace(squares, most=SHORTLY if len(tried) > 1 else most)
            sizes = [float(squares.sizes(one, [[*starts]])[0].sum()) for one in tried]
            order = [int(i) for i in np.argsort(sizes)[:STARTS] if np.isfinite(sizes[i])]
            if not order:
                raise ModelError(["the world refuses all values to begin with"])
            found = [gauss_newton(shortly, tried[i], [*starts]) for i in order]
            at = min(found, key=lambda one: float(one.squares.sum()))
            if len(tried) > 1:
                at = gauss_newton(replace(squares, most=most), at.scaled, at.starts)
            none: dict[str, Any] = {"reach": None, "played": None, "later": None, "reading": ""}
            return replace(
                fit,
                asked=world,
                measured=measured,
                targets=own,
                scaled=at.scaled,
                starts=np.array(at.starts),
                noise=self._noise,
                known=np.full(len(self._noise), True),
                found=tuple(at.made),
                spans=shooting.spans,
                ended=at.ended,
                **none,
            )

    def _sensor(self, column: int, kind: str) -> Target:
        """Return the number that is fitted of a sensor."""
        one, free = self._measured.recorded[column], (-np.inf, np.inf)
        name = f"{one.name} {kind}"
        if kind == "gain":
            return Target(name, name, 0, "1", 1.0, 1.0, False, *free, values=np.ones(()))
        if kind == "offset":
            about = one.unit, 0.0, float(self._spread[column]), False, *free
            return Target(name, name, 0, *about, values=np.zeros(()))
        unit, ends = f"× {self._measured.control_dt:g} s", (-LATEST, LATEST)
        return Target(name, name, 0, unit, 0.0, 1.0, False, *ends, values=np.zeros(()))

    def _terms(self) -> Iterator[Term]:
        """List the terms of this model: of sensors, of commands, and of joints."""
        world, fitted = self._world, {target.variable for target in self._fit.targets}
        with twin_of(world) as twin:
            turned = {*np.ravel(rotations_of(twin, self._measured.recorded)).tolist()}
            known = settable_of(twin)
        for column, one in enumerate(self._measured.recorded):
            for kind, values in SENSORS.items() if column not in turned else ():
                each = tuple({f"{one.name} {kind}": value} for value in values)
                key = f"{kind} of the sensor", one.name
                yield Term(key, world, begins=each, sensor=(column, kind))
        late = any(target.values is None for target in self._fit.targets)
        for name in () if late else world.compiled.actions:
            if f"{name}_past" not in world.model:
                begins = tuple({name + LATE: value} for value in SENSORS["lag"][:2])
                yield Term(("delay of the command", name), world, (name + LATE,), begins)
        joints = [
            name.removesuffix(".position")
            for name in world.compiled.slices
            if name.endswith(".position") and world.model.declared(name).shape == ()
        ]
        for joint, (attribute, kind) in itertools.product(joints, PLAIN.items()):
            name = f"{joint}.{attribute}"
            if name in known and name not in fitted:
                begins = tuple({name: value} for value in (0.01, 0.1, 2.0))
                yield Term((kind, joint), world, (name,), begins)
        task = getattr(world, "task", None)
        named = isinstance(task, ModelTask) and task.is_named and not task.channels
        can = named and world.backend.name == "mujoco"
        for joint in joints if can else ():
            try:
                yield from [*self._in_file(joint, fitted)]
            except ScmWorldError as error:
                self._untried.append(f"Not tried, other parts of {joint}: {error}.")
        if not can:
            why = "they need a file that MuJoCo simulates, without delays and noise of its own"
            self._untried.append(f"Not tried: {', '.join(IN_FILES)}; {why}.")

    def _in_file(self, joint: str, fitted: Collection[str]) -> Iterator[Term]:
        """List the terms of a joint for which its file needs another part."""
        from scm_world.backends.mujoco.parts import GEAR, ROTOR, Part, drives_of

        slices, starts, system = self._world.compiled.slices, self._begin.starts, self._system
        drives = [one for one in drives_of(system.source.realized) if one.joint == joint]
        spread, speed = (
            max(float(np.sqrt((starts[:, slices[f"{joint}.{what}"]] ** 2).mean())), 1e-9)
            for what in ("position", "velocity")
        )
        names = f"{joint}.stiffness", f"{joint}.springref"
        if not {*names} & {*fitted}:
            ends = itertools.product((0.03, 0.3), (-1.0, 0.0, 1.0))
            begins = tuple({names[0]: k, names[1]: q} for k, q in ends)
            other = self._edited(None, names)
            yield Term((SPRING, joint), other, names, begins, {names[1]: spread})
        yield from self._moving(joint, speed, drives)
        for drive in drives:
            name = f"{drive.name}.forcerange"
            if drive.plain and not drive.limited:
                part = Part("forcerange", drive.name, max(self._force(drive), 1e-9))
                begins = tuple({name: np.log(share)} for share in (0.95, 0.8, 0.6, 0.4, 0.2))
                yield Term((SATURATION, drive.name), self._edited(part, (name,)), (name,), begins)
        sides = {f"{joint}.{w}": f"{joint}{ROTOR}.{w}" for w in ("position", "velocity")}
        seen = {*sides} & {column.variable for column in self._measured.recorded}
        for kind in (BACKLASH, FLEXIBLE) if drives else ():
            loose = kind == BACKLASH
            what = ("range",) if loose else ("stiffness", "damping")
            own, inertia = tuple(f"{joint}{GEAR}.{one}" for one in what), f"{joint}{ROTOR}.armature"
            part = Part("backlash" if loose else "spring", joint, 0.03 * spread)
            other = self._edited(part, own)
            ends = itertools.product((-1.2, 0.0, 1.2), (-1.2, 0.0, 1.2))
            begins = tuple({own[0]: one, inertia: size} for one, size in ends)
            yield Term((kind, joint), other, (*own, inertia), begins)
            if seen:
                key = kind, f"{joint}, sensors at the motor"
                yield Term(key, other, (*own, inertia), begins, renamed=sides)

    def _moving(self, joint: str, speed: float, drives: Sequence[Drive]) -> Iterator[Term]:
        """List the torques that a joint has in addition, by a motor on it."""
        from scm_world.backends.mujoco.parts import MORE, Part

        offset, drop, usual, load = (
            f"{joint}.{what}" for what in ("offset", "stribeck_drop", "stribeck_speed", "load")
        )
        turns = self._world.model.declared(f"{joint}.position").unit == "rad"
        force, fast = ("N m", "rad/s") if turns else ("N", "m/s")
        positive = Box(0.0, np.inf)
        ties = (
            Exogenous(name=offset, default=0.0, unit=force),
            Exogenous(name=drop, default=0.0, bounds=Box(0.0, 1.0)),
            Exogenous(name=usual, default=0.3 * speed, unit=fast, bounds=positive),
            Exogenous(name=load, default=0.0, bounds=positive),
        )
        other, command = self._edited(Part("motor", joint), (), ties), f"{joint}{MORE}.control"
        if drives:
            law = Law(command, (offset,), lambda _, torque: torque)
            begins = tuple({offset: share} for share in NEAR)
            yield Term((OFFSET, joint), other, (offset,), begins, law=law)
        velocity, friction = f"{joint}.velocity", f"{joint}.frictionloss"
        ends = itertools.product((0.05, 0.7), (0.3, 0.7), (-1.2, 0.0, 1.2))
        begins = tuple({friction: f, drop: share, usual: v} for f, share, v in ends)
        fitted = any(target.variable == friction for target in self._fit.targets)
        law = Law(command, (velocity, friction, drop, usual), _stribeck)
        names = (drop, usual) if fitted else (friction, drop, usual)
        yield Term((STRIBECK, joint), other, names, begins, {drop: 1.0}, law)
        plain = [drive for drive in drives if drive.plain]
        gears = [f"{drive.name}.gear" for drive in plain]
        if plain and all(name in other.model for name in gears):
            places = other.compiled.actions

            def loaded(sent: Floats, q: Floats, v: Floats, share: Floats, *of: Floats) -> Floats:
                torque = np.zeros(len(q))
                for drive, gear in zip(plain, of, strict=True):
                    one, by_length, by_speed = drive.bias
                    force = drive.gain * sent[:, places[f"{drive.name}.control"].start] + one
                    torque += gear * (force + gear * (by_length * q + by_speed * v))
                return -share * np.abs(torque) * np.tanh(v / (SLOW * speed))

            law = Law(command, (f"{joint}.position", velocity, load, *gears), loaded)
            begins = tuple({load: value} for value in (0.5, 3.0))
            yield Term((LOAD, joint), other, (load,), begins, {load: 0.1}, law)

    @property
    def _system(self) -> Any:
        return self._world.compiled.composition.system

    def _force(self, drive: Drive) -> float:
        """Return the largest force of an actuator in the recording, without its velocity."""
        action, names = f"{drive.name}.control", [c.name for c in self._measured.recorded]
        place, position = self._world.compiled.actions[action].start, f"{drive.joint}.position"
        most, (one, by_length, _) = 0.0, drive.bias
        for run in self._measured.runs:
            force = drive.gain * run.commands[:, place] + one
            if by_length and position in names:
                at, q = np.arange(len(force)), run.filled[:, names.index(position)]
                force = force + by_length * drive.gear * np.interp(at, run.instants, q)
            most = max(most, float(np.abs(force).max(initial=0.0)))
        return most

    def _edited(
        self, part: Part | None, names: Sequence[str], ties: Sequence[Exogenous] = ()
    ) -> World:
        """Return the world with another part, other parameters exposed, and other ones.

        With these, control steps are physics steps: in each, a motor has another command.
        """
        from scm_world.backends.mujoco.parts import with_part

        build, (kind, task, options, _), *_ = self._world.__reduce__()
        about, patterns = {**task.given}, ("*",) if task.expose is None else task.expose
        if part is not None:
            about["model"] = with_part(about["model"], part, fixed_base=task.fixed_base)
        period = task.system.timestep if ties else self._world.options.control_period
        patterns = (patterns,) if isinstance(patterns, str) else patterns
        about |= {"expose": (*patterns, *names), "ties": (*task.ties, *ties)}
        about |= {"control_dt": period, "frame_skip": None}
        other = cast(World, build(kind, type(task)(**about), {**options, "frame_skip": None}, None))
        other._given = self._world._given
        return other


def _stribeck(_: Floats, v: Floats, friction: Floats, drop: Floats, speed: Floats) -> Floats:
    """Return the torque by which a friction is less than at rest, in the direction of motion.

    Source:
        Armstrong-Hélouvry, Dupont and Canudas de Wit, *A survey of models, analysis tools and
        compensation methods for the control of machines with friction*, Automatica 1994.
    """
    fast = -np.expm1(-((v / np.maximum(speed, 1e-9)) ** 2))
    return np.asarray(drop * friction * fast * np.sign(v))


def recorded_for(measured: Measurements, term: Term) -> tuple[Measurements, int]:
    """Return a recording for the world of a term, and how many of its control steps are one.

    Commands of motors that were added are 0.
    """
    times = round(measured.control_dt / term.world.options.control_period)
    wide = (0, 0), (0, term.world.compiled.n_actions - measured.runs[0].commands.shape[1])
    runs = []
    for run in measured.runs:
        sent, before = (
            None if one is None else np.repeat(np.pad(one, wide), times, axis=0)
            for one in (run.commands, run.before)
        )
        about: dict[str, Any] = {"commands": sent, "before": before}
        if run.sent is not None:
            about["sent"] = times * run.sent[0], np.pad(run.sent[1], wide)
        runs.append(replace(run, **about, instants=times * run.instants))
    columns = tuple(
        c._replace(variable=term.renamed.get(c.variable, c.variable)) for c in measured.columns
    )
    period = measured.control_dt / times
    return replace(measured, runs=tuple(runs), columns=columns, control_dt=period), times


def _moved(begin: Fit, world: World, usual: Floats, free: Integers) -> tuple[Floats, Floats]:
    """Return start states of a fit, and sizes of their units, in a world with more states.

    The states of a rotor are those of its joint; others are as usual.
    """
    from scm_world.backends.mujoco.parts import ROTOR

    old, sizes = begin.asked.compiled.slices, np.ones(begin.starts.shape[1])
    sizes[free_states(begin.asked)] = begin.spans
    starts, spans = np.tile(usual, (len(begin.starts), 1)), np.ones(len(usual))
    for name, where in world.compiled.slices.items():
        same = old.get(name, old.get(name.replace(ROTOR, "")))
        if same is not None:
            starts[:, where], spans[where] = begin.starts[:, same], sizes[same]
    return starts, spans[free]
