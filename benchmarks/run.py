"""Measure what the package costs: one command, one run, medians and ratios.

``python benchmarks/run.py [--out FILE]`` prints a table and writes it as JSON. Times are medians of
several repeats on whatever machine this is; ratios are taken within one run, with the two sides
interleaved, so that a busy machine slows both.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import scm_world as sw
from scm_world.backends.renderer import now_pixels
from scm_world.env import ScmWorldEnv
from scm_world.geometry.overlap import WORKSPACE, overlap_kernel
from scm_world.queries.experiments.versions import versions
from scm_world.scene import Structure, default_scene
from scm_world.scene.camera import CAMERAS
from scm_world.scene.kinematics import forward, inverse_kernel
from scm_world.scene.trifinger import REST
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
        "samples per second, 20 nodes": 2e11 / median(lambda: model.sample(200_000, seed=0), 1),
        "the same under do": 2e11
        / median(lambda: model.do({"x5": 2.0}).sample(200_000, seed=0), 1),
        "SCM.do [µs]": median(lambda: model.do({"x5": 2.0})),
    }


def stepping(backend: str, task: str) -> dict[str, float]:
    """Compare a step of the environment with the raw physics of the same scene and actions.

    Times are those of the processor, so that other programs do not count.
    """
    env = ScmWorldEnv(task, backend=backend)
    env.reset(seed=0)
    world = env.world
    actions = np.random.default_rng(0).uniform(-1, 1, (250, 9)).astype(np.float32)
    commands = [np.array(env._command(action)) for action in actions]
    mode, substeps, engine = world._mode, world._substeps, world.backend

    def whole() -> float:
        env.reset(seed=0)
        started = time.process_time()
        for action in actions:
            env.step(action)
        return (time.process_time() - started) / len(actions) * 1e6

    def raw() -> float:
        env.reset(seed=0)
        started = time.process_time()
        for command in commands:
            engine.step(mode, command, substeps)
        return (time.process_time() - started) / len(commands) * 1e6

    whole(), raw()
    pairs = [(whole(), raw()) for _ in range(3 * REPEATS)]
    return {
        f"{task}: env.step [µs]": statistics.median(w for w, _ in pairs),
        f"{task}: raw physics [µs]": statistics.median(r for _, r in pairs),
        f"{task}: share of the raw rate": statistics.median(r / w for w, r in pairs),
    }


def seeing(backend: str) -> dict[str, float]:
    """Step with pictures: three cameras now and three of the goal, 128 x 128."""
    found = {}
    for task in ("pushing", "general"):
        env = ScmWorldEnv(task, backend=backend, observation_mode="pixel")
        env.reset(seed=0)
        action = np.zeros(9, dtype=np.float32)
        step = median(lambda: env.step(action), 50)  # noqa: B023 # called at once
        found[f"{task}: pixel steps per second"] = 1e6 / step
    return found


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
            found[f"{task}, {title}: times real time"] = world.control_period / step * 1e6
        world.close()
    return found


def drawing() -> dict[str, float]:
    """Draw three cameras, compute an overlap and an inverse kinematics."""
    scene = _scene(1)
    out = np.empty((3, 3, 128, 128), dtype=np.uint8)
    found = {"three-camera sets per second": 1e6 / median(lambda: now_pixels(scene, CAMERAS, out))}
    generator = np.random.default_rng(0)
    turn = generator.normal(size=4)
    size, place, work = np.full(3, 0.065), np.zeros(3), np.empty(WORKSPACE)
    box = (size, place + 0.01, turn / np.linalg.norm(turn))
    found["overlap of two boxes [µs]"] = median(
        lambda: overlap_kernel(size, place, np.array([0.0, 0.0, 0.0, 1.0]), *box, work), 2000
    )
    tips, joints = forward(np.array(REST), 0.34) + 0.01, np.array(REST)
    solved, reached = np.empty(9), np.empty(3, dtype=np.bool_)
    found["inverse kinematics [µs]"] = median(
        lambda: inverse_kernel(tips, 0.34, joints, solved, reached), 2000
    )
    found["error of the inverse kinematics [m]"] = float(np.abs(forward(solved, 0.34) - tips).max())
    return found


def _scene(n_blocks: int) -> Any:
    return default_scene(Structure(blocks=tuple(f"block_{i}" for i in range(n_blocks))))


def resetting(backend: str) -> dict[str, float]:
    """Reset after some steps, which is what costs."""
    world = sw.World("pushing", backend=backend)
    world.reset(seed=0)
    times = []
    for _ in range(60):
        for _ in range(5):
            world.step(world.action_low)
        times.append(micros(lambda: world.reset(seed=0), 1))
    return {"reset [µs]": statistics.median(times[5:])}


def intervening(backend: str) -> dict[str, float]:
    """Intervene on variables, each time after a step, as a user does."""
    world = sw.World("pushing", backend=backend)
    world.reset(seed=0)
    rest = np.array(world["joint_positions"])
    draws = np.random.default_rng(0)
    requests: dict[str, Callable[[], Any]] = {
        "tool_block.mass": lambda: draws.uniform(0.015, 0.1),
        "floor_friction": lambda: draws.uniform(0.3, 0.8),
        "gravity": lambda: [0.0, 0.0, draws.uniform(-10, -7)],
        "tool_block.color": lambda: draws.random(3),
        "robot_finger_60_link_2.mass": lambda: draws.uniform(0.1, 0.2),
        "goal_block.polar": lambda: [draws.uniform(0.0, 0.1), 0.5],
        "block.size": lambda: [draws.uniform(0.055, 0.065)] * 3,
        "tool_block.cylindrical_position": lambda: [draws.uniform(0.0, 0.05), -1.5, 0.04],
    }
    found = {}
    for name, value in requests.items():
        world.reset(seed=0)
        times = []
        for _ in range(60):
            world.step(rest)
            request = {name: value()}
            times.append(micros(lambda request=request: world.do(request), 1))  # type: ignore[misc]
        found[f"do {name} [µs]"] = statistics.median(times[5:])
    world.reset(seed=0)
    for _ in range(20):
        world.step(rest)
    saved = world.snapshot()
    found["snapshot [µs]"] = median(world.snapshot, 50)
    found["restore after 20 steps [µs]"] = median(lambda: world.restore(saved), 20)
    return found


def discovering(backend: str) -> dict[str, float]:
    """Discover the pushing graph with the defaults."""
    report = sw.discover("pushing", backend=backend)
    return {
        "discover pushing [s]": report.seconds,
        "SHD": float(report.score.shd),
        "rollouts": float(report.rollouts),
        "floor": report.floor,
    }


def importing() -> dict[str, float]:
    """Start Python and import, beside starting it alone; the best of several."""

    def seconds(program: str) -> float:
        times = []
        for _ in range(5):
            started = time.perf_counter()
            subprocess.run([sys.executable, "-c", program], check=True)  # noqa: S603 # our own text
            times.append(time.perf_counter() - started)
        return min(times)

    nothing = seconds("pass")
    return {
        "import scm_world [s]": seconds("import scm_world") - nothing,
        "import scm_world.graph [s]": seconds("import scm_world.graph") - nothing,
    }


def main() -> None:
    """Measure everything."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("results.json"))
    out: Path = parser.parse_args().out
    results: dict[str, dict[str, float]] = {
        "graph": graph(),
        "import": importing(),
        "drawing and geometry": drawing(),
    }
    for backend in ("mujoco", "bullet"):
        try:
            results[backend] = {
                **stepping(backend, "pushing"),
                **stepping(backend, "general"),
                **seeing(backend),
                **building(backend),
                **resetting(backend),
                **intervening(backend),
                **discovering(backend),
            }
        except sw.ScmWorldError as error:
            print(f"{backend} is left out: {error}")
    for title, figures in results.items():
        print(f"\n{title}")
        for name, value in figures.items():
            print(f"  {name:<45} {value:>14,.3f}")
    about = {"machine": platform.machine(), "system": platform.system(), **versions()}
    out.write_text(json.dumps({"about": about, "results": results}, indent=1) + "\n")
    print(f"\nwritten to {out}")


if __name__ == "__main__":
    main()
