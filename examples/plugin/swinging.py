"""What the package adds: a model, a task with it, and a learner; ``pyproject.toml`` names them."""

from __future__ import annotations

import numpy as np

from scm_world import Box, ModelTask
from scm_world.discovery.data import Dataset

__version__ = "0.1.0"  # results name it

ROD = """<mujoco model="rod"><worldbody><body name="rod"><joint name="hinge" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass=".1"/></body></worldbody>
  <actuator><motor name="push" joint="hinge" ctrlrange="-1 1"/></actuator></mujoco>"""


def stillness(velocity: float) -> float:
    """Return the reward: 0 at rest, less if the rod swings [rad/s]."""
    return -abs(velocity)


class Hang(ModelTask):
    """Bring a rod to rest. It is heavier in B."""

    name, model, seconds, control_dt = "hang", ROD, 2.0, 0.04
    spaces = {"rod.mass": {"a": Box(0.05, 0.2), "b": Box(0.2, 0.4)}}  # noqa: RUF012
    start = {"hinge.position": Box(-0.5, 0.5)}  # noqa: RUF012
    reward = (stillness, "hinge.velocity")


def shifted(data: Dataset, *, seed: int = 0, least: float = 5.0) -> np.ndarray:
    """Find the variables whose mean moves when another one is set, direct or not."""
    seen = data.observational.values
    error = seen.std(axis=0) / np.sqrt(len(seen))
    found = np.zeros((len(data.names), len(data.names)))
    for i, name in enumerate(data.names):
        rows = data.values[[data.regimes[k].targets == (name,) for k in data.regime]]
        if len(rows):
            found[i] = np.abs(rows.mean(axis=0) - seen.mean(axis=0)) > least * error
    np.fill_diagonal(found, 0.0)
    return found
