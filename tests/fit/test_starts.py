"""Fits whose recording begins as is known, and their replay from there."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

import scm_world as sw
from scm_world.errors import UnknownOption, UnknownVariable

SERVO = """
<mujoco model="servo"><option gravity="0 0 0"/>
  <worldbody><body name="arm">
    <joint name="hinge" axis="0 1 0" damping="0.05" armature="0.01"/>
    <geom name="rod" type="capsule" fromto="0 0 0 0.2 0 0" size="0.01" mass="0.1"/>
  </body></worldbody>
  <actuator><general name="servo" joint="hinge" dyntype="filterexact" dynprm="0.05" gainprm="2"
    biastype="affine" biasprm="0 -2 0"/></actuator>
</mujoco>
"""
NOISE = 2e-3  # [rad]
NAMES = ["servo.kp", "hinge.damping"]


def moved(kp: float, steps: int = 40, seed: int = 0, at: float = 0.4) -> dict[str, Any]:
    """Return a recording by plain MuJoCo: a servo that stands, and follows commands."""
    text = SERVO.replace('gainprm="2"', f'gainprm="{kp}"').replace("0 -2 0", f"0 {-kp} 0")
    model = mujoco.MjModel.from_xml_string(text)
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    data.qpos[0] = data.act[0] = at
    commands = np.repeat([at, *rng.uniform(-0.8, 0.8, steps // 10 - 1)], 10)
    seen = [at]
    for command in commands:
        data.ctrl[0] = command
        mujoco.mj_step(model, data, 10)
        seen.append(float(data.qpos[0]))
    noisy = np.array(seen) + NOISE * rng.normal(size=steps + 1)
    names = ("time", "servo.control", "hinge.position")
    arrays = (0.02 * np.arange(steps + 1), np.append(commands, np.nan), noisy)
    return dict(zip(names, arrays, strict=True))


def test_a_fit_begins_at_rest_where_that_is_known() -> None:
    """Velocity 0 and the activation of the first command; after a gap nothing is known."""
    world, recording = sw.World(SERVO), moved(2.6)
    cut = {name: np.delete(values, [17, 18]) for name, values in recording.items()}
    for given, begins in ((recording, "rest"), (cut, "rest"), (recording, {"*.act*": (0.4, 0.01)})):
        fit = world.fit(given, NAMES, begins=begins)
        activation = 0.01 if isinstance(begins, dict) else 1e-3
        assert fit.starts[0, 2] == pytest.approx(0.4, abs=3 * activation)
        assert len(fit.runs) == 1 + (given is cut)
        if begins == "rest":
            assert fit.starts[0, 1] == pytest.approx(0.0, abs=3e-3)
            assert fit.starts[0, 0] == pytest.approx(0.4, abs=NOISE)
        table = fit.table.set_index("parameter")
        for name, true in zip(NAMES, (2.6, 0.05), strict=True):
            assert table.low[name] < true < table.high[name]
        assert fit.explains
        assert "1 measured column" in fit.read
        assert {*fit.counterfactual({}, draws=2).column} == {"hinge.position"}
    (experiment,) = fit.suggest(1, steps=20)
    assert np.isfinite(experiment.after)


def test_a_start_that_contradicts_the_recording_is_said() -> None:
    """It moved when the recording began; what stood there, and is fitted as moving, is said."""
    world, recording = sw.World(SERVO), moved(2.6)
    moving = {name: values[13:] for name, values in recording.items()}
    fit = world.fit(moving, NAMES, begins="rest", window=30)
    assert not fit.explains
    assert "or it did not begin as begins= says" in str(fit)
    free = world.fit(moving, NAMES, window=30)
    assert free.explains
    assert "run 0 begins at hinge.velocity = " in str(free)
    assert "begins='rest'" in str(free)


def test_wrong_starts_are_refused() -> None:
    """What was given, and what can be."""
    world, recording = sw.World(SERVO), moved(2.0)
    for wrong in ("moving", {"hinge.velocity": 0.0}, {"hinge.velocity": (0.0, 0.0)}, ["rest"]):
        with pytest.raises(UnknownOption, match="begins"):
            world.fit(recording, NAMES, begins=wrong)
    with pytest.raises(UnknownVariable, match=r"knee\.velocity"):
        world.fit(recording, NAMES, begins={"knee.velocity": (0.0, 0.1)})
