"""Checks of the promises of any world: run them on a model or a task of your own.

Each check takes a world and raises ``AssertionError`` where a promise is broken. ``check_model``
runs them all and returns the figures; ``benchmarks.models`` writes its tables with it, and
``scm_world.testing.task`` makes tests of them.
"""

from __future__ import annotations

import importlib
import pickle
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, suppress
from functools import partial
from typing import Any

import numpy as np

from scm_world._arguments import typed, whole_number
from scm_world._types import Floats, Value
from scm_world.errors import EngineFailure, InterventionError
from scm_world.policies.planning import action_range
from scm_world.queries import World
from scm_world.runs.processes import Worker
from scm_world.variables import Box, Categories, Draw, Integers, Noise, Rotations, Scale
from scm_world.variables.reserved import CONTROL_INDEX
from scm_world.world import Batch, Simulation, Snapshot

__all__ = ["check_model"]

SEED = 20_26


def quantities(world: Simulation) -> tuple[str, ...]:
    """Return the parameters and states that ``do`` can set, each in its own coordinates."""
    model = world.model
    names = (v.name for v in model.variables if v.settable and v.role != "action")
    return tuple(n for n in names if n != CONTROL_INDEX and model.target(n) == n)


def nearby(world: Simulation, name: str) -> Iterator[Value]:
    """List other possible values of a variable, near the present one; empty for one category."""
    variable, value = world.model.declared(name), world[name]
    match variable.bounds:
        case Box() | None:
            box = variable.bounds or Box(-np.inf, np.inf)
            low, high = box.bounds(variable.shape, world.values())
            low = np.where(np.isfinite(low), low, np.minimum(value, high) - np.abs(value) - 0.1)
            high = np.where(np.isfinite(high), high, np.maximum(value, low) + np.abs(value) + 0.1)
            inwards = 0.02 * (low + 0.37 * (high - low) - value)
            first = np.zeros(variable.shape)
            first.flat[0] = inwards.flat[0]
            shifts = inwards, 0.02 * (low - value), first, -first
            yield from (value + shift for shift in shifts if shift.any())
        case Integers(high=most):
            yield np.where(value < most, value + 1, value - 1)
        case Categories(members=members):
            yield from (np.asarray(member) for member in members if member != value)
        case Rotations():
            for angle in (0.1, 0.02):  # [rad]
                turned = value + 0.5 * angle * np.array([0.0, 0.0, 1.0, 0.0])
                yield np.asarray(variable.bounds.nearest(turned))


def moved(world: Simulation, name: str) -> bool:
    """Set a variable to the first nearby value that is feasible, if there is one."""
    for value in nearby(world, name):
        with suppress(InterventionError):
            world.do({name: value})
            return True
    return False


def actions(world: Simulation, n: int, seed: int = 0) -> Floats:
    """Draw actions, shape (n, n_actions)."""
    low, high = action_range(world)
    drawn = Noise(seed).uniforms("actions", n=n * low.size)[0].reshape(n, low.size)
    return np.asarray(low + (high - low) * drawn)


def trajectory(world: Simulation, taken: Floats) -> Floats:
    """Step a world, and return its states, shape (n + 1, k)."""
    found = [world.vector.copy()]
    for action in taken:
        world.step(action)
        found.append(world.vector.copy())
    return np.stack(found)


def future(world: Simulation, snapshot: Snapshot) -> list[bytes]:
    """List what follows a snapshot, and two episodes with all kinds of interventions."""
    world.restore(snapshot)
    seen = [trajectory(world, actions(world, 20, 7)).tobytes()]
    for episode in range(2):
        world.reset(seed=SEED + episode)
        names, model = quantities(world), world.model
        spaced = [name for name in names if model.declared(name).a is not None]
        real = [name for name in names if model.declared(name).dtype == "real"]
        for request in (
            world.task.sample_goal("A"),
            {name: Draw("A") for name in spaced[:: max(len(spaced) // 3, 1)]},
            {name: Scale(0.95) for name in real[:: max(len(real) // 3, 1)]},
        ):
            with suppress(InterventionError):  # refused here, refused everywhere
                world.do(request)
            seen.append(trajectory(world, actions(world, 4, seed=episode)).tobytes())
        values = world.values()
        seen += [name.encode() + np.asarray(values[name]).tobytes() for name in sorted(values)]
    return seen


def elsewhere(function: Callable[..., Any], *arguments: object, module: str = __name__) -> Any:
    """Call a function in another process that has imported a module; it is always the same one."""
    return _OTHER.ask(module, pickle.dumps((function, arguments)))


def called(module: str, what: bytes) -> Any:
    """Import a module; then unpickle a function and its arguments, and call it."""
    importlib.import_module(module)
    function, arguments = pickle.loads(what)  # noqa: S301 # our own
    return function(*arguments)


_OTHER = Worker(called)


def check_variables(world: Simulation) -> int:
    """Check that every variable has a unit, a sentence and a value within its bounds."""
    values = world.values()
    for variable in world.model.variables:
        assert variable.unit, f"{variable.name} has no unit"
        assert variable.doc, f"{variable.name} has no description"
        value, bounds = values[variable.name], variable.bounds
        assert np.isfinite(value).all(), f"{variable.name} = {value}"
        assert bounds is None or bounds.contains(value, values), f"{variable.name} = {value}"
    return len(world.model)


def _future(world: Simulation, steps: int) -> tuple[Any, Floats, Floats]:
    """Step a new episode; return a snapshot, the next actions and the states that follow."""
    world.reset(seed=0)
    taken = actions(world, steps + 3)
    trajectory(world, taken[:3])
    start = world.snapshot()
    expected = trajectory(world, taken[3:])
    world.restore(start)
    return start, taken[3:], expected


def check_undo(world: Simulation, horizons: tuple[int, ...] = (1, 50)) -> int:
    """Check that an intervention that is undone leaves exactly 0.0; count the quantities set."""
    world.require_exact("the undoing of an intervention without a trace")
    start, taken, expected = _future(world, max(horizons))
    found = 0
    for name in quantities(world):
        old = world[name]
        if moved(world, name):
            world.do({name: old})
            found += 1
            left = np.abs(trajectory(world, taken) - expected)[list(horizons)].max()
            assert left == 0.0, f"{name}: {left:g} is left after do and undo"
        world.restore(start)
    return found


def check_refusal(world: Simulation) -> int:
    """Check that a request of which one part is wrong leaves the world bit-identical."""
    _, taken, expected = _future(world, 4)
    names = quantities(world)
    requests: list[dict[str, Any]] = [{names[0]: Draw("A"), "no_such_variable": 1.0}]
    for other, name in zip((names[-1], *names), names, strict=False):
        shape, present = np.shape(world[name]), {other: world[other]} if other != name else {}
        bad = (np.full(shape, np.nan), np.full((*shape, 2), 1.0), "much")
        requests += [{**present, name: value} for value in bad]
    for request in requests:
        with suppress(InterventionError):
            world.do(request)
            raise AssertionError(f"do({request!r}) was not refused")
    assert np.array_equal(trajectory(world, taken), expected), "a refusal left a trace"
    return len(requests)


def check_counterfactual(world: World, steps: int = 20) -> None:
    """Check that a counterfactual without an intervention is the episode, bit for bit."""
    episode = world.rollout("random", seed=1, steps=steps)
    assert episode.counterfactual({}) == episode
    assert episode.counterfactual({}, at=steps // 2) == episode


def check_future(world: Simulation, module: str = __name__) -> None:
    """Check that a seed and a snapshot have one future each, here and in another process.

    The other process imports ``module`` first.
    """
    snapshot, *_ = _future(world, 2)
    here = future(world, snapshot)
    assert future(world, pickle.loads(pickle.dumps(snapshot))) == here  # noqa: S301 # our own
    there = elsewhere(future, world, snapshot, module=module)
    assert there == here, "another process has another future"


def check_batch(make: Callable[[], Simulation], n: int = 16, steps: int = 10) -> None:
    """Check that worlds stepped together equal single ones, each with a change of its own.

    One whose physics explodes is left out.
    """
    worlds, taken, ends = list[Simulation](), list[Floats](), list[Floats]()
    for index in range(n):
        world = make()
        world.reset(seed=index)
        names, mine = quantities(world), actions(world, steps, index)
        try:
            moved(world, names[index % len(names)])
            start, end = world.snapshot(), trajectory(world, mine)[-1]
        except EngineFailure:
            world.close()
            continue
        world.restore(start)
        worlds.append(world)
        taken.append(mine)
        ends.append(end)
    with closing(Batch(worlds, threads=2)) as batch:
        for together in np.stack(taken, axis=1):
            batch.advance(together)
        for index, end in enumerate(ends):
            assert np.array_equal(batch.world(index).vector, end), f"world {index} differs"


def check_endurance(world: Simulation, steps: int = 2000, every: int = 20) -> tuple[int, str]:
    """Step with random actions and interventions: no NaN; count the steps, return any error."""
    world.reset(seed=5)
    names, taken = quantities(world), actions(world, steps, 11)
    for step in range(steps):
        if step % every == 0:
            moved(world, names[(step // every) % len(names)])
        try:
            world.step(taken[step])
        except EngineFailure as error:
            return step, str(error)
        assert np.isfinite(world.vector).all()
    return steps, ""


@typed
def check_model(
    source: Any, *, backend: str = "mujoco", steps: int = 2000, **options: Any
) -> Mapping[str, Any]:
    """Run all checks on a model, and return the figures, by name.

    Args:
        source: Anything that ``World`` takes: a path, XML text, a task.
        backend: Name of the backend.
        steps: Control steps with random actions and interventions.
        options: Of ``World``.
    """
    steps = whole_number("steps", steps, least=1)
    make = partial(World, source, backend=backend, **options)
    started, world = time.perf_counter(), make()
    world.reset(seed=0)
    found: dict[str, Any] = {"variables": check_variables(world), "edges": len(world.graph.edges)}
    found |= {"set and undone": check_undo(world), "refused": check_refusal(world)}
    check_counterfactual(world)
    check_future(world)
    check_batch(make)
    found["steps"], found["ended by"] = check_endurance(world, steps)
    world.close()
    return {**found, "seconds": round(time.perf_counter() - started, 1)}
