"""Interventions of several layers, compared with functions that are composed by hand."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
import pytest

from scm_world import SCM, Derived, Exogenous, Linear, Mechanism, Parent, World
from scm_world.curricula import follow, make_vec
from scm_world.queries import Outcome, Plan
from scm_world.variables import Box, Draw, Hard, Integers, Natural, Noise, Scale, Shift, Time

STEPS = 6
SOURCE, FACTOR = Box(0.5, 1.5), Box(0.8, 1.2)
BEFORE = 2**32  # the step whose noise is that of the instant before the first step
Layer = Mapping[str, tuple[Any, ...]]
Layers = list[tuple[str, Layer]]
GIVEN, NATURE, START, CURRICULUM = (
    f" in {kind}" for kind in ("given", "nature", "start", "curriculum")
)


def doubled(value: Any) -> Any:
    """Return a function of a parent."""
    return 0.2 + 0.5 * value


def followed(value: Callable[[str], Any], parent: str) -> Any:
    """Return what a variable is that follows another one."""
    return doubled(value(parent))


def added(below: Callable[[], Any], by: Any) -> Any:
    """Return a shifted value."""
    return below() + by


def multiplied(below: Callable[[], Any], by: Any) -> Any:
    """Return a scaled value."""
    return below() * by


def composed(
    name: str,
    instant: int,
    natural: Callable[[], Any],
    layers: Layers,
    value: Callable[[str], Any],
    drawn: Callable[[str, Any, int], Any],
) -> Any:
    """Return the value of a variable at an instant: each layer is a function of those below.

    Args:
        name: The variable.
        instant: The control step.
        natural: What the variable is without any layer.
        layers: Kinds of layers, each with acts by variable, the lowest layer first. What shifts
            and scales draw has noise of its own in each kind.
        value: The present value of another variable.
        drawn: The number that a draw gives, by stream and the step at which the act began.
    """
    made = partial(natural)
    for kind, layer in layers:
        began = []
        for act in layer.get(name, ()):
            time = act.time or Time(at=0)
            first, stop = time.during or (time.at or 0, None)
            if time.every and instant > first:
                first += (instant - first) // time.every * time.every
            if first <= instant and (stop is None or instant < stop):
                began.append((first, act))
        if not began:
            continue
        first, act = max(reversed(began), key=lambda one: one[0])
        below = made
        if isinstance(act, Hard):
            made = partial(float, act.value)
        elif isinstance(act, Draw):
            made = partial(drawn, name, SOURCE, first)
        elif isinstance(act, Mechanism):
            made = partial(followed, value, act.parents[0].name)
        elif isinstance(act, Shift | Scale):
            by = drawn(f"by{kind}/{name}", FACTOR, first) if isinstance(act.by, Draw) else act.by
            made = partial(added if isinstance(act, Shift) else multiplied, below, by)
    return made()


def some_time(rng: np.random.Generator) -> dict[str, Any]:
    """Return a time at random; none is the beginning."""
    start = int(rng.integers(STEPS))
    times: list[dict[str, Any]] = [
        {},
        {"at": start},
        {"during": (start, start + 1 + int(rng.integers(STEPS)))},
        {"during": (start, None)},
        {"at": start, "every": 1 + int(rng.integers(3))},
    ]
    return times[rng.integers(len(times))]


def some_layer(rng: np.random.Generator, names: tuple[str, ...], *, timed: bool = True) -> Layer:
    """Return acts on some variables at random; a variable may follow the one before it."""
    layer: dict[str, tuple[Any, ...]] = {}
    for place, name in enumerate(names):
        acts = []
        for _ in range(rng.integers(3 if timed else 2)):
            time = some_time(rng) if timed else {}
            kinds: list[Any] = [
                Hard(float(rng.uniform(0.5, 1.5)), **time),
                Shift(float(rng.uniform(0.0, 0.2)), **time),
                Scale(float(rng.uniform(0.9, 1.1)), **time),
                Scale(Draw(FACTOR), **time),
                Draw(SOURCE, **time),
                Natural(**time),
            ]
            if place:
                kinds.append(Mechanism(doubled, names[place - 1], **time))
            acts.append(kinds[rng.integers(len(kinds))])
        if acts:
            layer[name] = tuple(acts)
    return layer


def one_instant(layer: Layer) -> dict[str, Any]:
    """Return the acts of a layer where each variable has one, without a time."""
    return {name: act for name, (act,) in layer.items()}


# --- a model of one instant -----------------------------------------------------------------------

ROOTS = ("a", "b", "c")


def roots() -> SCM:
    """Return three constants and their sum."""
    total = Derived(name="y", parents=ROOTS, mechanism=Linear(weights=(1.0, 2.0, 3.0)))
    return SCM([*(Exogenous(name=n, default=1.0 + i) for i, n in enumerate(ROOTS)), total])


def check_model(seed: int) -> None:
    """Compare a model in a context under interventions, in both orders of the calls."""
    rng, model = np.random.default_rng(seed), roots()
    context, again, own = (one_instant(some_layer(rng, ROOTS, timed=False)) for _ in range(3))
    layers: Layers = [
        (kind, {n: (a,) for n, a in one.items()})
        for kind, one in ((GIVEN, {**context, **again}), ("", own))
    ]
    found: dict[str, Any] = {}

    def drawn(stream: str, source: Any, first: int) -> Any:
        name = stream if stream.startswith("by") else f"do/{stream}"
        return Noise(seed).draw(source, name, (), {}, episode=0, step=0)[0]

    for place, name in enumerate(ROOTS):
        natural = partial(float, 1.0 + place)
        found[name] = composed(name, 0, natural, layers, found.__getitem__, drawn)
    stacked = model.given(context).given(again).do(own)
    assert stacked == model.do(own).given({**context, **again})
    got = {name: value[0] for name, value in stacked.draw(1, seed=seed).items()}
    assert {name: float(got[name]) for name in ROOTS} == found
    for name in ROOTS:  # what the model reports is what it computes
        kinds = [layer[name][0] for _, layer in layers if name in layer]
        roots_of = [a for a in kinds if isinstance(a, Hard | Draw | Mechanism)]
        follows = bool(roots_of) and isinstance(roots_of[-1], Mechanism)
        assert bool(stacked.parents(name)) == follows


def test_a_model_of_one_instant_composes() -> None:
    """300 random contexts and interventions give the composed functions, bit for bit."""
    for seed in range(300):
        check_model(seed)


# --- equations in a world -------------------------------------------------------------------------


def lagged() -> SCM:
    """Return constants, and a quantity that decays to their sum."""
    decay = Derived(
        name="z",
        parents=(Parent("z", 1), "a", "b"),
        mechanism=Linear(weights=(0.5, 1.0, 1.0)),
        start=0.25,
    )
    return SCM([*(Exogenous(name=n, default=1.0 + i) for i, n in enumerate("ab")), decay])


def check_equations(seed: int) -> None:
    """Compare an episode of equations: given, nature, and what is asked, each with times."""
    rng, names = np.random.default_rng(seed), ("a", "b", "z")
    given, nature, own = (some_layer(rng, names) for _ in range(3))
    layers = [(GIVEN, given), (NATURE, nature), ("", own)]
    path: list[dict[str, Any]] = []
    for instant in range(STEPS + 1):
        now: dict[str, Any] = {}

        def drawn(stream: str, source: Any, _: int, instant: int = instant) -> Any:
            name = stream if stream.startswith("by") else f"do/{stream}"
            step = instant - 1 if instant else BEFORE
            # Constants are drawn once in an episode; what changes, in each step.
            step = 0 if stream[-1] in "ab" else step
            return Noise(seed).draw(source, name, (), {}, episode=0, step=step)[0]

        starts: list[bool] = []

        def decays(instant: int = instant, now: Any = now, starts: Any = starts) -> Any:
            if not instant:
                starts.append(True)
                return 0.25
            weights, values = (0.5, 1.0, 1.0), (path[instant - 1]["z"], now["a"], now["b"])
            return Linear(weights=weights).bind()(*values)

        for place, name in enumerate(names):
            natural = decays if name == "z" else partial(float, 1.0 + place)
            now[name] = composed(name, instant, natural, layers, now.__getitem__, drawn)
        if starts:
            now["z"] = 0.25  # a start is not shifted
        path.append(now)
    world = World(lagged()).given(given)
    outcomes = [Outcome(name, "path") for name in names]
    found = world.sample(1, own, outcomes=outcomes, nature=nature, steps=STEPS, seed=seed)
    for outcome, name in zip(found, names, strict=True):
        # At the end of an episode nothing is done any more.
        there = found[outcome][0][:STEPS].tolist()
        assert there == [now[name] for now in path[:STEPS]], (seed, name)


def test_equations_in_a_world_compose() -> None:
    """150 random stacks with times give the composed functions in each instant, bit for bit."""
    for seed in range(150):
        check_equations(seed)


# --- physics --------------------------------------------------------------------------------------

ARM = """
<mujoco model="arm"><worldbody>
  <body name="upper"><joint name="hinge" axis="0 1 0" damping="1"/>
    <geom type="capsule" fromto="0 0 0 0 0 .3" size=".02" mass="1"/>
    <body name="lower" pos="0 0 .3"><joint name="elbow" axis="0 1 0" damping="1"/>
      <geom type="capsule" fromto="0 0 0 0 0 .3" size=".02" mass="1"/></body></body>
</worldbody></mujoco>
"""
PARAMETERS = ("upper.mass", "hinge.damping", "lower.mass")


def expected(layers: Layers, seed: int, episode: int = 0) -> dict[str, list[float]]:
    """Return the path of each parameter of the arm."""
    found: dict[str, list[float]] = {name: [] for name in PARAMETERS}

    def drawn(stream: str, source: Any, first: int) -> Any:
        return Noise(seed).draw(source, stream, (), {}, episode=episode, step=first)[0]

    for instant in range(STEPS):
        now: dict[str, Any] = {}
        for name in PARAMETERS:
            now[name] = composed(name, instant, lambda: 1.0, layers, now.__getitem__, drawn)
            found[name].append(float(now[name]))
    return found


def check_world(world: World, seed: int) -> None:
    """Compare the parameters of a world, as its engine has them, at each instant."""
    rng = np.random.default_rng(seed)
    given, nature, own = (some_layer(rng, PARAMETERS) for _ in range(3))
    wanted = expected([(GIVEN, given), (NATURE, nature), ("", own)], seed)
    outcomes = [Outcome(name, "path") for name in PARAMETERS]
    how: dict[str, Any] = {"nature": nature, "steps": STEPS, "seed": seed, "policy": None}
    with world.given(given) as other:
        found = other.sample(1, own, outcomes=outcomes, **how)
        for outcome, name in zip(found, PARAMETERS, strict=True):
            assert found[outcome][0][:STEPS].tolist() == wanted[name], (seed, name)
        other.reset(seed=seed, do=Plan(own).over(nature, "nature"))
        for instant in range(STEPS):
            other.act()
            keys = other.compiled.parameter_keys
            engine = other.backend.parameters({keys[name] for name in PARAMETERS})
            for name in PARAMETERS:
                assert float(engine[keys[name]]) == pytest.approx(wanted[name][instant], rel=1e-12)
            other.step([])


@pytest.fixture(scope="module", params=["mujoco", "bullet"])
def arm(request: pytest.FixtureRequest) -> Iterator[World]:
    """One world of the arm for each engine."""
    with World.from_mjcf(ARM, backend=request.param) as made:
        yield made


def test_worlds_compose(arm: World) -> None:
    """Random stacks of given, nature and what is asked, on both engines, bit for bit."""
    for seed in range(30 if arm.backend.name == "mujoco" else 10):
        check_world(arm, seed)


def check_vector(envs: Any, layers: Layers, seed: int, n: int) -> None:
    """Compare the parameters in each environment of a vector with its own noise."""
    *_, (_, own) = layers
    envs.reset(seed=seed, options={"do": own})
    for instant in range(STEPS - 1):
        for index, world in enumerate(envs.get_attr("world")):
            wanted = expected(layers, seed + index)
            for name in PARAMETERS:
                assert float(world[name]) == wanted[name][instant], (seed, index, name)
        envs.step(np.zeros((n, 0)))


def test_vectors_compose() -> None:
    """``start`` and the request of a reset, in native vectors, each environment with its draws."""
    for seed in range(12):
        rng = np.random.default_rng(1000 + seed)
        start = {n: acts[:1] for n, acts in some_layer(rng, PARAMETERS).items()}
        curriculum, own = (some_layer(rng, PARAMETERS) for _ in range(2))
        options: dict[str, Any] = {"model": ARM, "reward": (np.sum, "hinge.velocity")}
        begin = {n: act for n, (act,) in start.items()}
        part = follow(lambda _, plan=curriculum: plan)
        envs = make_vec("scm_world/Model-v0", 2, part, start=begin, **options)
        check_vector(envs, [(START, start), (CURRICULUM, curriculum), ("", own)], seed, 2)
        envs.close()


@pytest.mark.slow
def test_many_random_stacks_compose() -> None:
    """2,000 stacks of models and of equations, 300 of MuJoCo, 50 of Bullet."""
    for seed in range(10_000, 12_000):
        check_model(seed)
        check_equations(seed)
    for backend, count in (("mujoco", 300), ("bullet", 50)):
        with World.from_mjcf(ARM, backend=backend) as world:
            for seed in range(10_000, 10_000 + count):
                check_world(world, seed)


@pytest.mark.parametrize("nothing", [Shift(0.0), Scale(1.0)])
def test_a_shift_by_nothing_changes_no_bit_of_other_coordinates(nothing: Any) -> None:
    """Polar or Euler coordinates are rounded when they are inverted; what stays is not inverted."""
    names = ("tool_block.cylindrical_position", "goal_block.euler_orientation")
    for name in (*names, "camera_60.euler_orientation"):
        drawn = World("pushing", backend="fake").given({name: Draw("A")})
        for seed in range(6):
            drawn.reset(seed=seed)
            before = drawn.values()
            drawn.reset(seed=seed, do={name: nothing})
            after = drawn.values()
            drawn.do({name: nothing})
            for value in (after, drawn.values()):
                assert [n for n in before if not np.array_equal(before[n], value[n])] == []


def test_rows_that_a_drawn_shift_leaves_are_exact() -> None:
    """Of rows that are shifted by 0 or 1 in the logarithm, the first are the same to the bit."""
    log = Derived(name="log", parents=("x",), mechanism=np.log, inverse=np.exp)
    model = SCM([Exogenous(name="x", distribution=Box(1.0, 2.0), default=1.5), log])
    before = model.draw(200, seed=0)
    assert (np.exp(before["log"]) != before["x"]).any()
    after = model.do({"log": Shift(Draw(Integers(0, 1)))}).draw(200, seed=0)
    stays = np.isclose(after["x"], before["x"])
    assert 50 < stays.sum() < 150
    assert np.array_equal(after["x"][stays], before["x"][stays])
    np.testing.assert_allclose(after["x"][~stays], np.e * before["x"][~stays], rtol=1e-14)
