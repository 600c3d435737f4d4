"""Effects of experiments, and how large they are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, final

import numpy as np

from scm_world._types import Floats, Value
from scm_world.queries.progress import Progress

EdgeKey = tuple[str, str, int]
"""Cause, effect, lag."""

RESOLUTION = 1e-12
"""Smaller differences are rounding, where the noise floor is exactly zero."""

FACTOR = 10.0
"""How many times the noise floor an effect must be."""


@final
@dataclass(frozen=True)
class ProbeSetting:
    """What was done when something was seen.

    Attributes:
        probe: Number of the probe state.
        kind: How the probe state came about.
        change: By how much the cause was moved; None where no world was intervened on.
    """

    probe: int
    kind: str
    change: Floats | None = None


@final
@dataclass(frozen=True)
class Response:
    """How an effect answered to a change of its cause.

    Attributes:
        change: Of the cause, flattened.
        answer: Difference of the effect, flattened.
        base: Value of the effect without the change, flattened.
    """

    change: Floats
    answer: Floats
    base: Floats


@final
@dataclass
class Effects:
    """The largest effect seen so far on each ordered pair.

    Attributes:
        largest: By cause, effect and lag.
        settings: Where the largest effect of each pair was seen, if it is not zero.
        states: In how many probe states each pair answered, beyond rounding.
        floor: Noise floor: the largest difference after something was done and undone.
        floors: The same of each target by itself, after it was changed and put back.
        exact: Whether any difference counts, rounding too, where no edge is declared.
        changed: In how many probe states each variable got another value.
        touched: Pairs of bodies that pressed on each other in a probe state.
        rollouts: Control steps simulated in an experiment of their own.
        refused: Targets for which no feasible value was found, with how often.
        unstable: By how much a variable differed though nothing had been changed, or after another
            one had been changed and put back: by its name, and the name of that one or "".
        apart: The largest effect, and where, of each edge by contact while nothing touched.
        shared_noise: Pairs of variables that are given one and the same noise.
        setting: What is being done now.
        responses: By pair and probe, if they are wanted; else None.
    """

    largest: dict[EdgeKey, float] = field(default_factory=dict)
    settings: dict[EdgeKey, ProbeSetting] = field(default_factory=dict)
    states: dict[EdgeKey, int] = field(default_factory=dict)
    floor: float = 0.0
    floors: dict[str, float] = field(default_factory=dict)
    exact: bool = False
    changed: Counter[str] = field(default_factory=Counter)
    touched: set[tuple[str, str]] = field(default_factory=set)
    rollouts: int = 0
    refused: dict[str, int] = field(default_factory=dict)
    unstable: dict[tuple[str, str], float] = field(default_factory=dict)
    apart: dict[EdgeKey, tuple[float, ProbeSetting]] = field(default_factory=dict)
    shared_noise: set[tuple[str, str]] = field(default_factory=set)
    setting: ProbeSetting | None = None
    responses: dict[tuple[EdgeKey, int], Response] | None = None
    _answered: set[EdgeKey] = field(default_factory=set)

    def see(self, cause: str, effect: str, lag: int, after: Value, before: Value) -> None:
        """Keep a difference if it is the largest of its pair."""
        key, size = (cause, effect, lag), gap(after, before)
        if size > self.largest.get(key, -1.0):
            self.largest[key] = size
            if size > 0.0 and self.setting is not None:
                self.settings[key] = self.setting
        if size > RESOLUTION:
            self._answered.add(key)
        if self.responses is not None and size > 0.0:
            self._respond(self.responses, key, np.ravel(after), np.ravel(before))

    def see_unstable(self, name: str, size: float, after: str = "") -> None:
        """Keep a difference that nothing explains; see ``unstable``."""
        if size > self.unstable.get((name, after), 0.0):
            self.unstable[name, after] = size

    def see_apart(self, sizes: Mapping[EdgeKey, float]) -> None:
        """Keep effects of what needs contact, seen while nothing touched."""
        for key, size in sizes.items():
            known = self.apart[key][0] if key in self.apart else RESOLUTION
            if size > known and self.setting is not None:
                self.apart[key] = size, self.setting

    def see_nothing(self, cause: str, effect: str, lag: int) -> None:
        """Count a pair that was observed without a difference."""
        self.largest.setdefault((cause, effect, lag), 0.0)

    def end_of_probe(self) -> None:
        """Count the pairs that answered in this probe state."""
        for key in self._answered:
            self.states[key] = self.states.get(key, 0) + 1
        self._answered.clear()

    def _respond(
        self,
        responses: dict[tuple[EdgeKey, int], Response],
        key: EdgeKey,
        after: Floats,
        before: Floats,
    ) -> None:
        setting = self.setting
        if setting is not None and setting.change is not None:
            responses[key, setting.probe] = Response(setting.change, after - before, before)

    def take(self, other: Effects, done: int) -> None:
        """Add what was seen elsewhere.

        Args:
            other: Effects in other probe states.
            done: How many probe states came before those, so that they can be numbered on.
        """
        for key, size in other.largest.items():
            if size > self.largest.get(key, -1.0):
                self.largest[key] = size
                if key in other.settings:
                    found = other.settings[key]
                    self.settings[key] = replace(found, probe=done + found.probe)
            self.states[key] = self.states.get(key, 0) + other.states.get(key, 0)
        self.floor = max(self.floor, other.floor)
        for name, size in other.floors.items():
            self.floors[name] = max(size, self.floors.get(name, 0.0))
        self.changed += other.changed
        self.touched |= other.touched
        self.shared_noise |= other.shared_noise
        for (name, after), size in other.unstable.items():
            self.see_unstable(name, size, after)
        for key, (size, found) in other.apart.items():
            if key not in self.apart or size > self.apart[key][0]:
                self.apart[key] = size, replace(found, probe=done + found.probe)
        self.rollouts += other.rollouts

    @property
    def threshold(self) -> float:
        """What an effect must exceed, given the floor."""
        return max(FACTOR * self.floor, RESOLUTION)

    def found(self, threshold: float) -> set[EdgeKey]:
        """List the pairs whose effect exceeds a threshold."""
        return {key for key, size in self.largest.items() if size > threshold}

    def edges(self, declared: Container[EdgeKey]) -> set[EdgeKey]:
        """List the edges that were seen: declared ones beyond rounding, and others."""
        return {
            key
            for key, size in self.largest.items()
            if size > FACTOR * self.floor_of(key[0])
            and (size > RESOLUTION or (self.exact and key not in declared))
        }

    def floor_of(self, cause: str) -> float:
        """Give the noise floor of a cause, or of several; of what is not put back, that of all."""
        return max(self.floors.get(name, self.floor) for name in cause.split(" & "))

    def copy(self) -> Effects:
        """Keep what was seen so far."""
        return replace(
            self,
            largest=dict(self.largest),
            settings=dict(self.settings),
            floors=dict(self.floors),
            states=dict(self.states),
            changed=Counter(self.changed),
            touched=set(self.touched),
            refused=dict(self.refused),
            unstable=dict(self.unstable),
            apart=dict(self.apart),
            shared_noise=set(self.shared_noise),
            responses=None if self.responses is None else dict(self.responses),
            _answered=set(),
        )


def gap(a: Value, b: Value) -> float:
    """Compute the largest difference of two values; NaN counts as infinite."""
    x, y = np.asarray(a), np.asarray(b)
    if (x == y).all():
        return 0.0
    size = float(np.max(np.abs(x.astype(float) - y)))
    return size if size == size else np.inf


@final
class Series:
    """Experiments that may be interrupted (Ctrl-C) or end early.

    Args:
        paired: Does the experiments: ``Paired`` or ``PairedEquations``.
        planned: How many probe states there are.
        progress: Called after each probe.
        done: How many of them were finished before.

    Attributes:
        effects: What was seen in the probe states that are finished.
        done: How many these are.
        targets: The variables that are set.
    """

    def __init__(
        self,
        paired: Any,
        planned: int,
        progress: Progress | None = None,
        *,
        done: int = 0,
    ) -> None:
        self._paired, self.planned, self._progress = paired, planned, progress
        self.effects: Effects = paired.effects
        self.targets: tuple[str, ...] = paired.targets
        self.done = done

    def run(
        self, probes: Iterable[Any], enough: Callable[[Effects, int], bool] | None = None
    ) -> None:
        """Do all experiments.

        Args:
            probes: The probe states.
            enough: Is shown effects and how many probe states are finished after each of them;
                ends the series by returning True.

        Raises:
            KeyboardInterrupt: It was interrupted before the first probe state was finished.
        """
        try:
            for number, probe in enumerate(probes, self.done):
                self._paired.run(number, probe)
                self.done, self.effects = number + 1, self._paired.effects.copy()
                last = enough is not None and enough(self.effects, self.done)
                if self._progress is not None:
                    self._progress(self.done, self.done if last else self.planned)
                if last:
                    return
        except KeyboardInterrupt:
            if self.done == 0:
                raise
