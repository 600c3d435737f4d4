"""Delays and noise of the actuators and sensors of a model, as variables of its graph."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import ceil, inf, prod
from typing import Any, cast, final

import numpy as np

from scm_world._arguments import real_number
from scm_world._patterns import by_name
from scm_world._types import Floats, Value, Values
from scm_world._types import Integers as Places
from scm_world.errors import UnknownOption
from scm_world.geometry.numbers import njit, scalar
from scm_world.graph import NoiseKey
from scm_world.models import Model, ModelRow
from scm_world.models.model import HELD, StateRow
from scm_world.tasks.composition import Commands, Held
from scm_world.variables import (
    Box,
    Exogenous,
    Function,
    Integers,
    Measured,
    Normal,
    Parent,
    Variable,
)
from scm_world.variables.reserved import CONTROL_INDEX

STEPS = (
    "a number of control steps, 0 or more, such as 2 or 1.5",
    "Integers(least, most) or Box(least, most): drawn at every reset",
)


SAME = 1e-9
"""Steps between two times that are the same."""


@final
@dataclass(frozen=True)
class Channel:
    """An actuator, or a sensor, with a delay or noise.

    With d control steps of delay at most, a spread s and a standard normal number e of each control
    step, an actuator applies ``u[t - delay] + s e``, and a sensor reads ``y[t - delay] + s e``. In
    the first control steps an actuator applies its idle control, and a sensor reads the first
    value. Of a delay of 1.3 control steps of an actuator, ``u[t - 2]`` acts in the first 0.3 of a
    control step, then ``u[t - 1]``; see ``switched``.

    Attributes:
        of: The command, or the measured variable.
        acts: Whether it is an actuator.
        noise: Default of s, in the unit of the quantity; None without noise.
        delay: The steps it has, or the space that they are drawn from at every reset; None if 0. A
            number with a fraction, or a box, is a delay of real numbers.
        causes: The states and parameters that a readout is computed from.
    """

    of: ModelRow
    acts: bool
    noise: float | None
    delay: float | Integers | Box | None
    causes: tuple[str, ...] = ()

    @property
    def size(self) -> int:
        """How many numbers the quantity has."""
        return prod(self.of.shape)

    @property
    def ends(self) -> tuple[float, float]:
        """The shortest and the longest delay that it can have, in control steps.

        They are those of a space. Without one, the shortest is 0, or 1 of a command with a delay of
        1 or more, which reaches nothing at once; the longest one is a whole number.
        """
        if isinstance(self.delay, Integers | Box):
            low, high = cast(tuple[float, float], (self.delay.low, self.delay.high))
            return float(low), float(high)
        return float(self.acts and (self.delay or 0) >= 1), float(ceil(self.delay or 0))

    @property
    def most(self) -> int:
        """How many past values are needed."""
        return ceil(self.ends[1])

    @property
    def is_real(self) -> bool:
        """Whether the delay may have a fraction."""
        return isinstance(self.delay, float | Box)

    @property
    def varies(self) -> bool:
        """Whether the delay is a variable."""
        return self.most > 0 and not (self.acts and self.ends == (self.most, self.most))

    def name(self, what: str) -> str:
        """Return the name of one of its variables."""
        return f"{self.of.name}_{what}"

    def held(self) -> Iterator[StateRow]:
        """List the states that remember past values, and the present error of a sensor."""
        if self.most:
            idle = np.broadcast_to(self.of.default if self.acts else 0.0, self.size)
            effect = (self.of.always, self.of.contact) if self.acts else (frozenset[int](),) * 2
            yield StateRow(
                *(self.name("past"), self.of.unit, (self.most * self.size,)),
                *((*idle.tolist(),) * self.most, -inf, inf),
                *("Its last values, the latest first.", *effect),
                array=HELD,
            )
        if self.noise is not None and not self.acts:
            yield StateRow(
                *(self.name("error"), "1", self.of.shape),
                *((0.0,) * self.size if self.of.shape else 0.0, -inf, inf),
                "Present error of the sensor: standard normal numbers, new in every step.",
                array=HELD,
            )

    def parameters(self) -> Iterator[ModelRow]:
        """List its parameters: how much noise there is, and how long the delay is."""
        effect = (self.of.always, self.of.contact) if self.acts else (frozenset[int](),) * 2
        if self.noise is not None:
            what = "command" if self.acts else "reading"
            doc = f"Standard deviation of the noise of the {what}."
            name, start = self.name("noise"), self.noise
            yield ModelRow(name, self.of.unit, (), start, 0.0, inf, doc, *effect)
        if self.varies:
            row = self.name("delay"), "1", (), self.ends[1], *self.ends, "Delay in control steps."
            yield ModelRow(*row, *effect)

    def delays(self, given: Mapping[str, Any]) -> Exogenous:
        """Declare the delay, with requested fields."""
        drawn = self.delay if isinstance(self.delay, Integers | Box) else None
        default = self.ends[1] if self.is_real else self.most
        fields: dict[str, Any] = {
            "default": self.delay if isinstance(self.delay, float) else default,
            "distribution": drawn,
            "bounds": Box(*self.ends) if self.is_real else Integers(*map(int, self.ends)),
            "dtype": "real" if self.is_real else "integer",
            "doc": f"Delay of {self.of.name} in control steps.",
        }
        return Exogenous(name=self.name("delay"), **fields | dict(given))

    def remembers(
        self, row: StateRow, moving: Mapping[str, tuple[Parent, ...]]
    ) -> tuple[Parent, ...]:
        """Return the causes of a state of ``held``; ``moving`` has those of each moved state."""
        if row.name != self.name("past"):
            return ()
        causes = self.causes or (self.of.name,)
        found = [Parent(row.name, 1)] if self.most > 1 else []
        found += [Parent(name, 1) for name in causes]
        if self.is_real and not self.acts:  # it is read within a control step
            found += [Parent(self.name("delay"), 1)]
            found += [parent for name in causes for parent in moving.get(name, ())]
        return tuple(dict.fromkeys(found))

    def readings(self) -> Iterator[Variable]:
        """Declare what a sensor reads."""
        if self.acts:
            return
        parents, kernel = [self.of.name], cast(Any, _noisy)
        if self.most:
            parents += [self.name("delay"), self.name("past"), CONTROL_INDEX]
            kernel = _delayed_vector if self.of.shape else _delayed
        if self.noise is not None:
            parents += [self.name("noise"), self.name("error")]
            if self.most:
                kernel = _delayed_noisy_vector if self.of.shape else _delayed_noisy
        yield Measured(
            name=self.name("reading"),
            unit=self.of.unit,
            shape=self.of.shape,
            parents=tuple(parents),
            mechanism=Function(kernel),
            doc=f"What the sensor of {self.of.name} reads.",
        )


def channels_of(
    system: Model, noise: Mapping[str, Any], delay: Mapping[str, Any]
) -> tuple[Channel, ...]:
    """Return the actuators and sensors of a model that have noise or a delay.

    Standard deviations, and delays in control steps, are given by name or pattern of controls,
    states and readouts.
    """
    rows: dict[str, ModelRow] = {row.name: row for row in (*system.inputs, *system.states)}
    for row in system.readouts:
        size = (0.0,) * prod(row.shape) if row.shape else 0.0
        rows[row.name] = ModelRow(row.name, row.unit, row.shape, size, -inf, inf, row.doc)
    given, acting = {}, {row.name for row in system.inputs}
    for option, values in (("noise", noise), ("delay", delay)):
        given[option] = by_name(option, values, rows)
        for name, value in given[option].items():
            where = f"{option}[{name!r}]"
            if option == "delay":
                drawn = isinstance(value, Integers | Box)
                least, most = (value.low, value.high) if drawn else (0, value)
                kinds = (int, np.integer, float)
                right = all(isinstance(n, kinds) and not isinstance(n, bool) for n in (least, most))
                if not right or not 0 <= least <= most < inf:
                    raise UnknownOption(where, value, STEPS)
            elif real_number(where, value) < 0.0:
                raise UnknownOption(where, value, ("a standard deviation, not below 0",))
            elif name.endswith(".orientation"):
                allowed = ("left out: quaternions cannot be added up; add noise to a readout",)
                raise UnknownOption(where, value, allowed)
    causes = {row.name: row.parents for row in system.readouts}
    noises = given["noise"]
    delays = {name: steps for name, steps in given["delay"].items() if steps != 0}
    return tuple(
        Channel(row, name in acting, noises.get(name), delays.get(name), causes.get(name, ()))
        for name, row in rows.items()
        if name in noises or name in delays
    )


def with_held(system: Model, channels: Sequence[Channel]) -> Model:
    """Return a model with the states that channels remember, and no others, after its own."""
    own = [row for row in system.states if row.array != HELD]
    held = [row for channel in channels for row in channel.held()]
    text = f"{system.digest}\0{[(row.name, row.shape) for row in held]}"
    digest = hashlib.sha256(text.encode()).hexdigest()
    return dataclasses.replace(system, states=(*own, *held), digest=digest)


@lru_cache(maxsize=4096)
def switched(delay: float, substeps: int) -> tuple[int, tuple[float, ...]]:
    """Return how many control steps late a command is, and where in a control step it arrives.

    With m whole control steps of delay, u[t - m - 1] acts until the fraction of the delay is over,
    then u[t - m]. In the physics step in which that happens, both act in proportion to their time.

    Args:
        delay: In control steps.
        substeps: How many physics steps a control step has.

    Returns:
        The number m, and the share of u[t - m - 1] in each physics step; empty if the delay ends
        with a control step, to a billionth of a physics step.
    """
    late = delay * substeps
    late = round(late) if abs(late - round(late)) < SAME else late
    whole, rest = divmod(late, substeps)
    shares = tuple(min(1.0, max(0.0, rest - step)) for step in range(substeps))
    return int(whole), shares if rest else ()


@final
class Channels(Commands):
    """Delays commands, draws noise, and remembers commands and measurements.

    Noise belongs to seed, episode, control step and place among the channels of its kind: no
    intervention changes it.

    Args:
        channels: The actuators and sensors.
        system: The model with their states; see ``with_held``.
    """

    def __init__(self, channels: Sequence[Channel], system: Model) -> None:
        layout, inputs = system.layout.slices, [row.name for row in system.inputs]
        sensed = [one.of.name for one in channels if not one.acts and one.most]
        self._read = tuple(name for name in sensed if name not in layout)
        rows = [row for row in system.states if row.array == HELD]
        self._first = layout[rows[0].name].start if rows else system.layout.size
        # Each number that is held comes from a number of commands, state and readouts, in a row.
        places = {name: slice(i, i + 1) for i, name in enumerate(inputs)}
        shift, end = len(inputs), len(inputs) + system.layout.size
        places |= {n: slice(shift + at.start, shift + at.stop) for n, at in layout.items()}
        for one in channels:
            if one.of.name in self._read:
                places[one.of.name], end = slice(end, end + one.size), end + one.size
        sources, errors = list[int](), list[int]()
        self._shifted: list[tuple[str, range, bool]] = []  # sensors: delay, last value, quaternion
        for one in channels:
            for row in one.held():
                at, here = places[row.name], range(len(sources), len(sources) + one.size)
                if row.name == one.name("error"):
                    errors += here
                    sources += range(at.start, at.stop)
                    continue
                if one.is_real and not one.acts:
                    turns = one.of.name.endswith(".orientation")
                    self._shifted.append((one.name("delay"), here, turns))
                now = places[one.of.name]
                sources += [*range(now.start, now.stop), *range(at.start, at.stop - one.size)]
        self._sources, self._errors = np.array(sources, int), np.array(errors, int)
        self._late = [
            (
                inputs.index(one.of.name),
                one.name("delay") if one.varies else "",
                layout[one.name("past")].start + (0 if one.varies else one.most),
            )
            for one in channels
            if one.acts and one.most
        ]
        noisy = [one for one in channels if one.acts and one.noise is not None]
        self._noisy = [inputs.index(one.of.name) for one in noisy]
        self._spreads = [one.name("noise") for one in noisy]
        self.noisy = {inputs[at]: slice(at, at + 1) for at in self._noisy}

    def command(
        self, action: Floats, values: Values, vector: Floats, key: NoiseKey, substeps: int
    ) -> Floats:
        """Return the commands that arrive now, with noise; see ``Commands``."""
        sent = action.copy()
        if self._samples(values, substeps):
            sent = np.repeat(sent[None], substeps, axis=0)
        for index, name, past in self._late:
            whole, shares = switched(float(values[name]) if name else 0.0, substeps)
            if whole or not name:
                sent[..., index] = vector[past + whole - 1]
            if shares:
                if sent.ndim == 1:
                    sent = np.repeat(sent[None], substeps, axis=0)
                change = vector[past + whole] - sent[:, index]
                sent[:, index] += np.array(shares) * change
        if self._noisy:
            drawn = key.draw(Normal(), "actuators", (len(self._noisy),), {}, "noise")
            sent[..., self._noisy] += drawn * [float(values[name]) for name in self._spreads]
        return sent

    def held(
        self, action: Floats, values: Values, vector: Floats, key: NoiseKey, substeps: int
    ) -> Held | None:
        """Return past values and errors as they are after the control step."""
        if not self._sources.size:
            return None
        size, given = vector.size, cast(Any, values)

        def read(row: Floats) -> Floats:
            parts = [action, row[:size]]
            if self._read:
                now = given.copy()
                now.numbers[:size] = row[:size]
                now.evaluate(self._read)
                parts += [np.ravel(now[name]) for name in self._read]
            found: Floats = np.concatenate(parts)[self._sources]
            return found

        found = read(vector)
        if self._errors.size:
            found[self._errors] = key.draw(Normal(), "sensors", self._errors.shape, {}, "noise")
        return Held(found, self._samples(values, substeps), read)

    def _samples(self, values: Values, substeps: int) -> dict[int, tuple[Places, Floats]]:
        """Return what sensors remember from within a control step; see ``Held``.

        Of a delay with a fraction f, that is the value f control steps before the end: between two
        physics steps on a straight line, a quaternion that of the nearest one.
        """
        found: dict[int, list[tuple[int, float]]] = {}
        for name, places, turns in self._shifted:
            delay = float(values[name])
            if abs(delay - round(delay)) < SAME:
                continue
            since = (1.0 - delay % 1.0) * substeps
            near = round(since)
            step, share = divmod(near if turns or abs(since - near) < SAME else since, 1)
            for after, part in ((int(step), 1.0), (int(step) + 1, share)):
                if after and part:
                    found.setdefault(after, []).extend((place, part) for place in places)
        return {
            step: (np.array([p for p, _ in each]), np.array([share for _, share in each]))
            for step, each in found.items()
        }


# --- what a sensor reads --------------------------------------------------------------------------


@njit(cache=True)
def _noisy(value: Value, spread: Value, error: Value) -> Any:
    return value + spread * error


@njit(cache=True)
def _steps(delay: Value, index: Value) -> int:
    """Return which past value is read; in the first control steps there are fewer."""
    return ceil(min(scalar(delay), scalar(index)) - SAME)


@njit(cache=True)
def _delayed(value: Value, delay: Value, past: Floats, index: Value) -> float:
    steps = _steps(delay, index)
    return scalar(value) if steps == 0 else past[steps - 1]


@njit(cache=True)
def _delayed_vector(value: Floats, delay: Value, past: Floats, index: Value) -> Floats:
    steps = _steps(delay, index)
    n = value.size
    return value.copy() if steps == 0 else past[(steps - 1) * n : steps * n].copy()


@njit(cache=True)
def _delayed_noisy(
    value: Value, delay: Value, past: Floats, index: Value, spread: Value, error: Value
) -> float:
    return _delayed(value, delay, past, index) + scalar(spread) * scalar(error)


@njit(cache=True)
def _delayed_noisy_vector(
    value: Floats, delay: Value, past: Floats, index: Value, spread: Value, error: Floats
) -> Floats:
    return _delayed_vector(value, delay, past, index) + scalar(spread) * error
