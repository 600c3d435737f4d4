"""Evaluation of one variable of a causal model."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, final

import numpy as np

from scm_world._types import Value, Values
from scm_world.errors import FunctionFailure, ModelError, ScmWorldError, WrongValue, in_one_line
from scm_world.variables import (
    SOFT,
    Categories,
    Derived,
    Distribution,
    Draw,
    Exogenous,
    Fixed,
    Hard,
    Intervention,
    Measured,
    Mechanism,
    Noise,
    Parent,
    Scale,
    Shift,
    Variable,
)


@final
@dataclass
class NoiseKey:
    """Where in a noise stream a draw is taken.

    Attributes:
        noise: The seed's noise.
        episode: The first episode.
        step: The control step.
        count: For how many episodes in a row; None for a single one without a batch axis.
        origin: The control step at which variables got their own noise, if that was another one:
            noise drawn at the start of an episode stays, however late one intervenes.
        attempt: How many draws were rejected before, because they were infeasible.
        kept: The attempt of variables that are not drawn again at another one.
        given: Noise that is known: of some variables, instead of draws.
    """

    noise: Noise
    episode: int = 0
    step: int = 0
    count: int | None = None
    origin: int | None = None
    attempt: int = 0
    kept: Mapping[str, int] | None = None
    given: Values | None = None

    def natural(
        self, source: Distribution, name: str, shape: tuple[int, ...], values: Values
    ) -> Value:
        """Draw what a variable has by itself, without intervention."""
        key = self
        if self.attempt or self.origin is not None:
            step = self.step if self.origin is None else self.origin
            key = replace(self, attempt=0, step=step, origin=None)
        return key.draw(source, name, shape, values)

    def draw(
        self,
        source: Distribution,
        name: str,
        shape: tuple[int, ...],
        values: Values,
        stream: str | None = None,
    ) -> Value:
        """Draw a value of a variable, shape ``(count, *shape)`` or ``shape``."""
        if stream is None and self.given is not None and name in self.given:
            return self.given[name]
        drawn = self.noise.draw(
            source,
            self.stream(name, stream, self.attempt),
            shape,
            values,
            episode=self.episode,
            step=self.step,
            count=self.count or 1,
        )
        return drawn if self.count is not None else drawn[0]

    def stream(self, name: str, stream: str | None, attempt: int) -> str:
        """Return the name of the stream that an attempt to draw a variable takes its noise from."""
        return stream_of(name, stream, (self.kept or {}).get(name, attempt))


def stream_of(name: str, stream: str | None, attempt: int) -> str:
    """Return the name of the stream of an attempt to draw a variable."""
    own = name if stream is None else f"{stream}/{name}"
    return f"{own}#{attempt}" if attempt else own


def earlier(name: str, lag: int) -> str:
    """Name the value of so many control steps ago; that of one step ago has the plain name."""
    return name if lag == 1 else f"{name}@-{lag}"


class AppliedIntervention(NamedTuple):
    """An intervention on a variable.

    Attributes:
        intervention: The intervention.
        requested: The variable it was requested of: the variable itself, other coordinates of it,
            or a bundle that it is a part of.
        below: The intervention that a soft one acts on; None for the variable's own mechanism.
    """

    intervention: Intervention
    requested: Variable
    below: AppliedIntervention | None = None

    @property
    def root(self) -> AppliedIntervention:
        """The lowest one: it decides the mechanism."""
        return self if self.below is None else self.below.root

    @property
    def relative(self) -> Any:
        """The distribution of a shift or factor that is drawn; None if there is none."""
        own = getattr(self.intervention, "by", None)
        if isinstance(own, Draw):
            return own.source
        return None if self.below is None else self.below.relative


def noise_of(
    variable: Variable, mechanism: Derived | Mechanism, key: NoiseKey | None, values: Values
) -> dict[str, Value]:
    """Return the noise argument of a variable's own or given function; zero without a key."""
    source, shape = mechanism.noise, getattr(variable, "noise_shape", None)
    if isinstance(mechanism, Mechanism):
        takes = mechanism.equation.takes_noise
        source = (source or getattr(variable, "noise", None)) if takes else None
    if source is None:
        return {}
    shape = variable.shape if shape is None else shape
    if key is None:
        return {"noise": np.zeros(shape)}
    return {"noise": key.natural(source, variable.name, shape, values)}


def _check_kind(variable: Variable, value: Value) -> None:
    """Refuse what a function gives that is NaN, no whole number, or none of the categories."""
    bounds, said = variable.bounds, ""
    if value.dtype.kind == "f" and np.isnan(value).any():
        rows = f" in {int(np.isnan(value).sum())} of {value.size} numbers" if value.ndim else ""
        said = f"NaN{rows}"
    elif variable.dtype == "integer" and value.dtype.kind == "f":
        wrong = value[np.rint(value) != value].ravel().tolist()[:3]
        more = "and the variable is an integer: round them in the function"
        said = f"{wrong}, {more}" if wrong else ""
    elif isinstance(bounds, Categories) and not bounds.contains(value):
        wrong = np.setdiff1d(value, bounds.members).tolist()[:3]
        said = f"{wrong}, which are none of {bounds.describe()}"
    if said:
        raise FunctionFailure(f"the function of {variable.name!r} gives {said}")


def first_value(variable: Variable) -> Value:
    """Return the value that lagged children of a variable see before the first step."""
    fields = {Derived: "start", Fixed: "value", Exogenous: "default"}
    first: Any = getattr(variable, fields.get(type(variable), ""), 0.0)
    return variable.array(np.broadcast_to(first, variable.shape) if np.ndim(first) == 0 else first)


def amount(act: Shift | Scale, variable: Variable, key: NoiseKey | None) -> Value:
    """Return what an intervention adds, or the factor; drawn where it is a draw.

    A draw that variables share is one number for each episode, for all components.
    """
    by = act.by
    if not isinstance(by, Draw):
        return np.asarray(by)
    if key is None:
        raise ModelError([f"{variable.name!r} is changed by a draw: solve needs a noise key"])
    if getattr(variable, "per", "step") == "episode" and key.origin is None:
        key = replace(key, step=0)
    name, shape = (act.shared, ()) if act.shared else (variable.name, variable.shape)
    drawn = key.draw(by.source, str(name), shape, {}, by.stream or "by")  # type: ignore[arg-type]
    ones = (1,) * len(variable.shape) if act.shared and drawn.ndim else ()
    return drawn.reshape(drawn.shape + ones)


def given(requested: Any, name: str, value: Value) -> Value:
    """Return the value of a variable for one of a bundle, or of other coordinates."""
    if requested.name == name:
        return np.asarray(value)
    if requested.parts:
        return np.asarray(requested.mechanism.split(value)[requested.parts.index(name)])
    return np.asarray(requested.inverse.bind()(value))


def evaluate(
    declared: Mapping[str, Variable],
    name: str,
    act: AppliedIntervention | None,
    values: Values,
    previous: Values,
    key: NoiseKey | None,
) -> Value:
    """Compute a variable from the values so far, under an intervention or none."""
    if act is None:
        return _natural(declared, name, values, previous, key)
    requested = act.requested
    if requested.name == name or not isinstance(act.intervention, SOFT):
        return given(requested, name, intended(declared, name, act, values, previous, key))
    below, before, after = _moved(declared, name, act, values, previous, key)
    found = given(requested, name, after)
    stays = np.all(before == after, axis=tuple(range(-len(requested.shape), 0)))
    # The inverse of coordinates is rounded: what stays in them stays itself.
    return np.where(stays[(..., *(None,) * len(declared[name].shape))], below, found)


def intended(
    declared: Mapping[str, Variable],
    name: str,
    act: AppliedIntervention,
    values: Values,
    previous: Values,
    key: NoiseKey | None,
) -> Value:
    """Compute what an intervention makes of the variable that it was requested of."""
    done, requested = act.intervention, act.requested
    if isinstance(done, Hard):
        return requested.array(done.value)
    if isinstance(done, SOFT):
        return _moved(declared, name, act, values, previous, key)[2]
    if isinstance(done, Draw):
        if key is None:
            raise ModelError([f"{requested.name!r} is drawn: solve needs a noise key to draw with"])
        if getattr(requested, "per", "step") == "episode" and key.origin is None:
            key = replace(key, step=0)
        source, stream = done.drawn_from(requested), done.stream
        if stream is None and key.origin is None and key.given is None:
            stream = "do"  # of a model; a world counts its draws
        return key.draw(source, requested.name, requested.shape, values, stream)
    mechanism: Any = done
    arguments = map(np.array, _arguments(declared, mechanism.parents, values, previous))  # copies
    found = mechanism.equation.bind()(*arguments, **noise_of(requested, mechanism, key, values))
    value = np.asarray(found)
    if value.dtype.kind not in ("iuf" if requested.dtype == "real" else "biuf"):
        raise WrongValue(requested.name, found, f"numbers of shape {requested.shape}")
    if value.shape[value.ndim - len(requested.shape) :] != requested.shape:
        try:
            value = requested.array(value)
        except (TypeError, ValueError):
            raise WrongValue(requested.name, done, requested.shape, value.shape) from None
    if requested.dtype != "real":
        value = np.rint(value).astype(np.int64)
    _check_kind(requested, value)
    return value


def _moved(
    declared: Mapping[str, Variable],
    name: str,
    act: AppliedIntervention,
    values: Values,
    previous: Values,
    key: NoiseKey | None,
) -> tuple[Value, Value, Value]:
    """Return what a soft intervention acts on, that in the requested coordinates, and moved."""
    done: Any = act.intervention
    below, requested = evaluate(declared, name, act.below, values, previous, key), act.requested
    there = below
    if requested.name != name:
        coordinates: Any = requested
        there = np.asarray(coordinates.mechanism.bind()(below))
    by = amount(done, requested, key)
    moved = there + by if isinstance(done, Shift) else there * by
    return below, there, moved if requested.dtype == "real" else np.rint(moved).astype(np.int64)


def _natural(
    declared: Mapping[str, Variable],
    name: str,
    values: Values,
    previous: Values,
    key: NoiseKey | None,
) -> Value:
    """Compute a variable without intervention."""
    match variable := declared[name]:
        case Exogenous():
            if name in values:
                return values[name]
            if key is None or variable.distribution is None:
                return variable.array(variable.default)
            if variable.per == "episode" and key.origin is None and key.step:
                key = replace(key, step=0)
            return key.natural(variable.distribution, name, variable.shape, values)
        case Fixed():
            return variable.array(variable.value)
        case Derived() | Measured() if variable.mechanism is not None:
            pass
        case _ if name in values:
            return values[name]
        case _:
            raise ModelError([f"{name!r} is not computed by the model: give its value"])
    arguments = _arguments(declared, variable.parents, values, previous)
    own = variable if isinstance(variable, Derived) else None
    noise = {} if own is None or own.noise is None else noise_of(own, own, key, values)
    try:
        value = np.asarray(variable.mechanism.bind()(*arguments, **noise))
    except ScmWorldError:
        raise
    except Exception as error:
        problem = f"the function of {name!r} raised {in_one_line(error)}"
        raise FunctionFailure(problem) from error
    if own is None:
        return value
    shape = value.shape[value.ndim - len(own.shape) :]
    if value.dtype.kind not in "biuf" or shape != own.shape:
        wanted = f"numbers of shape {own.shape}" if own.shape else "a number"
        raise FunctionFailure(f"the function of {name!r} gives {value!r}, not {wanted}")
    _check_kind(own, value)
    return value


def _arguments(
    declared: Mapping[str, Variable], parents: Iterable[Parent], values: Values, previous: Values
) -> Iterator[Value]:
    for parent in parents:
        name = parent.name if parent.lag < 2 else earlier(parent.name, parent.lag)
        known = previous if parent.lag else values
        if parent.lag and name not in known:
            yield first_value(declared[parent.name])
        else:
            yield known[name]
