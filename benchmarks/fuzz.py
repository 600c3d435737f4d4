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
from scm_world.testing.requests import random_request
from scm_world.world import World


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


def fuzz(world: World, count: int, seed: int) -> dict[str, Any]:
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
            world = World(task, backend=backend)
            row = {"task": task, "backend": backend, **fuzz(world, share, options.seed)}
            world.close()
            row["seconds"] = round(time.perf_counter() - started, 1)
            row["memory"] = round(memory(), 1)
            found.append(row)
            print(row, flush=True)
        world = World("pushing", backend=backend)
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
