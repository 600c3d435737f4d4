"""Fit a long recording of a two-link arm, and print how many seconds of a processor it took.

::

    python benchmarks/fit_speed.py

5,000 rows of 2 ms, six parameters, noise of 1 mrad on both angles; intervals are included.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

import scm_world as sw

ARM = """
<mujoco model="arm">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 -1 0" damping="0.05" frictionloss="0.02"/>
      <geom name="a" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.6"/>
      <body name="lower" pos="0 0 -0.3">
        <joint name="elbow" axis="0 -1 0" damping="0.02" frictionloss="0.02"/>
        <geom name="b" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.4"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="first" joint="shoulder" ctrllimited="true" ctrlrange="-6 6"/>
    <motor name="second" joint="elbow" ctrllimited="true" ctrlrange="-4 4"/>
  </actuator>
</mujoco>
"""
TRUE = {
    "upper.mass": 0.75,
    "lower.mass": 0.3,
    "shoulder.damping": 0.08,
    "elbow.damping": 0.03,
    "shoulder.frictionloss": 0.05,
    "elbow.frictionloss": 0.01,
}


def main() -> None:
    """Record, fit and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rows", type=int, default=5000)
    rows = parser.parse_args().rows
    rng, times = np.random.default_rng(0), 0.002 * np.arange(rows)
    sent = np.zeros((rows - 1, 2))
    for _ in range(6):
        rates, phases = rng.uniform(0.2, 2.5, 2), rng.uniform(0.0, 2.0 * np.pi, 2)
        sent += np.array([0.9, 0.4]) * np.sin(2.0 * np.pi * rates * times[:-1, None] + phases)
    world = sw.World(ARM, control_dt=0.002)
    robot = world.rollout(sent, steps=rows - 1, do=TRUE)
    recording = {"time": times, "first.control": sent[:, 0], "second.control": sent[:, 1]}
    for name in ("shoulder.position", "elbow.position"):
        recording[name] = robot[name] + 1e-3 * rng.normal(size=rows)
    begin = time.process_time()
    fit = world.fit(recording, [*TRUE])
    print(fit)
    low, high = fit.table.low.to_numpy(), fit.table.high.to_numpy()
    cover = int(((low <= [*TRUE.values()]) & (high >= [*TRUE.values()])).sum())
    print(f"{cover} of 6 intervals cover; {time.process_time() - begin:.1f} s of a processor")


if __name__ == "__main__":
    main()
