"""Fits of a run that grows: a few steps from the last fit, in place of a search for intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, final

import numpy as np

from scm_world._arguments import real_number
from scm_world._types import Floats
from scm_world.errors import UnknownOption, UnknownVariable
from scm_world.fit.problem import FitProblem, LeastSquares
from scm_world.fit.recordings import MeasuredNumber, Measurements, RecordedRun, columns_of
from scm_world.fit.result import Fit
from scm_world.fit.search import ROUGH, gauss_newton
from scm_world.fit.shooting import Shooting
from scm_world.fit.targets import targets_of, twin_of
from scm_world.queries.world import World


@final
class OnlineFit:
    """Fits parameters to a run again and again, while it goes on.

    Each fit takes Gauss-Newton steps from the parameters of the last one, with start states of
    windows from the measurements. Its intervals are linearised; it does not look for other minima,
    as ``World.fit`` does. Simulated copies of the world are kept for the next fit.

    Args:
        world: The model, with the parameters from which the first fit begins.
        parameters: Patterns of parameters; see ``World.fit``.
        measures: Standard deviation of the noise of each measured column, by the names of columns
            or of variables.
        iterations: Largest number of steps of a fit; one that takes all of them determines nothing,
            and the next one goes on from there.
        last: How many of the last control steps are fitted; all if None.

    Attributes:
        columns: The measured numbers, in the order of the names.
        targets: The fitted numbers.

    Raises:
        UnknownVariable: A name is not that of a column, or a pattern fits nothing.
        UnknownOption: A standard deviation is not positive, or a parameter is a delay.
        NotIntervenable: A parameter cannot be changed.
    """

    def __init__(
        self,
        world: World,
        parameters: Iterable[str],
        measures: Mapping[str, float],
        *,
        iterations: int,
        last: int | None = None,
    ) -> None:
        self.world, self._iterations, self._last = world, iterations, last
        with twin_of(world) as twin:
            known, self.targets = columns_of(twin), targets_of(twin, parameters)
        found = dict[MeasuredNumber, float]()
        for name, given in measures.items():
            mine = [c for c in known.values() if name in (c.name, c.variable)]
            if not mine:
                raise UnknownVariable(name, known)
            if (deviation := real_number(f"measures[{name!r}]", given)) <= 0.0:
                raise UnknownOption(f"measures[{name!r}]", given, ("a number above zero",))
            found |= dict.fromkeys(mine, deviation)
        for target in self.targets:
            if target.values is None:
                raise UnknownOption("parameters", target.name, ("parameters of the world",))
        self.columns, self._noise = tuple(found), np.array([*found.values()])
        self._shooting: Shooting | None = None
        self.begin()

    def rescale(self, sizes: Floats) -> None:
        """Take steps of these sizes, scaled, shape (p,), of parameters that can be zero.

        They are asked for before the first fit. A size of 0 changes nothing.
        """
        self.targets = tuple(
            replace(t, low=t.low / size, high=t.high / size, scale=t.scale * size)
            if not t.log and size > 0.0
            else t
            for t, size in zip(self.targets, sizes, strict=True)
        )

    def begin(self) -> None:
        """Begin another run, from the parameters of the world."""
        self.scaled = np.zeros(len(self.targets))

    def close(self) -> None:
        """Return the copies of the world, for other fits."""
        if self._shooting is not None:
            self._shooting.__exit__()
            self._shooting = None

    def update(self, commands: Floats, values: Floats) -> Fit:
        """Fit the run so far.

        Args:
            commands: The command of each control step, shape (steps, n_actions).
            values: The measured columns at the beginning of each control step and after the last
                one, shape (steps + 1, columns).

        Raises:
            UnknownOption: There are fewer measurements than fitted numbers.
            EngineFailure: The engine lost every state.
        """
        first = max(len(commands) - (self._last or len(commands)), 0)
        dt, instants = self.world.options.control_period, np.arange(len(values) - first)
        about: Any = {"begin": dt * first, "whole": not first, "before": commands[:first]}
        run = RecordedRun(commands[first:], instants, values[first:], **about)
        measured = Measurements((run,), self.columns, dt)
        if self._shooting is None:
            self._shooting = Shooting(self.world, measured, self.targets)
        shooting = self._shooting
        shooting.runs = measured.runs
        problem = FitProblem(shooting, measured, self.targets, self._noise)
        if len(measured.cells[0]) < len(self.targets) + len(shooting.free) * len(problem.windows):
            needed = f"more than {len(measured.cells[0])}, for parameters and start states"
            raise UnknownOption("measurements", len(measured.cells[0]), (needed,))
        every = range(len(self.targets))
        how = problem.noise, every, ROUGH[1], self._iterations
        squares = LeastSquares(problem, problem.joined, *how)
        at = gauss_newton(squares, self.scaled, [*shooting.guess(problem.segments)])
        self.scaled = at.scaled
        firsts = np.cumsum([0, *map(len, problem.joined[:-1])])
        states = np.array(at.starts)[firsts], problem.noise, problem.given, problem.known
        linear = tuple(at.made), shooting.spans
        rest: Any = {"ended": not at.smooth}
        targets, window = self.targets, problem.window
        return Fit(self.world, measured, targets, window, at.scaled, *states, *linear, **rest)
