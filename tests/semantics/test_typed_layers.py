"""Stacks over a model with types, vectors, lags and noise in each step, evaluated by hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pytest

from scm_world import SCM, Derived, Exogenous, Mechanism, Parent, World
from scm_world.errors import CyclicModel, InterventionError, ScmWorldError
from scm_world.queries import Outcome, Plan
from scm_world.variables import (
    Box,
    Categories,
    Discrete,
    Draw,
    Hard,
    Integers,
    Natural,
    Noise,
    Normal,
    Reaches,
    Scale,
    Shift,
    Time,
)

STEPS = 5
BEFORE = 2**32  # the step whose noise is that of the instant before the first step
Layer = Mapping[str, Sequence[Any]]


class Given(NamedTuple):
    """A variable of the model: what it is by itself."""

    shape: tuple[int, ...] = ()
    dtype: str = "real"
    per: str = "step"
    parents: tuple[tuple[str, int], ...] = ()
    function: Any = None
    noise: Any = None  # of a root its distribution
    start: Any = 0.0
    lagged: bool = False  # whether it is cause or effect of an edge with a lag


def counted(i: Any, c: Any) -> Any:
    """Return a whole number."""
    return i * 2 + c


def moved(v: Any, w: Any, k: Any, noise: Any) -> Any:
    """Return a vector that follows itself."""
    return v * 0.5 + w + k[..., None] + noise


def mixed(v: Any, z: Any, i: Any, noise: Any) -> Any:
    """Return a number that follows itself two steps ago."""
    return v[..., 0] * 0.25 + z * 0.5 + i + noise


def read(z: Any, m: Any, v: Any) -> Any:
    """Return a readout of this instant and the one before."""
    return z + m * 0.1 + v[..., 1]


VARIABLES = {
    "k": Given(per="episode", noise=Normal(), start=0.75),
    "c": Given(dtype="categorical", per="episode", noise=Discrete((0, 1, 2)), start=1),
    "w": Given((2,), noise=Normal(), start=(0.1, 0.2)),
    "i": Given(dtype="integer", noise=Integers(0, 5), start=2, lagged=True),
    "m": Given((), "integer", "step", (("i", 0), ("c", 0)), counted, start=0),
    "v": Given(
        (2,),
        parents=(("v", 1), ("w", 0), ("k", 0)),
        function=moved,
        noise=Normal(0.5, 0.3),
        start=(0.3, 0.4),
        lagged=True,
    ),
    "z": Given(
        parents=(("v", 0), ("z", 2), ("i", 1)),
        function=mixed,
        noise=Normal(0.5, 0.3),
        start=0.25,
        lagged=True,
    ),
    "y": Given(parents=(("z", 0), ("m", 0), ("v", 1)), function=read, lagged=True),
}


def declared() -> SCM:
    """Return the model."""
    found: list[Any] = []
    for name, (shape, dtype, per, parents, function, noise, start, _) in VARIABLES.items():
        common: dict[str, Any] = {"name": name, "shape": shape, "dtype": dtype}
        if dtype == "categorical":
            common["bounds"] = Categories((0, 1, 2))
        if function is None:
            found.append(Exogenous(default=start, distribution=noise, per=per, **common))
            continue
        causes = tuple(Parent(*parent) for parent in parents)
        found.append(
            Derived(parents=causes, mechanism=function, noise=noise, start=start, **common)
        )
    return SCM(found)


# --- random layers --------------------------------------------------------------------------------


def halved(k: Any) -> Any:
    """Return a function of a root."""
    return k * 0.5 + 0.125


def delayed(z: Any) -> Any:
    """Return a function of the instant before."""
    return z * 0.5 - 1.0


def noisy(k: Any, noise: Any) -> Any:
    """Return a function with noise."""
    return k + noise * 2.0


def next_one(c: Any) -> Any:
    """Return a whole number of a category."""
    return c + 1


def pair(k: Any) -> Any:
    """Return a vector of a number."""
    return np.stack([k, k * 2.0], axis=-1)


def slower(v: Any, noise: Any) -> Any:
    """Return a vector that follows itself, with the noise that it has."""
    return v * 0.25 + noise


MECHANISMS: dict[str, list[tuple[Any, tuple[str, int], Any]]] = {
    "w": [(pair, ("k", 0), None)],
    "i": [(next_one, ("c", 0), None)],
    "m": [(next_one, ("c", 0), None)],
    "v": [(pair, ("k", 0), None), (slower, ("v", 1), None)],
    "z": [(halved, ("k", 0), None), (delayed, ("z", 1), None), (noisy, ("k", 0), Normal(0.0, 2.0))],
    "y": [(halved, ("k", 0), None), (delayed, ("z", 1), None)],
}
FUNCTIONS: dict[str, Callable[..., Any]] = {
    one.__name__: one for several in MECHANISMS.values() for one, *_ in several
}


def some_time(rng: np.random.Generator, first: int, *, events: bool) -> dict[str, Any]:
    """Return a time at random, with or without events."""
    start = int(rng.integers(first, STEPS))
    times: list[dict[str, Any]] = [
        {},
        {},
        {"at": start},
        {"during": (start, start + 1 + int(rng.integers(3)))},
        {"during": (start, None)},
        {"at": start, "every": 1 + int(rng.integers(3))},
    ]
    if events:
        times += [
            {"when": Reaches("z", above=float(rng.uniform(-0.5, 1.5)))},
            {"when": Reaches("v", below=0.6, component=1), "during": (start, start + 2)},
            {"when": Reaches("k", above=0.0), "during": (start, None)},
        ]
    return times[rng.integers(len(times))]


def some_act(rng: np.random.Generator, name: str, time: dict[str, Any]) -> Any:
    """Return an intervention at random that fits the type of a variable."""
    shape, dtype = VARIABLES[name][:2]
    if dtype == "categorical":
        acts: list[Any] = [Hard(int(rng.integers(3)), **time), Draw(Discrete((0, 2)), **time)]
    elif dtype == "integer":
        acts = [
            Hard(int(rng.integers(6)), **time),
            Draw(Integers(3, 9), **time),
            Shift(int(rng.integers(1, 4)), **time),
            Scale(2, **time),
            Shift(Draw(Integers(1, 3)), **time),
            Scale(Draw(Box(0.8, 1.7)), **time),
        ]
    else:
        value = rng.uniform(-1.0, 1.0, shape).tolist() if shape else float(rng.uniform(-1.0, 1.0))
        acts = [
            Hard(value, **time),
            Draw(Normal(1.0, 0.2), **time),
            Shift(value, **time),
            Scale(1.25, **time),
            Shift(Draw(Normal(0.0, 0.1)), **time),
            Scale(Draw(Box(0.8, 1.2)), **time),
        ]
    for function, parent, noise in MECHANISMS.get(name, ()):
        own = {} if noise is None else {"noise": noise}
        acts.append(Mechanism(function, [Parent(*parent)], **own, **time))
    acts.append(Natural(**time))
    return acts[rng.integers(len(acts))]


def some_layer(
    rng: np.random.Generator,
    most: int = 2,
    *,
    timed: bool = True,
    first: int = 0,
    events: bool = True,
) -> dict[str, tuple[Any, ...]]:
    """Return up to so many interventions on some variables."""
    found: dict[str, tuple[Any, ...]] = {}
    for name in VARIABLES:
        if rng.random() < 0.5:
            times = [some_time(rng, first, events=events) if timed else {} for _ in range(most)]
            acts = [some_act(rng, name, time) for time in times]
            found[name] = tuple(acts[: 1 + rng.integers(most)])
    return found


# --- by hand --------------------------------------------------------------------------------------


class ByHand:
    """One episode of layers, computed instant by instant.

    Args:
        layers: Kind and interventions of each layer, from the lowest up.
        done: What was done to the model: it holds where nothing in the last layer is in force.
        seed: Of the noise.
        episode: Within that noise.
    """

    def __init__(
        self, layers: Sequence[tuple[str, Layer]], done: Mapping[str, Any], seed: int, episode: int
    ) -> None:
        self.layers, self.done, self.noise, self.episode = layers, done, Noise(seed), episode
        self.fired: dict[tuple[int, str, str], int] = {}
        self.rows: list[dict[str, Any]] = []
        held: dict[str, list[Any]] = {}
        for step in range(STEPS):
            if step:  # events are those of the instant as the interventions before leave it
                self._await(step, self._instant(step, held))
            held = {name: self._held(name, step) for name in VARIABLES}
            self.rows.append(self._instant(step, held))

    def _await(self, step: int, now: Mapping[str, Any]) -> None:
        for number, (_, layer) in enumerate(self.layers):
            for name, acts in layer.items():
                for time in (act.time for act in acts if act.time and act.time.when):
                    start, stop = time.during or (0, None)
                    key = number, name, repr(time)
                    if key in self.fired or not start < step < (stop or STEPS):
                        continue
                    value = np.ravel(now[time.when.name])[time.when.component]
                    above, below = time.when.above, time.when.below
                    if value > above if above is not None else value < below:
                        self.fired[key] = step

    def _begun(self, number: int, name: str, time: Time | None, step: int) -> int | None:
        if time is None:
            return 0
        if time.when is not None:
            return self.fired.get((number, name, repr(time)))
        if time.during is not None:
            start, stop = time.during
            return start if start <= step and (stop is None or step < stop) else None
        start = time.at or 0
        again = (step - start) // time.every * time.every if time.every else 0
        return start + again if start <= step else None

    def _held(self, name: str, step: int) -> list[Any]:
        """Return what is in force in each layer: the last to begin."""
        found = list[Any]()
        for number, (_, layer) in enumerate(self.layers):
            begun = [
                (start, place, act)
                for place, act in enumerate(layer.get(name, ()))
                if (start := self._begun(number, name, act.time, step)) is not None
            ]
            found.append(max(begun, key=lambda one: one[:2])[2] if begun else None)
        found[-1] = found[-1] or self.done.get(name)
        return found

    def _instant(self, step: int, held: Mapping[str, list[Any]]) -> dict[str, Any]:
        now: dict[str, Any] = {}
        for name in VARIABLES:
            self._value(name, step, held, now)
        return now

    def _draw(self, name: str, source: Any, variable: str, step: int) -> Any:
        own = VARIABLES[variable]
        number = 0 if own.per == "episode" else step - 1 if step else BEFORE
        return self.noise.draw(source, name, own.shape, {}, episode=self.episode, step=number)

    def _value(self, name: str, step: int, held: Mapping[str, list[Any]], now: Any) -> Any:
        if name in now:
            return now[name]
        own, acts = VARIABLES[name], held.get(name, [])
        stack = [(k, a) for (k, _), a in zip(self.layers, acts, strict=False) if a is not None]
        stack = [one for one in stack if not isinstance(one[1], Natural)]
        replaced = [at for at, (_, a) in enumerate(stack) if not isinstance(a, Shift | Scale)]
        root, soft = (
            (stack[replaced[-1]][1], stack[replaced[-1] + 1 :]) if replaced else (None, stack)
        )
        quiet = not step and own.per == "step"
        if root is None and quiet and own.function and own.lagged:
            found, soft = own.start, []  # a start is not shifted
        elif root is None and own.function is None:
            found = own.start if quiet else self._draw(name, own.noise, name, step)
        elif root is None:
            found = self._called(own.function, own.parents, own.noise, name, step, held, now, quiet)
        elif isinstance(root, Hard):
            found = root.value
        elif isinstance(root, Draw):
            found = self._draw(f"do/{name}", root.source, name, step)
        else:
            function = FUNCTIONS[root.function.reference.rpartition(":")[2]]
            causes = tuple((parent.name, parent.lag) for parent in root.parents)
            noise = root.noise or own.noise
            found = self._called(function, causes, noise, name, step, held, now, False)
        found = self._typed(name, found)
        for kind, act in soft:
            drawn = isinstance(act.by, Draw)
            by = self._draw(f"by{kind}/{name}", act.by.source, name, step) if drawn else act.by
            by = np.asarray(by)
            found = self._typed(name, found + by if isinstance(act, Shift) else found * by)
        now[name] = np.broadcast_to(found, (1, *own.shape))
        return now[name]

    def _typed(self, name: str, value: Any) -> Any:
        found = np.asarray(value)
        return found if VARIABLES[name].dtype == "real" else np.rint(found).astype(np.int64)

    def _called(
        self,
        function: Any,
        causes: Sequence[tuple[str, int]],
        noise: Any,
        name: str,
        step: int,
        held: Mapping[str, list[Any]],
        now: Any,
        quiet: bool,
    ) -> Any:
        values = []
        for cause, lag in causes:
            if lag == 0:
                values.append(self._value(cause, step, held, now))
            elif step >= lag:
                values.append(self.rows[step - lag][cause])
            else:
                start = np.asarray(VARIABLES[cause].start)
                values.append(np.broadcast_to(start, (1, *VARIABLES[cause].shape)))
        if "noise" not in function.__code__.co_varnames:
            return function(*values)
        zeros = np.zeros((1, *VARIABLES[name].shape))
        return function(*values, noise=zeros if quiet else self._draw(name, noise, name, step))

    def check(self, found: Mapping[str, Any], said: Any) -> None:
        """Compare the paths of all variables, bit for bit."""
        for name in VARIABLES:
            for step, row in enumerate(self.rows):
                mine, other = (np.asarray(x, float) for x in (row[name][0], found[name][step]))
                assert mine.tobytes() == other.tobytes(), (said, name, step, mine, other)


def replaced(old: Layer, new: Layer, at: int) -> Layer:
    """Return the interventions of an episode and of a counterfactual from a step on."""
    found: dict[str, Sequence[Any]] = dict(old)
    for name, acts in new.items():
        kept = list[Any]()
        for act in old.get(name, ()):
            time = act.time or Time(during=(0, None))
            start, stop = time.during or (time.at or 0, None)
            if time.when is not None and start < at:
                window = start, at if stop is None else min(stop, at)
                kept.append(act.model_copy(update={"time": Time(when=time.when, during=window)}))
            elif time.every is not None:
                times = [Time(at=step) for step in range(start, at, time.every)]
                kept += [act.model_copy(update={"time": one}) for one in times]
            elif time.when is None and start < at:
                kept.append(act)
        begun = {"time": Time(at=at)}
        now = [act if act.time else act.model_copy(update=begun) for act in acts]
        found[name] = [*kept, *now]
    return found


def check(seed: int) -> bool:
    """Compare samples, a rollout and a counterfactual; return whether the stack was accepted."""
    rng, model = np.random.default_rng(seed), declared()
    in_world = rng.random() < 0.5
    given = some_layer(rng, 2 if in_world else 1, timed=in_world)
    model_acts = {} if in_world else some_layer(rng, 1, timed=False)
    done = {name: act for name, (act,) in model_acts.items()}
    nature, own = some_layer(rng), some_layer(rng, 3)
    first, at = int(rng.integers(4)), int(rng.integers(STEPS))
    other = some_layer(rng, first=at, events=False)
    outcomes = [Outcome(name, "path") for name in VARIABLES]
    how: dict[str, Any] = {"steps": STEPS, "seed": seed}
    try:
        system: Any = World(model).given(given) if in_world else model
        if not in_world:
            context = {name: act for name, (act,) in given.items()}
            system = model.given(context).do(done) if seed % 2 else model.do(done).given(context)
        found = system.sample(2, own, outcomes=outcomes, nature=nature, first=first, **how)
        plan = Plan(own).over(nature, "nature")
        episode = system.rollout(None, do=plan, episode=first, **how)
        branch = episode.counterfactual(other, at=at)
    except (InterventionError, CyclicModel):
        return False  # a mechanism closes a cycle
    except ScmWorldError:
        assert not getattr(system, "model", system).is_temporal  # nothing has a lag any more
        return False
    layers: Any = [(" in given", given), (" in nature", nature)]
    for row in range(2):
        paths = {o.name: values[row] for o, values in zip(outcomes, found.values(), strict=True)}
        ByHand([*layers, ("", own)], done, seed, first + row).check(paths, seed)
    ByHand([*layers, ("", own)], done, seed, first).check(episode, (seed, "rollout"))
    above = replaced(own, other, at)
    ByHand([*layers, ("", above)], done, seed, first).check(branch, (seed, "counterfactual", at))
    assert episode.counterfactual({}) == episode
    return True


def test_typed_stacks_compose() -> None:
    """Samples, rollouts and counterfactuals with events are those by hand, bit for bit."""
    assert sum(map(check, range(12))) > 6


@pytest.mark.slow
def test_many_typed_stacks_compose() -> None:
    """Of 400 stacks with integers, categories, vectors, lags and noise in each step."""
    assert sum(map(check, range(1000, 1400))) > 200
