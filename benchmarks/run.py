"""Measure sampling, drawing, geometry, walls and discovery; ``benchmarks.speed`` has the rest.

``python -m benchmarks.run [--out FILE]`` prints a table and writes it as JSON. Times are medians of
several repeats on whatever machine this is.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import scm_world as sw
from benchmarks import as_json
from scm_world.backends.renderer import camera_pixels
from scm_world.geometry.filling import overlap_fraction
from scm_world.queries.experiments.versions import versions
from scm_world.tasks.trifinger.cameras import CAMERAS
from scm_world.tasks.trifinger.hardware import REST
from scm_world.tasks.trifinger.kinematics import forward, inverse_kernel
from scm_world.tasks.trifinger.system import trifinger
from scm_world.variables import Normal

REPEATS = 9


def micros(function: Callable[[], Any], number: int) -> float:
    """Time one call, as the mean over a few [µs]."""
    started = time.perf_counter()
    for _ in range(number):
        function()
    return (time.perf_counter() - started) / number * 1e6


def median(function: Callable[[], Any], number: int = 200) -> float:
    """Time one call, as the median of several repeats [µs]."""
    micros(function, 5)
    return statistics.median(micros(function, number) for _ in range(REPEATS))


def graph() -> dict[str, float]:
    """Sample a linear model with 20 nodes."""
    generator = np.random.default_rng(0)
    variables = []
    for i in range(20):
        parents = tuple(f"x{j}" for j in range(i) if generator.random() < 0.2)
        weights = tuple(generator.uniform(0.5, 2.0, len(parents)))
        mechanism = sw.Linear(weights=weights)
        variables.append(
            sw.Derived(name=f"x{i}", parents=parents, mechanism=mechanism, noise=Normal())
        )
    model = sw.SCM(variables)
    return {
        "samples per second, 20 nodes": 2e11 / median(lambda: model.draw(200_000, seed=0), 1),
        "the same under do": 2e11 / median(lambda: model.do({"x5": 2.0}).draw(200_000, seed=0), 1),
        "SCM.do [µs]": median(lambda: model.do({"x5": 2.0})),
    }


def building(backend: str) -> dict[str, float]:
    """Step the walls: how much faster than real time, as they begin and once they are built."""
    found = {}
    for task in ("stacked_blocks", "creative_stacked_blocks"):
        world = sw.World(task, backend=backend)
        for title in ("begin", "built"):
            world.reset(seed=0)
            if title == "built":
                world.do(world.task.solution(world.values()))
            rest = np.array(world["joint_positions"])
            step = micros(lambda: world.step(rest), 25)  # noqa: B023 # called at once
            found[f"{task}, {title}: times real time"] = world.options.control_period / step * 1e6
        world.close()
    return found


def drawing() -> dict[str, float]:
    """Draw three cameras, compute an overlap and an inverse kinematics."""
    scene = _scene(1)
    out = np.empty((3, 3, 128, 128), dtype=np.uint8)
    found = {
        "three-camera sets per second": 1e6 / median(lambda: camera_pixels(scene, CAMERAS, out))
    }
    turn = np.random.default_rng(0).normal(size=(1, 4))
    size, place, upright = (
        np.full((1, 3), 0.065),
        np.zeros((1, 3)),
        np.array([[0.0, 0.0, 0.0, 1.0]]),
    )
    found["overlap of two boxes [µs]"] = median(
        lambda: overlap_fraction(size, place, upright, size, place + 0.01, turn), 2000
    )
    tips, joints = forward(np.array(REST), 0.34) + 0.01, np.array(REST)
    found["inverse kinematics [µs]"] = median(lambda: inverse_kernel(tips, 0.34, joints), 2000)
    solved, _ = inverse_kernel(tips, 0.34, joints)
    found["error of the inverse kinematics [m]"] = float(np.abs(forward(solved, 0.34) - tips).max())
    return found


def _scene(n_blocks: int) -> Any:
    return trifinger(blocks=tuple(f"block_{i}" for i in range(n_blocks))).default_scene()


def discovering(backend: str) -> dict[str, float]:
    """Discover the pushing graph with the defaults."""
    report = sw.discover("pushing", backend=backend)
    return {
        "discover pushing [s]": report.seconds,
        "SHD": float(report.score.shd),
        "rollouts": float(report.rollouts),
        "floor": report.floor,
    }


def main() -> None:
    """Measure everything."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("results.json"))
    out: Path = parser.parse_args().out
    results: dict[str, dict[str, float]] = {
        "graph": graph(),
        "drawing and geometry": drawing(),
    }
    for backend in ("mujoco", "bullet"):
        try:
            results[backend] = {
                **building(backend),
                **discovering(backend),
            }
        except sw.ScmWorldError as error:
            print(f"{backend} is left out: {error}")
    for title, figures in results.items():
        print(f"\n{title}")
        for name, value in figures.items():
            print(f"  {name:<45} {value:>14,.3f}")
    about = {"machine": platform.machine(), "system": platform.system(), **versions()}
    out.write_text(as_json({"about": about, "results": results}) + "\n")
    print(f"\nwritten to {out}")


if __name__ == "__main__":
    main()
