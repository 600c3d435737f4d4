"""Intervals of counterfactuals of recorded runs, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

import scm_world as sw

STEPS, DT, NOISE, AT = 40, 0.02, 0.01, 20
SLIDERS = """
<mujoco model="sliders">
  <option gravity="0 0 0" timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="a"><joint name="a" type="slide" axis="1 0 0" damping="2"/>
      <geom type="sphere" size="0.1" mass="1"/></body>
    <body name="b" pos="0 1 0"><joint name="b" type="slide" axis="1 0 0"/>
      <geom type="sphere" size="0.1" mass="1"/></body>
  </worldbody>
</mujoco>
"""


def test_a_counterfactual_is_as_uncertain_as_the_state_at_which_it_begins() -> None:
    """A body that is braked from then on: its speed is that of a straight line through its places.

    The fitted parameter is that of another body, so only the start state is uncertain.
    """
    rng, time = np.random.default_rng(0), DT * np.arange(STEPS + 1)
    places = 0.5 * time + NOISE * rng.normal(size=len(time))
    braked = (1.0 - np.exp(-2.0 * time)) / 2.0 + NOISE * rng.normal(size=len(time))
    columns = {"time": time, "a.position": braked, "b.position": places}
    noise = {"a.position": NOISE, "b.position": NOISE}
    with sw.World(SLIDERS, control_dt=DT) as world:
        fit = world.fit(columns, "a.damping", noise=noise)
        frame = fit.counterfactual({"b.damping": 5.0}, at=AT, draws=400)
    frame = frame[frame.column == "b.position"]
    since = np.maximum(time - time[AT], 0.0)
    lost = since - (1.0 - np.exp(-5.0 * since)) / 5.0  # [s] of the speed before
    speed = np.polyfit(time, places, 1)[0]
    deviation = NOISE / np.sqrt(((time - time.mean()) ** 2).sum())
    half = stats.norm.ppf(0.975) * deviation * np.sqrt(fit.discount) * lost
    wanted = places - speed * lost
    assert np.abs(frame.counterfactual - wanted).max() < 0.02 * speed * lost[-1]
    assert np.abs(frame.high - frame.low).iloc[: AT + 1].max() < 1e-12
    assert (frame.high - frame.low).iloc[-1] == pytest.approx(2.0 * half[-1], rel=0.15)
