"""Time the evaluation pipeline of CausalWorld 1.2, for ``evaluation.py``.

It runs in the interpreter of an environment that has the predecessor, and needs nothing else of
this project than the policy beside it. Task pushing, its twelve protocols, default parameters of
the world: control steps of 10 × 4 ms, joint positions, normalized. The last line that it prints
is JSON.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import time
from typing import Any

from causal_world.benchmark.benchmarks import (  # type: ignore[import-not-found]
    PUSHING_BENCHMARK,
)
from causal_world.evaluation.evaluation import (  # type: ignore[import-not-found]
    EvaluationPipeline,
)
from evaluation_policy import Mlp

PACKAGES = ("causal-world", "pybullet", "gym", "numpy")


def measure(fraction: float, network: int) -> dict[str, Any]:
    """Evaluate the policy with a fraction of the 200 episodes of each protocol.

    Args:
        fraction: Of the 200 episodes.
        network: Seed of its weights.

    Returns:
        Episodes, seconds and seconds of the processor of all episodes together, without the
        start-up, which is told apart; and the mean scores.
    """
    started = time.perf_counter()
    pipeline = EvaluationPipeline(
        evaluation_protocols=PUSHING_BENCHMARK["evaluation_protocols"],
        task_params={"task_generator_id": PUSHING_BENCHMARK["task_generator_id"]},
        world_params={},
    )
    made, busy = time.perf_counter(), time.process_time()
    scores = pipeline.evaluate_policy(Mlp(network), fraction=fraction)
    return {
        "seconds": time.perf_counter() - made,
        "processor": time.process_time() - busy,
        "start-up": made - started,
        "episodes": sum(p.get_num_episodes() for p in PUSHING_BENCHMARK["evaluation_protocols"]),
        "versions": {name: importlib.metadata.version(name) for name in PACKAGES},
        "scores": {
            name: float(found["mean_full_integrated_fractional_success"])
            for name, found in scores.items()
        },
    }


def main() -> None:
    """Measure, and print one line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fraction", type=float, required=True, help="of the 200 episodes")
    parser.add_argument("--network", type=int, required=True, help="seed of the weights")
    asked = parser.parse_args()
    print(json.dumps(measure(asked.fraction, asked.network)))


if __name__ == "__main__":
    main()
