"""CausalWorld 1.2, asked over a pipe: one line of JSON in, one line out; for ``predecessor.py``.

It runs in the interpreter of an environment that has the predecessor, and needs nothing of this
project. Times are in microseconds: those of steps are of the processor, others of the wall.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any, final

# The engine writes to the standard output as it is imported: answers have a channel of their own.
ANSWERS = os.fdopen(os.dup(1), "w")
os.dup2(os.open(os.devnull, os.O_WRONLY), 1)

import numpy as np  # noqa: E402 # after the channel
from causal_world.envs.causalworld import CausalWorld  # type: ignore[import-not-found] # noqa: E402
from causal_world.task_generators.task import (  # type: ignore[import-not-found] # noqa: E402
    generate_task,
)

PACKAGES = ("causal-world", "pybullet", "gym", "numpy")
MICRO = 1e6


@final
class Server:
    """One world, and what can be asked of it."""

    def __init__(self) -> None:
        self._env: Any = None
        self._rest = np.zeros(9, dtype=np.float32)

    def versions(self) -> dict[str, str]:
        """Give the versions of what matters."""
        return {name: importlib.metadata.version(name) for name in PACKAGES}

    def make(
        self,
        task: str,
        options: dict[str, Any],
        seed: int,
        observation_mode: str = "structured",
    ) -> None:
        """Make a world."""
        arguments = {name: np.array(value) for name, value in options.items()}
        made = generate_task(task_generator_id=task, **arguments)
        self._env = CausalWorld(
            task=made, seed=seed, observation_mode=observation_mode, enable_visualization=False
        )
        self._env.reset()

    def step(self, actions: list[list[float]]) -> float:
        """Give the time of a control step, from a reset on."""
        given = np.array(actions, dtype=np.float32)
        self._env.reset()
        started = time.process_time()
        for action in given:
            self._env.step(action)
        return (time.process_time() - started) / len(given) * MICRO

    def reset(self, times: int, between: int) -> float:
        """Give the time of a reset after some control steps."""
        return self._each(lambda _: self._env.reset(), range(times), between)

    def do(self, block: str, masses: list[float]) -> float:
        """Give the time of an intervention on a mass, each after a control step."""
        return self._each(
            lambda mass: self._env.do_intervention({block: {"mass": mass}}, check_bounds=False),
            masses,
            between=1,
        )

    def _each(self, act: Callable[[Any], Any], given: Any, between: int) -> float:
        total = 0.0
        for one in given:
            for _ in range(between):
                self._env.step(self._rest)
            started = time.perf_counter()
            act(one)
            total += time.perf_counter() - started
        return total / len(given) * MICRO

    def close(self) -> None:
        """End the world."""
        self._env.close()


def main() -> None:
    """Answer until the pipe is closed."""
    server = Server()
    asked: dict[str, Callable[..., Any]] = {
        name: getattr(server, name) for name in ("versions", "make", "step", "reset", "do", "close")
    }
    for line in sys.stdin:
        request = json.loads(line)
        answer = asked[request.pop("what")](**request)
        print(json.dumps(answer), file=ANSWERS, flush=True)


if __name__ == "__main__":
    main()
