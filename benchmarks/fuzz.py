"""Throw random interventions at every task on every engine, and watch what it costs.

    python benchmarks/fuzz.py --count 100000 --resets 10000

Every refused intervention must leave the world bit-identical, every accepted one finite; after a
reset the world must be like a new one. Memory is read before and after the resets.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from pathlib import Path
from typing import Any

import numpy as np

from scm_world.errors import InterventionError
from scm_world.tasks import TASKS
from scm_world.variables import (
    Box,
    Categories,
    Draw,
    Integers,
    Normal,
    Rotations,
    Scale,
    Shift,
    Variable,
)
from scm_world.world import Simulation

BAD: tuple[Any, ...] = (
    None,
    "x",
    float("nan"),
    float("inf"),
    [],
    [1.0, 2.0],
    {"x": 1.0},
    1e300,
    -1e300,
    True,
)
"""Values that no variable can have."""


def spread(variable: Variable, generator: np.random.Generator) -> Any:
    """Draw a value somewhere in, at, or just outside the bounds of a variable."""
    match variable.bounds:
        case Box() as box if not box.parents():
            low, high = box.bounds(variable.shape, {})
            return low + (high - low) * generator.uniform(-0.02, 1.02, variable.shape)
        case Integers(low=low, high=high):
            highest = min(high, low + 200)
            return generator.integers(low - 1, highest + 2, variable.shape).tolist()
        case Categories(members=members):
            return int(generator.choice([*members, -1]))
        case Rotations():
            value = generator.normal(size=variable.shape)
            return value / np.linalg.norm(value)
        case _:
            return 0.1 * generator.normal(size=variable.shape)


def random_request(
    world: Simulation, generator: np.random.Generator, *, most: int = 3
) -> dict[str, Any]:
    """Draw a request to a world.

    Args:
        world: In an episode.
        generator: Of the choices.
        most: How many targets it has at most.
    """
    request: dict[str, Any] = {}
    match generator.integers(12):
        case 0:
            request = world.task.sample_goal(("A", "B", "A|B")[generator.integers(3)])
        case 1:
            nearby = list(world.task.nearby(world.values()))
            request = dict(nearby[generator.integers(len(nearby))]) if nearby else {}
    names = list(world.model)
    chosen = generator.choice(names, size=int(generator.integers(1, most + 1)), replace=True)
    if request and generator.random() < 0.7:  # mostly what changes the goal or the structure alone
        return request
    return request | {str(name): _value(world, str(name), generator) for name in chosen}


def _value(world: Simulation, name: str, generator: np.random.Generator) -> Any:
    variable = world.model.declared(name)
    match generator.integers(8):
        case 0:
            return BAD[generator.integers(len(BAD))]
        case 1:
            return Shift(float(generator.normal(scale=0.01)))
        case 2:
            return Scale(float(generator.uniform(-0.1, 2.0)))
        case 3:
            return Draw(("A", "B", "A|B")[generator.integers(3)])
        case 4:
            return Draw(Normal(0.0, 0.05))
        case 5 | 6 if variable.dtype == "real":
            return world[name] + 0.01 * generator.normal(size=variable.shape)
        case _:
            return spread(variable, generator)


def memory() -> float:
    """Read the resident memory of this process [MiB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def same(first: dict[str, Any], second: dict[str, Any]) -> bool:
    """Compare all values bit for bit."""
    return first.keys() == second.keys() and all(
        np.asarray(first[n]).tobytes() == np.asarray(second[n]).tobytes() for n in first
    )


def expect(kept: bool, about: Any) -> None:
    """Stop where a promise is broken."""
    if not kept:
        raise RuntimeError(f"broken promise: {about}")


def fuzz(world: Simulation, count: int, seed: int) -> dict[str, Any]:
    """Do random things to one world.

    Raises:
        RuntimeError: A promise was broken.
    """
    generator = np.random.default_rng(seed)
    world.reset(seed=0)
    fresh = world.values()
    done = refused = structural = 0
    for index in range(count):
        if index % 50 == 0:
            world.reset(seed=index)
        before = world.values() if index % 20 == 0 else None
        declaration = world.compiled
        request = random_request(world, generator)
        try:
            world.do(request)
            done += 1
            structural += world.compiled is not declaration
        except InterventionError:
            refused += 1
            expect(before is None or same(world.values(), before), request)
        if index % 5 == 0:
            world.step(generator.uniform(world.action_low, world.action_high))
        if index % 20 == 0:
            values = world.values()
            wrong = [n for n, v in values.items() if not np.isfinite(v).all()]
            expect(not wrong, (wrong, request))
    world.reset(seed=0)
    expect(same(world.values(), fresh), "a reset did not bring the start back")
    return {"done": done, "refused": refused, "structural": structural}


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=100_000, help="interventions in all")
    parser.add_argument("--resets", type=int, default=10_000, help="resets of one world")
    parser.add_argument("--tasks", nargs="*", default=list(TASKS))
    parser.add_argument("--backends", nargs="*", default=["mujoco", "bullet"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    share = -(-options.count // (len(options.tasks) * len(options.backends)))
    found = []
    for backend in options.backends:
        for task in options.tasks:
            started = time.perf_counter()
            world = Simulation(task, backend=backend)
            row = {"task": task, "backend": backend, **fuzz(world, share, options.seed)}
            world.close()
            row["seconds"] = round(time.perf_counter() - started, 1)
            row["memory"] = round(memory(), 1)
            found.append(row)
            print(row, flush=True)
        world = Simulation("pushing", backend=backend)
        for index in range(200):
            world.reset(seed=index)
        before = memory()
        for index in range(options.resets):
            world.reset(seed=index, do={"tool_block.mass": 0.03})
        print(f"{backend}: {options.resets} resets, {memory() - before:+.1f} MiB", flush=True)
        world.close()
    if options.out is not None:
        options.out.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
