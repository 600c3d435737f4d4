"""Record a policy, replay its episodes, and clone it.

Run it with ``python examples/recording.py [mujoco|bullet]``.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import scm_world  # noqa: F401 # registers the environments
from scm_world.evaluation.recording import Recorder, Recording, record


def main(backend: str = "mujoco") -> None:
    """Teach a linear policy to sweep blocks of any mass to the middle."""
    env = gymnasium.make("scm_world/Pushing-v0", backend=backend, max_episode_length=50)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "sweeps.parquet"
        record("sweep", env, 5, do={"tool_block.mass": "A"}, out=path)
        recording = Recording.load(path)
        print(recording, "in", path.stat().st_size, "bytes")
    print(recording.replay(), "control steps happened again, bit for bit")

    seen, done = recording.pairs()
    weights = np.linalg.lstsq(np.c_[seen, np.ones(len(seen))], done, rcond=1e-3)[0]

    def clone(observation: Any) -> Any:
        return np.append(observation, 1.0) @ weights

    found = record(clone, env, 1)[0]
    print(f"the clone differs by {np.abs(found.actions - done[:50]).max():.3f} at most")

    recorder: Any = Recorder(env)
    recorder.reset(seed=0)
    for step, action in enumerate(found.actions):
        if step == 25:
            recorder.unwrapped.do({"tool_block.mass": 0.1})
        recorder.step(action)
    print("with a heavier block from step 25:", recorder.recording().replay(), "steps again")
    env.close()


if __name__ == "__main__":
    main(*sys.argv[1:2])
