"""What holds for a world of any model: run it on a model of your own.

Each check takes a world and raises ``AssertionError`` where the promise is broken. ``check_model``
runs them all and gives the figures; ``benchmarks.models`` writes its tables with it.

Example::

    from scm_world.testing.model import check_model

    print(check_model("my_robot.xml"))
"""

from __future__ import annotations

import contextlib
import hashlib
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scm_world._types import Floats, Value
from scm_world.errors import EngineFailure, InterventionError
from scm_world.queries import World
from scm_world.variables import Box, Categories, Integers, Noise, Rotations, Variable
from scm_world.world import Batch

SHARE = 0.1
"""How far a value is moved, as a fraction of its range or of itself."""


def another(variable: Variable, present: Value, uniforms: Floats) -> Value | None:
    """Choose another value near the present one, within constant bounds; None if there is none.

    Args:
        variable: Its declaration.
        present: Its value.
        uniforms: In [0, 1), one for each component.
    """
    shift = SHARE * (2.0 * uniforms.reshape(variable.shape) - 1.0)
    match variable.bounds:
        case Box():
            low, high = variable.bounds.bounds(variable.shape, {})
            span = np.where(np.isfinite(high - low), high - low, np.abs(present) + 0.1)
            return np.clip(present + shift * span, low, high)
        case Rotations():
            return np.asarray(variable.bounds.nearest(present + 4.0 * shift))
        case Integers():
            return np.asarray(present + np.where(present >= variable.bounds.high, -1, 1))
        case Categories(members=members):
            others = [member for member in members if member != present]
            return np.asarray(others[0]) if others else None
        case None:
            return np.asarray(present + shift * (np.abs(present) + 0.1))
    return None


def settable(world: World) -> tuple[str, ...]:
    """Name the parameters and states that ``do`` can set by themselves."""
    model = world.model
    return tuple(
        v.name
        for v in model.variables
        if v.settable and v.role != "action" and model.target(v.name) == v.name
    )


def actions(world: World, n: int, seed: int = 0) -> Floats:
    """Draw actions, shape (n, n_actions)."""
    low, high = world.action_low, world.action_high
    drawn = Noise(seed).uniforms("actions", n=n * low.size)[0].reshape(n, low.size)
    found: Floats = low + (high - low) * drawn
    return found


def trajectory(world: World, taken: Floats) -> Floats:
    """Step a world, and give its states, shape (n + 1, k)."""
    found = [world.current()[1].vector.copy()]
    for action in taken:
        world.step(action)
        found.append(world.current()[1].vector.copy())
    return np.stack(found)


def check_variables(world: World) -> int:
    """Check that every variable has a unit, a sentence and a default within its bounds."""
    world.reset(seed=0)
    values = world.values()
    for variable in world.model.variables:
        assert variable.unit, f"{variable.name} has no unit"
        assert variable.doc, f"{variable.name} has no description"
        value, bounds = values[variable.name], variable.bounds
        assert np.isfinite(value).all(), f"{variable.name} = {value}"
        assert bounds is None or bounds.contains(value, values), f"{variable.name} = {value}"
    return len(world.model)


def requests(world: World, seed: int = 0) -> Iterator[tuple[str, Value]]:
    """Give an intervention on each settable variable, from its present value."""
    noise = Noise(seed)
    for name in settable(world):
        variable = world.model.declared(name)
        present = world[name]
        n = int(np.prod(variable.shape))
        value = another(variable, present, noise.uniforms(name, n=n)[0])
        if value is not None:
            yield name, value


def check_undo(world: World, horizons: tuple[int, ...] = (1, 50)) -> tuple[int, float]:
    """Check that what is done and undone leaves exactly 0.0, for every settable variable.

    Returns:
        How many variables were set, and the largest difference at any horizon.
    """
    world.reset(seed=0)
    taken = actions(world, max(horizons) + 3)
    trajectory(world, taken[:3])
    start = world.snapshot()
    expected = trajectory(world, taken[3:])
    world.restore(start)
    found, worst = 0, 0.0
    for name, value in list(requests(world)):
        old = world[name]
        try:
            world.do({name: value})
        except InterventionError:
            world.restore(start)
            continue
        world.do({name: old})
        found += 1
        here = trajectory(world, taken[3:])
        worst = max(worst, *(float(np.abs(here[h] - expected[h]).max()) for h in horizons))
        assert worst == 0.0, f"{name}: {worst:g} is left after do and undo"
        world.restore(start)
    return found, worst


def check_refusal(world: World) -> int:
    """Check that a refused intervention leaves the world bit-identical."""
    world.reset(seed=0)
    taken = actions(world, 6)
    trajectory(world, taken[:2])
    start = world.snapshot()
    expected = trajectory(world, taken[2:])
    world.restore(start)
    refused = 0
    for name in settable(world):
        good = world[name]
        for bad in (np.full(good.shape, np.nan), np.full((*good.shape, 2), 1.0), "much"):
            try:
                world.do({name: bad})
            except InterventionError:
                refused += 1
            else:
                raise AssertionError(f"do({name}={bad!r}) was not refused")
    assert np.array_equal(trajectory(world, taken[2:]), expected), "a refusal left a trace"
    return refused


def check_counterfactual(world: World, steps: int = 20) -> None:
    """Check that a counterfactual of nothing is the episode, bit for bit."""
    episode = world.rollout("random", seed=1, steps=steps)
    assert episode.counterfactual({}) == episode
    assert episode.counterfactual({}, at=steps // 2) == episode


_ELSEWHERE = """
import hashlib, pickle, sys
from scm_world.testing.model import actions, trajectory
world, snapshot = pickle.load(open(sys.argv[1], "rb"))
world.restore(snapshot)
print(hashlib.sha256(trajectory(world, actions(world, 20, 7)).tobytes()).hexdigest())
"""


def check_snapshot_elsewhere(world: World) -> None:
    """Check that a snapshot continues bit-identically in another process."""
    world.reset(seed=2)
    trajectory(world, actions(world, 5, 3))
    snapshot = world.snapshot()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "world.pickle"
        path.write_bytes(pickle.dumps((world, snapshot)))
        command = [sys.executable, "-c", _ELSEWHERE, str(path)]
        said = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    assert said.returncode == 0, said.stderr
    here = trajectory(world, actions(world, 20, 7))
    assert said.stdout.split()[-1] == hashlib.sha256(here.tobytes()).hexdigest()


def check_batch(make: Any, n: int = 16, steps: int = 10, threads: int = 2) -> None:
    """Check that worlds stepped together equal single ones, each with a parameter of its own.

    Args:
        make: Makes a world.
        n: How many.
        steps: How many control steps.
        threads: Of the engine.
    """

    def begun(index: int, *, changed: bool) -> World:
        world: World = make()
        world.reset(seed=index)
        found = list(requests(world, seed=index))
        name, value = found[index % len(found)]
        if changed:
            with contextlib.suppress(InterventionError):
                world.do({name: value})
        return world

    first = begun(0, changed=False)
    taken = np.stack([actions(first, steps, seed) for seed in range(n)], axis=1)
    first.close()
    singles, stable = [], []
    for index in range(n):
        world = begun(index, changed=True)
        try:
            singles.append(trajectory(world, taken[:, index])[-1])
            stable.append(True)
        except EngineFailure:  # the physics of this change explodes: then without it
            world.close()
            world = begun(index, changed=False)
            singles.append(trajectory(world, taken[:, index])[-1])
            stable.append(False)
        world.close()
    batch = Batch([begun(i, changed=stable[i]) for i in range(n)], threads=threads)
    for step in range(steps):
        batch.advance(taken[step])
    for index in range(n):
        together = batch.world(index).current()[1].vector
        assert np.array_equal(together, singles[index]), f"world {index} of the batch differs"
    batch.close()


def check_endurance(world: World, steps: int = 2000, every: int = 20) -> tuple[int, str]:
    """Step with random actions and interventions: no NaN, or a typed error that says which.

    Returns:
        How many control steps were taken, and what ended it, if anything did.
    """
    world.reset(seed=5)
    names, taken = settable(world), actions(world, steps, 11)
    noise = Noise(13)
    for step in range(steps):
        if step % every == 0:
            name = names[(step // every) % len(names)]
            variable = world.model.declared(name)
            n = int(np.prod(variable.shape))
            value = another(variable, world[name], noise.uniforms(name, n=n, step=step)[0])
            with contextlib.suppress(InterventionError):
                world.do({name: value} if value is not None else {})
        try:
            world.step(taken[step])
        except EngineFailure as error:
            return step, str(error)
        assert np.isfinite(world.current()[1].vector).all()
    return steps, ""


def check_model(
    source: Any, *, backend: str = "mujoco", steps: int = 2000, **options: Any
) -> Mapping[str, Any]:
    """Run all checks on a model.

    Args:
        source: What ``World`` takes: a path, XML text, a task.
        backend: Name of the engine.
        steps: With random actions and interventions.
        options: Of ``World.from_mjcf``.

    Returns:
        The figures, by name.

    Raises:
        AssertionError: A promise is broken.
    """

    def make() -> World:
        return World.from_mjcf(source, backend=backend, **options)

    started = time.perf_counter()
    world = make()
    found: dict[str, Any] = {"variables": check_variables(world), "edges": len(world.graph.edges)}
    found["set and undone"], found["left over"] = check_undo(world)
    found["refused"] = check_refusal(world)
    check_counterfactual(world)
    check_snapshot_elsewhere(world)
    check_batch(make)
    found["steps"], found["ended by"] = check_endurance(world, steps)
    world.close()
    found["seconds"] = round(time.perf_counter() - started, 1)
    return found
