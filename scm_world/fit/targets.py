"""Fitted numbers: components of parameters of a twin, scaled, and the delay of the commands."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import final

import numpy as np

from scm_world._patterns import as_names, fits, fitting
from scm_world._types import ArrayLike, Floats, Integers
from scm_world.errors import NotIntervenable, UnknownOption, UnknownVariable
from scm_world.fit.inertia import (
    INERTIAL,
    LOGS,
    NUMBERS,
    PARTS,
    SECOND,
    InertiaBlock,
    swapped,
    ten_numbers,
    turn_from,
    turned_by,
)
from scm_world.fit.recordings import MeasuredNumber, labels, settable_of
from scm_world.queries.twins import twins_of
from scm_world.queries.world import World
from scm_world.tasks.channels import Channel
from scm_world.variables import Box, Variable
from scm_world.variables.distributions import Normal
from scm_world.variables.interventions import Mechanism
from scm_world.world import Simulation

DELAY = "delay"  # name of the delay of all commands [s], which is fitted like a parameter
LATE = "_delay"  # after the name of an action: the delay of one command [control steps]
TIMESTEP = "timestep"  # a setting of the engine, which no robot has
LONGEST_DELAY = 20.0  # [control steps]
UNSEEN = 0.1  # scale of a parameter that is zero, if nothing shows a better one
LIGHTEST = 1e-8  # least mass [kg] and second moment [kg m²] of an inertia that is drawn
FAR = 12.0  # largest logarithm of a positive parameter, relative to its default

Form = Callable[[Floats], Floats]


@final
@dataclass(frozen=True, eq=False)
class Target:
    """A fitted number: a component of a parameter, or a delay of commands.

    Attributes:
        name: ``"upper_arm.mass"``, or ``"pole.inertia[1]"`` for a component of a vector.
        variable: Name of the variable.
        component: Number of the component.
        unit: Unit of the variable.
        default: Its value in the world.
        scale: Size of a scaled unit, if ``log`` is false.
        log: Whether the scaled number is the logarithm of value : default.
        low: Lower end of its range, scaled.
        high: Upper end, scaled.
        whole: Whether all components keep their proportions to this one: those of an inertia, or
            the two ends of a symmetric range.
        values: All numbers of the variable in the world; None for a delay, which the world lacks.
        block: The inertia of which it is one of ten numbers, one after another. It is searched in
            the numbers of the block, and reported as those of ``InertiaBlock.numbers``.
        forms: What turns values of the variable into those of which it is a component, and back,
            where these can have any value.
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
    values: Floats | None = None
    block: InertiaBlock | None = None
    forms: tuple[Form, Form] = (np.asarray, np.asarray)

    @property
    def written(self) -> tuple[str, ...]:
        """Names of the variables that it sets."""
        if self.block is not None:
            return tuple(self.block.values(np.zeros(10)))
        return () if self.values is None else (self.variable,)

    def value(self, scaled: ArrayLike) -> Floats:
        """Return the value of a scaled number, or the values of an array of them."""
        if self.log:
            return np.asarray(self.default * np.exp(scaled))
        return np.asarray(self.default + self.scale * np.asarray(scaled))

    def scaled(self, value: ArrayLike) -> Floats:
        """Return the scaled number of a value, or those of an array of them."""
        if self.log:
            return np.log(np.asarray(value) / self.default)
        return (np.asarray(value) - self.default) / self.scale


@final
@dataclass(frozen=True, eq=False)
class Conditional:
    """Draws a fitted parameter from the posterior, given the parameters that were drawn before it.

    Attributes:
        own: Its fitted numbers.
        before: Those of its parents, in their order, and which parent has each.
        middle: Scaled values of its own numbers where those before it have theirs, shape (p,).
        others: Scaled values of those before it, shape (q,).
        slope: Derivatives by those before it, shape (p, q).
        root: Cholesky factor of the covariance that is left, shape (p, p).
    """

    own: tuple[Target, ...]
    before: tuple[tuple[int, Target], ...]
    middle: Floats
    others: Floats
    slope: Floats
    root: Floats

    def __call__(self, *parents: Floats, noise: Floats) -> Floats:
        """Return values of the parameter, with leading axes of the worlds, as the noise has."""
        usual = np.asarray(self.own[0].values)
        lead = np.shape(noise)[: np.ndim(noise) - usual.ndim]
        values = np.broadcast_to(usual, (*lead, *usual.shape)).copy().reshape(*lead, -1)
        drawn = np.reshape(noise, (*lead, -1))[..., : len(self.own)] @ self.root.T + self.middle
        for i, (place, target) in enumerate(self.before):
            there = np.reshape(target.forms[0](parents[place]), (*lead, -1))[..., target.component]
            drawn = drawn + (target.scaled(there) - self.others[i])[..., None] * self.slope[:, i]
        for i, target in enumerate(self.own):
            value = target.value(np.clip(drawn[..., i], target.low, target.high))
            if target.whole:
                values = values * (value / values[..., target.component])[..., None]
            else:
                values[..., target.component] = value
        return np.asarray(self.own[0].forms[1](values.reshape((*lead, *usual.shape))))


def _drawn(block: InertiaBlock, at: Floats) -> tuple[list[Target], Floats]:
    """Return numbers of an inertia whose normal distribution has only bodies that can exist.

    They are the logarithms of the mass and of the second moments along the principal axes, the
    center of mass, and the vector of a turn of these axes. Returned are also the derivatives of the
    searched numbers by them, shape (10, 10).
    """
    mass, center, moments, axes = block.body(at)
    turn = partial(turn_from, axes), partial(turned_by, axes)
    means = np.asarray(mass), center, swapped(moments, 0.5), np.zeros(3)
    plain: tuple[Form, Form] = np.asarray, np.asarray
    forms: tuple[tuple[Form, Form], ...] = plain, plain, (SECOND, swapped), turn
    found = list[Target]()
    for name, mean, form in zip(block.values(at), means, forms, strict=True):
        for i, value in enumerate(np.ravel(mean).tolist()):
            log = name.endswith((".mass", ".inertia"))
            scale = block.length if mean is center else 1.0
            low, high = (math.log(LIGHTEST / value), FAR) if log else (-math.inf, math.inf)
            about = name, name, i, "", value, scale, log, low, high, False, np.asarray(mean)
            found.append(Target(*about, forms=form))

    def searched(by: Floats) -> Floats:
        values = np.array([float(t.value(n)) for t, n in zip(found, by, strict=True)])
        body = values[0], values[1:4], swapped(values[4:7]), turned_by(axes, values[7:])
        return np.asarray(block.searched(ten_numbers(*body)))

    steps = 1e-5 * np.eye(10)
    slopes = np.array([(searched(one) - searched(-one)) / 2e-5 for one in steps]).T
    return found, slopes


def drawn_of(
    targets: Sequence[Target], scaled: Floats
) -> tuple[tuple[Target, ...], Floats, Floats]:
    """Return numbers that can be drawn, scaled, and derivatives of the given ones by them, (p, p).

    They are the given ones, but for inertias.
    """
    found, numbers, into = [*targets], scaled.copy(), np.eye(len(scaled))
    for block, own in blocks_of(targets):
        found[own], into[own, own] = _drawn(block, scaled[own])
        numbers[own] = 0.0
    return tuple(found), numbers, into


def posterior_of(targets: Sequence[Target], scaled: Floats, spread: Floats) -> dict[str, Mechanism]:
    """Return the joint normal distribution of scaled numbers as mechanisms of their parameters.

    Args:
        targets: The numbers; delays are not among the mechanisms.
        scaled: Their scaled means, shape (p,).
        spread: Their covariance, shape (p, p).
    """
    found, before = dict[str, Mechanism](), list[int]()
    for name in dict.fromkeys(t.variable for t in targets if t.values is not None):
        own = [i for i, target in enumerate(targets) if target.variable == name]
        slope = np.linalg.solve(spread[np.ix_(before, before)], spread[np.ix_(before, own)]).T
        left = spread[np.ix_(own, own)] - slope @ spread[np.ix_(before, own)]
        root = np.linalg.cholesky(left + 1e-12 * np.diag(np.diag(left)))
        parents = [*found]
        pairs = tuple((parents.index(targets[i].variable), targets[i]) for i in before)
        mine = tuple(targets[i] for i in own)
        middles = scaled[own], scaled[before]
        drawn = Conditional(mine, pairs, *middles, np.asarray(slope), np.asarray(root))
        found[name] = Mechanism(drawn, parents, noise=Normal())
        before += own
    return found


def begin(twin: Simulation, world: World) -> None:
    """Begin an episode of a twin with the values that the world is given.

    Sensors and actuators have no noise there: a model predicts what is measured without its error.
    """
    twin.reset(seed=0, do=world.plan.at_start())
    noisy = [one.name("noise") for one in channels_of(twin) if one.noise is not None]
    if noisy:
        twin.do(dict.fromkeys(noisy, 0.0))


def channels_of(world: Simulation) -> Sequence[Channel]:
    """Return the sensors and actuators that have noise or a delay."""
    found: Sequence[Channel] = getattr(world.task, "channels", ())
    return found


@contextmanager
def twin_of(world: World) -> Iterator[Simulation]:
    """Provide a twin of a world at the beginning of an episode."""
    with twins_of(world).twin() as twin:
        begin(twin, world)
        yield twin


def values_of(targets: Sequence[Target], scaled: Floats) -> dict[str, Floats]:
    """Return the values of the variables of scaled numbers, shape (p,), by name."""
    found = dict[str, Floats]()
    for i, (target, number) in enumerate(zip(targets, scaled, strict=True)):
        if target.block is not None:
            found |= {} if target.component else target.block.values(scaled[i : i + 10])
        elif target.values is not None:
            values = found.setdefault(target.variable, target.values.copy()).reshape(-1)
            if target.whole:
                values *= target.value(number) / values[target.component]
            else:
                values[target.component] = target.value(number)
    return found


def numbers_of(targets: Sequence[Target], scaled: Floats) -> Floats:
    """Return the numbers that are reported of scaled numbers, shape (p,) each."""
    found = np.array([float(t.value(n)) for t, n in zip(targets, scaled, strict=True)])
    for block, own in blocks_of(targets):
        found[own] = block.numbers(scaled[own])
    return found


def blocks_of(targets: Sequence[Target]) -> list[tuple[InertiaBlock, slice]]:
    """Return the inertias among some targets, each with the places of its ten numbers."""
    firsts = ((t.block, i) for i, t in enumerate(targets) if not t.component)
    return [(block, slice(i, i + 10)) for block, i in firsts if block is not None]


def delays_of(world: Simulation, targets: Sequence[Target], scaled: Floats) -> Floats:
    """Return the fitted delays of commands in control steps, shape (n_actions,)."""
    delays = np.zeros(world.compiled.n_actions)
    for target, steps in zip(targets, scaled, strict=True):
        if target.values is None:
            delays[world.compiled.actions.get(target.name.removesuffix(LATE), slice(None))] += steps
    return delays


def remembered(world: Simulation) -> dict[int, slice]:
    """Return where in the state past commands are, the latest first, by number of the action."""
    compiled = world.compiled
    names = ((at.start, f"{name}_past") for name, at in compiled.actions.items())
    return {i: compiled.slices[name] for i, name in names if name in compiled.slices}


def free_states(world: Simulation) -> Integers:
    """Return the numbers of the state that a fit moves: all but those that follow from commands."""
    free = world.structure.layout.can_be_set.copy()
    for where in remembered(world).values():
        free[where] = False
    return np.flatnonzero(free)


def ranges_of(targets: Sequence[Target]) -> tuple[Floats, Floats]:
    """Return the lower and the upper ends of the ranges, scaled, shape (p,) each."""
    return np.array([t.low for t in targets]), np.array([t.high for t in targets])


def targets_of(
    world: Simulation, patterns: Iterable[str], *, symmetric: bool = False
) -> tuple[Target, ...]:
    """Return the fitted numbers that some patterns of parameters name.

    A parameter that cannot be negative is scaled by its logarithm, any other one by its default, or
    the largest component of its vector; ``Shooting.seen`` scales those that are zero. An inertia
    keeps the proportions of its components, unless these are named. ``"link.inertial"`` names mass,
    center of mass, and inertia with its axes as one block, of which other names then have no part.

    Args:
        world: A twin of the world, at the beginning of an episode.
        patterns: Patterns of names of parameters, or of their components.
        symmetric: Whether ranges [-a, a] stay symmetric: one number, the upper end.

    Raises:
        UnknownOption: No such range is fitted, although ``symmetric`` asks for it.
        UnknownVariable: A pattern fits no parameter.
        NotIntervenable: A pattern fits another variable, or a parameter that cannot be changed.
    """
    model, given = world.model, as_names(patterns)
    known = {name: name for name in settable_of(world)}
    parts = {label: n for n in known for label in labels(n, model.declared(n).shape)}
    names, mirrored = dict[str, None](), set[str]()
    if symmetric:
        pairs = ((n, np.array(world[n], float)) for n in known if model.declared(n).shape == (2,))
        mirrored = {name for name, (low, high) in pairs if -low == high > 0.0}
    refused = world.composition.system.refused
    late = [*(f"{name}{LATE}" for name in world.compiled.actions), DELAY]
    late = [name for name in late if name not in model and world.compiled.n_actions]
    held = [name for name in world.compiled.actions if f"{name}_past" in model]
    blocks = dict[str, list[str]]()
    for pattern in given:
        if not isinstance(pattern, str):
            raise UnknownVariable(pattern, known)
        if inertials := _inertials(pattern, known, refused):
            blocks |= inertials
            names |= dict.fromkeys(inertials)
            continue
        if pattern in refused:
            raise NotIntervenable(pattern, str(refused[pattern]))
        if pattern in model and pattern not in known:
            raise NotIntervenable(pattern, "is not a parameter of real numbers that can be set")
        if pattern == DELAY and DELAY in late and held:
            own = ", ".join(f"{name}{LATE}" for name in held)
            raise NotIntervenable(DELAY, f"adds to delays that commands have already; fit {own}")
        mine = [n for n in late if n == pattern or (n != DELAY and fits(n, (pattern,)))]
        if pattern.endswith(DELAY) and mine:  # "*" means what the world has
            names |= dict.fromkeys(mine)
            if not any(fits(name, (pattern,)) for name in known):
                continue
        found = fitting(pattern, known if pattern in known else {**known, **parts})
        for name in found:
            joint = name not in known or name in mirrored or _kind(world, name) == "inertia"
            parts_of_it = (name,) if joint else labels(name, model.declared(name).shape)
            names |= dict.fromkeys(parts_of_it)
    inner = {*chain(*blocks.values())}
    names = {n: None for n in names if known.get(n, parts.get(n)) not in inner}
    if symmetric and mirrored.isdisjoint(names):
        raise UnknownOption("symmetric", True, (f"a range [-a, a] among {', '.join(names)}",))
    targets = []
    for name in names:
        if name in late:
            unit, one = ("s", world.options.control_period) if name == DELAY else ("1", 1.0)
            targets.append(Target(name, name, 0, unit, 0.0, one, False, 0.0, LONGEST_DELAY))
            continue
        if name in blocks:
            targets += _ten(name, {p: world[n] for p, n in zip(PARTS, blocks[name], strict=True)})
            continue
        whole = name in mirrored or (name in known and _kind(world, name) == "inertia")
        variable = model.declared(known.get(name) or parts[name])
        targets.append(_single(world, name, variable, whole, name in mirrored))
    return tuple(targets)


def _single(
    world: Simulation, name: str, variable: Variable, whole: bool, symmetric: bool
) -> Target:
    """Return a number of a parameter."""
    values = np.array(world[variable.name], dtype=float)
    vector = values.ravel()
    place = int(vector.argmax()) if whole else labels(variable.name, variable.shape).index(name)
    default, low, high = float(vector[place]), -np.inf, np.inf
    if isinstance(variable.bounds, Box):
        ends = variable.bounds.bounds(variable.shape, world.evaluate(()))
        low, high = (float(np.ravel(end)[place]) for end in ends)
    low = 0.0 if symmetric else low
    scale = abs(default) or float(np.abs(vector).max()) or UNSEEN
    log = low >= 0.0 and default > 0.0
    if log:
        least, most = (math.log(max(end, 1e-300) / default) for end in (low, high))
        low, high = max(least, -FAR), min(most, FAR)
    else:
        low, high = (low - default) / scale, (high - default) / scale
    about = (name, variable.name, place, variable.unit, default, scale)
    return Target(*about, log, low, high, whole, values)


def _inertials(
    pattern: str, known: Collection[str], refused: Mapping[str, str]
) -> dict[str, list[str]]:
    """Return the inertias that a pattern names, with the variables of each.

    Raises:
        NotIntervenable: It names some, and each has a variable that cannot be set.
    """
    if pattern in known or not pattern.endswith(INERTIAL):
        return {}
    bodies = (n.removesuffix(".mass") for n in (*known, *refused) if n.endswith(".mass"))
    every = {f"{body}{INERTIAL}": [f"{body}.{part}" for part in PARTS] for body in bodies}
    named = {name: own for name, own in every.items() if fits(name, (pattern,))}
    found = {name: own for name, own in named.items() if {*own} <= {*known}}
    for name, own in named.items() if not found else ():
        why = (f"{n}, which {refused.get(n, 'cannot be set')}" for n in own if n not in known)
        raise NotIntervenable(name, f"is not known without {', and without '.join(why)}")
    return found


def _ten(name: str, values: Mapping[str, ArrayLike]) -> Iterator[Target]:
    """Return the ten numbers of the inertia of a body."""
    block = InertiaBlock.of(name, values)
    usual = block.numbers(np.zeros(10))
    for i, (label, unit) in enumerate(NUMBERS.items()):
        end = FAR if i in LOGS else math.inf
        about = f"{name}.{label}", name, i, unit, float(usual[i]), 1.0, False, -end, end
        yield Target(*about, False, usual, block)


def acting(world: Simulation, columns: Iterable[MeasuredNumber]) -> list[str]:
    """Return the parameters that act on a measured variable, and the delay of commands."""
    graph, measured = world.model, {column.variable for column in columns}
    found = [
        name
        for name in settable_of(world)
        if name != TIMESTEP and not measured.isdisjoint(graph.descendants(name))
    ]
    return [*found, *((DELAY,) if world.compiled.n_actions else ())]


def _kind(world: Simulation, name: str) -> str:
    """Return the kind of a parameter of a model; an empty text for those of a step function."""
    rows = getattr(world.composition.system, "rows", {})
    element, _, attribute = name.rpartition(".")
    return getattr(rows.get((element, attribute)), "kind", "")
