"""Time the planning of CausalWorld 1.2, for ``planning.py``.

It runs in the interpreter of an environment that has the predecessor, and needs nothing else of
this project. Its optimizer is that of its tutorial on model-predictive control; the trajectories
are evaluated as its ``SimulatorModel`` does, a reset and then step after step, but in this
process, since the library that gave it processes cannot be installed any more. The last line that
it prints is JSON.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import time
from typing import Any

import numpy as np

np.float = float  # type: ignore[attr-defined] # noqa: NPY001 # its optimizer uses what numpy has no more

from causal_world.envs.causalworld import CausalWorld  # type: ignore[import-not-found] # noqa: E402
from causal_world.task_generators.task import (  # type: ignore[import-not-found] # noqa: E402
    generate_task,
)
from causal_world.utils.mpc_optimizers import (  # type: ignore[import-not-found] # noqa: E402
    CrossEntropyMethod,
)

PACKAGES = ("causal-world", "pybullet", "gym", "numpy")


class Here:
    """Evaluates trajectories one after another.

    Args:
        env: Where they happen.
    """

    def __init__(self, env: Any) -> None:
        self._env = env

    def evaluate_trajectories(self, sequences: Any) -> Any:
        """Sum up the rewards of each, shape (n,)."""
        rewards = np.zeros(len(sequences))
        for row, actions in enumerate(sequences):
            self._env.reset()
            for action in actions:
                rewards[row] += self._env.step(action)[1]
        return rewards


def main() -> None:
    """Measure, and print one line."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("samples", "horizon", "iterations", "elites", "plans"):
        parser.add_argument(f"--{name}", type=int, required=True)
    asked = parser.parse_args()
    task = generate_task(task_generator_id="pushing")
    env = CausalWorld(task=task, enable_visualization=False, skip_frame=10, normalize_actions=False)
    np.random.seed(0)  # noqa: NPY002 # it draws from the global generator
    optimizer = CrossEntropyMethod(
        planning_horizon=asked.horizon,
        max_iterations=asked.iterations,
        population_size=asked.samples,
        num_elite=asked.elites,
        action_upper_bound=env.action_space.high,
        action_lower_bound=env.action_space.low,
        model=Here(env),
    )
    times = []
    for _ in range(asked.plans):
        wall, busy = time.perf_counter(), time.process_time()
        optimizer.get_actions()
        times.append([time.perf_counter() - wall, time.process_time() - busy])
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    print(json.dumps({"times": times, "versions": versions}))


if __name__ == "__main__":
    main()
